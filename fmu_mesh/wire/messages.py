"""The messages of the synchronization, as bytes.

Every message starts with 16 bytes, little endian: kind (u8), one spare byte, link or node number (u16), count (u32),
point (i64). A frame follows with its rows: first all Real values (float64, row by row), then all others (int32). Abort
follows with an `ErrorReport` as JSON. Every decoder checks sizes before it touches anything.
"""

from __future__ import annotations

import struct
from typing import Final, TypeVar

import msgspec
import numpy as np
from numpy.typing import NDArray

from ..errors import ErrorReport, FmuMeshError
from ..model.ring import Layout
from .profile import NodeProfile

__all__ = [
    "ABORT",
    "FINISH",
    "FRAME",
    "GRANT",
    "HEADER",
    "INITIAL",
    "MAX_MESSAGE_SIZE",
    "PROGRESS",
    "WAKE",
    "NodeReport",
    "Rows",
    "decode_abort",
    "decode_json",
    "decode_rows",
    "encode_abort",
    "encode_rows",
]

HEADER: Final = struct.Struct("<BxHIq")
FRAME: Final = 1
INITIAL: Final = 2
GRANT: Final = 3
PROGRESS: Final = 4
FINISH: Final = 5
ABORT: Final = 6
WAKE: Final = 7

MAX_MESSAGE_SIZE: Final = 64 * 2**20

T = TypeVar("T")

Rows = tuple[NDArray[np.float64], NDArray[np.int32]]
_NO_INTEGERS: Final = np.zeros((0, 0), dtype=np.int32)


class NodeReport(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """How a node ended: at which point, with which error if any, and its profile if the master asked for one."""

    node: str
    point: int
    error: ErrorReport | None = None
    profile: NodeProfile | None = None


def encode_rows(kind: int, link: int, first: int, reals: NDArray[np.float64], integers: NDArray[np.int32]) -> bytes:
    """A FRAME or INITIAL message with consecutive rows; ``first`` is the own step index of the first one."""
    header = HEADER.pack(kind, link, len(reals), first)
    if integers.shape[1]:
        return b"".join((header, reals.tobytes(), integers.tobytes()))
    return header + reals.tobytes()


def decode_rows(data: bytes, count: int, layout: Layout) -> Rows:
    """The rows of a FRAME or INITIAL message as read-only arrays of shape (count, columns).

    Raises:
        FmuMeshError: the size does not fit ``count`` rows of ``layout``.
    """
    n_reals, n_integers = len(layout.reals), len(layout.integers)
    expected = HEADER.size + count * (8 * n_reals + 4 * n_integers)
    if len(data) != expected or len(data) > MAX_MESSAGE_SIZE:
        text = f"a frame of {count} points has {len(data)} bytes where {expected} are expected"
        raise FmuMeshError(text, hint="Do all processes run the same version of fmu_mesh and the same configuration?")
    reals = np.frombuffer(data, np.float64, count * n_reals, HEADER.size).reshape(count, n_reals)
    if not n_integers:
        return reals, _NO_INTEGERS
    integers = np.frombuffer(data, np.int32, count * n_integers, HEADER.size + reals.nbytes)
    return reals, integers.reshape(count, n_integers)


def encode_abort(report: ErrorReport) -> bytes:
    """An ABORT message."""
    return HEADER.pack(ABORT, 0, 0, 0) + msgspec.json.encode(report)


def decode_abort(data: bytes) -> ErrorReport:
    """The error that ended the mesh.

    Raises:
        msgspec.DecodeError: it is not an `ErrorReport`.
    """
    return decode_json(data[HEADER.size :], ErrorReport)


def decode_json(data: bytes, type_: type[T]) -> T:
    """JSON that came over the wire.

    Raises:
        msgspec.DecodeError: it is not JSON of that type.
    """
    try:
        return msgspec.json.decode(data, type=type_)
    except (RecursionError, UnicodeDecodeError) as error:  # msgspec lets them through
        raise msgspec.DecodeError(str(error)) from error
