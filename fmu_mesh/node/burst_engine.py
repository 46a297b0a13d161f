"""Steps the runners of a node with the burst in C, which also waits (`fmu_mesh/rings/burst.c`)."""

from __future__ import annotations

import ctypes
import math
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import partial
from itertools import chain
from time import perf_counter
from typing import Final, cast

from ..errors import FmuMeshError, ProtocolBroken, StepPending, TerminationRequested
from ..instances.contract import StepsNatively
from ..instances.process_state import ProcessState, floating_point_changed, restore_floating_point
from ..rings import native
from ..rings.host_memory import HostMemory
from ..rings.native import NEVER, OUT_OF_RANGE, STAGE_BITS, BurstEnd, RowBase, Stage, StepKind, table
from ..rings.row_streams import RowStreams
from ..system.plan import NodePlan
from .engine import SLICE_S, STATE_CHECK_S, Engine, PlainEngine, Windows
from .inputs import TimedInputs
from .stepping import RowPlayer, Runner

__all__ = ["BurstEngine", "make_engine"]

_PLAYED_TICKS: Final = 4096
"""How many rows are played at once."""


def make_engine(  # noqa: PLR0913  one node and how it is connected
    plan: NodePlan,
    units: Sequence[Sequence[Runner]],
    memory: HostMemory,
    windows: Windows = (),
    *,
    spins: bool,
    streams: RowStreams | None = None,
) -> Engine:
    """The engine for this machine."""
    if native.library is None:
        return PlainEngine(plan, units, memory, windows)
    return BurstEngine(plan, units, memory, windows, spins=spins, streams=streams)


class BurstEngine(Engine):
    """Steps with the burst in C."""

    def __init__(  # noqa: PLR0913  one node and how it is connected
        self,
        plan: NodePlan,
        units: Sequence[Sequence[Runner]],
        memory: HostMemory,
        windows: Windows = (),
        *,
        spins: bool,
        streams: RowStreams | None = None,
    ) -> None:
        super().__init__(plan, units, memory, windows)
        self._streams = streams
        assert native.library is not None
        self._library = native.library
        self._kept: dict[str, list[object]] = {}
        self._tracks: dict[str, list[object]] = {}
        self._by_python: dict[str, Callable[[int], None]] = {}
        self._spent_s = [0.0] * len(units)  # by Python
        self._peers = table(native.Peer, [native.Peer(counter.address, window) for _, counter, window in self._windows])
        self._node = native.NodeTable(
            place=memory.place,
            streams=streams.address if streams is not None else None,
            units=self._units,
            n_units=len(units),
            peers=self._peers,
            n_peers=len(self._windows),
            ceiling=memory.grant.address,
            finish=memory.finish.address if streams is not None else None,
            progress=self._progress.address,
            last_point=self._last_point,
            slice_ns=int(SLICE_S * 1e9),
            spins=spins,
            batch=plan.batch,
            stride=1,
        )
        self._address = ctypes.addressof(self._node)
        self._copy = self.copy
        for runner in self.runners:
            runner.refit()

    def begin_again(self, looked_after: ProcessState | None) -> None:
        """See `Engine`."""
        super().begin_again(looked_after)
        self._node.note(allowed=0, stride=1, patience=0)  # nothing of the grant before is known any more
        self._copy, self._spent_s = self.copy, [0.0] * len(self.units)

    def _burst(self, wait_s: float, *, eager: bool, quiet: bool) -> bool:
        node, library = self._node, self._library
        most_s = STATE_CHECK_S if quiet else SLICE_S
        node.wait_ns, node.eager, node.quiet_ns = int(wait_s * 1e9), eager, int(most_s * 1e9) if quiet else 0
        started, before, waited_ns = perf_counter(), self._ticks, node.waited_ns
        while (result := self._run(None, most_s)) >= BurstEnd.PYTHON:
            try:
                self.complete(result)
            except StepPending:  # the node looks at what else there is, and calls again
                result = BurstEnd.BLOCKED
                break
            if perf_counter() - started > most_s:
                library.attend(self._address)  # so it returns after this tick
        library.attended(self._address)
        self.is_blocked = result in {BurstEnd.BLOCKED, BurstEnd.DONE}
        self.note_wait((node.waited_ns - waited_ns) / 1e9)
        return self._ticks != before

    def _run(self, copy: int | None, most_s: float) -> int:
        """Step, in Python, too; with the address of a copy as one of many systems."""
        try:
            return int(self._library.run(self._address, copy, int(most_s * 1e9)))
        except FmuMeshError as error:
            self._failed(asks_to_end=isinstance(error, TerminationRequested)).is_finite.explain(error)
            raise

    def complete(self, result: int) -> None:
        """Let Python take or complete the step with which a burst has ended, or raise what it has ended with."""
        node, began = self._node, perf_counter()
        runner = self.units[node.unit][node.member]
        member = runner.table
        if result == BurstEnd.FORGED:
            raise self._forged(runner)
        if result == BurstEnd.BLOCKED:
            raise ProtocolBroken("an instance cannot step, although all instances before it have stepped")
        try:
            if result == BurstEnd.PYTHON:
                self._by_python[runner.name](member.step)
            else:
                self._complete(runner, result)
        except StepPending:
            member.stage = Stage.WAITING
            raise
        except FmuMeshError as error:
            self._failed(asks_to_end=isinstance(error, TerminationRequested)).is_finite.explain(error)
            raise
        if floating_point_changed():
            restore_floating_point()
        member.stage = Stage.STEPPED
        self._spent_s[node.unit] += perf_counter() - began

    def _failed(self, *, asks_to_end: bool) -> Runner:
        """Note that Python has not been able to take or complete a step; whose step it is."""
        unit, index = self._node.unit, self._node.member
        runner: Runner = self.units[unit][index]
        self._units[unit].stopped = 1
        if asks_to_end:
            runner.table.note(stage=Stage.WAITING)
        return runner

    @property
    def copy(self) -> native.CopyTable:
        """How the library steps it as one of many systems, from the first point on."""
        unit = self._units[0]
        return native.CopyTable(node=self._address, point=unit.tick * unit.tick_points)

    @property
    def point(self) -> int:
        """See `Engine`."""
        return int(self._copy.point)

    def _step_to(self, point: int) -> None:
        copy, address = self._copy, ctypes.addressof(self._copy)
        copy.goal = point
        while (end := self._run(address, 0.0)) != BurstEnd.DONE:
            if end == BurstEnd.ATTENTION:
                self._library.attended(self._address)
                return
            with suppress(StepPending):
                self.complete(end)

    def send(self) -> None:
        """See `Engine`."""
        super().send()
        if self._streams is not None:
            self._streams.beat()

    def ring_bell(self) -> None:
        """See `Engine`."""
        self._library.attend(self._address)

    @property
    def awaited(self) -> str | None:
        """See `Engine`."""
        names = {source.counter.address: source.instance for runner in self.runners for source in runner.sources}
        names |= {counter.address: name for name, counter, _ in self._windows}
        unfinished = (unit for unit in self._units if unit.tick < unit.last_tick and not unit.stopped)
        return next((names.get(unit.blocked_by) for unit in unfinished if unit.blocked_by is not None), None)

    @property
    def late(self) -> int:
        """How often a sleep ended by its time limit although the value was there: 0 where no wake-up is lost."""
        return int(self._node.late)

    @property
    def spent_s(self) -> list[float]:
        """See `Engine`."""
        return [native_s + own_s for native_s, own_s in zip(super().spent_s, self._spent_s, strict=True)]

    @property
    def _ticks(self) -> int:
        return sum(runner.step for runner in self.runners)

    def refit(self, runner: Runner) -> None:
        """Fill the table of a runner: at the start, and again whenever it steps in another way."""
        before, unit = runner.table, next(unit for unit in self.units if runner in unit)
        sources = runner.sources if runner.player is None else ()  # what plays needs no rows of others
        own = runner.instance.native if isinstance(runner.instance, StepsNatively) and not runner.player else None
        if own is not None and any(source.transfer.has_text for source in sources):
            own = None
        moves = [source.transfer.moves(RowBase.FIRST_GATE + number) for number, source in enumerate(sources)]
        bases = (ctypes.c_void_p * (RowBase.FIRST_GATE + len(sources)))()
        grid, points = runner.grid, runner.plan.step_points
        watched = runner.watched if runner.watched is not None else runner.outputs
        rings = [native.OutputTable(ring.address, ring.stride, ring.mask) for ring in (runner.outputs, watched)]
        names = (
            ("kind", "component", "do_step", "said", "host") if own is not None else ()
        )  # without them, BY_PYTHON is 0
        calls = {name: getattr(own, name) for name in names}
        by_python = self._step_of(runner)
        made = native.MemberTable(
            **calls,
            start_time=grid.start_time,
            base_step_size=grid.step_size,
            step_size=points * grid.step_size,
            points=points,
            every=points // self.tick_points(unit),
            wait=runner.plan.wait_points,  # of a unit of one instance, each tick has a step
            last_step=runner.last_step,
            python_at=NEVER,
            outputs=(native.OutputTable * 2)(*rings),
            counter=runner.counter.address,
            bases=ctypes.cast(bases, ctypes.POINTER(ctypes.c_void_p)),
            step=before.step,
            stage=before.stage,
            outcome=before.outcome,
            by_python=id(by_python),
        )
        if own is not None:
            made.give(loads=own.loads, setters=own.setters, getters=own.getters, stores=own.stores)
            made.give(regions=own.regions)
            if own.share is not None:
                own.share(self._memory.path, self._memory.address, self._memory.map.size)
            if own.lines is not None:
                made.note(lines=ctypes.addressof(own.lines), lines_count=len(own.lines))
        gates = [source.gate for source in sources]
        made.give(gates=gates, feeds=list(chain(*moves)), finite=runner.is_finite.spans)
        self._kept[runner.name] = [made, bases, own]  # what the table points to
        ctypes.pointer(before)[0] = made
        self._by_python[runner.name] = by_python  # now the table has no other one any more
        self.follow_inputs(runner)

    def _step_of(self, runner: Runner) -> Callable[[int], None]:
        """How Python takes a step of a runner, whose inputs that are no texts are there."""
        if runner.player is not None:
            return partial(self._play, runner, runner.player)
        do_step, is_timed = runner.do_step, isinstance(runner.instance, TimedInputs)
        may_fail = runner.plan.section.on_failure != "stop"
        texts = [source.transfer for source in runner.sources if source.transfer.has_text]
        if not texts and not is_timed and not may_fail:
            return do_step

        def step_all(step: int) -> None:
            for transfer in texts:
                transfer.step_text(step)
            do_step(step)
            if may_fail:
                self._look_at_failure(runner)
            if is_timed:
                self.follow_inputs(runner)

        return step_all

    def _play(self, runner: Runner, player: RowPlayer, step: int) -> None:
        """Play the rows of a unit as far as the burst may step now; the burst itself counts the last one.

        It calls this for each member. Those before it in the unit have taken the step already.
        """
        number, unit = next((number, unit) for number, unit in enumerate(self.units) if runner in unit)
        place, points = self._units[number], self.tick_points(unit)
        place.note(burst=_PLAYED_TICKS if step < player.last else 1)
        steps = [own.plan.step_points // points for own in unit]  # in ticks
        end = min(-(-self._node.allowed // points), (player.last + 1) * runner.plan.step_points // points - 1)
        end -= end % math.lcm(*steps)  # here each member has a row of its own
        if end > place.tick:
            for index, (own, ticks) in enumerate(zip(unit, steps, strict=True)):
                assert own.player is not None  # no member is at its state before this point
                own.player.read_to(row := end // ticks)
                own.table.note(step=row - (index >= place.next))
                own.counter.raise_to(own.step + 1)
            place.note(tick=end - 1)
        player.take(runner.step)

    def _look_at_failure(self, runner: Runner) -> None:
        """If an instance with native steps has failed and goes on with held outputs, Python takes its steps."""
        if runner.table.kind != StepKind.BY_PYTHON and runner.failed:
            self.refit(runner)

    def follow_inputs(self, runner: Runner) -> None:
        """Note in the table of a runner which step Python takes next, and what its inputs are in the steps before."""
        timed, member = runner.instance, runner.table
        if isinstance(timed, TimedInputs):
            if timed.tracks or member.n_tracks:
                self._tracks[runner.name] = [timed.tracks]  # what the table points to
                member.give(tracks=[native.Track(values.ctypes.data, to) for to, values in timed.tracks])
            member.python_at, member.tracks_from = timed.python_at, timed.tracks_from

    def _complete(self, runner: Runner, result: int) -> None:
        """Let Python complete a step that returned something unusual."""
        member = runner.table
        step = member.step
        if result == BurstEnd.NOT_FINITE:
            runner.not_finite(step)
            self._look_at_failure(runner)
            return
        if divmod(member.outcome, 1 << STAGE_BITS) == (Stage.SETTING, OUT_OF_RANGE):
            for source in runner.sources:
                source.transfer.check_range(step)
        if member.kind == StepKind.BY_PYTHON:
            raise self._forged(runner)  # it was out of range when the burst has read it
        cast("StepsNatively", runner.instance).finish(step, member.outcome)
        self._look_at_failure(runner)

    def _forged(self, runner: Runner) -> ProtocolBroken:
        step, sources = runner.step, runner.sources
        lost = [own for own in sources if not own.transfer.source.has_row(own.transfer.rule.row_for(step))]
        source = (lost or sources)[0]
        return ProtocolBroken(
            f"a row of '{source.instance}' for '{runner.name}' is not the one that was written",
            instance=runner.name,
            point=runner.point,
            time=runner.grid.time(runner.point),
            hint="Does another process write to the memory of this run?",
        )
