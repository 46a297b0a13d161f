"""What a batch and its processes say to each other, and the memory that they share.

Values lie in the memory, side by side for all copies, and each process uses those of its own copies; everything else
is a message on a pair of sockets. Owns the format of both. Knows neither what a command does nor who has ended.
"""

# Processes: the batch has one end of a pair of sockets for each process, and makes the memory, which has no name and
# goes with its last user. The batch writes values and then a message; the process answers after it has written values.
# So no two of them write at a time, and a message orders what lies in the memory (ADR 82). Threads: in a process, the
# main thread sends, and that of the watch where the main thread does not return; a lock keeps a message in one piece.

from __future__ import annotations

import mmap
import os
import socket
import struct
import threading
from collections.abc import Mapping
from contextlib import suppress
from typing import Any, Final, Self

import msgspec
import numpy as np
from numpy.typing import NDArray

from ..errors import ErrorReport
from ..instances.contract import LogMessage
from ..variables.value_types import Value

__all__ = [
    "FIRST_COPIES",
    "Answer",
    "Begin",
    "Channel",
    "Failed",
    "Free",
    "Get",
    "GoOn",
    "LoggedByModel",
    "News",
    "Request",
    "Reset",
    "Restore",
    "Save",
    "Set",
    "SharedBlock",
    "StepCopies",
]

FIRST_COPIES: Final = 16
"""After so many copies it is known how much memory one takes."""

_MOST_BYTES: Final = 1 << 30
_AT_ONCE: Final = 1 << 20
_LENGTH: Final = struct.Struct("<I")
_TIME: Final = struct.Struct("@ll")
_ALIGNED: Final = 64
_ROOM: Final = 1 << 20
_NAME: Final = "fmu_mesh"


class Message(msgspec.Struct, frozen=True, forbid_unknown_fields=True, tag=True):
    """One of them, with its name."""


class Values(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Where values of variables of an instance lie: an array of shape (copies, width) at a place in the memory.

    Attributes:
        dtype: as numpy writes it; `O` are texts, which messages have.
    """

    instance: str
    names: tuple[str, ...]
    place: int
    dtype: str
    width: int


class Begin(Message, frozen=True):
    """Open all copies; those of ``gone`` (truths, a byte each) take no steps until they are reset."""

    gone: bytes


class GoOn(Message, frozen=True):
    """After the answer to the first part of `Begin`: there is enough memory for the others."""


class StepCopies(Message, frozen=True):
    """Step all copies that have not ended, then read values."""

    points: int
    reads: tuple[Values, ...] = ()


class Set(Message, frozen=True):
    """Set a variable of the wanted copies (truths, a byte each)."""

    values: Values
    wanted: bytes
    texts: list[list[Value]] | None = None


class Get(Message, frozen=True):
    """Read variables."""

    values: Values


class Save(Message, frozen=True):
    """Save all copies by this number."""

    state: int


class Restore(Message, frozen=True):
    """Bring the wanted copies back to what was saved."""

    state: int
    wanted: bytes


class Free(Message, frozen=True):
    """Free what was saved."""

    state: int


class Reset(Message, frozen=True):
    """Bring the wanted copies back to point 0, with start values by copy, instance and variable."""

    wanted: bytes
    overrides: Mapping[int, Mapping[str, Mapping[str, Any]]] | None = None


Request = list[Begin | GoOn | StepCopies | Set | Get | Save | Restore | Free | Reset]
"""What a process does before its next answer."""


class Answer(Message, frozen=True):
    """All of a request is done, or what it has raised. The memory says how far each copy is, and which have ended.

    Attributes:
        errors: how copies have ended, by their numbers in this process; None: nothing has changed.
        texts: those of a `Get`; None where a copy has none.
        why_not_saved: see `Copies`.
        taken: after the first copies, the memory that they take, in bytes.
    """

    raised: ErrorReport | None = None
    errors: dict[int, ErrorReport] | None = None
    texts: list[list[Value | None]] | None = None
    why_not_saved: str | None = None
    taken: int = 0


class LoggedByModel(Message, frozen=True):
    """A message of a model."""

    message: LogMessage


class Failed(Message, frozen=True):
    """The process is about to end: an FMU does not return, or has crashed. None: it is not known of which copy."""

    copy: int | None
    error: ErrorReport


News = Answer | LoggedByModel | Failed
"""What a process says."""


class Channel:
    """One end of a pair of sockets: messages, each after its length.

    Args:
        end: the socket.
        type_: what is received.
        limit_s: how long it may take until the other end has room for a message, in s; None: as long as it takes.
    """

    def __init__(self, end: socket.socket, type_: Any, limit_s: float | None = None) -> None:  # noqa: ANN401  a union, which is no type
        self._socket = end
        if limit_s is not None:  # by the system: a timeout of Python would be one more call of the system for each
            end.setsockopt(socket.SOL_SOCKET, socket.SO_SNDTIMEO, _TIME.pack(max(1, int(limit_s)), 0))
            end.setsockopt(socket.SOL_SOCKET, socket.SO_RCVTIMEO, _TIME.pack(1, 0))
        self._decoder = msgspec.msgpack.Decoder(type_)
        self._encoder = msgspec.msgpack.Encoder()
        self._read = bytearray()
        self._sending = threading.Lock()

    def fileno(self) -> int:
        """For `poll`."""
        return self._socket.fileno()

    def send(self, message: object) -> None:
        """From any thread: send a message.

        Raises:
            OSError: the other end is gone, or takes nothing.
        """
        data = self._encoder.encode(message)
        with self._sending:
            self._socket.sendall(_LENGTH.pack(len(data)) + data)

    def receive(self) -> Any:  # noqa: ANN401  a message of its type
        """Wait for a message; None: the other end is gone.

        Raises:
            OSError: it is too long.
            msgspec.DecodeError: it is no message.
        """
        while (length := self._length()) is None or len(self._read) < length:
            if not self._take():
                return None
        return self._next(length)

    def received(self) -> tuple[list[Any], bool]:
        """The messages that are there, and whether there may be more; waits for a part of one, at most a second.

        Raises:
            OSError: see `receive`.
            msgspec.DecodeError: see `receive`.
        """
        more, found = True, []
        with suppress(BlockingIOError):  # the second is over
            more = self._take()
        while (length := self._length()) is not None and len(self._read) >= length:
            found.append(self._next(length))
        return found, more

    def end(self, how: int = socket.SHUT_RDWR) -> None:
        """From any thread: tell the other end that there is no more; whoever waits here gets None."""
        with suppress(OSError):  # it is gone
            self._socket.shutdown(how)

    def close(self) -> None:
        """Close this end."""
        self._socket.close()

    def _take(self) -> bool:
        try:
            data = self._socket.recv(_AT_ONCE)
        except ConnectionError:  # it was killed with messages that nobody has read
            return False
        self._read += data
        return bool(data)

    def _length(self) -> int | None:
        if len(self._read) < _LENGTH.size:
            return None
        length: int = _LENGTH.unpack_from(self._read)[0]
        if length > _MOST_BYTES:
            raise OSError(f"a message has {length} bytes; expected at most {_MOST_BYTES}")
        return length + _LENGTH.size

    def _next(self, length: int) -> Any:  # noqa: ANN401  a message of its type
        message = self._decoder.decode(memoryview(self._read)[_LENGTH.size : length])
        del self._read[:length]
        return message


class SharedBlock:
    """The memory of one batch: how far its copies are, and values.

    Args:
        descriptor: the memory; it is closed with this object.
        count: how many copies.
        processes: how many processes.

    Attributes:
        points: of the copies, shape (copies,).
        ended: which of them take no more steps, shape (copies,).
        beats: of the processes, shape (processes,): a number grows as long as a process can do anything.
    """

    def __init__(self, descriptor: int, count: int, processes: int) -> None:
        self._descriptor, self._count = descriptor, count
        head = 8 * count + 8 * processes + count
        self._free = _up(head)
        if os.fstat(descriptor).st_size < self._free + _ROOM:
            os.ftruncate(descriptor, self._free + _ROOM)
        self._map()
        self.points = np.frombuffer(self._memory, np.int64, count)
        self.beats = np.frombuffer(self._memory, np.int64, processes, 8 * count)
        self.ended = np.frombuffer(self._memory, np.bool_, count, 8 * (count + processes))

    @classmethod
    def made(cls, count: int, processes: int) -> Self:
        """New memory.

        Raises:
            OSError: the system has none.
        """
        return cls(os.memfd_create(_NAME, os.MFD_CLOEXEC), count, processes)

    @property
    def descriptor(self) -> int:
        """For the processes."""
        return self._descriptor

    def place_for(self, dtype: np.dtype[Any], width: int) -> int:
        """A new place for values of all copies."""
        place, self._free = self._free, _up(self._free + self._count * width * dtype.itemsize)
        if self._free > len(self._memory):
            os.ftruncate(self._descriptor, max(self._free, 2 * len(self._memory)))
            self._map()
        return place

    def values(self, own: Values) -> NDArray[Any]:
        """The values of all copies at a place, shape (copies, width)."""
        dtype = np.dtype(own.dtype)
        if own.place + self._count * own.width * dtype.itemsize > len(self._memory):
            self._map()  # it has grown
        flat = np.frombuffer(self._memory, dtype, self._count * own.width, own.place)
        return flat.reshape(self._count, own.width)

    def close(self) -> None:
        """Close the descriptor; the memory goes with its last user."""
        os.close(self._descriptor)

    def _map(self) -> None:
        self._memory = mmap.mmap(self._descriptor, os.fstat(self._descriptor).st_size, mmap.MAP_SHARED)


def _up(size: int) -> int:
    return -(-size // _ALIGNED) * _ALIGNED
