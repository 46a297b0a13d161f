"""Laws of the arithmetic between points and seconds."""

from __future__ import annotations

import math
from decimal import Decimal

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fmu_mesh.simtime import ENDLESS, TimeGrid, step_within, steps_between

ROUND_STOPS = (1, 2, 5, 10, 20, 30, 40, 50, 60, 100, 120, 300, 600, 3600)
ROUND_STEPS = ("0.1", "0.05", "0.02", "0.01", "0.005", "0.002", "0.001", "0.0005")

round_numbers = st.builds(
    lambda digits, exponent: Decimal(digits).scaleb(exponent), st.integers(-9999, 9999), st.integers(-4, 3)
)
round_steps = st.builds(
    lambda digits, exponent: Decimal(digits).scaleb(exponent), st.integers(1, 99), st.integers(-5, 0)
)


def assert_no_step_ends_after_the_told_stop_time(grid: TimeGrid, points: int) -> None:
    """Every step of an instance, as its FMU adds it up, ends by the time that it is told, late by rounding only."""
    stop, told = grid.stop_time, grid.told_stop_time(points)
    assert stop is not None
    assert told is not None
    starts = grid.start_time + np.arange(grid.last_point // points) * points * grid.step_size
    assert (starts + points * grid.step_size <= told).all()
    assert 0.0 <= told - stop <= 4 * math.ulp(max(abs(grid.start_time), abs(stop), points * grid.step_size))


@pytest.mark.parametrize("stop", ROUND_STOPS)
def test_no_step_of_a_round_size_ends_after_a_round_stop_time(stop: int) -> None:
    for text in ROUND_STEPS:
        count = int(Decimal(stop) / Decimal(text))
        assert steps_between(0.0, float(stop), float(text)) == count
        assert_no_step_ends_after_the_told_stop_time(TimeGrid(0.0, float(text), count), 1)


@given(round_numbers, round_steps, st.integers(0, 2000), st.integers(1, 7))
def test_no_step_ends_after_the_told_stop_time_from_any_round_start(
    start: Decimal, step: Decimal, count: int, points: int
) -> None:
    assert_no_step_ends_after_the_told_stop_time(TimeGrid(float(start), float(step), count), points)


@given(st.floats(-1e6, 1e6), st.floats(1e-6, 1e3), st.integers(1, 10_000))
def test_no_step_ends_after_the_told_stop_time_whatever_the_numbers(start: float, step: float, count: int) -> None:
    assert_no_step_ends_after_the_told_stop_time(TimeGrid(start, step, count), 1)


def test_a_run_without_an_end_tells_no_stop_time() -> None:
    assert TimeGrid(0.5, 0.1, ENDLESS).told_stop_time(3) is None


@given(st.floats(-10.0, 10.0), st.floats(1e-3, 20.0))
def test_a_step_that_ends_in_time_keeps_its_size(time: float, size: float) -> None:
    assert step_within(time, size, time + size) == size


@pytest.mark.parametrize("end", [0.11, 0.25, 0.7, 1.3])
def test_the_rest_of_a_step_is_the_rest_but_for_rounding(end: float) -> None:
    """From any hundredth before it: 0.04 + (0.11 - 0.04) is greater than 0.11, as many of these sums are."""
    for time in (hundredths / 100 for hundredths in range(-100, round(end * 100))):
        rest = step_within(time, end - time, end)
        assert time + rest <= end
        assert end - time - math.ulp(end - time) <= rest <= end - time


@given(round_numbers, round_steps, st.integers(0, 100_000))
def test_round_times_are_as_many_steps_apart_as_on_paper(start: Decimal, step: Decimal, count: int) -> None:
    stop = start + count * step

    assert steps_between(float(start), float(stop), float(step)) == count


@given(round_numbers, round_steps, st.integers(0, 10_000), st.floats(0.01, 0.99))
def test_a_duration_that_ends_within_step_is_no_whole_number_of_them(
    start: Decimal, step: Decimal, count: int, part: float
) -> None:
    stop = float(start) + (count + part) * float(step)

    assert steps_between(float(start), stop, float(step)) is None


@pytest.mark.parametrize(("start", "stop", "step"), [(0.0, 1.0, 0.0), (1.0, 0.0, 0.1), (0.0, math.inf, 0.1)])
def test_what_is_no_duration_has_no_number_of_steps(start: float, stop: float, step: float) -> None:
    assert steps_between(start, stop, step) is None
