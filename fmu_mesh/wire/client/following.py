"""Follows what a mesh publishes: `Follower` until the mesh ends, `ValueStream` a changing set of variables.

Owns the detection of that end: the liveliness token of the master disappears, also if the master is killed. And what is
lost where values come faster than they are taken: `Follower`, whose variables stay the same, keeps the oldest,
`ValueStream` the newest.
"""

from __future__ import annotations

import queue
import threading
import time
from collections import deque
from collections.abc import Callable, Collection, Iterator
from contextlib import ExitStack, suppress
from functools import partial
from typing import Generic, Self, TypeVar

import zenoh
from zenoh.handlers import Callback

from ...errors import DeadlineExceeded, MessageRefused
from ...files import decoded_json
from ..keys import Keys
from ..views import GOING_ON, MeshStatus
from .readings import Reading, Target, latecomers, reading_of

__all__ = ["COMES_BACK_S", "Follower", "ValueStream"]

# Threads: those of Zenoh put samples (`take`, `arrived`) and the loss of the token; any other thread takes them.
# Callbacks are `indirect=False`: a thread for each of 1,000 keys would be too many, so they only store, and never
# wait; of what is stored there is a limit. The token may be reported as gone before samples that were sent earlier
# have arrived (another priority, another thread), so the end is only the end after `latecomers`. And Zenoh may report
# one token twice: a mesh that has ended does not begin again for the same follower (ADR 67 on lost tokens). A mesh that
# may start again says so in its status: then a thread waits for its token, and ends the follower if none comes (ADR
# 87).

Item = TypeVar("Item")

_WAITING_SAMPLES = 1 << 16
COMES_BACK_S = 30.0
"""For how long in s a mesh that may start again counts as one that comes back after its master was lost."""


class Follower(Generic[Item]):
    """Follows a mesh as long as the `with` block lasts; ``on_end`` is called on a thread of Zenoh when the mesh ends.

    The queue ``arrived`` has what subscribers have received, in order, and None at the end of the mesh.
    """

    def __init__(self, session: zenoh.Session, keys: Keys, on_end: Callable[[], None] = lambda: None) -> None:
        self._session = session
        self._keys = keys
        self._on_end = on_end
        self._stack = ExitStack()
        self._over = False
        self._may_restart = False
        self._back: threading.Event | None = None  # set when the master is there again
        self.arrived: queue.SimpleQueue[Item | None] = queue.SimpleQueue()
        self.there = threading.Event()

    def __enter__(self) -> Self:
        token = self._session.liveliness().declare_subscriber(self._keys.master, self._token_changed, history=True)
        self._stack.callback(token.undeclare)
        seen = Callback(self._status_came, indirect=False)
        self._stack.callback(self._session.declare_subscriber(self._keys.mesh_key("status"), seen).undeclare)
        return self

    def __exit__(self, *_error: object) -> None:
        self._stack.close()
        self._stop_waiting()
        self.arrived.put(None)  # another thread may be waiting for more

    def subscribe(
        self,
        keys: Collection[str],
        decode: Callable[[zenoh.Sample], Item | None],
        through: Collection[str] | None = None,
    ) -> None:
        """From now on the samples of these keys arrive, as ``decode`` returns them; not those that it refuses.

        A reader that is much too slow loses samples, because a thread of Zenoh must not wait for it. ``through`` are
        the key expressions to subscribe to instead of each key.
        """

        def take(sample: zenoh.Sample) -> None:
            if str(sample.key_expr) not in keys or self.arrived.qsize() >= _WAITING_SAMPLES:
                return
            with suppress(MessageRefused):
                if (item := decode(sample)) is not None:
                    self.arrived.put(item)

        directly = Callback(take, indirect=False)  # no thread for each of 1,000 keys
        for key in keys if through is None else through:
            self._stack.callback(self._session.declare_subscriber(key, directly).undeclare)

    def to_the_last(self, deadline: float | None = None) -> Iterator[Item]:
        """Everything that arrives until the mesh has ended, and shortly after, unless the mesh starts again.

        Raises:
            DeadlineExceeded: the mesh has not ended before the monotonic time ``deadline`` in s.
        """
        while (item := self._next(deadline)) is not None:
            yield item
        for late in latecomers(self.arrived):
            if late is None:
                return
            yield late

    def _next(self, deadline: float | None) -> Item | None:
        try:
            return self.arrived.get(timeout=None if deadline is None else max(0.0, deadline - time.monotonic()))
        except queue.Empty:
            raise DeadlineExceeded(f"mesh '{self._keys.mesh}' did not end in time") from None

    def _token_changed(self, sample: zenoh.Sample) -> None:
        if sample.kind == zenoh.SampleKind.PUT and not self._over:
            self.there.set()  # Zenoh may report it twice, for example if other code with this session queries tokens
            self._stop_waiting()
        elif self._may_restart and not self._over:
            if self._back is None or self._back.is_set():
                self._back = threading.Event()
                wait = partial(self._wait, self._back)
                threading.Thread(target=wait, name="waits for a master", daemon=True).start()
        else:
            self._end()

    def _status_came(self, sample: zenoh.Sample) -> None:
        with suppress(ValueError):
            status = decoded_json(sample.payload.to_bytes(), MeshStatus)
            self._may_restart = status.may_restart and status.state in GOING_ON
            if not self._may_restart and self._back is not None and not self._back.is_set():
                self._end()

    def _wait(self, back: threading.Event) -> None:
        if not back.wait(COMES_BACK_S):
            self._end()

    def _end(self) -> None:
        self._over = True
        self._stop_waiting()
        self.arrived.put(None)
        self._on_end()

    def _stop_waiting(self) -> None:
        if self._back is not None:
            self._back.set()


class ValueStream:
    """Values as they come, as long as the `with` block lasts; from any thread. Over ``limit`` the oldest are lost."""

    def __init__(self, session: zenoh.Session, limit: int) -> None:
        self._session = session
        self._waiting: deque[tuple[Target, zenoh.Sample]] = deque(maxlen=limit)
        self._limit = limit
        self._lost = 0
        self._lock = threading.Lock()
        self._arrived = threading.Event()
        self._subscribers: dict[str, zenoh.Subscriber[None]] = {}

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_error: object) -> None:
        for key in list(self._subscribers):
            self._subscribers.pop(key).undeclare()

    def follow(self, target: Target) -> None:
        """From now on values of this variable arrive; twice is as once."""
        if target.key in self._subscribers:
            return

        def arrived(sample: zenoh.Sample) -> None:
            if str(sample.key_expr) == target.key:
                with self._lock:
                    self._lost += len(self._waiting) == self._limit
                    self._waiting.append((target, sample))
                    self._arrived.set()

        directly = Callback(arrived, indirect=False)  # no thread for each variable
        self._subscribers[target.key] = self._session.declare_subscriber(target.key, directly)

    def leave(self, target: Target) -> None:
        """From now on no value of this variable arrives."""
        if (subscriber := self._subscribers.pop(target.key, None)) is not None:
            subscriber.undeclare()

    def wake(self) -> None:
        """Let `take` return."""
        self._arrived.set()

    def take(self, timeout_s: float) -> list[tuple[Target, Reading]]:
        """What has arrived since the last call, the oldest first; waits for it for at most ``timeout_s`` seconds."""
        self._arrived.wait(timeout_s)
        with self._lock:
            self._arrived.clear()
            taken = list(self._waiting)
            self._waiting.clear()
        readings = [(target, reading_of(target, sample)) for target, sample in taken]
        return [(target, reading) for target, reading in readings if reading is not None]

    def take_lost(self) -> int:
        """Number of values that were lost since the last call."""
        with self._lock:
            lost, self._lost = self._lost, 0
        return lost
