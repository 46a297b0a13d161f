"""The rows of one instance as whoever writes results reads them: in rings of others, and in mirrors that frames fill.

Used by the recorder, and by runs in one process. It waits for nothing.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from ..errors import ProtocolBroken
from ..results.growth import ReadColumn
from ..system.plan import Link
from ..variables.value_types import is_text
from ..wire.frames import FrameReceiver, SourceRows

__all__ = ["RecordedSource"]


class RecordedSource:
    """Rows of one instance that wait for rows of the others.

    Args:
        rows: its ring, if the recorder can read it; then the mirror for what comes in frames, if something does.
    """

    def __init__(self, link: Link, last_point: int, rows: Sequence[SourceRows], receiver: FrameReceiver | None) -> None:
        self.link = link
        self.receiver = receiver
        self.counters = [own.counter for own in rows]
        self._rings = [own.ring for own in rows]
        self._last_point = last_point

    @property
    def covered(self) -> int:
        """The last point for which the value is known; it holds until the next own point."""
        received = min(counter.value for counter in self.counters) * self.link.step_points
        return self._last_point if received > self._last_point else received - 1

    def check(self, first: int, end: int) -> None:
        """The rows for the points first to end - 1 are complete.

        Raises:
            ProtocolBroken: one is not.
        """
        low, high = first // self.link.step_points, (end - 1) // self.link.step_points + 1
        wanted = np.arange(low + 1, high + 1)
        for ring in self._rings:
            mask = ring.mask
            slots = slice(low & mask, (high - 1 & mask) + 1) if self.link.step_points == 1 else (wanted - 1) & mask
            wrong = ring.stamps[slots] != wanted
            if wrong.any():
                raise ProtocolBroken(
                    f"a row of '{self.link.source}' for the recorder is not the one that was written",
                    instance=self.link.source,
                    point=(low + int(wrong.argmax())) * self.link.step_points,
                    hint="Does another process write to the memory of this run?",
                )

    def memory(self, first: int, end: int) -> Iterator[memoryview]:
        """The bytes of own rows ``first .. end - 1``, of a source without text."""
        return (self._rings[0].memory(slots) for _, slots in self._rings[0].pieces(first, end))

    def column(self, variable: str) -> ReadColumn:
        """A function that returns the values of a variable at the points first to end - 1, without wrap-around."""
        ring = self._rings[-1 if is_text(self.link.layout.column(variable).type) else 0]
        step_points, place, mask = self.link.step_points, ring.layout.place(variable), ring.mask
        values = ring.parts[place.part][:, place.first]
        if step_points == 1:
            return lambda first, end: values[first & mask :][: end - first]
        return lambda first, end: values[(np.arange(first, end) // step_points) & mask]
