"""Follows what a mesh publishes until the mesh ends.

Owns the detection of that end: the liveliness token of the master disappears, also if the master is killed.
"""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Callable, Collection, Iterator
from contextlib import ExitStack, suppress
from types import TracebackType
from typing import Generic, Self, TypeVar

import zenoh
from zenoh.handlers import Callback

from ...errors import DeadlineExceeded, MessageRefused
from ..keys import Keys
from .readings import latecomers

__all__ = ["Follower"]

Item = TypeVar("Item")

_WAITING_SAMPLES = 1 << 16


class Follower(Generic[Item]):
    """Follows a mesh as long as the `with` block lasts.

    Args:
        session: a session that reaches the mesh.
        keys: the keys of the mesh.
        on_end: called on a thread of Zenoh when the mesh ends.

    Attributes:
        arrived: what subscribers have received, in order; None marks the end of the mesh.
        there: set when the mesh was found.
    """

    def __init__(self, session: zenoh.Session, keys: Keys, on_end: Callable[[], None] = lambda: None) -> None:
        self._session = session
        self._keys = keys
        self._on_end = on_end
        self._stack = ExitStack()
        self._over = False
        self.arrived: queue.SimpleQueue[Item | None] = queue.SimpleQueue()
        self.there = threading.Event()

    def __enter__(self) -> Self:
        token = self._session.liveliness().declare_subscriber(self._keys.master, self._token_changed, history=True)
        self._stack.callback(token.undeclare)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stack.close()
        self.arrived.put(None)  # another thread may be waiting for more

    def subscribe(
        self, keys: Collection[str], decode: Callable[[zenoh.Sample], Item | None], through: str | None = None
    ) -> None:
        """From now on the samples of these keys arrive, as ``decode`` returns them; not those that it refuses.

        A reader that is much too slow loses samples, because a thread of Zenoh must not wait for it.

        Args:
            keys: what arrives.
            decode: of each sample what arrives.
            through: one key expression to subscribe to instead of each key.
        """

        def take(sample: zenoh.Sample) -> None:
            if str(sample.key_expr) not in keys or self.arrived.qsize() >= _WAITING_SAMPLES:
                return
            with suppress(MessageRefused):
                if (item := decode(sample)) is not None:
                    self.arrived.put(item)

        directly = Callback(take, indirect=False)  # no thread for each of 1,000 keys
        for key in keys if through is None else (through,):
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
        if deadline is None:
            return self.arrived.get()
        try:
            return self.arrived.get(timeout=max(0.0, deadline - time.monotonic()))
        except queue.Empty:
            raise DeadlineExceeded(f"mesh '{self._keys.mesh}' did not end in time") from None

    def _token_changed(self, sample: zenoh.Sample) -> None:
        if sample.kind == zenoh.SampleKind.PUT and not self._over:
            self.there.set()  # Zenoh may report it twice, for example if other code with this session queries tokens
        else:
            self._over = True
            self.arrived.put(None)
            self._on_end()
