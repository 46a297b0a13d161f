"""All instances of a plan in this process, stepped point by point in the plainest way: the reference of invariant 1.

It uses the same plan as the nodes but none of their code. Any other run must give bit-for-bit the same result. Owns the
order of calls at a point and the state of the whole system. Knows no files, no wall clock and no deadlines:
`fmu_mesh.api.open_system` gives it to a program, and tests compare all runs with a loop over it (ADR 73).
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Mapping
from contextlib import nullcontext, suppress
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

from msgspec.structs import replace

from ..errors import FmuError, InitializationFailed, NotFinite, TerminationRequested
from ..instances.call_guard import Guarded, doing
from ..instances.contract import LogMessage, Opening, Showing
from ..instances.kept_models import KeptModels
from ..instances.process_state import LOOK_STEPS, kept_state
from ..instances.tight_group import solve_together
from ..printing import paragraph
from ..rings.value_change import ValueChange
from ..system.algebraic_loop import FixedPoint
from ..system.initialization_plan import Loop
from ..system.plan import Plan
from ..system.states import BeginsWith
from ..variables.value_conversion import to_value
from ..variables.value_types import PlainValue, Value
from .local_member import LocalMember, SavedMember, element_at
from .run_plan import opening_in
from .threads import LimitedThreads

__all__ = ["LocalSystem", "SavedSystem", "forwarded", "opening_of"]

log = logging.getLogger("fmu_mesh.api.open_system")  # as docs/stepping.md has it


class LocalSystem:
    """The instances of a plan and what moves values between them.

    Call sequence: `start`, then `step` as often as there are points, with all other methods in between; at the end, and
    after any exception, `close`. After an exception of `step` only `restore` and `start` bring the system to a point.

    Args:
        plan: the plan; its nodes and its window are not used.
        models: what the instances leave for those of the next `start`; None: each one loads its model.

    Attributes:
        point: the last point that all instances reached.
        stepping: name of the instance whose step is under way, or has failed; empty between two points.
    """

    def __init__(self, plan: Plan, models: KeptModels | None = None) -> None:
        self.point = 0
        self.stepping = ""
        self._plan = plan
        self._grid = plan.grid
        self._models = models
        self._members: dict[str, LocalMember] = {}
        self._steps: tuple[tuple[str, Callable[[int], None]], ...] = ()
        self._looked_after: tuple[tuple[str, Callable[[int], None]], ...] = ()
        self._look_at = 0
        self._kept: dict[int, SavedSystem] = {}
        self._threads = LimitedThreads()

    def start(
        self,
        open_instance: Callable[[str], Guarded],
        plan: Plan | None = None,
        start_values: Mapping[str, Mapping[str, PlainValue]] = MappingProxyType({}),
        begins_with: BeginsWith | None = None,
        point: int = 0,
    ) -> None:
        """Open all instances and initialize them; then they are at point 0. Those of before are closed first.

        Args:
            open_instance: opens an instance by name; it is closed here.
            plan: replaces that of before; it has the same instances, with other start values.
            start_values: by instance and variable, those that are not as in the plan.
            begins_with: states that a system of an equal plan has written by `packed`, or a run; None: there are none.
            point: the point of these states, where the system is then.

        Raises:
            FmuError: an instance cannot be opened or initialized, or cannot use its state.
        """
        self.point, self.stepping, self._look_at = 0, "", 0
        self._plan = plan = plan or self._plan
        with kept_state():
            self._free_all()
            before = {name: member for name, member in self._members.items() if member.begin_again(plan, name)}
            self._close(name for name in self._members if name not in before)
            self._members = before
            self._limit_threads()
            members: dict[str, LocalMember] = {}
            for name in plan.order:
                members[name] = before.get(name) or LocalMember(plan, name, open_instance(name))
                self._members = before | members
            self._members = members
            solve_together(plan.groups, {name: member.instance for name, member in members.items()})
            self._limit_threads()  # with the libraries that a component has imported
            begins = begins_with or BeginsWith()
            self._initialize(start_values, begins, point)
            self._load(begins, point)
            for member in members.values():
                member.is_finite.check_first(member.step, self._grid, member.instance.get_values)
        self._steps = tuple((name, member.step_from) for name, member in self._members.items())
        self._looked_after = tuple((name, partial(self._look_after, step)) for name, step in self._steps)

    def step(self) -> None:
        """Take all steps that end at the next point, in the order of the plan.

        Raises:
            FmuError: a step failed; it has the point at which this step began, and its time.
            TerminationRequested: an FMU asks to end the simulation. All outputs are still those of `point`.
        """
        point, steps = self.point, self._steps
        if point >= self._look_at:
            steps, self._look_at = self._looked_after, point + LOOK_STEPS
        try:
            for self.stepping, step_from in steps:
                step_from(point)
        except FmuError as error:
            member = self._members[self.stepping]
            if isinstance(error, NotFinite):
                found = member.is_finite.error(member.step + 1, self._grid)
                member.is_finite.explain(found)
                raise found from None
            error.at(self.begun_at, self._grid.time(self.begun_at))
            member.is_finite.explain(error)
            raise
        except TerminationRequested as asked:
            asked.at(point, self._grid.time(point))
            raise
        self.point = point + 1
        self.stepping = ""

    def _look_after(self, step_from: Callable[[int], None], point: int) -> None:
        """Take a step; if it has changed the state of the process, all steps are looked after from now on."""
        with kept_state() as state:
            step_from(point)
        if state.changed:
            self._steps = self._looked_after

    @property
    def begun_at(self) -> int:
        """The point at which the step that is under way, or has failed, began; between two points `point`.

        A step of an instance with a step size of its own begins some points before `point`.
        """
        if not self.stepping:
            return self.point
        member = self._members[self.stepping]
        return member.step * member.plan.step_points

    def doing(self, instance: str) -> str:
        """In words what an instance that steps is doing; from any thread."""
        return doing(self._members[instance].instance.stage)

    def reader(self, instance: str, variable: str) -> tuple[Callable[[int], Value], int]:
        """A function that reads an output of the plan or an element of it, and the points of an own step.

        The value at a point is that of the last own step that ended there or before: ``read(point // points)``.
        """
        return self._members[instance].reader(variable)

    def getter(self, instance: str, variable: str) -> Callable[[int], Value]:
        """A function that returns the value of a variable, or of an element of an array, at the current point."""
        return self._members[instance].getter(variable)

    def setter(self, instance: str, variable: str) -> Callable[[Value], None]:
        """A function that sets an unconnected input or a tunable parameter; the next step of the instance uses it."""
        return self._members[instance].setter(variable)

    def set(self, instance: str, values: Mapping[str, Value]) -> None:
        """As `setter`, for several variables at once."""
        self._members[instance].set(values)

    def save(self) -> SavedSystem:
        """Save the state of all instances between two points. `free` or `close` frees it."""
        states: dict[str, SavedMember] = {}
        try:
            for name, member in self._members.items():
                states[name] = member.save()
        except BaseException:
            self._free(SavedSystem(self.point, states))
            raise
        saved = SavedSystem(self.point, states)
        self._kept[id(saved)] = saved
        return saved

    def restore(self, saved: SavedSystem) -> None:
        """Go back, or ahead, to a state of `save`."""
        members = self._members
        for self.stepping, member in members.items():  # until all are there, the system is at no point
            member.restore(saved.members[self.stepping])
        self.point = saved.point
        self.stepping = ""

    def packed(self, saved: SavedSystem) -> dict[str, bytes]:
        """A state as bytes by instance, for `load` in any process.

        Raises:
            FmuError: an instance cannot write its state.
        """
        return {name: self._members[name].packed(own) for name, own in saved.members.items()}

    def _load(self, begins_with: BeginsWith, point: int) -> None:
        for self.stepping, data in begins_with.states.items():
            self._members[self.stepping].load(data)
        for name, values in begins_with.set_again.items():
            variables = {v.name: v for v in self._plan.system.instances[name].description.variables}
            self.set(name, {own: to_value(value, variables[own]) for own, value in values.items()})
        self.point, self.stepping = point, ""

    def free(self, saved: SavedSystem) -> None:
        """Free a state; nothing happens if it is freed already."""
        if self._kept.pop(id(saved), None) is not None:
            self._free(saved)

    def close(self) -> None:
        """Free all states and close all instances. Never raises; may be called twice."""
        if self._models is not None:
            self._models.close()
        with kept_state() if self._members else nullcontext():
            self._free_all()
            self._close(self._members)
        self._members.clear()
        self._threads.close()

    def _free_all(self) -> None:
        """Free all states."""
        for saved in self._kept.values():
            with suppress(FmuError):  # it has failed before, and now its memory goes anyway
                self._free(saved)
        self._kept.clear()

    def _close(self, names: Iterable[str]) -> None:
        """Close instances, which leave their models to the next ones."""
        for name in names:
            self._members[name].instance.close()

    def _limit_threads(self) -> None:
        """Let the numeric libraries that are loaded by now use one thread."""
        self._threads.limit(self._models.loads if self._models is not None else len(self._members))

    def _free(self, saved: SavedSystem) -> None:
        for name, own in saved.members.items():
            self._members[name].instance.free_state(own.state)

    def _initialize(
        self, start_values: Mapping[str, Mapping[str, PlainValue]], begins_with: BeginsWith, point: int
    ) -> None:
        grid, members, anew = self._grid, self._members, begins_with.anew
        known: dict[tuple[str, str], Value] = {}
        for name, member in members.items():
            start_time = grid.time(point) if name in anew else grid.start_time
            stop_time = grid.told_stop_time(member.plan.step_points)
            values = {**member.plan.start_values, **anew.get(name, {}), **start_values.get(name, {})}
            member.instance.enter_initialization(start_time, stop_time, values)
            if anew:
                member.begin_at(point, begins_with.states.get(name))
        levels = self._plan.initialization.levels
        loops = iter((*self._plan.initialization.loops, None))
        loop = next(loops)
        for (name, variable), level in sorted(levels.items(), key=lambda item: item[1]):
            if loop is not None and level >= loop.first:
                self._iterate(loop, known)
                loop = next(loops)
            if (name, variable) not in known:
                members[name].set_initial_inputs(known)
                known[(name, variable)] = members[name].initial_output(variable)
        for member in members.values():
            member.set_initial_inputs(known)
        for member in members.values():
            member.instance.exit_initialization()
            member.bind(grid, members)
        for group in self._plan.groups:
            first, *others = (members[name] for name in group.members)
            first.solve_with(others)

    def _iterate(self, loop: Loop, known: dict[tuple[str, str], Value]) -> None:
        """Iterate an algebraic loop until its values are consistent."""
        members = self._members
        point = FixedPoint(loop, self._plan.system.config.initialization)
        before = dict(known)
        consistent = False
        while not consistent:
            known.clear()
            known.update(before)
            for name, variable in loop.outputs:
                members[name].set_initial_inputs(known, point.assumed)
                known[(name, variable)] = members[name].initial_output(variable)
            brought = []
            for tear in loop.tears:
                ends = tear.target, tear.input
                c = next(c for c in self._plan.connections if (c.target_instance, c.target_name) == ends)
                value = element_at(known[c.source_instance, c.source.name], c.source_index)
                brought.append(ValueChange.of_tear(tear).of(value, InitializationFailed))
            consistent = point.update(brought)
        for name, variable in point.assumed:
            members[name].settled.add(variable)


class SavedSystem(NamedTuple):
    """The state of a `LocalSystem` at a point."""

    point: int
    members: Mapping[str, SavedMember]


def forwarded(message: LogMessage) -> None:
    """Give the log a message of a model."""
    level = {"ok": logging.DEBUG, "warning": logging.WARNING}.get(message.status.lower(), logging.ERROR)
    said = map(paragraph, (message.category, message.message))
    log.log(level, "fmu_message instance=%s category=%s: %s", message.instance, *said)


def opening_of(
    plan: Plan, name: str, folder: Path, log: Callable[[LogMessage], None], showing: Showing
) -> Opening[Any]:
    """What the kind of an instance gets to open it; its files go into ``folder``."""
    node, description = plan.nodes[plan.node_of(name)], plan.system.instances[name].description
    return replace(opening_in(node, name, description, folder, log), showing=showing)
