"""The sending end of a link: makes frames from an output ring. The receiving end is `fmu_mesh.wire.frames`."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from ..errors import FmuMeshError
from ..rings.ring import Ring
from ..system.layout import Layout
from ..system.plan import RECORDER, Link
from ..system.window import lazy_frame_rows
from ..variables.value_types import Value
from ..wire.messages import FRAME, HEADER, INITIAL, LAST
from ..wire.rows import encode_frames, encode_rows

__all__ = ["OutLink"]

_FRAME_BYTES = 32 * 1024
_FRAME_POINTS = 1024
_LAZY_FRAME_BYTES = 128 * 1024


class OutLink:
    """Sends the rows of one instance to one node; a frame holds all rows since the last one.

    Attributes:
        sent: own steps sent so far; the next frame starts at this step.
        capacity: rows after which a frame is full.
        lazy: whether no step needs these rows, so that they may be sent a little later than others.
    """

    def __init__(self, link: Link, outputs: Ring, put: Callable[[bytes], None], window: int) -> None:
        self.link = link
        self.sent = 0
        self.lazy = link.target_node == RECORDER
        if self.lazy:
            rows, size = lazy_frame_rows(window), _LAZY_FRAME_BYTES
        else:
            # A quarter of the window: the consumer can step on these rows while the next grant is on its way.
            rows, size = min(_FRAME_POINTS, max(1, window // (4 * link.step_points))), _FRAME_BYTES
        self.capacity = max(1, min(rows, size // max(link.layout.row_size, 1)))
        self._outputs = outputs
        self._put = put
        self._picks = _picks(outputs.layout, link.layout)

    def flush(self, end: int) -> None:
        """Send the rows of own steps ``sent .. end - 1``."""
        first = self.sent
        if first >= end:
            return
        ring = self._outputs
        if end - first > ring.rows:
            lost = end - ring.rows - first
            text = f"{lost} rows for {self.link.target_node} were overwritten before they were sent"
            raise FmuMeshError(text, instance=self.link.source, point=first * self.link.step_points)
        while first < end:
            start = first & ring.mask
            cut = min(end - first, ring.rows - start)
            end_slot = start + cut
            rows = tuple(
                ring.parts[part][start:end_slot] if picked is None else ring.parts[part][start:end_slot, picked]
                for part, picked in self._picks
            )
            for message in encode_frames(FRAME, self.link.index, first, rows):
                self._put(message)
            first += cut
        self.sent = end

    def send_last(self, end: int) -> None:
        """The run ends early: send the remaining rows up to own step ``end - 1``, and that no more will come."""
        self.flush(end)
        self._put(HEADER.pack(LAST, self.link.index, 0, end))

    def send_initial(self, tag: int, values: Mapping[str, Value]) -> None:
        """Send the values of one level of Initialization Mode; ``tag`` is its number, and other columns are zero."""
        row = Ring(self.link.layout, 1)
        for name in row.layout.names:
            if name in values:
                row.put(0, name, values[name])
        self._put(encode_rows(INITIAL, self.link.index, tag, row.parts))


def _picks(have: Layout, want: Layout) -> list[tuple[int, list[int] | None]]:
    """For each wanted part: its number in the ring, and the elements to pick, or None if all are wanted."""
    types = [part.type for part in have.parts]
    picks: list[tuple[int, list[int] | None]] = []
    for part in want.parts:
        number = types.index(part.type)
        places = [have.place(column.name) for column in part.columns]
        elements = [element for place in places for element in range(place.first, place.first + place.size)]
        picks.append((number, None if len(elements) == have.parts[number].width else elements))
    return picks
