"""A live cell: a widget in a notebook that draws chosen values of a mesh while it runs. Imports anywidget, an extra.

Threads: one takes the values as fast as they come, and one sends a picture to the page a few times a second, so that a
slow page never holds back the values, nor the mesh. Both end with the mesh, and when the widget or the `Run` is closed.
The page gets a picture of bounded size each time, so one that is opened late, or twice, shows the same.
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

__all__ = ["LiveView"]

_EVERY_S = 0.25
_JOIN_S = 5.0
_CURVES = 10
_SECTIONS = 400
"""Of a long curve, the least and the largest value of so many sections of time are drawn."""
_ROWS = 8 * _SECTIONS
"""So many values of a curve are kept before they are put into sections."""


class LiveView(anywidget.AnyWidget):
    """A live cell; `Run.view` makes it.

    Args:
        client: the way into the mesh.
        names: variables, or patterns; none: the outputs.

    Raises:
        UnknownName: there is no such variable.
        CallRefused: too many of them, or none of them, are numbers.
    """

    _esm = Path(__file__).with_name("live_view.js").read_text(encoding="utf-8")
    curves: traitlets.List[dict[str, object]] = traitlets.List().tag(sync=True)
    state = traitlets.Unicode("waiting").tag(sync=True)

    def __init__(self, client: MeshClient, names: Sequence[str]) -> None:
        found = [target for target in targets_of(client, *(names or ["*"])) if _is_drawn(target, names)]
        if not found or (names and len(found) > _CURVES):
            text = (
                f"{len(found)} numbers match, and a live cell draws at most {_CURVES}" if found else "no number matches"
            )
            raise CallRefused(text, hint="Name what is to be drawn.")
        super().__init__()
        self._mesh = client.keys.mesh
        self._curves = {target.name: _Curve(target) for target in found[:_CURVES]}
        self._watch = Watch(client, found[:_CURVES])
        self._over = threading.Event()
        self._threads = [
            threading.Thread(target=work, daemon=True) for work in (self._take_values, self._send_pictures)
        ]
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
        """The first thread."""
        try:
            for sample in self._watch:
                self._curves[sample.name].add(sample)
        except FmuMeshError:
            pass  # the mesh is gone, which whoever waits for the run is told
        finally:
            self._over.set()

    def _send_pictures(self) -> None:
        """The second thread."""
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
        with self._lock:
            self._now = f"{value:.5g}"
            if self._step and passed > self._step:  # values were lost, and no line is drawn over them
                self._append(sample.time, math.nan)
            self._append(sample.time, value if math.isfinite(value) else math.nan)
            if len(self._times) >= _ROWS:
                self._times, self._values = _in_sections(np.array(self._times), np.array(self._values))
        if len(self._times) > 1 and passed > 0:
            self._step = min(passed, self._step or passed)
        self._last = sample.point

    def drawn(self) -> dict[str, object]:
        with self._lock:
            return {**self._head, "now": self._now, "points": np.array([self._times, self._values]).tobytes()}

    def _append(self, time: float, value: float) -> None:
        self._times.append(time)
        self._values.append(value)


def _in_sections(times: NDArray[np.float64], values: NDArray[np.float64]) -> tuple[list[float], list[float]]:
    """Two rows for each section: its least and its largest value; NaN where values were lost in all of it."""
    edges = np.linspace(times[0], times[-1], 2 * _SECTIONS + 1)[:-1]
    section = np.searchsorted(edges[::2], times, side="right") - 1
    least, largest = np.full((2, _SECTIONS), np.nan)
    np.fmin.at(least, section, values)
    np.fmax.at(largest, section, values)
    return edges.tolist(), np.stack([least, largest], axis=1).ravel().tolist()


def _is_drawn(target: Target, names: Sequence[str]) -> bool:
    """Whether a variable is one number; without names, whether it is an output, too."""
    view = target.variable
    return not view.shape and view.type not in ("String", "Binary") and (bool(names) or view.causality == "output")
