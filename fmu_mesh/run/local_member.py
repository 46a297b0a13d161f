"""One instance of a `LocalSystem`: its rings, what it reads from others, its steps, and its state with all of that.

Looks everything up once, before the first step. Knows no other instance but through the functions that read its rows.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial, reduce
from operator import add
from types import MappingProxyType
from typing import NamedTuple

from ..errors import FmuError, InitializationFailed, NotFinite
from ..instances.call_guard import Guarded
from ..instances.process_state import floating_point_changed, restore_floating_point
from ..rings.array_elements import element_of, scaled
from ..rings.finite import FiniteRows
from ..rings.packed_member import PackedMember, columns_of, put_columns
from ..rings.ring import Ring, Rows
from ..rings.value_change import ValueChange
from ..simtime import TimeGrid
from ..system.coupling_rule import CouplingRule
from ..system.feeds import FeedColumn, consistent_columns, reads_of
from ..system.input_timeouts import LastValues
from ..system.layout import Layout
from ..system.plan import Plan
from ..system.schedule import Course
from ..system.series_files import courses_of
from ..text import listed
from ..variables.value_types import Value

__all__ = ["LocalMember", "SavedMember", "element_at"]


class LocalMember:
    """One instance of a `LocalSystem`.

    Attributes:
        settled: inputs that keep the values of the iteration of a loop at the start.
        is_finite: checks a row of outputs.
    """

    def __init__(self, plan: Plan, name: str, instance: Guarded) -> None:
        self.plan = plan.nodes[plan.node_of(name)].instance(name)
        self.connections = [c for c in plan.connections if c.target_instance == name]
        self._consistent = plan.consistent
        self.instance = instance
        self._inputs = Ring(self.plan.input_row, 1)
        # A slower instance reads values that are as old as its own step.
        reads = reads_of(plan.connections, plan.consistent)
        readers = {reader for source, _, reader in reads if source == name} | {name}
        oldest = max(plan.system.instances[reader].step_points for reader in readers)
        self._outputs = Ring(self.plan.outputs, 1 << (2 * -(-oldest // self.plan.step_points)).bit_length())
        self.is_finite = FiniteRows(self.plan, self._outputs, self._inputs)
        self._looks_at_rows = True
        self._points, self._wait = self.plan.step_points, self.plan.wait_points
        self._last_step, self._rule_of = plan.grid.last_point // self._points, plan.rule_of
        self._feeds: list[_Feed] = []
        self._timed: list[LocalMember] = []  # those that get values over time before its step
        self._courses: dict[str, Course] = {}
        self._last = LastValues((), {}, instance.description)
        self._parameters: dict[str, str] = {}
        self._given: dict[str, Value] = {}
        self.settled: set[str] = set()
        self.step, self._set_at = 0, -1
        self._setters: dict[str, Callable[[Value], None]] = {}
        self._prepared: set[str] = set()  # the variables that need no call together with others

    def begin_again(self, plan: Plan, name: str) -> bool:
        """Be as a new one, with the start values of a plan; False if the instance cannot be, and has to be closed."""
        if not self.instance.end_run():
            return False
        self.instance.begin_again()
        self.plan = plan.nodes[plan.node_of(name)].instance(name)
        self.step, self._set_at = 0, -1
        self.settled.clear()
        self._parameters.clear()
        self._given.clear()
        for ring in (self._inputs, self._outputs):
            ring.clear()
        return True

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
                value = element_at(known[key], c.source_index)
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
                row = element_at(row, (i,))
            assert isinstance(row, list)
            row[c.target_index[-1]] = value
        if values:
            self.instance.set_values(values)

    def begin_at(self, point: int, data: bytes | None) -> None:
        """Begin anew at a point, or beside those that do: then its outputs there are those of the state ``data``."""
        if data is None:
            self.step = point // self._points
        else:
            self._given.update(PackedMember.decoded(data, self.plan.name).last_row(self.plan.outputs, self.plan.name))

    def initial_output(self, name: str) -> Value:
        """The value of an output in Initialization Mode."""
        return self._given[name] if name in self._given else self.instance.get_values([name])[0]

    def _has(self, parameter: str, value: Value) -> bool:
        """Whether a connected parameter has this value already; FMI 1.0 cannot set it a second time."""
        before = self._parameters.get(parameter)
        self._parameters[parameter] = text = repr(value)
        return before == text

    def bind(self, grid: TimeGrid, members: Mapping[str, LocalMember]) -> None:
        """Prepare `step_from`: what it needs at every point is looked up here, once."""
        self._grid = grid
        self._courses = courses_of(self.plan.scenario, self.instance.description, grid, self._points)
        self._last = LastValues(self.plan.timeouts, self._courses, self.instance.description)
        if self.step:
            self._last.count_from(self.step)
        names = [column.name for column in self._inputs.layout.columns if column.shape or column.name in self._courses]
        for name, value in zip(names, self.instance.get_values(names) if names else [], strict=True):
            self._inputs.put(0, name, value)  # elements that are not connected keep it
        self.instance.bind(self._inputs, (self._outputs,), grid, self.plan.step_points, self.step)
        self._looks_at_rows = not self.instance.check_rows(self.is_finite.spans)
        self._do_step = self.instance.do_step
        self._timed = [self] if self._courses or self.plan.timeouts else []
        self._setters.clear()
        self._feeds.clear()
        for c in self.connections:
            if c.initial_only:
                continue
            columns = [*consistent_columns(c, self._consistent)]
            if len(columns) > 1 or (c.source_instance, c.source_name) in self._consistent:
                self._feed_consistent(columns, members, self._rule_of(c))
                continue
            read, _ = members[c.source_instance].reader(c.source_name)
            rule = self._rule_of(c)
            own = ValueChange.of_connection(c)
            change: Callable[[Value], Value] | None = None
            if (c.factor, c.offset) != (1.0, 0.0):
                change = partial(scaled, factor=c.factor, offset=c.offset)
            elif c.map or own.is_checked(c.source.type):
                change = own.of
            write = self._inputs.writer(c.target_name)
            self._feeds.append(_Feed(read, rule.source_points, rule.lead, rule.last, change, write))

    def _feed_consistent(
        self, columns: Sequence[tuple[str, FeedColumn]], members: Mapping[str, LocalMember], rule: CouplingRule
    ) -> None:
        """Elements of one connection, of which some are consistent outputs: each is the sum of its terms."""
        for target in dict.fromkeys(column.target for _, column in columns):
            own = [(source, column) for source, column in columns if column.target == target]
            reads = [(members[source].reader(column.source)[0], column.factor, column.offset) for source, column in own]
            write = self._inputs.writer(target)
            self._feeds.append(_Feed(partial(_sum, reads), rule.source_points, rule.lead, rule.last, None, write))

    def reader(self, variable: str) -> tuple[Callable[[int], Value], int]:
        """See `LocalSystem.reader`."""
        return self._outputs.reader(variable), self.plan.step_points

    def step_from(self, point: int) -> None:
        """Take an own step before ``point + 1``, if there is one, with the inputs that the delays prescribe.

        It ends there; that of an instance that goes ahead begins at ``point``.
        """
        step = self.step
        start = step * self._points
        if start + self._wait > point or step >= self._last_step:
            return
        for member in self._timed:
            member.prescribe(step)
        for read, points, lead, last, change, write in self._feeds:
            value = read(min((start + lead) // points, last))  # `CouplingRule.row_for`
            write(0, value if change is None else change(value))
        self._do_step(step)
        if floating_point_changed():
            restore_floating_point()
        if self._looks_at_rows and not self.is_finite.check(step + 1):
            if self.plan.section.on_failure == "stop":
                raise NotFinite("an output is not finite", instance=self.plan.name)
            error = self.is_finite.error(step + 1, self._grid)
            self.is_finite.explain(error)
            self.instance.hold(step, error)
        self.step = step + 1

    def solve_with(self, others: Sequence[LocalMember]) -> None:
        """Take the steps of a solved group, of which it is the first member: it needs what all of them read."""
        for other in others:
            other.follow_first(self._feeds, self._timed)

    def follow_first(self, feeds: list[_Feed], timed: list[LocalMember]) -> None:
        """The first member of its solved group, which has these feeds, takes its steps."""
        feeds += self._feeds
        timed += self._timed
        self._feeds, self._timed = [], []

    def prescribe(self, step: int) -> None:
        """Give own step ``step`` what the scenario prescribes, and what inputs without a value fall back to."""
        changes = {name: course.change(step) for name, course in self._courses.items()}
        prescribed = {name: value for name, value in changes.items() if value is not None}
        if prescribed := prescribed | self._last.fall_back(step):
            self._give(prescribed)

    def getter(self, name: str) -> Callable[[int], Value]:
        """See `LocalSystem.getter`: from the row of the point, or from the model if something was set since then."""
        variable = self.instance.description.variable_of(name)
        assert variable is not None
        column = Layout.of([variable]).columns[0]

        get = self.instance.getter(column.name)

        def from_model(_point: int) -> Value:
            if get is not None:
                return get()
            return element_of(self.instance.get_values([column.name])[0], column, name)

        if column.name not in self.plan.outputs.names:
            return from_model
        read, points = self._outputs.reader(name), self._points
        if points == 1:
            return lambda point: from_model(point) if self._set_at == self.step else read(point)

        def from_row(point: int) -> Value:  # the model of an instance that goes ahead is at a later point
            return from_model(point) if self._set_at == self.step == point // points else read(point // points)

        return from_row

    def set(self, values: Mapping[str, Value]) -> None:
        """See `LocalSystem.set`."""
        setters = [self.setter(name) for name in values]
        if len(values) == 1 or self._prepared.issuperset(values):
            for put, value in zip(setters, values.values(), strict=True):
                put(value)
            return
        self._set_at = self.step
        for name in values:
            self._last.came(name, self.step)
        self.instance.set_values(values)
        if given := {name: value for name, value in values.items() if name in self._courses}:
            self._give(given)

    def setter(self, name: str) -> Callable[[Value], None]:
        """See `LocalSystem.setter`."""
        if (known := self._setters.get(name)) is not None:
            return known
        put, is_timed, is_prescribed = self.instance.setter(name), name in self._last.sent, name in self._courses
        if put is not None:
            self._prepared.add(name)

        def set_value(value: Value) -> None:
            self._set_at = self.step
            if is_timed:
                self._last.came(name, self.step)
            if put is not None:
                put(value)
            else:
                self.instance.set_values({name: value})
            if is_prescribed:
                self._give({name: value})

        self._setters[name] = set_value
        return set_value

    def _give(self, values: Mapping[str, Value]) -> None:
        """Give the next step values of the scenario, or of somebody instead of it: in the row of inputs, if it can."""
        in_row = {*self._inputs.layout.names}
        for name, value in values.items():
            if name in in_row:
                self._inputs.put(0, name, value)
        if others := {name: value for name, value in values.items() if name not in in_row}:
            self.instance.set_in_step(others)

    def save(self) -> SavedMember:
        """See `LocalSystem.save`."""
        rows = tuple(part.copy() for part in self._outputs.parts)
        inputs = tuple(part.copy() for part in self._inputs.parts)
        sent = {name: tuple(steps) for name, steps in self._last.sent.items()}
        return SavedMember(self.instance.get_state(), self.step, self._set_at, rows, inputs, sent)

    def restore(self, saved: SavedMember) -> None:
        """See `LocalSystem.restore`."""
        self.instance.set_state(saved.state)
        self.step, self._set_at = saved.step, saved.set_at
        self._last.sent.update((name, [*steps]) for name, steps in saved.sent.items())
        for part, kept in zip(self._outputs.parts, saved.outputs, strict=True):
            part[...] = kept
        for part, kept in zip(self._inputs.parts, saved.inputs, strict=True):
            part[...] = kept

    def packed(self, saved: SavedMember) -> bytes:
        """A state of `save` as bytes, for `load` in any process.

        Raises:
            FmuError: the instance cannot write its state.
        """
        newest = self._newest(saved.step)
        outputs, inputs = columns_of(self._outputs, saved.outputs, newest), columns_of(self._inputs, saved.inputs, [0])
        state = self.instance.serialize_state(saved.state)
        sent = {name: [*steps] for name, steps in saved.sent.items()}
        return PackedMember(state, saved.step, saved.set_at, outputs, inputs, sent).encoded()

    def _newest(self, step: int) -> list[int]:
        """The rows that are there after so many own steps."""
        return [*range(max(0, step + 1 - self._outputs.rows), step + 1)]

    def load(self, data: bytes) -> None:
        """Restore a state from the bytes of `packed`.

        An output that was in no row there, because nobody recorded it, has its present value in all of them.

        Raises:
            FmuError: the instance cannot use its state.
        """
        own = PackedMember.decoded(data, self.plan.name)
        if own.waits:
            text = f"values of {listed([*own.waits])} wait for their time, which a program that steps cannot have"
            raise FmuError(text, instance=self.plan.name, hint="A run can begin with it: `run(state=...)`.")
        outputs, inputs = (tuple(part.copy() for part in ring.parts) for ring in (self._outputs, self._inputs))
        newest = self._newest(own.step)
        others = put_columns(self._outputs, outputs, newest, own.outputs, self.plan.name)
        put_columns(self._inputs, inputs, [0], own.inputs, self.plan.name)
        state = self.instance.deserialize_state(own.state)
        try:
            self.restore(SavedMember(state, own.step, own.set_at, outputs, inputs, own.sent))
        finally:
            self.instance.free_state(state)
        for name, value in zip(others, self.instance.get_values(others) if others else [], strict=True):
            for row in newest:
                self._outputs.put(row, name, value)


class _Feed(NamedTuple):
    """How an input gets its value: ``read`` a row of the source; see `CouplingRule` for ``points`` to ``last``."""

    read: Callable[[int], Value]
    points: int
    lead: int
    last: int
    change: Callable[[Value], Value] | None
    write: Callable[[int, Value], None]


class SavedMember(NamedTuple):
    """The state of one instance, its own steps done, those when something was last set, its rows, `LastValues.sent`."""

    state: object
    step: int
    set_at: int
    outputs: Rows
    inputs: Rows
    sent: Mapping[str, Sequence[int]]


def _sum(reads: Sequence[tuple[Callable[[int], Value], float, float]], row: int) -> Value:
    """The sum of the values of this row of several instances, each with its factor and offset."""
    values = [scaled(read(row), factor, offset) for read, factor, offset in reads]
    return reduce(add, values)


def element_at(value: Value, index: tuple[int, ...]) -> Value:
    """An element of an array; the value itself if there is no index."""
    for number in index:
        assert isinstance(value, list)
        value = value[number]
    return value
