"""Simulation time: a communication point is an integer, its time is one multiplication.

This module owns the arithmetic between points and seconds. No other module adds up step sizes.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import msgspec

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

__all__ = ["ENDLESS", "TimeGrid", "resolvable", "step_within", "steps_between"]

ENDLESS = 2**53
"""Last point of a run without a stop time. Beyond it a point has no exact double any more."""

_FAR_S = 1e6
"""A time that is this far ahead of the present in s is no simulation time: who sends it most likely has a Unix time."""


class TimeGrid(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The communication points `first_point .. last_point` of a run: `t = start_time + point * step_size`.

    Example:
        >>> TimeGrid(start_time=0.0, step_size=0.002, last_point=20000).time(812)
        1.624

    Attributes:
        start_time: time of point 0 in s.
        step_size: base communication step size in s, greater than 0.
        last_point: index of the last communication point; `ENDLESS` for a run without a stop time.
        first_point: index of the first one; not 0 where a run begins with a state.
    """

    start_time: float
    step_size: float
    last_point: int
    first_point: int = 0

    def time(self, point: int) -> float:
        """The time of ``point`` in s."""
        return self.start_time + point * self.step_size

    def times(self, first: int, end: int, points: int = 1) -> NDArray[np.float64]:
        """The times of the points ``first .. end - 1``, or of own steps there, in s, bit for bit those of `time`."""
        import numpy as np  # noqa: PLC0415 many commands need no array, and it takes as long as all the rest

        times: NDArray[np.float64] = self.start_time + np.arange(first, end, points, dtype=np.float64) * self.step_size
        return times

    def step_at(self, time: float, points: int = 1, tolerance: float = 0.0) -> int:
        """The first own step that begins at ``time`` (s) or later: 0 for the past, `ENDLESS` beyond all runs.

        Example:
            >>> grid = TimeGrid(start_time=1.0, step_size=0.1, last_point=60)
            >>> grid.step_at(1.3), grid.step_at(1.31), grid.step_at(1.3, points=2)  # 1.0 + 3 * 0.1 is not 1.3
            (3, 4, 2)

        Args:
            time: in s.
            points: points per own step.
            tolerance: times that differ by this much (s) are equal. Those that differ by rounding always are.
        """
        exact = (time - self.start_time) / (points * self.step_size)
        if not exact > 0.0:
            return 0
        if exact >= ENDLESS:
            return ENDLESS
        near = round(exact)
        if abs(self.time(near * points) - time) <= max(tolerance, self.rounding(time)):
            return near
        return math.ceil(exact)

    def snapped(self, time: float, tolerance: float) -> float:
        """The time of the point that differs from ``time`` by ``tolerance`` at most (s), or ``time`` itself.

        Example:
            >>> TimeGrid(start_time=0.0, step_size=0.1, last_point=60).snapped(0.9000000953674316, tolerance=2.4e-7)
            0.9
        """
        near = (time - self.start_time) / self.step_size
        at = self.time(round(near)) if abs(near) < ENDLESS else time
        return at if abs(at - time) <= tolerance else time

    def rounding(self, time: float) -> float:
        """Largest difference in s of two equal times: the rounding of one multiplication and one addition."""
        return 8 * math.ulp(max(abs(self.start_time), abs(time)))

    @property
    def stop_time(self) -> float | None:
        """The time of the last point in s; None for a run without a stop time."""
        return self.time(self.last_point) if self.last_point < ENDLESS else None

    def latest(self, point: int, *, streamed: bool) -> float:
        """The latest time in s of a value sent at ``point``: the end; without one, or ``streamed``, 1e6 s ahead."""
        ahead, stop = self.time(point) + _FAR_S, self.stop_time
        return ahead if stop is None else min(stop, ahead) if streamed else stop

    def told_stop_time(self, points: int) -> float | None:
        """The stop time in s for the setup of an FMU whose steps take ``points`` points; None without a stop time.

        An FMU adds the start of a step and its size, and 1999 * 0.01 + 0.01 is 20.000000000000004. So it gets the end
        of its last step if rounding makes that later than `stop_time`.
        """
        if self.stop_time is None:
            return None
        last_start = self.time((self.last_point // points - 1) * points)
        return max(self.stop_time, last_start + points * self.step_size)


def resolvable(time: float, stop: float) -> bool:
    """Whether ``stop`` is after ``time`` (both in s) by more than rounding.

    Time events and communication points are computed in different ways. So the same instant may have two values that
    differ in the last digits; there is nothing to integrate between them.
    """
    return math.isinf(stop) or stop - time > 8 * math.ulp(max(abs(time), abs(stop)))


def step_within(time: float, step_size: float, end: float) -> float:
    """``step_size``, reduced by rounding errors so that ``time`` plus the result is at most ``end`` (all in s).

    For the parts of a step. Only rounding is corrected: in exact arithmetic the step must end at ``end`` or earlier.
    """
    if time + step_size <= end:
        return step_size
    rest = end - time
    # The difference is rounded, too: 0.04 + (0.11 - 0.04) is greater than 0.11.
    return rest if time + rest <= end else math.nextafter(rest, 0.0)


def steps_between(start: float, stop: float, step_size: float) -> int | None:
    """The number of steps of ``step_size`` between ``start`` and ``stop`` (s), or None if it is not a whole number.

    Decimal numbers have no exact binary form: 40 s are 20,000.000000000004 steps of 2 ms, and from 1000000.1 s to
    1000000.4 s there are 3.0000000005 steps of 0.1 s. So the quotient may differ from a whole number by a few units in
    its last place, and by a few units in the last place of the two times. A larger difference is not rounding.

    Example:
        >>> steps_between(0.0, 40.0, 0.002)
        20000
    """
    duration = stop - start
    if not (math.isfinite(duration) and math.isfinite(step_size)) or step_size <= 0.0 or duration < 0.0:
        return None
    quotient = duration / step_size
    nearest = round(quotient)
    of_times = math.ulp(max(abs(start), abs(stop))) / step_size
    return nearest if abs(quotient - nearest) <= 8 * max(math.ulp(max(quotient, 1.0)), of_times) else None
