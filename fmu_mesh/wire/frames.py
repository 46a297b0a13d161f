"""The receiving end of a link: checks frames and fills the mirror of a ring; no row may be missing or come twice."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import FrameGap, MessageRefused, ProtocolBroken
from ..rings.host_memory import Counter
from ..rings.ring import Ring, Rows
from ..system.layout import Layout
from ..system.plan import Link
from ..variables.value_types import Value, is_text
from .rows import decode_rows

__all__ = ["FrameReceiver", "initial_values", "needed_levels", "of_text", "picks"]


class FrameReceiver:
    """Checks the frames of one link.

    Args:
        link: the link.
        layout: the columns of its frames.
        target: the receiver, for errors.
        ring: the mirror of the ring of the source: gets the rows.
        counter: the number of rows of this mirror.
        fits: whether rows before this own step of the source overwrite no row that is still needed.
    """

    def __init__(  # noqa: PLR0913, PLR0917  both ends of a link
        self,
        link: Link,
        layout: Layout,
        target: str,
        ring: Ring,
        counter: Counter,
        fits: Callable[[int], bool] = lambda _end: True,
    ) -> None:
        self.link = link
        self._layout = layout
        self._fits = fits
        self._target = target
        self._ring = ring
        self._counter = counter
        self._places = picks(ring.layout, layout)

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
        rows = decode_rows(data, count, self._layout.parts)
        received = self.received
        if first < 0:
            raise MessageRefused(f"a frame from point {first} on has no point of this run")
        if count > self._ring.rows or (first <= received < first + count and not self._fits(first + count)):
            last = (first + count - 1) * self.link.step_points
            raise ProtocolBroken(
                f"'{self.link.source}' sends its values up to point {last} to {self._target}, more than was granted",
                instance=self.link.source,
                point=first * self.link.step_points,
                hint="Does another process send messages with its name?",
            )
        if first > received:
            missing, last = received * self.link.step_points, first * self.link.step_points - 1
            text = f"points {missing} to {last} of '{self.link.source}' never reached {self._target}"
            raise FrameGap(text, instance=self.link.source, point=missing)
        if first < received:
            known = min(received - first, count)
            self._compare(first, known, rows)
            if known == count:
                return
            first, rows = first + known, tuple(part[known:] for part in rows)
        self._keep(first, rows)
        self._counter.raise_to(first + len(rows[0]))

    def _keep(self, first: int, rows: Rows) -> None:
        ring = self._ring
        start, count = first & ring.mask, len(rows[0])
        cut = min(count, ring.rows - start)
        stamps = np.arange(first + 1, first + count + 1)
        for part, place, new in [(ring.stamps, None, stamps), *self._into(rows)]:
            columns = (slice(None),) if place is None else (slice(None), place)
            part[start : start + cut][columns] = new[:cut]
            part[: count - cut][columns] = new[cut:]

    def _into(self, rows: Rows) -> Iterator[tuple[NDArray[Any], list[int] | slice, NDArray[Any]]]:
        """Each part of the ring, its elements that a frame has, and their new values."""
        for (part, elements), new in zip(self._places, rows, strict=True):
            yield self._ring.parts[part], slice(None) if elements is None else elements, new

    def _compare(self, first: int, known: int, rows: Rows) -> None:
        """A row that is received again must have the same bits; this is checked for the rows that are still kept."""
        for row in range(max(0, self.received - self._ring.rows - first), known):
            slot = (first + row) & self._ring.mask
            if any(_bits(part[slot][place]) != _bits(new[row]) for part, place, new in self._into(rows)):
                raise FrameGap(
                    f"the values of '{self.link.source}' came twice and differ",
                    instance=self.link.source,
                    point=(first + row) * self.link.step_points,
                    hint="Two processes publish as this instance: end one of them.",
                )


def picks(have: Layout, want: Layout) -> list[tuple[int, list[int] | None]]:
    """For each wanted part: its number in a ring, and the elements to pick, or None if all are wanted."""
    types = [part.type for part in have.parts]
    found: list[tuple[int, list[int] | None]] = []
    for part in want.parts:
        number = types.index(part.type)
        places = [have.place(column.name) for column in part.columns]
        elements = [element for place in places for element in range(place.first, place.first + place.size)]
        found.append((number, None if len(elements) == have.parts[number].width else elements))
    return found


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


def needed_levels(link: Link) -> frozenset[int]:
    """The levels of Initialization Mode at which the target of this link expects a message."""
    return frozenset(level for level in link.levels if level >= 0)
