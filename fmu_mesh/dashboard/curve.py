"""The history of one variable in bounded memory: the smallest and the largest value of each interval of time.

Knows neither meshes nor pages.
"""

from __future__ import annotations

import threading
from typing import Final

import msgspec
import numpy as np
from numpy.typing import NDArray

__all__ = ["BUCKETS", "BoundedCurve", "CurveChange"]

BUCKETS: Final = 1024
"""Intervals of a curve. A plot on a page has about as many columns of pixels."""


class CurveChange(msgspec.Struct, frozen=True, rename={"t_low": "tl", "t_high": "th", "low": "l", "high": "h"}):
    """What a page needs to draw a curve that it has drawn before.

    Attributes:
        version: what the page names the next time.
        whole: whether this replaces all that the page has.
        at: the intervals that changed, by number.
        t_low: the time of the smallest value of each of them, in s; ``t_high`` is that of the largest.
        low: the smallest values; ``high`` has the largest.
    """

    version: int
    whole: bool
    at: list[int]
    t_low: list[float]
    low: list[float]
    t_high: list[float]
    high: list[float]


class BoundedCurve:
    """The values of one variable from the start on, at most 1024 intervals of equal length.

    When the intervals do not reach far enough, each two of them become one. The order in which values come does not
    matter, so older ones can be added while new ones come. Memory: 40 kB, however long the run is. All methods may be
    called from any thread.

    Args:
        start: the start time in s.
        width: length of an interval in s at first, such as the step size.
    """

    def __init__(self, start: float, width: float) -> None:
        self._lock = threading.Lock()
        self._start = start
        self._width = width
        self._low = np.full(BUCKETS, np.nan)
        self._high = np.full(BUCKETS, np.nan)
        self._t_low = np.zeros(BUCKETS)
        self._t_high = np.zeros(BUCKETS)
        self._changed = np.zeros(BUCKETS, np.int64)
        self._version = 0
        self._whole_since = 0

    def add(self, times: NDArray[np.float64], values: NDArray[np.float64]) -> None:
        """Add values; those that are not finite are left out.

        Args:
            times: in s, shape `(n,)`; in any order.
            values: of the same shape.
        """
        finite = np.isfinite(values) & np.isfinite(times)
        times, values = times[finite], values[finite]
        if len(times):
            with self._lock:
                self._add(times, values)

    def since(self, version: int) -> CurveChange:
        """What has changed since a version; 0 stands for a page that has nothing yet."""
        with self._lock:
            whole = version < self._whole_since or version > self._version or version == 0
            at = np.flatnonzero(self._changed > (0 if whole else version))
            columns = (self._t_low, self._low, self._t_high, self._high)
            return CurveChange(self._version, whole, at.tolist(), *(column[at].tolist() for column in columns))

    def _add(self, times: NDArray[np.float64], values: NDArray[np.float64]) -> None:
        self._reach(float(times.max()))
        # Rounding may put a value at the very start just before it.
        at = np.maximum(((times - self._start) / self._width).astype(np.int64), 0)
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

    def _reach(self, time: float) -> None:
        """Make the intervals long enough for a time."""
        while (time - self._start) / self._width >= BUCKETS:
            self._width *= 2.0
            self._merge()

    def _merge(self) -> None:
        """Each two intervals become one."""
        half = BUCKETS // 2
        low, high = self._low.reshape(half, 2), self._high.reshape(half, 2)
        rows = np.arange(half)
        lower = np.where(np.isnan(low), np.inf, low).argmin(axis=1)
        higher = np.where(np.isnan(high), -np.inf, high).argmax(axis=1)
        merged = (
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
