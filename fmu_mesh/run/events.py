"""The events of a run, and how the process of the master sends them to its launcher: one JSON line each.

`Mesh.run` and `Mesh.start` give them to `on_event`.
"""

# Threads: whoever has an event puts it into `_waiting`, and a thread "events" writes, because the launcher may be
# stopped. Only the outcome is waited for (ADR 71). It writes to the descriptor itself: the lock of a buffered file
# would keep the process from ending.

from __future__ import annotations

import os
import sys
import threading
from collections import deque

import msgspec

from ..errors import ErrorReport
from ..instances.contract import LogMessage
from ..wire.views import LogLine, MeshStatus
from .outcome import Outcome

__all__ = [
    "Event",
    "EventWriter",
    "Log",
    "OutputLine",
    "Reachable",
    "Restarted",
    "Status",
    "WasReset",
    "decode_event",
    "log_line",
]


_MOST_WAITING = 10_000


class Reachable(msgspec.Struct, frozen=True, tag="reachable"):
    """The master, or the gateway, can be reached at these Zenoh endpoints."""

    endpoints: tuple[str, ...]


class Status(msgspec.Struct, frozen=True, tag="status"):
    """The state of the run; sent about ten times per second."""

    status: MeshStatus


class Log(msgspec.Struct, frozen=True, tag="log"):
    """A log message of an FMU."""

    line: LogLine


class OutputLine(msgspec.Struct, frozen=True, tag="output"):
    """A line that a process of the run has written to its standard output or error; the launcher makes this event."""

    process: str
    text: str


class Restarted(msgspec.Struct, frozen=True, tag="restarted"):
    """All processes start again, for the ``number``-th of ``most`` times, because of an error.

    The rows up to ``point`` are there, and are made again unpaced.
    """

    error: ErrorReport
    number: int
    most: int
    point: int = 0


class WasReset(msgspec.Struct, frozen=True, tag="reset"):
    """A command has reset the mesh, for the ``number``-th time: ``outcome`` is that of the run before."""

    outcome: Outcome
    number: int


Event = Reachable | Status | Log | OutputLine | Restarted | WasReset | Outcome

_decoder: msgspec.json.Decoder[Event] = msgspec.json.Decoder(Event)


def decode_event(line: bytes) -> Event:
    """Decode the event of one line.

    Raises:
        msgspec.DecodeError: the line is not an event.
    """
    return _decoder.decode(line)


def log_line(message: LogMessage, step_points: int) -> LogLine:
    """A message of an instance as others see it; its own step is so many points, and it begins at point 0."""
    point = max(message.step, 0) * step_points
    return LogLine(message.instance, message.status, message.category, message.message, point)


class EventWriter:
    """Writes events for the launcher; may be called from any thread.

    The launcher may be stopped (Ctrl-Z) and then reads nothing. The run does not wait for it: a thread of its own
    writes, and only the newest of several unwritten statuses is kept. Only a call with the outcome returns after the
    event is written, or after the launcher has ended.

    Args:
        descriptor: the file descriptor to write to; by default that of standard output.
    """

    def __init__(self, descriptor: int | None = None) -> None:
        self._descriptor = descriptor if descriptor is not None else sys.stdout.fileno()
        self._changed = threading.Condition()
        self._waiting: deque[Event] = deque()
        self._writing = False
        self._gone = False
        threading.Thread(target=self._run, name="events", daemon=True).start()

    def __call__(self, event: Event) -> None:
        """Write one event."""
        with self._changed:
            waiting = self._waiting
            if waiting and isinstance(event, Status) and isinstance(waiting[-1], Status):
                waiting.pop()
            if len(waiting) < _MOST_WAITING or isinstance(event, Outcome):
                waiting.append(event)
            self._changed.notify_all()
            if isinstance(event, Outcome):
                # If the launcher has ended, the end of standard input ends this process (`fmu_mesh.run.process`).
                self._changed.wait_for(lambda: self._gone or not (waiting or self._writing))

    def _run(self) -> None:
        while not self._gone:
            with self._changed:
                self._changed.wait_for(lambda: bool(self._waiting))
                event, self._writing = self._waiting.popleft(), True
            line = msgspec.json.encode(event) + b"\n"
            try:
                while line:  # not through a buffered file: its lock would keep the process from ending
                    line = line[os.write(self._descriptor, line) :]
            except OSError:  # nobody reads any more
                self._gone = True
            with self._changed:
                self._writing = False
                self._changed.notify_all()
