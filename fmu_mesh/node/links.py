"""The sending end of a link: frames out of an output ring. The receiving end is `fmu_mesh.wire.frames`."""

from __future__ import annotations

import numpy as np
import zenoh

from ..model.plan import LAZY_ROWS, RECORDER, Link
from ..model.ring import Ring
from ..wire.messages import FRAME, INITIAL, encode_rows

__all__ = ["OutLink"]

_FRAME_BYTES = 32 * 1024
_FRAME_POINTS = 256


class OutLink:
    """Sends the rows of one instance to one node; a frame holds all rows since the last one.

    Attributes:
        sent: own steps sent so far; the next frame starts here.
        capacity: rows after which a frame is full.
        lazy: whether nobody steps on these rows, so that they may wait a little when others are sent.
    """

    def __init__(self, link: Link, outputs: Ring, publisher: zenoh.Publisher, window: int) -> None:
        self.link = link
        self.sent = 0
        self.lazy = link.target_node == RECORDER
        # A quarter of the window, so that the consumer has work while the credit for more is on its way.
        by_window = LAZY_ROWS // 2 if self.lazy else max(1, window // (4 * link.step_points))
        self.capacity = max(1, min(_FRAME_POINTS, _FRAME_BYTES // max(link.layout.row_size, 1), by_window))
        self._outputs = outputs
        self.publisher = publisher
        self._put = publisher.put
        self._reals = _columns(outputs.layout.reals, link.layout.reals)
        self._integers = _columns(outputs.layout.integers, link.layout.integers)

    def flush(self, end: int) -> None:
        """Send the rows of own steps ``sent .. end - 1``."""
        first = self.sent
        if first >= end:
            return
        ring = self._outputs
        while first < end:
            start = first & ring.mask
            cut = min(end - first, ring.rows - start)
            reals = ring.reals[start : start + cut]
            integers = ring.integers[start : start + cut]
            self._put(
                encode_rows(
                    FRAME,
                    self.link.index,
                    first,
                    reals if self._reals is None else reals[:, self._reals],
                    integers if self._integers is None else integers[:, self._integers],
                )
            )
            first += cut
        self.sent = end

    def send_initial(self, tag: int, values: dict[str, float | int]) -> None:
        """Send the values of one level of Initialization Mode, which ``tag`` tells; other columns are zero."""
        layout = self.link.layout
        reals = np.array([[values.get(name, 0.0) for name in layout.reals]], dtype=np.float64)
        integers = np.array([[values.get(name, 0) for name in layout.integers]], dtype=np.int32)
        self._put(encode_rows(INITIAL, self.link.index, tag, reals, integers))

    def close(self) -> None:
        """Undeclare the publisher."""
        self.publisher.undeclare()


def _columns(have: tuple[str, ...], want: tuple[str, ...]) -> list[int] | None:
    """Indices of the wanted columns, or None if all are wanted."""
    return None if have == want else [have.index(name) for name in want]
