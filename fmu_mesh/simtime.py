"""Simulation time: a communication point is an integer, its time is one multiplication.

This module owns the arithmetic between points and seconds, so that no other module ever adds step sizes up.
"""

from __future__ import annotations

import math

import msgspec
import numpy as np
from numpy.typing import NDArray

__all__ = ["ENDLESS", "TimeGrid", "step_within", "steps_between"]

ENDLESS = 2**53
"""The last point of a run without an end; above it, the product of a point and the step size is no longer exact."""


class TimeGrid(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The communication points `0 .. last_point` of a run: `t = start_time + point * step_size`.

    Attributes:
        start_time: time of point 0 in s.
        step_size: base communication step size in s, greater than 0.
        last_point: index of the last communication point; `ENDLESS` for a run that goes on until it is stopped.
    """

    start_time: float
    step_size: float
    last_point: int

    def time(self, point: int) -> float:
        """The time of ``point`` in s."""
        return self.start_time + point * self.step_size

    def times(self, first: int, end: int) -> NDArray[np.float64]:
        """The times of the points ``first .. end - 1`` in s, each as `time` computes it."""
        times: NDArray[np.float64] = self.start_time + np.arange(first, end, dtype=np.float64) * self.step_size
        return times

    @property
    def stop_time(self) -> float | None:
        """The time of the last point in s; None for a run without an end."""
        return self.time(self.last_point) if self.last_point < ENDLESS else None

    def told_stop_time(self, points: int) -> float | None:
        """The stop time in s that an FMU is told whose own steps take ``points`` points; None for a run without an end.

        An FMU adds up what it is given, the start of a step and its size: 1999 * 0.01 + 0.01 is 20.000000000000004. So
        it is told the end of its last step where that is later than `stop_time`, which it is by rounding only.
        """
        if self.stop_time is None:
            return None
        last_start = self.time((self.last_point // points - 1) * points)
        return max(self.stop_time, last_start + points * self.step_size)


def step_within(time: float, step_size: float, end: float) -> float:
    """``step_size``, or a little less where rounding would bring a step from ``time`` past ``end`` (all in s).

    For the parts of a step: the sum of ``time`` and the returned size is never greater than ``end``. Only rounding is
    corrected: without it, the step must end at ``end`` or before.
    """
    if time + step_size <= end:
        return step_size
    rest = end - time
    # The difference itself is rounded, too: 0.04 + (0.11 - 0.04) is greater than 0.11.
    return rest if time + rest <= end else math.nextafter(rest, 0.0)


def steps_between(start: float, stop: float, step_size: float) -> int | None:
    """How many steps of ``step_size`` lie between ``start`` and ``stop`` (s), or None if it is not a whole number.

    Decimal numbers have no exact binary form: 40 s are 20,000.000000000004 steps of 2 ms, and from 1000000.1 s to
    1000000.4 s there are 3.0000000005 steps of 0.1 s. So the quotient may be off a whole number by a few units in its
    last place, and the two times by a few units in theirs; anything more is a different duration.
    """
    duration = stop - start
    if not (math.isfinite(duration) and math.isfinite(step_size)) or step_size <= 0.0 or duration < 0.0:
        return None
    quotient = duration / step_size
    nearest = round(quotient)
    of_times = math.ulp(max(abs(start), abs(stop))) / step_size
    return nearest if abs(quotient - nearest) <= 8 * max(math.ulp(max(quotient, 1.0)), of_times) else None
