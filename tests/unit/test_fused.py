"""The calls of a step as one compiled call: their order, their arguments, and what a status does."""

from __future__ import annotations

import ctypes
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest

from fmu_mesh import compiled
from fmu_mesh.fmu import open_instance, read_description
from fmu_mesh.fmu.calls import DirectCall, Rows, hot, memory, pointer
from fmu_mesh.fmu.fused import GETTING, SETTING, STATUS_BITS, STEPPING, Fused, fuse
from fmu_mesh.model.ring import Layout, Ring
from fmu_mesh.simtime import TimeGrid
from tests.fmus.helpers import FMUS

COMPONENT = 4711
ROW_SIZE = 16

_MOVE = ctypes.CFUNCTYPE(ctypes.c_int, ctypes.c_void_p, ctypes.c_void_p, ctypes.c_size_t, ctypes.c_void_p)
_STEP = ctypes.CFUNCTYPE(ctypes.c_int, ctypes.c_void_p, ctypes.c_double, ctypes.c_double, ctypes.c_int)


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
        self._step = hot(self._keep[-1], "int (*)(void *, double, double, int)")

    def fuse(self) -> Fused:
        one = fuse(pointer(COMPONENT), self._setters, self._step, 0.1, self._getters)
        assert one is not None
        return one

    def _move(self, name: str, *references: int) -> DirectCall:
        array = (ctypes.c_uint * len(references))(*references)

        def moved(component: int, values: int, count: int, row: int) -> int:
            taken = tuple(ctypes.cast(values, ctypes.POINTER(ctypes.c_uint))[:count])
            self.calls.append((name, component, taken, (row - self.rows) // ROW_SIZE))
            return self._statuses.get(name, 0)

        self._keep.append(_MOVE(moved))
        called = hot(self._keep[-1], "int (*)(void *, void *, size_t, void *)")
        return called, memory(array), len(references), Rows(self.rows, ROW_SIZE), len(references)

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
    one = recorded.fuse()

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
    one = recorded.fuse()

    assert divmod(one.call(4, 0.3, 6), 1 << STATUS_BITS) == (stage, status)
    assert recorded.calls == ALL[:calls]


@pytest.mark.parametrize("model", ["TransportDelay", "DampedPendulum", "Integrator", "Gain"])
def test_the_rows_are_those_of_a_step_call_by_call(model: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    together = rows_of_steps(model, tmp_path)
    monkeypatch.setattr(compiled, "_llvm", lambda: None)

    assert rows_of_steps(model, tmp_path) == together
    assert len(set(together)) > 100


def rows_of_steps(model: str, folder: Path) -> list[tuple[float, ...]]:
    path = FMUS / f"{model}.fmu"
    description = read_description(path)
    with closing(open_instance(path, "it", description, folder)) as instance:
        instance.enter_initialization(0.0, 100.0, {})
        instance.exit_initialization()
        inputs, outputs = (Ring(Layout.of(description.with_causality(kind)), 64) for kind in ("input", "output"))
        instance.bind(inputs, (outputs,), TimeGrid(0.0, 0.1, 1000), 1)
        rows = []
        for step in range(200):
            for part in inputs.parts:
                part[step & inputs.mask] = 0.37 * step
            instance.do_step(step)
            rows.append(tuple(outputs.parts[0][(step + 1) & outputs.mask].tolist()))
        return rows
