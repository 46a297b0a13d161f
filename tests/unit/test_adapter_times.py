"""`FMIAdapter` with times of ROS: exact to the nanosecond, by their shape only, and never mixed with seconds."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from typing import Any

import msgspec
import pytest

from fmu_mesh import FMIAdapter
from fmu_mesh.adapter import Nanoseconds
from fmu_mesh.errors import CallRefused
from tests.helpers import FMUS

UNIX_NS = 1_700_000_000_123_456_789
MS = 1_000_000


class Stamp(msgspec.Struct):
    """As `builtin_interfaces.msg.Time`."""

    sec: int
    nanosec: int


def stamp(nanoseconds: int) -> Stamp:
    return Stamp(*divmod(nanoseconds, 1_000_000_000))


@pytest.fixture
def gain() -> Iterator[FMIAdapter]:
    with FMIAdapter(FMUS / "Gain.fmu", Nanoseconds(2 * MS), interpolate_input=False) as adapter:
        yield adapter


@pytest.mark.parametrize("of", [Nanoseconds, stamp])
def test_a_stamp_of_ros_is_met_to_nanosecond_whatever_its_clock_says(
    gain: FMIAdapter, of: Callable[[int], Any]
) -> None:
    gain.exit_initialization_mode(of(UNIX_NS))
    for k in range(500):
        gain.set_input_value("u", of(UNIX_NS + k * 2 * MS), float(k))

    seen = []
    for k in range(500):
        gain.do_steps_until(of(UNIX_NS + (k + 1) * 2 * MS))
        seen.append((gain.simulation_time_ns, gain.get_output_value("y")))

    assert seen == [(UNIX_NS + (k + 1) * 2 * MS, float(k)) for k in range(500)]


def test_a_stamp_is_late_from_two_nanoseconds_after_the_step_on() -> None:
    def first_step_of(late_ns: int) -> int:
        with FMIAdapter(FMUS / "Gain.fmu", 0.002, interpolate_input=False) as adapter:
            adapter.exit_initialization_mode(Nanoseconds(UNIX_NS))
            adapter.set_input_value("u", Nanoseconds(UNIX_NS + 10 * MS + late_ns), 1.0)
            steps = 0
            while adapter.get_output_value("y") != 1.0:
                adapter.do_step()
                steps += 1
            return steps

    assert [first_step_of(late) for late in (-1, 0, 1, 2)] == [6, 6, 6, 7]


def test_inputs_before_the_start_are_on_the_clock_that_the_start_decides(gain: FMIAdapter) -> None:
    gain.set_input_value("u", Nanoseconds(UNIX_NS - 5), 3.0)
    gain.set_input_value("u", Nanoseconds(UNIX_NS + 2 * MS), 4.0)

    gain.exit_initialization_mode(stamp(UNIX_NS))

    assert gain.get_value("u") == 3.0
    assert gain.do_step() == (UNIX_NS + 2 * MS) / 1e9


@pytest.mark.parametrize(
    ("start", "time", "words"),
    [
        (Nanoseconds(5), 1.0, "1.0 is a time in s, and this adapter's clock is in ns"),
        (0.0, Nanoseconds(5), "in ns, and"),
    ],
)
def test_seconds_and_times_of_ros_are_not_mixed(
    gain: FMIAdapter, start: float | Nanoseconds, time: float | Nanoseconds, words: str
) -> None:
    gain.exit_initialization_mode(start)

    for call in (lambda: gain.set_input_value("u", time, 1.0), lambda: gain.do_steps_until(time)):
        with pytest.raises(CallRefused, match=re.escape(words)):
            call()

    assert gain.do_step() == (0.002000005 if start else 0.002)


def test_an_input_of_the_other_kind_is_refused_at_the_start(gain: FMIAdapter) -> None:
    gain.set_input_value("u", 0.0, 1.0)

    with pytest.raises(CallRefused, match="is a time in s"):
        gain.exit_initialization_mode(Nanoseconds(UNIX_NS))
    gain.exit_initialization_mode(0.0)

    assert gain.get_value("u") == 1.0
