"""Any scenario gives the same floats in C, in Python, in one process, and in a loop over FMPy that sets the values."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from fractions import Fraction
from typing import Any, cast

import msgspec
import numpy as np
import pytest
from hypothesis import HealthCheck, event, given, settings
from hypothesis import strategies as st

import fmu_mesh
from fmu_mesh.node import inputs
from fmu_mesh.rings import native
from fmu_mesh.simtime import ENDLESS, TimeGrid
from fmu_mesh.system.schedule import Course
from tests.equivalence.reference import Pipe, Reference, Unit, run_fmpy
from tests.helpers import FMUS, examples

LAST = 24
FMU_OF = {"gain": "Gain", "integral": "Integrator", "slow": "Gain"}
SETTABLE = (("gain", "u", True), ("gain", "k", False), ("integral", "k", False), ("slow", "u", True))
POINTS = {"gain": 1, "integral": 1, "slow": 3}
QUARTER = 4
"""Times lie on quarters of a step."""


class Drawn(msgspec.Struct, frozen=True):
    """A scenario; times are quarters of the base step after the start.

    Attributes:
        values: by (instance, variable): times, values, and whether they are linear.
        events: (time, instance, variable, value).
        grouped: whether all instances share a node.
    """

    start_time: float
    step_size: float
    values: dict[str, tuple[list[int], list[float], bool]]
    events: list[tuple[int, str, float]]
    grouped: bool

    def time(self, quarters: int) -> float:
        """In s, as a user would write it."""
        return self.start_time + quarters * self.step_size / QUARTER


numbers = st.one_of(st.sampled_from([0.0, -0.0, 1.0]), st.floats(-4, 4, allow_nan=False))
quarters = st.integers(-6, QUARTER * (LAST + 3))


@st.composite
def drawn_scenarios(draw: st.DrawFn) -> Drawn:
    values = {}
    for instance, variable, may_be_linear in SETTABLE:
        if not draw(st.booleans()):
            continue
        times = sorted(draw(st.lists(quarters, min_size=1, max_size=6)))
        own = draw(st.lists(numbers, min_size=len(times), max_size=len(times)))
        values[f"{instance}.{variable}"] = (times, own, may_be_linear and draw(st.booleans()))
    held = [f"{i}.{v}" for i, v, _ in SETTABLE if not values.get(f"{i}.{v}", ((), (), False))[2]]
    events = draw(st.lists(st.tuples(quarters, st.sampled_from(held), numbers), max_size=5)) if held else []
    unique = {(at, name): (at, name, value) for at, name, value in events}
    return Drawn(
        start_time=draw(st.sampled_from([0.0, 0.5, -3.0, 1000.1])),
        step_size=draw(st.sampled_from([0.1, 0.25, 1e-3, 1.0])),
        values=values,
        events=list(unique.values()),
        grouped=draw(st.booleans()),
    )


def mesh_of(drawn: Drawn) -> fmu_mesh.Mesh:
    h = drawn.step_size
    stop = drawn.start_time + LAST * h
    mesh = fmu_mesh.Mesh("drawn", step_size=h, stop_time=stop, start_time=drawn.start_time)
    for name, fmu in FMU_OF.items():
        group = "all" if drawn.grouped else None
        mesh.add(name, fmu=FMUS / f"{fmu}.fmu", step_size=POINTS[name] * h, group=group)
    mesh.connect("gain.y", "integral.u")
    mesh.scenario(
        {
            name: {
                "times": [drawn.time(time) for time in times],
                "values": values,
                "interpolation": "linear" if linear else "hold",
            }
            for name, (times, values, linear) in drawn.values.items()
        },
        [{"at": drawn.time(at), "set": {name: value}} for at, name, value in drawn.events],
    )
    return mesh


def prescribed(drawn: Drawn, name: str, begin: int) -> float | None:
    """The value of a variable for the step that begins at a point, from its definition, in exact arithmetic."""
    times, values, linear = drawn.values.get(name, ([], [], False))
    pairs = [*zip(times, values, strict=True)]
    pairs += sorted((at, value) for at, own, value in drawn.events if own == name)
    pairs.sort(key=lambda pair: pair[0])
    now = QUARTER * begin
    before = [pair for pair in pairs if pair[0] <= now]
    after = [pair for pair in pairs if pair[0] > now]
    if not before:
        return None
    start, value = before[-1]
    end, later = after[0] if after else before[-1]  # of equal times a line ends at the first: a jump
    if not linear or not after or start == now or same(value, later):
        return value
    first, last = drawn.time(start), drawn.time(end)
    time = drawn.start_time + begin * drawn.step_size
    return value + (later - value) * ((time - first) / (last - first))


def expected_of(drawn: Drawn) -> list[list[float]]:
    starts: dict[str, dict[str, float]] = {name: {} for name in FMU_OF}
    changes: dict[tuple[str, str], dict[int, float]] = {}
    for instance, variable, _ in SETTABLE:
        name, before = f"{instance}.{variable}", prescribed(drawn, f"{instance}.{variable}", 0)
        if before is not None:
            starts[instance][variable] = before
        for begin in range(POINTS[instance], LAST, POINTS[instance]):
            value = prescribed(drawn, name, begin)
            if value is not None and not same(value, before):
                changes.setdefault((instance, variable), {})[begin] = value
            before = value
    reference = Reference(
        units=[Unit(name, str(FMUS / f"{fmu}.fmu"), starts[name], POINTS[name]) for name, fmu in FMU_OF.items()],
        pipes=[Pipe("gain", "y", "integral", "u", 0)],
        step_size=drawn.step_size,
        last_point=LAST,
        recorded=[(name, "y") for name in FMU_OF],
        start_time=drawn.start_time,
        changes=changes,
    )
    return [list(row) for row in run_fmpy(reference)]


def same(left: float, right: float | None) -> bool:
    return right is not None and (left, math.copysign(1, left)) == (right, math.copysign(1, right))


def rows_of(result: fmu_mesh.Result) -> list[bytes]:
    return bits([list(row) for row in zip(result.times, *(result[f"{name}.y"] for name in FMU_OF), strict=True)])


def bits(rows: list[list[float]]) -> list[bytes]:
    return [np.array(row, np.float64).tobytes() for row in rows]


@contextmanager
def without_library() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(native, "library", None)
        yield


@contextmanager
def little_ahead() -> Iterator[None]:
    """Inputs are calculated only a few steps ahead, so that it happens often in a short run."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(inputs, "_SOON", 2)
        patch.setattr(inputs, "_AHEAD", 5)
        yield


@given(drawn_scenarios())
@settings(max_examples=examples(30), deadline=None, suppress_health_check=[HealthCheck.too_slow])
def test_every_way_of_running_gives_the_floats_of_a_loop_over_fmpy(drawn: Drawn) -> None:
    mesh = mesh_of(drawn)
    event("linear" if any(linear for *_, linear in drawn.values.values()) else "held")

    local = rows_of(mesh.run(record="memory", processes=False))
    with mesh.repeated() as runs:
        in_c = [rows_of(runs.run()) for _ in range(2)]
    with without_library(), mesh.repeated() as runs:
        in_python = rows_of(runs.run())
    with little_ahead():
        with mesh.repeated() as runs:
            ahead = [rows_of(runs.run())]
        with without_library(), mesh.repeated() as runs:
            ahead.append(rows_of(runs.run()))

    assert local == bits(expected_of(drawn))
    assert in_c == [local, local]
    assert in_python == local
    assert ahead == [local, local]


@given(drawn_scenarios(), st.integers(1, 4))
@settings(max_examples=examples(30), deadline=None, suppress_health_check=[HealthCheck.too_slow])
def test_system_stepped_by_program_follows_scenario_also_after_it_went_back(drawn: Drawn, before: int) -> None:
    mesh = mesh_of(drawn)
    wanted = mesh.run(record="memory", processes=False)

    with ExitStack() as stack:
        system = stack.enter_context(mesh.open())
        system.step(before)
        state = system.save()
        system.step(before)
        system.restore(state)
        got = [system.get("integral.y")]
        for _ in range(LAST - before):
            system.step()
            got.append(system.get("integral.y"))

    assert np.array(got).tobytes() == wanted["integral.y"][before:].tobytes()


times = st.lists(st.integers(-8, 80), min_size=1, max_size=8).map(sorted)


@given(times, st.lists(numbers, min_size=8, max_size=8), st.booleans(), st.booleans(), st.integers(1, 3))
def test_next_change_misses_no_change_and_change_tells_when_the_value_differs(
    quarters_: list[int],
    values: list[float],
    linear: bool,  # noqa: FBT001  drawn
    initial: bool,  # noqa: FBT001  drawn
    points: int,
) -> None:
    course = Course(
        [quarter * 0.1 / QUARTER for quarter in quarters_],
        values[: len(quarters_)],
        TimeGrid(0.0, 0.1, 100),
        points,
        linear=linear,
        initial=initial,
    )
    first = next((Fraction(quarter, QUARTER) for quarter in quarters_), None)
    assert first is not None

    changing = [step for step in range(40) if course.change(step) is not None]
    for step in range(40):
        due = next((other for other in changing if other >= step), ENDLESS)
        assert step <= course.next_change(step) <= due
    assert course.value(math.ceil(max(first, Fraction(0)) / points)) is not None
    start = course.first_step
    ahead = course.values(start, 40).tolist()
    assert all(same(value, cast("float", course.value(start + n))) for n, value in enumerate(ahead))
    held: Any = course.value(0) if initial else None
    for step in range(40):
        value = course.change(step)
        held = value if value is not None else held
        now: Any = course.value(step)
        assert (held is None and now is None) or same(held or 0.0, now) or (held == now)
