"""A clock for deadlines of others: it stands still while its own process cannot run."""

from __future__ import annotations

import time
from collections.abc import Callable

__all__ = ["AwakeClock"]

_MOST_S = 1.0


class AwakeClock:
    """Seconds in which this process could run; read it at least twice a second.

    A process may be stopped by a signal, or its machine be suspended. When it goes on, nothing of what it waits for had
    the time to happen: of the time between two reads, at most a second counts.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._seen = clock()
        self._awake_s = 0.0

    def __call__(self) -> float:
        """The time in s since this object was made, without the time in which this process could not run."""
        now = self._clock()
        self._awake_s += min(now - self._seen, _MOST_S)
        self._seen = now
        return self._awake_s
