"""One system in this process: its memory, its instances and what steps them; it can begin again at point 0.

Owns what does not depend on a run, so that many runs of one plan share it. Knows no result files and no end of a run:
`fmu_mesh.run.repeated` steps it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import Final

from msgspec.structs import replace

from ..errors import FmuError, TerminationRequested
from ..instances.call_guard import CallWatch, Guarded, Unwatched
from ..instances.contract import Instance, LogMessage
from ..instances.process_state import ProcessState
from ..node.burst_engine import make_engine
from ..node.engine import Engine
from ..node.initialization import Initialization
from ..node.inputs import with_times
from ..node.runner_states import load_states, set_again
from ..node.stepping import Runner, connect
from ..rings import native
from ..rings.host_memory import HostMemory
from ..rings.ring import Ring
from ..system.layout import row_bytes
from ..system.memory_map import MemoryMap, RingPlace
from ..system.plan import Plan, make_plan
from ..system.states import BeginsWith
from ..variables.value_types import PlainValue

__all__ = ["IN_ONE_NODE", "HostedSystem", "in_one_node"]

IN_ONE_NODE: Final = "instances"
"""The node with all instances."""


# Of rows that are wider, a few are in memory.
_WIDE_ROW_BYTES = 2**20


class HostedSystem:
    """The instances of a plan in one node of this process, with their rings and the engine that steps them.

    Call sequence, on one thread: `open`, `begin`, steps of the engine by `Engine.step_to`; then `end`, and `open` again
    if that returned True; at last, and after any exception, `close`. Each run has new instances, or those that were
    reset, as the model of an instance is kept (`fmu_mesh.instances.kept_models`). The first run looks after each call
    of an FMU; the state of the process is then looked after once in each later run, and the floating-point mode still
    after each call.

    Args:
        plan: a plan of `in_one_node`.
        watch: watches all calls, if somebody does.
        open_instance: opens the instance with this name.
        log: called with what inputs over time warn of.
        alone: whether nothing else in this process changes its state between the runs, so that it is looked after as
            between steps: several times a second, and not once in each run.
        places: where the rings are in memory, if not as in the plan.
        room: memory of zeros for them; None: memory of its own.
        begins_with: the states of the first point, if it is not that after Initialization Mode; then it has one run.

    Attributes:
        plan: the plan.
        runners: the instances, by name.
        loads: whether the next `open` opens instances, and does not use those that are there.
    """

    def __init__(  # noqa: PLR0913  what a system needs of its surroundings
        self,
        plan: Plan,
        watch: CallWatch | Unwatched,
        open_instance: Callable[[str], Instance],
        log: Callable[[LogMessage], None],
        *,
        alone: bool,
        places: tuple[MemoryMap, Mapping[str, RingPlace]] | None = None,
        room: memoryview | None = None,
        begins_with: BeginsWith | None = None,
    ) -> None:
        self.plan = plan
        self.node = node = plan.nodes[IN_ONE_NODE]
        map_, self._places = places or (node.memory, {place.instance: place for place in node.rings})
        self.memory = HostMemory.private(map_, IN_ONE_NODE, room)
        self.runners: dict[str, Runner] = {}
        self.loads = True
        self._watch = watch
        self._open_instance, self._log = open_instance, log
        self._instances: list[Guarded] = []
        self._engine: Engine | None = None
        self._alone = alone
        self._state: ProcessState | None = None
        self._begins_with = begins_with or BeginsWith()
        self._begins_again, self._names = begins_with is None, ", ".join(plan.order)
        self._initialization = Initialization(node)

    def open(self) -> None:
        """Open all instances; after `end`, they begin again.

        Raises:
            LoadFailed: one cannot be opened.
        """
        if not self.loads:
            self._state = None if self._alone else ProcessState()
            self.memory.begin_again()
            for instance in self._instances:
                instance.begin_again()
            return
        node = self.node
        for item in node.instances:
            instance = Guarded(item.name, partial(self._open_instance, item.name), self._watch, node.timeouts)
            self._instances.append(instance)
            place = self._places[item.name]
            ring, counter = self.memory.ring(place), self.memory.counter(place.counter)
            timed = with_times(instance, item, node.grid, self._log)
            self._begins_again = self._begins_again and timed is instance
            inputs = Ring(item.input_row, 1, self.memory.beside(row_bytes(item.input_row)))
            self.runners[item.name] = Runner(item, timed, node.grid, ring, counter, inputs=inputs)
        connect(node, self.runners, self.memory, self.memory)

    def begin(self, start_values: Mapping[str, Mapping[str, PlainValue]]) -> Engine:
        """Initialization Mode, as `Node` does it; then the outputs are those of the first point.

        Args:
            start_values: by instance and variable, those that are not as in the plan.

        Raises:
            FmuError: an instance cannot be initialized.
        """
        node, engine = self.node, self._engine
        self._initialization.run(self.runners.values(), start_values, again=engine is not None)
        load_states(self._begins_with, self.runners)
        if engine is None:
            units = [[self.runners[name] for name in self.plan.order]]  # called in this order at each point
            engine = self._engine = make_engine(node, units, self.memory, spins=False)
        else:
            engine.begin_again(self._state)
        for runner in self.runners.values():
            runner.begin()
        set_again(self._begins_with, self.runners)
        self.memory.grant.raise_to(self.plan.grid.last_point)
        return engine

    def located(self, event: FmuError | TerminationRequested, point: int) -> None:
        """Tell where a step that ended with this began: an instance with a step size of its own, before ``point``."""
        if event.point is None:
            runner = self.runners.get(event.instance or "") or (self._engine.current if self._engine else None)
            begun = runner.point if isinstance(event, FmuError) and runner is not None else point
            event.at(begun, self.plan.grid.time(begun))

    def end(self) -> bool:
        """After the last point: end the run of all instances, and keep what the next one needs; whether that works."""
        if not self._begins_again or not all(instance.runs_again for instance in self._instances):
            return False
        state = self._state or (None if self._alone else ProcessState())
        with self._watch.surviving(self._names):
            ended = [instance.end_run() for instance in reversed(self._instances)]
        self.loads = not all(ended) or (state is not None and state.restore())
        return not self.loads

    def close(self) -> None:
        """Close all instances, and free the memory. May be called twice."""
        self.loads = True
        if self._alone and self._engine is not None:  # elsewhere each run has looked, and the program goes on
            self._engine.look_after()
        for instance in reversed(self._instances):
            instance.close()
        self._instances.clear()
        for runner in self.runners.values():
            runner.follow(native.MemberTable())  # so it is in no cycle of objects any more
        self.runners.clear()
        self._engine = None


def in_one_node(plan: Plan, files: int | None = None, window: int | None = None) -> Plan:
    """The plan of the same system with all instances in one node, and the first ``files`` result files; None: all.

    Without a window, it is as large as the memory for rows allows.
    """
    system = plan.system
    rows = [row_bytes(item.outputs) for node in plan.nodes.values() for item in node.instances]
    chosen = window or (1 if max(rows, default=0) > _WIDE_ROW_BYTES else "auto")
    config = replace(system.config, simulation=replace(system.config.simulation, window=chosen))
    instances = {name: replace(own, node=IN_ONE_NODE) for name, own in system.instances.items()}
    return make_plan(replace(system, config=config, instances=instances, records=system.records[:files]))
