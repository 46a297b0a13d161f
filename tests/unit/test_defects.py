"""What was assumed over steps compared with what came: the same floats as step by step, whatever the blocks are."""

from __future__ import annotations

import math
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from numpy.typing import NDArray

from fmu_mesh.config.instance_sections import Extrapolation
from fmu_mesh.results.defects import DefectWatch
from fmu_mesh.simtime import TimeGrid
from fmu_mesh.system.coupling_rule import Consistent, CouplingRule, SourceLine, Term, jumps_in
from fmu_mesh.system.defect import Defect
from fmu_mesh.system.feeds import Compared
from fmu_mesh.system.plan import Plan

POINTS = 20_001
RULES = [(1, 1), (1, 5), (5, 1), (2, 3), (3, 2), (4, 6), (7, 5)]
WAYS: list[tuple[Extrapolation, int]] = [(w, d) for w in ("hold", "linear", "midpoint") for d in (1, 0)]


def some_values(points: int = POINTS, own: int = 1) -> NDArray[np.float64]:
    """What a source with steps of ``own`` points has at each point: smooth, with jumps and times of rest."""
    places = np.arange(points) // own * own
    smooth: NDArray[np.float64] = np.sin(0.01 * places) + 1e-5 * places
    return smooth + 3.0 * (places // 911 % 3) + np.where(places > 0.9 * points, np.cos(0.4 * places), 0.0)


def watch_of(rule: CouplingRule, way: Extrapolation, values: NDArray[np.float64]) -> DefectWatch:
    """What watches the connections of two sources: one with these values and two readers, and one with others."""
    first, second = (Consistent(0.0, (Term("a", name, 1.0),)) for name in "yz")
    readers = (("a.y -> b.u", first), ("a.z -> b.v", second), ("a.y -> c.u", first))
    compared = tuple(Compared(name, rule, way, own) for name, own in readers)
    plan = SimpleNamespace(grid=TimeGrid(2.0, 0.5, len(values) - 1), system=SimpleNamespace(compared=compared))
    watch = DefectWatch(cast("Plan", plan))
    columns = iter((values, 0.5 * values - 1.0))

    def read_of(_: Consistent) -> Any:  # noqa: ANN401  a function of two points
        column = next(columns)
        return lambda first, end: column[first:end]

    watch.begin(read_of)
    return watch


def looked(watch: DefectWatch, points: int, block: int, first: int = 0) -> dict[str, Defect]:
    for start in range(first, points, block):
        watch.look(start, min(start + block, points))
    return watch.defects


def step_by_step(rule: CouplingRule, way: Extrapolation, values: NDArray[np.float64]) -> Iterator[tuple[int, float]]:
    """The point and the difference of each step of the target in which a value came, with one line after another."""
    own, knows_end = rule.source_points, not rule.delay and rule.target_points >= rule.source_points
    line = SourceLine(float(values[0]))
    for begin in range(0, len(values) - rule.target_points, rule.target_points):
        end = begin + rule.target_points
        line = line.through(float(values[begin]), begin - begin % own)
        if begin // own == end // own:
            continue
        held, came, last = float(values[begin]), float(values[end]), end - end % own
        if way == "hold":
            yield end, came - held
        elif knows_end:
            after = line.through(came, last)
            yield end, came - (held if way == "midpoint" and after.jumped else after.at(last))
        else:
            yield end, came - (held if way == "midpoint" and line.jumped else line.at(last))


@pytest.mark.parametrize(("own", "target"), RULES)
@pytest.mark.parametrize(("way", "delay"), WAYS)
def test_blocks_give_what_single_steps_give(way: Extrapolation, delay: int, own: int, target: int) -> None:
    rule, values = CouplingRule(delay, own, target), some_values(own=own)

    found = looked(watch_of(rule, way, values), POINTS, 512)["a.y -> b.u"]

    expected = list(step_by_step(rule, way, values))
    point, largest = max(expected, key=lambda item: abs(item[1]))
    assert (found.maximum, found.steps) == (abs(largest), len(expected))
    assert (found.point, found.time) == (point, 2.0 + 0.5 * point) or largest == 0.0
    assert found.rms == pytest.approx(math.sqrt(math.fsum(d * d for _, d in expected) / len(expected)), rel=1e-12)


@pytest.mark.parametrize(("own", "target"), RULES)
@pytest.mark.parametrize(("way", "delay"), WAYS)
def test_no_float_depends_on_the_blocks(way: Extrapolation, delay: int, own: int, target: int) -> None:
    rule, values = CouplingRule(delay, own, target), some_values(own=own)

    one, *others = [looked(watch_of(rule, way, values), POINTS, block) for block in (POINTS, 4096, 1000, 17)]

    assert [*one] == ["a.y -> b.u", "a.z -> b.v", "a.y -> c.u"]
    assert one["a.y -> b.u"] is one["a.y -> c.u"]
    assert all(other == one for other in others)


def test_looking_in_between_changes_nothing() -> None:
    values, rule = some_values(), CouplingRule(1, 1, 1)
    watch = watch_of(rule, "midpoint", values)

    for first in range(0, POINTS, 100):
        watch.look(first, min(first + 100, POINTS))
        watch.look(first, min(first + 100, POINTS))
        assert watch.defects or not first

    assert watch.defects == looked(watch_of(rule, "midpoint", values), POINTS, POINTS)


def test_another_run_begins_with_nothing() -> None:
    values, rule = some_values(), CouplingRule(1, 1, 1)
    watch = watch_of(rule, "linear", values)
    first = looked(watch, POINTS, 1000)

    watch.begin_again()

    assert watch.defects == {}
    assert looked(watch, POINTS, 1000) == first


@pytest.mark.parametrize("first", [1, 8191, 8192, 9000])
def test_a_run_that_goes_on_begins_where_lines_are_known(first: int) -> None:
    values = 1e-3 * np.arange(POINTS, dtype=float) ** 2
    watch = watch_of(CouplingRule(1, 1, 1), "linear", values)

    found = looked(watch, POINTS, 512, first)["a.y -> b.u"]

    assert found.steps == POINTS - 1 - first - 2
    assert found.maximum == pytest.approx(2e-3, rel=1e-6)


def test_a_linear_source_has_no_defect_with_lines() -> None:
    values = np.arange(POINTS, dtype=float)

    held = looked(watch_of(CouplingRule(1, 1, 1), "hold", values), POINTS, 4096)["a.y -> b.u"]
    lines = looked(watch_of(CouplingRule(1, 1, 1), "linear", values), POINTS, 4096)["a.y -> b.u"]

    assert (held.maximum, held.rms, held.relative) == (1.0, 1.0, 1.0 / (POINTS - 1))
    assert (lines.maximum, lines.point) == (1.0, 1)  # at the first point, there is one value only


@pytest.mark.parametrize("way", ["hold", "linear", "midpoint"])
def test_values_that_are_not_finite_are_left_out(way: Extrapolation) -> None:
    values = some_values()
    values[100], values[200], values[300] = math.nan, math.inf, 1e300

    found = looked(watch_of(CouplingRule(1, 1, 1), way, values), POINTS, 4096)["a.y -> b.u"]

    assert math.isfinite(found.maximum)
    assert 0.0 < found.rms <= found.maximum
    assert math.isfinite(found.relative)


def test_one_point_has_no_defect() -> None:
    assert looked(watch_of(CouplingRule(1, 1, 1), "hold", some_values(1)), 1, 1) == {}


def test_jumps_are_those_of_one_value_after_another() -> None:
    values, points = some_values(2000), np.cumsum(np.arange(2000) % 3 + 1.0) - 1.0
    line, expected = SourceLine(float(values[0])), []
    for number, (value, point) in enumerate(zip(values, points, strict=True)):
        line = line.through(float(value), int(point))
        expected += [number] if line.jumped else []

    jumps = jumps_in(values, np.diff(values), np.diff(points))

    assert expected
    assert jumps.tolist() == expected
