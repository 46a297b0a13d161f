"""A mesh without processes: the real nodes on a wire of this module, in an order that a seed decides.

Every node is the one of `fmu_mesh.node`, with its rings, links and waits; only its session, its meeting and its report
are of here. Each runs on a thread that goes on only when the scheduler says so, one at a time, so that nothing depends
on the machine. Messages keep their order within one key; between keys and nodes they are delayed at random.
"""

from __future__ import annotations

import random
import threading
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Self, cast

import numpy as np
import zenoh
from numpy.typing import NDArray

from fmu_mesh.instances.contract import Instance
from fmu_mesh.node.engine import PlainEngine, Windows
from fmu_mesh.node.node import Node
from fmu_mesh.node.stepping import Runner
from fmu_mesh.rings.host_memory import HostMemory, Wish
from fmu_mesh.rings.ring import Ring
from fmu_mesh.system.plan import RECORDER, NodePlan, Plan
from fmu_mesh.wire.frames import FrameReceiver
from fmu_mesh.wire.keys import RunKeys
from fmu_mesh.wire.membership import Membership, Welcome
from fmu_mesh.wire.messages import FINISH, FRAME, GRANT, HEADER, NOTED, PROGRESS

__all__ = ["SimulatedMesh"]

_MASTER = "@mesh"
RUN = RunKeys("fmu_mesh/scenario", "0123456789abcdef")
_TURN_S = 30.0
"""A node that does not come back to the scheduler within this time hangs in a loop of its own."""

_LONG_BURST = 40
"""Most ticks that a node steps in one turn; mostly it is one."""

_QUIET_ROUNDS = 3
"""So many times all waits time out without any message before it is called a deadlock."""


class SimulatedMesh:
    """Runs the nodes of a plan.

    Args:
        plan: the plan of the whole mesh.
        open_instance: opens a test double by name.
        seed: decides the delays of messages and the order in which nodes go on.

    Attributes:
        recorded: the rows (Real part) that reached the recorder, by instance.
        messages: how many frames were sent.
        waits_before_sending: how often a node waited while it had rows for another node that were not sent.
    """

    def __init__(self, plan: Plan, open_instance: Callable[[str], Instance], seed: int = 0) -> None:
        self.recorded: dict[str, list[NDArray[np.float64]]] = {}
        self.messages = 0
        self.waits_before_sending = 0
        self._plan = plan
        self._random = random.Random(seed)  # noqa: S311 no secret
        self._nodes = list(plan.nodes)
        self._windows = [plan.nodes[node].window for node in self._nodes]
        self._progress = [-1] * len(self._nodes)
        self._grant = 0
        self._finished = False
        self._links: dict[str, deque[bytes]] = {}
        self._pace: dict[str, float] = {}
        self._told = -1
        self._quiet_rounds = 0
        self.back = threading.Semaphore(0)
        self.stopping = False
        self.thread = threading.current_thread()
        self._processes = {
            node: _Process(self, plan.nodes[node], open_instance, number)
            for number, node in enumerate(self._nodes)
            if node != RECORDER
        }
        self._receivers: dict[int, FrameReceiver] = {}
        self._mirrors: dict[int, Ring] = {}
        if RECORDER in plan.nodes:
            recorder = plan.nodes[RECORDER]
            memory = HostMemory.private(recorder.memory, RECORDER)
            places = {place.instance: place for place in recorder.rings}
            for link in recorder.links_in:
                place = places[link.source]
                self._mirrors[link.index] = mirror = Ring(link.layout, place.rows)
                self._receivers[link.index] = FrameReceiver(link, mirror, memory.counter(place.counter))
                self.recorded[link.source] = []

    def run(self) -> None:
        """Run to the last point.

        Raises:
            AssertionError: nothing can go on any more.
            BaseException: what ended a node.
        """
        self.thread = threading.current_thread()
        for process in self._processes.values():
            process.thread.start()
        try:
            while any(not process.over for process in self._processes.values()):
                self._turn()
        finally:
            self.stopping = True
            for process in self._processes.values():
                while not process.over:
                    self._resume(process)
                process.thread.join(_TURN_S)

    def slow_down(self, node: str, times: float) -> None:
        """Give a node its turn so many times less often than the fastest of the others. Call before `run`."""
        self._pace[node] = 1.0 / times

    def burst(self) -> int:
        """How many ticks a node steps in its turn."""
        return 1 if self._random.random() < 0.8 else self._random.randint(2, _LONG_BURST)

    def send(self, key: str, data: bytes) -> None:
        """Put a message on its way; called by nodes."""
        self._quiet_rounds = 0
        self.messages += data[0] == FRAME
        self._links.setdefault(key, deque()).append(data)

    # --- one at a time

    def _turn(self) -> None:
        """Deliver one message, or let one node go on."""
        ready: list[tuple[float, Callable[[], None]]] = []
        for key, queue in self._links.items():
            if queue:
                ready.append((self._pace_of(key), lambda key=key: self._deliver(key)))  # type: ignore[misc] # a default
        for name, process in self._processes.items():
            if not process.over and process.can_go_on:
                ready.append((self._pace_of(name), lambda process=process: self._resume(process)))  # type: ignore[misc] # as above
        if not ready:
            self._let_time_pass()
            return
        [chosen] = self._random.choices([act for _, act in ready], [pace for pace, _ in ready])
        chosen()

    def _pace_of(self, name: str) -> float:
        """How often a key or a node gets its turn: some are up to a hundred times slower than others."""
        if name not in self._pace:
            self._pace[name] = 10.0 ** -self._random.uniform(0.0, 2.0)
        return self._pace[name]

    def _deliver(self, key: str) -> None:
        data = self._links[key].popleft()
        target = key.rpartition("to=")[2]
        if target == _MASTER:
            self._take_progress(key.rpartition("of=")[2].partition("/")[0], data)
        elif target == RECORDER:
            self._record(data)
        else:
            self._processes[target].channel.put(_Sample(_internal(key), data))
            self._processes[target].rung = True

    def _resume(self, process: _Process) -> None:
        process.turn.release()
        assert self.back.acquire(timeout=_TURN_S), f"{process.name} does not come back"
        if process.error is not None and not self.stopping:
            raise process.error

    def _let_time_pass(self) -> None:
        """Everybody waits: all waits time out."""
        self._quiet_rounds += 1
        if self._quiet_rounds > _QUIET_ROUNDS:
            waiting = [process.name for process in self._processes.values() if not process.over]
            where = dict(zip(self._nodes, self._progress, strict=True))
            raise AssertionError(f"a deadlock: {waiting} wait for ever; grant {self._grant}, progress {where}")
        for process in self._processes.values():
            process.rung = True

    # --- master and recorder

    def _take_progress(self, node: str, data: bytes) -> None:
        """The credit rule: nobody runs more than its window ahead of the slowest."""
        kind, _, _, point = HEADER.unpack_from(data)
        assert kind == PROGRESS
        number = self._nodes.index(node)
        self._progress[number] = max(self._progress[number], point)
        last = self._plan.grid.last_point
        if min(self._progress) < 0:
            return
        grant = min(*(p + w for p, w in zip(self._progress, self._windows, strict=True)), last)
        if grant > self._grant:
            self._grant = grant
            self._tell(GRANT, grant)
        if min(self._progress) >= last and not self._finished:
            self._finished = True
            self._tell(FINISH, 0)

    def _tell(self, kind: int, point: int) -> None:
        for node in self._processes:
            self.send(RUN.grants([node])[node], HEADER.pack(kind, 0, 0, point))

    def _record(self, data: bytes) -> None:
        kind, number, count, first = HEADER.unpack_from(data)
        if kind == NOTED:
            return  # how a loop was solved: for metadata only
        assert kind == FRAME
        receiver = self._receivers[number]
        before, mirror = receiver.received, self._mirrors[number]
        receiver.take(first, count, data)
        values = mirror.part("Float64")
        for row in range(before, receiver.received):
            assert mirror.has_row(row)
            self.recorded[receiver.link.source].append(values[row & mirror.mask].copy())
        last = self._plan.grid.last_point
        covered = [r.received * r.link.step_points for r in self._receivers.values()]
        complete = min(last if points > last else points - 1 for points in covered)
        stride = self._plan.nodes[RECORDER].progress_stride
        if self._told < 0 <= complete or complete >= self._told + stride or complete == last > self._told:
            self._told = complete
            self.send(RUN.progress(RECORDER), HEADER.pack(PROGRESS, 0, 0, complete))


class _Process:
    """A node's thread; it runs between `turn` and the release of the mesh's `back`."""

    def __init__(
        self, mesh: SimulatedMesh, plan: NodePlan, open_instance: Callable[[str], Instance], number: int
    ) -> None:
        self.name = plan.node
        self.mesh = mesh
        self.number = number
        self.channel = _Channel(self)
        self.engine: _SimulatedEngine | None = None
        self.rung = False
        self.turn = threading.Semaphore(0)
        self.thread = threading.Thread(target=self._live, name=f"node {plan.node}", daemon=True)
        self.over = False
        self.error: BaseException | None = None
        self._waiting = False
        self._plan = plan
        self._open_instance = open_instance

    @property
    def can_go_on(self) -> bool:
        """Whether it does not sleep, or its bell has rung."""
        return not self._waiting or self.rung

    @property
    def may_be_told(self) -> bool:
        """Whether this is a thread of the simulation; what other threads want has time until the next message."""
        return threading.current_thread() in (self.thread, self.mesh.thread)

    def sleep(self) -> None:
        """Let the others go on until the bell has rung, or time has passed."""
        self._waiting = True
        self.give_up()
        while not self.rung:
            self.give_up()
        self._waiting = False

    def give_up(self) -> None:
        """Let the others go on, once."""
        self.mesh.back.release()
        assert self.turn.acquire(timeout=2 * _TURN_S)
        if self.mesh.stopping:
            raise _Stopped

    def _live(self) -> None:
        self.turn.acquire()
        try:
            if not self.mesh.stopping:
                _SimulatedNode(self, self._plan, self._open_instance).run()
        except _Stopped:
            pass
        except BaseException as error:  # noqa: BLE001 raised again by the scheduler
            self.error = error
        finally:
            self.over = True
            self.mesh.back.release()


class _Stopped(BaseException):
    """The test ends before the node does."""


class _SimulatedNode(Node):
    """A node whose mesh is complete from the start."""

    def __init__(self, process: _Process, plan: NodePlan, open_instance: Callable[[str], Instance]) -> None:
        session = cast("zenoh.Session", _Session(process))
        super().__init__(plan, session, open_instance, engine=partial(_SimulatedEngine, process))
        self._memory = self._own_memory = _SimulatedMemory.of(process, plan)
        self._inbox.move_to(self._memory, self._memory)
        self._membership = _SimulatedMembership(plan, self._session, self._inbox)


class _SimulatedMemory(HostMemory):
    """Private memory; the scheduler decides how long a node sleeps."""

    _owner: _Process

    @classmethod
    def of(cls, process: _Process, plan: NodePlan) -> Self:
        """The memory of a node."""
        memory = cls.private(plan.memory, plan.node)
        memory._owner = process
        return memory

    def seen(self) -> int:
        self._owner.rung = False
        return 0

    def sleep(self, seen: int, timeout_s: float, wishes: Sequence[Wish] = ()) -> None:  # noqa: ARG002 time is simulated
        if timeout_s > 0 and not self._owner.rung:
            self._owner.sleep()

    def ring_bell(self) -> None:
        if self._owner.may_be_told:
            self._owner.rung = True


class _SimulatedEngine(PlainEngine):
    """Lets the others go on before it steps; then it takes one tick of each unit, or some more."""

    slice_s = -1.0

    def __init__(
        self,
        process: _Process,
        plan: NodePlan,
        units: Sequence[Sequence[Runner]],
        memory: HostMemory,
        windows: Windows,
        **_: object,
    ) -> None:
        super().__init__(plan, units, memory, windows)
        self._process = process
        process.engine = self

    @property
    def has_unsent(self) -> bool:
        """Whether another node may wait for rows of this one."""
        links = [(runner, link) for runner in self.runners for link in runner.out_links if link.has_frames]
        return any(link.sent <= runner.step for runner, link in links if not link.to_recorder)

    def run(self, wait_s: float, *, eager: bool, quiet: bool = False) -> bool:
        self._process.give_up()
        stepped = super().run(wait_s, eager=eager, quiet=quiet)
        for _ in range(1, self._process.mesh.burst() if stepped else 1):
            if not super().run(0.0, eager=eager):
                break
        return stepped

    def ring_bell(self) -> None:
        if self._process.may_be_told:
            super().ring_bell()


class _SimulatedMembership(Membership):
    """Everybody is there, and is reached through the wire of this module."""

    def register(self, *_: object) -> None:
        return

    def keys(self, _patience_s: float) -> RunKeys:
        return RUN

    def report(self, *_: object, **__: object) -> None:
        return

    def join(self) -> Welcome:
        plan = self._plan
        senders = {RUN.frames(link.source, plan.node): link.source_node for link in plan.links_in}
        senders[RUN.grants([plan.node])[plan.node]] = _MASTER
        self._inbox.open(self._session, RUN, plan.node, senders)
        return Welcome()


def _internal(key: str) -> str:
    """The key of a message without the name of the node that has put it."""
    return key[key.index(RUN.root) :]


class _Entity:
    """Whatever is declared and never used: nobody is outside of the mesh."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        return

    def undeclare(self) -> None:
        return

    def declare_matching_listener(self, _listener: object) -> _Entity:
        return _Entity()

    @property
    def matching_status(self) -> _Entity:
        return self

    @property
    def matching(self) -> bool:
        return False


class _Channel:
    """Where the samples for a node are until it takes them; its subscriber, too."""

    def __init__(self, process: _Process) -> None:
        self._process = process
        self._samples: deque[_Sample] = deque()
        self.put = self._samples.append
        self.wake: _Sample

    @property
    def handler(self) -> Self:
        return self

    def undeclare(self) -> None:
        return

    def __iter__(self) -> Iterator[_Sample]:
        return iter(())  # the node reads it itself

    def try_recv(self) -> _Sample | None:
        return self._samples.popleft() if self._samples else None

    def recv(self) -> _Sample:
        """The next sample; if the bell has rung without one, or time has passed, that which wakes the node."""
        engine = self._process.engine
        self._process.mesh.waits_before_sending += engine is not None and engine.has_unsent
        if not self._samples and not self._process.rung:
            self._process.sleep()
        return self.try_recv() or self.wake


class _Session:
    """As much of a session as a node uses."""

    def __init__(self, process: _Process) -> None:
        self._process = process

    def declare_subscriber(self, key: str, _handler: object, **_settings: object) -> _Entity | _Channel:
        return self._process.channel if key.endswith(f"/to={self._process.name}/**") else _Entity()

    def put(self, key: str, data: bytes, **_settings: object) -> None:
        """What a node sends to itself: its bell wakes it here."""
        self._process.channel.wake = _Sample(key, data)

    def declare_publisher(self, key: object, **_settings: object) -> _Entity:
        return _Publisher(self._process, str(key)) if "/@sync/" in str(key) else _Entity()

    def declare_queryable(self, _key: str, _handler: object = None) -> _Entity:
        return _Entity()

    def liveliness(self) -> Self:
        return self

    def declare_token(self, _key: str) -> _Entity:
        return _Entity()


class _Publisher(_Entity):
    def __init__(self, process: _Process, key: str) -> None:
        self._process = process
        self._key = key

    def put(self, data: bytes) -> None:
        self._process.mesh.send(f"{self._process.name}/{self._key}", data)


class _Sample:
    """A sample, and its payload."""

    def __init__(self, key: str, data: bytes) -> None:
        self.key_expr = key
        self._data = data

    @property
    def payload(self) -> Self:
        return self

    def to_bytes(self) -> bytes:
        return self._data
