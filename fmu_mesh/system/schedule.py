"""The values that a scenario prescribes for one variable: which one each own step of its instance uses.

A `Schedule` is the part of a plan; a `Course` answers for a step. Owns the evaluation, which every engine shares. How a
value gets into an instance is not its business.
"""

from __future__ import annotations

import math
from bisect import bisect_left, bisect_right
from collections.abc import Sequence
from collections.abc import Set as AbstractSet

import msgspec
import numpy as np
from numpy.typing import NDArray

from ..simtime import ENDLESS, TimeGrid
from ..variables.model_description import ModelDescription, Value
from ..variables.value_conversion import is_finite
from ..variables.value_types import PlainValue
from .layout import Layout

__all__ = ["Course", "Schedule", "SeriesFile", "between", "row_of"]


class SeriesFile(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The columns of a table that values come from.

    Attributes:
        path: absolute path of the file.
        sha256: of its content when the run was planned.
        time: the column with the times in s.
        column: the column with the values.
        factor: the value is factor * number + offset, for a conversion of units; ``offset`` likewise.
    """

    path: str
    sha256: str
    time: str
    column: str
    factor: float = 1.0
    offset: float = 0.0


class Schedule(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The values of one variable over time.

    Attributes:
        variable: its name.
        times: in s, in ascending order.
        values: the value from each time on.
        linear: whether it changes linearly between two times.
        initial: whether a value for the start or earlier is a start value, and not set in the first step.
        tolerance: times that differ by this much (s) are equal; rounding is allowed for in any case.
        file: a table with more times and values, which come before ``times`` where both are equal.
        every: whether a value that equals the one before counts, too: its input has a timeout.
    """

    variable: str
    times: tuple[float, ...]
    values: tuple[PlainValue, ...]
    linear: bool = False
    initial: bool = True
    tolerance: float = 0.0
    file: SeriesFile | None = None
    every: bool = False

    def agreed(self) -> Schedule:
        """The schedule without what may differ between hosts: where the file is."""
        if self.file is None:
            return self
        return msgspec.structs.replace(self, file=msgspec.structs.replace(self.file, path=""))


class Course:
    """What each own step of an instance uses for one variable: the prescribed value at the start of the step.

    A value is set in the steps in which it changes. So a value that somebody else sets holds until then.

    Example:
        >>> course = Course([0.0, 0.25, 2.0], [1.0, 5.0, 7.0], TimeGrid(0.0, 0.1, 100), 1)
        >>> course.value(0), course.value(2), course.value(3), course.change(3), course.change(4)
        (1.0, 1.0, 5.0, 5.0, None)
        >>> course.next_change(4)
        20

    Args:
        times: in s, in ascending order; at least one.
        values: the value from each time on. Of equal times the last one counts; a line from before ends at the first.
        grid: the communication points.
        points: points per own step.
        linear: whether numbers change linearly between two times.
        initial: whether the value for step 0 is set before the run, as a start value.
        tolerance: see `Schedule`.
        every: see `Schedule`.
    """

    def __init__(  # noqa: PLR0913  what a schedule has, and the steps
        self,
        times: Sequence[float],
        values: Sequence[Value],
        grid: TimeGrid,
        points: int,
        *,
        linear: bool = False,
        initial: bool = True,
        tolerance: float = 0.0,
        every: bool = False,
    ) -> None:
        self._every = every
        self._grid = grid
        self._points = points
        self._linear = linear
        self._initial = initial
        self._times: list[float] = []
        self._values: list[Value] = []
        self._steps: list[int] = []
        """The first own step that begins at each time or later."""
        self._arrays: tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float64]] | None = None
        for time, value in zip(times, values, strict=True):
            step = grid.step_at(time, points, tolerance)
            if not linear and self._steps and step == self._steps[-1]:
                self._times.pop(), self._values.pop(), self._steps.pop()
            if linear or every or not self._values or not _same(self._values[-1], value):
                self._times.append(time)
                self._values.append(value)
                self._steps.append(step)

    @property
    def not_finite_at(self) -> float | None:
        """The first time in s at which the value is not finite."""
        pairs = zip(self._times, self._values, strict=True)
        return next((time for time, value in pairs if not is_finite(value)), None)

    def value(self, step: int) -> Value | None:
        """The prescribed value for an own step; None before the first one."""
        place = bisect_right(self._steps, step) - 1
        if place < 0:
            return None
        value = self._values[place]
        if not self._linear or place + 1 == len(self._values) or _same(value, self._values[place + 1]):
            return value
        time = self._grid.time(step * self._points)
        start, end = self._times[place], self._times[place + 1]
        # Its step begins at this time, or differs from it by rounding only.
        if start >= time - self._grid.rounding(time):
            return value
        return between(value, self._values[place + 1], min((time - start) / (end - start), 1.0))

    def values(self, first: int, count: int) -> NDArray[np.float64]:
        """The prescribed values for ``count`` own steps from ``first`` on, bit for bit those of `value`; of a Float64.

        ``first`` is not before `first_step`.
        """
        if self._arrays is None:
            self._arrays = np.array(self._steps), np.array(self._times), np.array(self._values, np.float64)
        own_steps, own_times, own_values = self._arrays
        steps = np.arange(first, first + count)
        place = np.searchsorted(own_steps, steps, side="right") - 1
        values: NDArray[np.float64] = own_values[place]
        if not self._linear:
            return values
        following = np.minimum(place + 1, len(own_values) - 1)
        right, start, end = own_values[following], own_times[place], own_times[following]
        times = self._grid.start_time + (steps * self._points).astype(np.float64) * self._grid.step_size
        rounding = 8 * np.spacing(np.maximum(abs(self._grid.start_time), np.abs(times)))
        equal = (values.view(np.int64) == right.view(np.int64)) | (np.isnan(values) & np.isnan(right))
        with np.errstate(all="ignore"):  # where two times are equal, the line is not used
            line = values + (right - values) * np.minimum((times - start) / (end - start), 1.0)
        return np.where(equal | (following == place) | (start >= times - rounding), values, line)

    def change(self, step: int) -> Value | None:
        """The value to set before an own step; None if the prescribed value is that of the step before it."""
        value = self.value(step)
        if value is None or (step == 0 and self._initial):
            return None
        if self._every and not self._linear and self.last(step) == step:
            return value
        before = self.value(step - 1) if step else None
        return None if before is not None and _same(before, value) else value

    def last(self, step: int) -> int:
        """The last own step up to ``step`` with a value of its own, or in a line; 0 where there is none."""
        place = bisect_right(self._steps, step) - 1
        is_line = self._linear and 0 <= place < len(self._steps) - 1
        return step if is_line else self._steps[place] if place >= 0 else 0

    def next_change(self, step: int) -> int:
        """The first own step from ``step`` on that may have a `change`; `ENDLESS` if there is none."""
        if step == 0 and self._initial:
            step = 1
        steps = self._steps
        place = bisect_left(steps, step)
        if self._linear and 0 < place < len(steps) and not _same(self._values[place - 1], self._values[place]):
            return step
        return steps[place] if place < len(steps) else ENDLESS

    @property
    def first_step(self) -> int:
        """The first own step with a prescribed value."""
        return self._steps[0]

    @property
    def last_step(self) -> int:
        """The own step from which on the value does not change any more."""
        return self._steps[-1]

    @property
    def end(self) -> Value:
        """The last value."""
        return self._values[-1]

    @property
    def changes(self) -> int:
        """Number of times at which the value, or its slope, changes."""
        return len(self._steps)


def row_of(description: ModelDescription, names: AbstractSet[str], connected: AbstractSet[str]) -> Layout | None:
    """The inputs that are set in every step: connected ones, and those with ``names`` that are a single Float64.

    None if these are the connected ones.
    """
    inputs = (v for v in description.with_causality("input") if v.type == "Float64" and not v.shape)
    driven = {v.name for v in inputs if v.name in names}
    return Layout.of(v for v in description.variables if v.name in connected | driven) if driven else None


def between(left: Value, right: Value, weight: float) -> Value:
    """The value between two values; of an array, element by element.

    With a weight below 1, the result stays between the two values, which may be the limits of the variable.
    """
    if isinstance(left, list) and isinstance(right, list):
        return [between(one, other, weight) for one, other in zip(left, right, strict=True)]
    assert isinstance(left, float)
    assert isinstance(right, float)
    return left + (right - left) * weight


def _same(left: Value, right: Value) -> bool:
    """Whether two values are equal bit for bit, but for the payload of a NaN."""
    if isinstance(left, list) and isinstance(right, list):
        return len(left) == len(right) and all(_same(one, other) for one, other in zip(left, right, strict=True))
    if isinstance(left, float) and isinstance(right, float):
        if left == right:
            return left != 0.0 or math.copysign(1.0, left) == math.copysign(1.0, right)
        return math.isnan(left) and math.isnan(right)
    return left == right
