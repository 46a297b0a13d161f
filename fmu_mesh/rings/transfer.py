"""Moving values from a row of a source into the row of inputs of a target, with factor and offset, or the map.

Which row a step reads is `fmu_mesh.system.coupling_rule`. The burst moves numbers by tables (`moves`); the same moves
in Python are `step`, which is also the only way for text.
"""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..system.feeds import Feed, FeedColumn
from ..variables.value_types import is_text
from .native import NUMBER_TYPES, Change, Lookup, Move, RowBase
from .ring import Ring
from .value_change import ValueChange

__all__ = ["Index", "Transfer", "elements_at"]

# Threads: only the one that steps the target (of a node the main thread) calls a `Transfer`. What it reads is a row
# that another process or thread has written: it is complete because its counter was read before (acquire, see
# docs/rings.md), and it stays because the window of the writer ends before this slot comes again. A forged counter or
# a broken window is found by the stamp of the row: by the burst after it has copied, in Python by `Ring.has_row`.
#
# Two implementations on purpose: the burst moves numbers by `moves`, `step` does the same in Python where the library
# is missing, and for text, which has no fixed size in a ring. That both give the same bits is tested for all types.
# So `step` may not be simplified by arithmetic that rounds otherwise: factor and offset are one multiplication and
# one addition in Float64. Tried and given up: code that is compiled for each transfer (ADR 57), and values that
# travel as messages, which were copied seven times on their way (ADR 58).

Index = slice | NDArray[np.intp]


class Transfer:
    """The columns of one feed: with ``text`` True only those with text, with False those with numbers; None is all.

    The ``rule`` says which row of the source a step needs.
    """

    def __init__(self, feed: Feed, source: Ring, inputs: Ring, *, target: str, text: bool | None = None) -> None:
        self.feed, self.target = feed, target
        self.source = source
        self.rule = feed.rule
        self.columns = [
            column
            for column in feed.columns
            if text is None or is_text(inputs.layout.column(column.target).type) == text
        ]
        self._inputs = inputs
        self._changes = [
            ValueChange.of_column(feed.source, target, inputs.layout.column(column.target).type, column)
            for column in self.columns
        ]
        self._copies = _copies(self.columns, self._changes, source, inputs)
        self._checked = [
            (column.source, change)
            for column, change in zip(self.columns, self._changes, strict=True)
            if change.is_checked(source.layout.column(column.source).type)
        ]
        self._lookups = {
            column: Lookup.of(dict(column.map), [number for _, number in column.items])
            for column in self.columns
            if column.map or column.items
        }

    def step(self, step: int) -> None:
        """Move the values for own step ``step`` of the target; raises as `check_range` does."""
        if self._checked:
            self.check_range(step)
        slot = self.rule.row_for(step) & self.source.mask
        for copy in self._copies:
            values = copy.convert(self.source.parts[copy.source_part][slot][copy.source_columns])
            if copy.adds:
                copy.part[0, copy.columns] += values
            else:
                copy.part[0, copy.columns] = values

    def check_range(self, step: int) -> None:
        """Check the values for own step ``step``: the burst ends where one does not fit, and does not say which one.

        Raises:
            StepFailed: an input cannot be the number that its output is.
        """
        row = self.rule.row_for(step)
        for source_name, change in self._checked:
            change.of(self.source.value(row, source_name))

    def step_text(self, step: int) -> None:
        """As `step`, for the columns with text."""
        slot = self.rule.row_for(step) & self.source.mask
        for copy in self._copies:
            if copy.part.dtype == np.object_:
                copy.part[0, copy.columns] = self.source.parts[copy.source_part][slot][copy.source_columns]

    @property
    def has_text(self) -> bool:
        """Whether there is a column with text."""
        return any(copy.part.dtype == np.object_ for copy in self._copies)

    def moves(self, base: int) -> list[Move]:
        """The moves of the numbers, from the row ``base`` of the burst."""
        moves = []
        for column in self.columns:
            have, want = self.source.layout.place(column.source), self._inputs.layout.place(column.target)
            lookup = self._lookups.get(column)
            from_type = self.source.layout.parts[have.part].type
            to_type = self._inputs.layout.parts[want.part].type
            if is_text(from_type):
                continue
            moves.append(
                Move(
                    from_base=base,
                    from_=self.source.place_in_row(have.part, have.first),
                    to_base=RowBase.FIXED,
                    to=self._inputs.address + self._inputs.place_in_row(want.part, want.first),
                    count=want.size,
                    from_type=NUMBER_TYPES[from_type],
                    to_type=NUMBER_TYPES[to_type],
                    change=Change.LOOKED_UP if lookup is not None else _change_of(column),
                    factor=column.factor,
                    offset=column.offset,
                    lookup=ctypes.addressof(lookup) if lookup is not None else None,
                )
            )
        return moves


class _Copy(NamedTuple):
    """Columns of one part of the source rows for columns of one part of the row of inputs."""

    source_part: int
    source_columns: Index
    part: NDArray[Any]
    columns: Index
    scale: tuple[Any, Any] | None
    change: ValueChange | None
    adds: bool

    def convert(self, values: NDArray[Any]) -> NDArray[Any]:
        """``values * factor + offset`` in Float64, with one rounding each; for a Float32 the result is rounded again.

        The assignment that follows converts between types; `check` refuses connections that would lose something.
        """
        if self.change is not None:
            return np.array(self.change.of(values.tolist()), self.part.dtype)
        if self.scale is None:
            return values
        factor, offset = self.scale
        scaled: NDArray[Any] = values * factor + offset
        if self.part.dtype == np.float32:
            with np.errstate(over="ignore"):
                return scaled.astype(np.float32)
        return scaled


def _change_of(column: FeedColumn) -> Change:
    if column.adds:
        return Change.ADDED
    return Change.UNCHANGED if (column.factor, column.offset) == (1.0, 0.0) else Change.SCALED


def _copies(columns: Sequence[FeedColumn], changes: Sequence[ValueChange], source: Ring, inputs: Ring) -> list[_Copy]:
    """Group the columns by part of source and target, and by whether they are scaled; a column with a map is alone.

    So is one that adds, after the group with the value that it is added to; and it keeps its place among such columns.
    An unscaled column is not multiplied by 1.0, so it keeps every bit, also of a NaN.
    """
    groups: dict[tuple[int, int, Change, int], list[tuple[int, int, int, float, float]]] = {}
    for number, column in enumerate(columns):
        have, want = source.layout.place(column.source), inputs.layout.place(column.target)
        key = (Change.LOOKED_UP, number) if column.map else (_change_of(column), number if column.adds else -1)
        group = groups.setdefault((have.part, want.part, *key), [])
        group.append((have.first, want.first, want.size, column.factor, column.offset))
    copies = []
    for (source_part, target_part, kind, number), group in groups.items():
        have_first, want_first, sizes, factors, offsets = zip(*group, strict=True)
        is_scaled, adds = kind in {Change.SCALED, Change.ADDED}, kind == Change.ADDED
        scale = (np.repeat(factors, sizes), np.repeat(offsets, sizes)) if is_scaled else None
        sources, targets = elements_at(have_first, sizes), elements_at(want_first, sizes)
        change = changes[number] if kind == Change.LOOKED_UP else None
        copies.append(_Copy(source_part, sources, inputs.parts[target_part], targets, scale, change, adds))
    return sorted(copies, key=lambda copy: copy.adds)


def elements_at(first: Sequence[int], sizes: Sequence[int]) -> Index:
    """The elements of several places in a part: a slice if they are consecutive, because numpy copies it faster."""
    ends = [start + size for start, size in zip(first, sizes, strict=True)]
    if [*first[1:]] == ends[:-1]:
        return slice(first[0], ends[-1])
    return np.concatenate([np.arange(start, end) for start, end in zip(first, ends, strict=True)])
