"""The page at `/`: which mesh it shows, and what it says if there is none.

`mesh_page` has what is shown of a mesh.
"""

from __future__ import annotations

from typing import Final

from fastapi import Request
from nicegui import ui

from .mesh_directory import MeshDirectory
from .mesh_follower import MeshView
from .mesh_page import MeshPage

__all__ = ["register_page"]

# A status comes four times a second, so a shorter time shows nothing new.
_REDRAW_S: Final = 0.25
_BUSY_S: Final = 60.0
"""On a busy machine, a page may take this long to be made."""


def register_page(directory: MeshDirectory, *, read_only: bool) -> None:
    """Let NiceGUI serve the page at `/` to any number of browsers."""

    @ui.page("/", response_timeout=_BUSY_S)
    async def opened(request: Request) -> None:
        """A browser opens the page: `?mesh=KEY&curve=0:instance.variable` says what it shows."""
        ui.add_head_html('<link rel="stylesheet" href="/dashboard/static/dashboard.css">')
        ui.add_head_html('<script src="/dashboard/static/plots.js"></script>')
        plots: dict[str, list[str]] = {}
        for text in request.query_params.getlist("curve"):
            number, _, name = text.partition(":")
            plots.setdefault(number, []).append(name)
        content = _Content(directory, request.query_params.get("mesh"), [*plots.values()], read_only=read_only)
        await ui.context.client.connected()
        content.look()
        ui.timer(_REDRAW_S, content.look)


class _Content:
    """What is on one page: a choice of meshes above one of them.

    The key of the mesh to show first, and the curves of each plot, are what the address says; without them, the page
    chooses.
    """

    def __init__(
        self, directory: MeshDirectory, wanted: str | None, plots: list[list[str]], *, read_only: bool
    ) -> None:
        self._directory = directory
        self._plots = plots
        self._read_only = read_only
        self._page: MeshPage | None = None
        with ui.header().classes("items-center q-py-sm"):
            ui.label("fmu_mesh").classes("text-h6 fm-brand").props("role=heading aria-level=1")
            self._choice = ui.select({}, value=None, label="mesh", on_change=self._clear).props("dense dark outlined")
            self._choice.classes("fm-mesh")
            self._head = ui.row().classes("fm-line fm-head col")
        self._body = ui.column().classes("fm-content")
        with self._body:
            self._nothing = ui.label().props("role=status")
        self._wanted = wanted

    def look(self) -> None:
        """Show what is known now."""
        followers = self._directory.followers
        if [*followers] != [*self._choice.options]:
            short = [key.rpartition("/")[2] for key in followers]
            # Where two have the same name, each is shown by its key.
            names = {k: name if short.count(name) == 1 else k for k, name in zip(followers, short, strict=True)}
            value = self._choice.value if self._choice.value in followers else None
            value = value or (self._wanted if self._wanted in followers else next(iter(followers), None))
            self._choice.set_options(names, value=value)
        follower = followers.get(self._choice.value) if self._choice.value is not None else None
        view = follower.view if follower is not None else None
        if follower is None or view is None or view.info is None or view.status is None:
            self._say(view)
            return
        if self._page is None or (self._page.key, self._page.run) != (view.key, view.run):
            self._clear()
            self._nothing.set_visibility(False)
            self._page = MeshPage(follower, view, self._plots, read_only=self._read_only)
            self._page.build(self._head, self._body)
        self._page.look(view)

    def _say(self, view: MeshView | None) -> None:
        """No mesh can be shown: say why."""
        if view is None:
            text = "No mesh is running here. Start one with `fmu-mesh launch CONFIG`: it appears here."
        else:
            text = f"Mesh '{view.key}' is starting." if view.trouble is None else f"Not reached: {view.trouble}"
        self._nothing.set_text(text)
        self._nothing.set_visibility(True)

    def _clear(self) -> None:
        if self._page is not None:
            self._plots = self._page.plots if self._page.key == self._choice.value else []
            self._page.remove()
            self._page = None
