"""The engines of all nodes of a plan on one memory, without messages: as on one host, but in this process.

Masters and recorders are simulated; each engine is the real one. They step in turn, in an order that a seed decides, or
each in a thread of its own.
"""

from __future__ import annotations

import random
import threading
import time
from collections.abc import Callable, Sequence
from functools import partial

import numpy as np
from numpy.typing import NDArray

from fmu_mesh.instances.contract import Instance
from fmu_mesh.node.burst_engine import BurstEngine
from fmu_mesh.node.engine import Engine, Windows
from fmu_mesh.node.stepping import Runner, sources_of
from fmu_mesh.rings.host_memory import Counter, HostMemory
from fmu_mesh.rings.ring import Ring
from fmu_mesh.system.plan import MASTER, RECORDER, NodePlan, Plan
from fmu_mesh.wire.frames import SourceRows

__all__ = ["EngineMesh", "MakeEngine", "burst_engine", "windows_of"]

MakeEngine = Callable[[NodePlan, Sequence[Sequence[Runner]], HostMemory], Engine]

_QUIET_TURNS = 200
_END_S = 60.0


def burst_engine(plan: NodePlan, units: Sequence[Sequence[Runner]], memory: HostMemory) -> BurstEngine:
    """An engine that steps in C."""
    return BurstEngine(plan, units, memory, windows_of(plan, memory), spins=True)


def windows_of(plan: NodePlan, memory: HostMemory) -> Windows:
    """Those of a node whose others all share its memory."""
    return [(name, memory.progress[name], window) for name, window in plan.windows]


class EngineMesh:
    """Runs the engines of a plan.

    Args:
        plan: the plan of the whole mesh.
        open_instance: opens an instance by name.
        make: makes the engine of a node.

    Attributes:
        memory: what all of them share.
        rings: the ring of each instance, with its counter.
        engines: by node.
        runners: by instance.
        recorded: rows (Float64) that a recorder has read, by instance.
    """

    def __init__(self, plan: Plan, open_instance: Callable[[str], Instance], make: MakeEngine = burst_engine) -> None:
        self._plan = plan
        self._last_point = plan.grid.last_point
        first = next(iter(plan.nodes.values()))
        self.memory = HostMemory.private(first.memory, MASTER)
        self.recorded: dict[str, list[NDArray[np.float64]]] = {}
        self.rings: dict[str, tuple[Ring, Counter]] = {}
        self.runners: dict[str, Runner] = {}
        for node in plan.nodes.values():
            for place in node.rings:
                if place.node == node.node:
                    ring = self.memory.ring(place), self.memory.counter(place.counter)
                    self.rings[place.instance] = ring
                    instance = open_instance(place.instance)
                    self.runners[place.instance] = Runner(node.instance(place.instance), instance, plan.grid, *ring)
        self._written = 0
        self._recorded = list(dict.fromkeys(name for name, _ in plan.system.recorded)) if self._records else []
        self.recorded = {name: [] for name in self._recorded}
        self.engines = {name: self._engine(node, make) for name, node in plan.nodes.items() if name != RECORDER}

    @property
    def _records(self) -> bool:
        return RECORDER in self._plan.nodes

    def _engine(self, node: NodePlan, make: MakeEngine) -> Engine:
        sources = {name: [SourceRows(*ring)] for name, ring in self.rings.items()}
        for item in node.instances:
            runner = self.runners[item.name]
            runner.sources.extend(sources_of(runner, sources))
            runner.instance.enter_initialization(self._plan.grid.start_time, None, item.start_values)
            runner.instance.exit_initialization()
            runner.bind()
        units = [[self.runners[name] for name in names] for names in node.units]
        engine = make(node, units, self.memory.participant(node.node))
        for unit in units:
            for runner in unit:
                runner.begin()
        self.memory.progress[node.node].raise_to(engine.covered + 1)
        return engine

    @property
    def is_over(self) -> bool:
        """Whether everybody is at the last point."""
        return all(counter.value > self._last_point for counter in self.memory.progress.values())

    def run(self, seed: int = 0) -> None:
        """Let engines, master and recorder go on one after the other, to the last point.

        Raises:
            AssertionError: nobody can go on.
            FmuMeshError: of an engine.
        """
        chance = random.Random(seed)  # noqa: S311 no secret
        any_ = partial(chance.choice, (False, True))
        acts: list[Callable[[], object]] = [
            *(lambda engine=engine: engine.run(0.0, eager=any_(), quiet=any_()) for engine in self.engines.values()),
            lambda: self.grant(chance.randint(1, 20)),
            *([self.record] if self._records else []),
        ]
        quiet, before = 0, self._state()
        while not self.is_over:
            chance.choice(acts)()
            after = self._state()
            quiet, before = 0 if after != before else quiet + 1, after
            assert quiet < _QUIET_TURNS * len(acts), f"a deadlock: {self._state()}"

    def run_in_threads(self) -> None:
        """Let each engine run in its own thread, as processes do; all is granted.

        Raises:
            AssertionError: they do not come to the end in time.
            BaseException: of an engine.
        """
        errors: list[BaseException] = []

        def step(engine: Engine) -> None:
            try:
                while engine.covered < self._last_point and time.monotonic() < end:
                    engine.run(_END_S, eager=False)
            except BaseException as error:  # noqa: BLE001 raised again below
                errors.append(error)

        end = time.monotonic() + _END_S
        self.memory.grant.raise_to(self._last_point)
        threads = [threading.Thread(target=step, args=(engine,)) for engine in self.engines.values()]
        for thread in threads:
            thread.start()
        slowest = [counter for name, counter in self.memory.progress.items() if name != RECORDER]
        while self._records and not errors and self._written <= self._last_point and time.monotonic() < end:
            self.memory.sleep(self.memory.seen(), 0.1, [(counter, self._written + 1) for counter in slowest])
            self.record()
        for thread in threads:
            thread.join(_END_S)
        if errors:
            raise errors[0]
        assert self.is_over, self._state()

    def grant(self, points: int) -> None:
        """Grant some points more than the slowest node has reached."""
        slowest = min(counter.value for name, counter in self.memory.progress.items() if name != RECORDER)
        self.memory.grant.raise_to(min(slowest - 1 + points, self._last_point))

    def record(self) -> None:
        """Read the rows of all complete points, as the recorder does; the ring must still have them."""
        while self._written <= self._last_point and all(
            self.rings[name][1].value > self._row(name, self._written) for name in self._recorded
        ):
            for name in self._recorded:
                ring, _ = self.rings[name]
                row = self._row(name, self._written)
                assert ring.has_row(row)
                if row == len(self.recorded[name]):
                    self.recorded[name].append(ring.part("Float64")[row & ring.mask].copy())
            self._written += 1
        self.memory.progress[RECORDER].raise_to(self._written)

    def _row(self, name: str, point: int) -> int:
        return point // self.runners[name].plan.step_points

    def _state(self) -> dict[str, int]:
        progress = {name: counter.value for name, counter in self.memory.progress.items()}
        steps = {name: runner.step for name, runner in self.runners.items()}
        return {"grant": self.memory.grant.value, **progress, **steps}
