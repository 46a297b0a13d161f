"""What a GET answers: values of the point that is told with them, although the node steps meanwhile."""

from __future__ import annotations

import time
from types import SimpleNamespace
from typing import Any, cast

import pytest
import zenoh

from fmu_mesh.node import answering
from fmu_mesh.node.answering import Answers
from fmu_mesh.node.stepping import Runner
from fmu_mesh.rings.ring import Ring
from fmu_mesh.simtime import TimeGrid
from fmu_mesh.system.layout import Layout
from tests.scenarios.scenario import variable

ROWS = 8
Y = variable("y", "output")


class SteppingRunner:
    """A runner that goes on by ``stride`` steps whenever somebody looks; each row holds its own number."""

    def __init__(self, strides: list[int]) -> None:
        self.outputs = Ring(Layout.of([("y", "Float64")]), ROWS)
        self._strides = strides
        self._step = 0
        self._write(100)

    @property
    def step(self) -> int:
        self._write(self._strides.pop(0) if self._strides else 1)
        return self._step

    def _write(self, steps: int) -> None:
        for _ in range(steps):
            self._step += 1
            self.outputs.put(self._step, "y", float(self._step))


def read(strides: list[int]) -> tuple[list[tuple[str, Any]], int]:
    answers = Answers.__new__(Answers)
    runner = cast("Runner", SteppingRunner(strides))
    values: list[tuple[str, Any]]
    values, step = answers._from_rows(runner, [("key", Y)])
    return values, step


def test_the_values_are_those_of_the_step_that_is_told() -> None:
    values, step = read([])

    assert values == [("key", float(step))]


def test_a_row_that_was_overwritten_meanwhile_is_read_again() -> None:
    values, step = read([1, ROWS - 1, 1, 2])

    assert values == [("key", float(step))]
    assert step == 100 + 1 + ROWS - 1 + 1


def test_where_the_rows_go_by_too_fast_nothing_is_told_from_them() -> None:
    values, _ = read([1, ROWS] * 20)

    assert values == []


def test_what_the_rows_do_not_hold_is_left_to_the_main_thread() -> None:
    answers = Answers.__new__(Answers)
    runner = SimpleNamespace(outputs=Ring(Layout.of([("y", "Float64")]), ROWS), step=3)

    assert answers._from_rows(cast("Runner", runner), [("key", variable("x", "local"))]) == ([], 3)


class Query:
    """A query for the output, and what it was told."""

    payload = None

    def __init__(self, key: str = "out/y") -> None:
        self.key_expr = zenoh.KeyExpr(f"fmu_mesh/lab/unit/{key}")
        self.told: list[str] = []

    def reply(self, key: str, value: bytes, **_options: object) -> None:
        self.told.append(f"{key} {value.decode()}")

    def reply_err(self, reason: str) -> None:
        self.told.append(reason)

    def drop(self) -> None:
        self.told.append("dropped")


@pytest.mark.parametrize("state", ["waiting for the mesh", "initializing"])
def test_a_query_before_first_point_waits_for_it_and_not_for_ever(state: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(answering, "instance_info", lambda _plan, _runner, _ways, _loops: 5)
    ring = Ring(Layout.of([("y", "Float64")]), ROWS)
    ring.put(0, "y", 2.5)
    description = SimpleNamespace(variables=[Y], variable={"y": Y}.get)
    runner = SimpleNamespace(
        name="unit",
        outputs=ring,
        step=0,
        instance=SimpleNamespace(description=description),
        plan=SimpleNamespace(step_points=1),
        player=None,
    )
    activity = SimpleNamespace(state=state, runners={"unit": runner}, ways=None, loops=(), status=lambda _name: 7)
    plan = SimpleNamespace(key_prefix="fmu_mesh", mesh="lab", grid=TimeGrid(0.0, 0.1, 10))
    none = cast("Any", None)
    answers = Answers(cast("Any", plan), none, cast("Any", activity), none, none, none)
    soon, never, everything = Query(), Query(), Query("**")

    answers.answer("unit", cast("Any", never))
    answers.turn(time.monotonic())
    assert never.told == []
    answers.turn(time.monotonic() + 60.0)
    assert never.told == [f"'unit' has no values now: {state}", "dropped"]

    answers.answer("unit", cast("Any", soon))
    answers.answer("unit", cast("Any", everything))
    activity.state = "running"
    answers.turn(time.monotonic())
    root = "fmu_mesh/lab/unit"
    assert everything.told == [f"{root}/status 7", f"{root}/info 5", f"{root}/out/y 2.5", "dropped"]
    assert soon.told == ["fmu_mesh/lab/unit/out/y 2.5", "dropped"]
