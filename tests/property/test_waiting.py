"""All orders of events of the waiting protocol of `burst.c` and `streams.c`, at small sizes.

docs/rings.md has the protocol in words.

`Protocol` has the C functions with the same names; each ``yield`` is one access to shared memory. In each run all
threads have to come to their end, and no sleep ends by its time limit: a run that stops before is a lost wake-up or a
deadlock.
"""

from __future__ import annotations

import hashlib
import os
import re
from collections.abc import Callable, Sequence
from functools import cache, partial
from pathlib import Path
from typing import NamedTuple

import pytest

from tests.explorer import (
    FENCE,
    WORK,
    Explorer,
    Found,
    Machine,
    Order,
    Scenario,
    Steps,
    add,
    load,
    ring,
    store,
    swap,
    wait,
)

SOURCES = [Path("fmu_mesh/rings") / name for name in ("counters.h", "streams.c", "burst.c")]
FUNCTIONS = (
    "lower",
    "ring_pipe",
    "ring",
    "wake",
    "wake_if_needed",
    "raise_counter",
    "counter_raise",
    "granted",
    "poll_streams",
    "sleep_on",
    "wake_all",
    "await",
    "node_attend",
    "claim",
    "grant_withdraw",
    "take_flag_or_ask",
    "send_and_release",
)
DIGEST = "1ba1a9670016ea5f"
"""Of these functions, when `Protocol` was last compared with them."""

NEVER = 99
PROCESSES = 3


class Counter(NamedTuple):
    """The places of a counter."""

    value: int
    wake_at: int
    needs: tuple[int, ...]

    @classmethod
    def at(cls, first: int) -> Counter:
        return cls(first, first + 1, tuple(range(first + 2, first + 2 + PROCESSES)))


class Wish(NamedTuple):
    counter: Counter
    need: int


A, B = Counter.at(0), Counter.at(2 + PROCESSES)
BELLS = range(2 * (2 + PROCESSES), 2 * (2 + PROCESSES) + PROCESSES)
ATTENTION = BELLS.stop
POLLS = range(ATTENTION + 1, ATTENTION + 1 + PROCESSES)
PIPES = range(POLLS.stop, POLLS.stop + PROCESSES)
"""How many bytes were written; what was there when a process began to wait, it has read."""
MEMORY = [NEVER if place in {A.wake_at, B.wake_at} else 0 for place in range(PIPES.stop)]
NAMES = [
    f"{name}.{part}" for name in "AB" for part in ("value", "wake_at", *(f"needs[{at}]" for at in range(PROCESSES)))
]
NAMES += [*(f"bells[{at}]" for at in range(PROCESSES)), "attention"]
NAMES += [f"{name}[{at}]" for name in ("polls", "pipe") for at in range(PROCESSES)]


class Protocol:
    """The protocol of `burst.c`, or a wrong one without one of its parts; who ``polls`` has streams."""

    def __init__(self, without: str = "", polls: frozenset[int] = frozenset()) -> None:
        self._without = without
        self._polls = polls

    def has(self, part: str) -> bool:
        return part != self._without

    def lower(self, place: int, value: int) -> Steps[None]:
        order = Order.SEQ_CST if self.has("the lower bound is loaded in order") else Order.RELAXED
        seen = yield load(place, order)
        while value < seen:
            found = yield swap(place, seen, value)
            if found == seen:
                return
            seen = found

    def ring_bell(self, process: int) -> Steps[None]:
        polls = 0
        if not self.has("polls is read after the bell is counted"):
            polls = yield load(POLLS[process])
        if self.has("the bell is counted"):
            yield add(BELLS[process])
        if process in self._polls:  # of all others, `polls` is never anything else than 0
            if self.has("polls is read after the bell is counted"):
                polls = yield load(POLLS[process])
            if polls:
                yield add(PIPES[process])
                yield ring(PIPES[process])
                return
        yield ring(BELLS[process])

    def wake(self, counter: Counter) -> Steps[None]:
        again = True
        while again:
            if self.has("wake_at is reset before the scan"):
                yield store(counter.wake_at, NEVER)
            lowest = NEVER
            value = yield load(counter.value)
            for process in range(PROCESSES):
                need = yield load(counter.needs[process])
                if need == 0:
                    continue
                if need > value:
                    lowest = min(lowest, need)
                elif (yield swap(counter.needs[process], need, 0)) == need:
                    yield from self.ring_bell(process)
            if not self.has("wake_at is reset before the scan"):
                yield store(counter.wake_at, NEVER)
            if lowest != NEVER and self.has("the lowest need that is left"):
                yield from self.lower(counter.wake_at, lowest)
            again = lowest != NEVER and self.has("the look at the value after the scan")
            if again:
                again = (yield load(counter.value)) >= lowest

    def wake_if_needed(self, counter: Counter) -> Steps[None]:
        wake_at = yield load(counter.wake_at, Order.RELAXED)
        value = yield load(counter.value, Order.RELAXED)
        if wake_at <= value:
            del wake_at, value
            yield from self.wake(counter)

    def raise_counter(self, counter: Counter, value: int) -> Steps[None]:
        yield store(counter.value, value, Order.RELAXED)
        yield from self.wake_if_needed(counter)

    def counter_raise(self, counter: Counter, value: int) -> Steps[None]:
        if value <= (yield load(counter.value, Order.RELAXED)):
            return
        yield store(counter.value, value, Order.RELAXED)
        if self.has("the fence of counter_raise"):
            yield FENCE
        yield from self.wake_if_needed(counter)

    def wake_all(self, counter: Counter) -> Steps[None]:
        if self.has("the fence of wake_all"):
            yield FENCE
        yield from self.wake_if_needed(counter)

    def granted(self, wishes: tuple[Wish, ...]) -> Steps[bool]:
        for counter, need in wishes:
            if (yield load(counter.value, Order.RELAXED)) >= need:
                return True
        return False

    def sleep_for(self, own: int, seen: int, wishes: tuple[Wish, ...]) -> Steps[bool]:
        for counter, need in wishes:
            other = yield load(counter.needs[own], Order.RELAXED)
            if other in {0, *range(need + 1, NEVER)}:
                yield store(counter.needs[own], need)
            del other
            yield from self.lower(counter.wake_at, need)
        if own in self._polls:
            return (yield from self.poll(own, seen, wishes))
        if self.has("the fence of sleep_for"):
            yield FENCE
        is_granted = (yield from self.granted(wishes)) if self.has("the look before sleep") else False
        if not is_granted:
            if not self.has("the bell is read first"):
                seen = yield load(BELLS[own])
            yield wait(BELLS[own], seen, [(wish.counter.value, wish.need) for wish in wishes])
            is_granted = yield from self.granted(wishes)
        for counter, _ in wishes:
            yield store(counter.needs[own], 0)
        return is_granted

    def poll(self, own: int, seen: int, wishes: tuple[Wish, ...]) -> Steps[bool]:
        """`sleep_on` of a process with streams, and `poll_streams`."""
        while True:
            drained = yield load(PIPES[own], Order.RELAXED)
            if self.has("polls is set before the look"):
                yield store(POLLS[own], 1, Order.RELAXED)
            if self.has("the fence of poll_streams"):
                yield FENCE
            is_granted = (yield from self.granted(wishes)) if self.has("the look before poll") else False
            rung = (yield load(BELLS[own], Order.RELAXED)) if self.has("the bell is read again") else seen
            if is_granted or rung != seen:
                break
            if not self.has("polls is set before the look"):
                yield store(POLLS[own], 1)
            yield wait(PIPES[own], drained, [(wish.counter.value, wish.need) for wish in wishes])
            yield store(POLLS[own], 0, Order.RELAXED)
        is_granted = yield from self.granted(wishes)
        yield store(POLLS[own], 0, Order.RELAXED)
        for counter, _ in wishes:
            yield store(counter.needs[own], 0)
        return is_granted

    def await_(self, own: int, wishes: tuple[Wish, ...], written: Counter | None = None) -> Steps[bool]:
        """`await` again and again, until a wish is granted or there is attention."""
        while True:
            seen = yield load(BELLS[own], Order.RELAXED)
            if (yield load(ATTENTION)) and own == 0:
                return False
            if written is not None and self.has("others are rung before sleep"):
                yield from self.wake_all(written)
            if (yield from self.sleep_for(own, seen, wishes)):
                return True

    def node_attend(self) -> Steps[None]:
        yield store(ATTENTION, 1)
        yield from self.ring_bell(0)


# --- threads of the scenarios


def waiting(protocol: Protocol, own: int, *wishes: Wish) -> Steps[None]:
    """Wait for one value after the other."""
    for counter, need in wishes:
        yield from protocol.await_(own, (Wish(counter, need),))


def waiting_for_any(protocol: Protocol, own: int, *wishes: Wish) -> Steps[None]:
    yield from protocol.await_(own, wishes)


def bursting(protocol: Protocol, counter: Counter, values: Sequence[int]) -> Steps[None]:
    """A burst of steps."""
    for value in values:
        yield from protocol.raise_counter(counter, value)
        yield WORK
    yield from protocol.wake_all(counter)


def raising(protocol: Protocol, counter: Counter, values: Sequence[int]) -> Steps[None]:
    """What Python does: the master, or rows that have arrived."""
    for value in values:
        yield from protocol.counter_raise(counter, value)
        yield WORK


def stepping(protocol: Protocol, own: int, written: Counter, read: Counter, last: int) -> Steps[None]:
    """A node of a cycle: its step to row n needs row n - 1 of the other."""
    for row in range(1, last + 1):
        if (yield load(read.value, Order.RELAXED)) < row - 1:
            yield from protocol.await_(own, (Wish(read, row - 1),), written)
        yield from protocol.raise_counter(written, row)
    yield from protocol.wake_all(written)


def also_waking(protocol: Protocol, counter: Counter) -> Steps[None]:
    """Another thread of the process that writes the counter."""
    yield from protocol.wake_all(counter)


def attending(protocol: Protocol) -> Steps[None]:
    yield from protocol.node_attend()


def restarted(protocol: Protocol, counter: Counter, last: int) -> Steps[None]:
    """A writer that was killed goes on where its counter stands."""
    done = yield load(counter.value)
    yield from protocol.wake_all(counter)
    for value in range(done + 1, last + 1):
        yield from protocol.raise_counter(counter, value)
    yield from protocol.wake_all(counter)


# --- what is explored


Program = Callable[[Protocol], Steps[None]]


def thread(function: Callable[..., Steps[None]], *arguments: object) -> Program:
    return lambda protocol: function(protocol, *arguments)


THREADS: dict[str, list[Program]] = {
    "a burst and two sleepers": [
        thread(bursting, A, (1, 2, 3)),
        thread(waiting, 1, Wish(A, 2)),
        thread(waiting, 2, Wish(A, 1), Wish(A, 3)),
    ],
    "Python raises for two sleepers": [
        thread(raising, A, (1, 2, 3)),
        thread(waiting, 1, Wish(A, 2)),
        thread(waiting, 2, Wish(A, 1), Wish(A, 3)),
    ],
    "two threads wake": [
        thread(raising, A, (1, 2)),
        thread(also_waking, A),
        thread(waiting, 1, Wish(A, 1)),
        thread(waiting, 2, Wish(A, 2)),
    ],
    "a cycle of two": [thread(stepping, 0, A, B, 3), thread(stepping, 1, B, A, 3)],
    "a sleeper with two wishes": [
        thread(bursting, A, (1,)),
        thread(bursting, B, (1, 2)),
        thread(waiting_for_any, 2, Wish(A, 2), Wish(B, 2)),
    ],
    "two units wait for one counter": [
        thread(bursting, A, (1, 2)),
        thread(waiting_for_any, 1, Wish(A, 3), Wish(A, 2)),
    ],
    "attention": [thread(waiting, 0, Wish(A, 1)), thread(attending)],
    "sleeps end by their limit": [
        thread(bursting, A, (1, 2)),
        thread(waiting, 1, Wish(A, 1), Wish(A, 2)),
        thread(waiting, 2, Wish(A, 2)),
    ],
    "a writer is killed": [
        thread(bursting, A, (1, 2)),
        thread(waiting, 1, Wish(A, 1)),
        thread(waiting, 2, Wish(A, 2)),
    ],
    "a sleeper is killed": [
        thread(waiting, 1, Wish(A, 1), Wish(A, 3)),
        thread(bursting, A, (1, 2, 3)),
    ],
}
POLLING = {
    "a burst and two sleepers": {1, 2},
    "Python raises for two sleepers": {1},
    "a cycle of two": {0},
    "a sleeper with two wishes": {2},
    "attention": {0},
    "a writer is killed": {1},
}
"""Who has streams in some more runs of these."""

RESTARTS = {
    "a writer is killed": thread(restarted, A, 2),
    "a sleeper is killed": thread(waiting, 1, Wish(A, 2), Wish(A, 3)),
}
"""Who takes the place of the first thread, which may be killed at any moment."""


def explore(name: str, machine: Machine, protocol: Protocol) -> Found:
    restart = RESTARTS.get(name)
    scenario = Scenario(
        MEMORY,
        NAMES,
        [partial(program, protocol) for program in THREADS[name]],
        limits=1 if name == "sleeps end by their limit" else 0,
        restart=partial(restart, protocol) if restart is not None else None,
    )
    return Explorer(scenario, machine).explore()


MISSING = {
    "the lower bound is loaded in order": ("a cycle of two", Machine.WEAK),
    "the fence of sleep_for": ("a cycle of two", Machine.WEAK),
    "the fence of wake_all": ("a cycle of two", Machine.TSO),
    "the fence of counter_raise": ("Python raises for two sleepers", Machine.TSO),
    "the look before sleep": ("a cycle of two", Machine.TSO),
    "the bell is read first": ("a cycle of two", Machine.TSO),
    "the bell is counted": ("attention", Machine.TSO),
    "others are rung before sleep": ("a cycle of two", Machine.TSO),
    "wake_at is reset before the scan": ("a cycle of two", Machine.TSO),
    "the lowest need that is left": ("Python raises for two sleepers", Machine.TSO),
    "the look at the value after the scan": ("two threads wake", Machine.TSO),
    "polls is set before the look": ("attention", Machine.TSO),
    "polls is read after the bell is counted": ("attention", Machine.TSO),
    "the fence of poll_streams": ("a cycle of two", Machine.WEAK),
    "the look before poll": ("a cycle of two", Machine.TSO),
    "the bell is read again": ("attention", Machine.TSO),
}
_OF_POLL = [*MISSING][-5:]


@cache
def explored(name: str, machine: Machine) -> Found:
    return explore(name, machine, Protocol())


@pytest.mark.parametrize("machine", Machine, ids=lambda machine: machine.name)
@pytest.mark.parametrize("name", THREADS)
def test_in_every_order_of_events_all_sleepers_are_woken(name: str, machine: Machine) -> None:
    found = explored(name, machine)

    assert not found.lost, found.lost


_IN_LONG = pytest.mark.skipif("FMU_MESH_BURST_SECONDS" not in os.environ, reason="two minutes: .ci/long tsan runs it")
_POLLING = [pytest.param(name, marks=[_IN_LONG] if name == "a burst and two sleepers" else []) for name in POLLING]


@pytest.mark.parametrize("machine", Machine, ids=lambda machine: machine.name)
@pytest.mark.parametrize("name", _POLLING)
def test_who_polls_is_woken_by_a_pipe_in_every_order_of_events(name: str, machine: Machine) -> None:
    found = explore(name, machine, Protocol(polls=frozenset(POLLING[name])))

    assert not found.lost, found.lost


@pytest.mark.parametrize("part", MISSING)
def test_without_one_of_its_parts_the_protocol_loses_a_wake_up(part: str) -> None:
    name, machine = MISSING[part]

    polls = POLLING[name] if part in _OF_POLL else ()
    found = explore(name, machine, Protocol(part, frozenset(polls)))

    assert "sleeps" in found.lost


@pytest.mark.parametrize("machine", Machine, ids=lambda machine: machine.name)
def test_a_raise_with_a_fence_misses_nobody(machine: Machine) -> None:
    found = explored("Python raises for two sleepers", machine)

    assert found.missed == 0


def test_a_burst_may_miss_a_sleeper_until_it_looks_again() -> None:
    found = explored("a burst and two sleepers", Machine.TSO)

    assert found.missed > 0  # so the page and the limit of each sleep are right to speak of it
    assert not found.lost


@pytest.mark.parametrize(("name", "most"), [("a writer is killed", 2), ("a sleeper is killed", 0)])
def test_after_a_kill_at_most_each_sleeper_ends_by_its_limit(name: str, most: int) -> None:
    found = explored(name, Machine.WEAK)

    assert found.ended_by_limit == most


def test_the_protocol_is_that_of_the_c_functions() -> None:
    source = "".join(own.read_text() for own in SOURCES)
    functions = [
        re.search(rf"^[^\n/]*\b{name}\([^;{{]*\) \{{\n.*?^\}}", source, re.DOTALL | re.MULTILINE) for name in FUNCTIONS
    ]
    text = "".join(function[0] for function in functions if function is not None)
    code = "".join(re.sub(r"/\*.*?\*/", "", text, flags=re.DOTALL).split())

    assert None not in functions
    assert hashlib.sha256(code.encode()).hexdigest()[:16] == DIGEST, (
        f"one of {', '.join(FUNCTIONS)} in {SOURCES[0].parent} has changed: change Protocol (or test_pausing.py, "
        "test_sending.py) and docs/rings.md in the same way, look at the results of the other tests here, and then "
        "change DIGEST"
    )
