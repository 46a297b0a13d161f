"""Frames: rows of an instance as bytes, and the receiving end of a link, which fills the mirror of a ring.

In a message, the parts of the rows are in the order of the layout. Numbers are little endian, row by row; a Boolean is
one byte, 0 or 1. For String and Binary, the lengths of all values in bytes (u32) come first, then the values (UTF-8,
raw bytes). The decoder checks sizes before it reads anything. The receiver lets no row be missing or come twice.
The sending end is `fmu_mesh.node.links`.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Sequence
from itertools import pairwise
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..errors import FmuMeshError, FrameGap, MessageRefused, ProtocolBroken
from ..rings.host_memory import Counter, HostMemory
from ..rings.ring import Ring, Rows
from ..system.layout import Layout, Part
from ..system.memory_map import RingPlace
from ..system.plan import RECORDER, Link
from ..variables.value_types import DTYPES, Value, VariableType, is_text
from .messages import HEADER, MAX_MESSAGE_SIZE
from .views import Way

__all__ = [
    "FrameReceiver",
    "SourceRows",
    "decode_rows",
    "encode_frames",
    "encode_rows",
    "initial_values",
    "of_numbers",
    "of_text",
    "rows_of",
]

_LENGTH: Final = np.dtype("<u4")
_HINT: Final = "Do all processes run the same version of fmu_mesh and the same configuration?"

assert sys.byteorder == "little", "numbers go over the wire as they lie in memory"


class SourceRows(NamedTuple):
    """Rows of an instance: with ``text`` True only its text, with False only its numbers; None is all."""

    ring: Ring
    counter: Counter
    text: bool | None = None


def rows_of(  # noqa: PLR0913, PLR0917  a link, and where its rows may be
    link: Link, place: RingPlace, way: Way, memory: HostMemory, own: HostMemory, fits: Callable[[int], bool]
) -> tuple[list[SourceRows], FrameReceiver | None]:
    """Where the target of a link finds the rows of the source, and what takes the frames of the link.

    By a ``ring``, numbers are at ``place`` in the ``memory`` that source and target share. By a ``stream``, they come
    to a mirror of it, whose counter is in the ``own`` memory of the target, as that of each mirror. Text comes in
    frames, and ``by Zenoh`` all columns do.
    """
    rows, layout, counter = [], link.layout, own.counter(place.counter)
    if way != "zenoh":
        layout, counter, numbers = of_text(link.layout), own.counter(place.text_counter), of_numbers(link.layout)
        if way == "ring":
            rows.append(SourceRows(memory.ring(place), memory.counter(place.counter), text=False))
        elif numbers.columns:
            rows.append(SourceRows(Ring(numbers, place.rows), own.counter(place.counter), text=False))
    if not layout.columns:
        return rows, None
    mirror = SourceRows(Ring(layout, place.rows), counter, None if way == "zenoh" else True)
    return [*rows, mirror], FrameReceiver(link, mirror.ring, mirror.counter, fits)


class FrameReceiver:
    """Checks the frames of one link.

    Args:
        ring: the mirror of the ring of the source, with the columns of the frames: gets the rows.
        fits: whether rows before this own step of the source overwrite no row that is still needed.
    """

    def __init__(
        self, link: Link, ring: Ring, counter: Counter, fits: Callable[[int], bool] = lambda _end: True
    ) -> None:
        self.link = link
        self._ring = ring
        self._counter = counter
        self._fits = fits

    @property
    def received(self) -> int:
        """Number of rows of the source that were received; the next row must have this number."""
        return self._counter.value

    def take(self, first: int, count: int, data: bytes) -> None:
        """Take a FRAME message with ``count`` rows from own step ``first`` of the source on.

        Raises:
            MessageRefused: it is not a frame of this link.
            FrameGap: rows before it are missing, or a row came twice with different values.
            ProtocolBroken: it has more rows than were granted.
        """
        link, ring, received, end = self.link, self._ring, self.received, first + count
        rows = decode_rows(data, count, ring.layout.parts)
        if first < 0:
            raise MessageRefused(f"a frame from point {first} on has no point of this run")
        target = "the recorder" if link.target_node == RECORDER else f"node '{link.target_node}'"
        if count > ring.rows or (first <= received < end and not self._fits(end)):
            last = (end - 1) * link.step_points
            raise ProtocolBroken(
                f"'{link.source}' sends its values up to point {last} to {target}, more than was granted",
                instance=link.source,
                point=first * link.step_points,
                hint="Does another process send messages with its name?",
            )
        if first > received:
            missing, last = received * link.step_points, first * link.step_points - 1
            text = f"points {missing} to {last} of '{link.source}' never reached {target}"
            raise FrameGap(text, instance=link.source, point=missing)
        parts = list(zip(ring.parts, rows, strict=True))
        for row in range(max(first, received - ring.rows), min(end, received)):  # the old ones that are still kept
            if any(_bits(part[row & ring.mask]) != _bits(new[row - first]) for part, new in parts):
                raise FrameGap(
                    f"the values of '{link.source}' came twice and differ",
                    instance=link.source,
                    point=row * link.step_points,
                    hint="Two processes publish as this instance: end one of them.",
                )
        for start, slots in ring.pieces(received, end):
            stop = start + slots.stop - slots.start
            for part, new in parts:
                part[slots] = new[start - first : stop - first]
            ring.stamps[slots] = np.arange(start + 1, stop + 1)
        if end > received:
            self._counter.raise_to(end)


def of_numbers(layout: Layout) -> Layout:
    """The columns without text."""
    return Layout(tuple(column for column in layout.columns if not is_text(column.type)))


def of_text(layout: Layout) -> Layout:
    """The columns with text."""
    return Layout(tuple(column for column in layout.columns if is_text(column.type)))


def _bits(row: NDArray[Any]) -> bytes | list[str | bytes]:
    """What must be equal in two rows: the bits of numbers, which distinguish -0.0 from 0.0, and the texts."""
    if row.dtype == object:
        texts: list[str | bytes] = row.tolist()
        return texts
    return bytes(row.tobytes())


def initial_values(link: Link, level: int, data: bytes) -> dict[str, Value]:
    """The values of ``level`` in an INITIAL message.

    Raises:
        MessageRefused: it is not a message of this link.
    """
    row = Ring(link.layout, 1)
    for part, new in zip(row.parts, decode_rows(data, 1, link.layout.parts), strict=True):
        part[:] = new
    names = [name for name, own in zip(link.layout.names, link.levels, strict=True) if own == level]
    return {name: row.value(0, name) for name in names}


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
