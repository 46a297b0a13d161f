"""The inbox of a process: the only place where its main thread waits.

Messages of other hosts, and rare events that any thread posts (a query, a lost token, a request to end). Rows of this
host come through rings; a wait may also be for them. Every wait has a deadline.
"""

from __future__ import annotations

import math
import os
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Protocol

import zenoh
from zenoh.handlers import FifoChannel

from ..errors import MessageRefused
from ..rings.host_memory import HostMemory, Wish
from ..system.plan import MASTER
from .keys import RunKeys
from .messages import HEADER
from .refusals import Refusals

__all__ = ["Inbox", "Message", "Sleeper"]

# Threads: one thread, the owner, calls `poll`, `wait` and `close`, and runs what was posted. A thread of the inbox
# calls `_take` for each message that Zenoh has put into a channel, any thread calls `post`. Between them are two
# deques, whose ends are atomic in CPython, and a bell: first something is put into a deque, then the bell is rung; the
# owner reads the bell first, looks into the deques second, and sleeps third. So what comes in between rings a bell that
# the owner has not seen, and the sleep ends at once (docs/rings.md).
#
# An owner that waits for messages only (`receive_directly`) reads the channel itself: one thread less to wake for each
# message, a third of the time. Zenoh's `recv` has no time limit and sees no bell, so what else wakes the owner comes as
# a message to its own inbox: from `post`, and from a thread with an alarm at the end of each wait. The owner first says
# that it sleeps, and then looks for posted actions; who posts one looks second whether it sleeps.
#
# What may go wrong: a handler that raises would end the thread, so `_take` only compares a key and stores bytes, and
# everything else happens on the owner's thread inside a guard (ADR 8). A flood of queries must not hold grants back:
# after `_MOST_AT_ONCE` posted actions the messages have their turn. A flood of messages fills the channel, and then
# stops the thread of Zenoh that reads its link; so the channel has room for all that this run may have on the way. When
# the owner moves to shared memory, somebody may ring the old bell meanwhile: `move_to` rings both.
#
# Why not `queue.Queue`: it takes a lock and a condition for each message, and cannot wait for a counter as well.
# Tried and given up: a buffer in shared memory for each sender (ADR 5, replaced by rings, ADR 58), callbacks (ADR 74).

Message = tuple[str, int, int, int, int, bytes]
"""Sender, kind, link, count, point, and the whole message."""


_MOST_AT_ONCE = 64
"""Posted actions that run one after the other, before messages and grants get their turn."""

_ROOM, _MOST_ROOM = 1 << 10, 1 << 24
"""Messages that a channel has room for beside those that may be on the way, and of those."""
_THREAD_END_S = 5.0
_WAKE_BYTES = 16


class Sleeper(Protocol):
    """What the main thread may be in when there is something for it."""

    def ring_bell(self) -> None:
        """From any thread: wake it."""
        ...


class Inbox:
    """Receives the messages for one participant; until `open`, there are none, and only posted actions are run.

    Args:
        memory: has the bell on which it waits.

    Attributes:
        is_direct: whether the owner reads the channel itself.
    """

    def __init__(self, memory: HostMemory) -> None:
        self._memory = memory
        self._sleeper: Sleeper = memory
        self._posted: deque[Callable[[], None]] = deque()
        self._arrived: deque[tuple[str, bytes]] = deque()
        self._subscriber: zenoh.Subscriber[zenoh.handlers.Handler[zenoh.Sample]] | None = None
        self._thread: threading.Thread | None = None
        self.is_direct = self._sleeps = False
        self._alarm = threading.Condition()
        self._alarm_at = self._looks_at = math.inf
        self._echo = threading.Event()
        self.refusals = Refusals()

    def open(
        self, session: zenoh.Session, keys: RunKeys, name: str, senders: Mapping[str, str], on_way: float = 0.0
    ) -> None:
        """From now on the participant ``name`` receives messages; ``senders`` are the allowed ones by their keys.

        There is room for those that are ``on_way`` at most while nobody reads them, and for some that are not allowed.
        After `close`, it may be opened for another run: nothing of the one before arrives any more.
        """
        self._arrived.clear()
        self.is_direct = self._sleeps = False
        self._senders, self._own_key, self._token = senders, keys.wake(name), os.urandom(_WAKE_BYTES)
        local = zenoh.Locality.SESSION_LOCAL
        self._send_wake = partial(session.put, self._own_key, self._token, allowed_destination=local)
        room = _ROOM + int(min(on_way, _MOST_ROOM))
        self._subscriber = session.declare_subscriber(keys.inbox(name), FifoChannel(room))
        self._channel = self._subscriber.handler
        self._thread = threading.Thread(target=self._receive, args=(self._channel,), name="inbox", daemon=True)
        self._thread.start()

    def receive_directly(self) -> None:
        """From now on the owner waits for messages and posted actions only, no counters, and reads the channel itself.

        Call `wait` where there is nothing else to do: a message ends no step of the sleeper.
        """
        assert self._thread is not None
        self.is_direct = True
        self._send_wake()
        self._thread.join(_THREAD_END_S)
        self._thread = threading.Thread(target=self._ring_alarms, name="alarm", daemon=True)
        self._thread.start()

    def move_to(self, memory: HostMemory, sleeper: Sleeper) -> None:
        """From now on wait in another memory, and wake ``sleeper``, which may also be stepping."""
        before, self._memory, self._sleeper = self._sleeper, memory, sleeper
        before.ring_bell()
        sleeper.ring_bell()  # for what came meanwhile

    def post(self, action: Callable[[], None], *, first: bool = False, later: bool = False) -> None:
        """From any thread: let the main thread run ``action`` when it next looks into the inbox; ``first`` of all.

        ``later`` is for the main thread itself: it may take its next steps before.
        """
        (self._posted.appendleft if first else self._posted.append)(action)
        if not later:
            self._sleeper.ring_bell()
            self._wake()

    @property
    def has_posted(self) -> bool:
        """Whether there are posted actions."""
        return bool(self._posted)

    def poll(self) -> Message | None:
        """The next message if there is one; also runs posted actions."""
        self._run_posted()
        if self.is_direct and not self._arrived and (sample := self._channel.try_recv()) is not None:
            self._take(sample)
        while self._arrived:
            if (message := self._decoded(*self._arrived.popleft())) is not None:
                return message
        return None

    def wait(self, timeout_s: float, wishes: Sequence[Wish] = ()) -> Message | None:
        """Wait for the next message; None after ``timeout_s`` seconds, after posted actions were run, or by a wish."""
        seen = self._memory.seen()
        if self._run_posted():
            return None
        if (message := self.poll()) is not None:
            return message
        if not self.is_direct:
            self._memory.sleep(seen, timeout_s, wishes)
            return self.poll()
        self._sleeps = True
        with self._alarm:
            self._alarm_at = time.monotonic() + timeout_s
            if self._alarm_at < self._looks_at:
                self._alarm.notify()
        if not self._posted:
            self._take(self._channel.recv())
        self._sleeps = False
        return self.poll()

    def settle(self, timeout_s: float) -> None:
        """Wait until `poll` has all messages that Zenoh has delivered before; not for an owner that reads directly."""
        if self._subscriber is not None:
            self._echo.clear()
            self._send_wake()  # comes after them
            self._echo.wait(timeout_s)

    def wait_until(self, is_so: Callable[[], bool], timeout_s: float) -> bool:
        """Run what is posted, and drop messages, until something is so; whether it was within ``timeout_s`` seconds."""
        deadline = time.monotonic() + timeout_s
        while not is_so():
            if (left := deadline - time.monotonic()) <= 0:
                return False
            self.wait(left)
        return True

    def hand_on(
        self, message: Message, from_master: Callable[[Message], None], from_node: Callable[[Message], None]
    ) -> None:
        """Give a message to the handler of its sender; a message that the handler refuses is counted."""
        sender = message[0]
        try:
            (from_master if sender == MASTER else from_node)(message)
        except MessageRefused as refused:
            self.refusals.add(sender, refused.message)

    def _receive(self, channel: zenoh.handlers.Handler[zenoh.Sample]) -> None:
        """On a thread of its own, until the owner reads the channel, or the inbox is closed."""
        for sample in channel:
            self._take(sample)
            self._sleeper.ring_bell()
            if self.is_direct:
                return

    def _take(self, sample: zenoh.Sample) -> None:
        """On the thread that reads the channel."""
        key, data = str(sample.key_expr), sample.payload.to_bytes()
        if (sender := self._senders.get(key)) is not None:
            self._arrived.append((sender, data))
        elif key == self._own_key and data == self._token:
            self._echo.set()
        else:
            self.refusals.add(key, "no participant of this run sends with this key")

    def _wake(self) -> None:
        """From any thread: if the owner waits for the channel, end its wait."""
        if self._sleeps:
            self._sleeps = False
            self._send_wake()

    def _ring_alarms(self) -> None:
        """On a thread of its own, which most often finds that the owner waits for something later by now."""
        while self._subscriber is not None:
            with self._alarm:
                self._looks_at = self._alarm_at
                if (left := self._looks_at - time.monotonic()) > 0:
                    self._alarm.wait(min(left, threading.TIMEOUT_MAX))
                    continue
                self._alarm_at = math.inf
            self._wake()  # without the lock: where the channel is full it waits for the owner

    def _decoded(self, sender: str, data: bytes) -> Message | None:
        if len(data) < HEADER.size:
            self.refusals.add(sender, f"a message of {len(data)} bytes is too short")
            return None
        kind, number, count, point = HEADER.unpack_from(data)
        return sender, kind, number, count, point, data

    def close(self) -> None:
        """Stop receiving."""
        if self._subscriber is None or self._thread is None:
            return
        subscriber, self._subscriber = self._subscriber, None
        subscriber.undeclare()
        del self._channel  # nobody waits for room in it any more
        with self._alarm:
            self._alarm.notify()
        self._thread.join(_THREAD_END_S)

    def _run_posted(self) -> bool:
        """Run the posted actions; return whether there were any."""
        found = min(len(self._posted), _MOST_AT_ONCE)
        for _ in range(found):
            with self.refusals.guard("a query or a setting"):
                self._posted.popleft()()
        return found > 0
