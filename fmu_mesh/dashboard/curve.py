"""The history of one variable in bounded memory: the smallest and the largest value of each interval of time.

Knows neither meshes nor pages.
"""

# Threads: the values of a curve come on the thread of the samples of its mesh, and the event loop of the server reads
# what has changed for each page. A lock for each curve is held for one addition or one answer (ADR 0061).

from __future__ import annotations

import itertools
import math
import threading
from typing import Final

import msgspec
import numpy as np
from numpy.typing import NDArray

__all__ = ["BUCKETS", "SPANS", "BoundedCurve", "CurveChange", "Looks"]

BUCKETS: Final = 1024
"""Intervals of a curve from the start on. A plot on a page has about as many columns of pixels."""
SPANS: Final = (1, 10, 60, 600)
"""The last so many seconds of a curve are also kept in finer intervals."""
_RECENT: Final = 512
_LATE: Final = 1.5
"""A value that comes later than so many usual steps after another one is not the next one."""
_SLOW: Final = 10.0
"""A look that comes later than so many usual times after another one is not the next one."""

_first_versions = itertools.count(1 << 32, 1 << 32)
"""A page that has drawn another curve of this name has no version of this one. A script has 53 bits for a number."""

Numbers = NDArray[np.float64]


class CurveChange(
    msgspec.Struct, frozen=True, rename={"t_low": "tl", "t_high": "th", "low": "l", "high": "h", "gaps": "g"}
):
    """What a page needs to draw a curve that it has drawn before.

    Attributes:
        version: what the page names the next time.
        whole: whether this replaces all that the page has.
        at: the intervals that changed, by number.
        t_low: the time of the smallest value of each of them, in s; ``t_high`` is that of the largest.
        low: the smallest values; ``high`` has the largest.
        gaps: those of them after which nothing is known, so no line may lead to the next one.
    """

    version: int
    whole: bool
    at: list[int]
    t_low: list[float]
    low: list[float]
    t_high: list[float]
    high: list[float]
    gaps: list[int]


class BoundedCurve:
    """The values of one variable: from the start on in 1024 intervals, and the newest ones in finer intervals.

    The order in which values come does not matter, so older ones can be added while new ones come. Memory: 150 kB.
    All methods may be called from any thread.

    Args:
        start: the start time in s.
        width: length of an interval in s at first, such as the step size.
    """

    def __init__(self, start: float, width: float) -> None:
        self._lock = threading.Lock()
        self._whole = _FromStart(start, width)
        self._recent = {span: _Recent(start, max(span / _RECENT, width)) for span in SPANS}

    def add(self, times: Numbers, values: Numbers, after: float | None = None) -> None:
        """Add values of one source; those that are not finite are left out.

        A line leads from a value to the next one where none is missing between them: where both are finite, and as near
        to each other as others are. ``after`` is the time of the value of the source before them in s; None: there was
        none, or some may be missing.
        """
        finite = np.isfinite(values) & np.isfinite(times)
        ends, known = (times, finite) if after is None else (np.append(after, times), np.append(True, finite))
        steps = np.diff(ends)
        joined = known[:-1] & known[1:] & (steps >= 0.0)
        if joined.sum() > 1:
            joined &= steps <= _LATE * np.median(steps[joined])
        lines = ends[:-1][joined], ends[1:][joined]
        times, values = times[finite], values[finite]
        if not len(times):
            return
        parts: tuple[_FromStart | _Recent, ...] = (self._whole, *self._recent.values())
        with self._lock:
            for part in parts:
                part.add(times, values)
                part.join(*lines)

    def since(self, version: int, span: int = 0) -> CurveChange:
        """What has changed since the version that a page has, 0 for nothing yet; ``span``: see `CurveQuestion`."""
        with self._lock:
            return self._recent[span].since(version) if span in self._recent else self._whole.since(version)


class Looks:
    """Which values were looked at in the look before, so that none that could be had is missing between them."""

    def __init__(self, usual: float) -> None:
        self._least = self._usual = usual
        self._number = 0
        self._began = math.inf
        self._last: dict[str, tuple[int, float, float]] = {}

    def begin(self, now: float) -> None:
        """Begin a look at a wall-clock time in s."""
        # A slow source has a longer time between two looks.
        self._usual += 0.1 * (min(max(now - self._began, self._least), 2.0 * self._usual) - self._usual)
        self._number, self._began = self._number + 1, now

    def after(self, name: str, now: float, time: float, step: float) -> float | None:
        """Take the time of a value, and give that of the value before; None if values may be missing between them.

        Within ``step`` seconds none is missing. A value that came ``now`` may be as old as its question, so the time
        since the look before began counts.
        """
        number, began, before = self._last.get(name, (-1, -math.inf, -math.inf))
        self._last[name] = self._number, self._began, time
        is_next = number == self._number - 1 and now - began < _SLOW * self._usual
        return before if is_next or time - before < _LATE * step else None


class _Intervals:
    """The smallest and the largest value of each of some intervals."""

    def __init__(self, numbers: NDArray[np.int32 | np.int64], start: float, width: float) -> None:
        count = len(numbers)
        self._number = numbers
        self._start = start
        self._width = width
        self._low = np.full(count, np.nan)
        self._high = np.full(count, np.nan)
        self._t_low = np.zeros(count)
        self._t_high = np.zeros(count)
        self._joined = np.zeros(count, bool)  # whether a line leads from its last value to the next interval
        self._changed = np.zeros(count, np.int64)
        self._version = self._whole_since = next(_first_versions)

    def since(self, version: int) -> CurveChange:
        """As `BoundedCurve.since`."""
        whole = not self._whole_since <= version <= self._version
        at = np.flatnonzero(self._changed > (0 if whole else version))
        columns = [column[at] for column in (self._number, self._t_low, self._low, self._t_high, self._high)]
        columns.append(self._number[at[~self._joined[at]]])
        return CurveChange(self._version, whole, *(column.tolist() for column in columns))

    def join(self, starts: Numbers, ends: Numbers) -> None:
        """Let lines lead from values at these times to those at others."""
        numbers = self._numbers(starts)
        numbers = numbers[numbers < self._numbers(ends)]
        at = numbers % len(self._number)
        new = at[(self._number[at] == numbers) & ~self._joined[at] & ~np.isnan(self._low[at])]
        if len(new):
            self._version += 1
            self._joined[new] = True
            self._changed[new] = self._version

    def _numbers(self, times: Numbers) -> NDArray[np.int64]:
        """The interval of each time. Rounding may put the very start just before it."""
        numbers: NDArray[np.int64] = ((times - self._start) / self._width).astype(np.int64)
        return np.maximum(numbers, 0)

    def _put(self, at: NDArray[np.int64], times: Numbers, values: Numbers) -> None:
        """Put each value into its interval."""
        order = np.lexsort((values, at))
        at, times, values = at[order], times[order], values[order]
        first = np.flatnonzero(np.diff(at, prepend=-1))
        last = np.append(first[1:], len(at)) - 1
        touched = at[first]
        lower = ~(self._low[touched] <= values[first])  # also where there was nothing
        higher = ~(self._high[touched] >= values[last])
        below, above = touched[lower], touched[higher]
        self._low[below], self._t_low[below] = values[first][lower], times[first][lower]
        self._high[above], self._t_high[above] = values[last][higher], times[last][higher]
        if len(below) or len(above):
            self._version += 1
            self._changed[below] = self._version
            self._changed[above] = self._version


class _FromStart(_Intervals):
    """All values; when the intervals do not reach far enough, each two of them become one."""

    def __init__(self, start: float, width: float) -> None:
        super().__init__(np.arange(BUCKETS, dtype=np.int32), start, width)

    def add(self, times: Numbers, values: Numbers) -> None:
        """Add values that are finite; at least one."""
        while (float(times.max()) - self._start) / self._width >= BUCKETS:
            self._width *= 2.0
            self._merge()
        self._put(self._numbers(times), times, values)

    def _merge(self) -> None:
        """Each two intervals become one."""
        half = BUCKETS // 2
        low, high = self._low.reshape(half, 2), self._high.reshape(half, 2)
        rows = np.arange(half)
        lower = np.where(np.isnan(low), np.inf, low).argmin(axis=1)
        higher = np.where(np.isnan(high), -np.inf, high).argmax(axis=1)
        joined = self._joined.reshape(half, 2)
        merged = (
            (self._joined, np.where(np.isnan(low[:, 1]), joined[:, 0], joined[:, 1]), False),
            (self._low, low[rows, lower], np.nan),
            (self._high, high[rows, higher], np.nan),
            (self._t_low, self._t_low.reshape(half, 2)[rows, lower], 0.0),
            (self._t_high, self._t_high.reshape(half, 2)[rows, higher], 0.0),
        )
        for column, values, nothing in merged:
            column[:half], column[half:] = values, nothing
        self._version += 1
        self._whole_since = self._version
        self._changed[:half] = np.where(np.isnan(self._low[:half]), 0, self._version)
        self._changed[half:] = 0


class _Recent(_Intervals):
    """The newest values, in a ring of intervals."""

    def __init__(self, start: float, width: float) -> None:
        super().__init__(np.full(_RECENT, -1, np.int64), start, width)
        self._newest = 0

    def add(self, times: Numbers, values: Numbers) -> None:
        """Add values that are finite; older ones than those in the ring are left out."""
        numbers = self._numbers(times)
        self._newest = max(self._newest, int(numbers.max()))
        recent = numbers > self._newest - _RECENT
        if not recent.any():
            return
        numbers = numbers[recent]
        at = numbers % _RECENT
        old = at[self._number[at] != numbers]
        self._low[old] = self._high[old] = np.nan
        self._joined[old] = False
        self._number[at] = numbers
        self._put(at, times[recent], values[recent])
