"""Measures how a node spends its time, and what it waits for.

Without a profile none of this runs. If the master asks for a profile, measured units, links and calls replace those of
the node before the first point.
"""

from __future__ import annotations

import os
import socket
from collections.abc import Callable, Iterable, Sequence
from time import perf_counter
from typing import NamedTuple, ParamSpec, TypeVar

from ..rings.ring import Ring
from ..system.plan import Link
from ..wire.inbox import Message
from ..wire.time_profile import GRANT, Burst, NodeProfile, UnitProfile, Wait
from .links import OutLink
from .stepping import Runner, Unit

__all__ = ["Calls", "Profiler"]

P = ParamSpec("P")
T = TypeVar("T")


class Calls(NamedTuple):
    """The calls of a node that a profile measures.

    Attributes:
        poll: returns the next message if there is one.
        take: takes a message.
        put_progress: sends the progress to the master.
    """

    poll: Callable[[], Message | None]
    take: Callable[[Message], None]
    put_progress: Callable[[bytes], None] = lambda _data: None


class Profiler:
    """Collects what one node does.

    Args:
        node: name of the node.
        entries: largest number of bursts and waits that are stored; the sums contain all of them.
        window: window of the node's plan, from which the capacity of links follows.

    Call `link`, `measured_units` and `measured_calls` before Initialization Mode and `start` after it, then step; at
    the end call `profile`.
    """

    def __init__(self, node: str, entries: int, window: int) -> None:
        self._node = node
        self._entries = entries
        self._window = window
        self._units: list[_MeasuredUnit] = []
        self._started = self._ended = perf_counter()
        self._received_s = 0.0
        self._wait_s: dict[str, float] = {}
        self._bursts: list[Burst] = []
        self._waits: list[Wait] = []
        self._cut = 0
        self._transport_s = 0.0
        self.sent_s = 0.0

    def link(self, link: Link, outputs: Ring, put: Callable[[bytes], None]) -> OutLink:
        """A link whose sending is measured."""
        return _MeasuredLink(self, link, outputs, put, self._window)

    def measured_calls(self, calls: Calls) -> Calls:
        """The same calls, which are measured."""
        return Calls(self._receiving(calls.poll), self._receiving(calls.take), self._sending(calls.put_progress))

    def measured_units(self, units: Iterable[Unit]) -> list[Unit]:
        """The measured forms of ``units``."""
        self._units = [_MeasuredUnit(unit.runners, number, self) for number, unit in enumerate(units)]
        return [*self._units]

    def start(self) -> None:
        """The node is at point 0."""
        self._started = self._ended = perf_counter()
        self.sent_s = self._received_s = self._transport_s = 0.0

    def _sending(self, call: Callable[P, T]) -> Callable[P, T]:
        """The same call, whose time is spent on sending."""

        def measured(*args: P.args, **kwargs: P.kwargs) -> T:
            started = perf_counter()
            try:
                return call(*args, **kwargs)
            finally:
                self.sent_s += perf_counter() - started

        return measured

    def _receiving(self, call: Callable[P, T]) -> Callable[P, T]:
        """The same call, whose time is spent on receiving."""

        def measured(*args: P.args, **kwargs: P.kwargs) -> T:
            started = perf_counter()
            try:
                return call(*args, **kwargs)
            finally:
                self._received_s += perf_counter() - started

        return measured

    def stepped(self, burst: Burst) -> None:
        """Add a burst; sending and receiving after the last burst are not part of the run."""
        self._ended = burst.end
        self._transport_s = self.sent_s + self._received_s
        if len(self._bursts) + len(self._waits) < self._entries:
            self._bursts.append(burst)
        else:
            self._cut += 1

    def waited(self, seconds: float, *, running: bool) -> None:
        """Add a wait that has just ended, before its message is handled; ``running``: whether there was a grant."""
        if not running:  # other nodes are not at point 0 yet: the run begins with the first grant
            self.start()
            return
        ended = perf_counter()
        reason = self._behind()
        if reason is None:
            return
        self._wait_s[reason] = self._wait_s.get(reason, 0.0) + seconds
        if len(self._bursts) + len(self._waits) < self._entries:
            self._waits.append(Wait(ended - seconds, ended, reason))
        else:
            self._cut += 1

    def profile(self) -> NodeProfile:
        """What was measured."""
        return NodeProfile(
            node=self._node,
            host=socket.gethostname(),
            pid=os.getpid(),
            started=self._started,
            ended=self._ended,
            units=tuple(unit.profile() for unit in self._units),
            transport_s=self._transport_s,
            wait_s=self._wait_s,
            bursts=tuple(self._bursts),
            waits=tuple(self._waits),
            cut=self._cut,
        )

    def _behind(self) -> str | None:
        """The instance of another node for which this node waits, `GRANT`, or None after the last point."""
        unfinished = False
        for unit in self._units:
            for runner in unit.runners:
                if runner.step < runner.last_step:
                    unfinished = True
                    for feed in runner.remote_feeds:
                        if feed.ready <= runner.step:
                            return feed.receiver.link.source
        return GRANT if unfinished else None


class _MeasuredUnit(Unit):
    """A unit that reports its bursts to the profiler."""

    def __init__(self, runners: Sequence[Runner], number: int, profiler: Profiler) -> None:
        super().__init__(runners)
        self._number = number
        self._profiler = profiler
        self._bursts = 0
        self._compute_s = 0.0

    def advance(self, grant: int) -> bool:
        profiler, runner = self._profiler, self.runners[0]
        before, first = profiler.sent_s, runner.step
        started = perf_counter()
        if not super().advance(grant):
            return False
        ended = perf_counter()
        sent_s = profiler.sent_s - before
        self._bursts += 1
        self._compute_s += ended - started - sent_s
        profiler.stepped(Burst(started, ended, self._number, runner.step - first, sent_s))
        return True

    def profile(self) -> UnitProfile:
        """What was measured."""
        names = tuple(runner.name for runner in self.runners)
        return UnitProfile(names, self.runners[0].step, self._bursts, self._compute_s)


class _MeasuredLink(OutLink):
    """A link that reports the time of sending to the profiler."""

    def __init__(
        self, profiler: Profiler, link: Link, outputs: Ring, put: Callable[[bytes], None], window: int
    ) -> None:
        super().__init__(link, outputs, put, window)
        self._profiler = profiler

    def flush(self, end: int) -> None:
        if self.sent < end:
            started = perf_counter()
            super().flush(end)
            self._profiler.sent_s += perf_counter() - started
