"""An explorer of threads that share memory: it tries all orders of their accesses, on machines that delay stores.

A thread is a generator: each ``yield`` is one access (`load`, `store`, `swap`, `add`, `FENCE`, `wait`, `ring`), which
gets what was read. Two moments of a thread are the same if it is at the same place of its code with the same variables.
So a loop must have a variable that tells its passes apart.

The machines: all processors see stores in one order, but later than following loads of the same thread. Sleeps end by a
ring, and by their time limit only where the scenario says so.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Generator, Iterator, Sequence
from enum import Enum
from types import GeneratorType
from typing import NamedTuple, TypeVar

T = TypeVar("T")


class Order(Enum):
    RELAXED = 0
    """Also release and acquire: a load may be done before an older store of the same thread is seen by others."""
    SEQ_CST = 1


class Op(NamedTuple):
    """What a thread does next with shared memory."""

    kind: str
    place: int = -1
    value: int = 0
    expected: int = 0
    order: Order = Order.SEQ_CST
    wishes: tuple[tuple[int, int], ...] = ()


Steps = Generator[Op, int, T]
"""A function of a thread: it yields each access, gets what was read, and returns ``T``."""


def load(place: int, order: Order = Order.SEQ_CST) -> Op:
    return Op("load", place, order=order)


def store(place: int, value: int, order: Order = Order.SEQ_CST) -> Op:
    return Op("store", place, value, order=order)


def swap(place: int, expected: int, value: int) -> Op:
    """Compare and swap; the result is what was there."""
    return Op("swap", place, value, expected)


def add(place: int) -> Op:
    """Add 1."""
    return Op("add", place)


def wait(place: int, seen: int, wishes: Sequence[tuple[int, int]]) -> Op:
    """Sleep, unless the place has another value than ``seen``; a wish is a place and the value that it has to reach."""
    return Op("wait", place, seen, wishes=tuple(wishes))


def ring(place: int) -> Op:
    """Wake all who sleep at this place."""
    return Op("ring", place)


FENCE = Op("fence")
WORK = Op("work")
"""A step of a model. It may take so long that all others come as far as they can."""


class Moment(NamedTuple):
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
        self.nodes: list[Moment] = []
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
            return self._number("end", Moment(None, results, "end"))
        frames = list(_frames(steps))
        key = tuple((code, line, tuple(sorted(names.items(), key=str))) for code, line, names in frames)
        where = " > ".join(code for code, _, _ in frames)
        number = self._number(str(key), Moment(op, results, where))
        assert self.nodes[number].op == op, f"{where}: the same place has two operations"
        return number

    def _number(self, key: str, node: Moment) -> int:
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


Program = Callable[[], Steps[None]]


class Scenario(NamedTuple):
    """Threads, and what else may happen."""

    memory: Sequence[int]
    """What each place contains at the start."""
    names: Sequence[str]
    """The name of each place."""
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

    def __init__(self, scenario: Scenario, machine: Machine) -> None:
        self.scenario = scenario
        self.machine = machine
        restarts = [] if scenario.restart is None else [scenario.restart]
        self.threads = [
            Thread([program, *(restarts if number == 0 else [])]) for number, program in enumerate(scenario.programs)
        ]
        self.running = len(self.threads)

    def explore(self) -> Found:
        """Go through all states, depth first. A run that comes back to a state would never end."""
        count = self.running
        start = State(tuple(self.scenario.memory), (0,) * count, ((),) * count, (False,) * count, 0, 0)
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
        may_kill = self.scenario.restart is not None and not state.kills
        for thread in range(may_kill, self.running):  # a store into the own buffer commutes with all but a kill
            op = self.op(state, thread)
            if op is not None and self.is_buffered(op):
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
        elif self.is_buffered(op):
            yield self.moved(self.buffered(state, thread, Stored(op.place, op.value, op.order)), thread, 0)
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
        elif op.kind == "ring":
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

    def is_buffered(self, op: Op) -> bool:
        return op.kind == "store" and (self.machine is Machine.WEAK or op.order is Order.RELAXED)

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
        return any(state.memory[place] >= need for place, need in op.wishes)

    def name(self, op: Op) -> str:
        return self.scenario.names[op.place] if op.place >= 0 else ""

    def told(self, path: Sequence[State]) -> str:
        """The events of a run, one per line."""
        events = []
        for before, after in itertools.pairwise(path):
            for number, thread in enumerate(self.threads):
                node = thread.nodes[before.nodes[number]]
                if len(after.buffers[number]) < len(before.buffers[number]):
                    events.append(f"thread {number}: others see {self.scenario.names[before.buffers[number][0].place]}")
                if after.nodes[number] != before.nodes[number] and node.op is not None:
                    events.append(f"thread {number}: {node.where}: {node.op.kind} {self.name(node.op)}")
                if after.asleep[number] > before.asleep[number]:
                    events.append(f"thread {number}: sleeps")
        return "\n".join(events)


def _put(values: tuple[T, ...], place: int, value: T) -> tuple[T, ...]:
    return (*values[:place], value, *values[place + 1 :])
