"""The newest values of a changing set of variables.

Owns what is lost when values come faster than they are taken: the oldest. `MeshClient.watch` keeps those instead, and
its variables are the same until it ends.
"""

from __future__ import annotations

import threading
from collections import deque
from types import TracebackType
from typing import Self

import zenoh
from zenoh.handlers import Callback

from .mesh_client import MeshClient
from .readings import Reading, Target, reading_of

__all__ = ["ValueStream"]


class ValueStream:
    """Values as they come, as long as the `with` block lasts; from any thread.

    Args:
        client: the way into the mesh.
        limit: number of values that wait at most; of more, the oldest are lost.
    """

    def __init__(self, client: MeshClient, limit: int) -> None:
        self._session = client.session
        self._waiting: deque[tuple[Target, zenoh.Sample]] = deque(maxlen=limit)
        self._limit = limit
        self._lost = 0
        self._lock = threading.Lock()
        self._arrived = threading.Event()
        self._subscribers: dict[str, zenoh.Subscriber[None]] = {}

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
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
