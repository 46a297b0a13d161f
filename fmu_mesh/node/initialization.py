"""Initialization Mode over the wire: values are calculated level by level, here and in other nodes (FMI 2.0, 4.2.3).

All nodes that have outputs of an algebraic loop iterate it. They exchange the values of every iteration (sweep), and
each of them runs the same `FixedPoint` on the same values. So all of them stop at the same sweep; other nodes get only
the values of the last one.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from functools import partial
from types import MappingProxyType
from typing import NamedTuple

from ..awake import AwakeClock
from ..errors import DeadlineExceeded, InitializationFailed, ProtocolBroken
from ..rings.array_elements import element_of, merged
from ..rings.packed_member import PackedMember
from ..rings.value_change import ValueChange
from ..simtime import ENDLESS
from ..system.algebraic_loop import FixedPoint
from ..system.feeds import FeedColumn
from ..system.initialization_plan import Loop
from ..system.layout import Column
from ..system.plan import InstancePlan, Link, NodePlan
from ..system.states import BeginsWith
from ..variables.value_types import PlainValue, Value, split_element
from ..wire.frames import initial_values
from ..wire.messages import Noted
from ..wire.solved_loop import SolvedLoop
from .links import OutLink
from .stepping import Runner

__all__ = ["Initialization"]

# `AwakeClock` has to be read twice a second, or a pause of this process counts as waiting: a longer wait is cut into
# pieces of this length.
_WAIT_SLICE_S = 0.5
_SWEEP = 1 << 32
"""An INITIAL message has the number `level + sweep * this`."""

Key = tuple[str, str]


class _Move(NamedTuple):
    """How an input gets its initial value: from an output with the column ``column``, or from an element of it."""

    source: str
    output: str
    target: str
    column: Column
    level: int
    change: ValueChange


class Initialization:
    """Sets inputs and gets outputs while all instances of a node are in Initialization Mode.

    ``wait`` waits for a message for at most this time in s, and handles it; None: there are no other nodes.

    Attributes:
        out_links: those that are needed only during Initialization Mode.
        solved: how loops were solved in which this node takes part.
    """

    def __init__(self, plan: NodePlan, wait: Callable[[float], None] | None = None) -> None:
        self.solved: list[SolvedLoop] = []
        self.out_links: list[OutLink] = []
        self._plan = plan
        self._wait = wait or _nothing_comes
        self._columns: dict[Key, Column] = {}
        self._levels: dict[Key, int] = {}
        for link in plan.links_in:
            for column, level in zip(link.layout.columns, link.levels, strict=True):
                self._columns[link.source, column.name] = column
                self._levels[link.source, column.name] = level
        for own in plan.instances:
            columns = (*own.outputs.columns, *own.initial_outputs.columns)
            self._columns |= {(own.name, column.name): column for column in columns}
            self._levels |= {(own.name, name): level for name, level in own.initialization.items()}
        self._outputs: dict[tuple[str, int], list[str]] = {}
        for own in plan.instances:
            for name, level in own.initialization.items():
                self._outputs.setdefault((own.name, level), []).append(name)
        steps = {own.step_points for own in plan.instances}
        self._stop_times = {points: plan.grid.told_stop_time(points) for points in steps}
        self._loops = {loop.first: loop for loop in plan.loops}
        iterated = {level for loop in plan.loops for level in range(loop.first, loop.last + 1)}
        self._sequence = sorted(({level for _, level in self._outputs} - iterated) | self._loops.keys())
        self._moves = {own.name: list(map(partial(self._move, own), _columns_of(own))) for own in plan.instances}
        self._known: dict[tuple[str, str, int | None], Value] = {}
        self._settled: set[Key] = set()
        self._parameters: dict[Key, str] = {}
        self._rows: dict[str, dict[str, Value]] = {}  # of the states of instances beside those that begin anew
        self._clock, self._end = AwakeClock(), 0.0

    @property
    def noted(self) -> list[Noted]:
        """How loops were solved, for the metadata of results: that of a loop at the instance of its first output."""
        own: dict[str, list[str]] = {item.name: [] for item in self._plan.instances}
        for loop in self.solved:
            own.get(loop.outputs[0].partition(".")[0], []).append(str(loop))
        return [Noted("loops", name, 0, "; ".join(loops)) for name, loops in own.items() if loops]

    def take(self, link: Link, tag: int, data: bytes) -> None:
        """Store an INITIAL message of another node."""
        sweep, level = divmod(tag, _SWEEP)
        iterated = any(loop.first <= level <= loop.last for loop in self._plan.loops)
        for name, value in initial_values(link, level, data).items():
            self._known[link.source, name, sweep if iterated else None] = value

    def run(
        self,
        runners: Collection[Runner],
        start_values: Mapping[str, Mapping[str, PlainValue]] = MappingProxyType({}),
        *,
        again: bool = False,
        begins_with: BeginsWith | None = None,
    ) -> None:
        """Take all instances through Initialization Mode; afterwards their outputs are those of point 0.

        An instance that begins anew beside others with states does so at the first point of the run: what the others
        give it are the rows in their states.

        May be called again for another run, but not after an exception.

        Args:
            runners: the instances.
            start_values: by instance and variable, those that are not as in the plan.
            again: whether the instances were bound for an earlier run.
            begins_with: the states that the instances will get.

        Raises:
            DeadlineExceeded: the initial value of another node did not come in time.
            FmuError: an FMU refused a value.
            LoopNotConverged: a loop has no consistent values.
        """
        for runner in runners:
            self._enter(runner, start_values.get(runner.name, {}), begins_with or BeginsWith())
        self._end = self._clock() + self._plan.timeouts.initialize
        self.solved = []
        for level in self._sequence:
            if level in self._loops:
                self._iterate(self._loops[level], runners)
            else:
                for runner in runners:
                    if names := self._outputs.get((runner.name, level)):
                        self._set_inputs(runner, level)
                        self._send(runner, level, self._get_outputs(runner, names))
        for runner in runners:
            if self._moves[runner.name]:
                self._set_inputs(runner, ENDLESS)
        self.out_links.clear()
        for values_of_run in (self._known, self._settled, self._parameters, self._rows):
            values_of_run.clear()
        for runner in runners:
            runner.instance.exit_initialization()
            runner.bind_again() if again else runner.bind()

    def _enter(self, runner: Runner, others: Mapping[str, PlainValue], begins: BeginsWith) -> None:
        grid, name, anew = self._plan.grid, runner.name, begins.anew.get(runner.name)
        if anew is not None:
            runner.begin_at(grid.first_point // runner.plan.step_points)
        elif begins.anew:
            state = PackedMember.decoded(begins.states[name], name)
            self._rows[name] = state.last_row(runner.plan.outputs, name)
        start_time = grid.time(grid.first_point) if anew is not None else grid.start_time
        own = runner.plan.start_values
        values = {**own, **(anew or {}), **others} if anew or others else own
        runner.instance.enter_initialization(start_time, self._stop_times[runner.plan.step_points], values)

    def _iterate(self, loop: Loop, runners: Collection[Runner]) -> None:
        """Iterate the levels of a loop until its values are consistent."""
        members = frozenset(loop.outputs)
        point = FixedPoint(loop, self._plan.initialization)
        own = [
            (runner, level, names)
            for level in range(loop.first, loop.last + 1)
            for runner in runners
            if (names := self._outputs.get((runner.name, level)))
        ]
        consistent = False
        while not consistent:
            sweep = point.sweeps
            for runner, level, names in own:
                self._set_inputs(runner, loop.first, point, level)
                self._send(runner, level, self._get_outputs(runner, names, sweep), loop, sweep)
            consistent = point.update(
                [
                    ValueChange.of_tear(tear).of(self._element(tear.source, tear.output, sweep), InitializationFailed)
                    for tear in loop.tears
                ]
            )
            if consistent:
                self._known |= {(*key, None): self._value(*key, sweep) for key in members & self._levels.keys()}
            self._known = {
                k: v
                for k, v in self._known.items()
                if k[2] is None or k[:2] not in members or (k[2] > sweep and not consistent)
            }
        self._settled |= point.assumed.keys()
        self.solved.append(SolvedLoop(tuple(map(".".join, loop.outputs)), point.sweeps, point.residual))
        for runner, level, names in own:
            self._send(runner, level, {name: self._known[runner.name, name, None] for name in names}, loop)

    def _set_inputs(self, runner: Runner, below: int, point: FixedPoint | None = None, within: int = 0) -> None:
        """Set the inputs whose sources have a level below this one.

        In a sweep of a loop, also set the assumed inputs, and those whose sources have a level below ``within``, to
        their values of this sweep.
        """
        values: dict[str, Value] = {}
        for move in self._moves[runner.name]:
            key = runner.name, move.target
            if point is not None and key in point.assumed:
                values[move.target] = point.assumed[key]
            elif point is not None and below <= move.level < within:
                values[move.target] = self._moved(move, point.sweeps)
            elif move.level < below and key not in self._settled:
                values[move.target] = self._moved(move)
        for column in (column for feed in runner.plan.parameters for column in feed.columns):
            if column.target in values and self._has(runner.name, column.target, values[column.target]):
                del values[column.target]
        if values:
            runner.instance.set_values(merged(values, runner.plan.initial_inputs, runner.instance.get_values))

    def _has(self, instance: str, parameter: str, value: Value) -> bool:
        """Whether a parameter has this value already; FMI 1.0 cannot set it a second time."""
        before = self._parameters.get((instance, parameter))
        self._parameters[instance, parameter] = text = repr(value)
        return before == text

    def _move(self, own: InstancePlan, source_and_column: tuple[str, FeedColumn]) -> _Move:
        source, column = source_and_column
        output = self._column(source, column.source)
        input_type = own.initial_inputs.column(column.target).type
        change = ValueChange.of_column(source, own.name, input_type, column)
        return _Move(source, column.source, column.target, output, self._levels[source, output.name], change)

    def _moved(self, move: _Move, sweep: int | None = None) -> Value:
        """The initial value that a connection gives its input."""
        value = element_of(self._value(move.source, move.column.name, sweep), move.column, move.output)
        return move.change.of(value, InitializationFailed)

    def _column(self, instance: str, name: str) -> Column:
        """The column of an output, or of the array that ``name`` is an element of."""
        if (instance, name) not in self._columns and (parts := split_element(name)) is not None:
            return self._columns[instance, parts[0]]
        return self._columns[instance, name]

    def _element(self, instance: str, name: str, sweep: int | None = None) -> Value:
        """The initial value of an output, or of an element of it; in a sweep of a loop, that of the sweep."""
        column = self._column(instance, name)
        return element_of(self._value(instance, column.name, sweep), column, name)

    def _value(self, instance: str, variable: str, sweep: int | None = None) -> Value:
        while (instance, variable, sweep) not in self._known:
            left_s = self._end - self._clock()
            if left_s <= 0:
                text = f"its initial value did not come within {self._plan.timeouts.initialize:g} s"
                raise DeadlineExceeded(text, instance=instance, variable=variable)
            self._wait(min(left_s, _WAIT_SLICE_S))
        return self._known[instance, variable, sweep]

    def _get_outputs(self, runner: Runner, names: Sequence[str], sweep: int | None = None) -> dict[str, Value]:
        values = dict(zip(names, runner.instance.get_values(names), strict=True))
        if (row := self._rows.get(runner.name)) is not None:
            values = {name: row.get(name, value) for name, value in values.items()}
        self._known |= {(runner.name, name, sweep): value for name, value in values.items()}
        return values

    def _send(
        self, runner: Runner, level: int, values: dict[str, Value], loop: Loop | None = None, sweep: int | None = None
    ) -> None:
        """Send the outputs of a level to the nodes that need them; in a sweep of a loop, to those that take part."""
        for link in (*runner.out_links, *self.out_links):
            if link.link.source != runner.name or level not in link.link.levels:
                continue
            if loop is None or (link.link.target_node in loop.nodes) == (sweep is not None):
                link.send_initial(level + (sweep or 0) * _SWEEP, values)


def _columns_of(own: InstancePlan) -> list[tuple[str, FeedColumn]]:
    """What the inputs and the parameters of an instance are connected to."""
    return [(feed.source, column) for feed in (*own.feeds, *own.parameters) for column in feed.columns]


def _nothing_comes(_left_s: float) -> None:
    """In the place of a wait for other nodes."""
    raise ProtocolBroken("an initial value has no source in this process")
