"""Laws of the rule that says which row of a source feeds which step of a target (design, section 3)."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from fmu_mesh.system.coupling_rule import CouplingRule

points = st.integers(1, 12)
delays = st.integers(0, 1)
steps = st.integers(0, 10_000)
rules = st.builds(CouplingRule, delay=delays, source_points=points, target_points=points)


@given(rules, steps)
def test_a_step_reads_no_row_of_its_future(rule: CouplingRule, step: int) -> None:
    end = (step + 1) * rule.target_points

    assert rule.row_for(step) * rule.source_points <= end


@given(rules, steps)
def test_with_a_delay_a_step_reads_nothing_that_comes_after_its_start(rule: CouplingRule, step: int) -> None:
    late = CouplingRule(1, rule.source_points, rule.target_points)

    assert late.row_for(step) * rule.source_points <= step * rule.target_points


@given(rules, steps)
def test_a_step_reads_the_newest_row_that_it_may(rule: CouplingRule, step: int) -> None:
    point = step * rule.target_points if rule.delay else (step + 1) * rule.target_points
    newest = rule.row_for(step)

    assert newest * rule.source_points <= point < (newest + 1) * rule.source_points


@given(points, points, steps)
def test_delay_1_reads_what_delay_0_reads_one_step_before(source: int, target: int, step: int) -> None:
    late, instant = CouplingRule(1, source, target), CouplingRule(0, source, target)

    assert late.row_for(step + 1) == instant.row_for(step)
    assert late.row_for(step) <= instant.row_for(step)


@given(points, points)
def test_the_first_step_reads_the_initial_row_if_there_is_a_delay(source: int, target: int) -> None:
    assert CouplingRule(1, source, target).row_for(0) == 0


@given(points, delays, steps)
def test_at_equal_rates_the_delay_is_the_distance_in_rows(own: int, delay: int, step: int) -> None:
    assert CouplingRule(delay, own, own).row_for(step) == step + 1 - delay


@given(rules, steps)
def test_rows_are_read_in_their_order(rule: CouplingRule, step: int) -> None:
    assert rule.row_for(step) <= rule.row_for(step + 1)


@given(points, points, steps, st.integers(0, 5000))
def test_ahead_a_step_reads_the_first_row_at_its_end_or_later(source: int, target: int, step: int, last: int) -> None:
    rule = CouplingRule(0, source, target, ahead=True, last=last)
    end = (step + 1) * target

    row = rule.row_for(step)

    assert row == last or row * source >= end
    assert (row - 1) * source < end
