"""Simulation time: a communication point is an integer, its time is one multiplication.

This module owns the arithmetic between points and seconds, so that no other module ever adds step sizes up.
"""

from __future__ import annotations

import math

import msgspec
import numpy as np
from numpy.typing import NDArray

__all__ = ["ENDLESS", "StepSizes", "TimeGrid", "step_within", "steps_between"]

ENDLESS = 2**53
"""The last point of a run without an end; above it, the product of a point and the step size is no longer exact."""


class StepSizes(msgspec.Struct, frozen=True):
    """The communication step sizes of one instance, in s: one for all its steps, and one for its last step.

    Attributes:
        regular: of every step but the last.
        last_step: the own step that ends at the last point, or before it.
        last_time: the time at which that step begins, in s.
        last: its size, which ends no later than the stop time; see `step_within`.
    """

    regular: float
    last_step: int
    last_time: float
    last: float

    def of(self, step: int) -> float:
        """The size of the own step ``step``."""
        return self.regular if step != self.last_step else self.last


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
        """The time of the last point in s, which is what FMUs are told; None for a run without an end."""
        return self.time(self.last_point) if self.last_point < ENDLESS else None

    def step_sizes(self, points: int) -> StepSizes:
        """The step sizes of an instance whose own steps take ``points`` points each."""
        regular, last_step = points * self.step_size, self.last_point // points - 1
        last_time = self.time(last_step * points)
        stop_time = math.inf if self.stop_time is None else self.stop_time
        return StepSizes(regular, last_step, last_time, step_within(last_time, regular, stop_time))


def step_within(time: float, step_size: float, stop_time: float) -> float:
    """``step_size``, or a little less where rounding would bring a step from ``time`` past ``stop_time`` (all in s).

    An FMU adds the two numbers that it is given, and 1999 * 0.01 + 0.01 is 20.000000000000004. The sum of ``time`` and
    the returned size is never greater than ``stop_time``. Only rounding is corrected: without it, the step must end at
    ``stop_time`` or before.
    """
    if time + step_size <= stop_time:
        return step_size
    rest = stop_time - time
    # The difference itself is rounded, too, where the step begins before 0 and ends after it.
    return rest if time + rest <= stop_time else math.nextafter(rest, 0.0)


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
