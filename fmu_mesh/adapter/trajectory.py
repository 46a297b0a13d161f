"""What an input is when: the caller's clock against the FMU's, and the values of one input over the FMU's time."""

from __future__ import annotations

import math
from bisect import bisect_left, bisect_right

from ..model.description import Value

__all__ = ["Clock", "Trajectory"]


class Clock:
    """The caller's clock against the FMU's, which starts at 0.0.

    The only place that knows how the caller tells the time. A clock of integer nanoseconds has the same three methods.

    Args:
        start: the caller's time of the FMU's 0.0, in s.
    """

    def __init__(self, start: float) -> None:
        self._start = start

    def to_fmu(self, time: float) -> float:
        """A time of the caller on the FMU's clock, in s: one subtraction, exact while ``time`` is near the start."""
        return time - self._start

    def from_fmu(self, time: float) -> float:
        """A time of the FMU on the caller's clock, in s: one addition."""
        return self._start + time

    def resolution(self, time: float) -> float:
        """How far apart two of the caller's times near the FMU's ``time`` can be (s) and still mean the same.

        A float of today's Unix time is good to 0.24 us, and `start + 3 * 0.1` is not `start + 0.3`: a few units in the
        last place are left to the rounding of one multiplication and one addition, as in `simtime.steps_between`.
        """
        return 8 * math.ulp(max(abs(self._start), abs(self._start + time)))


class Trajectory:
    """Values of one input over the FMU's time. Read it at rising times: what is past then is forgotten.

    Args:
        linear: linear between two times, or else constant.
    """

    def __init__(self, *, linear: bool) -> None:
        self._linear = linear
        self._times: list[float] = []
        self._values: list[Value] = []

    def __len__(self) -> int:
        return len(self._times)

    def add(self, time: float, value: Value) -> None:
        """From ``time`` on the input has this value; it replaces an earlier one for the same time."""
        place = bisect_left(self._times, time)
        if place < len(self._times) and self._times[place] == time:
            self._values[place] = value
        else:
            self._times.insert(place, time)
            self._values.insert(place, value)

    def value(self, time: float, resolution: float) -> Value:
        """The value at ``time``, which must not be before the first one's.

        Times that differ by no more than ``resolution`` are the same: the value of such a time is taken as it is.
        """
        place = bisect_right(self._times, time + resolution) - 1
        if place > len(self._times) // 2:  # not at every step, because that would move a long future each time
            del self._times[:place], self._values[:place]
            place = 0
        start, value = self._times[place], self._values[place]
        if not self._linear or place + 1 == len(self._times) or start >= time - resolution:
            return value
        end, right = self._times[place + 1], self._values[place + 1]
        return _between(value, right, (time - start) / (end - start))


def _between(left: Value, right: Value, weight: float) -> Value:
    """The value between two, of an array element by element.

    With a weight below 1 this never leaves the range of the two values, which may be the limits of the FMU.
    """
    if isinstance(left, list) and isinstance(right, list):
        return [_between(one, other, weight) for one, other in zip(left, right, strict=True)]
    assert isinstance(left, float)
    assert isinstance(right, float)
    return left + (right - left) * weight
