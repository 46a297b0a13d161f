"""Measuring the grant: which node, or what else, keeps it from growing, and for how long."""

from __future__ import annotations

import time

__all__ = ["CLOCK", "PAUSE", "GrantWatch"]

CLOCK = "@clock"
"""Holds the grant where the run keeps to the wall clock."""

PAUSE = "@pause"
"""Holds the grant while the mesh is paused."""


class GrantWatch:
    """Sums up how long what held the grant; `look` at every grant."""

    def __init__(self) -> None:
        self.held_s: dict[str, float] = {}
        self._holder: str | None = None
        self._since = 0.0

    def look(self, holder: str | None) -> None:
        """From now on ``holder`` keeps the grant from growing; None: it is at the last point."""
        now = time.perf_counter()
        if self._holder is not None:
            self.held_s[self._holder] = self.held_s.get(self._holder, 0.0) + now - self._since
        self._holder, self._since = holder, now
