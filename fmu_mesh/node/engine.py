"""The engine of a node: steps its runners as far as inputs, windows and the grant allow.

`BurstEngine` hands tables to the burst in C, which also waits (`fmu_mesh/rings/burst.c`). `PlainEngine` is the same in
plain Python, for one process: where the library is missing, all other processes are reached by frames, so it waits for
nothing but its inbox.
"""

from __future__ import annotations

import ctypes
from abc import ABC, abstractmethod
from collections.abc import Sequence
from functools import partial
from threading import Lock
from time import perf_counter
from typing import Final, cast

from ..errors import FmuMeshError, ProtocolBroken, TerminationRequested
from ..instances.contract import StepsNatively
from ..instances.process_state import ProcessState, floating_point_changed, restore_floating_point
from ..rings import native
from ..rings.host_memory import HostMemory
from ..rings.native import NEVER, OUT_OF_RANGE, STAGE_BITS, BurstEnd, RowBase, Stage, StepKind, table
from ..system.plan import NodePlan
from .inputs import TimedInputs
from .stepping import Position, PositionInTable, Runner

__all__ = ["BurstEngine", "Engine", "PlainEngine", "make_engine"]

_SLICE_S: Final = 0.001
"""A burst of steps ends after about this time in s, so that its rows are sent and messages are handled."""

_STATE_CHECK_S: Final = 0.05
"""How often in s, at the end of a burst, a changed state of the process is looked for, which takes 10 us. Models that
are known to change it are looked after in each step."""

_BUSY: Final = (Stage.SETTING, Stage.STEPPING, Stage.GETTING, Stage.IN_PYTHON)


class Engine(ABC):
    """Steps the units of a node.

    Args:
        plan: the plan of the node.
        units: the runners of each unit, in the order of the plan.
        memory: with the grant and the progress of all nodes.
        shared: whether the other nodes of the run write their progress there, so that the windows are kept here.

    Attributes:
        waited_s: time that it has waited in s.
        sending: held by whoever sends rows: the main thread between bursts, or another one during a long step.
    """

    def __init__(self, plan: NodePlan, units: Sequence[Sequence[Runner]], memory: HostMemory, *, shared: bool) -> None:
        self.units = units
        self.runners = [runner for unit in units for runner in unit]
        self.waited_s = 0.0
        self.sending = Lock()
        self._plan = plan
        self._memory = memory
        self._progress = memory.progress[plan.node]
        self._windows = [(memory.progress[name], window) for name, window in plan.windows] if shared else []
        self._last_point = plan.grid.last_point
        self._looked_after: ProcessState | None = None
        self._look_at = 0.0

    def run(self, wait_s: float, *, eager: bool) -> bool:
        """Step for about a millisecond, and wait for up to ``wait_s`` where nothing can step; whether there was a step.

        Args:
            wait_s: in s.
            eager: whether to return instead of waiting when there was a step: its rows have to be sent.

        Raises:
            FmuMeshError: a step failed, or a ring has something that its writer never wrote.
            TerminationRequested: an FMU asks to end the simulation.

        The unit of an instance that raised one of them is not stepped any more.
        """
        self._looked_after = self._looked_after or ProcessState()
        looks = True
        try:
            stepped = self._burst(wait_s, eager=eager)
            looks = perf_counter() >= self._look_at
        finally:
            if looks:
                self._look_at = perf_counter() + _STATE_CHECK_S
                if self._looked_after.restore():
                    for runner in self.runners:
                        runner.take_care()
        return stepped

    @abstractmethod
    def _burst(self, wait_s: float, *, eager: bool) -> bool:
        """As `run`, which then restores the state of the process."""

    @abstractmethod
    def ring_bell(self) -> None:
        """From any thread: let `run` return after the current step."""

    @property
    def covered(self) -> int:
        """The last point for which all outputs of this node are known."""
        return min(runner.covered for runner in self.runners)

    @property
    def current(self) -> Runner | None:
        """The runner whose step is under way, or has failed; from any thread."""
        return next((own for own in self.runners if own.stage in _BUSY and own.step < own.last_step), None)

    @property
    @abstractmethod
    def spent_s(self) -> list[float]:
        """How long each unit was stepped, in s."""

    @property
    def awaited(self) -> str | None:
        """The instance or node whose progress the last wait was for; None: it was the master's grant."""
        own = {runner.name for runner in self.runners}
        sources = (source for runner in self.runners for source in runner.lacking)
        return next((source.instance for source in sources if source.instance not in own), None)

    def tick_points(self, unit: Sequence[Runner]) -> int:
        """Base points of one tick: a unit of one instance ticks at its own points, a cycle at every point."""
        return unit[0].plan.step_points if len(unit) == 1 else 1


def make_engine(
    plan: NodePlan, units: Sequence[Sequence[Runner]], memory: HostMemory, *, shared: bool, spins: bool
) -> Engine:
    """The engine for this machine."""
    if native.library is None:
        return PlainEngine(plan, units, memory, shared=shared)
    return BurstEngine(plan, units, memory, shared=shared, spins=spins)


class BurstEngine(Engine):
    """Steps with the burst in C."""

    def __init__(
        self, plan: NodePlan, units: Sequence[Sequence[Runner]], memory: HostMemory, *, shared: bool, spins: bool
    ) -> None:
        super().__init__(plan, units, memory, shared=shared)
        assert native.library is not None
        self._library = native.library
        self._kept: dict[tuple[int, int], list[object]] = {}
        self._tracks: dict[tuple[int, int], list[object]] = {}
        self._members = [(native.MemberTable * len(unit))() for unit in units]
        self._units = table(native.UnitTable, [self._unit(number) for number in range(len(units))])
        self._peers = table(native.Peer, [native.Peer(counter.address, window) for counter, window in self._windows])
        self._node = native.NodeTable(
            place=memory.place,
            units=self._units,
            n_units=len(units),
            peers=self._peers,
            n_peers=len(self._windows),
            ceiling=memory.grant.address,
            progress=self._progress.address,
            last_point=self._last_point,
            slice_ns=int(_SLICE_S * 1e9),
            spins=spins,
            batch=plan.batch,
            stride=1,
        )
        self._address = ctypes.addressof(self._node)
        for number, unit in enumerate(units):
            for index, runner in enumerate(unit):
                fill = partial(self._fill, number, index)
                runner.follow(PositionInTable(self._members[number][index], fill))
                fill()

    def _burst(self, wait_s: float, *, eager: bool) -> bool:
        """See `Engine`."""
        node, library = self._node, self._library
        node.wait_ns, node.eager = int(wait_s * 1e9), eager
        started, before = perf_counter(), self._ticks
        while True:
            result = library.run(self._address)
            if result < BurstEnd.PYTHON:
                break
            runner, member = self._at(node.unit, node.member)
            if result == BurstEnd.FORGED:
                raise self._forged(runner)
            began = perf_counter()
            self._complete(node.unit, runner, member, result)
            self._units[node.unit].spent_ns += int((perf_counter() - began) * 1e9)
            if perf_counter() - started > _SLICE_S:
                library.attend(self._address)  # so it returns after this tick
        library.attended(self._address)
        self.waited_s = node.waited_ns / 1e9
        return self._ticks != before

    def ring_bell(self) -> None:
        """See `Engine`."""
        self._library.attend(self._address)

    @property
    def spent_s(self) -> list[float]:
        """See `Engine`."""
        return [unit.spent_ns / 1e9 for unit, _ in zip(self._units, self.units, strict=False)]

    @property
    def awaited(self) -> str | None:
        """See `Engine`."""
        names = {source.counter.address: source.instance for runner in self.runners for source in runner.sources}
        names |= {counter.address: name for name, counter in self._memory.progress.items()}
        unfinished = (unit for unit in self._units if unit.tick < unit.last_tick and not unit.stopped)
        return next((names.get(unit.blocked_by) for unit in unfinished if unit.blocked_by is not None), None)

    @property
    def late(self) -> int:
        """How often a sleep ended by its time limit although the value was there: 0 where no wake-up is lost."""
        return int(self._node.late)

    @property
    def _ticks(self) -> int:
        return sum(runner.step for runner in self.runners)

    def _unit(self, number: int) -> native.UnitTable:
        unit = self.units[number]
        points = self.tick_points(unit)
        last_tick = unit[0].last_step if len(unit) == 1 else self._last_point
        return native.UnitTable(
            members=self._members[number], n_members=len(unit), tick_points=points, last_tick=last_tick, burst=1
        )

    def _fill(self, unit: int, index: int) -> None:
        """Fill the table of a runner: at the start, and again whenever it steps in another way."""
        runner, before = self._at(unit, index)
        own = runner.instance.native if isinstance(runner.instance, StepsNatively) else None
        if own is not None and any(source.transfer.has_text for source in runner.sources):
            own = None
        gates, loads = [], []
        for number, source in enumerate(runner.sources):
            gates.append(source.gate)
            loads += source.transfer.moves(RowBase.FIRST_GATE + number)
        loads += own.loads if own is not None else ()
        setters, getters, stores = (own.setters, own.getters, own.stores) if own is not None else ((), (), ())
        bases = (ctypes.c_void_p * (RowBase.FIRST_GATE + len(gates)))()
        grid, points = runner.grid, runner.plan.step_points
        watched = runner.watched if runner.watched is not None else runner.outputs
        rings = [native.OutputTable(ring.address, ring.stride, ring.mask) for ring in (runner.outputs, watched)]
        made = native.MemberTable(
            gates=table(native.Gate, gates),
            loads=table(native.Move, loads),
            setters=table(native.Call, setters),
            getters=table(native.Call, getters),
            stores=table(native.Move, stores),
            n_gates=len(gates),
            n_loads=len(loads),
            n_setters=len(setters),
            n_getters=len(getters),
            n_stores=len(stores),
            kind=own.kind if own is not None else StepKind.BY_PYTHON,
            component=own.component if own is not None else None,
            do_step=own.do_step if own is not None else None,
            said=own.said if own is not None else None,
            start_time=grid.start_time,
            base_step_size=grid.step_size,
            step_size=points * grid.step_size,
            points=points,
            every=points // self.tick_points(self.units[unit]),
            last_step=runner.last_step,
            outputs=(native.OutputTable * 2)(*rings),
            counter=runner.counter.address,
            bases=ctypes.cast(bases, ctypes.POINTER(ctypes.c_void_p)),
            step=before.step,
            stage=before.stage,
            outcome=before.outcome,
        )
        made.check_rows(runner.is_finite.spans)
        self._kept[unit, index] = [made, bases, own]  # what the table points to
        self._members[unit][index] = made
        self._follow(unit, index)

    def _follow(self, unit: int, index: int) -> None:
        """Note in the table of a runner which step Python takes next, and what its inputs are in the steps before."""
        runner, member = self._at(unit, index)
        timed = runner.instance if isinstance(runner.instance, TimedInputs) else None
        member.python_at = timed.python_at if timed is not None else NEVER
        tracks = timed.tracks if timed is not None else []
        addresses = [native.Track(values.ctypes.data, to) for to, values in tracks]
        made = table(native.Track, addresses)
        self._tracks[unit, index] = [made, tracks]  # what the table points to
        member.tracks, member.n_tracks = made, len(addresses)
        member.tracks_from = timed.tracks_from if timed is not None else 0

    def _at(self, unit: int, member: int) -> tuple[Runner, native.MemberTable]:
        return self.units[unit][member], self._members[unit][member]

    def _complete(self, unit: int, runner: Runner, member: native.MemberTable, result: int) -> None:
        """Let Python take a step, or complete one that returned something unusual."""
        step = member.step
        try:
            if result == BurstEnd.NOT_FINITE:
                raise runner.is_finite.error(step + 1, runner.grid)
            if result == BurstEnd.PYTHON:
                for source in runner.sources:
                    source.transfer.step_text(step)
                runner.instance.do_step(step)
                self._follow(unit, self._node.member)
            else:
                if divmod(member.outcome, 1 << STAGE_BITS) == (Stage.SETTING, OUT_OF_RANGE):
                    for source in runner.sources:
                        source.transfer.check_range(step)
                if member.kind == StepKind.BY_PYTHON:
                    raise self._forged(runner)  # it was out of range when the burst has read it
                cast("StepsNatively", runner.instance).finish(step, member.outcome)
        except FmuMeshError as error:
            self._units[unit].stopped = 1
            runner.is_finite.explain(error)
            if isinstance(error, TerminationRequested):
                member.stage = Stage.WAITING
            raise
        if floating_point_changed():
            restore_floating_point()
        member.stage = Stage.STEPPED

    def _forged(self, runner: Runner) -> ProtocolBroken:
        source = next(
            (
                source
                for source in runner.sources
                if not source.transfer.source.has_row(source.transfer.rule.row_for(runner.step))
            ),
            runner.sources[0],
        )
        return ProtocolBroken(
            f"a row of '{source.instance}' for '{runner.name}' is not the one that was written",
            instance=runner.name,
            point=runner.point,
            time=runner.grid.time(runner.point),
            hint="Does another process write to the memory of this run?",
        )


class PlainEngine(Engine):
    """Steps in plain Python.

    Args:
        slice_s: time in s after which `run` returns, once every unit had a turn.
    """

    def __init__(
        self,
        plan: NodePlan,
        units: Sequence[Sequence[Runner]],
        memory: HostMemory,
        *,
        shared: bool,
        slice_s: float = _SLICE_S,
    ) -> None:
        super().__init__(plan, units, memory, shared=shared)
        self._slice_s = slice_s
        self._positions = {runner.name: Position() for runner in self.runners}
        self._ticks = [0] * len(units)
        self._next = [0] * len(units)
        self._stopped: set[int] = set()
        self._spent_s = [0.0] * len(units)
        self._attention = False
        for runner in self.runners:
            runner.follow(self._positions[runner.name])

    def _burst(self, wait_s: float, *, eager: bool) -> bool:  # noqa: ARG002  it never waits after a step
        """See `Engine`."""
        started = perf_counter()
        seen = self._memory.seen()
        stepped = False
        while not self._attention:
            advanced = [self._advance(number, started) for number in range(len(self.units))]
            self._progress.raise_to(self.covered + 1)
            stepped = stepped or any(advanced)
            if not any(advanced) or perf_counter() - started > self._slice_s:
                break
        if not stepped and not self._attention:
            began = perf_counter()
            self._memory.sleep(seen, wait_s)
            self.waited_s += perf_counter() - began
        self._attention = False
        return stepped

    def ring_bell(self) -> None:
        """See `Engine`."""
        self._attention = True
        self._memory.ring_bell()

    @property
    def spent_s(self) -> list[float]:
        """See `Engine`."""
        return self._spent_s

    def _allowed(self) -> int:
        """The point up to which the grant and the windows allow steps."""
        limits = [counter.value - 1 + window for counter, window in self._windows]
        return min(self._memory.grant.value, self._last_point, *limits)

    def _advance(self, number: int, started: float) -> bool:
        """Step one unit for the rest of the slice; whether there was a step."""
        unit, tick_points = self.units[number], self.tick_points(self.units[number])
        last = unit[0].last_step if len(unit) == 1 else self._last_point
        began, stepped = perf_counter(), False
        while number not in self._stopped and self._ticks[number] < last and not self._attention:
            if not self._next[number] and self._ticks[number] * tick_points >= self._allowed():
                break
            for index in range(self._next[number], len(unit)):
                self._next[number] = index
                every = unit[index].plan.step_points // tick_points
                if (self._ticks[number] + 1) % every:
                    continue
                if any(unit[index].lacking):
                    self._spent_s[number] += perf_counter() - began
                    return stepped
                self._step(number, unit[index])
                stepped = True
            self._ticks[number] += 1
            self._next[number] = 0
            if perf_counter() - started > self._slice_s:
                break
        self._spent_s[number] += perf_counter() - began
        return stepped

    def _step(self, number: int, runner: Runner) -> None:
        position = self._positions[runner.name]
        step = position.step
        try:
            for source in runner.sources:
                source.transfer.step(step)
            position.enter(Stage.IN_PYTHON)
            runner.instance.do_step(step)
            if not runner.is_finite.check(step + 1):
                raise runner.is_finite.error(step + 1, runner.grid)
        except FmuMeshError as error:
            self._stopped.add(number)
            runner.is_finite.explain(error)
            raise
        finally:
            position.enter(Stage.WAITING)
        if floating_point_changed():
            restore_floating_point()
        runner.outputs.stamp(step + 1)
        position.count()
        runner.counter.raise_to(step + 2)
