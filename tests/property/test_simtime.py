"""Laws of the arithmetic between points and seconds."""

from __future__ import annotations

import math
from decimal import Decimal

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fmu_mesh.simtime import steps_between

round_numbers = st.builds(
    lambda digits, exponent: Decimal(digits).scaleb(exponent), st.integers(-9999, 9999), st.integers(-4, 3)
)
round_steps = st.builds(
    lambda digits, exponent: Decimal(digits).scaleb(exponent), st.integers(1, 99), st.integers(-5, 0)
)


@given(round_numbers, round_steps, st.integers(0, 100_000))
def test_round_times_are_as_many_steps_apart_as_on_paper(start: Decimal, step: Decimal, count: int) -> None:
    stop = start + count * step

    assert steps_between(float(start), float(stop), float(step)) == count


@given(round_numbers, round_steps, st.integers(0, 10_000), st.floats(0.01, 0.99))
def test_a_duration_that_ends_within_a_step_is_no_whole_number_of_them(
    start: Decimal, step: Decimal, count: int, part: float
) -> None:
    stop = float(start) + (count + part) * float(step)

    assert steps_between(float(start), stop, float(step)) is None


@pytest.mark.parametrize(("start", "stop", "step"), [(0.0, 1.0, 0.0), (1.0, 0.0, 0.1), (0.0, math.inf, 0.1)])
def test_what_is_no_duration_has_no_number_of_steps(start: float, stop: float, step: float) -> None:
    assert steps_between(start, stop, step) is None
