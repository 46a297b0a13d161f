"""The instances of a node as they are stepped: a `Runner` is one instance with its rows; a `Source` feeds it.

Owns what one step of one instance needs, and where its inputs come from: rings that others share, and mirrors of rings
that frames fill. It owns nothing about waiting. `fmu_mesh.node.engine` steps the runners.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from typing import NamedTuple, Protocol, cast

from ..instances.call_guard import doing
from ..instances.contract import Instance, StepsNatively
from ..instances.instance_wrapper import AroundInstance, AroundNativeSteps
from ..instances.tight_group import solve_together
from ..instances.tight_member import TightMember
from ..rings import native
from ..rings.array_elements import fill_unconnected
from ..rings.finite import FiniteRows
from ..rings.host_memory import Counter, HostMemory
from ..rings.ring import Ring
from ..rings.transfer import Transfer
from ..simtime import TimeGrid
from ..system.layout import Layout
from ..system.plan import InstancePlan, Link, NodePlan
from ..system.window import rows_of_ring
from ..wire.frames import FrameReceiver, SourceRows, rows_of
from ..wire.ways import Ways
from .links import OutLink

__all__ = ["RowPlayer", "Runner", "Source", "connect", "sources_of"]


class Source(NamedTuple):
    """Where values of a runner come from, and the number of complete rows there."""

    instance: str
    transfer: Transfer
    counter: Counter

    def has(self, step: int) -> bool:
        """Whether the row for own step ``step`` of the runner is there."""
        return self.counter.value > self.transfer.rule.row_for(step)

    @property
    def gate(self) -> native.Gate:
        """Its rows as the burst sees them."""
        ring, rule = self.transfer.source, self.transfer.rule
        return native.Gate(
            counter=self.counter.address,
            rows=ring.address,
            stride=ring.stride,
            mask=ring.mask,
            lead=rule.lead,
            points=rule.source_points,
            last=rule.last,
        )


class Refitting(Protocol):
    """The engine of a runner, as far as a runner knows it."""

    def refit(self, runner: Runner) -> None:
        """The runner steps in another way from the next step on."""
        ...

    def follow_inputs(self, runner: Runner) -> None:
        """Values that were sent to the runner change its inputs in other steps than before."""
        ...


class RowPlayer:
    """Plays the rows of an instance up to the point of its state, and loads this in the place of the last step.

    Nobody else can tell that from stepping: rows, counters and windows are the same, but no source is waited for.

    Args:
        rows: reads the rows of the instance into its ring, from one own step to before another.
        last: the own step that ends at that point.
        load: loads the state, with the row after that step; then the runner steps by itself.
    """

    def __init__(self, rows: Callable[[int, int], None], last: int, load: Callable[[], None]) -> None:
        self._rows, self.last, self._load, self._read = rows, last, load, 0

    def read_to(self, row: int) -> None:
        """Have all rows up to this one in the ring; raises `FmuMeshError` if they cannot be read."""
        if row > self._read:
            self._rows(self._read + 1, row + 1)
            self._read = row

    def take(self, step: int) -> None:
        """Have the row after own step ``step``, or load; the errors are those of both."""
        if step == self.last:
            self._load()
        else:
            self.read_to(step + 1)


class Runner:
    """One instance with its row of inputs and its output ring.

    Attributes:
        out_links: send its rows to those who do not read its ring.
        watched: a ring with further outputs, which somebody watches.
        table: how far it is, which whoever steps it writes, and for the burst how it is stepped.
        player: takes its steps before the point of its state, if it plays; None: the instance takes them.
    """

    def __init__(  # noqa: PLR0913  an instance, and where its values are
        self,
        plan: InstancePlan,
        instance: Instance,
        grid: TimeGrid,
        outputs: Ring,
        counter: Counter,
        *,
        inputs: Ring | None = None,
    ) -> None:
        self.plan = plan
        self.name = plan.name
        self.instance = instance
        self.inputs = inputs or Ring(plan.input_row, 1)
        self.outputs = outputs
        self.counter = counter
        self.sources: list[Source] = []
        self.out_links: list[OutLink] = []
        self._together: tuple[Runner, ...] = ()
        self.watched: Ring | None = None
        self.player: RowPlayer | None = None
        self.last_step = grid.last_point // plan.step_points
        self.grid = grid
        self.is_finite = FiniteRows(plan, outputs, self.inputs)
        self.follow(native.MemberTable())

    def begin_at(self, step: int) -> None:
        """The run begins after so many own steps: call before `bind`."""
        self.table.note(step=step)
        for link in self.out_links:
            link.begin_at(step)

    def bind(self) -> None:
        """Bind the instance to its rows, and read the current outputs. Call after Initialization Mode.

        Between two steps, the row of the last one stays as it is: what was set since then belongs to the next row.
        Nothing happens while it plays: the instance is at another point.
        """
        if self.player is None:
            self.bind_at(self.step)

    def bind_at(self, step: int) -> None:
        """As `bind`, for an instance that has taken so many own steps."""
        self._fill_unconnected()
        outputs = (self.outputs,) if self.watched is None else (self.outputs, self.watched)
        slot = step & self.outputs.mask
        row = [part[slot].copy() for part in self.outputs.parts] if self.outputs.has_row(step) else []
        self.instance.bind(self.inputs, outputs, self.grid, self.plan.step_points, step)
        for part, kept in zip(self.outputs.parts, row, strict=False):
            part[slot] = kept
        self.refit()

    def bind_again(self) -> None:
        """As `bind`, for an instance that has begun another run; see `BeginsAgain`."""
        self.outputs.stamps[: self.step + 1] = 0  # of the rows of the run before
        instance, table = self.instance, self.table
        if any(column.shape for column in self.inputs.layout.columns):
            self._fill_unconnected()
        instance.bind(self.inputs, (self.outputs,), self.grid, self.plan.step_points)
        own = instance.native if isinstance(instance, AroundNativeSteps) else None
        table.note(component=None if own is None else own.component, step=0, stage=native.Stage.WAITING, outcome=0)
        for gate in table.gates[: table.n_gates] if self.sources else ():
            gate.note(known=0)

    def _fill_unconnected(self) -> None:
        connected = [own.target for feed in self.plan.step_feeds for own in feed.columns]
        fill_unconnected(self.inputs, connected, self.instance.get_values)

    def solve_with(self, others: Sequence[Runner]) -> None:
        """Take the steps of a solved group, of which it is the first member: it needs what all of them read."""
        self._together = (*others, self)
        for other in others:
            self.sources.extend(other.sources)
            other.sources.clear()
            other.follow_first()

    def follow_first(self) -> None:
        """The first member of its solved group takes its steps."""
        self._together = (self,)

    @property
    def do_step(self) -> Callable[[int], None]:
        """How its step is taken, when all sources have moved their values."""
        if not self._together:
            return self.instance.do_step
        return self._step_together if len(self._together) > 1 else _is_done

    @property
    def stepping(self) -> Runner:
        """Itself; while it takes the steps of a solved group, the member whose instance steps. From any thread."""
        members = ((own, cast("AroundInstance[Instance]", own.instance).within(TightMember)) for own in self._together)
        return next((own for own, member in members if member.is_stepping), self)

    def _step_together(self, step: int) -> None:
        for runner in self._together:
            runner.instance.do_step(step)

    def begin(self) -> None:
        """The outputs after Initialization Mode, or of the state with which the run begins, are complete.

        Raises:
            NotFinite: one is not finite.
        """
        self.is_finite.check_first(self.step, self.grid, self.instance.get_values)
        self.outputs.stamp(self.step)
        self.counter.raise_to(self.step + 1)

    def not_finite(self, step: int) -> None:
        """The row that own step ``step`` has written is not finite: the instance holds its outputs, if it may.

        Raises:
            NotFinite: it may not.
        """
        error = self.is_finite.error(step + 1, self.grid)
        if self.plan.section.on_failure == "stop":
            raise error
        self.is_finite.explain(error)
        cast("AroundInstance[Instance]", self.instance).hold(step, error)

    @property
    def failed(self) -> str:
        """In words since when and why its outputs are held; empty: they are not."""
        return self.instance.failed if isinstance(self.instance, AroundInstance) else ""

    @property
    def awaited(self) -> str:
        """For which program of the user its step waits, and since when, in words; empty: it does not wait."""
        return self.instance.awaited if isinstance(self.instance, AroundInstance) else ""

    def play(self, player: RowPlayer | None) -> None:
        """Let its rows be played from the next step on; with None, the instance takes its steps."""
        self.player = player

    def stop(self) -> None:
        """This instance takes no more steps: its outputs hold to the end."""
        self.last_step = self.step
        self.refit()

    def flush(self, *, lazy: bool = True) -> None:
        """Send all rows that were not sent yet; those for the recorder only if ``lazy``, or if no more will come."""
        end = self.step + 1
        for link in self.out_links:
            if lazy or not link.to_recorder or self.step >= self.last_step:
                link.flush(end)

    def send_again(self) -> None:
        """Frames may be lost: send all rows again that are still there."""
        for link in self.out_links:
            link.send_again(self.step + 1)

    def send_last(self, end: int) -> None:
        """The run ends early: send the recorder the remaining rows before own step ``end``, and that no more come."""
        for link in self.out_links:
            if link.to_recorder:
                link.send_last(end)

    def follow(self, table: native.MemberTable, engine: Refitting | None = None) -> None:
        """From now on this ``engine`` steps it, with this ``table``."""
        self.table, self._engine = table, engine

    def watch(self, names: Sequence[str]) -> None:
        """From now on also read these outputs after every step; the plan does not contain them."""
        variables = {variable.name: variable for variable in self.instance.description.variables}
        layout = Layout.of(variables[name] for name in names)
        self.watched = Ring(layout, min(self.outputs.rows, rows_of_ring(layout))) if names else None
        self.bind()

    def wrap(self, wrapped: Instance) -> None:
        """From the next step on, ``wrapped`` is stepped, which has the instance inside."""
        self.instance = wrapped
        self.refit()

    def take_care(self) -> None:
        """A step has changed the state of its process: from the next step on, it is looked after."""
        if isinstance(self.instance, AroundInstance):
            self.instance.take_care()
            self.refit()

    def refit(self) -> None:
        """The instance steps in another way from the next step on."""
        if self._engine is not None:
            self._engine.refit(self)

    def follow_inputs(self) -> None:
        """Its inputs over time change in other steps than before. This takes a small part of the time of `refit`."""
        if self._engine is not None:
            self._engine.follow_inputs(self)

    @property
    def step(self) -> int:
        """Number of own steps done; this is also the newest row of `outputs`."""
        return int(self.table.step)

    @property
    def stage(self) -> int:
        """What it is doing, a `fmu_mesh.rings.native.Stage`."""
        return int(self.table.stage)

    @property
    def doing(self) -> str:
        """The same in words; of a step that Python takes, the instance knows more."""
        is_known = self.stage == native.Stage.IN_PYTHON and isinstance(self.instance, StepsNatively)
        return doing(cast("StepsNatively", self.instance).stage if is_known else self.stage)

    @property
    def point(self) -> int:
        """The communication point this instance is at."""
        return self.step * self.plan.step_points

    @property
    def covered(self) -> int:
        """The last point for which the outputs are known: they hold until the next own point."""
        step = self.step
        if step >= self.last_step:
            return self.grid.last_point
        return min((step + 1) * self.plan.step_points - 1, self.grid.last_point)

    @property
    def reached_by_all(self) -> int:
        """The last point that all instances can reach if it takes no more steps."""
        return self.point if self.plan.ahead else self.covered

    def has_step(self, point: int) -> bool:
        """Where all step point by point: whether it takes its next step before the next point."""
        return self.point + self.plan.wait_points <= point and self.step < self.last_step

    @property
    def lacking(self) -> Iterator[Source]:
        """The sources without the row for the next step; what is played needs none."""
        step = self.step
        if step < self.last_step and self.player is None:
            yield from (source for source in self.sources if not source.has(step))

    @property
    def waits_for(self) -> str:
        """What the next step waits for, in words."""
        source = next(self.lacking, None)
        if source is None:
            return "the master's grant"
        output, own = source.transfer.columns[0][:2]
        return f"'{source.instance}.{output}', which feeds '{source.transfer.target}.{own}'"


_NO_WAYS = Ways()


class Connected(NamedTuple):
    """What takes the frames of each link, by its number; the link itself if it brings initial values only.

    And where the rows of each link come to that has a stream.
    """

    receivers: dict[int, FrameReceiver | Link]
    streamed: dict[int, SourceRows]


def connect(
    plan: NodePlan,
    runners: Mapping[str, Runner],
    memory: HostMemory,
    own_memory: HostMemory,
    ways: Ways = _NO_WAYS,
) -> Connected:
    """Give all runners their sources: in ``memory`` for nodes that share it, and in mirrors for all others."""
    rows: dict[str, list[SourceRows]] = {name: [SourceRows(own.outputs, own.counter)] for name, own in runners.items()}
    places = {place.instance: place for place in plan.rings}
    receivers: dict[int, FrameReceiver | Link] = {}
    streamed: dict[int, SourceRows] = {}
    for link in plan.links_in:
        receivers[link.index] = link
        if link.initial_only:
            continue
        way, fits = ways.way(plan.node, link.source_node), partial(_fits, runners, link.source)
        found, receiver = rows_of(link, places[link.source], way, memory, own_memory, fits)
        if way == "stream":
            streamed.update((link.index, own) for own in found if own.text is False)
        rows.setdefault(link.source, []).extend(found)
        if receiver is not None:
            receivers[link.index] = receiver
    for runner in runners.values():
        runner.sources.extend(sources_of(runner, rows))
    solve_together(plan.groups, {name: runner.instance for name, runner in runners.items()})
    for group in plan.groups:
        first, *others = (runners[name] for name in group.members)
        first.solve_with(others)
    return Connected(receivers, streamed)


def sources_of(runner: Runner, rows: Mapping[str, Sequence[SourceRows]]) -> Iterator[Source]:
    """The sources of a runner, from the rows of each instance."""
    for feed in runner.plan.step_feeds:
        for ring, counter, text in rows[feed.source]:
            transfer = Transfer(feed, ring, runner.inputs, target=runner.name, text=text)
            if transfer.columns:
                yield Source(feed.source, transfer, counter)


def _is_done(_step: int) -> None:
    """The step of a member of a solved group that is not the first: that one has taken it."""


def _fits(runners: Mapping[str, Runner], source: str, end: int) -> bool:
    """Whether rows of a mirror before own step ``end`` overwrite no row that a step still needs."""
    return all(
        end - own.transfer.rule.row_for(runner.step) <= own.transfer.source.rows
        for runner in runners.values()
        for own in runner.sources
        if own.instance == source
    )
