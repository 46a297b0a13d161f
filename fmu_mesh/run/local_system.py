"""All instances of a plan in this process, stepped point by point in the plainest way: the reference of invariant 1.

It uses the same plan as the nodes but none of their code. Any other run must give bit-for-bit the same result. Owns the
order of calls at a point and the state of the whole system. Knows no files, no wall clock and no deadlines:
`fmu_mesh.api.open_system` gives it to a program, and tests compare all runs with a loop over it (ADR 73).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, suppress
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

from msgspec.structs import replace

from ..errors import FmuError, InitializationFailed, NotFinite, TerminationRequested
from ..instances.call_guard import Guarded, doing
from ..instances.contract import LogMessage, Opening, Showing
from ..instances.process_state import LOOK_STEPS, floating_point_changed, kept_state, restore_floating_point
from ..rings.array_elements import element_of, scaled
from ..rings.finite import FiniteRows
from ..rings.ring import Ring, Rows
from ..rings.value_change import ValueChange
from ..simtime import TimeGrid
from ..system.algebraic_loop import FixedPoint
from ..system.coupling_rule import CouplingRule
from ..system.initialization_plan import Loop
from ..system.input_timeouts import LastValues
from ..system.layout import Layout
from ..system.plan import Plan
from ..system.schedule import Course
from ..system.series_files import courses_of
from ..variables.value_types import Value
from .run_plan import opening_in
from .threads import one_thread_meanwhile

__all__ = ["LocalSystem", "SavedSystem", "opening_of"]


class LocalSystem:
    """The instances of a plan and what moves values between them.

    Call sequence: `start`, then `step` as often as there are points, with all other methods in between; at the end, and
    after any exception, `close`. After an exception of `step` only `restore` brings the system back to a point.

    Args:
        plan: the plan; its nodes and its window are not used.

    Attributes:
        point: the last point that all instances reached.
        stepping: name of the instance whose step is under way, or has failed; empty between two points.
    """

    def __init__(self, plan: Plan) -> None:
        self.point = 0
        self.stepping = ""
        self._plan = plan
        self._grid = plan.grid
        self._members: dict[str, _Member] = {}
        self._steps: tuple[tuple[str, Callable[[int], None]], ...] = ()
        self._looked_after: tuple[tuple[str, Callable[[int], None]], ...] = ()
        self._look_at = 0
        self._kept: dict[int, SavedSystem] = {}
        self._threads = ExitStack()

    def start(self, open_instance: Callable[[str], Guarded]) -> None:
        """Open all instances and initialize them; then they are at point 0.

        Args:
            open_instance: opens an instance by name; it is closed here.

        Raises:
            FmuError: an instance cannot be opened or initialized.
        """
        self._threads.enter_context(one_thread_meanwhile())
        for name in self._plan.order:
            self._members[name] = _Member(self._plan, name, open_instance(name))
        self._threads.enter_context(one_thread_meanwhile())  # with the libraries that a component has imported
        self._initialize()
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

    def set(self, instance: str, variable: str, value: Value) -> None:
        """Set an unconnected input or a tunable parameter; the next step of the instance uses it."""
        self._members[instance].set(variable, value)

    def save(self) -> SavedSystem:
        """Save the state of all instances between two points. `free` or `close` frees it."""
        states: dict[str, _SavedMember] = {}
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

    def free(self, saved: SavedSystem) -> None:
        """Free a state; nothing happens if it is freed already."""
        if self._kept.pop(id(saved), None) is not None:
            self._free(saved)

    def close(self) -> None:
        """Free all states and close all instances. Never raises; may be called twice."""
        for saved in self._kept.values():
            with suppress(FmuError):  # it has failed before, and now its memory goes anyway
                self._free(saved)
        self._kept.clear()
        for member in self._members.values():
            member.instance.close()
        self._threads.close()

    def _free(self, saved: SavedSystem) -> None:
        for name, own in saved.members.items():
            self._members[name].instance.free_state(own.state)

    def _initialize(self) -> None:
        grid, members = self._grid, self._members
        for member in members.values():
            stop_time = grid.told_stop_time(member.plan.step_points)
            member.instance.enter_initialization(grid.start_time, stop_time, member.plan.start_values)
        levels = self._plan.initialization.levels
        known: dict[tuple[str, str], Value] = {}
        loops = iter((*self._plan.initialization.loops, None))
        loop = next(loops)
        for (name, variable), level in sorted(levels.items(), key=lambda item: item[1]):
            if loop is not None and level >= loop.first:
                self._iterate(loop, known)
                loop = next(loops)
            if (name, variable) not in known:
                members[name].set_initial_inputs(known)
                known[(name, variable)] = members[name].instance.get_values([variable])[0]
        for member in members.values():
            member.set_initial_inputs(known)
        for member in members.values():
            member.instance.exit_initialization()
            member.bind(grid, members)

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
                known[(name, variable)] = members[name].instance.get_values([variable])[0]
            brought = []
            for tear in loop.tears:
                ends = tear.target, tear.input
                c = next(c for c in self._plan.connections if (c.target_instance, c.target_name) == ends)
                value = _at(known[c.source_instance, c.source.name], c.source_index)
                brought.append(ValueChange.of_tear(tear).of(value, InitializationFailed))
            consistent = point.update(brought)
        for name, variable in point.assumed:
            members[name].settled.add(variable)


class _SavedMember(NamedTuple):
    """The state of one instance, its own steps done, those when something was last set, its rows, `LastValues.sent`."""

    state: object
    step: int
    set_at: int
    outputs: Rows
    inputs: Rows
    sent: Mapping[str, Sequence[int]]


class SavedSystem(NamedTuple):
    """The state of a `LocalSystem` at a point."""

    point: int
    members: Mapping[str, _SavedMember]


class _Member:
    """One instance of a `LocalSystem`.

    Attributes:
        settled: inputs that keep the values of the iteration of a loop at the start.
        is_finite: checks a row of outputs.
    """

    def __init__(self, plan: Plan, name: str, instance: Guarded) -> None:
        self.plan = plan.nodes[plan.node_of(name)].instance(name)
        self.connections = [c for c in plan.connections if c.target_instance == name]
        self.instance = instance
        self._inputs = Ring(self.plan.input_row, 1)
        # A slower instance reads values that are as old as its own step.
        readers = {c.target_instance for c in plan.connections if c.source_instance == name} | {name}
        oldest = max(plan.system.instances[reader].step_points for reader in readers)
        self._outputs = Ring(self.plan.outputs, 1 << (2 * -(-oldest // self.plan.step_points)).bit_length())
        self.is_finite = FiniteRows(self.plan, self._outputs, self._inputs)
        self._looks_at_rows = True
        self._points = self.plan.step_points
        self._feeds: list[_Feed] = []
        self._set_at = -1
        self._courses: dict[str, Course] = {}
        self._last = LastValues((), {}, instance.description)
        self._parameters: dict[str, str] = {}
        self.step = 0
        self.settled: set[str] = set()

    def set_initial_inputs(
        self, known: Mapping[tuple[str, str], Value], assumed: Mapping[tuple[str, str], Value] = MappingProxyType({})
    ) -> None:
        """Set every connected input whose source is known, or which has an assumed value."""
        values: dict[str, Value] = {}
        for c in self.connections:
            key = (c.source_instance, c.source.name)
            own = (c.target_instance, c.target_name)
            if own in assumed:
                value = assumed[own]
            elif key in known and c.target_name not in self.settled:
                value = _at(known[key], c.source_index)
                value = ValueChange.of_connection(c).of(value, InitializationFailed)
            else:
                continue
            if c.initial_only and self._has(c.target_name, value):
                continue
            if not c.target_index:
                values[c.target.name] = value
                continue
            if c.target.name not in values:
                values[c.target.name] = self.instance.get_values([c.target.name])[0]
            row = values[c.target.name]
            for i in c.target_index[:-1]:
                row = _at(row, (i,))
            assert isinstance(row, list)
            row[c.target_index[-1]] = value
        if values:
            self.instance.set_values(values)

    def _has(self, parameter: str, value: Value) -> bool:
        """Whether a connected parameter has this value already; FMI 1.0 cannot set it a second time."""
        before = self._parameters.get(parameter)
        self._parameters[parameter] = text = repr(value)
        return before == text

    def bind(self, grid: TimeGrid, members: Mapping[str, _Member]) -> None:
        """Prepare `step_from`: what it needs at every point is looked up here, once."""
        self._courses = courses_of(self.plan.scenario, self.instance.description, grid, self._points)
        self._last = LastValues(self.plan.timeouts, self._courses, self.instance.description)
        names = [column.name for column in self._inputs.layout.columns if column.shape or column.name in self._courses]
        for name, value in zip(names, self.instance.get_values(names) if names else [], strict=True):
            self._inputs.put(0, name, value)  # elements that are not connected keep it
        self.instance.bind(self._inputs, (self._outputs,), grid, self.plan.step_points)
        self.is_finite.check_first(grid, self.instance.get_values)
        self._looks_at_rows = not self.instance.check_rows(self.is_finite.spans)
        self._do_step = self.instance.do_step
        for c in self.connections:
            if c.initial_only:
                continue
            read, points = members[c.source_instance].reader(c.source_name)
            lead = CouplingRule(c.delay or 0, points, self._points).lead
            own = ValueChange.of_connection(c)
            change: Callable[[Value], Value] | None = None
            if (c.factor, c.offset) != (1.0, 0.0):
                change = partial(scaled, factor=c.factor, offset=c.offset)
            elif c.map or own.is_checked(c.source.type):
                change = own.of
            self._feeds.append(_Feed(read, points, lead, change, self._inputs.writer(c.target_name)))

    def reader(self, variable: str) -> tuple[Callable[[int], Value], int]:
        """See `LocalSystem.reader`."""
        return self._outputs.reader(variable), self.plan.step_points

    def step_from(self, point: int) -> None:
        """Take the own step that ends at ``point + 1``, if there is one, with the inputs that the delays prescribe."""
        if (point + 1) % self._points:
            return
        step = self.step
        start = step * self._points
        if self._courses or self.plan.timeouts:
            changes = {name: course.change(step) for name, course in self._courses.items()}
            prescribed = {name: value for name, value in changes.items() if value is not None}
            if prescribed := prescribed | self._last.fall_back(step):
                self._give(prescribed)
        for read, points, lead, change, write in self._feeds:
            value = read((start + lead) // points)  # `CouplingRule.row_for`, without a call
            write(0, value if change is None else change(value))
        self._do_step(step)
        if floating_point_changed():
            restore_floating_point()
        if self._looks_at_rows and not self.is_finite.check(step + 1):
            raise NotFinite("an output is not finite", instance=self.plan.name)
        self.step = step + 1

    def getter(self, name: str) -> Callable[[int], Value]:
        """See `LocalSystem.getter`: from the row of the point, or from the model if something was set since then."""
        variable = self.instance.description.variable_of(name)
        assert variable is not None
        column = Layout.of([variable]).columns[0]

        def from_model(_point: int) -> Value:
            return element_of(self.instance.get_values([column.name])[0], column, name)

        if column.name not in self.plan.outputs.names:
            return from_model
        read = self._outputs.reader(name)
        return lambda point: from_model(point) if self._set_at == self.step else read(point // self._points)

    def set(self, name: str, value: Value) -> None:
        """See `LocalSystem.set`."""
        self._set_at = self.step
        self._last.came(name, self.step)
        self.instance.set_values({name: value})
        if name in self._courses:
            self._give({name: value})

    def _give(self, values: Mapping[str, Value]) -> None:
        """Give the next step values of the scenario, or of somebody instead of it: in the row of inputs, if it can."""
        in_row = {*self._inputs.layout.names}
        for name, value in values.items():
            if name in in_row:
                self._inputs.put(0, name, value)
        if others := {name: value for name, value in values.items() if name not in in_row}:
            self.instance.set_in_step(others)

    def save(self) -> _SavedMember:
        """See `LocalSystem.save`."""
        rows = tuple(part.copy() for part in self._outputs.parts)
        inputs = tuple(part.copy() for part in self._inputs.parts)
        sent = {name: tuple(steps) for name, steps in self._last.sent.items()}
        return _SavedMember(self.instance.get_state(), self.step, self._set_at, rows, inputs, sent)

    def restore(self, saved: _SavedMember) -> None:
        """See `LocalSystem.restore`."""
        self.instance.set_state(saved.state)
        self.step, self._set_at = saved.step, saved.set_at
        self._last.sent.update((name, [*steps]) for name, steps in saved.sent.items())
        for part, kept in zip(self._outputs.parts, saved.outputs, strict=True):
            part[...] = kept
        for part, kept in zip(self._inputs.parts, saved.inputs, strict=True):
            part[...] = kept


class _Feed(NamedTuple):
    """How an input gets its value: ``read`` a row of the source; see `CouplingRule` for ``points`` and ``lead``."""

    read: Callable[[int], Value]
    points: int
    lead: int
    change: Callable[[Value], Value] | None
    write: Callable[[int, Value], None]


def opening_of(
    plan: Plan, name: str, folder: Path, log: Callable[[LogMessage], None], showing: Showing
) -> Opening[Any]:
    """What the kind of an instance gets to open it; its files go into ``folder``."""
    node, description = plan.nodes[plan.node_of(name)], plan.system.instances[name].description
    return replace(opening_in(node, name, description, folder, log), showing=showing)


def _at(value: Value, index: tuple[int, ...]) -> Value:
    """An element of an array; the value itself if there is no index."""
    for number in index:
        assert isinstance(value, list)
        value = value[number]
    return value
