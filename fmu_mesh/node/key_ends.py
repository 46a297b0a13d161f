"""The Zenoh keys at ends of connections of one node: what they limit, and what is said of them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from threading import Lock
from typing import Any, Final

import zenoh
import zenoh.ext
from zenoh.handlers import Callback

from ..config.mesh import TimeoutsConfig
from ..rings.host_memory import HostMemory
from ..system.live_keys import KeyInput, KeyValue
from ..system.memory_map import map_memory
from ..wire.session import undeclare_all
from ..wire.views import KeyStatus, LogLine
from .engine import Windows
from .key_inputs import KeyFeed
from .key_outputs import KeyOutputs
from .stepping import Runner

__all__ = ["FromTheFirst", "KeyEnds"]

_HISTORY_S: Final = 10.0
_MOST_HELD: Final = 1 << 12

_Subscriber = zenoh.Subscriber[Any] | zenoh.ext.AdvancedSubscriber[Any]


class KeyEnds:
    """The keys of the instances of one node.

    Call sequence on the main thread: `serve`, then `begin` at point 0, then `check` and `publish_now` after steps; at
    the end `close`. A run that repeats an earlier one has no keys.

    Args:
        post: lets the main thread do something, from any thread.
        log: publishes a log message; from any thread.
        tell: tells the recorder, if there is one, which values have come.

    Attributes:
        lossy: the outputs that another thread publishes.
    """

    def __init__(  # noqa: PLR0913, PLR0917  what a node has around its keys
        self,
        node: str,
        timeouts: TimeoutsConfig,
        session: zenoh.Session,
        post: Callable[..., None],
        log: Callable[[LogLine], None],
        tell: Callable[[Sequence[KeyValue]], None],
    ) -> None:
        self.lossy: list[KeyOutputs] = []
        self._node, self._timeouts = node, timeouts
        self._session = session
        self._around = post, log, tell
        self._feeds: list[KeyFeed] = []
        self._subscribers: list[_Subscriber] = []
        self._blocking: list[KeyOutputs] = []

    def serve(self, runners: Mapping[str, Runner]) -> None:
        """Subscribe and declare publishers; what comes from now on is used from point 0 on."""
        live = [runner for runner in runners.values() if runner.plan.recorded_keys is None]
        waiting = {
            f"{own.key} > {runner.name}.{own.variable}" for runner in live for own in runner.plan.keys_in if own.wait
        }
        blocking = {f"keys of {runner.name}" for runner in live if any(own.blocks for own in runner.plan.keys_out)}
        # A counter for each that limits the node, in memory of its own: only this thread uses it.
        map_, _ = map_memory([self._node, *waiting, *blocking], {})
        counters = HostMemory.private(map_, self._node).progress
        for runner in live:
            for own in runner.plan.keys_in:
                counter = counters.get(f"{own.key} > {runner.name}.{own.variable}")
                self._feeds.append(feed := KeyFeed(own, runner, counter, *self._around))
                self._subscribers.append(self._subscriber(feed, own))
            if any(not own.blocks for own in runner.plan.keys_out):
                self.lossy.append(KeyOutputs(runner, self._session, None, self._around[0]))
            if (counter := counters.get(f"keys of {runner.name}")) is not None:
                self._blocking.append(KeyOutputs(runner, self._session, counter, self._around[0]))

    def _subscriber(self, feed: KeyFeed, own: KeyInput) -> _Subscriber:
        """A subscriber; if steps wait for the key, it also gets what was published before, or lost with a link."""
        if not own.wait:
            return self._session.declare_subscriber(own.key, Callback(feed.arrived, indirect=False))
        take = Callback(FromTheFirst(self._session, feed.arrived), indirect=False)
        history = zenoh.ext.HistoryConfig(detect_late_publishers=True)
        recovery = zenoh.ext.RecoveryConfig(periodic_queries=None, heartbeat=True)
        subscriber = zenoh.ext.declare_advanced_subscriber(
            self._session, own.key, take, history=history, recovery=recovery
        )
        subscriber.sample_miss_listener(Callback(feed.missed, indirect=False))
        return subscriber

    def begin(self) -> None:
        """At point 0: use what has come before, and publish the first values."""
        for feed in self._feeds:
            feed.begin()
        for outputs in (*self.lossy, *self._blocking):
            outputs.begin()
        self.publish_now()

    @property
    def windows(self) -> Windows:
        """How far the node may be ahead: of the values that its steps wait for, and of outputs that block."""
        limits = [(feed.words, feed.counter, 1) for feed in self._feeds if feed.counter is not None]
        blocking = [(f"the keys of '{own.runner.name}'", own.counter, own.window) for own in self._blocking]
        return limits + [(words, counter, window) for words, counter, window in blocking if counter is not None]

    @property
    def publishes(self) -> bool:
        """Whether rows go to keys."""
        return bool(self.lossy or self._blocking)

    def publish_now(self) -> None:
        """Publish the rows that may not be lost; waits for who is slow."""
        for outputs in self._blocking:
            outputs.publish_now()

    def waits_for(self, name: str) -> str | None:
        """What the next step of an instance waits for, in words; None if it is no key."""
        return next((f.words for f in self._feeds if f.runner.name == name and f.holds(f.runner.point + 1)), None)

    def check(self, granted: int, now: float) -> None:
        """Look whether steps up to the point ``granted`` wait for a key for too long; ``now`` is in s.

        Raises:
            DeadlineExceeded: no value has come, or nobody reads one.
        """
        for feed in self._feeds:
            feed.check(granted, now, self._timeouts.step)
        for outputs in self._blocking:
            outputs.check(granted, now, self._timeouts.step)

    def look(self, now: float) -> None:
        """On the thread of the server: tell of keys that nobody has published for the time of a start."""
        for feed in self._feeds:
            feed.look(now, self._timeouts.start)

    def statuses(self, name: str) -> tuple[KeyStatus, ...]:
        """What `status` says of the keys of an instance; from any thread."""
        outputs = (own for own in (*self.lossy, *self._blocking) if own.runner.name == name)
        feeds = (feed.status for feed in self._feeds if feed.runner.name == name)
        return (*feeds, *(status for own in outputs for status in own.statuses))

    def close(self) -> None:
        """Undeclare everything."""
        undeclare_all(self._subscribers)
        for outputs in (*self.lossy, *self._blocking):
            outputs.close()


class FromTheFirst:
    """What an advanced subscriber calls: passes the samples of each publisher on, from its first one.

    The subscriber of Zenoh asks for what was published before it came. A value that comes meanwhile may be passed on at
    once, and then the earlier ones are dropped (1.10.2: if the publisher was detected as a late one, too). So this
    class asks again for what is before the first sample of a publisher. Called on threads of Zenoh.
    """

    def __init__(self, session: zenoh.Session, pass_on: Callable[[zenoh.Sample], object]) -> None:
        self._session, self._pass_on = session, pass_on
        self._lock = Lock()
        self._held: dict[tuple[str, int], list[zenoh.Sample]] = {}  # of each publisher; empty when nothing is missing

    def __call__(self, sample: zenoh.Sample) -> None:
        """A sample has come."""
        info = sample.source_info
        source = (str(info.source_id.zid), info.source_id.eid) if info is not None else None
        with self._lock:
            is_first = source is not None and source not in self._held
            held = self._held.setdefault(source, []) if source is not None else []
            if (held or (is_first and info is not None and info.source_sn > 0)) and len(held) < _MOST_HELD:
                held.append(sample)
            else:
                is_first = False
                self._pass_held(held)
                self._pass_on(sample)
        if is_first and held and source is not None:
            self._ask(f"{sample.key_expr}/@adv/pub/{source[0]}/{source[1]}/**", held)

    def _ask(self, key: str, held: list[zenoh.Sample]) -> None:
        found: list[zenoh.Sample] = []

        def take(reply: zenoh.Reply) -> None:
            if reply.ok is not None:
                found.append(reply.ok)

        def end() -> None:
            with self._lock:
                if held:
                    first = _number(held[0])
                    held[:0] = sorted((own for own in found if _number(own) < first), key=_number)
                    self._pass_held(held)

        self._session.get(
            key,
            Callback(take, end, indirect=False),
            consolidation=zenoh.ConsolidationMode.NONE,
            accept_replies=zenoh.ReplyKeyExpr.ANY,
            timeout=_HISTORY_S,
        )

    def _pass_held(self, held: list[zenoh.Sample]) -> None:
        for own in held:
            self._pass_on(own)
        held.clear()


def _number(sample: zenoh.Sample) -> int:
    """Of a sample among those of its publisher."""
    return sample.source_info.source_sn if sample.source_info is not None else 0
