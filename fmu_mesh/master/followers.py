"""Readers that must get the last sample of a run: the master, which routes it to them, stays until they have it.

A follower has a liveliness token as long as it lacks samples; Zenoh itself does not tell.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable

import zenoh

from ..wire.inbox import Inbox

__all__ = ["Followers"]

log = logging.getLogger(__name__)


class Followers:
    """The followers of one run.

    Args:
        inbox: the inbox of the master.
        is_going_on: whether the run has not come to its end.
    """

    def __init__(self, inbox: Inbox, is_going_on: Callable[[], bool]) -> None:
        self._inbox = inbox
        self._is_going_on = is_going_on
        self._there: set[str] = set()
        self._lost: set[str] = set()

    def changed(self, sample: zenoh.Sample) -> None:
        """Take a token of a follower that is there, or gone."""
        name = str(sample.key_expr)
        if sample.kind == zenoh.SampleKind.PUT:
            self._there.add(name)
            self._lost.discard(name)
        else:
            self._there.discard(name)
            if self._is_going_on():
                self._lost.add(name)

    def wait(self, timeout_s: float) -> None:
        """Stay until all of them have their last sample, for ``timeout_s`` seconds at most."""
        if self._lost:
            log.warning("a gateway was gone before the last point; ROS has nothing of what came after it")
        deadline = time.monotonic() + timeout_s
        while self._there:
            if (left := deadline - time.monotonic()) <= 0:
                log.warning("a gateway did not take its last samples within %g s", timeout_s)
                return
            self._inbox.wait(left)
