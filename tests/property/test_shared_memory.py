"""Messages through shared memory: all of them, in order, whole, whatever their size; and an end to every wait."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
import time
from collections import deque
from collections.abc import Callable

import msgspec
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from msgspec.structs import replace

from fmu_mesh.errors import DeadlineExceeded, FmuMeshError
from fmu_mesh.wire.messages import ABORT, MAX_MESSAGE_SIZE
from fmu_mesh.wire.shared_memory import Offer, SharedInbox, SharedOutlet, available

pytestmark = pytest.mark.skipif(not available(), reason="needs Linux with memfd_create and glibc 2.30")

SIZE = 64 * 1024
"""The smallest buffer there is."""


def outlet_to(
    inbox: SharedInbox, sender: str = "a", own: Callable[[], bool] | None = None, deadline_s: float = 10.0
) -> SharedOutlet:
    outlet = SharedOutlet.open(inbox.offer, sender, "node 'b'", own, deadline_s)
    assert outlet is not None
    return outlet


def in_background(action: Callable[[], object]) -> threading.Thread:
    thread = threading.Thread(target=action, daemon=True)
    thread.start()
    return thread


@settings(max_examples=50)
@given(st.lists(st.tuples(st.sampled_from("ab"), st.integers(0, 20_000), st.integers(0, 3)), max_size=40))
def test_messages_of_any_sizes_come_in_the_order_of_their_sender(plan: list[tuple[str, int, int]]) -> None:
    inbox = SharedInbox({"a": SIZE, "b": SIZE})
    outlets = {name: outlet_to(inbox, name) for name in "ab"}
    sent: dict[str, deque[bytes]] = {"a": deque(), "b": deque()}

    def take_one() -> None:
        message = inbox.take()
        if message is None:
            assert not any(sent.values())
        else:
            sender, data = message
            assert data == sent[sender].popleft()

    for number, (sender, size, takes) in enumerate(plan):
        message = sender.encode() + number.to_bytes(4, "little") * (size // 4)
        while sum(len(m) + 16 for m in sent[sender]) + size > SIZE - 32:
            take_one()
        outlets[sender].put(message)
        sent[sender].append(message)
        for _ in range(takes):
            take_one()
    while any(sent.values()):
        take_one()
    assert inbox.take() is None


def test_a_message_larger_than_the_buffer_arrives_whole() -> None:
    inbox = SharedInbox({"a": SIZE})
    message = os.urandom(10 * SIZE + 5)
    sender = in_background(lambda: outlet_to(inbox).put(message))

    assert inbox.take_within(10.0) == ("a", message)
    sender.join(10.0)
    assert not sender.is_alive()


def test_a_message_larger_than_any_may_be_is_refused() -> None:
    with pytest.raises(FmuMeshError, match="is larger than"):
        outlet_to(SharedInbox({"a": 0})).put(bytes(MAX_MESSAGE_SIZE + 1))


def test_two_that_send_to_each_other_more_than_fits_do_not_wait_for_each_other() -> None:
    first, second = SharedInbox({"b": SIZE}), SharedInbox({"a": SIZE})
    message = os.urandom(8 * SIZE)
    senders = [
        in_background(lambda: outlet_to(second, "a", first.stash).put(message)),
        in_background(lambda: outlet_to(first, "b", second.stash).put(message)),
    ]

    for sender in senders:
        sender.join(0.2)  # each is in its `put` by now, or through
    deadline = time.monotonic() + 10.0
    received = [first.take(), second.take()]
    while None in received and time.monotonic() < deadline:
        received = [old or inbox.take_within(0.01) for old, inbox in zip(received, (first, second), strict=True)]
    assert received == [("b", message), ("a", message)]


def test_a_receiver_that_takes_nothing_is_an_error_with_its_name() -> None:
    inbox = SharedInbox({"a": SIZE})
    outlet = outlet_to(inbox, deadline_s=0.2)

    with pytest.raises(DeadlineExceeded, match=r"node 'b' has taken no message for 0\.2 s"):
        outlet.put(bytes(10 * SIZE))


def test_a_sender_that_finds_no_room_gives_up_when_the_run_is_over() -> None:
    full, own = SharedInbox({"a": SIZE}), SharedInbox({"@mesh": SIZE})
    outlet = outlet_to(full, own=own.stash)
    outlet_to(own, "@mesh").put(bytes([ABORT]) + bytes(15))

    for _ in range(100):
        outlet.put(bytes(SIZE // 8))

    assert own.take_within(1.0) == ("@mesh", bytes([ABORT]) + bytes(15))  # and the abort is still there to be read


def test_a_wake_ends_a_wait_and_a_wait_ends_by_itself() -> None:
    inbox = SharedInbox({"a": SIZE})
    inbox.wake()
    assert inbox.take_within(60.0) is None
    started = time.monotonic()
    assert inbox.take_within(0.05) is None
    assert time.monotonic() - started >= 0.05


@pytest.mark.parametrize("change", [{"token": "00" * 16}, {"pid": 2**22 + 1}, {"descriptor": 999_999}, {"size": 64}])
def test_memory_that_is_not_the_offered_one_is_not_used(change: dict[str, object]) -> None:
    offer = replace(SharedInbox({"a": SIZE}).offer, **change)
    assert SharedOutlet.open(offer, "a", "node 'b'", None, 1.0) is None


@given(st.integers(-(2**70), 2**70) | st.sampled_from([0, 64, 128]), st.integers(-(2**70), 2**70) | st.just(SIZE))
@example(128 + 64, SIZE)
@example(128, 2 * SIZE)
@example(129, SIZE)
def test_a_buffer_outside_the_memory_is_not_used(offset: int, size: int) -> None:
    inbox = SharedInbox({"a": SIZE})
    own = inbox.offer.channels["a"]
    outlet = SharedOutlet.open(replace(inbox.offer, channels={"a": (offset, size)}), "a", "node 'b'", None, 1.0)

    assert outlet is None or (own[0] <= offset and size >= 0 and offset + size <= sum(own))


def test_a_closed_inbox_cannot_be_opened_any_more() -> None:
    inbox = SharedInbox({"a": SIZE})
    inbox.close()
    assert SharedOutlet.open(inbox.offer, "a", "node 'b'", None, 1.0) is None


_RECEIVER = """
import msgspec, sys
from fmu_mesh.wire.shared_memory import SharedInbox
inbox = SharedInbox({"a": 65536})
print(msgspec.json.encode(inbox.offer).decode(), flush=True)
count = int(sys.argv[1])
total = 0
for number in range(count):
    sender, message = inbox.take_within(30.0)
    assert sender == "a" and int.from_bytes(message[:8], "little") == number, number
    total += len(message)
print(total, flush=True)
sys.stdin.read()
"""


def receiver(count: int) -> tuple[subprocess.Popen[str], Offer]:
    process = subprocess.Popen(
        [sys.executable, "-c", _RECEIVER, str(count)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    assert process.stdout is not None
    return process, msgspec.json.decode(process.stdout.readline(), type=Offer)


def test_thousands_of_messages_reach_another_process() -> None:
    count = 20_000
    process, offer = receiver(count)
    with process:
        outlet = SharedOutlet.open(offer, "a", "node 'b'", None, 30.0)
        assert outlet is not None
        for number in range(count):
            outlet.put(number.to_bytes(8, "little") * (1 + number % 7))
        out, _ = process.communicate(timeout=60)
    assert int(out) == sum(8 * (1 + number % 7) for number in range(count))


def test_a_sender_does_not_wait_for_a_process_that_was_killed() -> None:
    process, offer = receiver(10**9)
    with process:
        outlet = SharedOutlet.open(offer, "a", "node 'b'", None, 60.0)
        assert outlet is not None
        process.kill()
        process.wait(10)
        started = time.monotonic()
        for _ in range(100):
            outlet.put(bytes(SIZE // 8))
        assert time.monotonic() - started < 30.0  # it would have been 60 s of waiting for room
        process.communicate(timeout=10)
