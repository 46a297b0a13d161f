"""The receiving end of a link: checks frames and returns new rows; no row may be missing or come twice."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from numpy.typing import NDArray

from ..errors import FrameGap, MessageRefused, ProtocolBroken
from ..rings.ring import Ring, Rows
from ..system.plan import Link
from ..variables.value_types import Value
from .rows import decode_rows

__all__ = ["FrameReceiver", "initial_values", "needed_levels"]


class FrameReceiver:
    """Checks the frames of one link.

    Args:
        link: the link.
        target: the receiver, for errors.
        keep: how many rows are kept: a power of two, and at least the window, so that a frame always fits.
        fits: whether rows before this own step of the source overwrite no row that is still needed.

    Attributes:
        kept: the newest rows.
        received: number of own steps of the source that were received; the next row must have this number.
    """

    def __init__(self, link: Link, target: str, keep: int, fits: Callable[[int], bool] = lambda _end: True) -> None:
        self.link = link
        self._fits = fits
        self.received = 0
        self._target = target
        self._parts = link.layout.parts
        self.kept = Ring(link.layout, keep)

    def take(self, first: int, count: int, data: bytes) -> tuple[int, Rows] | None:
        """The new rows of a FRAME message with ``count`` rows from own step ``first`` of the source on.

        Returns:
            The own step of the first new row and the rows; None if all of them were received before.

        Raises:
            MessageRefused: it is not a frame of this link.
            FrameGap: rows before it are missing, or a row came twice with different values.
            ProtocolBroken: it has more rows than were granted.
        """
        rows = decode_rows(data, count, self._parts)
        if first < 0:
            raise MessageRefused(f"a frame from point {first} on has no point of this run")
        if count > self.kept.rows or (first <= self.received < first + count and not self._fits(first + count)):
            last = (first + count - 1) * self.link.step_points
            raise ProtocolBroken(
                f"'{self.link.source}' sends its values up to point {last} to {self._target}, more than was granted",
                instance=self.link.source,
                point=first * self.link.step_points,
                hint="Does another process send messages with its name?",
            )
        if first > self.received:
            missing, last = self.received * self.link.step_points, first * self.link.step_points - 1
            text = f"points {missing} to {last} of '{self.link.source}' never reached {self._target}"
            raise FrameGap(text, instance=self.link.source, point=missing)
        if first < self.received:
            known = min(self.received - first, count)
            self._compare(first, known, rows)
            if known == count:
                return None
            first, rows = first + known, tuple(part[known:] for part in rows)
        self._keep(first, rows)
        self.received = first + len(rows[0])
        return first, rows

    def _keep(self, first: int, rows: Rows) -> None:
        kept = self.kept
        start, count = first & kept.mask, len(rows[0])
        cut = min(count, kept.rows - start)
        for part, new in zip(kept.parts, rows, strict=True):
            part[start : start + cut] = new[:cut]
            part[: count - cut] = new[cut:]

    def _compare(self, first: int, known: int, rows: Rows) -> None:
        """A row that is received again must have the same bits; this is checked for the rows that are still kept."""
        for row in range(max(0, self.received - self.kept.rows - first), known):
            slot = (first + row) & self.kept.mask
            kept = [_bits(part, slot) for part in self.kept.parts]
            if kept != [_bits(part, row) for part in rows]:
                raise FrameGap(
                    f"the values of '{self.link.source}' came twice and differ",
                    instance=self.link.source,
                    point=(first + row) * self.link.step_points,
                    hint="Two processes publish as this instance: end one of them.",
                )


def _bits(array: NDArray[Any], row: int) -> bytes | list[str | bytes]:
    """What must be equal in two rows: the bits of numbers, which distinguish -0.0 from 0.0, and the texts."""
    if array.dtype == object:
        texts: list[str | bytes] = array[row].tolist()
        return texts
    bits: bytes = array[row].tobytes()
    return bits


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
