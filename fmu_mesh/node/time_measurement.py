"""Measures how a node spends its time, and what it waits for.

Without a profile none of this runs. If the master asks for one, the node lets a `Profiler` look at its engine after
every burst.
"""

from __future__ import annotations

import socket
from time import perf_counter

from ..wire.host_processes import own_pid
from ..wire.time_profile import GRANT, Burst, NodeProfile, UnitProfile, Wait
from .engine import Engine

__all__ = ["Profiler"]


class Profiler:
    """Collects what one node does.

    Args:
        entries: largest number of bursts and waits that are stored; the sums contain all of them.

    Call `start` before the first burst and `look` after each; at the end call `profile`.
    """

    def __init__(self, node: str, entries: int) -> None:
        self._node = node
        self._most = entries
        self._entries: list[Burst | Wait] = []
        self._cut = 0
        self._wait_s: dict[str, float] = {}
        self._transport_s = 0.0

    def start(self, engine: Engine) -> None:
        """The node is at point 0."""
        self._started = self._ended = self._looked = perf_counter()
        self._waited_s = engine.waited_s
        self._units = [
            UnitProfile(tuple(runner.name for runner in unit), unit[0].step, 0, spent_s)
            for unit, spent_s in zip(engine.units, engine.spent_s, strict=True)
        ]

    def look(self, engine: Engine) -> None:
        """After a burst: where the time since the last look went. What is left over is the transport."""
        if not any(runner.step for runner in engine.runners):  # the run begins with the first step
            self.start(engine)
            return
        now, at, waited_s = perf_counter(), self._looked, engine.waited_s - self._waited_s
        for number, (unit, spent_s, old) in enumerate(zip(engine.units, engine.spent_s, self._units, strict=True)):
            begin, at = at, at + spent_s - old.compute_s
            steps, stepped = unit[0].step, unit[0].step > old.steps
            if stepped:
                self._store(Burst(begin, at, number, steps - old.steps))
                self._ended = now
            self._units[number] = UnitProfile(old.instances, steps, old.bursts + stepped, spent_s)
        if waited_s > 0.0 and any(runner.step < runner.last_step for runner in engine.runners):
            reason = engine.awaited or GRANT
            self._wait_s[reason] = self._wait_s.get(reason, 0.0) + waited_s
            self._store(Wait(at, at + waited_s, reason))
        if self._ended == now:
            self._transport_s += max(0.0, now - at - waited_s)
        self._looked = now
        self._waited_s = engine.waited_s

    def profile(self) -> NodeProfile:
        """What was measured."""
        return NodeProfile(
            node=self._node,
            host=socket.gethostname(),
            pid=own_pid(),
            started=self._started,
            ended=self._ended,
            units=tuple(self._units),
            transport_s=self._transport_s,
            wait_s=self._wait_s,
            bursts=tuple(entry for entry in self._entries if isinstance(entry, Burst)),
            waits=tuple(entry for entry in self._entries if isinstance(entry, Wait)),
            cut=self._cut,
        )

    def _store(self, entry: Burst | Wait) -> None:
        if len(self._entries) < self._most:
            self._entries.append(entry)
        else:
            self._cut += 1
