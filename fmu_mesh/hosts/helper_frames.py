"""What a launcher and its helper on another host send each other: frames, each a length and MessagePack.

What comes before the first frame of the helper, such as the output of a login script, ends with a magic word. A frame
without content is a sign of life; `fmu_mesh.hosts.ssh_relay` sends it, which knows nothing else of frames.
"""

from __future__ import annotations

import math
import os
import platform
import select
import struct
from typing import Final

import msgspec

from ..awake import AwakeClock

__all__ = [
    "MAGIC",
    "PROBE",
    "Alive",
    "CannotGoOn",
    "Ended",
    "FilePiece",
    "Forget",
    "FrameReader",
    "FromHelper",
    "HelperHello",
    "Line",
    "Missing",
    "OfferTrees",
    "Prepare",
    "Ready",
    "SignalNode",
    "StartNode",
    "ToHelper",
    "framed",
    "this_system",
]

MAGIC: Final = b"\x00fmu_mesh helper\x00"

PROBE: Final = "probe"
"""A socket in the folder of the run at the helper, which sends a byte to the first one who comes."""

_LENGTH: Final = struct.Struct("<I")
_READ_BYTES: Final = 1 << 18
_LOOK_S: Final = 0.25


class HelperHello(msgspec.Struct, frozen=True, tag=True):
    """The first frame of a helper: what is there. Of another version it may have more.

    Attributes:
        version: of fmu_mesh; ``python``, ``libc``: of these.
        machine: the processor, such as `x86_64`.
        run: the name of the run there.
        pid: of the helper.
        cache: where the files of models are.
        address: of that host in the connection of ssh; empty: it is not known.
    """

    version: str
    python: str
    libc: str
    machine: str
    run: str
    pid: int
    cache: str
    address: str = ""


class OfferTrees(msgspec.Struct, frozen=True, tag=True):
    """The trees that the nodes need, by name: the SHA-256 of each file by its path in the tree."""

    trees: dict[str, dict[str, str]]


class Missing(msgspec.Struct, frozen=True, tag=True):
    """The files that are not there yet, by SHA-256; and the folder of the run."""

    contents: tuple[str, ...]
    folder: str


class FilePiece(msgspec.Struct, frozen=True, tag=True):
    """A part of a file, or the ``last`` one."""

    content: str
    data: bytes
    last: bool


class Prepare(msgspec.Struct, frozen=True, tag=True):
    """All files are there: make the trees, write the run plan, and check the models, once for the same ``terms``.

    Attributes:
        journals: the folder for the journals of the nodes; empty: they write none.
        is_first: whether it is that of the first attempt, for which there are none yet.
    """

    plan: bytes
    nodes: tuple[str, ...]
    terms: str
    journals: str = ""
    is_first: bool = True


class Forget(msgspec.Struct, frozen=True, tag=True):
    """No other attempt follows: remove the journals at the end."""


class Ready(msgspec.Struct, frozen=True, tag=True):
    """Nodes can be started, unless there are problems: an instance, what it misses, and what to do."""

    problems: tuple[tuple[str, str, str], ...] = ()


class StartNode(msgspec.Struct, frozen=True, tag=True):
    """Start a node, with this Python; None: that of the helper."""

    node: str
    interpreter: str | None


class SignalNode(msgspec.Struct, frozen=True, tag=True):
    """Send a signal to a node, if it still runs."""

    node: str
    number: int


class Line(msgspec.Struct, frozen=True, tag=True):
    """A line that a node has written, to standard error if it is an ``error``."""

    node: str
    data: bytes
    error: bool


class Ended(msgspec.Struct, frozen=True, tag=True):
    """A node has ended with a code: the negative number of a signal if it was one."""

    node: str
    code: int


class Alive(msgspec.Struct, frozen=True, tag=True):
    """The answer to each frame, at once."""


class CannotGoOn(msgspec.Struct, frozen=True, tag=True):
    """The helper cannot go on, and ends."""

    text: str
    hint: str


ToHelper = OfferTrees | FilePiece | Prepare | StartNode | SignalNode | Forget
FromHelper = HelperHello | Missing | Ready | Line | Ended | Alive | CannotGoOn


def framed(message: ToHelper | FromHelper) -> bytes:
    """A message as a frame."""
    data = msgspec.msgpack.encode(message)
    return _LENGTH.pack(len(data)) + data


def this_system() -> tuple[str, str, str]:
    """The version of Python, the C library, and the processor of this host."""
    return platform.python_version(), " ".join(platform.libc_ver()), platform.machine()


class FrameReader:
    """Reads frames from a descriptor, on one thread.

    Args:
        descriptor: of a pipe.
        magic: what the first frame follows.
    """

    def __init__(self, descriptor: int, magic: bytes = b"") -> None:
        self._descriptor = descriptor
        self._magic = magic
        self._data = bytearray()

    def next(self, limit_s: float = math.inf) -> bytes | None:
        """The content of the next frame, empty for a sign of life; None at the end.

        Raises:
            TimeoutError: nothing has come for ``limit_s`` seconds in which this process could run.
        """
        while True:
            if self._magic and (found := self._data.find(self._magic)) >= 0:
                del self._data[: found + len(self._magic)]
                self._magic = b""
            if self._magic:
                del self._data[: -len(self._magic)]
            elif len(self._data) >= _LENGTH.size:
                end = _LENGTH.size + _LENGTH.unpack_from(self._data)[0]
                if len(self._data) >= end:
                    content = bytes(self._data[_LENGTH.size : end])
                    del self._data[:end]
                    return content
            self._wait(limit_s)
            if not (more := os.read(self._descriptor, _READ_BYTES)):
                return None
            self._data += more

    def _wait(self, limit_s: float) -> None:
        clock = AwakeClock()
        while not select.select([self._descriptor], [], [], _LOOK_S)[0]:
            if clock() > limit_s:
                raise TimeoutError
