"""What a master's process tells its launcher: one JSON line per event on standard output."""

from __future__ import annotations

import os
import sys
import threading
from collections import deque

import msgspec

from ..errors import ErrorReport
from ..wire.time_profile import MeshProfile
from ..wire.views import LogLine, MeshStatus

__all__ = ["End", "Event", "EventWriter", "Log", "Ready", "Status", "decode_event"]


_MOST_WAITING = 10_000


class Ready(msgspec.Struct, frozen=True, tag="ready"):
    """The master can be reached at these endpoints."""

    endpoints: tuple[str, ...]


class Status(msgspec.Struct, frozen=True, tag="status"):
    """The state of the run, about ten times a second."""

    status: MeshStatus


class Log(msgspec.Struct, frozen=True, tag="log"):
    """A log message of an FMU."""

    line: LogLine


class End(msgspec.Struct, frozen=True, tag="end"):
    """The run is over.

    Attributes:
        seconds: wall-clock time from the first grant to the last point in s.
        rows: rows in the result file.
        profile: where the time went, if that was asked for.
        ended_by: what ended the simulation before its last point although nothing failed, if something did.
        signal: by which signal the process of the master was asked to end, if it was.
    """

    status: MeshStatus
    seconds: float
    rows: int
    result_file: str | None
    error: ErrorReport | None = None
    profile: MeshProfile | None = None
    ended_by: ErrorReport | None = None
    signal: str | None = None


Event = Ready | Status | Log | End

_decoder: msgspec.json.Decoder[Event] = msgspec.json.Decoder(Event)


def decode_event(line: bytes) -> Event:
    """The event of one line.

    Raises:
        msgspec.DecodeError: it is none.
    """
    return _decoder.decode(line)


class EventWriter:
    """Writes events for the launcher; from any thread.

    The launcher may be stopped (Ctrl-Z) and read nothing for as long as its user likes. Nobody waits for it: a thread
    of its own writes, and of statuses that are not written yet the newest is kept. Only the last event waits until it
    is written, or the launcher is gone.

    Args:
        descriptor: where to write; by default standard output.
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
            if len(waiting) < _MOST_WAITING or isinstance(event, End):
                waiting.append(event)
            self._changed.notify_all()
            if isinstance(event, End):
                # The end of standard input ends this process when the launcher is gone (`fmu_mesh.run.process`).
                self._changed.wait_for(lambda: self._gone or not (waiting or self._writing))

    def _run(self) -> None:
        while not self._gone:
            with self._changed:
                self._changed.wait_for(lambda: bool(self._waiting))
                event, self._writing = self._waiting.popleft(), True
            line = msgspec.json.encode(event) + b"\n"
            try:
                while line:  # not through a buffered file, whose lock would keep the process from ending
                    line = line[os.write(self._descriptor, line) :]
            except OSError:  # nobody reads any more
                self._gone = True
            with self._changed:
                self._writing = False
                self._changed.notify_all()
