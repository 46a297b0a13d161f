"""Stepping: the inner loop of a node.

A `Runner` is one instance with its rings and feeds; a feed brings values of a source into the input ring. A `Unit` is
stepped together: it is one runner, which steps as far as its inputs and the grant allow, or a cycle of runners, which
step point by point. Nothing here waits.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
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
from ..system.plan import InstancePlan, NodePlan
from ..wire.frames import FrameReceiver
from .links import OutLink

__all__ = ["LAZY_S", "LocalFeed", "RemoteFeed", "Runner", "Unit", "connect_feeds"]

_BURST_S = 0.001
"""A burst of steps ends after about this time in s, so that its rows are sent and messages are handled."""

LAZY_S = 0.05
"""How long in s rows that no step needs may wait for more rows: each frame wakes a process, which needs a core."""


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
        step: number of own steps done; this is also the newest row of `outputs`.
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
        """Bind the instance to its rings, and read the current outputs. Call after Initialization Mode."""
        connected = [target for feed in self.plan.feeds for _, target, _, _ in feed.columns]
        fill_unconnected(self.inputs, connected, self.instance.get_values)
        outputs = (self.outputs,) if self.watched is None else (self.outputs, self.watched)
        self.instance.bind(self.inputs, outputs, self.grid, self.plan.step_points, self.step)

    def watch(self, names: Sequence[str]) -> None:
        """From now on also read these outputs after every step; the plan does not contain them."""
        variables = {variable.name: variable for variable in self.instance.description.variables}
        self.watched = Ring(Layout.of(variables[name] for name in names), self.outputs.rows) if names else None
        self.bind()

    def wrap(self, wrapper: Callable[[Instance], Wrapped]) -> Wrapped:
        """Replace the instance by what ``wrapper`` makes of it, from the next step on; return the new one."""
        self.instance = wrapped = wrapper(self.instance)
        return wrapped

    @property
    def point(self) -> int:
        """The communication point this instance is at."""
        return self.step * self.plan.step_points

    @property
    def covered(self) -> int:
        """The last point for which the outputs are known: they hold until the next own point."""
        if self.step >= self.last_step:
            return self.grid.last_point
        return min((self.step + 1) * self.plan.step_points - 1, self.grid.last_point)

    def limit(self, grant: int) -> int:
        """The own step up to which this instance may step now: k < grant and every input is there."""
        return min(-(-grant // self.plan.step_points), self.last_step, *self.ready_steps())

    def ready_steps(self, without: frozenset[str] = frozenset()) -> Iterator[int]:
        """Number of own steps for which all feeds have values; feeds from the instances in ``without`` are ignored."""
        for remote in self.remote_feeds:
            yield remote.ready
        for local in self.local_feeds:
            if local.source.name not in without:
                yield local.transfer.ready(local.source.step + 1)

    def lacking(self) -> str:
        """What the next step waits for, in words: the first feed without a value, or the grant."""
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
        """The run ends early: send the recorder the remaining rows before own step ``end``, and that no more come."""
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

    The length of a burst is estimated from earlier bursts, but an FMU may become slow from one step to the next. Then
    another thread may end the burst (`hurry`), and send rows during a long step (`meanwhile`).
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
        """The runner that is stepping."""
        return min(self.runners, key=lambda runner: (runner.step + 1) * runner.plan.step_points)

    def hurry(self) -> None:
        """From another thread: end the burst after the current step."""
        self._hurry = True

    def meanwhile(self, action: Callable[[], None]) -> None:
        """From another thread: call ``action`` if a burst is running; meanwhile only ``action`` uses links and inbox.

        The stepping thread sets `_stepping` before it reads `_hurry`, and this thread does the opposite. So one of the
        two sees the flag of the other, and the stepping thread waits at the end of its burst until ``action`` is done.
        """
        with self._returning:
            self._hurry = True
            if self._stepping:
                action()

    def advance(self, grant: int) -> bool:
        """Step as far as inputs and ``grant`` allow, for at most one burst; return whether there was a step."""
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
        """Step from point ``first`` to ``end``, or less far after `hurry`; return the point that was reached."""
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
                # A slower instance steps when the end of its step is reached: only then all its inputs can be known.
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
        """The point up to which the whole cycle may step: limited by the grant and by inputs from other units."""
        limit = grant
        for runner in self.runners:
            for ready in runner.ready_steps(without=self._inner):
                if ready < runner.last_step:
                    # The first own step without all inputs is taken at its last point; the others may step up to there.
                    limit = min(limit, (ready + 1) * runner.plan.step_points - 1)
            for link in runner.out_links:
                limit = min(limit, max(runner.step + 1, link.sent + link.capacity - 1) * link.link.step_points)
        return limit


def connect_feeds(plan: NodePlan, runners: Mapping[str, Runner]) -> dict[int, tuple[FrameReceiver, list[RemoteFeed]]]:
    """Give all runners their feeds; return the receiver of each link, by its index, with the feeds that use it."""
    remote: dict[int, tuple[FrameReceiver, list[RemoteFeed]]] = {}
    for link in plan.links_in:
        fed: list[RemoteFeed] = []
        fits = partial(_fit, fed)
        remote[link.index] = (FrameReceiver(link, f"node '{plan.node}'", plan.ring_rows, fits), fed)
    receivers = {
        receiver.link.source: (receiver, feeds) for receiver, feeds in remote.values() if not receiver.link.initial_only
    }
    for runner in runners.values():
        for feed in runner.plan.feeds:
            points = runner.plan.step_points
            if feed.source in runners:
                source = runners[feed.source]
                local = Transfer(
                    feed,
                    source.outputs.layout,
                    runner.inputs,
                    source_points=source.plan.step_points,
                    target_points=points,
                )
                runner.local_feeds.append(LocalFeed(source, local))
            else:
                receiver, feeds = receivers[feed.source]
                link = receiver.link
                transfer = Transfer(
                    feed, link.layout, runner.inputs, source_points=link.step_points, target_points=points
                )
                feeds.append(RemoteFeed(receiver, runner, transfer))
                runner.remote_feeds.append(feeds[-1])
    return remote


def _fit(feeds: Sequence[RemoteFeed], end: int) -> bool:
    """Whether the rows of the source before own step ``end`` fit into the ring without overwriting unused inputs."""
    return all(feed.transfer.ready(end) - feed.target.step <= feed.target.inputs.rows for feed in feeds)
