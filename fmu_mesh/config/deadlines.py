"""How long the launcher and the master of a run wait: what `timeouts` of the configuration says, and what follows."""

from __future__ import annotations

import math
from typing import Self

import msgspec

from .mesh import TimeoutsConfig

__all__ = ["Deadlines"]


class Deadlines(msgspec.Struct, frozen=True, kw_only=True):
    """Each in s, by a clock that stands still while the process that waits cannot run (`AwakeClock`).

    Attributes:
        start: until all nodes are ready; for the launcher: until the first event of the master.
        initialize: then, until all are at the first point.
        step: without progress, if the process of a node is stopped.
        silence: without progress. The instances of a node step one after the other, each with a deadline of its own.
        stop: from the last point until all nodes have reported their end.
        heartbeat: between two messages of the master to the nodes, so that they know that it lives.
        link: how long a process may be stopped before the run begins.
        finish: from an outcome without an error until its processes have ended; the gateway may still have samples.
        no_event: without an event of the master. It sends ten per second, so it is lost: its nodes have ended before,
            at the deadline of a step, and said why.
        look: between two looks at the processes, where nothing else happens.
        report: from the end of a node until the launcher reports it. The master notices it within milliseconds.
        report_of_failure: the same if an FMU has failed: the node has told the master, which may wait for the recorder.
        gateway: a gateway that has ended so long before its mesh has lost its link.
        interrupt: from an interrupt until the launcher no longer waits for an orderly end.
        look_at_end: as `look`, at the end. Only a process that has left others behind ends without an event.
        leave: for processes to end by themselves after the outcome, or after SIGTERM.
        leave_lost: the same without an outcome: most of them wait for somebody who is gone.
        leave_interrupted: after SIGTERM, where a person waits for the end.
    """

    start: float
    initialize: float
    step: float
    silence: float
    stop: float
    heartbeat: float
    link: float
    finish: float
    no_event: float
    look: float = 0.25
    report: float = 1.5
    report_of_failure: float = 8.0
    gateway: float = 2.0
    interrupt: float = 0.9
    look_at_end: float = 0.05
    leave: float = 0.7
    leave_lost: float = 0.1
    leave_interrupted: float = 0.3

    @classmethod
    def of(cls, timeouts: TimeoutsConfig, most_instances: int = 1, *, waits_for_program: bool = False) -> Self:
        """The deadlines of a mesh whose largest node has so many instances; one may wait for a program of the user."""
        return cls(
            start=timeouts.start,
            initialize=timeouts.initialize,
            step=timeouts.step,
            silence=math.inf if waits_for_program else 3 * timeouts.step * most_instances,
            stop=timeouts.stop + timeouts.terminate * most_instances,
            heartbeat=max(0.01, min(0.5, timeouts.step / 4)),
            link=timeouts.link,
            finish=timeouts.stop,
            no_event=10.0 + timeouts.step,
        )
