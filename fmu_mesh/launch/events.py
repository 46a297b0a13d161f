"""What a master's process tells its launcher: one JSON line per event on standard output."""

from __future__ import annotations

import sys
import threading
from typing import BinaryIO

import msgspec

from ..errors import ErrorReport
from ..wire.profile import MeshProfile
from ..wire.views import LogLine, MeshStatus

__all__ = ["End", "Event", "EventWriter", "Log", "Ready", "Status", "decode_event"]


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
        ended_by: which FMU asked to end the simulation before its last point, if one did.
    """

    status: MeshStatus
    seconds: float
    rows: int
    result_file: str | None
    error: ErrorReport | None = None
    profile: MeshProfile | None = None
    ended_by: ErrorReport | None = None


Event = Ready | Status | Log | End

_decoder: msgspec.json.Decoder[Event] = msgspec.json.Decoder(Event)


def decode_event(line: bytes) -> Event:
    """The event of one line.

    Raises:
        msgspec.DecodeError: it is none.
    """
    return _decoder.decode(line)


class EventWriter:
    """Writes events for the launcher; from any thread."""

    def __init__(self, stream: BinaryIO | None = None) -> None:
        self._stream = stream if stream is not None else sys.stdout.buffer
        self._lock = threading.Lock()

    def __call__(self, event: Event) -> None:
        """Write one event."""
        line = msgspec.json.encode(event) + b"\n"
        with self._lock:
            try:
                self._stream.write(line)
                self._stream.flush()
            except BrokenPipeError:
                return  # the launcher is gone; the end of standard input ends this process
