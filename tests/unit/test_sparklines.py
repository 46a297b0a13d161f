"""The lines that `top --watch` shows below its table."""

from __future__ import annotations

import math

import numpy as np
import pytest

from fmu_mesh.api.samples import Sample
from fmu_mesh.cli.output.sparklines import BLOCKS, KEPT, PLAIN, Histories, sparkline, sparkline_signs


def histories(name: str, *values: object, unit: str | None = None) -> Histories:
    found = Histories()
    for point, value in enumerate(values):
        found.add([Sample(name, value, point, 0.1 * point, unit)])
    return found


def test_the_least_value_has_the_lowest_block_and_the_greatest_one_highest() -> None:
    assert sparkline([0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0]) == BLOCKS
    assert sparkline([-1e308, 1e308]) == "▁█"
    assert sparkline([5.0, 0.0], PLAIN) == "#_"


def test_equal_values_are_in_middle_and_what_is_not_finite_is_blank() -> None:
    assert sparkline([2.0, 2.0]) == "▄▄"
    assert sparkline([0.0, math.nan, math.inf, 1.0]) == "▁  █"
    assert sparkline([math.nan, math.nan]) == "  "
    assert sparkline([0.0, 5e-324]) == "▄▄"
    assert sparkline([]) == ""


def test_a_line_has_name_course_range_value_and_unit() -> None:
    assert histories("pendulum.a", -1.5, 0.0, 1.5, unit="rad").lines() == [
        f"pendulum.a  ▁▅█{' ' * 37}  -1.5..1.5  1.5 rad"
    ]


@pytest.mark.parametrize(
    ("value", "shown"),
    [(True, "true"), (7, "7"), ("text", "text"), (b"\x01", "b'\\x01'"), (np.array([1.0, 2.5]), "[1. 2.5]")],
)
def test_every_type_has_a_value(value: object, shown: str) -> None:
    assert histories("x.y", value).lines()[0].endswith(shown)


@pytest.mark.parametrize("width", [80, 100, 200])
def test_no_line_is_wider_than_the_terminal_and_each_has_a_sparkline(width: int) -> None:
    found = histories("the_wheel_of_the_front_axle_left.a_long_name_of_a_variable", *range(3), unit="rad/s")
    found.add([Sample("gain.text", "a text that is much longer than a line of a terminal " * 3, 3, 0.3, None)])
    for value in range(2 * KEPT):
        found.add([Sample("gain.y", -1.23456789e-100 * value, value, 0.0, "N.m")])

    lines = found.lines(width)

    assert len(lines) == 3
    assert max(map(len, lines)) <= width
    assert lines[2].count("▄") > 0
    assert lines[2].endswith("N.m")


def test_no_more_values_are_kept_than_a_line_shows() -> None:
    found = histories("gain.y", 1e9, *[0.0] * KEPT)

    assert "0..0" in found.lines(10_000)[0]


def test_blocks_are_drawn_where_they_can_be_written() -> None:
    assert [sparkline_signs(name) for name in ("utf-8", "ascii", "iso-8859-1", None, "no-encoding")] == [
        BLOCKS,
        *[PLAIN] * 4,
    ]


def test_a_look_without_an_answer_is_blank_and_not_a_shorter_line() -> None:
    found = histories("gain.y", 0.0, 1.0)

    found.add([])
    found.add([Sample("gain.y", 1.0, 3, 0.3, None)])

    assert found.lines()[0].startswith("gain.y  ▁█ █  ")
