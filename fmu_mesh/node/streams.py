"""Streams: every value of a variable as a Zenoh sample. Without subscribers there is no work.

The main thread only copies the subscribed columns of new rows; the server thread encodes and publishes them. A
subscriber that stops loses samples (their points show which), and does not slow down the mesh.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from operator import itemgetter
from typing import Any, Final

import numpy as np
import zenoh
from numpy.typing import NDArray
from zenoh.handlers import Callback

from ..simtime import TimeGrid
from ..variables.model_description import Variable
from ..wire.keys import Keys, VariableKind, unescape
from ..wire.session import matches, subscribed, undeclare_all
from ..wire.values import attachment, encode_value, json_encoding
from .stepping import Runner

__all__ = ["MAX_WAITING_ROWS", "PRIORITY", "Batch", "InstanceStreams", "VariableKeys", "kind_of"]

MAX_WAITING_ROWS = 1 << 14
_MAX_WAITING_VALUES = 1 << 20
"""Somebody may subscribe to all 60,000 variables of an FMU: their rows would need gigabytes."""

PRIORITY = zenoh.Priority.DATA_LOW
"""Frames and grants must not wait behind samples for subscribers."""

_KINDS: Final[dict[str, VariableKind]] = {
    "output": "out",
    "input": "in",
    "parameter": "param",
    "calculatedParameter": "param",
    "local": "local",
}

Batch = tuple["InstanceStreams", NDArray[np.intp], list[tuple[zenoh.KeyExpr, NDArray[Any]]]]
"""Streams, own steps, and the values of each key."""


def kind_of(variable: Variable) -> VariableKind | None:
    """The part of the key space a variable lives in; None for the independent variable."""
    return _KINDS.get(variable.causality)


class VariableKeys:
    """The keys of the variables of one instance."""

    def __init__(self, keys: Keys, runner: Runner) -> None:
        self._keys = keys
        self._runner = runner
        self._root = f"{keys.instance(runner.name)}/"
        self.every = zenoh.KeyExpr(f"{self._root}*/*")

    def matching(self, asked: zenoh.KeyExpr) -> Iterator[tuple[str, Variable]]:
        """(key, variable) of all variables that a key expression matches; fast if it is one key, or nothing matches."""
        description, text = self._runner.instance.description, str(asked)
        if not asked.intersects(self.every):
            return
        name = unescape(text.rpartition("/")[2])
        own = (description.variable(name),) if "*" not in text else description.variables
        everything = asked.includes(self.every)
        for variable in own:
            if variable is None or (kind := kind_of(variable)) is None:
                continue
            key = self._keys.variable(self._runner.name, kind, variable.name)
            if everything or key == text or ("*" in text and asked.intersects(zenoh.KeyExpr(key))):
                yield key, variable


class InstanceStreams:
    """The streams of one instance.

    One publisher for all variables tells whether somebody may listen. Only then `look` finds out to what, so that
    nothing is declared for a variable (an FMU may have 60,000).

    Args:
        changed: called on a thread of Zenoh when the instance gets its first or loses its last subscriber.
    """

    def __init__(
        self, runner: Runner, session: zenoh.Session, keys: Keys, grid: TimeGrid, changed: Callable[[], None]
    ) -> None:
        self.runner = runner
        self._session = session
        self._keys = VariableKeys(keys, runner)
        self._dropped = 0
        self._grid = grid
        self._next = 0
        self._subscribed: frozenset[str] = frozenset()
        self._wanted: dict[str, zenoh.KeyExpr] = {}
        self._active: dict[str, zenoh.KeyExpr] = {}
        self._publisher = session.declare_publisher(
            self._keys.every, priority=PRIORITY, allowed_destination=zenoh.Locality.REMOTE
        )
        notice: Callback[Any] = Callback(lambda _status: changed(), indirect=False)  # without a thread
        self._listener: zenoh.MatchingListener[Any] = self._publisher.declare_matching_listener(notice)

    @property
    def is_followed(self) -> bool:
        """Whether somebody subscribes to something that may be a variable of this instance."""
        return matches(self._publisher)

    def look(self) -> bool:
        """Find the variables that have subscribers, for `update`; return whether they are others than before."""
        subscribed_now = subscribed(self._session, str(self._keys.every)) if self.is_followed else frozenset()
        if subscribed_now == self._subscribed:
            return False
        matching = [pair for asked in subscribed_now for pair in self._keys.matching(zenoh.KeyExpr(asked))]
        self._wanted = {variable.name: zenoh.KeyExpr(key) for key, variable in sorted(matching, key=itemgetter(0))}
        self._subscribed = subscribed_now  # last: the main thread may look as well
        return True

    def update(self) -> None:
        """On the main thread, between steps: from now on, read the variables that have subscribers."""
        active = self._wanted
        if active.keys() == self._active.keys():
            return
        watched = tuple(name for name in active if name not in self.runner.outputs.layout)
        if {*watched} != {*(self.runner.watched.layout.names if self.runner.watched is not None else ())}:
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
        if waiting_rows > min(MAX_WAITING_ROWS, _MAX_WAITING_VALUES // len(self._active)):
            self._dropped += end - first
            return None
        steps = np.arange(first, end)
        return self, steps, [(key, self._column(name, steps)) for name, key in self._active.items()]

    def _column(self, name: str, steps: NDArray[np.intp]) -> NDArray[Any]:
        ring = self.runner.outputs
        if name not in ring.layout and self.runner.watched is not None:
            ring = self.runner.watched
        part, first, size, shape = ring.layout.place(name)
        values: NDArray[Any] = ring.parts[part][steps & ring.mask, first : first + size]
        return values.reshape(len(steps), *shape)

    def publish(self, steps: NDArray[np.intp], columns: list[tuple[zenoh.KeyExpr, NDArray[Any]]]) -> None:
        """On the server's thread: publish what `collect` returned."""
        put = partial(
            self._session.put,
            encoding=json_encoding,
            congestion_control=zenoh.CongestionControl.DROP,
            priority=PRIORITY,
            allowed_destination=zenoh.Locality.REMOTE,
        )
        lists = [(key, column.tolist()) for key, column in columns]
        for offset, point in enumerate((steps * self.runner.plan.step_points).tolist()):
            stamp = attachment(point, self._grid.time(point))
            for key, values in lists:
                put(key, encode_value(values[offset]), attachment=stamp)

    def take_dropped(self) -> int:
        """Number of rows that were dropped since the last call."""
        dropped, self._dropped = self._dropped, 0
        return dropped

    def close(self) -> None:
        """Undeclare the publisher."""
        undeclare_all([self._listener, self._publisher])
