"""A progress bar below the cell of a notebook, while a program waits for a run. Elsewhere nothing is shown."""

from __future__ import annotations

import html
import sys
from types import TracebackType
from typing import Any, Self

from ..simtime import ENDLESS
from ..wire.views import MeshStatus

__all__ = ["NotebookProgress"]


class NotebookProgress:
    """Shows the status of a run.

    Args:
        name: name of the mesh.
        display: the function `display` of IPython; None shows nothing.
    """

    def __init__(self, name: str, display: Any | None) -> None:  # noqa: ANN401  IPython has no types for it
        self._name = name
        self._display = display
        self._handle: Any = None

    @classmethod
    def here(cls, name: str) -> Self:
        """A progress bar if this program is a notebook, and one that shows nothing otherwise."""
        if "ipykernel" not in sys.modules:
            return cls(name, None)
        from IPython.display import display  # noqa: PLC0415  only a notebook has it

        return cls(name, display)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._handle is not None:
            self._handle.update({"text/plain": ""}, raw=True)

    def update(self, status: MeshStatus) -> None:
        """Show a status."""
        if self._display is None:
            return
        shown = {"text/html": self._html(status), "text/plain": self._text(status)}
        if self._handle is None:
            self._handle = self._display(shown, raw=True, display_id=True)
        else:
            self._handle.update(shown, raw=True)

    def _text(self, status: MeshStatus) -> str:
        of = f" of {status.last_point}" if status.last_point < ENDLESS else ""
        return f"{self._name}: {status.state}, point {status.point}{of}, {status.points_per_second:.0f} points/s"

    def _html(self, status: MeshStatus) -> str:
        bar = f"<progress value='{status.point}' max='{status.last_point}'></progress> "
        return (bar if status.last_point < ENDLESS else "") + html.escape(self._text(status))
