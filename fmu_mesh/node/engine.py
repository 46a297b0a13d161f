"""The engine of a node: steps its runners as far as inputs, windows and the grant allow.

`PlainEngine` does it in plain Python, for one process: where the library is missing, all other processes are reached by
frames, so it waits for nothing but its inbox. `fmu_mesh.node.burst_engine` does it in C.
"""

from __future__ import annotations

import ctypes
from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from threading import Lock
from time import perf_counter
from typing import Final

from ..errors import FmuMeshError, ProtocolBroken
from ..instances.process_state import ProcessState, floating_point_changed, restore_floating_point
from ..rings import native
from ..rings.host_memory import Counter, HostMemory
from ..rings.native import Stage
from ..system.plan import NodePlan
from .stepping import Runner

__all__ = ["SLICE_S", "STATE_CHECK_S", "Engine", "PlainEngine", "Windows"]

# Threads: `run` belongs to the main thread, because an FMU is called from one thread only (ADR 12). From other
# threads come: `ring_bell` (threads of Zenoh with a message, the server with a query), `current` and `spent_s` (the
# server, for `status`), and `sending`, which the server takes to send rows while a step lasts long. The burst in C
# runs without the interpreter's lock: so whatever another thread reads of a table is one number that the burst writes
# once.
#
# What may go wrong:
# * A step never returns. Then `run` does not either; `Activity` sees it, and `status` still answers.
# * A row is not what its writer wrote (a forged counter, a broken window): the burst looks at its stamp after it has
#   copied it, and ends with FORGED. The outputs of that step are not counted.
# * A wake-up is lost, because its sender was killed: each sleep has a limit, then everything is looked at anew.
# * An FMU changes the floating-point mode or a signal handler of the process: the mode is looked at after each step,
#   as that is two additions; all else every 50 ms (`STATE_CHECK_S`), as that is 10 us.
# * Python writes a table while the burst uses it: it cannot, because `refit` and `follow_inputs` run on the main
#   thread, between two calls of `node_run`, or for a member whose step the burst has just given to Python.
# * A step of Python raises: the call of the library raises it, with the tables as they were in that step. The library
#   has the interpreter's lock in such a step only, and calls the object that `_kept` holds; a `refit` within the step
#   may replace that one.
#
# Tried and given up: one call from Python for each step (as much time as a small FMU takes), a return to Python for
# each of its own steps (twice the time of such a step), loops that llvmlite compiled (170 MB, up to 20 ms for each
# node, and no faster; ADR 57), a grant that is asked for at each window (ADR 58).

SLICE_S: Final = 0.001
"""A burst of steps ends after about this time in s, so that its rows are sent and messages are handled."""

STATE_CHECK_S: Final = 0.05
"""How often in s, at the end of a burst, a changed state of the process is looked for, which takes 10 us. Models that
are known to change it are looked after in each step."""

Windows = Sequence[tuple[str, Counter, int]]
"""Others, their progress, and how many points each of them may be behind."""

_BUSY: Final = (Stage.SETTING, Stage.STEPPING, Stage.GETTING, Stage.IN_PYTHON)


class Engine(ABC):
    """Steps the units of a node.

    Args:
        units: the runners of each unit, in the order of the plan.
        memory: with the grant and the progress of all nodes.
        windows: the progress of those whose windows are kept here, and how far each may be behind.

    Attributes:
        is_blocked: whether the last `run` has ended because nothing can step without another row, or a grant.
        sending: held by whoever sends rows: the main thread between bursts, or another one during a long step.
    """

    def __init__(
        self, plan: NodePlan, units: Sequence[Sequence[Runner]], memory: HostMemory, windows: Windows = ()
    ) -> None:
        self.units = units
        self.runners = [runner for unit in units for runner in unit]
        self.waited_s = 0.0
        self.is_blocked = False
        self.sending = Lock()
        self._plan = plan
        self._memory = memory
        self._progress = memory.progress[plan.node]
        self._windows = windows
        self._last_point = plan.grid.last_point
        self._looked_after: ProcessState | None = None
        self._look_at = 0.0
        kinds = [native.MemberTable * len(unit) for unit in units]
        members = [kind.from_buffer(memory.beside(ctypes.sizeof(kind))) for kind in kinds]
        of_units = native.UnitTable * max(len(units), 1)
        self._units = of_units.from_buffer(memory.beside(ctypes.sizeof(of_units)))
        for number, both in enumerate(zip(units, members, strict=True)):
            self._units[number] = self._unit(*both)
        for unit, tables in zip(units, members, strict=True):
            for runner, member in zip(unit, tables, strict=True):
                member.note(step=runner.step)  # not 0 where the run begins with a state
                runner.follow(member, self)

    def _unit(self, unit: Sequence[Runner], members: object) -> native.UnitTable:
        last_tick = unit[0].last_step if len(unit) == 1 else self._last_point
        points = self.tick_points(unit)
        return native.UnitTable(
            members=members,
            n_members=len(unit),
            tick_points=points,
            last_tick=last_tick,
            tick=unit[0].point // points,
            burst=1,
        )

    @abstractmethod
    def refit(self, runner: Runner) -> None:
        """On the main thread, between steps: the runner steps in another way from the next step on."""

    def follow_inputs(self, runner: Runner) -> None:  # noqa: B027  an engine whose steps ask the runner needs nothing
        """On the main thread, between steps: inputs over time of the runner change in other steps than before."""

    def begin_again(self, looked_after: ProcessState | None) -> None:
        """All runners begin another run (`Runner.bind_again`).

        ``looked_after`` is the state of the process now; None: it is to be as it was before.
        """
        self.waited_s, self.is_blocked, self._looked_after = 0.0, False, looked_after or self._looked_after
        for unit, _ in zip(self._units, self.units, strict=False):
            unit.note(tick=0, next=0, spent_ns=0, blocked_by=None)

    def run(self, wait_s: float, *, eager: bool, quiet: bool = False) -> bool:
        """Step for about a millisecond, and wait for up to ``wait_s`` where nothing can step; whether there was a step.

        If it is ``eager``, it returns instead of waiting when there was a step: its rows have to be sent. If it is
        ``quiet``, nobody looks at each step: it goes on for 50 ms, because each return takes longer than a small step.

        Raises:
            FmuMeshError: a step failed, or a ring has something that its writer never wrote.
            TerminationRequested: an FMU asks to end the simulation.

        The unit of an instance that raised one of them is not stepped any more.
        """
        self.is_blocked = False
        with self._looking_after():
            return self._burst(wait_s, eager=eager, quiet=quiet)

    def step_to(self, point: int) -> None:
        """Take all steps that end at this point or before, in a process that waits for nobody: point by point.

        So an event ends them as if each instance had been called in its turn; it raises what `run` raises. `ring_bell`
        ends them after the current point.
        """
        with self._looking_after():
            self._step_to(point)

    @contextmanager
    def _looking_after(self) -> Iterator[None]:
        """After some of the steps, and after one that has failed, restore the state of the process."""
        self._looked_after = self._looked_after or ProcessState()
        looks = True
        try:
            yield
            looks = perf_counter() >= self._look_at
        finally:
            if looks:
                self.look_after()

    def look_after(self) -> None:
        """Restore the state of the process, if a model has changed it since the first step."""
        self._look_at = perf_counter() + STATE_CHECK_S
        if self._looked_after is not None and self._looked_after.restore():
            for runner in self.runners:
                runner.take_care()

    @abstractmethod
    def _burst(self, wait_s: float, *, eager: bool, quiet: bool) -> bool:
        """As `run`, which then restores the state of the process."""

    @abstractmethod
    def _step_to(self, point: int) -> None:
        """As `step_to`, which then restores the state of the process."""

    @property
    @abstractmethod
    def point(self) -> int:
        """Between calls of `step_to`: the last point that all runners have reached."""

    @abstractmethod
    def ring_bell(self) -> None:
        """From any thread: let `run` or `step_to` return after the current step."""

    def note_wait(self, seconds: float) -> None:
        """The node has waited for so long because nothing could step."""
        self.waited_s += seconds

    def send(self) -> None:
        """While a step is under way, by another thread that holds `sending`: send all rows before it."""
        for runner in self.runners:
            runner.flush()

    @property
    def granted(self) -> int:
        """The point up to which the master lets nodes step; from any thread."""
        return int(self._memory.grant.value)

    @property
    def covered(self) -> int:
        """The last point for which all outputs of this node are known."""
        return min(runner.covered for runner in self.runners)

    @property
    def current(self) -> Runner | None:
        """The runner whose step is under way, or has failed; from any thread."""
        busy = next((own for own in self.runners if own.stage in _BUSY and own.step < own.last_step), None)
        return busy.stepping if busy is not None else None

    @property
    def spent_s(self) -> list[float]:
        """How long each unit was stepped, in s."""
        return [unit.spent_ns / 1e9 for unit, _ in zip(self._units, self.units, strict=False)]

    @property
    def awaited(self) -> str | None:
        """The instance or node whose progress the last wait was for; None: it was the master's grant."""
        own = {runner.name for runner in self.runners}
        sources = (source for runner in self.runners for source in runner.lacking)
        return next((source.instance for source in sources if source.instance not in own), None)

    @property
    def places(self) -> list[tuple[int, int]]:
        """Where in memory it is told how far the units and their members are, and how many bytes."""
        ticks = native.UnitTable.tick.offset, native.UnitTable.spent_ns.offset
        steps = native.MemberTable.step.offset, ctypes.sizeof(native.MemberTable)
        tables = [(unit, ticks) for unit in self._units[: len(self.units)]] + [
            (own.table, steps) for own in self.runners
        ]
        return [(ctypes.addressof(own) + first, end - first) for own, (first, end) in tables]

    def tick_points(self, unit: Sequence[Runner]) -> int:
        """Base points of one tick: a unit of one instance ticks at its own points, a cycle at every point."""
        return unit[0].plan.step_points if len(unit) == 1 else 1


class PlainEngine(Engine):
    """Steps in plain Python."""

    @property
    def point(self) -> int:
        """See `Engine`."""
        return min(self.covered, self._last_point)

    def _step_to(self, point: int) -> None:
        for unit, place in zip(self.units, self._units, strict=False):
            place.last_tick = point // place.tick_points
            while (before := place.tick) < place.last_tick and not (place.stopped or self._attention):
                self._advance(unit, place, perf_counter())
                if place.tick == before and not self._attention:
                    raise ProtocolBroken("an instance cannot step, although all instances before it have stepped")
        self._attention = False

    slice_s = SLICE_S  # every unit has a turn before it is looked at
    _attention = False

    def refit(self, runner: Runner) -> None:
        """Nothing: each step asks the runner itself."""

    def _burst(self, wait_s: float, *, eager: bool, quiet: bool) -> bool:  # noqa: ARG002  it never waits after a step
        started = perf_counter()
        seen = self._memory.seen()
        stepped = False
        while not self._attention:
            advanced = [self._advance(*both, started) for both in zip(self.units, self._units, strict=False)]
            self._progress.raise_to(self.covered + 1)
            stepped = stepped or any(advanced)
            self.is_blocked = not any(advanced)
            if self.is_blocked or perf_counter() - started > self.slice_s:
                break
        if not stepped and not self._attention:
            began = perf_counter()
            self._memory.sleep(seen, wait_s)
            self.note_wait(perf_counter() - began)
        self._attention = False
        return stepped

    def ring_bell(self) -> None:
        """See `Engine`."""
        self._attention = True
        self._memory.ring_bell()

    def _advance(self, unit: Sequence[Runner], place: native.UnitTable, started: float) -> bool:
        """Step one unit for the rest of the slice; whether there was a step."""
        began, stepped = perf_counter(), False
        try:
            while not place.stopped and place.tick < place.last_tick and not self._attention:
                if not place.next:
                    limits = [counter.value - 1 + window for _, counter, window in self._windows]
                    if place.tick * place.tick_points >= min(self._memory.grant.value, self._last_point, *limits):
                        break
                for index in range(place.next, len(unit)):
                    place.next, runner = index, unit[index]
                    if len(unit) > 1 and not runner.has_step(place.tick):
                        continue
                    if any(runner.lacking):
                        return stepped
                    self._step(place, runner)
                    stepped = True
                place.tick += 1
                place.next = 0
                if perf_counter() - started > self.slice_s:
                    break
            return stepped
        finally:
            place.spent_ns += int((perf_counter() - began) * 1e9)

    def _step(self, place: native.UnitTable, runner: Runner) -> None:
        member, step = runner.table, runner.step
        try:
            for source in runner.sources if runner.player is None else ():
                source.transfer.step(step)
            member.stage = Stage.IN_PYTHON
            (runner.player.take if runner.player is not None else runner.do_step)(step)
            if not runner.is_finite.check(step + 1):
                runner.not_finite(step)
        except FmuMeshError as error:
            place.stopped = 1
            runner.is_finite.explain(error)
            raise
        finally:
            member.stage = Stage.WAITING
        if floating_point_changed():
            restore_floating_point()
        runner.outputs.stamp(step + 1)
        member.step = step + 1
        runner.counter.raise_to(step + 2)
