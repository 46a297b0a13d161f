"""All orders of events of the waiting protocol of `burst.c`, at small sizes (docs/rings.md has the protocol in words).

`Protocol` has the C functions with the same names; each ``yield`` is one access to shared memory. `Explorer` tries all
interleavings of a few threads, on two machines that delay stores. In each run all threads have to come to their end,
and no sleep ends by its time limit: so a run that stops before is a lost wake-up or a deadlock.
"""

from __future__ import annotations

import hashlib
import itertools
import re
from collections.abc import Callable, Generator, Iterator, Sequence
from enum import Enum
from functools import cache, partial
from pathlib import Path
from types import GeneratorType
from typing import NamedTuple, TypeVar

import pytest

BURST = Path("fmu_mesh/rings/burst.c")
FUNCTIONS = (
    "lower",
    "ring_bell",
    "wake",
    "wake_if_needed",
    "raise_counter",
    "counter_raise",
    "granted",
    "sleep_for",
    "wake_all",
    "await",
    "node_attend",
)
DIGEST = "37273cecb70a87c1"
"""Of these functions, when `Protocol` was last compared with them."""

NEVER = 99
PROCESSES = 3

# --- one access to memory


class Order(Enum):
    RELAXED = 0
    """Also release and acquire: a load may be done before an older store of the same thread is seen by others."""
    SEQ_CST = 1


class Wish(NamedTuple):
    counter: Counter
    need: int


class Op(NamedTuple):
    """What a thread does next with shared memory."""

    kind: str
    place: int = -1
    value: int = 0
    expected: int = 0
    order: Order = Order.SEQ_CST
    wishes: tuple[Wish, ...] = ()


T = TypeVar("T")
Steps = Generator[Op, int, T]
"""A function of C: it yields each access, gets what was read, and returns ``T``."""


class Counter(NamedTuple):
    value: int
    wake_at: int
    needs: tuple[int, ...]


def counter_at(first: int) -> Counter:
    return Counter(first, first + 1, tuple(range(first + 2, first + 2 + PROCESSES)))


A, B = counter_at(0), counter_at(2 + PROCESSES)
BELLS = range(B.needs[-1] + 1, B.needs[-1] + 1 + PROCESSES)
ATTENTION = BELLS[-1] + 1
PLACES = [
    f"{name}.{part}" for name in "AB" for part in ("value", "wake_at", *(f"needs[{at}]" for at in range(PROCESSES)))
]
PLACES += [*(f"bells[{at}]" for at in range(PROCESSES)), "attention", ""]
START = tuple(NEVER if place in {A.wake_at, B.wake_at} else 0 for place in range(ATTENTION + 1))


def load(place: int, order: Order = Order.SEQ_CST) -> Op:
    return Op("load", place, order=order)


def store(place: int, value: int, order: Order = Order.SEQ_CST) -> Op:
    return Op("store", place, value, order=order)


def swap(place: int, expected: int, value: int) -> Op:
    """Compare and swap; the result is what was there."""
    return Op("swap", place, value, expected)


def add(place: int) -> Op:
    return Op("add", place)


FENCE = Op("fence")
WORK = Op("work")
"""A step of a model. It may take so long that all others come as far as they can."""


# --- the functions of burst.c


class Protocol:
    """The protocol of `burst.c`, or a wrong one without one of its parts."""

    def __init__(self, without: str = "") -> None:
        self._without = without

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
        if self.has("the bell is counted"):
            yield add(BELLS[process])
        yield Op("wake", BELLS[process])

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
        if value <= (yield load(counter.value)):
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
        if self.has("the fence of sleep_for"):
            yield FENCE
        is_granted = (yield from self.granted(wishes)) if self.has("the look before sleep") else False
        if not is_granted:
            if not self.has("the bell is read first"):
                seen = yield load(BELLS[own])
            yield Op("wait", BELLS[own], seen, wishes=wishes)
            is_granted = yield from self.granted(wishes)
        for counter, _ in wishes:
            yield store(counter.needs[own], 0)
        return is_granted

    def await_(self, own: int, wishes: tuple[Wish, ...], written: Counter | None = None) -> Steps[bool]:
        """`await` again and again, until a wish is granted or there is attention."""
        while True:
            seen = yield load(BELLS[own])
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


# --- the exploration


class Node(NamedTuple):
    """Where a thread is: what it does next, and how it comes there: the program, and the results of its accesses."""

    op: Op | None
    results: tuple[int, ...]
    where: str


class Thread:
    """All places that a thread can be at. Two runs that lead to the same line with the same variables are one place."""

    def __init__(self, programs: Sequence[Callable[[], Steps[None]]]) -> None:
        self._programs = programs
        self._numbers: dict[str, int] = {}
        self._next: dict[tuple[int, int], int] = {}
        self.nodes: list[Node] = []
        self.starts = [self._add((number,)) for number in range(len(programs))]

    def after(self, node: int, result: int) -> int:
        """The place after the access at ``node`` gave ``result``."""
        if (node, result) not in self._next:
            self._next[node, result] = self._add((*self.nodes[node].results, result))
        return self._next[node, result]

    def _add(self, results: tuple[int, ...]) -> int:
        steps = self._programs[results[0]]()
        try:
            op = next(steps)
            for result in results[1:]:
                op = steps.send(result)
        except StopIteration:
            return self._number("end", Node(None, results, "end"))
        frames = list(_frames(steps))
        key = tuple((code, line, tuple(sorted(names.items(), key=str))) for code, line, names in frames)
        where = " > ".join(code for code, _, _ in frames)
        number = self._number(str(key), Node(op, results, where))
        assert self.nodes[number].op == op, f"{where}: the same place has two operations"
        return number

    def _number(self, key: str, node: Node) -> int:
        if key not in self._numbers:
            self._numbers[key] = len(self.nodes)
            self.nodes.append(node)
        return self._numbers[key]


def _frames(steps: object) -> Iterator[tuple[str, int, dict[str, object]]]:
    """Function, place in its code, and variables of a generator, and of those that it waits for."""
    while isinstance(steps, GeneratorType) and (frame := steps.gi_frame) is not None:
        names = {name: value for name, value in frame.f_locals.items() if name not in {"self", "protocol"}}
        yield steps.gi_code.co_name, frame.f_lasti, names
        steps = steps.gi_yieldfrom


class Machine(Enum):
    TSO = "x86: a store is seen later, until a locked operation or a fence"
    WEAK = "ARM: so is each store, also that of a compare and swap, until a seq_cst load, the next swap, or a fence"


class Stored(NamedTuple):
    """A store that others do not see yet."""

    place: int
    value: int
    order: Order
    locked: bool = False
    """Of a compare and swap: nobody else changes this place before."""


class State(NamedTuple):
    memory: tuple[int, ...]
    nodes: tuple[int, ...]
    buffers: tuple[tuple[Stored, ...], ...]
    asleep: tuple[bool, ...]
    limits: int
    """How many sleeps have ended by their time limit."""
    kills: int
    """How many threads were killed."""


Program = Callable[[Protocol], Steps[None]]


class Scenario(NamedTuple):
    """Threads, and what else may happen."""

    programs: Sequence[Program]
    limits: int = 0
    """How many sleeps may end by their limit at any moment."""
    restart: Program | None = None
    """If given, the first thread may be killed at any moment, once; then this takes its place."""


class Found(NamedTuple):
    states: int
    missed: int
    """States in which somebody sleeps although its wish is granted, and only a long step of the writer goes on."""
    ended_by_limit: int
    """The most sleeps of one run that ended by their time limit."""
    lost: str
    """The events of a run that stops before all threads are at their end."""


class Explorer:
    """All runs of a scenario."""

    def __init__(self, scenario: Scenario, protocol: Protocol, machine: Machine) -> None:
        self.scenario = scenario
        self.machine = machine
        programs = [[program] for program in scenario.programs]
        if scenario.restart is not None:
            programs[0].append(scenario.restart)
        self.threads = [Thread([partial(program, protocol) for program in of_thread]) for of_thread in programs]
        self.running = len(self.threads)

    def explore(self) -> Found:
        """Go through all states, depth first. A run that comes back to a state would never end."""
        count = self.running
        start = State(START, (0,) * count, ((),) * count, (False,) * count, 0, 0)
        path, seen, open_ = [(start, iter(self.following(start)))], {start}, {start}
        missed = most = 0
        while path:
            state, following = path[-1]
            after = next(following, None)
            if after is None:
                open_.discard(state)
                path.pop()
            elif after in open_:
                return Found(len(seen), missed, most, "a run without end: " + self.told([at for at, _ in path]))
            elif after not in seen:
                seen.add(after)
                open_.add(after)
                followers = self.following(after)
                if not followers and not self.ended(after):
                    return Found(len(seen), missed, most, self.told([*(at for at, _ in path), after]))
                missed += self.is_missed(after)
                most = max(most, after.limits)
                path.append((after, iter(followers)))
        return Found(len(seen), missed, most, "")

    def following(self, state: State) -> list[State]:
        """The states after the next event."""
        for thread in range(self.running):  # a store into the own buffer commutes with all else
            op = self.op(state, thread)
            if op is not None and op.kind == "store" and not self.drains(op):
                return [self.moved(self.buffered(state, thread, Stored(op.place, op.value, op.order)), thread, 0)]
        found = [after for thread in range(self.running) for after in self.steps(state, thread)]
        if (
            self.scenario.restart is not None
            and not state.kills
            and self.threads[0].nodes[state.nodes[0]].op is not None
        ):
            nodes = _put(state.nodes, 0, self.threads[0].starts[1])
            found.append(state._replace(nodes=nodes, asleep=_put(state.asleep, 0, value=False), kills=1))
        may_end = state.limits < self.scenario.limits or (not found and state.kills > 0)
        if may_end:
            sleepers = [thread for thread in range(self.running) if state.asleep[thread]]
            found += [self.woken(state, thread)._replace(limits=state.limits + 1) for thread in sleepers]
        return found

    def steps(self, state: State, thread: int) -> Iterator[State]:
        buffer = state.buffers[thread]
        if buffer and not self.is_locked(state, thread, buffer[0].place):
            drained = _put(state.buffers, thread, buffer[1:])
            yield state._replace(memory=_put(state.memory, buffer[0].place, buffer[0].value), buffers=drained)
        op = self.op(state, thread)
        if op is None:
            return
        if op.kind == "load":
            if op.order is Order.SEQ_CST and any(stored.order is Order.SEQ_CST for stored in buffer):
                return
            own = [stored.value for stored in buffer if stored.place == op.place]
            yield self.moved(state, thread, own[-1] if own else state.memory[op.place])
        elif op.kind in {"swap", "add"}:
            if not buffer and not self.is_locked(state, thread, op.place):
                yield self.swapped(state, thread, op)
        elif op.kind in {"wait", "work"} or not buffer:
            yield self.done(state, thread, op)

    def swapped(self, state: State, thread: int, op: Op) -> State:
        """After a compare and swap, or an addition. The weak machine may load what follows before others see it."""
        old = state.memory[op.place]
        if op.kind == "swap" and old != op.expected:
            return self.moved(state, thread, old)
        new = op.value if op.kind == "swap" else old + 1
        if self.machine is Machine.WEAK:
            state = self.buffered(state, thread, Stored(op.place, new, Order.SEQ_CST, locked=True))
        else:
            state = state._replace(memory=_put(state.memory, op.place, new))
        return self.moved(state, thread, old)

    def done(self, state: State, thread: int, op: Op) -> State:
        """After an operation that is neither a load nor a compare and swap."""
        if op.kind == "store":
            state = state._replace(memory=_put(state.memory, op.place, op.value))
        elif op.kind == "wait" and state.memory[op.place] == op.value:
            return state._replace(asleep=_put(state.asleep, thread, value=True))
        elif op.kind == "wake":
            for other in range(self.running):
                sleeps = self.threads[other].nodes[state.nodes[other]].op
                if state.asleep[other] and sleeps is not None and sleeps.place == op.place:
                    state = self.woken(state, other)
        return self.moved(state, thread, 0)

    def buffered(self, state: State, thread: int, stored: Stored) -> State:
        return state._replace(buffers=_put(state.buffers, thread, (*state.buffers[thread], stored)))

    def is_locked(self, state: State, thread: int, place: int) -> bool:
        """Whether another thread is within a compare and swap of this place."""
        others = (stored for other, buffer in enumerate(state.buffers) if other != thread for stored in buffer)
        return any(stored.locked and stored.place == place for stored in others)

    def op(self, state: State, thread: int) -> Op | None:
        """The next operation of a thread; None if it sleeps or is at its end."""
        return None if state.asleep[thread] else self.threads[thread].nodes[state.nodes[thread]].op

    def drains(self, op: Op) -> bool:
        return self.machine is Machine.TSO and op.order is Order.SEQ_CST

    def works(self, state: State, thread: int) -> bool:
        op = self.op(state, thread)
        return op is not None and op.kind == "work"

    def moved(self, state: State, thread: int, result: int) -> State:
        return state._replace(nodes=_put(state.nodes, thread, self.threads[thread].after(state.nodes[thread], result)))

    def woken(self, state: State, thread: int) -> State:
        return self.moved(state._replace(asleep=_put(state.asleep, thread, value=False)), thread, 0)

    def ended(self, state: State) -> bool:
        return all(self.threads[thread].nodes[node].op is None for thread, node in enumerate(state.nodes))

    def is_missed(self, state: State) -> bool:
        quiet = all(self.works(state, thread) or self.op(state, thread) is None for thread in range(self.running))
        return quiet and not any(state.buffers) and any(self.is_granted(state, at) for at in range(self.running))

    def is_granted(self, state: State, thread: int) -> bool:
        op = self.threads[thread].nodes[state.nodes[thread]].op
        if not state.asleep[thread] or op is None:
            return False
        return any(state.memory[wish.counter.value] >= wish.need for wish in op.wishes)

    def told(self, path: Sequence[State]) -> str:
        """The events of a run, one per line."""
        events = []
        for before, after in itertools.pairwise(path):
            for number, thread in enumerate(self.threads):
                node = thread.nodes[before.nodes[number]]
                if len(after.buffers[number]) < len(before.buffers[number]):
                    events.append(f"thread {number}: others see {PLACES[before.buffers[number][0].place]}")
                if after.nodes[number] != before.nodes[number] and node.op is not None:
                    events.append(f"thread {number}: {node.where}: {node.op.kind} {PLACES[node.op.place]}")
                if after.asleep[number] > before.asleep[number]:
                    events.append(f"thread {number}: sleeps")
        return "\n".join(events)


def _put(values: tuple[T, ...], place: int, value: T) -> tuple[T, ...]:
    return (*values[:place], value, *values[place + 1 :])


# --- what is explored


SCENARIOS = {
    "a burst and two sleepers": Scenario(
        [
            lambda protocol: bursting(protocol, A, (1, 2, 3)),
            lambda protocol: waiting(protocol, 1, Wish(A, 2)),
            lambda protocol: waiting(protocol, 2, Wish(A, 1), Wish(A, 3)),
        ]
    ),
    "Python raises for two sleepers": Scenario(
        [
            lambda protocol: raising(protocol, A, (1, 2, 3)),
            lambda protocol: waiting(protocol, 1, Wish(A, 2)),
            lambda protocol: waiting(protocol, 2, Wish(A, 1), Wish(A, 3)),
        ]
    ),
    "two threads wake": Scenario(
        [
            lambda protocol: raising(protocol, A, (1, 2)),
            lambda protocol: also_waking(protocol, A),
            lambda protocol: waiting(protocol, 1, Wish(A, 1)),
            lambda protocol: waiting(protocol, 2, Wish(A, 2)),
        ]
    ),
    "a cycle of two": Scenario(
        [
            lambda protocol: stepping(protocol, 0, A, B, 3),
            lambda protocol: stepping(protocol, 1, B, A, 3),
        ]
    ),
    "a sleeper with two wishes": Scenario(
        [
            lambda protocol: bursting(protocol, A, (1,)),
            lambda protocol: bursting(protocol, B, (1, 2)),
            lambda protocol: waiting_for_any(protocol, 2, Wish(A, 2), Wish(B, 2)),
        ]
    ),
    "two units wait for one counter": Scenario(
        [
            lambda protocol: bursting(protocol, A, (1, 2)),
            lambda protocol: waiting_for_any(protocol, 1, Wish(A, 3), Wish(A, 2)),
        ]
    ),
    "attention": Scenario(
        [
            lambda protocol: waiting(protocol, 0, Wish(A, 1)),
            attending,
        ]
    ),
    "sleeps end by their limit": Scenario(
        [
            lambda protocol: bursting(protocol, A, (1, 2)),
            lambda protocol: waiting(protocol, 1, Wish(A, 1), Wish(A, 2)),
            lambda protocol: waiting(protocol, 2, Wish(A, 2)),
        ],
        limits=1,
    ),
    "a writer is killed": Scenario(
        [
            lambda protocol: bursting(protocol, A, (1, 2)),
            lambda protocol: waiting(protocol, 1, Wish(A, 1)),
            lambda protocol: waiting(protocol, 2, Wish(A, 2)),
        ],
        restart=lambda protocol: restarted(protocol, A, 2),
    ),
    "a sleeper is killed": Scenario(
        [
            lambda protocol: waiting(protocol, 1, Wish(A, 1), Wish(A, 3)),
            lambda protocol: bursting(protocol, A, (1, 2, 3)),
        ],
        restart=lambda protocol: waiting(protocol, 1, Wish(A, 2), Wish(A, 3)),
    ),
}


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
}


@cache
def explored(name: str, machine: Machine) -> Found:
    return Explorer(SCENARIOS[name], Protocol(), machine).explore()


@pytest.mark.parametrize("machine", Machine, ids=lambda machine: machine.name)
@pytest.mark.parametrize("name", SCENARIOS)
def test_in_every_order_of_events_all_sleepers_are_woken(name: str, machine: Machine) -> None:
    found = explored(name, machine)

    assert not found.lost, found.lost


@pytest.mark.parametrize("part", MISSING)
def test_without_one_of_its_parts_the_protocol_loses_a_wake_up(part: str) -> None:
    name, machine = MISSING[part]

    found = Explorer(SCENARIOS[name], Protocol(without=part), machine).explore()

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
def test_after_a_kill_no_more_sleeps_end_by_their_limit_than_there_are_sleepers(name: str, most: int) -> None:
    found = explored(name, Machine.WEAK)

    assert found.ended_by_limit == most


def test_the_protocol_is_that_of_the_c_functions() -> None:
    source = BURST.read_text()
    functions = [
        re.search(rf"^[^\n/]*\b{name}\([^;{{]*\) \{{\n.*?^\}}", source, re.DOTALL | re.MULTILINE) for name in FUNCTIONS
    ]
    text = "".join(function[0] for function in functions if function is not None)
    code = "".join(re.sub(r"/\*.*?\*/", "", text, flags=re.DOTALL).split())

    assert None not in functions
    assert hashlib.sha256(code.encode()).hexdigest()[:16] == DIGEST, (
        f"one of {', '.join(FUNCTIONS)} in {BURST} has changed: change Protocol and docs/rings.md in the same way, "
        "look at the results of the other tests here, and then change DIGEST"
    )
