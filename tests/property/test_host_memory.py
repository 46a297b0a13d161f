"""Memory that processes share: who may open it, counters that wake, and sleeps that no wake-up misses."""

from __future__ import annotations

import fcntl
import itertools
import json
import mmap
import os
import secrets
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from msgspec.structs import replace

from fmu_mesh.rings import host_memory, native
from fmu_mesh.rings.host_memory import Counter, HostMemory, Offer, can_share
from fmu_mesh.system.layout import Layout
from fmu_mesh.system.memory_map import MASTER, RECORDER, MemoryMap, RingPlace, map_memory
from fmu_mesh.wire.host_processes import opened_of

pytestmark = pytest.mark.skipif(not can_share(), reason="needs Linux with memfd_create, and the library")

LAYOUT = Layout.of([("y", "Float64"), ("n", "Int32"), ("on", "Boolean")])
LONG_S = 30.0
"""What a lost wake-up would take."""


def mapped(rows: int = 16) -> tuple[MemoryMap, RingPlace]:
    map_, places = map_memory(["a", "b", RECORDER, MASTER], {"i": ("a", 1, LAYOUT, rows)})
    return map_, places["i"]


MAP, PLACE = mapped()


@pytest.fixture
def memory() -> Iterator[HostMemory]:
    made = HostMemory.create(MAP, MASTER)
    yield made
    made.close()


def opened(memory: HostMemory, process: str, map_: MemoryMap = MAP, **changes: object) -> HostMemory | None:
    return HostMemory.opened(replace(memory.offer, **changes), map_, process, opened_of)


# --- opening


def test_who_opens_an_offer_sees_the_same_rows_and_counters(memory: HostMemory) -> None:
    other = opened(memory, "a")

    assert other is not None
    ring, seen = other.ring(PLACE), memory.ring(PLACE)
    ring.put(5, "y", -0.0)
    ring.put(5, "n", 7)
    ring.stamp(5)
    other.counter(PLACE.counter).raise_to(6)
    assert memory.counter(PLACE.counter).value == 6
    assert seen.has_row(5)
    assert (str(seen.value(5, "y")), seen.value(5, "n")) == ("-0.0", 7)


@pytest.mark.parametrize("change", [{"token": "00" * 16}, {"token": ""}, {"pid": 2**22 + 1}, {"descriptor": 999_999}])
def test_memory_that_is_not_the_offered_one_is_not_used(memory: HostMemory, change: dict[str, object]) -> None:
    assert opened(memory, "a", **change) is None  # type: ignore[arg-type] # none of them is the map


def test_memory_of_another_size_is_not_used(memory: HostMemory) -> None:
    assert opened(memory, "a", mapped(rows=32)[0]) is None
    assert opened(memory, "a", replace(MAP, size=MAP.size - 1)) is None


def test_memory_that_somebody_could_shrink_is_not_used() -> None:
    """To read beyond its end would kill the process."""
    descriptor = os.memfd_create("stranger", os.MFD_CLOEXEC | os.MFD_ALLOW_SEALING)
    try:
        os.ftruncate(descriptor, MAP.size)
        token = secrets.token_bytes(16)
        os.pwrite(descriptor, token, 0)
        offer = Offer(os.getpid(), descriptor, token.hex())

        assert HostMemory.opened(offer, MAP, "a", opened_of) is None
        fcntl.fcntl(descriptor, fcntl.F_ADD_SEALS, fcntl.F_SEAL_SHRINK)
        assert HostMemory.opened(offer, MAP, "a", opened_of) is not None
    finally:
        os.close(descriptor)


@pytest.mark.parametrize("path", ["/etc/hostname", "/dev/zero", "/dev/null", "/proc/self"])
def test_a_descriptor_of_something_else_is_not_used(memory: HostMemory, path: str) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        assert opened(memory, "a", descriptor=descriptor) is None
    finally:
        os.close(descriptor)


@pytest.mark.parametrize("size", [0, 100, MAP.size - 1, 2 * MAP.size])
def test_nobody_can_change_its_size(memory: HostMemory, size: int) -> None:
    offer = memory.offer
    descriptor = os.open(f"/proc/{offer.pid}/fd/{offer.descriptor}", os.O_RDWR)
    try:
        with pytest.raises(PermissionError):
            os.ftruncate(descriptor, size)
        with pytest.raises(PermissionError):
            fcntl.fcntl(descriptor, fcntl.F_ADD_SEALS, fcntl.F_SEAL_WRITE)
    finally:
        os.close(descriptor)


def test_closed_memory_cannot_be_opened_and_who_has_it_goes_on() -> None:
    memory = HostMemory.create(MAP, MASTER)
    offer, other = memory.offer, opened(memory, "a")
    memory.close()

    assert HostMemory.opened(offer, MAP, "b", opened_of) is None
    assert other is not None
    other.grant.raise_to(4)
    assert memory.grant.value == 4


def test_shared_memory_is_no_file_and_no_child_inherits_it(memory: HostMemory) -> None:
    link = Path(f"/proc/self/fd/{memory.offer.descriptor}").readlink()

    assert str(link).startswith("/memfd:")
    assert not os.get_inheritable(memory.offer.descriptor)


def test_private_memory_is_that_of_one_participant() -> None:
    first, second = HostMemory.private(MAP, "a"), HostMemory.private(MAP, "b")

    first.grant.raise_to(7)

    assert (first.grant.value, second.grant.value) == (7, 0)


def test_everything_has_cache_lines_of_its_own() -> None:
    counters = [MAP.grant, *MAP.progress, *MAP.rings]
    bells = [MAP.bells + 64 * number for number in range(len(MAP.processes))]
    starts = sorted([*counters, *bells, PLACE.offset])

    assert all(start % 64 == 0 for start in starts)
    assert min(starts) >= 16  # the token
    assert all(
        end - start >= 64 + 8 * len(MAP.processes) for start, end in itertools.pairwise(starts) if start in counters
    )
    assert MAP.size >= PLACE.offset + 16 * (8 + 8 + 8 + 8)


# --- counters


@given(st.lists(st.integers(0, 2**62)))
@settings(max_examples=50)
def test_a_counter_only_grows(values: list[int]) -> None:
    counter = HostMemory.private(MAP, "a").counter(PLACE.counter)
    highest = 0
    for value in values:
        counter.raise_to(value)
        highest = max(highest, value)
        assert counter.value == highest


@pytest.mark.parametrize("value", [2**62, 2**63 - 1, -1, -(2**63)])
def test_a_forged_counter_is_a_number_and_no_error(memory: HostMemory, value: int) -> None:
    """What it means is up to who reads it: an engine, the master and the recorder compare it with what can be."""
    other = opened(memory, "a")
    assert other is not None
    np.frombuffer(other._memory, np.int64, 1, MAP.grant)[:] = value

    assert memory.grant.value == value


# --- sleeping


def elapsed(action: Callable[[], object]) -> float:
    started = time.monotonic()
    action()
    return time.monotonic() - started


def test_a_sleep_ends_by_itself() -> None:
    memory = HostMemory.private(MAP, "a")

    assert 0.05 <= elapsed(lambda: memory.sleep(memory.seen(), 0.05)) < LONG_S


def test_a_bell_that_rang_since_somebody_looked_ends_a_sleep_at_once() -> None:
    memory = HostMemory.private(MAP, "a")
    seen = memory.seen()
    memory.ring_bell()

    assert elapsed(lambda: memory.sleep(seen, LONG_S)) < LONG_S
    assert elapsed(lambda: memory.sleep(memory.seen(), 0.05)) >= 0.05


def test_the_bell_of_another_participant_ends_no_sleep(memory: HostMemory) -> None:
    seen = memory.seen()
    memory.participant("a").ring_bell()

    assert elapsed(lambda: memory.sleep(seen, 0.05)) >= 0.05


def test_a_wish_that_is_granted_ends_a_sleep_at_once(memory: HostMemory) -> None:
    memory.grant.raise_to(5)

    assert elapsed(lambda: memory.sleep(memory.seen(), LONG_S, [(memory.grant, 5)])) < LONG_S
    assert elapsed(lambda: memory.sleep(memory.seen(), 0.05, [(memory.grant, 6)])) >= 0.05


def test_one_of_several_wishes_is_enough(memory: HostMemory) -> None:
    others = [(counter, 100) for counter in memory.progress.values()]
    sleeper = threading.Thread(
        target=lambda: memory.sleep(memory.seen(), LONG_S, [*others, (memory.counter(PLACE.counter), 3)])
    )
    sleeper.start()

    for value in (1, 2, 3):
        memory.participant("a").counter(PLACE.counter).raise_to(value)

    sleeper.join(LONG_S / 2)
    assert not sleeper.is_alive()


def test_any_thread_can_ring_the_bell(memory: HostMemory) -> None:
    seen = memory.seen()
    sleeper = threading.Thread(target=lambda: memory.sleep(seen, LONG_S))
    sleeper.start()

    memory.ring_bell()

    sleeper.join(LONG_S / 2)
    assert not sleeper.is_alive()


ROUNDS = 5_000


def ball(memory: HostMemory, own: Counter, other: Counter, rounds: int, first: int) -> None:
    """Raise the own counter whenever the other one has grown."""
    for number in range(1, rounds + 1):
        while other.value < number - 1 + first:
            memory.sleep(memory.seen(), LONG_S, [(other, number - 1 + first)])
        own.raise_to(number)


def test_no_wake_up_is_lost_between_two_threads(memory: HostMemory) -> None:
    """One that is lost takes half a minute."""
    one, two = memory.participant("a"), memory.participant("b")
    thread = threading.Thread(target=ball, args=(two, two.progress["b"], two.progress["a"], ROUNDS, 1), daemon=True)
    thread.start()

    assert elapsed(lambda: ball(one, one.progress["a"], one.progress["b"], ROUNDS, 0)) < LONG_S

    thread.join(LONG_S)
    assert memory.progress["b"].value == ROUNDS


_PLAYER = """
import json, sys
import msgspec
from fmu_mesh.rings.host_memory import HostMemory, Offer
from fmu_mesh.wire.host_processes import opened_of
from fmu_mesh.system.memory_map import MemoryMap
from tests.property.test_host_memory import ball
offer, map_ = (msgspec.convert(item, type) for item, type in zip(json.loads(sys.argv[1]), (Offer, MemoryMap)))
memory = HostMemory.opened(offer, map_, "b", opened_of)
ball(memory, memory.progress["b"], memory.progress["a"], int(sys.argv[2]), 1)
"""


def player(memory: HostMemory, rounds: int) -> subprocess.Popen[bytes]:
    told = json.dumps([msgspec.to_builtins(memory.offer), msgspec.to_builtins(MAP)])
    return subprocess.Popen([sys.executable, "-c", _PLAYER, told, str(rounds)])


def test_no_wake_up_is_lost_between_two_processes(memory: HostMemory) -> None:
    own = memory.participant("a")
    with player(memory, ROUNDS) as process:
        own.progress["a"].raise_to(0)
        while own.progress["b"].value == 0:  # until it is there
            own.progress["a"].raise_to(1)
            own.sleep(own.seen(), LONG_S, [(own.progress["b"], 1)])
        ball_from(own, 2)
        assert process.wait(LONG_S) == 0
    assert own.progress["b"].value == ROUNDS


def ball_from(memory: HostMemory, first: int) -> None:
    own, other = memory.progress["a"], memory.progress["b"]
    started = time.monotonic()
    for number in range(first, ROUNDS + 1):
        while other.value < number - 1:
            memory.sleep(memory.seen(), LONG_S, [(other, number - 1)])
        own.raise_to(number)
    assert time.monotonic() - started < LONG_S


def test_process_killed_leaves_what_it_has_written_and_nobody_waits_for_ever(memory: HostMemory) -> None:
    own = memory.participant("a")
    with player(memory, 10**9) as process:
        own.progress["a"].raise_to(1)
        own.sleep(own.seen(), LONG_S, [(own.progress["b"], 1)])
        process.kill()
        process.wait(LONG_S)
    assert own.progress["b"].value == 1
    assert elapsed(lambda: own.sleep(own.seen(), 0.05, [(own.progress["b"], 2)])) >= 0.05
    own.progress["a"].raise_to(2)  # its need is still there, and wakes nobody


# --- without the library


def test_without_the_library_threads_wake_one_another(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(native, "library", None)
    memory = HostMemory.private(MAP, "a")
    assert not host_memory.can_share()
    for wake in (memory.ring_bell, memory.ring_bell):
        seen = memory.seen()
        sleeper = threading.Thread(target=lambda seen=seen: memory.sleep(seen, LONG_S))
        sleeper.start()
        wake()
        sleeper.join(LONG_S / 2)
        assert not sleeper.is_alive()
    assert elapsed(lambda: memory.sleep(memory.seen(), 0.05)) >= 0.05


def test_without_the_library_no_offer_is_taken(memory: HostMemory, monkeypatch: pytest.MonkeyPatch) -> None:
    offer = memory.offer
    monkeypatch.setattr(native, "library", None)

    assert HostMemory.opened(offer, MAP, "a", opened_of) is None


def test_the_token_is_in_the_memory_and_is_another_one_each_time(memory: HostMemory) -> None:
    second = HostMemory.create(MAP, MASTER)
    try:
        assert second.offer.token != memory.offer.token
        descriptor = os.open(f"/proc/self/fd/{memory.offer.descriptor}", os.O_RDONLY)
        with mmap.mmap(descriptor, MAP.size, mmap.MAP_SHARED, mmap.PROT_READ) as seen:
            assert seen[:16].hex() == memory.offer.token
        os.close(descriptor)
    finally:
        second.close()
