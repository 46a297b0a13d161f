"""The inbox of a process: the only place where its main thread waits.

Frames, grants and progress arrive through one Zenoh FIFO channel, without Python code on a thread of Zenoh, or through
shared memory, if all senders are on this host. Rare events (a query, a lost token, a request to end) are posted by any
thread and wake the main thread. Every wait has a deadline.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Mapping
from types import TracebackType
from typing import Final, Protocol, Self

import zenoh
from zenoh.handlers import FifoChannel

from ..errors import MessageRefused
from .keys import MASTER, RunKeys
from .messages import HEADER, WAKE
from .refusals import Refusals
from .shared_memory import Arrived, Offer, SharedInbox

__all__ = ["Inbox", "Message"]

Message = tuple[str, int, int, int, int, bytes]
"""Sender, kind, link, count, point, and the whole message."""

_WAKE: Final = HEADER.pack(WAKE, 0, 0, 0)
_TIMER_PERIOD_S: Final = 0.05
_NOBODY: Final = ""
"""Stands for the sender if there is no message to handle: a wake-up, or a refused message."""


class _Source(Protocol):
    """Where messages come from."""

    def take(self) -> Arrived | None:
        """The next message if one is there."""
        ...

    def take_within(self, timeout_s: float) -> Arrived | None:
        """The next message; None after ``timeout_s`` seconds or a `wake`."""
        ...

    def wake(self) -> None:
        """From any thread: let `take_within` come back."""
        ...

    def close(self) -> None:
        """Stop receiving."""
        ...


class Inbox:
    """Receives the messages for one process; until `open`, there are none, and only posted actions are run.

    Args:
        shared: the shared memory that `share` switches to; None if there is none.

    Attributes:
        offer: where senders on this host find the shared memory; None if there is none.
        refusals: counts the refused messages.
    """

    def __init__(self, shared: SharedInbox | None = None) -> None:
        self._posted: deque[Callable[[], None]] = deque()
        self._source: _Source = _Unopened()
        self._shared = shared
        self.offer: Offer | None = shared.offer if shared is not None else None
        self.refusals = Refusals()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def open(self, session: zenoh.Session, keys: RunKeys, name: str, senders: Mapping[str, str], capacity: int) -> None:
        """From now on the process ``name`` receives messages through Zenoh.

        Args:
            session: the session of this process.
            keys: the keys of the run.
            name: of the node, or of the master.
            senders: the allowed senders by their keys; a message with any other key is refused.
            capacity: number of messages that fit; at least as many as the senders may have on the way.
        """
        self._source = _ZenohSource(session, keys, name, senders, capacity, self.refusals)
        self._source.wake()  # for what was posted meanwhile

    def share(self) -> None:
        """From now on all messages come through shared memory; call it before the first message."""
        assert self._shared is not None
        zenoh_source, self._source = self._source, self._shared
        zenoh_source.close()
        self._source.wake()  # for what was posted meanwhile

    def stash(self) -> bool:
        """For a sender that waits for free space: read the shared memory empty; return whether the run is over."""
        return self._shared.stash() if self._shared is not None else False

    def post(self, action: Callable[[], None]) -> None:
        """From any thread: let the main thread run ``action`` when it next looks into the inbox."""
        self._posted.append(action)
        self._source.wake()

    def poll(self) -> Message | None:
        """The next message if there is one; also runs posted actions."""
        if self._posted:
            self._run_posted()
        while (arrived := self._source.take()) is not None:
            if (message := self._decoded(*arrived)) is not None:
                return message
        return None

    def wait(self, timeout_s: float) -> Message | None:
        """Wait for the next message; None after ``timeout_s`` seconds, or after posted actions were run."""
        if self._run_posted():
            return None
        arrived = self._source.take_within(timeout_s)
        if arrived is not None and (message := self._decoded(*arrived)) is not None:
            return message
        self._run_posted()
        return None

    def hand_on(
        self, message: Message, from_master: Callable[[Message], None], from_node: Callable[[Message], None]
    ) -> None:
        """Give a message to the handler of its sender; a message that the handler refuses is counted."""
        sender = message[0]
        try:
            (from_master if sender == MASTER else from_node)(message)
        except MessageRefused as refused:
            self.refusals.add(sender, refused.message)

    def _decoded(self, sender: str, data: bytes) -> Message | None:
        if sender == _NOBODY:
            return None
        if len(data) < HEADER.size:
            self.refusals.add(sender, f"a message of {len(data)} bytes is too short")
            return None
        kind, number, count, point = HEADER.unpack_from(data)
        return sender, kind, number, count, point, data

    def close(self) -> None:
        """Stop receiving."""
        self._source.close()
        if self._shared is not None:
            self._shared.close()

    def _run_posted(self) -> bool:
        """Run the posted actions; return whether there were any."""
        found = bool(self._posted)
        while self._posted:
            with self.refusals.guard("a query or a setting"):
                self._posted.popleft()()
        return found


class _Unopened:
    """Before `open`: there are no messages; a wait ends by its time or a wake-up."""

    def __init__(self) -> None:
        self._woken = threading.Event()

    def take(self) -> Arrived | None:
        return None

    def take_within(self, timeout_s: float) -> Arrived | None:
        self._woken.wait(timeout_s)
        self._woken.clear()
        return None

    def wake(self) -> None:
        self._woken.set()

    def close(self) -> None:
        return


class _ZenohSource:
    """A Zenoh subscriber with a FIFO channel; a timer thread ends its waits."""

    def __init__(  # noqa: PLR0913, PLR0917  as `Inbox.open`
        self,
        session: zenoh.Session,
        keys: RunKeys,
        name: str,
        senders: Mapping[str, str],
        capacity: int,
        refusals: Refusals,
    ) -> None:
        wake_key = keys.wake(name)
        self._senders = {**senders, wake_key: _NOBODY}
        self._refusals = refusals
        self._subscriber = session.declare_subscriber(keys.inbox(name), FifoChannel(capacity))
        self._recv = self._subscriber.handler.recv
        self._try_recv = self._subscriber.handler.try_recv
        self._waker = session.declare_publisher(wake_key, allowed_destination=zenoh.Locality.SESSION_LOCAL)
        self._condition = threading.Condition()
        self._deadline = float("inf")
        self._closed = False
        self._timer = threading.Thread(target=self._run_timer, name="inbox-timer", daemon=True)
        self._timer.start()

    def take(self) -> Arrived | None:
        sample = self._try_recv()
        return None if sample is None else self._from_somebody(sample)

    def take_within(self, timeout_s: float) -> Arrived | None:
        self._deadline = time.monotonic() + timeout_s
        if timeout_s < _TIMER_PERIOD_S:
            with self._condition:
                self._condition.notify()
        sample = self._recv()
        self._deadline = float("inf")
        return self._from_somebody(sample)

    def _from_somebody(self, sample: zenoh.Sample) -> Arrived:
        key = str(sample.key_expr)
        sender = self._senders.get(key)
        if sender is None:
            self._refusals.add(key, "no participant of this run sends with this key")
            return _NOBODY, b""
        return sender, sample.payload.to_bytes()

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

        Waits that are longer than the period need not notify this thread: it checks the deadline once per period.
        """
        with self._condition:
            while not self._closed:
                left = self._deadline - time.monotonic()
                if left <= 0:
                    self._deadline = float("inf")
                    self._waker.put(_WAKE)
                else:
                    self._condition.wait(min(left, _TIMER_PERIOD_S))
