"""The iteration of an algebraic loop: what is consistent, what comes next, and what is said when it does not end."""

from __future__ import annotations

import copy
import math
import random
import re
from collections.abc import Callable, Sequence
from operator import mul

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fmu_mesh.config.mesh import InitializationConfig
from fmu_mesh.errors import InitializationFailed, LoopNotConverged, from_report
from fmu_mesh.system.algebraic_loop import FixedPoint, accelerated
from fmu_mesh.system.initialization_plan import Loop, Tear
from fmu_mesh.variables.model_description import PlainValue, VariableType

_TYPES: dict[type, VariableType] = {float: "Float64", int: "Int32", bool: "Boolean"}


def loop(starts: list[PlainValue]) -> Loop:
    tears = tuple(
        Tear("b", f"y{n}", "a", f"u{n}", 1.0, 0.0, _TYPES[type(start)], start) for n, start in enumerate(starts)
    )
    return Loop(0, 1, tears, (("a", "x"), ("b", "y0")), ("a", "b"))


def iterated(gain: float, start: float = 0.0, bias: float = 1.0, **settings: float) -> FixedPoint:
    """The iteration of `u = gain * u + bias`."""
    point = FixedPoint(loop([start]), InitializationConfig(**settings))  # type: ignore[arg-type] # iterations is an int
    while not point.update([gain * point.assumed["a", "u0"] + bias]):  # type: ignore[operator] # a float
        pass
    return point


def solved(equations: Callable[[list[float]], Sequence[float]], starts: list[float]) -> tuple[list[float], int]:
    """The values and the number of sweeps of a loop of floats."""
    point = FixedPoint(loop([*starts]), InitializationConfig())
    while not point.update(equations(values := [float(str(own)) for own in point.assumed.values()])):
        pass
    return values, point.sweeps


def test_what_depends_on_nothing_is_consistent_after_the_second_sweep_and_exact() -> None:
    point = iterated(0.0, start=0.1, bias=0.3)

    assert (point.sweeps, point.assumed) == (2, {("a", "u0"): 0.3})


def test_a_loop_that_is_consistent_from_the_start_needs_one_sweep() -> None:
    assert iterated(0.5, start=2.0).sweeps == 1


@given(st.floats(-0.9, 0.9), st.floats(-10.0, 10.0))
def test_a_contracting_loop_ends_within_its_tolerance(gain: float, start: float) -> None:
    value = iterated(gain, start).assumed["a", "u0"]

    assert isinstance(value, float)
    # The error of a contraction is its residual over (1 - gain).
    assert abs(value - 1.0 / (1.0 - gain)) <= 1.1e-9 * max(1.0, abs(value)) / (1.0 - gain)


@pytest.mark.parametrize("gain", [-3.0, -2.0, 0.9, 0.5, 3.0, -1e3])
def test_one_secant_step_solves_a_linear_loop_whatever_its_gain(gain: float) -> None:
    point = iterated(gain)

    assert point.sweeps == 3
    assert point.assumed["a", "u0"] == pytest.approx(1.0 / (1.0 - gain), rel=1e-11)  # some last digits


@pytest.mark.parametrize(
    ("equation", "start", "solution"),
    [
        (math.cos, 0.0, 0.7390851332151607),
        (lambda u: 2.0 - u**3, 0.3, 1.0),
        (lambda u: math.exp(-3.0 * u), 0.0, 0.3499696316657),
        (lambda u: -math.log(u) if u > 0.0 else math.nan, 3.0, 0.5671432904097838),  # 3 leads to -1.1, and that to NaN
    ],
)
def test_a_nonlinear_loop_is_solved_where_substitution_leads_away(
    equation: Callable[[float], float], start: float, solution: float
) -> None:
    (value,), sweeps = solved(lambda u: [equation(*u)], [start])

    assert value == pytest.approx(solution, abs=1e-9)  # the tolerance
    assert sweeps <= 15


@pytest.mark.parametrize("scale", [0.5, 3.0, 10.0])
@pytest.mark.parametrize("count", [2, 3, 6])
def test_several_values_are_solved_after_one_sweep_for_each_and_few_more(count: int, scale: float) -> None:
    made = random.Random(count)  # noqa: S311  any numbers will do
    rows = [[made.uniform(-scale, scale) for _ in range(count)] for _ in range(count)]

    values, sweeps = solved(lambda u: [math.fsum(map(mul, row, u)) + 1.0 for row in rows], [0.0] * count)

    assert sweeps <= count + 4
    for row, value in zip(rows, values, strict=True):
        assert math.fsum(map(mul, row, values)) + 1.0 == pytest.approx(value, abs=2e-9, rel=2e-9)


def test_values_of_very_different_units_are_solved() -> None:
    """A pressure in Pa and a flow in m3/s."""
    (pressure, flow), _ = solved(lambda u: [1e5 - 2e8 * u[1], 3e-8 * (u[0] - 2e4)], [0.0, 0.0])

    assert (pressure, flow) == pytest.approx((2.2e5 / 7.0, 2.4e-3 / 7.0), rel=1e-9)


@pytest.mark.parametrize("gain", [0.05, -0.09])
def test_what_settles_fast_gets_the_floats_of_plain_substitution(gain: float) -> None:
    plain = 0.0
    while abs(gain * plain + 1.0 - plain) > 1e-9:
        plain = gain * plain + 1.0

    assert iterated(gain).assumed["a", "u0"] == plain


def test_outputs_that_only_seem_to_be_a_loop_are_exact() -> None:
    """Each one depends on the one before, by a factor with which differences grow."""
    exact = [0.1]
    for _ in range(4):
        exact.append(-7.3 * exact[-1] + 0.1)

    values, sweeps = solved(lambda u: [0.1, *(-7.3 * before + 0.1 for before in u[:-1])], [0.0] * 5)

    assert (values, sweeps) == (exact, 6)


def test_a_change_of_another_type_begins_again_with_other_equations() -> None:
    """The number counts down to 2 meanwhile."""
    point = FixedPoint(loop([0.0, 5]), InitializationConfig())
    while True:
        value, number = point.assumed.values()
        assert isinstance(value, float)
        assert isinstance(number, int)
        if point.update([-3.0 * value + number, max(number - 1, 2)]):
            break

    assert point.assumed["a", "u1"] == 2
    assert point.assumed["a", "u0"] == pytest.approx(0.5, abs=1e-9)
    assert point.sweeps == 6


def test_what_settles_by_substitution_only_still_does() -> None:
    """The differences of values that are rounded say nothing."""
    value, sweeps = solved(lambda u: [round(0.5 * u[0] + 1.0, 3)], [0.0])

    assert value == [2.0]
    assert sweeps < 60


@given(st.lists(st.tuples(st.floats(-1e9, 1e9), st.floats(-1e9, 1e9)), min_size=1, max_size=5))
def test_a_step_depends_on_its_values_only_and_is_finite(sweeps: list[tuple[float, float]]) -> None:
    pairs = [([old], [new]) for old, new in sweeps]

    assert accelerated(pairs) == accelerated(copy.deepcopy(pairs))
    assert math.isfinite(*accelerated(pairs))


def test_a_relaxation_below_1_is_never_accelerated() -> None:
    relaxed = 0.0
    while abs(-2.0 * relaxed + 1.0 - relaxed) > 1e-9:
        relaxed += 0.5 * (-2.0 * relaxed + 1.0 - relaxed)

    assert iterated(-2.0, relaxation=0.5).assumed["a", "u0"] == relaxed
    with pytest.raises(LoopNotConverged, match=r"lower `initialization.relaxation` \(now 0.9\)"):
        iterated(-2.0, relaxation=0.9)


def test_a_loop_without_solution_is_named_with_last_values_and_residual() -> None:
    expected = (
        "the algebraic loop a.x -> b.y0 did not converge at the start: after 1000 iterations not within a tolerance of "
        "1e-09; residuals: b.y0 -> a.u0 1 (from 999 to 1000)"
    )
    with pytest.raises(LoopNotConverged, match=re.escape(expected)) as caught:
        iterated(1.0)

    assert caught.value.exit_code == 3
    assert "It may have no solution" in (caught.value.hint or "")


def test_the_error_tells_the_smallest_residual_where_the_tolerance_cannot_be_met() -> None:
    with pytest.raises(LoopNotConverged, match=r"as the tolerance counts them, 0\.00\d+ at best\. It may have no"):
        solved(lambda u: [round(-3.0 * u[0] + 1.002, 3)], [0.0])


def test_a_loop_that_leaves_all_bounds_ends_at_once() -> None:
    point = FixedPoint(loop([0.0]), InitializationConfig())

    with pytest.raises(LoopNotConverged, match=r"after 1 iterations a value is not finite any more; residuals: b.y0"):
        point.update([math.nan])


def test_other_types_than_real_have_to_be_equal() -> None:
    point = FixedPoint(loop([False, 3, 0.0]), InitializationConfig(tolerance=1.0, relaxation=0.5))

    assert not point.update([True, 4, 0.5])
    assert list(point.assumed.values()) == [True, 4, 0.25]
    assert point.update([True, 4, 0.5])


def test_residual_that_does_not_end_is_told_for_each_connection_off() -> None:
    point = FixedPoint(loop([0.0, False]), InitializationConfig(iterations=1))

    with pytest.raises(LoopNotConverged, match=r"residuals: b.y1 -> a.u1 \(from False to True\)"):
        point.update([0.0, True])


def test_the_error_crosses_a_process_boundary() -> None:
    with pytest.raises(LoopNotConverged) as caught:
        iterated(1.0)

    again = from_report(caught.value.report())
    assert isinstance(again, LoopNotConverged)
    assert isinstance(again, InitializationFailed)


def test_an_array_agrees_when_all_its_elements_do() -> None:
    tear = Tear("b", "y", "a", "u", 1.0, 0.0, "Float64", [1.0, "INF"], (2,))
    point = FixedPoint(Loop(0, 0, (tear,), (("b", "y"),), ("b",)), InitializationConfig(relaxation=0.5, iterations=3))
    assert point.assumed == {("a", "u"): [1.0, math.inf]}

    point.assumed["a", "u"] = [1.0, 0.0]
    assert not point.update([[1.0, 4.0]])
    assert point.assumed == {("a", "u"): [1.0, 2.0]}
    assert point.update([[1.0, 2.0]])
    with pytest.raises(LoopNotConverged, match=r"residuals: b.y -> a.u 6 \(the largest of its elements\)"):
        point.update([[3.0, 8.0]])
