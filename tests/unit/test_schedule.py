"""What the steps of an instance use: the prescribed value at the start of each own step."""

from __future__ import annotations

import math

import pytest

from fmu_mesh.simtime import ENDLESS, TimeGrid
from fmu_mesh.system.schedule import Course

GRID = TimeGrid(1.0, 0.1, 60)


def values(course: Course, steps: int) -> list[object]:
    return [course.value(step) for step in range(steps)]


def test_value_holds_from_first_step_that_begins_at_its_time_or_later() -> None:
    course = Course([1.0, 1.3, 1.55], [1.0, 2.0, 3.0], GRID, 1)  # 1.0 + 3 * 0.1 is not 1.3

    assert values(course, 8) == [1.0, 1.0, 1.0, 2.0, 2.0, 2.0, 3.0, 3.0]


def test_instance_with_step_size_looks_at_starts_of_its_own_steps() -> None:
    course = Course([1.1, 1.35], [1.0, 2.0], GRID, 2)

    assert values(course, 4) == [None, 1.0, 2.0, 2.0]


def test_a_linear_value_is_on_the_line_and_ends_on_the_last() -> None:
    course = Course([0.9, 1.1, 1.25], [0.0, 4.0, 10.0], GRID, 1, linear=True)

    assert values(course, 5) == pytest.approx([2.0, 4.0, 8.0, 10.0, 10.0], rel=1e-12)
    assert course.value(1) == 4.0  # exactly, although 1.0 + 0.1 and 1.1 may differ by rounding


def test_of_several_values_for_one_step_the_last_one_counts() -> None:
    course = Course([1.0, 1.02, 1.04, 1.04, 1.2], [1.0, 2.0, 3.0, 4.0, 5.0], GRID, 1)

    assert values(course, 3) == [1.0, 4.0, 5.0]


def test_a_line_ends_at_a_jump_and_the_next_one_begins_there() -> None:
    line = Course([1.0, 1.2, 1.2, 1.4], [0.0, 1.0, 5.0, 6.0], GRID, 1, linear=True)

    assert values(line, 5) == pytest.approx([0.0, 0.5, 5.0, 5.5, 6.0], rel=1e-12)
    assert line.values(0, 5).tolist() == values(line, 5)


def test_a_value_is_set_where_it_changes_and_nowhere_else() -> None:
    course = Course([1.0, 1.1, 1.2, 1.3, 1.4], [5.0, 5.0, 6.0, 6.0, 5.0], GRID, 1)

    assert [course.change(step) for step in range(6)] == [None, None, 6.0, None, 5.0, None]
    assert [course.next_change(step) for step in range(6)] == [2, 2, 2, 4, 4, ENDLESS]


def test_what_was_no_start_value_is_set_in_the_first_step() -> None:
    course = Course([1.0], [5.0], GRID, 1, initial=False)

    assert (course.change(0), course.next_change(0), course.next_change(1)) == (5.0, 0, ENDLESS)


def test_nan_after_nan_is_no_change_and_another_sign_of_zero_is() -> None:
    course = Course([1.0, 1.1, 1.2, 1.3], [math.nan, math.nan, 0.0, -0.0], GRID, 1)

    assert [str(course.change(step)) for step in range(5)] == ["None", "None", "0.0", "-0.0", "None"]


def test_text_truth_and_arrays_hold() -> None:
    assert values(Course([1.0, 1.1], ["a", "b"], GRID, 1), 2) == ["a", "b"]
    assert values(Course([1.0, 1.1], [True, False], GRID, 1), 2) == [True, False]
    line = Course([1.0, 1.4], [[0.0, 4.0], [4.0, 0.0]], GRID, 1, linear=True)
    assert line.value(2) == pytest.approx([2.0, 2.0], rel=1e-12)


def test_a_flat_part_of_a_line_needs_no_step_of_python() -> None:
    course = Course([1.0, 2.0, 3.0], [1.0, 1.0, 2.0], GRID, 1, linear=True)

    assert (course.next_change(1), course.next_change(10), course.next_change(11)) == (10, 10, 11)
    assert (course.next_change(20), course.next_change(21)) == (20, ENDLESS)


@pytest.mark.parametrize(
    ("time", "step"), [(-1e308, 0), (0.999, 0), (1.0, 0), (1.0000001, 1), (1e20, ENDLESS), (1e308, ENDLESS)]
)
def test_the_first_step_at_a_time(time: float, step: int) -> None:
    assert GRID.step_at(time) == step


def test_times_within_the_tolerance_are_equal() -> None:
    assert GRID.step_at(1.2 + 1e-9) == 3
    assert GRID.step_at(1.2 + 1e-9, tolerance=1.5e-9) == 2
