"""Moving values from rows of a source to rows of a target: which step needs which, and the arithmetic of a connection.

Owns the mapping of invariant 1: values are matched by instance and point, never by arrival order. Used on frames that
arrive and on rings of the same process alike.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..system.layout import Layout
from ..system.plan import Feed
from .ring import Ring, Rows

__all__ = ["Transfer"]

Index = slice | NDArray[np.intp]


class Transfer:
    """Copies the columns of one feed into the input ring of its target.

    Own step ``j`` of the target, which takes ``target_points`` base points, uses the source's value at base point
    ``j * target_points`` with a delay of 1, and ``(j + 1) * target_points`` with a delay of 0 (design, section 3). A
    source that takes ``source_points`` base points per step holds its value between them.
    """

    def __init__(
        self, feed: Feed, source_layout: Layout, inputs: Ring, *, source_points: int, target_points: int
    ) -> None:
        self.feed = feed
        self._inputs = inputs
        self._source_points = source_points
        self._target_points = target_points
        self._lead = 0 if feed.delay else target_points
        self._same_rate = source_points == target_points
        self._copies = _copies(feed, source_layout, inputs)

    def ready(self, source_steps: int) -> int:
        """How many own steps of the target are fed once the source's rows ``0 .. source_steps - 1`` are there."""
        return max(0, -(-(source_steps * self._source_points - self._lead) // self._target_points))

    def source_step(self, step: int) -> int:
        """The source's own step whose row feeds own step ``step`` of the target."""
        return (step * self._target_points + self._lead) // self._source_points

    def from_rows(self, first: int, rows: Rows) -> None:
        """Take what the source's rows from own step ``first`` on feed."""
        low, high = self.ready(first), self.ready(first + len(rows[0]))
        if low >= high:
            return
        if self._same_rate:
            skip = self.source_step(low) - first
            picked: Index = slice(skip, skip + high - low)
        else:
            steps = np.arange(low, high)
            picked = (steps * self._target_points + self._lead) // self._source_points - first
        self._write(low, high, tuple(part[picked] for part in rows))

    def from_ring(self, source: Ring, low: int, high: int) -> None:
        """Feed own steps ``low .. high - 1`` of the target from the rows of ``source``."""
        steps = np.arange(low, high)
        slots = ((steps * self._target_points + self._lead) // self._source_points) & source.mask
        self._write(low, high, tuple(part[slots] for part in source.parts))

    def stepper(self, source: Ring) -> Callable[[int], None]:
        """What feeds one own step of the target from ``source``: the cheap way for one row.

        Single numbers of one type go through memory views, which hand over the same bits several times faster.
        """
        if self._same_rate and all(copy.is_one_number(source) for copy in self._copies):
            lead = self._lead // self._source_points
            steppers = [copy.stepper(source, lead, self._inputs.mask) for copy in self._copies]
            if len(steppers) == 1:
                return steppers[0]

            def step_each(step: int) -> None:
                for feed in steppers:
                    feed(step)

            return step_each

        def step_rows(step: int) -> None:
            slot = self.source_step(step) & source.mask
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
        """Whether this is one number that Python hands over as it is; a Float32 would go through a Float64."""
        if not (isinstance(self.source_columns, slice) and isinstance(self.columns, slice)):
            return False
        single = self.columns.stop - self.columns.start == 1
        dtype = source.parts[self.source_part].dtype
        return single and dtype == self.part.dtype and dtype not in (np.float32, np.object_)

    def stepper(self, source: Ring, lead: int, mask: int) -> Callable[[int], None]:
        """As `Transfer.stepper`, for `is_one_number`; ``lead`` is how many rows the source is ahead."""
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
        """Apply factor and offset in Float64, one rounding each, as any program would; a Float32 is rounded once more.

        Types that differ are converted by the assignment that follows; `check` has seen to it that nothing is lost.
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
    """Group the columns by part of source and target, and by whether they are scaled: others stay as they are."""
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
    """A slice if the columns are consecutive, which numpy handles faster, otherwise an index array."""
    if list(columns) == list(range(columns[0], columns[0] + len(columns))):
        return slice(columns[0], columns[0] + len(columns))
    return np.array(columns, dtype=np.intp)
