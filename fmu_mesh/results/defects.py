"""Compares what inputs were assumed to be over a step with what came: the defect of each connection (`--defects`).

A target has its next value from a source at the end of one of its own steps. Until then it assumes the last value
(hold), or the line through the last two (`fmu_mesh.system.coupling_rule`). All of that follows from rows, so it is
calculated from the blocks of rows that are written, and costs a step nothing. Knows no file.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..simtime import TimeGrid
from ..system.coupling_rule import Consistent, jumps_in
from ..system.defect import Defect
from ..system.feeds import Compared
from ..system.plan import Plan
from .growth import ReadColumn

__all__ = ["DefectWatch"]

_CHUNK: Final = 8192
"""Differences that are added up at once. Sums of floats depend on what is added first, so chunks begin at multiples of
it, whatever the blocks are in which rows are written."""

_BEFORE: Final = 2
"""Values before a chunk that tell the line at its first one, and whether that one has jumped."""


class DefectWatch:
    """Compares what the targets of a plan assume with what comes; nothing if the plan does not want it.

    Call sequence: `begin`, then `look` for consecutive points; `begin_again` before those of another run of the plan.
    """

    def __init__(self, plan: Plan) -> None:
        self._plan = plan
        self._watched: dict[Compared, _Watched] = {}  # without names: all readers of an output may assume the same

    def begin(self, read_of: Callable[[Consistent], ReadColumn]) -> None:
        """Choose what is read; ``read_of`` says how the values of an input are read that follow from rows."""
        self._watched = {}
        for one in self._plan.system.compared:
            if (same := one._replace(name="")) not in self._watched:
                self._watched[same] = _Watched(one, read_of(one.value))

    def begin_again(self) -> None:
        """Another run begins, whose values are read in the same way."""
        for own in self._watched.values():
            own.begin_again()

    def look(self, first: int, end: int) -> None:
        """Look at the points first to end - 1."""
        for own in self._watched.values():
            own.take(first, end)

    @property
    def defects(self) -> dict[str, Defect]:
        """The defects so far by connection, as `a.y -> b.u`, in the order of the plan; without those of no step."""
        found = {same: own.defect(self._plan.grid) for same, own in self._watched.items()}
        named = ((one.name, found.get(one._replace(name=""))) for one in self._plan.system.compared)
        return {name: own for name, own in named if own is not None}


class _Sums(NamedTuple):
    """What is known of some differences.

    Attributes:
        place: number of the value that differs most from what was assumed.
        least: the least value; ``most``: the largest one.
    """

    steps: int = 0
    maximum: float = 0.0
    place: int = 0
    squares: float = 0.0
    least: float = math.inf
    most: float = -math.inf

    def with_later(self, later: _Sums) -> _Sums:
        """Both together."""
        first = later if later.maximum > self.maximum else self
        squares, ends = self.squares + later.squares, (min(self.least, later.least), max(self.most, later.most))
        return _Sums(self.steps + later.steps, first.maximum, first.place, squares, *ends)


class _Watched:
    """One connection. Value n of its source is the n-th that the target gets and did not have before."""

    def __init__(self, compared: Compared, read: ReadColumn) -> None:
        self._way, self._read = compared.way, read
        self._own, self._target = own, target = compared.rule.source_points, compared.rule.target_points
        # With a delay of 0, the last value is the one at the end of the step, and the line goes through both ends.
        self._knows_end = not compared.rule.delay and target >= own
        # Points from value to value; 0: they differ, because neither step size is a multiple of the other.
        self._stride = target if target >= own else 0 if own % target else own
        self._values = np.zeros(_BEFORE + _CHUNK + 1)
        self.begin_again()

    def begin_again(self) -> None:
        """Forget all values."""
        self._sums = _Sums()
        self._first, self._begin, self._end = -1, 0, 0  # the first value, that at place 0 of `_values`, and the next

    def defect(self, grid: TimeGrid) -> Defect | None:
        """The defect so far; None before the first step."""
        sums = self._sums.with_later(self._newest)
        if not sums.steps:
            return None
        rms = min(math.sqrt(sums.squares / sums.steps), sums.maximum)  # squares can be infinite
        width, point = sums.most - sums.least, int(self._points(np.array([sums.place]))[0])
        relative = sums.maximum / width if 0.0 < width < math.inf else 0.0
        return Defect(sums.maximum, point, grid.time(point), rms, relative, sums.steps)

    def _points(self, numbers: NDArray[np.intp]) -> NDArray[np.intp]:
        """The points at which the target gets its values."""
        own, target = self._own, self._target
        return numbers * self._stride if self._stride else -(-numbers * own // target) * target

    def _before(self, point: int) -> int:
        """How many values the target gets before a point."""
        if self._stride:
            return -(-point // self._stride)
        return max(0, (-(-point // self._target) - 1) * self._target // self._own + 1)

    def take(self, first: int, end: int) -> None:
        """Take the values of the points first to end - 1; those that are there already are left out."""
        low, high = max(self._before(first), self._end), self._before(end)
        if low >= high:
            return
        if self._first < 0:
            self._first = self._end = low
            self._begin = low - low % _CHUNK - _BEFORE
        if self._stride:
            new = self._read(first, end)[low * self._stride - first :: self._stride]
        else:
            new = self._read(first, end)[self._points(np.arange(low, high)) - first]
        while len(new):
            place = self._end - self._begin
            part = new[: len(self._values) - place]
            self._values[place : place + len(part)] = part
            new, self._end = new[len(part) :], self._end + len(part)
            if place + len(part) == len(self._values):
                self._sums = self._sums.with_later(self._newest)
                self._values[: _BEFORE + 1] = self._values[_CHUNK:]
                self._begin += _CHUNK

    @property
    def _newest(self) -> _Sums:
        """What is known of the chunk that is not complete yet."""
        known = max(self._first, self._begin, 0)
        # A run that does not begin at point 0 does not know its lines before there are enough values.
        unknown = _BEFORE if self._first > 0 and self._way != "hold" else 0
        low = max(self._begin + _BEFORE, self._first + unknown)
        if self._end - low < 2:
            return _Sums()
        values, came = self._values[known - self._begin : self._end - self._begin], self._end - low
        with np.errstate(over="ignore", invalid="ignore"):  # values need not be finite
            sizes = self._differences(values, known)[1 - came :]
            place = int(np.abs(sizes, out=sizes).argmax())
            squares, ends = float(np.add.reduce(sizes * sizes)), values[-came:]
            if not math.isfinite(squares):
                sizes[~np.isfinite(sizes)] = 0.0
                place, ends = int(sizes.argmax()), ends[np.isfinite(ends)]
                squares = float(np.add.reduce(sizes * sizes))
        least, most = (float(ends.min()), float(ends.max())) if len(ends) else (math.inf, -math.inf)
        return _Sums(came - 1, float(sizes[place]), low + 1 + place, squares, least, most)

    def _differences(self, values: NDArray[np.float64], known: int) -> NDArray[np.float64]:
        """What came minus what was assumed, of each value but the first one, which has the number ``known``."""
        before, came = values[:-1], values[1:]
        if self._knows_end and self._way == "linear":
            return came - came
        change = came - before
        if self._way == "hold":
            return change
        if self._stride and not self._stride % self._own:  # as below, and faster
            line, distance = change[:-1], np.broadcast_to(float(self._stride), change.shape)
        else:
            points = self._points(np.arange(known, known + len(values))) // self._own * self._own
            distance = np.diff(points).astype(float)
            line = change[:-1] * (distance[1:] / distance[:-1])
        assumed = came
        if not self._knows_end:
            assumed = before.copy()
            assumed[1:] += line
        found = came - assumed
        if self._way == "midpoint":
            jumps = jumps_in(values, change, distance)
            held = jumps - 1 if self._knows_end else jumps[jumps < len(change)]
            found[held] = change[held]
        return found
