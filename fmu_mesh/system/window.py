"""The sizes of windows in points and of rings in rows: how far nodes may be ahead, and the recorder behind.

Owns what memory bounds: narrow rows may wait in thousands, of wide ones (images, fields) there are a few.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import Literal

from .layout import Layout, row_bytes

__all__ = [
    "AUTO_WINDOW_POINTS",
    "recorder_window",
    "rows_for",
    "rows_of_ring",
    "window_of",
]

RECORDER_WINDOW = 262144
"""Largest number of points that the recorder may be behind. It sleeps while rows accumulate."""

_ROOM_BYTES = 16 * 2**20
"""Up to this size, memory for rows is not worth saving: a recorder, a reader and a watcher look less often."""

_LEAST_POINTS = 16
_MOST_BYTES = 32 * 2**20
"""What the rows of a window that is configured may take, unless they are `_LEAST_POINTS` or fewer."""

AUTO_WINDOW_POINTS = 262144
"""As many as fast instances step while rows and progress travel to another continent and back."""
AUTO_WINDOW_ROWS = 1048576
"""Limit for all instances together, unless each has `_STEADY_POINTS` or fewer."""
_STEADY_POINTS = 1024


def recorder_window(window: int, row_sizes: Sequence[int]) -> int:
    """Number of points that the recorder may be behind: no node needs its rows, so it delays nodes as late as possible.

    The window is that of the mesh in points, the sizes in bytes those of the rows of all recorded instances.
    """
    return max(window, min(RECORDER_WINDOW, _ROOM_BYTES // max(sum(row_sizes), 1)))


def window_of(configured: int | Literal["auto"], outputs: Collection[Layout]) -> int:
    """The window of a mesh in points; `auto` is as large as the memory for the rows allows.

    A large window costs memory only. Values do not depend on it, and a pause takes effect soon at every window: see
    `fmu_mesh.master.granting`. So of wide rows, a window that is configured is only as large as memory should be.
    ``outputs`` are those of each instance.
    """
    widest = max(1, *(layout.row_size for layout in outputs))
    if configured != "auto":
        return min(configured, max(_LEAST_POINTS, _MOST_BYTES // widest))
    points = min(AUTO_WINDOW_POINTS, max(_STEADY_POINTS, AUTO_WINDOW_ROWS // len(outputs)))
    return max(_LEAST_POINTS, min(points, _ROOM_BYTES // widest))


def rows_for(rows: int) -> int:
    """Number of rows of a ring whose writer may be ``rows`` ahead without overwriting a row in use."""
    return 1 << (rows + 3).bit_length()


def rows_of_ring(layout: Layout, needed: int = 0, most: int = RECORDER_WINDOW) -> int:
    """Number of rows of a ring whose readers may be ``needed`` rows behind.

    With ``most`` rows the readers look less often: a ring has as many of them as take little memory.
    """
    return rows_for(max(needed, min(most, _ROOM_BYTES // row_bytes(layout))))
