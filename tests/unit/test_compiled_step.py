"""The calls of a step as one compiled call: their order, their arguments, and what a status does."""

from __future__ import annotations

import ctypes
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest

from fmu_mesh import compiled
from fmu_mesh.instances.fmi import open_instance, read_description
from fmu_mesh.instances.fmi.calls import DirectCall, RowPointers, cffi_function, memory, pointer
from fmu_mesh.instances.fmi.co_simulation.compiled_step import (
    GETTING,
    SETTING,
    STATUS_BITS,
    STEPPING,
    CompiledStep,
    compile_step,
    fmi2_step,
    fmi3_step,
)
from fmu_mesh.rings.ring import Ring
from fmu_mesh.simtime import TimeGrid
from fmu_mesh.system.layout import Layout
from fmu_mesh.variables.value_types import VariableType
from tests.fmus.helpers import find_fmu

COMPONENT = 4711
ROW_SIZE = 16

_MOVE = ctypes.CFUNCTYPE(ctypes.c_int, ctypes.c_void_p, ctypes.c_void_p, ctypes.c_size_t, ctypes.c_void_p)
_STEP = ctypes.CFUNCTYPE(ctypes.c_int, ctypes.c_void_p, ctypes.c_double, ctypes.c_double, ctypes.c_int)
_MOVE_3 = ctypes.CFUNCTYPE(
    ctypes.c_int, ctypes.c_void_p, ctypes.c_void_p, ctypes.c_size_t, ctypes.c_void_p, ctypes.c_size_t
)
_STEP_3 = ctypes.CFUNCTYPE(
    ctypes.c_int, ctypes.c_void_p, ctypes.c_double, ctypes.c_double, ctypes.c_bool, *[ctypes.c_void_p] * 4
)


class Recorded:
    """An FMU of four functions that notes how they are called, and returns what it is told."""

    def __init__(self, **statuses: int) -> None:
        self.calls: list[tuple[Any, ...]] = []
        self._statuses = statuses
        self._memory = (ctypes.c_double * 64)()
        self.rows = ctypes.addressof(self._memory)
        self._keep: list[Any] = []
        self._setters = [self._move("set_real", 3, 1), self._move("set_integer", 5)]
        self._getters = [self._move("get_real", 7, 8, 9)]
        self._keep.append(_STEP(self._stepped))
        self._step = cffi_function(self._keep[-1], "int (*)(void *, double, double, int)")

    def compile_step(self) -> CompiledStep:
        one = compile_step(pointer(COMPONENT), self._setters, fmi2_step(self._step, 0.1), self._getters)
        assert one is not None
        return one

    def _move(self, name: str, *references: int) -> DirectCall:
        array = (ctypes.c_uint * len(references))(*references)

        def moved(component: int, values: int, count: int, row: int) -> int:
            taken = tuple(ctypes.cast(values, ctypes.POINTER(ctypes.c_uint))[:count])
            self.calls.append((name, component, taken, (row - self.rows) // ROW_SIZE))
            return self._statuses.get(name, 0)

        self._keep.append(_MOVE(moved))
        called = cffi_function(self._keep[-1], "int (*)(void *, void *, size_t, void *)")
        return called, memory(array), len(references), RowPointers(self.rows, ROW_SIZE), len(references)

    def _stepped(self, component: int, time: float, step_size: float, no_set_state: int) -> int:
        self.calls.append(("step", component, time, step_size, no_set_state))
        return self._statuses.get("step", 0)


ALL = [
    ("set_real", COMPONENT, (3, 1), 4),
    ("set_integer", COMPONENT, (5,), 4),
    ("step", COMPONENT, 0.3, 0.1, 1),
    ("get_real", COMPONENT, (7, 8, 9), 6),
]


def test_all_functions_are_called_in_their_order_on_their_rows() -> None:
    recorded = Recorded(set_real=1, step=1)  # a warning is none of our business
    one = recorded.compile_step()

    assert one.call(4, 0.3, 6) == 0
    assert recorded.calls == ALL


@pytest.mark.parametrize(
    ("name", "status", "stage", "calls"),
    [
        ("set_real", 3, SETTING, 1),
        ("set_integer", 2, SETTING, 2),
        ("step", 5, STEPPING, 3),
        ("step", 70_000, STEPPING, 3),
        ("get_real", 4, GETTING, 4),
    ],
)
def test_the_first_status_above_warning_ends_the_step_and_is_told_with_its_stage(
    name: str, status: int, stage: int, calls: int
) -> None:
    recorded = Recorded(**{name: status})
    one = recorded.compile_step()

    assert divmod(one.call(4, 0.3, 6), 1 << STATUS_BITS) == (stage, status)
    assert recorded.calls == ALL[:calls]


class Recorded3:
    """As `Recorded`, with the functions of FMI 3.0, which take the number of values, and where a step sets flags."""

    def __init__(self) -> None:
        self.calls: list[tuple[Any, ...]] = []
        self.flag: int | None = None
        self._memory = (ctypes.c_double * 64)()
        self._flags = (ctypes.c_uint8 * 4)()
        first = ctypes.addressof(self._flags)
        self.addresses = (first, first + 1, first + 2, ctypes.addressof(self._memory))
        self._keep = [_MOVE_3(self._moved), _STEP_3(self._stepped)]
        moved = cffi_function(self._keep[0], "int (*)(void *, void *, size_t, void *, size_t)")
        stepped = cffi_function(self._keep[1], "int (*)(void *, double, double, _Bool, void *, void *, void *, void *)")
        self._references = (ctypes.c_uint * 2)(6, 5)
        rows = RowPointers(ctypes.addressof(self._memory), ROW_SIZE)
        moves = [(moved, memory(self._references), 2, rows, 9)]
        step = fmi3_step(stepped, 0.1, [pointer(address) for address in self.addresses], first)
        one = compile_step(pointer(COMPONENT), moves, step, moves, sized=True)
        assert one is not None
        self.one = one

    def _moved(self, component: int, values: int, count: int, row: int, size: int) -> int:
        taken = tuple(ctypes.cast(values, ctypes.POINTER(ctypes.c_uint))[:count])
        self.calls.append((component, taken, (row - ctypes.addressof(self._memory)) // ROW_SIZE, size))
        return 0

    def _stepped(self, component: int, time: float, step_size: float, no_set_state: bool, *results: int) -> int:  # noqa: FBT001 as in C
        self.calls.append((component, time, step_size, no_set_state, results, bytes(self._flags)))
        if self.flag is not None:
            self._flags[self.flag] = 1
        return 0


@pytest.mark.parametrize("flag", [None, 0, 1, 2])
def test_a_step_of_fmi_3_ends_where_the_fmu_says_more_than_its_status(flag: int | None) -> None:
    recorded = Recorded3()
    recorded.flag = flag
    moved = (COMPONENT, (6, 5))
    step = (COMPONENT, 0.3, 0.1, True, recorded.addresses, bytes(4))
    all_calls = [(*moved, 4, 9), step, (*moved, 6, 9)]

    for _ in range(2):  # the flags of the first step are no longer there in the second
        outcome = recorded.one.call(4, 0.3, 6)

        assert divmod(outcome, 1 << STATUS_BITS) == ((0, 0) if flag is None else (STEPPING, 0))
        assert recorded.calls == all_calls[: 3 if flag is None else 2]
        recorded.calls.clear()


MODELS: list[tuple[str, dict[str, float]]] = [
    ("TransportDelay", {}),
    ("DampedPendulum", {}),
    ("Integrator", {}),
    ("Gain", {}),
    ("AllTypes3", {}),
    ("Events3", {"interval": 0.3125, "announced": 1.0}),  # no plain step passes an event that it announces
    ("Events3", {"interval": 0.3125, "announced": 0.0}),  # it returns early from a plain step
]


@pytest.mark.parametrize(("model", "start_values"), MODELS)
def test_the_rows_are_those_of_a_step_call_by_call(
    model: str, start_values: dict[str, float], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    together, is_one_call = rows_of_steps(model, start_values, tmp_path)
    monkeypatch.setattr(compiled, "_llvm", lambda: None)

    assert rows_of_steps(model, start_values, tmp_path) == (together, False)
    assert is_one_call
    assert len(set(together)) > 100


def rows_of_steps(
    model: str, start_values: dict[str, float], folder: Path
) -> tuple[list[tuple[tuple[float, ...], ...]], bool]:
    """All numbers that an FMU puts out in 200 steps, and whether a step was one call."""
    path = find_fmu(model, folder)
    description = read_description(path)
    with closing(open_instance(path, "it", description, folder)) as instance:
        instance.enter_initialization(0.0, 100.0, start_values)
        instance.exit_initialization()
        numbers = ([v for v in description.with_causality(kind) if is_number(v.type)] for kind in ("input", "output"))
        inputs, outputs = (Ring(Layout.of(variables), 64) for variables in numbers)
        # A power of two, because Events3 wants each step to start exactly where it is.
        instance.bind(inputs, (outputs,), TimeGrid(0.0, 0.125, 1000), 1)
        rows = []
        for step in range(200):
            for part in inputs.parts:
                part[step & inputs.mask] = 0.37 * step
            instance.do_step(step)
            rows.append(tuple(tuple(part[(step + 1) & outputs.mask].tolist()) for part in outputs.parts))
        return rows, vars(instance)["_compiled"] is not None


def is_number(type_: VariableType) -> bool:
    return type_.startswith(("Float", "Int", "UInt"))
