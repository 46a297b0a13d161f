"""A live cell: a widget in a notebook that draws values of a mesh while it runs. Imports anywidget, an extra.

Threads: one takes the values as fast as they come, and one sends a picture to the page a few times a second, so that a
slow page never holds back the values, nor the mesh. Both end with the mesh, and when the widget or the `Run` is closed.
The page gets all that it draws each time, and its size is bounded: one that is opened late shows the same.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Sequence
from pathlib import Path

import anywidget
import numpy as np
import traitlets
from numpy.typing import NDArray

from ..errors import CallRefused, FmuMeshError
from ..text import listed
from ..wire.client.mesh_client import MeshClient
from ..wire.client.readings import Target
from .samples import Sample, Watch, targets_of

__all__ = ["LiveView", "live_view"]

_EVERY_S = 0.25
_JOIN_S = 5.0
_CURVES = 10
_SECTIONS = 400
"""Of a long curve, the least and the largest value of so many sections of time are drawn."""
_ROWS = 8 * _SECTIONS
"""So many values of a curve are kept before they are put into sections."""


def live_view(client: MeshClient, names: Sequence[str]) -> LiveView:
    """As `Run.view`."""
    found = [
        target
        for target in targets_of(client, *(names or ["*"]))
        if not (target.variable.shape or target.variable.type in ("String", "Binary"))
        and (names or target.variable.causality == "output")
    ]
    if not found or (names and len(found) > _CURVES):
        many = f"{len(found)} numbers match, and a live cell draws at most {_CURVES}"
        raise CallRefused(many if found else "no number matches", hint="Name what is to be drawn.")
    return LiveView(client, found[:_CURVES])


class LiveView(anywidget.AnyWidget):
    """A live cell; `Run.view` makes it."""

    _esm = Path(__file__).with_name("live_view.js").read_text(encoding="utf-8")
    curves: traitlets.List[dict[str, object]] = traitlets.List().tag(sync=True)
    state = traitlets.Unicode("waiting").tag(sync=True)

    def __init__(self, client: MeshClient, targets: Sequence[Target]) -> None:
        super().__init__()
        self._mesh = client.keys.mesh
        self._curves = {target.name: _Curve(target) for target in targets}
        self._watch = Watch(client, targets)
        self._over = threading.Event()
        works = self._take_values, self._send_pictures
        self._threads = [threading.Thread(target=work, daemon=True) for work in works]
        for thread in self._threads:
            thread.start()

    def __repr__(self) -> str:
        return f"<LiveView of {self._mesh}: {listed([*self._curves])}, {self.state}>"

    def stop(self) -> None:
        """Draw nothing more; what is drawn stays."""
        self._watch.close()
        for thread in self._threads:
            thread.join(_JOIN_S)

    def close(self) -> None:
        """As `stop`, and remove the cell."""
        self.stop()
        super().close()

    def _take_values(self) -> None:
        try:
            for sample in self._watch:
                self._curves[sample.name].add(sample)
        except FmuMeshError:
            pass  # the mesh is gone, which whoever waits for the run is told
        finally:
            self._over.set()

    def _send_pictures(self) -> None:
        ended = False
        while not ended:
            ended = self._over.wait(_EVERY_S)
            with self.hold_sync():
                self.state = "ended" if ended else "running"
                self.curves = [curve.drawn() for curve in self._curves.values()]


class _Curve:
    """The values of one variable: those that are new, and before them the sections of those that were."""

    def __init__(self, target: Target) -> None:
        view = target.variable
        self._head = {"name": target.name, "unit": view.unit or "", "held": view.variability != "continuous"}
        self._lock = threading.Lock()
        self._times: list[float] = []
        self._values: list[float] = []
        self._last, self._step, self._now = 0, 0, ""

    def add(self, sample: Sample) -> None:
        value, passed = float(sample.value), sample.point - self._last
        lost = 0 < self._step < passed  # no line is drawn over values that were lost
        if self._now and passed:
            self._step = min(passed, self._step or passed)
        with self._lock:
            self._times += [sample.time] * (1 + lost)
            self._values += [math.nan] * lost + [value if math.isfinite(value) else math.nan]
            if len(self._times) >= _ROWS:
                self._times, self._values = _in_sections(np.array(self._times), np.array(self._values))
            self._last, self._now = sample.point, f"{value:.5g}"

    def drawn(self) -> dict[str, object]:
        with self._lock:
            return {**self._head, "now": self._now, "points": np.array([self._times, self._values]).tobytes()}


def _in_sections(times: NDArray[np.float64], values: NDArray[np.float64]) -> tuple[list[float], list[float]]:
    """Two rows for each section: its least and its largest value; NaN where values were lost in all of it.

    Rows are at regular times, so a later section that has none is one without values.
    """
    edges = np.linspace(times[0], times[-1], 2 * _SECTIONS + 1)[:-1]
    section = np.searchsorted(edges[::2], times, side="right") - 1
    least, largest = np.full((2, _SECTIONS), np.nan)
    np.fmin.at(least, section, values)
    np.fmax.at(largest, section, values)
    rows = np.stack([least, largest], axis=1)
    falling = np.gradient(least + largest) < 0.0
    rows[falling] = rows[falling, ::-1]  # otherwise a curve that falls is a saw
    return edges.tolist(), rows.ravel().tolist()
