"""The inbox of a participant all of whose links are Zenoh: its owner waits in the channel, and is woken there."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
import zenoh

from fmu_mesh.rings.host_memory import HostMemory
from fmu_mesh.system.memory_map import map_memory
from fmu_mesh.wire.inbox import Inbox
from fmu_mesh.wire.keys import RunKeys
from fmu_mesh.wire.messages import FRAME, HEADER
from fmu_mesh.wire.session import Wiring, matches, open_session
from tests.helpers import DEADLINE_S, wait_until

KEYS = RunKeys("fmu_mesh/inbox", "0123456789abcdef")
FRAMES = KEYS.frames("source", "b")
_SHORT_S = 0.05
_FLOOD, _LARGE = 4000, 8192
"""Messages and bytes: more than the room of an inbox and the buffers of a link take."""


class Both:
    """An inbox, and who sends to it from another session."""

    def __init__(self, folder: Path) -> None:
        endpoint = f"unixsock-stream/{folder}/s"
        self.session = open_session(Wiring(listen=(endpoint,)))
        self.memory = HostMemory.private(map_memory(["a", "b"], {})[0], "b")
        self.inbox = Inbox(self.memory)
        self.inbox.open(self.session, KEYS, "b", {FRAMES: "a"})
        self.peer = open_session(Wiring(connect=(endpoint,)))
        block = zenoh.CongestionControl.BLOCK
        self.publisher = self.peer.declare_publisher(FRAMES, congestion_control=block)
        wait_until(lambda: matches(self.publisher), "the subscription of the inbox")

    def send(self, point: int) -> None:
        """A message without rows."""
        self.publisher.put(HEADER.pack(FRAME, 1, 0, point))

    def next_point(self) -> int:
        """The point of the next message."""
        end = time.monotonic() + DEADLINE_S
        while (message := self.inbox.wait(_SHORT_S)) is None:
            assert time.monotonic() < end
        assert message[:2] == ("a", FRAME)
        return message[4]

    def close(self) -> None:
        """End both."""
        self.inbox.close()
        self.peer.close()
        self.session.close()


@pytest.fixture
def both(tmp_path: Path) -> Iterator[Both]:
    made = Both(tmp_path)
    yield made
    made.close()


def test_messages_keep_their_order_when_the_owner_begins_to_read(both: Both) -> None:
    def send() -> None:
        for point in range(2000):
            both.send(point)

    sending = threading.Thread(target=send)
    sending.start()
    got = [both.next_point() for _ in range(100)]
    both.inbox.receive_directly()
    got += [both.next_point() for _ in range(1900)]
    sending.join()
    assert got == [*range(2000)]


def test_a_posted_action_ends_a_wait(both: Both) -> None:
    both.inbox.receive_directly()
    ran: list[float] = []
    for _ in range(20):  # also before, and just when, the owner begins to wait
        posting = threading.Thread(target=both.inbox.post, args=(lambda: ran.append(time.monotonic()),))
        posting.start()
        while not ran:
            began = time.monotonic()
            assert both.inbox.wait(DEADLINE_S) is None
            assert time.monotonic() - began < DEADLINE_S / 2
        posting.join()
        ran.clear()


def test_an_action_posted_for_later_ends_no_step(both: Both) -> None:
    """A step in C ends when the bell has rung."""
    ran: list[int] = []
    before = both.memory.seen()

    both.inbox.post(lambda: ran.append(1), later=True)

    assert both.memory.seen() == before
    assert both.inbox.has_posted
    began = time.monotonic()
    assert both.inbox.wait(DEADLINE_S) is None
    assert time.monotonic() - began < DEADLINE_S
    assert ran == [1]
    assert not both.inbox.has_posted
    both.inbox.post(lambda: ran.append(2))
    assert both.memory.seen() != before


def test_an_action_posted_just_before_the_wait_is_not_missed(both: Both, monkeypatch: pytest.MonkeyPatch) -> None:
    both.inbox.receive_directly()
    ran: list[int] = []
    monkeypatch.setattr(both.inbox.refusals, "add", lambda *_: both.inbox.post(lambda: ran.append(1)))
    both.session.put(KEYS.frames("other", "b"), b"")  # it is in the channel now, and refused by the last look
    began = time.monotonic()
    assert both.inbox.wait(DEADLINE_S) is None
    assert ran
    assert time.monotonic() - began < DEADLINE_S / 2


def test_a_wait_ends_at_its_deadline_though_a_later_one_was_set(both: Both) -> None:
    both.inbox.receive_directly()
    both.send(1)
    wait_until(lambda: both.inbox.wait(DEADLINE_S), "a message")  # the alarm is set to a far time
    began = time.monotonic()
    assert both.inbox.wait(_SHORT_S) is None
    assert _SHORT_S <= time.monotonic() - began < DEADLINE_S / 2


def test_only_the_own_process_wakes_the_owner(both: Both) -> None:
    both.inbox.receive_directly()
    for key in (KEYS.wake("b"), KEYS.frames("other", "b"), f"{KEYS.base}/*/*/to=b"):
        refused = both.inbox.refusals.count
        both.peer.put(key, b"x", congestion_control=zenoh.CongestionControl.BLOCK)
        wait_until(lambda: both.inbox.wait(_SHORT_S) is None and both.inbox.refusals.count > refused, key)  # noqa: B023 called at once
    both.inbox.post(lambda: None)
    both.inbox.wait(_SHORT_S)
    assert both.inbox.refusals.count == 3


def test_a_flood_waits_at_its_sender(both: Both) -> None:
    both.inbox.receive_directly()

    def send() -> None:
        for point in range(_FLOOD):
            both.publisher.put(HEADER.pack(FRAME, 1, 0, point) + bytes(_LARGE))

    sending = threading.Thread(target=send)
    sending.start()
    sending.join(1.0)
    assert sending.is_alive()  # the channel, and all that is on the way, are full
    assert [both.next_point() for _ in range(_FLOOD)] == [*range(_FLOOD)]
    sending.join(DEADLINE_S)


def test_no_thread_is_left(both: Both) -> None:
    names = ("inbox", "alarm")
    assert [thread.name for thread in threading.enumerate() if thread.name in names] == ["inbox"]
    both.inbox.receive_directly()
    assert [thread.name for thread in threading.enumerate() if thread.name in names] == ["alarm"]
    both.inbox.close()
    assert not [thread for thread in threading.enumerate() if thread.name in names]
