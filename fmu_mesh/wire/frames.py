"""The receiving end of a link: checks frames and fills the mirror of a ring; no row may be missing or come twice."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..errors import FrameGap, MessageRefused, ProtocolBroken
from ..rings.host_memory import Counter, HostMemory
from ..rings.ring import Ring
from ..system.layout import Layout
from ..system.memory_map import RingPlace
from ..system.plan import RECORDER, Link
from ..variables.value_types import Value, is_text
from .rows import decode_rows

__all__ = ["FrameReceiver", "SourceRows", "initial_values", "of_text", "rows_of"]


class SourceRows(NamedTuple):
    """Rows of an instance.

    Attributes:
        text: True: only its text is taken from here, because the numbers are in another ring. False: only its numbers.
    """

    ring: Ring
    counter: Counter
    text: bool | None = None


def rows_of(
    link: Link, place: RingPlace, shared: HostMemory | None, own: HostMemory, fits: Callable[[int], bool]
) -> tuple[list[SourceRows], FrameReceiver | None]:
    """Where the target of a link finds the rows of the source, and what takes the frames of the link.

    The ring is at ``place`` in the memory that source and target share. If they share none, all columns come in frames;
    otherwise those with text. The rows of frames are in a mirror, whose counter is in the ``own`` memory of the target.
    """
    rows = [SourceRows(shared.ring(place), shared.counter(place.counter), text=False)] if shared is not None else []
    layout = link.layout if shared is None else of_text(link.layout)
    if not layout.columns:
        return rows, None
    mirror = SourceRows(Ring(layout, place.rows), own.counter(place.counter), None if shared is None else True)
    return [*rows, mirror], FrameReceiver(link, mirror.ring, mirror.counter, fits)


class FrameReceiver:
    """Checks the frames of one link.

    Args:
        ring: the mirror of the ring of the source, with the columns of the frames: gets the rows.
        counter: the number of rows of this mirror.
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
        if end > received:
            numbers = np.arange(received, end)
            for part, new in parts:
                part[numbers & ring.mask] = new[received - first :]
            ring.stamps[numbers & ring.mask] = numbers + 1
            self._counter.raise_to(end)


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
