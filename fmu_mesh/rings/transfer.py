"""Moving values from rows of a source to rows of a target, with the factor and the offset of a connection.

Which row a step reads is `fmu_mesh.system.coupling_rule`. Frames from another node and rings of the same process go
the same way.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..system.coupling_rule import CouplingRule
from ..system.layout import Layout
from ..system.plan import Feed
from .ring import Ring, Rows

__all__ = ["Transfer"]

Index = slice | NDArray[np.intp]


class Transfer:
    """Copies the columns of one feed into the input ring of its target.

    Args:
        feed: the source, the delay and the columns.
        source_layout: columns of the source's rows, in a ring or in a frame.
        inputs: the input ring of the target.
        source_points: base points per step of the source.
        target_points: base points per step of the target.
    """

    def __init__(
        self, feed: Feed, source_layout: Layout, inputs: Ring, *, source_points: int, target_points: int
    ) -> None:
        self.feed = feed
        self._inputs = inputs
        self._rule = CouplingRule(feed.delay, source_points, target_points)
        self._same_rate = source_points == target_points
        self._copies = _copies(feed, source_layout, inputs)

    def ready(self, rows: int) -> int:
        """See `CouplingRule.steps_ready`."""
        return self._rule.steps_ready(rows)

    def from_rows(self, first: int, rows: Rows) -> None:
        """Feed all steps of the target that ``rows`` of the source feed; the first of them is row ``first``."""
        low, high = self.ready(first), self.ready(first + len(rows[0]))
        if low >= high:
            return
        if self._same_rate:
            skip = self._rule.row_for(low) - first
            picked: Index = slice(skip, skip + high - low)
        else:
            picked = self._rule.row_for(np.arange(low, high)) - first
        self._write(low, high, tuple(part[picked] for part in rows))

    def from_ring(self, source: Ring, low: int, high: int) -> None:
        """Feed own steps ``low .. high - 1`` of the target from the rows of ``source``."""
        slots = self._rule.row_for(np.arange(low, high)) & source.mask
        self._write(low, high, tuple(part[slots] for part in source.parts))

    def stepper(self, source: Ring) -> Callable[[int], None]:
        """A function that feeds one own step of the target from ``source``; faster than `from_ring` for a single row.

        Single numbers of one type go through memory views: the bits are the same, and a copy takes a fraction of the
        time.
        """
        if self._same_rate and all(copy.is_one_number(source) for copy in self._copies):
            lead = self._rule.row_for(0)
            steppers = [copy.stepper(source, lead, self._inputs.mask) for copy in self._copies]
            if len(steppers) == 1:
                return steppers[0]

            def step_each(step: int) -> None:
                for feed in steppers:
                    feed(step)

            return step_each
        row_for = self._rule.row_for

        def step_rows(step: int) -> None:
            slot = row_for(step) & source.mask
            target = step & self._inputs.mask
            for copy in self._copies:
                values = source.parts[copy.source_part][slot]
                copy.part[target, copy.columns] = copy.convert(values[copy.source_columns])

        return step_rows

    def _write(self, low: int, high: int, rows: Rows) -> None:
        """Write rows of own steps ``low .. high - 1``, in two pieces where the ring wraps."""
        size, mask = self._inputs.rows, self._inputs.mask
        start = low & mask
        cut = min(high - low, size - start)
        for copy in self._copies:
            values = copy.convert(rows[copy.source_part][:, copy.source_columns])
            copy.part[start : start + cut, copy.columns] = values[:cut]
            if cut < high - low:
                copy.part[: high - low - cut, copy.columns] = values[cut:]


class _Copy:
    """Columns of one part of the source rows for columns of one part of the target ring."""

    def __init__(
        self, source_part: int, source_columns: Index, part: NDArray[Any], columns: Index, scale: tuple[Any, Any] | None
    ) -> None:
        self.source_part = source_part
        self.source_columns = source_columns
        self.part = part
        self.columns = columns
        self.scale = scale

    def is_one_number(self, source: Ring) -> bool:
        """Whether this copies one number that Python does not change; a Float32 would become a Float64 on the way."""
        if not (isinstance(self.source_columns, slice) and isinstance(self.columns, slice)):
            return False
        single = self.columns.stop - self.columns.start == 1
        dtype = source.parts[self.source_part].dtype
        return single and dtype == self.part.dtype and dtype not in (np.float32, np.object_)

    def stepper(self, source: Ring, lead: int, mask: int) -> Callable[[int], None]:
        """As `Transfer.stepper`, if `is_one_number`; step n reads row ``n + lead``."""
        have, want = source.parts[self.source_part], self.part
        values, inputs = have.reshape(-1).data, want.reshape(-1).data
        assert isinstance(self.source_columns, slice)
        assert isinstance(self.columns, slice)
        first, width, source_mask = self.source_columns.start, have.shape[1], source.mask
        own_first, own_width = self.columns.start, want.shape[1]
        if self.scale is None:

            def step_one(step: int) -> None:
                inputs[(step & mask) * own_width + own_first] = values[((step + lead) & source_mask) * width + first]

            return step_one
        factor, offset = float(self.scale[0][0]), float(self.scale[1][0])

        def step_scaled(step: int) -> None:
            inputs[(step & mask) * own_width + own_first] = (
                values[((step + lead) & source_mask) * width + first] * factor + offset
            )

        return step_scaled

    def convert(self, values: NDArray[Any]) -> NDArray[Any]:
        """``values * factor + offset`` in Float64, with one rounding each; for a Float32 the result is rounded again.

        The assignment that follows converts between types; `check` refuses connections that would lose something.
        """
        if self.scale is None:
            return values
        factor, offset = self.scale
        scaled: NDArray[Any] = values * factor + offset
        if self.part.dtype == np.float32:
            with np.errstate(over="ignore"):
                return scaled.astype(np.float32)
        return scaled


def _copies(feed: Feed, source: Layout, inputs: Ring) -> list[_Copy]:
    """Group the columns by part of source and target, and by whether they are scaled.

    An unscaled column is not multiplied by 1.0, so it keeps every bit, also of a NaN.
    """
    groups: dict[tuple[int, int, bool], list[tuple[int, int, float, float]]] = {}
    for source_name, target_name, factor, offset in feed.columns:
        have, want = source.place(source_name), inputs.layout.place(target_name)
        scaled = (factor, offset) != (1.0, 0.0)
        group = groups.setdefault((have.part, want.part, scaled), [])
        group += [(have.first + place, want.first + place, factor, offset) for place in range(want.size)]
    copies = []
    for (source_part, target_part, scaled), columns in groups.items():
        scale = (np.array([c[2] for c in columns]), np.array([c[3] for c in columns])) if scaled else None
        sources, targets = _index([c[0] for c in columns]), _index([c[1] for c in columns])
        copies.append(_Copy(source_part, sources, inputs.parts[target_part], targets, scale))
    return copies


def _index(columns: Sequence[int]) -> Index:
    """A slice if the columns are consecutive, because numpy copies it faster; otherwise an index array."""
    if list(columns) == list(range(columns[0], columns[0] + len(columns))):
        return slice(columns[0], columns[0] + len(columns))
    return np.array(columns, dtype=np.intp)
