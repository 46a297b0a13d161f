"""The link of a process to its router: whether it is there, and what follows for others that seem to be gone."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Iterable

import zenoh

from ..awake import AwakeClock
from .session import tokens

__all__ = ["RouterLink"]

# Threads: each thread that asks has a link of its own, or is the only one that does: `register` uses that of its node
# before the main thread does. Zenoh has no event for a router that is lost in client mode, so `_waits_until` looks
# again and again, with a deadline; the `Event` there is never set. No callback of Zenoh may call this, because a
# question about a token would wait for the thread that it is on.
#
# What may go wrong: a router is gone and back between two looks. Then rows by Zenoh have a gap, and the run ends with
# its name. ADR 74.

_LINK_S = 1.0
_UNLINK_S = 0.2
_BACK_S = 3.0
"""How long in s the processes behind a router that is back may need until all see all tokens again."""
_LINK_CHECK_S = 0.01


class RouterLink:
    """Watches the link of a process to the router that connects it to the other processes.

    Without ``endpoints``, everything that the process needs is on this host.
    """

    def __init__(self, session: zenoh.Session, endpoints: Iterable[str] = ()) -> None:
        self._session = session
        self.endpoints = tuple(endpoints)
        self._had_router = False
        self._lost_at: float | None = None
        self._back_at: float | None = None
        self._clock = AwakeClock()

    def wait(self) -> None:
        """Wait a moment for the link: a session in peer mode is open before the link is."""
        if self.endpoints:
            self._waits_until(there=True, seconds=_LINK_S)

    def look(self) -> bool:
        """Whether there is a router. After it was found once, a missing router counts as lost."""
        there = bool(self.endpoints) and any(True for _ in self._session.info.routers_zid())
        self._had_router = self._had_router or there
        return there

    @property
    def is_lost(self) -> bool:
        """Whether the router was there, and is not there now."""
        return self._had_router and not self.look()

    def has_gone(self, key: str, stream_silent_s: float, limit_s: float) -> bool | None:
        """Whether the process with this token is gone; None: that is not known yet. It may send a query.

        Its token says so, unless its row stream has not ended, but is only silent (``stream_silent_s`` is finite).
        Without a router that was there nobody has a token: that is no verdict for ``limit_s`` seconds.
        """
        if stream_silent_s < math.inf:
            return None
        if tokens(self._session, key):
            return False
        return None if self.may_come_back(limit_s) else True

    def may_come_back(self, limit_s: float) -> bool:
        """Whether what is missing may be missing only because the router was lost less than ``limit_s`` seconds ago.

        When it is back, the other processes need a moment to connect to it again.
        """
        if self._lost_at is None and self.loss() is not None:
            self._lost_at = self._clock()
        return self.is_unsteady(limit_s)

    def is_unsteady(self, limit_s: float = math.inf) -> bool:
        """Whether the router is lost for less than ``limit_s`` seconds, or is back for a moment only.

        Messages of this time may be lost. Call it again and again: it notices only what it sees.
        """
        now = self._clock()
        if self.is_lost:
            self._lost_at, self._back_at = self._lost_at or now, None
            return now - self._lost_at < limit_s
        if self._lost_at is None:
            return False
        self._back_at = self._back_at or now
        if now - self._back_at < _BACK_S:
            return True
        self._lost_at = None
        return False

    @property
    def is_back(self) -> bool:
        """Whether it is back for a moment only: then what may be lost has to be sent again."""
        return self.is_unsteady() and self._back_at is not None

    def loss(self) -> str | None:
        """A text that says that the router is lost; None if it is there, or if there was none.

        Zenoh reports the tokens behind a link as gone a moment before it reports the link as closed.
        """
        if not self._had_router or not self._waits_until(there=False, seconds=_UNLINK_S):
            return None
        return f"the link to the router at {', '.join(self.endpoints)} was lost"

    def _waits_until(self, *, there: bool, seconds: float) -> bool:
        """Wait until the router is there, or until it is not; return whether that happened in time."""
        end = time.monotonic() + seconds
        never = threading.Event()
        while self.look() != there:
            if time.monotonic() > end:
                return False
            never.wait(_LINK_CHECK_S)
        return True
