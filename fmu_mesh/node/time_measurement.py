"""Measures how a node spends its time, and what it waits for.

Without a profile none of this runs. If the master asks for one, the node lets a `Profiler` look at its engine after
every burst.
"""

from __future__ import annotations

import os
import socket
from time import perf_counter

from ..wire.time_profile import GRANT, Burst, NodeProfile, UnitProfile, Wait
from .engine import Engine

__all__ = ["Profiler"]


class Profiler:
    """Collects what one node does.

    Args:
        node: name of the node.
        entries: largest number of bursts and waits that are stored; the sums contain all of them.

    Call `start` before the first burst and `look` after each; at the end call `profile`.
    """

    def __init__(self, node: str, entries: int) -> None:
        self._node = node
        self._entries = entries
        self._started = self._ended = self._looked = perf_counter()
        self._spent_s: list[float] = []
        self._steps: list[int] = []
        self._names: list[tuple[str, ...]] = []
        self._counts: list[int] = []
        self._waited_s = 0.0
        self._wait_s: dict[str, float] = {}
        self._bursts: list[Burst] = []
        self._waits: list[Wait] = []
        self._cut = 0
        self._transport_s = 0.0

    def start(self, engine: Engine) -> None:
        """The node is at point 0."""
        self._started = self._ended = self._looked = perf_counter()
        self._names = [tuple(runner.name for runner in unit) for unit in engine.units]
        self._counts = [0] * len(engine.units)
        self._note(engine)

    def look(self, engine: Engine) -> None:
        """After a burst: where the time since the last look went. What is left over is the transport."""
        now = perf_counter()
        waited_s = engine.waited_s - self._waited_s
        if not any(runner.step for runner in engine.runners):  # the run begins with the first step
            self.start(engine)
            return
        begin, busy_s = self._looked, 0.0
        for number, (unit, spent_s) in enumerate(zip(engine.units, engine.spent_s, strict=True)):
            steps, lasted_s = unit[0].step - self._steps[number], spent_s - self._spent_s[number]
            if steps > 0:
                self._counts[number] += 1
                self._store(Burst(begin + busy_s, begin + busy_s + lasted_s, number, steps, 0.0))
                self._ended = now
            busy_s += lasted_s
        if waited_s > 0.0 and any(runner.step < runner.last_step for runner in engine.runners):
            reason = engine.awaited or GRANT
            self._wait_s[reason] = self._wait_s.get(reason, 0.0) + waited_s
            self._store(Wait(begin + busy_s, begin + busy_s + waited_s, reason))
        if self._ended == now:
            self._transport_s += max(0.0, now - begin - busy_s - waited_s)
        self._looked = now
        self._note(engine)

    def profile(self) -> NodeProfile:
        """What was measured."""
        return NodeProfile(
            node=self._node,
            host=socket.gethostname(),
            pid=os.getpid(),
            started=self._started,
            ended=self._ended,
            units=tuple(
                UnitProfile(names, steps, count, spent_s)
                for names, steps, count, spent_s in zip(
                    self._names, self._steps, self._counts, self._spent_s, strict=True
                )
            ),
            transport_s=self._transport_s,
            wait_s=self._wait_s,
            bursts=tuple(self._bursts),
            waits=tuple(self._waits),
            cut=self._cut,
        )

    def _note(self, engine: Engine) -> None:
        self._waited_s = engine.waited_s
        self._spent_s = list(engine.spent_s)
        self._steps = [unit[0].step for unit in engine.units]

    def _store(self, entry: Burst | Wait) -> None:
        if len(self._bursts) + len(self._waits) >= self._entries:
            self._cut += 1
        elif isinstance(entry, Burst):
            self._bursts.append(entry)
        else:
            self._waits.append(entry)
