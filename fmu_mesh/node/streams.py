"""Streams: every value of a variable as a Zenoh sample. Without subscribers there is no work.

The main thread only copies the subscribed columns of new rows; the server thread encodes and publishes them. A
subscriber that stops loses samples (their points show which), and does not slow down the mesh.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Final

import numpy as np
import zenoh
from numpy.typing import NDArray

from ..simtime import TimeGrid
from ..variables.model_description import Variable
from ..wire.keys import Keys, VariableKind
from ..wire.session import matches, undeclare_all
from ..wire.values import attachment, encode_value, json_encoding
from .stepping import Runner

__all__ = ["MAX_WAITING_ROWS", "PRIORITY", "Batch", "InstanceStreams", "kind_of"]

MAX_WAITING_ROWS = 1 << 14

PRIORITY = zenoh.Priority.DATA_LOW
"""Frames and grants must not wait behind samples for subscribers."""

_KINDS: Final[dict[str, VariableKind]] = {
    "output": "out",
    "input": "in",
    "parameter": "param",
    "calculatedParameter": "param",
    "local": "local",
}

Batch = tuple["InstanceStreams", NDArray[np.intp], dict[str, NDArray[Any]]]
"""Streams, own steps, and the values by variable name."""


def kind_of(variable: Variable) -> VariableKind | None:
    """The part of the key space a variable lives in; None for the independent variable."""
    return _KINDS.get(variable.causality)


class InstanceStreams:
    """The streams of one instance.

    Args:
        changed: called on a thread of Zenoh when a variable gets its first or loses its last subscriber.
    """

    def __init__(
        self,
        runner: Runner,
        session: zenoh.Session,
        keys: Keys,
        grid: TimeGrid,
        changed: Callable[[InstanceStreams], None],
    ) -> None:
        self.runner = runner
        self._dropped = 0
        self._grid = grid
        self._next = 0
        self._active: tuple[str, ...] = ()
        self._publishers: dict[str, zenoh.Publisher] = {}
        self._listeners: list[zenoh.MatchingListener[Any]] = []
        for variable in runner.instance.description.variables:
            kind = kind_of(variable)
            if kind is None:
                continue
            publisher = session.declare_publisher(
                keys.variable(runner.name, kind, variable.name),
                encoding=json_encoding,
                congestion_control=zenoh.CongestionControl.DROP,
                priority=PRIORITY,
                allowed_destination=zenoh.Locality.REMOTE,
            )
            self._publishers[variable.name] = publisher
            self._listeners.append(publisher.declare_matching_listener(lambda _status: changed(self)))

    def update(self) -> None:
        """On the main thread, between steps: find the variables that have subscribers, and read them from now on."""
        active = tuple(name for name, publisher in self._publishers.items() if matches(publisher))
        if active == self._active:
            return
        watched = tuple(name for name in active if name not in self.runner.outputs.layout.names)
        if watched != (self.runner.watched.layout.names if self.runner.watched is not None else ()):
            self.runner.watch(watched)
        if not self._active:
            self._next = self.runner.step
        self._active = active

    def collect(self, waiting_rows: int) -> Batch | None:
        """On the main thread: the rows since the last call, copied; None if there is nothing to publish."""
        first, end = self._next, self.runner.step + 1
        if not self._active or first >= end:
            return None
        self._next = end
        watched = self.runner.watched
        kept = min(self.runner.outputs.rows, watched.rows if watched is not None else end)
        self._dropped += max(0, end - kept - first)
        first = max(first, end - kept)  # older rows are overwritten
        if waiting_rows > MAX_WAITING_ROWS:
            self._dropped += end - first
            return None
        steps = np.arange(first, end)
        return self, steps, {name: self._column(name, steps) for name in self._active}

    def _column(self, name: str, steps: NDArray[np.intp]) -> NDArray[Any]:
        ring = self.runner.outputs
        if name not in ring.layout.names and self.runner.watched is not None:
            ring = self.runner.watched
        part, first, size, shape = ring.layout.place(name)
        values: NDArray[Any] = ring.parts[part][steps & ring.mask, first : first + size]
        return values.reshape(len(steps), *shape)

    def publish(self, steps: NDArray[np.intp], columns: dict[str, NDArray[Any]]) -> None:
        """On the server's thread: publish what `collect` returned."""
        lists = [(self._publishers[name].put, column.tolist()) for name, column in columns.items()]
        for offset, point in enumerate((steps * self.runner.plan.step_points).tolist()):
            stamp = attachment(point, self._grid.time(point))
            for put, values in lists:
                put(encode_value(values[offset]), attachment=stamp)

    def take_dropped(self) -> int:
        """Number of rows that were dropped since the last call."""
        dropped, self._dropped = self._dropped, 0
        return dropped

    def close(self) -> None:
        """Undeclare all publishers."""
        undeclare_all(self._listeners, self._publishers.values())
