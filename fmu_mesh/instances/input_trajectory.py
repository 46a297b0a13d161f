"""The value of an input over time: values with times, in between constant or linear."""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from ..system.schedule import between
from ..variables.model_description import Value

__all__ = ["SavedTrajectory", "Trajectory"]


class SavedTrajectory(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A `Trajectory`: its values and their times, and that from which no line leads to the next one, in s."""

    linear: bool
    held: float | None
    times: tuple[float, ...]
    values: tuple[Any, ...]


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
        saved: values that another one had.
    """

    def __init__(self, *, linear: bool, saved: SavedTrajectory | None = None) -> None:
        self.linear = linear
        self._held = saved.held if saved is not None else None
        self._times: list[float] = [*saved.times] if saved is not None else []
        self._values: list[Value] = [*saved.values] if saved is not None else []

    def __len__(self) -> int:
        return len(self._times)

    def save(self) -> SavedTrajectory:
        """What it has now."""
        return SavedTrajectory(self.linear, self._held, tuple(self._times), tuple(self._values))

    def add(self, time: float, value: Value, *, holds: bool = False) -> None:
        """The input has this value from ``time`` (s) on; it replaces the value for the same time.

        If it ``holds``, there is no line to the next one.
        """
        if holds or time == self._held:
            self._held = time if holds else None
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
        if not self.linear or place + 1 == len(self._times) or start >= time - resolution or start == self._held:
            return value
        end, right = self._times[place + 1], self._values[place + 1]
        return between(value, right, (time - start) / (end - start))

    def values(self, times: NDArray[np.float64], resolutions: NDArray[np.float64]) -> NDArray[np.float64]:
        """The values at rising times, bit for bit those of `value`; of a Float64."""
        first = bisect_right(self._times, times[0] + resolutions[0]) - 1
        end = bisect_right(self._times, times[-1] + resolutions[-1]) + 1
        own_times, own_values = np.array(self._times[first:end]), np.array(self._values[first:end], np.float64)
        place = np.searchsorted(own_times, times + resolutions, side="right") - 1
        start, values = own_times[place], own_values[place]
        if not self.linear:
            return values
        following = np.minimum(place + 1, len(own_times) - 1)
        with np.errstate(all="ignore"):  # where two times are equal, the line is not used
            line = values + (own_values[following] - values) * ((times - start) / (own_times[following] - start))
        holds = (
            (following == place)
            | (start >= times - resolutions)
            | (start == (np.nan if self._held is None else self._held))
        )
        return np.where(holds, values, line)

    @property
    def last(self) -> float:
        """The last time in s."""
        return self._times[-1]

    def after(self, time: float) -> float | None:
        """The first time (s) after ``time``; None if no value has a later one."""
        place = bisect_right(self._times, time)
        return self._times[place] if place < len(self._times) else None
