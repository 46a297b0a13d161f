"""Streams: every value of a variable as a Zenoh sample; a subscriber that is too slow loses some, and sees which."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import cached_property, partial
from itertools import groupby
from os.path import commonprefix
from typing import Any, Final, NamedTuple

import numpy as np
import zenoh
from numpy.typing import NDArray
from zenoh.handlers import Callback

from ..rings.ring import Ring
from ..simtime import TimeGrid
from ..variables.model_description import Variable
from ..variables.value_types import nested
from ..wire.keys import Keys, VariableKind, escape, unescape
from ..wire.session import matches, undeclare_all
from ..wire.values import attachment, encode_value, json_encoding
from .stepping import Runner

__all__ = ["PRIORITY", "InstanceStreams", "RowsFor", "VariableKeys", "WaitingRows", "kind_of"]

# Threads: the main thread calls `update`, `collect` and reads `_active`; the thread of the server calls `look`,
# `look_at` and `publish`, and owns `_wanted` and `_search`; a thread of Zenoh calls `changed`, which only puts a job.
# `update` takes `_wanted` in one assignment, and `collect` copies rows, so nobody waits for anybody: a slow
# subscriber loses samples, and never slows down a step.
#
# What may go wrong (ADR 77): while the declaration of a key ends, Zenoh loses a value that arrives with this key, and
# after 65,536 declarations it mistakes one key of a session for another. So what `look` has asked for stays declared.
#
# Tried and given up (ADR 68): a publisher and a listener for each variable (a thread of zenoh-python for each of
# 60,000), a listener without them (declaring takes time that grows with the square), and the list of subscribers in
# the admin space (a session that answers it while another one subscribes can stand for ever, zenoh 1.10).

_MAX_WAITING_ROWS = 1 << 14
_AT_ONCE: Final = 512
_BACKLOG: Final = 1 << 16
"""So many values are published in one job; and where so many wait, publishing gets a share of the time."""

_MAX_WAITING_VALUES = 1 << 20
"""Somebody may subscribe to all 60,000 variables of an FMU: their rows would need gigabytes."""

_MOST_DECLARED: Final = 1 << 12
"""Keys that stay declared; each takes longer than the one before. Those beyond them count as subscribed."""

PRIORITY = zenoh.Priority.DATA_LOW
"""Frames and grants must not wait behind samples for subscribers."""

_KINDS: Final[dict[str, VariableKind]] = {
    "output": "out",
    "input": "in",
    "parameter": "param",
    "calculatedParameter": "param",
    "local": "local",
}


_NO_VARIABLE = "%"
"""No name of a variable ends so in a key, where `%` begins the number of a character."""


class Picked(NamedTuple):
    """The variables of one type in one ring that have subscribers.

    Attributes:
        part: the array of the ring that has them.
        elements: their elements there.
        keys: of each variable its key, or what else it is for, the number of its elements, and its shape.
    """

    ring: Ring
    part: int
    elements: NDArray[np.intp]
    keys: list[tuple[Any, int, tuple[int, ...]]]


class WaitingRows(NamedTuple):
    """Who publishes them, own steps, and their rows."""

    streams: RowsFor
    steps: NDArray[np.intp]
    blocks: list[tuple[Picked, NDArray[Any]]]

    def parts(self) -> tuple[WaitingRows, WaitingRows]:
        """As many rows as are published without a look at what else is to do, and the others."""
        count = max(1, _AT_ONCE // max(1, sum(block.shape[1] for _, block in self.blocks)))
        part = [(picked, block[:count]) for picked, block in self.blocks]
        rest = [(picked, block[count:]) for picked, block in self.blocks]
        return WaitingRows(self.streams, self.steps[:count], part), WaitingRows(self.streams, self.steps[count:], rest)


def kind_of(variable: Variable) -> VariableKind | None:
    """The part of the key space a variable lives in; None for the independent variable."""
    return _KINDS.get(variable.causality)


class VariableKeys:
    """The keys of the variables of one instance."""

    def __init__(self, keys: Keys, runner: Runner) -> None:
        self._keys = keys
        self._runner = runner
        self.root = f"{keys.instance(runner.name)}/"
        self.every = zenoh.KeyExpr(f"{self.root}*/*")

    def key(self, variable: Variable) -> str | None:
        """The key of a variable; None for the independent variable."""
        kind = kind_of(variable)
        return self._keys.variable(self._runner.name, kind, variable.name) if kind is not None else None

    def matching(self, asked: zenoh.KeyExpr) -> Iterator[tuple[str, Variable]]:
        """(key, variable) of all variables that a key expression matches; fast if it is one key, or nothing matches."""
        description, text = self._runner.instance.description, str(asked)
        if not asked.intersects(self.every):
            return
        name = unescape(text.rpartition("/")[2])
        own = (description.variable(name),) if "*" not in text else description.variables
        everything = asked.includes(self.every)
        for variable in own:
            if variable is None or (key := self.key(variable)) is None:
                continue
            if everything or key == text or ("*" in text and asked.intersects(zenoh.KeyExpr(key))):
                yield key, variable


class RowsFor:
    """Hands the rows of one instance to whoever publishes the values of some of its variables.

    Attributes:
        backlog: where more rows wait, publishing gets a share of the time; set by the main thread, and read by that of
            the server, too.
        most_waiting: where more rows wait, they are dropped.
    """

    def __init__(self, runner: Runner) -> None:
        self.runner = runner
        self.backlog = self.most_waiting = 0
        self._dropped = self._next = 0
        self._active: Mapping[str, Any] = {}
        self._picked: list[Picked] = []

    def _pick(self, wanted: Mapping[str, Any]) -> None:
        """On the main thread, between steps: from now on read these variables, which are in rings."""
        if not self._active:
            self._next = self.runner.step
        self._active = wanted
        most = max(1, len(wanted))
        self.backlog = min(_MAX_WAITING_ROWS // 2, _BACKLOG // most)
        self.most_waiting = min(_MAX_WAITING_ROWS, _MAX_WAITING_VALUES // most)
        rings = [ring for ring in (self.runner.outputs, self.runner.watched) if ring is not None]
        self._picked = [picked for ring in rings for picked in _picked(ring, wanted)]

    @property
    def is_active(self) -> bool:
        """On the main thread: whether `collect` has something to do."""
        return bool(self._active)

    def skip(self) -> None:
        """On the main thread: begin with the newest row."""
        self._next = self.runner.step

    def collect(self, waiting_rows: int) -> WaitingRows | None:
        """On the main thread: the rows since the last call, copied; None if there is nothing to publish."""
        end, watched = self.runner.step + 1, self.runner.watched
        first = max(self._next, end - (watched.rows if watched is not None else end))
        if not self._active or first >= end:
            return None
        self._dropped += first - self._next
        self._next = end
        watched = self.runner.watched
        kept = min(self.runner.outputs.rows, watched.rows if watched is not None else end)
        self._dropped += max(0, end - kept - first)
        first = max(first, end - kept)  # older rows are overwritten
        if waiting_rows > self.most_waiting:
            self._dropped += end - first
            return None
        steps = np.arange(first, end)
        rows = [(own, own.ring.parts[own.part][np.ix_(steps & own.ring.mask, own.elements)]) for own in self._picked]
        return WaitingRows(self, steps, rows)

    def publish(self, steps: NDArray[np.intp], blocks: list[tuple[Picked, NDArray[Any]]]) -> None:
        """Publish what `collect` returned."""
        raise NotImplementedError

    def take_dropped(self) -> int:
        """Number of rows that were dropped since the last call."""
        dropped, self._dropped = self._dropped, 0
        return dropped


class InstanceStreams(RowsFor):
    """The streams of one instance.

    One publisher for all variables tells whether somebody may listen. Only then `look` finds out to what, so that
    nothing is declared for a variable (an FMU may have 60,000). ``changed`` is called on a thread of Zenoh when the
    instance gets its first or loses its last subscriber. ``declared`` has the keys that all streams of this session
    have asked for.
    """

    def __init__(  # noqa: PLR0913, PLR0917  one instance and its surroundings
        self,
        runner: Runner,
        session: zenoh.Session,
        keys: Keys,
        grid: TimeGrid,
        changed: Callable[[], None],
        declared: dict[str, zenoh.KeyExpr],
    ) -> None:
        super().__init__(runner)
        self._session = session
        self._keys = VariableKeys(keys, runner)
        self._declared = declared
        self._grid = grid
        self._wanted: dict[str, zenoh.KeyExpr] = {}
        self._rests = False
        self._search: tuple[list[str], Iterator[str | None]] | None = None
        self._publisher = session.declare_publisher(
            self._keys.every, priority=PRIORITY, allowed_destination=zenoh.Locality.REMOTE
        )
        notice: Callback[Any] = Callback(lambda _status: changed(), indirect=False)  # without a thread
        self._listener: zenoh.MatchingListener[Any] = self._publisher.declare_matching_listener(notice)

    @property
    def is_followed(self) -> bool:
        """Whether somebody subscribes to something that may be a variable of this instance."""
        return matches(self._publisher)

    def look(self, seconds: float | None = None) -> bool:
        """On the server's thread: find the variables that have subscribers; return whether `update` is due.

        Go on with the present search for some ``seconds``; without them, search anew, to the end.
        """
        end = time.monotonic() + (seconds if seconds is not None else math.inf)
        if seconds is None or self._search is None or not self.is_followed:
            chunks = self._chunks if self.is_followed else {}
            self._search = [], (key for root, own in chunks.items() for key in self._subscribed(root, own))
        keys, search = self._search
        for key in search:
            if key is not None:
                keys.append(key)
            if time.monotonic() > end:
                return False
        before, self._wanted = self._wanted, {unescape(key.rpartition("/")[2]): zenoh.KeyExpr(key) for key in keys}
        self._search = None
        return before.keys() != self._wanted.keys()

    def look_at(self, names: Iterable[str]) -> bool:
        """On the server's thread: find those of these variables that have subscribers, as `look` does."""
        variables = [self.runner.instance.description.variable(name) for name in names]
        keys = {v.name: self._keys.key(v) for v in variables if v is not None and v.name not in self._wanted}
        found = {name: zenoh.KeyExpr(key) for name, key in keys.items() if key is not None and self._is_subscribed(key)}
        self._wanted = {**self._wanted, **found}
        self._search = None  # it may have passed them already
        return bool(found)

    def _subscribed(self, root: str, chunks: Sequence[str]) -> Iterator[str | None]:
        """The keys with one of these sorted last chunks that have subscribers, found by their first letters.

        Of many variables few have subscribers. The admin space has a list of them, but a session that is asked for it
        while another one subscribes can block for ever (zenoh 1.10). After each question, None is a chance to pause.
        """
        common = commonprefix([chunks[0], chunks[-1]])  # noqa: RUF071  they are no paths
        if not self._is_subscribed(root + (chunks[0] if len(chunks) == 1 else f"{common}$*" if common else "*")):
            yield None
        elif len(chunks) == 1 or self._is_subscribed(f"{root}{common}{_NO_VARIABLE}"):  # by a wildcard
            yield from (root + chunk for chunk in chunks)
        else:
            for _, group in groupby(chunks, key=lambda chunk: chunk[len(common) : len(common) + 1]):
                yield from self._subscribed(root, [*group])

    def _is_subscribed(self, key: str) -> bool:
        if key not in self._declared:
            if len(self._declared) >= _MOST_DECLARED:
                return True
            self._declared[key] = self._session.declare_keyexpr(key)
        own, remote = self._declared[key], zenoh.Locality.REMOTE
        with self._session.declare_publisher(own, allowed_destination=remote) as publisher:
            return matches(publisher)

    @cached_property
    def _chunks(self) -> dict[str, list[str]]:
        """The last chunks of the keys of all variables, sorted, by what is before them."""
        names: dict[str, list[str]] = {}
        for variable in self.runner.instance.description.variables:
            if (kind := kind_of(variable)) is not None:
                names.setdefault(f"{self._keys.root}{kind}/", []).append(escape(variable.name))
        return {root: sorted(chunks) for root, chunks in names.items()}

    def update(self) -> None:
        """On the main thread, between steps: from now on, read the variables that have subscribers."""
        if (wanted := self._wanted).keys() != self._active.keys():
            self._read(wanted)

    def _read(self, wanted: Mapping[str, Any]) -> None:
        watched = tuple(name for name in wanted if name not in self.runner.outputs.layout)
        if {*watched} != {*(self.runner.watched.layout.names if self.runner.watched is not None else ())}:
            self.runner.watch(watched)
        self._rests = False
        self._pick(wanted)

    def collect(self, waiting_rows: int) -> WaitingRows | None:
        """As `RowsFor.collect`; what would be dropped is not read either: an FMU may take long to give many values."""
        batch = super().collect(waiting_rows if not self._rests else self.most_waiting + 1)
        if self._rests and waiting_rows <= self.backlog:
            self._read(self._active)
        elif waiting_rows > self.most_waiting and self.runner.watched is not None:
            self.runner.watch(())
            self._rests = True
        return batch

    def publish(self, steps: NDArray[np.intp], blocks: list[tuple[Picked, NDArray[Any]]]) -> None:
        """On the server's thread: publish what `collect` returned."""
        put = partial(
            self._session.put,
            encoding=json_encoding,
            congestion_control=zenoh.CongestionControl.DROP,
            priority=PRIORITY,
            allowed_destination=zenoh.Locality.REMOTE,
        )
        lists = [(picked.keys, block.tolist()) for picked, block in blocks]
        for offset, point in enumerate((steps * self.runner.plan.step_points).tolist()):
            stamp = attachment(point, self._grid.time(point))
            for keys, rows in lists:
                row, first = rows[offset], 0
                for key, size, shape in keys:
                    put(key, encode_value(nested(row[first : first + size], shape)), attachment=stamp)
                    first += size

    def close(self) -> None:
        """Undeclare the publisher."""
        undeclare_all([self._listener, self._publisher])


def _picked(ring: Ring, keys: Mapping[str, Any]) -> Iterator[Picked]:
    for number, part in enumerate(ring.layout.parts):
        found = [(keys[column.name], ring.layout.place(column.name)) for column in part.columns if column.name in keys]
        if found:
            elements = np.concatenate([np.arange(place.first, place.first + place.size) for _, place in found])
            yield Picked(ring, number, elements, [(key, place.size, place.shape) for key, place in found])
