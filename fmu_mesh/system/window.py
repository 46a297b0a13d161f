"""The sizes of windows in points: how far nodes may be ahead, and how far the recorder may be behind."""

from __future__ import annotations

from collections.abc import Sequence

from .layout import Layout
from .system import ResolvedSystem

__all__ = [
    "AUTO_WINDOW_POINTS",
    "STEADY_POINTS",
    "batch_of",
    "recorder_window",
    "window_of",
]

RECORDER_WINDOW = 32768
"""Largest number of points that the recorder may be behind. It sleeps while rows accumulate."""

_LEAST_RECORDER_WINDOW = 64
_RECORDER_BYTES = 16 * 2**20

AUTO_WINDOW_POINTS = 32768
AUTO_WINDOW_BYTES = 16 * 2**20
AUTO_WINDOW_ROWS = 262144
"""Limit for all instances together."""

STEADY_POINTS = 1024
"""Points that the grant may be ahead at any speed; more only for fast instances."""


def recorder_window(window: int, row_sizes: Sequence[int]) -> int:
    """Number of points that the recorder may be behind: no node needs its rows, so it delays nodes as late as possible.

    Args:
        window: window of the mesh in points.
        row_sizes: row sizes of all recorded instances in bytes.
    """
    most = min(RECORDER_WINDOW, _RECORDER_BYTES // max(sum(row_sizes), 1))
    return max(window, _LEAST_RECORDER_WINDOW, most)


def batch_of(window: int) -> int:
    """Number of points that a node may sleep for if no other waits for its next one; ``window``: of the mesh."""
    return max(1, window // 16)


def window_of(system: ResolvedSystem) -> int:
    """The window of the configuration in points; `auto` is as large as the memory for the rows allows.

    A large window costs memory only. Values do not depend on it, and a pause takes effect soon at every window: see
    `fmu_mesh.master.granting`.
    """
    configured = system.config.simulation.window
    if configured != "auto":
        return configured
    widest = max(Layout.of(instance.description.variables).row_size for instance in system.instances.values())
    points = min(AUTO_WINDOW_POINTS, max(STEADY_POINTS, AUTO_WINDOW_ROWS // len(system.instances)))
    return max(16, min(points, AUTO_WINDOW_BYTES // max(widest, 1)))
