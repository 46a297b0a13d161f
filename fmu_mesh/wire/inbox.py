"""The inbox of a process: the one place where its main thread waits.

Frames, grants and progress arrive through one Zenoh FIFO channel, which no Python code on a foreign thread touches, or
through shared memory, once it is known that all who send are on this host. Everything rare (a query to serve, a lost
token, an end that was asked for) is posted by any thread and wakes the main thread up. No wait is without a deadline.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable
from types import TracebackType
from typing import Final, Protocol, Self

import zenoh
from zenoh.handlers import FifoChannel

from .messages import HEADER, WAKE
from .shared_memory import Offer, SharedInbox

__all__ = ["Inbox", "Message"]

Message = tuple[int, int, int, int, bytes]
"""Kind, link or node, count, point, and the whole message."""

_WAKE: Final = HEADER.pack(WAKE, 0, 0, 0)
_TIMER_PERIOD_S: Final = 0.05


class _Source(Protocol):
    """Where messages come from."""

    def take(self) -> bytes | None:
        """The next message if one is there."""
        ...

    def take_within(self, timeout_s: float) -> bytes | None:
        """The next message; None after ``timeout_s`` seconds or a `wake`."""
        ...

    def wake(self) -> None:
        """From any thread: let `take_within` come back."""
        ...

    def close(self) -> None:
        """Stop receiving."""
        ...


class Inbox:
    """Receives what is sent to one process.

    Args:
        session: the session of this process.
        key: key expression to subscribe to; see `Keys.inbox`.
        wake_key: a key of this node that only this process publishes on.
        capacity: messages that fit; at least as many as the senders have credit for.
        shared: shared memory that `share` changes over to; None where nothing is shared.

    Attributes:
        offer: where senders on this host find the shared memory; None where nothing is shared.
    """

    def __init__(
        self, session: zenoh.Session, key: str, wake_key: str, capacity: int, shared: SharedInbox | None = None
    ) -> None:
        self._posted: deque[Callable[[], None]] = deque()
        self._source: _Source = _ZenohSource(session, key, wake_key, capacity)
        self._take = self._source.take
        self._shared = shared
        self.offer: Offer | None = shared.offer if shared is not None else None

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def share(self) -> None:
        """From now on everything comes through shared memory; call it before the first message."""
        assert self._shared is not None
        zenoh_source, self._source = self._source, self._shared
        self._take = self._source.take
        zenoh_source.close()
        self._source.wake()  # for what was posted meanwhile

    def stash(self) -> bool:
        """For a sender that finds no room: take over what came through shared memory; whether the run is over."""
        return self._shared.stash() if self._shared is not None else False

    def post(self, action: Callable[[], None]) -> None:
        """From any thread: let the main thread run ``action`` when it next looks into the inbox."""
        self._posted.append(action)
        self._source.wake()

    def poll(self) -> Message | None:
        """The next message if one is there; runs posted actions on the way."""
        if self._posted:
            self._run_posted()
        while (data := self._take()) is not None:
            kind, number, count, point = HEADER.unpack_from(data)
            if kind != WAKE:
                return kind, number, count, point, data
        return None

    def wait(self, timeout_s: float) -> Message | None:
        """The next message, or None after ``timeout_s`` seconds or when posted actions were run."""
        if self._run_posted():
            return None
        data = self._source.take_within(timeout_s)
        if data is not None:
            kind, number, count, point = HEADER.unpack_from(data)
            if kind != WAKE:
                return kind, number, count, point, data
        self._run_posted()
        return None

    def close(self) -> None:
        """Stop receiving."""
        self._source.close()
        if self._shared is not None:
            self._shared.close()

    def _run_posted(self) -> bool:
        """Run what was posted; whether there was anything."""
        found = bool(self._posted)
        while self._posted:
            self._posted.popleft()()
        return found


class _ZenohSource:
    """A Zenoh subscriber with a FIFO channel; a timer thread ends its waits."""

    def __init__(self, session: zenoh.Session, key: str, wake_key: str, capacity: int) -> None:
        self._subscriber = session.declare_subscriber(key, FifoChannel(capacity))
        self._recv = self._subscriber.handler.recv
        self._try_recv = self._subscriber.handler.try_recv
        self._waker = session.declare_publisher(wake_key, allowed_destination=zenoh.Locality.SESSION_LOCAL)
        self._condition = threading.Condition()
        self._deadline = float("inf")
        self._closed = False
        self._timer = threading.Thread(target=self._run_timer, name="inbox-timer", daemon=True)
        self._timer.start()

    def take(self) -> bytes | None:
        sample = self._try_recv()
        return None if sample is None else sample.payload.to_bytes()

    def take_within(self, timeout_s: float) -> bytes | None:
        self._deadline = time.monotonic() + timeout_s
        if timeout_s < _TIMER_PERIOD_S:
            with self._condition:
                self._condition.notify()
        sample = self._recv()
        self._deadline = float("inf")
        return sample.payload.to_bytes()

    def wake(self) -> None:
        with self._condition:
            if not self._closed:
                self._waker.put(_WAKE)

    def close(self) -> None:
        with self._condition:
            if self._closed:
                return
            self._closed = True
            self._condition.notify()
        self._timer.join(1.0)
        self._subscriber.undeclare()
        self._waker.undeclare()

    def _run_timer(self) -> None:
        """Put a wake message when the deadline of the current wait has passed.

        Waits that are longer than the period need not notify: the deadline is looked at once a period.
        """
        with self._condition:
            while not self._closed:
                left = self._deadline - time.monotonic()
                if left <= 0:
                    self._deadline = float("inf")
                    self._waker.put(_WAKE)
                else:
                    self._condition.wait(min(left, _TIMER_PERIOD_S))
