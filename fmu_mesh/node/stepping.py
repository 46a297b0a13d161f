"""Stepping: the hot loop of a node.

A `Runner` is one instance with its rings and feeds. A `Unit` is what is stepped together: one runner, which goes as far
ahead as its inputs and the grant allow, or a cycle of runners, which go point by point. Nothing here waits.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from threading import Lock
from time import perf_counter
from typing import TypeVar

from ..instances.call_guard import DEFAULT_MODE, floating_point_changed, restore_floating_point
from ..instances.contract import Instance
from ..rings.array_elements import fill_unconnected
from ..rings.ring import Ring
from ..rings.transfer import Transfer
from ..simtime import TimeGrid
from ..system.layout import Layout
from ..system.plan import InstancePlan
from ..wire.frames import FrameReceiver
from .links import OutLink

__all__ = ["LAZY_S", "LocalFeed", "RemoteFeed", "Runner", "Unit"]

_BURST_S = 0.001
"""A burst of steps ends after about this time, so that its rows are sent and messages are looked at."""

LAZY_S = 0.05
"""How long rows that nobody steps on may wait for more of them: each frame wakes a process that needs a core for it."""


Wrapped = TypeVar("Wrapped", bound=Instance)


class RemoteFeed:
    """A feed from another node: the receiver of the frames that bring it, and the instance that uses it."""

    def __init__(self, receiver: FrameReceiver, target: Runner, transfer: Transfer) -> None:
        self.receiver = receiver
        self.target = target
        self.transfer = transfer
        self.ready = 0


class LocalFeed:
    """A feed from a runner of the same node."""

    def __init__(self, source: Runner, transfer: Transfer) -> None:
        self.source = source
        self.transfer = transfer
        self.step = transfer.stepper(source.outputs)


class Runner:
    """One instance with its rings.

    Attributes:
        step: own steps done; the row of this step in `outputs` is the newest.
    """

    def __init__(self, plan: InstancePlan, instance: Instance, grid: TimeGrid, ring_rows: int) -> None:
        self.plan = plan
        self.name = plan.name
        self.instance = instance
        self.inputs = Ring(plan.inputs, ring_rows)
        self.outputs = Ring(plan.outputs, ring_rows)
        self.watched: Ring | None = None
        self.step = 0
        self.last_step = grid.last_point // plan.step_points
        self.out_links: list[OutLink] = []
        self.remote_feeds: list[RemoteFeed] = []
        self.local_feeds: list[LocalFeed] = []
        self.step_seconds = 0.0
        self.grid = grid

    def bind(self) -> None:
        """Let the instance work on the rings, and read the current outputs. Call after Initialization Mode."""
        connected = [target for feed in self.plan.feeds for _, target, _, _ in feed.columns]
        fill_unconnected(self.inputs, connected, self.instance.get_values)
        outputs = (self.outputs,) if self.watched is None else (self.outputs, self.watched)
        self.instance.bind(self.inputs, outputs, self.grid, self.plan.step_points, self.step)

    def watch(self, names: Sequence[str]) -> None:
        """From now on also read these outputs after every step; they are not among the plan's columns."""
        variables = {variable.name: variable for variable in self.instance.description.variables}
        self.watched = Ring(Layout.of(variables[name] for name in names), self.outputs.rows) if names else None
        self.bind()

    def wrap(self, wrapper: Callable[[Instance], Wrapped]) -> Wrapped:
        """From the next step on, step what ``wrapper`` makes around the instance; returns it."""
        self.instance = wrapped = wrapper(self.instance)
        return wrapped

    @property
    def point(self) -> int:
        """The communication point this instance is at."""
        return self.step * self.plan.step_points

    @property
    def covered(self) -> int:
        """The last point for which nobody has to wait for this instance: its outputs hold until its next own point."""
        if self.step >= self.last_step:
            return self.grid.last_point
        return min((self.step + 1) * self.plan.step_points - 1, self.grid.last_point)

    def limit(self, grant: int) -> int:
        """The own step up to which this instance may step now: k < grant and every input is there."""
        return min(-(-grant // self.plan.step_points), self.last_step, *self.ready_steps())

    def ready_steps(self, without: frozenset[str] = frozenset()) -> Iterator[int]:
        """Own steps for which each feed has its values; feeds from the instances in ``without`` are left out."""
        for remote in self.remote_feeds:
            yield remote.ready
        for local in self.local_feeds:
            if local.source.name not in without:
                yield local.transfer.ready(local.source.step + 1)

    def lacking(self) -> str:
        """In words what the next step waits for: the first feed that is not there, or the grant."""
        feeds: list[RemoteFeed | LocalFeed] = [*self.remote_feeds, *self.local_feeds]
        for feed in feeds:
            source_steps = feed.receiver.received if isinstance(feed, RemoteFeed) else feed.source.step + 1
            if feed.transfer.ready(source_steps) <= self.step:
                plan = feed.transfer.feed
                source, target = plan.columns[0][:2]
                return f"'{plan.source}.{source}', which feeds '{self.name}.{target}'"
        return "the master's grant"

    def flush(self, *, lazy: bool = True) -> None:
        """Send all rows that were not sent yet; those of lazy links only if ``lazy``."""
        end = self.step + 1
        for link in self.out_links:
            if lazy or not link.lazy:
                link.flush(end)

    def send_last(self, end: int) -> None:
        """The run ends early: send the recorder the rows before own step ``end`` that it lacks, and that it is all."""
        for link in self.out_links:
            if link.lazy:
                link.send_last(end)

    def flush_full(self) -> None:
        """Send the rows of those links whose frame is full."""
        end = self.step + 1
        for link in self.out_links:
            if end - link.sent >= link.capacity:
                link.flush(end)


class Unit:
    """Runners that are stepped together, in the order of the plan.

    How long a burst takes is known from those before it only, and an FMU may become slow from one step to the next:
    another thread may then end the burst (`hurry`) and do what cannot wait (`meanwhile`).
    """

    def __init__(self, runners: Sequence[Runner]) -> None:
        self.runners = runners
        self._single = runners[0] if len(runners) == 1 else None
        self._inner = frozenset(runner.name for runner in runners)
        self._one_rate = all(runner.plan.step_points == 1 for runner in runners)
        self._point = 0
        self._burst = 1
        self._starved = False
        self._lazy_flushed = 0.0
        self._stepping = False
        self._hurry = False
        self._returning = Lock()

    @property
    def current(self) -> Runner:
        """The runner whose step is under way while this is advanced."""
        return min(self.runners, key=lambda runner: (runner.step + 1) * runner.plan.step_points)

    def hurry(self) -> None:
        """From another thread: end the burst that is under way after the current step."""
        self._hurry = True

    def meanwhile(self, action: Callable[[], None]) -> None:
        """From another thread: call ``action`` if a burst is under way; for that time it alone uses links and inbox.

        The thread that steps sets `_stepping` before it looks at `_hurry`, and this one the other way round: one of the
        two sees the other, and the one that steps waits at the end of its burst until ``action`` is over.
        """
        with self._returning:
            self._hurry = True
            if self._stepping:
                action()

    def advance(self, grant: int) -> bool:
        """Step as far as inputs and ``grant`` allow, for one burst at most; whether anything was stepped."""
        started = perf_counter()
        self._stepping = True
        try:
            if self._single is not None:
                steps = self._advance_single(self._single, grant)
            else:
                steps = self._advance_cycle(grant)
        finally:
            self._stepping = False
            if self._hurry:
                with self._returning:
                    self._hurry = False
        if not steps:
            return False
        elapsed = perf_counter() - started
        if steps == self._burst and elapsed < _BURST_S:
            self._burst = min(2 * self._burst, 4096)
        elif elapsed > 2 * _BURST_S:
            self._burst = max(1, min(self._burst, steps) // 2)
        lazy = started + elapsed - self._lazy_flushed > LAZY_S
        if lazy:
            self._lazy_flushed = started + elapsed
        for runner in self.runners:
            runner.step_seconds += elapsed
            if lazy or self._starved or elapsed >= _BURST_S:
                runner.flush(lazy=lazy)
            runner.flush_full()
        return True

    def _advance_single(self, runner: Runner, grant: int) -> int:
        first = runner.step
        limit = runner.limit(grant)
        end = min(limit, first + self._burst)
        if end <= first:
            return 0
        for link in runner.out_links:
            end = min(end, max(first + 1, link.sent + link.capacity - 1))
        for feed in runner.local_feeds:
            feed.transfer.from_ring(feed.source.outputs, first, end)
        do_step = runner.instance.do_step
        one, half_ulp, quarter_ulp, tiny = DEFAULT_MODE
        for step in range(first, end):
            do_step(step)
            if one + half_ulp - quarter_ulp != one or not tiny + tiny:  # as `floating_point_changed`, without a call
                restore_floating_point()
            runner.step = step + 1
            if self._hurry:
                break
        self._starved = runner.step == limit
        return runner.step - first

    def _advance_cycle(self, grant: int) -> int:
        first = self._point
        limit = self._cycle_limit(grant)
        end = min(limit, first + self._burst)
        end = self._step_together(first, end) if self._one_rate else self._step_at_own_rates(first, end)
        self._point = end
        self._starved = end == limit
        return end - first

    def _step_together(self, first: int, end: int) -> int:
        """From point ``first`` to ``end``, or less far in a hurry; returns how far."""
        one, half_ulp, quarter_ulp, tiny = DEFAULT_MODE
        members = [
            (runner, [feed.step for feed in runner.local_feeds], runner.instance.do_step) for runner in self.runners
        ]
        for point in range(first, end):
            for runner, feeds, do_step in members:
                for feed in feeds:
                    feed(point)
                do_step(point)
                if one + half_ulp - quarter_ulp != one or not tiny + tiny:  # as in `_advance_single`
                    restore_floating_point()
                runner.step = point + 1
            if self._hurry:
                return point + 1
        return max(first, end)

    def _step_at_own_rates(self, first: int, end: int) -> int:
        """As `_step_together`."""
        for point in range(first, end):
            for runner in self.runners:
                # A slower instance steps when the end of its step is reached: only then all its inputs can be there.
                step, rest = divmod(point + 1 - runner.plan.step_points, runner.plan.step_points)
                if rest:
                    continue
                for feed in runner.local_feeds:
                    feed.step(step)
                runner.instance.do_step(step)
                if floating_point_changed():
                    restore_floating_point()
                runner.step = step + 1
            if self._hurry:
                return point + 1
        return max(first, end)

    def _cycle_limit(self, grant: int) -> int:
        """The point up to which the whole cycle may step: bounded by the grant and by what comes from outside."""
        limit = grant
        for runner in self.runners:
            for ready in runner.ready_steps(without=self._inner):
                if ready < runner.last_step:
                    # The first own step that lacks something is taken at its last point; the others go on up to there.
                    limit = min(limit, (ready + 1) * runner.plan.step_points - 1)
            for link in runner.out_links:
                limit = min(limit, max(runner.step + 1, link.sent + link.capacity - 1) * link.link.step_points)
        return limit
