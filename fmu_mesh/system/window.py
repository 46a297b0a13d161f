"""How far ahead of others who may be: the sizes of windows, in points, and what they are bounded by."""

from __future__ import annotations

from collections.abc import Sequence

from .layout import Layout
from .system import System

__all__ = [
    "AUTO_WINDOW_POINTS",
    "FRAME_OVERHEAD",
    "LAZY_ROWS",
    "STEADY_POINTS",
    "lazy_frame_rows",
    "recorder_window",
    "window_of",
]

RECORDER_WINDOW = 32768
"""How many points the recorder may be behind, where its memory for their rows allows: it rests while they gather."""

_LEAST_RECORDER_WINDOW = 8192
_RECORDER_BYTES = 16 * 2**20

FRAME_OVERHEAD = 32
"""What a message takes besides its rows, in bytes; it may hold a single one."""

LAZY_ROWS = 2048
"""Rows that a ring holds at least, so that half of them may wait for the recorder where the window is small."""

_LAZY_FRAME_ROWS = 4096

AUTO_WINDOW_POINTS = 16384
AUTO_WINDOW_BYTES = 16 * 2**20
AUTO_WINDOW_ROWS = 65536
"""Of all instances together; where a step goes call by call, each row is kept with a pointer to it, too."""

STEADY_POINTS = 1024
"""So far the grant may be ahead at any speed; how far beyond that depends on it."""


def recorder_window(window: int, row_sizes: Sequence[int]) -> int:
    """How many points the recorder may be behind: rows that nobody steps on hold nodes back only when there are many.

    Args:
        window: that of the mesh.
        row_sizes: of all instances that are recorded, in bytes.
    """
    row_bytes = sum(row_sizes) + FRAME_OVERHEAD * len(row_sizes)
    return max(window, _LEAST_RECORDER_WINDOW, min(RECORDER_WINDOW, _RECORDER_BYTES // max(row_bytes, 1)))


def lazy_frame_rows(window: int) -> int:
    """How many rows may wait in a node until a frame for the recorder is worth sending, for a window of the mesh."""
    return min(_LAZY_FRAME_ROWS, max(LAZY_ROWS // 2, window // 4))


def window_of(system: System) -> int:
    """The window of the configuration; `auto` is as large as the memory for the rows allows.

    A large window only costs memory: values do not depend on it, what a node sends is flushed when a consumer could
    be waiting for it, and slow instances are granted a part of it only, so that a pause holds soon.
    """
    configured = system.config.simulation.window
    if configured != "auto":
        return configured
    widest = max(Layout.of(instance.description.variables).row_size for instance in system.instances.values())
    points = min(AUTO_WINDOW_POINTS, max(STEADY_POINTS, AUTO_WINDOW_ROWS // len(system.instances)))
    return max(16, min(points, AUTO_WINDOW_BYTES // max(widest, 1)))
