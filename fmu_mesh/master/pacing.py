"""The wall clock of a run: how long it took, and how far it may be."""

from __future__ import annotations

import math
import time

from ..model.plan import Plan

__all__ = ["Clock", "Pacer"]


class Clock:
    """Wall-clock time since the first point, pauses left out."""

    def __init__(self) -> None:
        self._before = 0.0
        self._since: float | None = None

    def start(self) -> None:
        """Start, or go on after a pause."""
        if self._since is None:
            self._since = time.perf_counter()

    def stop(self) -> None:
        """Hold it."""
        self._before = self.elapsed()
        self._since = None

    def elapsed(self) -> float:
        """Seconds so far."""
        return self._before + (time.perf_counter() - self._since if self._since is not None else 0.0)


class Pacer:
    """Holds the grant back to the wall clock; a real-time factor of 0 never does."""

    def __init__(self, plan: Plan, real_time_factor: float) -> None:
        self._rate = real_time_factor / plan.grid.step_size
        self._origin = 0
        self._started = 0.0

    def start(self, point: int) -> None:
        """The wall clock and ``point`` belong together now."""
        self._origin = point
        self._started = time.perf_counter()

    def limit(self, wanted: int) -> tuple[int, float]:
        """The point that may be granted now, and how long until ``wanted`` may be, in s."""
        if self._rate <= 0:
            return wanted, math.inf
        due = self._origin + (time.perf_counter() - self._started) * self._rate
        allowed = math.floor(due) + 1
        if allowed >= wanted:
            return wanted, math.inf
        return allowed, max(0.0005, (allowed - due) / self._rate)
