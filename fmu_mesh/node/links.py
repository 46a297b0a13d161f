"""The sending end of a link: makes frames from an output ring. The receiving end is `fmu_mesh.wire.frames`."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from ..errors import FmuMeshError
from ..rings.ring import Ring
from ..rings.transfer import Index, elements_at
from ..system.layout import Layout
from ..system.plan import RECORDER, Link
from ..variables.value_types import Value
from ..wire.frames import encode_frames, encode_rows
from ..wire.messages import FRAME, HEADER, INITIAL, LAST

__all__ = ["OutLink"]

# Threads: the main thread sends between bursts; during a step that lasts long, the thread of the server does, because
# other nodes may wait for the rows before it, and they must not be lost if this process dies in the step. Both hold
# `Engine.sending`, so a row is never sent twice or in the wrong order. A put may block: that is how a receiver that
# is stopped holds its sender, and it ends with the deadline of the link (ADR 4).
#
# Why one link for each pair of instance and node, and not one frame for all: in a cycle the other node needs each row
# at once, the recorder may get hundreds in one frame (ADR 1).

_FRAME_BYTES = 128 * 1024


class OutLink:
    """Sends rows of one instance to one node; a frame holds all rows since the last one.

    Its frames have the columns of ``layout``, none where the target reads the ring itself. The next frame starts at the
    own step ``sent``.
    """

    def __init__(self, link: Link, layout: Layout, outputs: Ring, put: Callable[[bytes], None]) -> None:
        self.link = link
        self.sent = 0
        self.to_recorder = link.target_node == RECORDER
        self._rows = max(1, _FRAME_BYTES // max(layout.row_size, 1))
        self._outputs = outputs
        self._put = put
        # Without frames, its columns may be none of the outputs that are read in the steps.
        self._picked = [] if link.initial_only else _picked(outputs.layout, layout)

    @property
    def has_frames(self) -> bool:
        """Whether it sends rows at all."""
        return bool(self._picked)

    def begin_at(self, step: int) -> None:
        """The run begins with a state after so many own steps: the rows before were never there."""
        self.sent = step

    def flush(self, end: int) -> None:
        """Send the rows of own steps ``sent .. end - 1``."""
        ring, first = self._outputs, self.sent
        if self._picked and end - first > ring.rows:
            text = f"{end - ring.rows - first} rows for {self.link.target_node} were overwritten before they were sent"
            raise FmuMeshError(text, instance=self.link.source, point=first * self.link.step_points)
        for start, slots in ring.pieces(first, end, self._rows) if self._picked else ():
            rows = tuple(ring.parts[part][slots, own] for part, own in self._picked)
            for message in encode_frames(FRAME, self.link.index, start, rows):
                self._put(message)
            self.sent = start + slots.stop - slots.start

    def send_again(self, end: int) -> None:
        """Send all rows again that are still there; the target knows which it has."""
        self.sent = max(0, min(self.sent, end - self._outputs.rows + 1))
        self.flush(end)

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


def _picked(have: Layout, want: Layout) -> list[tuple[int, Index]]:
    """For each part of the wanted columns: its number in a ring with the columns ``have``, and its elements there."""
    numbers = {part.type: number for number, part in enumerate(have.parts)}
    picked = []
    for part in want.parts:
        places = [have.place(column.name) for column in part.columns]
        picked.append((numbers[part.type], elements_at([p.first for p in places], [p.size for p in places])))
    return picked
