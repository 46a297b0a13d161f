"""Times of the caller: seconds, or the nanoseconds of a ROS clock.

Owns the conversion to the clock of the FMU, which is in seconds and starts at 0.0. Recognizes ROS times by their
attributes and imports nothing of ROS.
"""

from __future__ import annotations

import math
from typing import Protocol, runtime_checkable

import msgspec

__all__ = [
    "CallerClock",
    "Instant",
    "Nanoseconds",
    "NanosecondsClock",
    "RosStamp",
    "RosTime",
    "SecondsClock",
    "Time",
    "instant_of",
]

_NANO = 1_000_000_000


class Nanoseconds(msgspec.Struct, frozen=True):
    """A time or a duration in whole nanoseconds, for programs without `rclpy.time.Time`."""

    nanoseconds: int


@runtime_checkable
class RosTime(Protocol):
    """The common part of `rclpy.time.Time`, `rclpy.duration.Duration` and `Nanoseconds`."""

    @property
    def nanoseconds(self) -> int:
        """The time in ns."""
        ...


@runtime_checkable
class RosStamp(Protocol):
    """The stamp in the header of a message (`builtin_interfaces/Time`)."""

    sec: int
    nanosec: int


Time = float | RosTime | RosStamp
"""Seconds, or a time of ROS."""

Instant = float | Nanoseconds
"""A `Time` in one of two exact forms."""


def instant_of(time: RosTime | RosStamp) -> Nanoseconds:
    """A time of ROS in its exact form."""
    if isinstance(time, RosStamp):
        return Nanoseconds(int(time.sec) * _NANO + int(time.nanosec))
    return Nanoseconds(int(time.nanoseconds))


class SecondsClock:
    """The clock of a caller in seconds, which has ``start`` when the time of the FMU is 0.0.

    `to_fmu` and `from_fmu` convert between both clocks, in s; a time of the other kind of clock is None. Two times near
    the FMU's ``time`` count as equal if they differ by its `resolution`, in s, at most.
    """

    def __init__(self, start: float) -> None:
        self._start = start

    def to_fmu(self, time: Instant) -> float | None:
        """One subtraction, exact while ``time`` is near the start."""
        return None if isinstance(time, Nanoseconds) else time - self._start

    def from_fmu(self, time: float) -> float:
        """One addition."""
        return self._start + time

    def nanoseconds_from_fmu(self, time: float) -> int:
        """Rounded to the nearest nanosecond."""
        return round(self.from_fmu(time) * _NANO)

    def resolution(self, time: float) -> float:
        """8 units in the last place.

        Unix time in a float has a resolution of 0.24 us, and `start + 3 * 0.1` is not `start + 0.3`. This limit allows
        for the rounding of one multiplication and one addition, as in `simtime.steps_between`.
        """
        return 8 * math.ulp(max(abs(self._start), abs(self._start + time)))


class NanosecondsClock:
    """As `SecondsClock`, in whole nanoseconds, as in ROS: exact for any start."""

    def __init__(self, start: int) -> None:
        self._start = start

    def to_fmu(self, time: Instant) -> float | None:
        """An exact subtraction and one division."""
        return (time.nanoseconds - self._start) / _NANO if isinstance(time, Nanoseconds) else None

    def from_fmu(self, time: float) -> float:
        """The nearest float to the time in ns."""
        return self.nanoseconds_from_fmu(time) / _NANO

    def nanoseconds_from_fmu(self, time: float) -> int:
        """Rounded to the nearest nanosecond."""
        return self._start + round(time * _NANO)

    def resolution(self, time: float) -> float:
        """1 ns: a stamp is the time of a step, truncated or rounded to whole nanoseconds."""
        return 1.0 / _NANO + 8 * math.ulp(time)


CallerClock = SecondsClock | NanosecondsClock
