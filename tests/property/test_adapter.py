"""Laws of input trajectories: the order of calls does not matter, and every value is the one worked out otherwise.

`Gain` with k = 1 shows after each step what the step was given. Steps and stamps are whole numbers of 1/64 s, which are
exact in binary, so an input can be compared with a calculation in fractions.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path

from hypothesis import given, settings
from hypothesis import strategies as st

from fmu_mesh import FMIAdapter
from tests.helpers import examples

GAIN = Path(__file__).resolve().parents[2] / "fmus" / "Gain.fmu"
TICK = 1 / 64
STEPS = 40

starts = st.sampled_from([0.0, 17.25, -3.5, 1.7e9])
values = st.floats(min_value=-1e6, max_value=1e6)
stamps = st.tuples(st.integers(-20, 60), values)
"""A time in ticks after the start, and a value."""
few = settings(deadline=None, max_examples=examples(60))  # each example loads an FMU


def inputs_of(
    given_stamps: Sequence[tuple[int, float]], *, start: float, interpolate: bool, early: int = 0, initial: float = 0.0
) -> list[float]:
    """What each step is given when the stamps are set in this order, the first ``early`` of them before the start."""
    with FMIAdapter(GAIN, TICK, interpolate) as adapter:
        adapter.set_initial_value("u", initial)
        for tick, value in given_stamps[:early]:
            adapter.set_input_value("u", start + tick * TICK, value)
        adapter.exit_initialization_mode(start)
        for tick, value in given_stamps[early:]:
            adapter.set_input_value("u", start + tick * TICK, value)
        seen = []
        for _ in range(STEPS):
            adapter.do_step()
            seen.append(float(adapter.get_output_value("y")))
        return seen


def expected_input(pairs: dict[int, float], tick: int, *, interpolate: bool) -> Fraction:
    """The input at a tick by definition, looking at all pairs; one of them is at or before it."""
    before = max(time for time in pairs if time <= tick)
    after = [time for time in pairs if time > tick]
    if not interpolate or not after or before == tick:
        return Fraction(pairs[before])
    weight = Fraction(tick - before, min(after) - before)
    return (1 - weight) * Fraction(pairs[before]) + weight * Fraction(pairs[min(after)])


@few
@given(data=st.data(), given_stamps=st.dictionaries(st.integers(0, 60), values), start=starts)
def test_any_order_of_calls_gives_the_trajectory_of_the_sorted_ones(
    data: st.DataObject, given_stamps: dict[int, float], start: float
) -> None:
    interpolate = data.draw(st.booleans())
    shuffled = data.draw(st.permutations(sorted(given_stamps.items())))
    early = data.draw(st.integers(0, len(shuffled)))

    in_any_order = inputs_of(shuffled, start=start, interpolate=interpolate, early=early)

    assert in_any_order == inputs_of(sorted(given_stamps.items()), start=start, interpolate=interpolate)


@few
@given(given_stamps=st.lists(stamps, max_size=12), start=starts, initial=values)
def test_a_constant_input_is_the_last_value_at_or_before_a_step(
    given_stamps: list[tuple[int, float]], start: float, initial: float
) -> None:
    pairs = {-1_000_000: initial} | dict(given_stamps)

    seen = inputs_of(given_stamps, start=start, interpolate=False, early=len(given_stamps), initial=initial)

    assert seen == [expected_input(pairs, tick, interpolate=False) for tick in range(STEPS)]


@few
@given(given_stamps=st.lists(stamps, max_size=12), start=starts, initial=values)
def test_a_linear_input_is_on_the_line_between_its_neighbours(
    given_stamps: list[tuple[int, float]], start: float, initial: float
) -> None:
    pairs = dict(given_stamps)
    if not any(tick <= 0 for tick in pairs):
        pairs[0] = initial

    seen = inputs_of(given_stamps, start=start, interpolate=True, early=len(given_stamps), initial=initial)

    largest = max(map(abs, pairs.values()))
    for tick, value in enumerate(seen):
        exact = expected_input(pairs, tick, interpolate=True)
        # The difference of two values, the weight, their product and a sum: each is rounded once, at up to 2 * largest.
        assert abs(Fraction(value) - exact) <= 4 * math.ulp(2 * largest)


@few
@given(
    given_stamps=st.lists(
        st.tuples(st.integers(0, STEPS), values, st.integers(0, STEPS)), max_size=12, unique_by=lambda s: s[0]
    ),
    start=starts,
)
def test_a_constant_input_may_come_at_any_moment_before_its_time(
    given_stamps: list[tuple[int, float, int]], start: float
) -> None:
    seen = []
    with FMIAdapter(GAIN, TICK, interpolate_input=False) as adapter:
        adapter.exit_initialization_mode(start)
        for now in range(STEPS):
            for tick, value, moment in given_stamps:
                if min(moment, tick) == now:
                    adapter.set_input_value("u", start + tick * TICK, value)
            adapter.do_step()
            seen.append(float(adapter.get_output_value("y")))

    in_advance = [(tick, value) for tick, value, _ in given_stamps]
    assert seen == inputs_of(in_advance, start=start, interpolate=False)


@few
@given(step_size=st.floats(min_value=1e-4, max_value=10.0), steps=st.integers(0, 200), start=starts)
def test_the_time_after_any_number_of_steps_is_one_multiplication(step_size: float, steps: int, start: float) -> None:
    with FMIAdapter(GAIN, step_size) as adapter:
        adapter.exit_initialization_mode(start)

        reached = adapter.do_steps_until(start + steps * step_size)

    # A float of Unix time is good to 0.24 us, which moves no step of 0.1 ms or more.
    assert reached == start + steps * step_size
