"""The iteration of an algebraic loop: what is consistent, what comes next, and what is said when it does not end."""

from __future__ import annotations

import math
import re

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fmu_mesh.config.mesh import InitializationConfig
from fmu_mesh.errors import InitializationFailed, LoopNotConverged, from_report
from fmu_mesh.system.algebraic_loop import FixedPoint
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


def test_relaxation_brings_a_loop_to_its_end_that_diverges_without() -> None:
    with pytest.raises(LoopNotConverged):
        iterated(-2.0)

    assert iterated(-2.0, relaxation=0.5).assumed["a", "u0"] == pytest.approx(1.0 / 3.0, abs=1e-9)  # its tolerance


def test_the_error_names_the_loop_the_torn_connection_and_its_residual() -> None:
    expected = (
        "the algebraic loop a.x -> b.y0 did not converge at the start: after 3 iterations not within a tolerance of "
        "1e-09; residuals: b.y0 -> a.u0 4 (from -1 to 3)"
    )
    with pytest.raises(LoopNotConverged, match=re.escape(expected)) as caught:
        iterated(-2.0, iterations=3)

    assert caught.value.exit_code == 3
    assert "initialization.relaxation" in (caught.value.hint or "")


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
        iterated(2.0)

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
