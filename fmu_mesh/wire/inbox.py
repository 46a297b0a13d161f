"""The inbox of a process: the only place where its main thread waits.

Messages of other hosts, and rare events that any thread posts (a query, a lost token, a request to end). Rows of this
host come through rings; a wait may also be for them. Every wait has a deadline.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from typing import Protocol

import zenoh

from ..errors import MessageRefused
from ..rings.host_memory import HostMemory, Wish
from ..system.plan import MASTER
from .keys import RunKeys
from .messages import HEADER
from .refusals import Refusals

__all__ = ["Inbox", "Message", "Sleeper"]

# Threads: one thread, the owner, calls `poll`, `wait` and `close`, and runs what was posted. Threads of Zenoh call
# `take`, any thread calls `post`. Between them are two deques, whose ends are atomic in CPython, and a bell: first
# something is put into a deque, then the bell is rung; the owner reads the bell first, looks into the deques second,
# and sleeps third. So what comes in between rings a bell that the owner has not seen, and the sleep ends at once
# (docs/rings.md).
#
# What may go wrong: a callback that raises would end a thread of Zenoh, so `take` only compares a key and stores
# bytes, and everything else happens on the owner's thread inside a guard (ADR 8). A flood of queries must not hold
# grants back: after `_MOST_AT_ONCE` posted actions the messages have their turn. When the owner moves to shared
# memory, somebody may ring the old bell meanwhile: `move_to` rings both.
#
# Why not `queue.Queue`: it takes a lock and a condition for each message, and cannot wait for a counter as well.
# Tried and given up: a buffer in shared memory for each sender (ADR 5, replaced by rings, ADR 58).

Message = tuple[str, int, int, int, int, bytes]
"""Sender, kind, link, count, point, and the whole message."""


_MOST_AT_ONCE = 64
"""Posted actions that run one after the other, before messages and grants get their turn."""


class Sleeper(Protocol):
    """What the main thread may be in when there is something for it."""

    def ring_bell(self) -> None:
        """From any thread: wake it."""
        ...


class Inbox:
    """Receives the messages for one participant; until `open`, there are none, and only posted actions are run.

    Args:
        memory: has the bell on which it waits.
    """

    def __init__(self, memory: HostMemory) -> None:
        self._memory = memory
        self._sleeper: Sleeper = memory
        self._posted: deque[Callable[[], None]] = deque()
        self._arrived: deque[tuple[str, bytes]] = deque()
        self._subscriber: zenoh.Subscriber[None] | None = None
        self.refusals = Refusals()

    def open(self, session: zenoh.Session, keys: RunKeys, name: str, senders: Mapping[str, str]) -> None:
        """From now on the participant ``name`` receives messages; ``senders`` are the allowed ones by their keys.

        After `close`, it may be opened for another run: nothing of the one before arrives any more.
        """
        self._arrived = arrived = deque[tuple[str, bytes]]()

        def take(sample: zenoh.Sample) -> None:
            """On a thread of Zenoh."""
            key = str(sample.key_expr)
            sender = senders.get(key)
            if sender is None:
                self.refusals.add(key, "no participant of this run sends with this key")
                return
            arrived.append((sender, sample.payload.to_bytes()))
            self._sleeper.ring_bell()

        self._subscriber = session.declare_subscriber(keys.inbox(name), take)

    def move_to(self, memory: HostMemory, sleeper: Sleeper) -> None:
        """From now on wait in another memory, and wake ``sleeper``, which may also be stepping."""
        before, self._memory, self._sleeper = self._sleeper, memory, sleeper
        before.ring_bell()
        sleeper.ring_bell()  # for what came meanwhile

    def post(self, action: Callable[[], None], *, first: bool = False) -> None:
        """From any thread: let the main thread run ``action`` when it next looks into the inbox; ``first`` of all."""
        (self._posted.appendleft if first else self._posted.append)(action)
        self._sleeper.ring_bell()

    def poll(self) -> Message | None:
        """The next message if there is one; also runs posted actions."""
        self._run_posted()
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
        self._memory.sleep(seen, timeout_s, wishes)
        return self.poll()

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

    def _decoded(self, sender: str, data: bytes) -> Message | None:
        if len(data) < HEADER.size:
            self.refusals.add(sender, f"a message of {len(data)} bytes is too short")
            return None
        kind, number, count, point = HEADER.unpack_from(data)
        return sender, kind, number, count, point, data

    def close(self) -> None:
        """Stop receiving."""
        if self._subscriber is not None:
            self._subscriber.undeclare()
            self._subscriber = None

    def _run_posted(self) -> bool:
        """Run the posted actions; return whether there were any."""
        found = min(len(self._posted), _MOST_AT_ONCE)
        for _ in range(found):
            with self.refusals.guard("a query or a setting"):
                self._posted.popleft()()
        return found > 0
