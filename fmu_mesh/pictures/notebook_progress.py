"""Waits for a run or a sweep; in a notebook, a progress bar is below the cell meanwhile."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from concurrent.futures import Future
from typing import Any, NamedTuple, TypeVar

from ..errors import DeadlineExceeded
from ..simtime import ENDLESS
from ..wire.views import MeshStatus
from .tables import escaped

__all__ = ["ShownProgress", "awaited", "progress_of"]

# Five times a second a bar moves smoothly, and drawing it does not slow down the run.
_REDRAW_S = 0.2

Ended = TypeVar("Ended")


class ShownProgress(NamedTuple):
    """How far something is: in words, and as a part of a total, which may be unknown."""

    text: str
    done: int
    total: int | None

    @property
    def html(self) -> str:
        """A bar with the words."""
        bar = f"<progress value='{self.done}' max='{self.total}'></progress> " if self.total is not None else ""
        return bar + escaped(self.text)


def progress_of(name: str, status: MeshStatus) -> ShownProgress:
    """How far the run of the mesh with this name is."""
    total = status.last_point if status.last_point < ENDLESS else None
    of = f" of {total}" if total is not None else ""
    text = f"{name}: {status.state}, point {status.point}{of}, {status.points_per_second:.0f} points/s"
    return ShownProgress(text, status.point, total)


def awaited(
    future: Future[Ended], timeout: float | None, what: str, progress: Callable[[], ShownProgress | None]
) -> Ended:
    """The result of a run or a sweep, when it has ended; ``what`` names it in an error.

    Raises:
        DeadlineExceeded: it goes on after this time in s.
        BaseException: the error with which it has ended.
    """
    end = time.monotonic() + timeout if timeout is not None else None
    display, bar = _display(), None
    try:
        while True:
            left = _REDRAW_S if end is None else min(_REDRAW_S, end - time.monotonic())
            try:
                return future.result(max(left, 0.0))
            except TimeoutError:
                if future.done():
                    raise  # an error that happens to be of this class
                if end is not None and time.monotonic() >= end:
                    text = f"{what} has not ended within {timeout:g} s"
                    raise DeadlineExceeded(text, hint="It goes on; wait again, or end it.") from None
            if display is None or (now := progress()) is None:
                continue
            shown = {"text/html": now.html, "text/plain": now.text}
            if bar is None:
                bar = display(shown, raw=True, display_id=True)
            else:
                bar.update(shown, raw=True)
    finally:
        if bar is not None:
            bar.update({"text/plain": ""}, raw=True)


def _display() -> Any | None:  # noqa: ANN401  IPython has no types for it
    """The function `display` of IPython if this program is a notebook."""
    shell = sys.modules["IPython"].get_ipython() if "IPython" in sys.modules else None
    if not hasattr(shell, "kernel"):  # a terminal has none, and a program that imports ipykernel has no shell
        return None
    from IPython.display import display  # noqa: PLC0415  only a notebook has it

    return display
