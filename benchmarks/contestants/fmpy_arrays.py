"""FMPy's loaded library in one process with preallocated arrays: what a careful user can get out of one Python loop."""

from __future__ import annotations

import ctypes
from time import perf_counter
from typing import Any

from benchmarks.contestants.entry import main, versions
from benchmarks.contestants.fmu import Fmu, opened_all
from benchmarks.task import Outcome, Task

__all__: list[str] = []

_ACCESS = ctypes.CFUNCTYPE(ctypes.c_int, ctypes.c_void_p, ctypes.c_void_p, ctypes.c_size_t, ctypes.c_void_p)
_DO_STEP = ctypes.CFUNCTYPE(ctypes.c_int, ctypes.c_void_p, ctypes.c_double, ctypes.c_double, ctypes.c_int)


def run(task: Task) -> Outcome:
    """Step both instances; timed is the loop alone. Every row stays in one array of two columns."""
    with opened_all(task.system, task.stop_time) as (fmus, _):
        rows = ((ctypes.c_double * 2) * (task.points + 1))()
        base = ctypes.addressof(rows)
        for column, fmu in enumerate(fmus):
            rows[0][column] = fmu.get()
        loop = _chain if task.system.kind == "chain" else _cycle
        started = perf_counter()
        loop([_Calls(fmu) for fmu in fmus], base, task)
        seconds = perf_counter() - started
        last = {member.column: rows[task.points][column] for column, member in enumerate(task.system.members)}
    return Outcome(seconds, last, versions("fmpy"))


class _Calls:
    """The three functions of one instance, and the addresses of its value references."""

    def __init__(self, fmu: Fmu) -> None:
        self.component = fmu.fmu.component
        self.set = _ACCESS(("fmi2SetReal", fmu.fmu.dll))
        self.step = _DO_STEP(("fmi2DoStep", fmu.fmu.dll))
        self.get = _ACCESS(("fmi2GetReal", fmu.fmu.dll))
        self._keep = ((ctypes.c_uint * 1)(*fmu.inputs), (ctypes.c_uint * 1)(*fmu.outputs))
        self.input, self.output = (ctypes.addressof(references) for references in self._keep)


def _check(status: int) -> None:
    if status > 1:
        msg = f"an FMI function returned {status}"
        raise RuntimeError(msg)


def _chain(calls: list[_Calls], base: int, task: Task) -> None:
    step_size = task.system.step_size
    (a, b), row = calls, base
    a_step, a_get, a_output, a_component = a.step, a.get, a.output, a.component
    b_set, b_step, b_get, b_input, b_output, b_component = b.set, b.step, b.get, b.input, b.output, b.component
    for point in range(task.points):
        time = point * step_size
        row += 16
        status = a_step(a_component, time, step_size, 1)
        status |= a_get(a_component, a_output, 1, row)
        status |= b_set(b_component, b_input, 1, row)
        status |= b_step(b_component, time, step_size, 1)
        status |= b_get(b_component, b_output, 1, row + 8)
        if status > 1:
            _check(status)


def _cycle(calls: list[_Calls], base: int, task: Task) -> None:
    step_size = task.system.step_size
    (a, b), row = calls, base
    a_set, a_step, a_get, a_input, a_output, a_component = a.set, a.step, a.get, a.input, a.output, a.component
    b_set, b_step, b_get, b_input, b_output, b_component = b.set, b.step, b.get, b.input, b.output, b.component
    for point in range(task.points):
        time = point * step_size
        status: Any = a_set(a_component, a_input, 1, row + 8)
        status |= b_set(b_component, b_input, 1, row)
        row += 16
        status |= a_step(a_component, time, step_size, 1)
        status |= b_step(b_component, time, step_size, 1)
        status |= a_get(a_component, a_output, 1, row)
        status |= b_get(b_component, b_output, 1, row + 8)
        if status > 1:
            _check(status)


if __name__ == "__main__":
    main(run)
