"""Long calls of many steps in pieces, between which somebody may end them: of copies on threads, or in processes."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Final

from ..instances.process_state import ProcessState
from ..node.engine import STATE_CHECK_S

__all__ = ["Pieces"]

_PIECE_S: Final = 0.05
"""About how long in s a piece takes: then somebody may end the call."""

_MANY_POINTS: Final = 4096


class Pieces:
    """Takes long calls in pieces of about 50 ms, and looks after the state of the process after them."""

    def __init__(self) -> None:
        self._points = 1
        self._looked_after: ProcessState | None = None
        self._look_at = 0.0

    def step(self, points: int, is_asked: Callable[[], bool], take: Callable[[int], object]) -> bool:
        """Take a step over so many points; whether it has changed the state of the process, which is restored."""
        self._looked_after = self._looked_after or ProcessState()
        try:
            self.take(points, is_asked, take)
        finally:
            is_changed = False
            if (now := time.perf_counter()) >= self._look_at:
                self._look_at = now + STATE_CHECK_S
                is_changed = self._looked_after.restore()
        return is_changed

    def take(self, points: int, is_asked: Callable[[], bool], take: Callable[[int], object]) -> None:
        """Take a step over so many points in pieces, which change nothing of this process."""
        while points > 0 and not is_asked():
            piece, began = min(points, self._points), time.perf_counter()
            take(piece)
            points -= piece
            took_s = time.perf_counter() - began
            if took_s < _PIECE_S / 2 and piece == self._points:
                self._points = min(2 * piece, _MANY_POINTS)
            elif took_s > _PIECE_S:
                self._points = max(1, self._points // 2)
