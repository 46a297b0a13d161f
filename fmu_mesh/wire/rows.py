"""Rows as bytes: the values that follow the header of a frame.

The parts are in the order of the layout. Numbers are little endian, row by row; a Boolean is one byte, 0 or 1. For
String and Binary, the lengths of all values in bytes (u32) come first, then the values (UTF-8, raw bytes). Every
decoder checks sizes before it reads anything.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence
from itertools import pairwise
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from ..errors import FmuMeshError, MessageRefused
from ..rings.ring import Rows
from ..system.layout import Part
from ..variables.value_types import DTYPES, VariableType, is_text
from .messages import HEADER, MAX_MESSAGE_SIZE

__all__ = ["decode_rows", "encode_frames", "encode_rows"]

_LENGTH: Final = np.dtype("<u4")
_HINT: Final = "Do all processes run the same version of fmu_mesh and the same configuration?"

assert sys.byteorder == "little", "numbers go over the wire as they lie in memory"


def encode_rows(kind: int, link: int, first: int, rows: Rows) -> bytes:
    """A FRAME or INITIAL message with consecutive rows from own step ``first`` on; there is at least one part."""
    header = HEADER.pack(kind, link, len(rows[0]), first)
    return b"".join((header, *(_texts(part) if part.dtype == np.object_ else part.tobytes() for part in rows)))


def encode_frames(kind: int, link: int, first: int, rows: Rows) -> Iterator[bytes]:
    """As `encode_rows`, but in several messages if one would be too large; texts have no fixed size.

    Raises:
        FmuMeshError: a single row is too large.
    """
    message = encode_rows(kind, link, first, rows)
    if len(message) <= MAX_MESSAGE_SIZE:
        yield message
        return
    half = len(rows[0]) // 2
    if not half:
        text = f"the values of one point take {len(message)} bytes; the limit is {MAX_MESSAGE_SIZE}"
        raise FmuMeshError(text, hint="Connect and record fewer or smaller variables.")
    yield from encode_frames(kind, link, first, tuple(part[:half] for part in rows))
    yield from encode_frames(kind, link, first + half, tuple(part[half:] for part in rows))


def decode_rows(data: bytes, count: int, parts: Sequence[Part]) -> Rows:
    """The ``count`` rows of a FRAME or INITIAL message; arrays of numbers are read-only.

    Raises:
        MessageRefused: it does not contain exactly these rows.
    """
    if len(data) > MAX_MESSAGE_SIZE:
        raise _refused(data, count, f"at most {MAX_MESSAGE_SIZE} are allowed")
    place = HEADER.size
    rows: list[NDArray[Any]] = []
    for type_, _, width in parts:
        size = count * width
        if is_text(type_):
            values, place = _decode_texts(data, place, count, size, type_)
        else:
            dtype = np.dtype(DTYPES[type_])
            if place + size * dtype.itemsize > len(data):
                raise _refused(data, count, f"at least {place + size * dtype.itemsize} are expected")
            values = np.frombuffer(data, dtype, size, place)
            if type_ == "Boolean" and size and values.view(np.uint8).max() > 1:
                raise MessageRefused("a frame has a Boolean that is neither true nor false", hint=_HINT)
            place += size * dtype.itemsize
        rows.append(values.reshape(count, width))
    if place != len(data):
        raise _refused(data, count, f"{place} are expected")
    return tuple(rows)


def _texts(part: NDArray[Any]) -> bytes:
    values = [value.encode() if isinstance(value, str) else value for value in part.ravel().tolist()]
    return b"".join((np.array([len(value) for value in values], _LENGTH).tobytes(), *values))


def _decode_texts(
    data: bytes, place: int, count: int, size: int, type_: VariableType
) -> tuple[NDArray[np.object_], int]:
    """The values of a part with text, and the position after them."""
    first = place + size * _LENGTH.itemsize
    if first > len(data):
        raise _refused(data, count, f"at least {first} are expected")
    ends = first + np.cumsum(np.frombuffer(data, _LENGTH, size, place), dtype=np.int64)
    if size and ends[-1] > len(data):
        raise _refused(data, count, f"at least {ends[-1]} are expected")
    bounds = [first, *ends.tolist()]
    texts: list[Any] = [data[begin:end] for begin, end in pairwise(bounds)]
    if type_ == "String":
        try:
            texts = [text.decode() for text in texts]
        except UnicodeDecodeError as error:
            raise MessageRefused(f"a frame has a String that is no UTF-8 ({error.reason})", hint=_HINT) from error
    values = np.empty(size, dtype=np.object_)
    values[:] = texts
    return values, bounds[-1]


def _refused(data: bytes, count: int, expected: str) -> MessageRefused:
    return MessageRefused(f"a frame of {count} points has {len(data)} bytes where {expected}", hint=_HINT)
