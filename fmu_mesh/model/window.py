"""How far ahead of others who may be: the sizes of windows, in points, and what they are bounded by."""

from __future__ import annotations

from .ring import Layout
from .system import System

__all__ = ["AUTO_WINDOW_POINTS", "LAZY_ROWS", "RECORDER_WINDOW", "STEADY_POINTS", "window_of"]

RECORDER_WINDOW = 8192
"""How many points the recorder may be behind, at least."""

LAZY_ROWS = 2048
"""Rows for the recorder that may wait in a node until a frame is worth sending."""

AUTO_WINDOW_POINTS = 4096
AUTO_WINDOW_BYTES = 16 * 2**20
AUTO_WINDOW_ROWS = 65536
"""Of all instances together; each row is kept with the pointers to its values, too."""

STEADY_POINTS = 1024
"""So far the grant may be ahead at any speed; how far beyond that depends on it."""


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
