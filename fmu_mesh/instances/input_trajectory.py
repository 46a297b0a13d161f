"""The value of an input over time: values with times, in between constant or linear."""

from __future__ import annotations

from bisect import bisect_left, bisect_right

from ..variables.model_description import Value

__all__ = ["Trajectory"]


class Trajectory:
    """Values of one input over the FMU's time. Read it at rising times: it forgets values that are past.

    Example:
        >>> trajectory = Trajectory(linear=True)
        >>> trajectory.add(0.0, 1.0)
        >>> trajectory.add(2.0, 3.0)
        >>> trajectory.value(1.0, resolution=1e-9)
        2.0

    Args:
        linear: whether the input is linear between two times, or constant from each time on.
    """

    def __init__(self, *, linear: bool) -> None:
        self._linear = linear
        self._times: list[float] = []
        self._values: list[Value] = []

    def __len__(self) -> int:
        return len(self._times)

    def add(self, time: float, value: Value) -> None:
        """The input has this value from ``time`` (s) on; it replaces the value for the same time."""
        place = bisect_left(self._times, time)
        if place < len(self._times) and self._times[place] == time:
            self._values[place] = value
        else:
            self._times.insert(place, time)
            self._values.insert(place, value)

    def value(self, time: float, resolution: float) -> Value:
        """The value at ``time``, which is not before the first time; both in s.

        Times that differ by ``resolution`` or less are equal: the value is then that of this time, not interpolated.
        """
        place = bisect_right(self._times, time + resolution) - 1
        if place > len(self._times) // 2:  # not at every step: it moves all future values
            del self._times[:place], self._values[:place]
            place = 0
        start, value = self._times[place], self._values[place]
        if not self._linear or place + 1 == len(self._times) or start >= time - resolution:
            return value
        end, right = self._times[place + 1], self._values[place + 1]
        return _between(value, right, (time - start) / (end - start))


def _between(left: Value, right: Value, weight: float) -> Value:
    """The value between two values; of an array, element by element.

    With a weight below 1, the result stays between the two values, which may be the limits of the variable.
    """
    if isinstance(left, list) and isinstance(right, list):
        return [_between(one, other, weight) for one, other in zip(left, right, strict=True)]
    assert isinstance(left, float)
    assert isinstance(right, float)
    return left + (right - left) * weight
