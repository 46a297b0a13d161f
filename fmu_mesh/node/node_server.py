"""What other programs see of a node: info, status, current values, settings, streams and log.

`fmu_mesh.node.answering` has the answers. `status` is answered while an FMU hangs.
"""

from __future__ import annotations

import queue
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from functools import partial

import msgspec
import zenoh
from zenoh.handlers import Callback

from ..errors import FmuError
from ..system.attempt import Attempt
from ..system.live_keys import KeyValue
from ..system.plan import NodePlan
from ..wire.inbox import Inbox
from ..wire.keys import BY, SUBSCRIBED, Keys
from ..wire.messages import SetValue, decode_json
from ..wire.session import matches, undeclare_all
from ..wire.values import json_encoding
from ..wire.views import AuditEntry, LogLine
from .activity import Activity
from .answering import Answers, Job
from .inputs import TimedInputs
from .key_ends import KeyEnds
from .stepping import Runner
from .streams import InstanceStreams, WaitingRows

__all__ = ["NodeServer"]

# Threads: one of its own, `server`, on which every job runs: queries, searches, samples, log lines. Threads of Zenoh
# and the main thread only put jobs. What needs an FMU is posted to the main thread through the inbox, and its answer
# comes back as a job. So a query never waits for a step, a step never waits for a query, and no lock is held while
# either runs.
#
# What may go wrong: a job fails (the guard of the inbox counts it, and the thread goes on); a step never returns
# (this thread notices it in `_tick` and answers `status`); a subscriber is slower than the run (samples are dropped,
# and told); the main thread ends while jobs wait (`close` gives them a second, then what is left is not published);
# the master ends before log lines have reached it (`say_everything` waits for an answer that comes after them).
#
# Why not in the callbacks of Zenoh: one that waits for a point would hold all later queries of its instance. ADR 68
# says why nothing is declared for a variable.

_TICK_S = 0.25
_TICK_BEFORE_S = 1.0
"""Before the first point, when little changes: of hundreds that start, each waits for all others."""
# A stream whose subscriber Zenoh does not announce (it reports only the first of an instance) begins within about this
# time; shorter would take the main thread's time for nothing.
_SEARCH_S = 0.05
_LOOK_SHARE = 20
"""Looking for new subscribers takes one part in so many of the time. For one subscriber it takes about 1 ms."""
_LAST_ROWS_S = 1.0
_LAST_WORDS_S = 0.5
_STREAM_SHARE = 4.0
_FLOOD = 8
"""Where more jobs wait, those for others get a share of the node's time, and steps the rest."""
_EARLY_LINES = 1000
"""Largest number of log messages that are kept until this node has joined the mesh."""


class NodeServer:
    """Serves the instances of one node.

    Args:
        on_hang: called on the server thread if a step does not return in time.
        tell: tells the recorder and the master which value was set or refused, or which have come by keys.

    Attributes:
        keys: the Zenoh keys at ends of connections.
        is_live: whether values are published and set; after a restart, not before the last point that was seen.
    """

    def __init__(  # noqa: PLR0913, PLR0917  one node and whom it tells
        self,
        plan: NodePlan,
        session: zenoh.Session,
        inbox: Inbox,
        activity: Activity,
        on_hang: Callable[[FmuError], None],
        tell: Callable[[SetValue | AuditEntry | Sequence[KeyValue]], None],
    ) -> None:
        self._on_hang = on_hang
        self._plan = plan
        self._session = session
        self._names = Keys(plan.key_prefix, plan.mesh)
        self._inbox = inbox
        self._activity = activity
        self._streams: list[InstanceStreams] = []
        self._declared: dict[str, zenoh.KeyExpr] = {}
        self._searches = False
        self._next_search = 0.0
        self._rows: deque[WaitingRows] = deque()
        self._waiting_rows = 0
        self._jobs: queue.SimpleQueue[Job | None] = queue.SimpleQueue()
        self.keys = KeyEnds(plan.node, plan.timeouts, session, inbox.post, self.log_message, tell)
        self._answers = Answers(plan, inbox, activity, self._serve_others, self._publish_log, tell)
        self._entities: list[zenoh.Queryable[None] | zenoh.Subscriber[None] | zenoh.LivelinessToken] = []
        self._status_publishers: dict[str, zenoh.Publisher] = {}
        self._log_publishers: dict[str, zenoh.Publisher] = {}
        self._early_lines: list[LogLine] = []
        self._begun = self.is_live = False
        self._live_from = 0
        self._visible = threading.Event()
        self._closing, self._hurries = threading.Event(), threading.Event()
        self._thread = threading.Thread(target=self._run, name="server", daemon=True)
        self._thread.start()

    def open(self) -> None:
        """From any thread, after the master has admitted the node: it is visible afterwards, even while FMUs load.

        What the node sends after this comes to the master later than what is declared here. So a query for any instance
        of a mesh that has begun finds it.
        """
        self._jobs.put(self._declare)
        self._visible.wait(self._plan.timeouts.start)

    # --- called by the main thread

    def serve(self, runners: Mapping[str, Runner], attempt: Attempt, given_to: int = 0) -> None:
        """From now on values can be read and set, and streams can be subscribed, in this attempt of the run.

        After a restart, nothing is set before all values up to the point ``given_to`` were given again: the order of
        the values of one point is theirs.
        """
        self._live_from = max(attempt.replays_to, given_to)
        self.keys.serve(runners)
        self._activity.serve(runners, self.keys, attempt)
        for runner in runners.values():
            changed = partial(self._jobs.put, self._search)
            grid, declared = self._plan.grid, self._declared
            self._streams.append(InstanceStreams(runner, self._session, self._names, grid, changed, declared))
            for key in self._answers.setting_keys(runner.name):
                # On the thread that reads the link: what is put is a job before a query that came after it.
                take = Callback(partial(self._answers.put_arrived, runner), indirect=False)
                self._entities.append(self._session.declare_subscriber(key, take, allowed_origin=zenoh.Locality.REMOTE))

    @property
    def is_unfollowed(self) -> bool:
        """Whether nobody would get the next row at once: no streams have subscribers, and no rows go to keys."""
        follow = self.keys.publishes or any(
            own.is_active and self._waiting_rows <= own.backlog for own in self._streams
        )
        return self.is_live and not follow

    def stepped(self) -> None:
        """Give new rows to the streams that have subscribers, and to keys."""
        if not self.is_live:
            if any(own.runner.point < self._live_from for own in self._streams):
                return
            self._go_live()
        self.keys.publish_now()
        for streams in (*self.keys.lossy, *self._streams):
            if (batch := streams.collect(self._waiting_rows)) is not None:
                self._waiting_rows += len(batch.steps)
                self._rows.append(batch)
                self._jobs.put(self._publish_rows)

    def started(self) -> None:
        """All streams begin at the first point: find the subscriptions that were made before it."""
        self._begun = True
        looked = threading.Event()

        def look() -> None:
            try:
                for streams in self._streams:
                    streams.look()
            finally:
                looked.set()

        self._jobs.put(look)
        looked.wait(self._plan.timeouts.start)
        for streams in self._streams:
            streams.update()
        self.stepped()

    def _go_live(self) -> None:
        """Set the values that came before, and publish from here on."""
        self.is_live = True
        for streams in self._streams:
            if isinstance(inputs := streams.runner.instance, TimedInputs):
                inputs.take_given(streams.runner.step)
        self._answers.begin()
        self.keys.begin()
        for streams in self._streams:
            streams.skip()

    def log_message(self, line: LogLine) -> None:
        """Publish one log message; never waits."""
        self._jobs.put(partial(self._publish_log, line))

    def close(self) -> None:
        """Publish what is waiting, for a second at most, and undeclare everything."""
        if self._closing.is_set():
            return
        self._hurries.set()
        self._jobs.put(None)
        self._thread.join(_LAST_ROWS_S)
        self._closing.set()
        undeclare_all(self._entities, self._status_publishers.values(), self._log_publishers.values())
        for streams in self._streams:
            streams.close()
        self.keys.close()

    # --- the thread

    def _run(self) -> None:
        published = 0.0
        while True:
            with suppress(queue.Empty):
                tick_s = _TICK_S if self._begun else _TICK_BEFORE_S
                if (job := self._jobs.get(timeout=_SEARCH_S if self._searches else tick_s)) is None:
                    while self._rows and not self._closing.is_set():
                        self._publish_rows()
                    self._answers.tell_refused()
                    return
                with self._inbox.refusals.guard("a query or a value"):
                    job()
            now = time.monotonic()
            if self._searches and now >= self._next_search:
                self._search()
            if now - published >= _TICK_S:
                published = now
                self._tick(now)

    def _tick(self, now: float) -> None:
        self._answers.turn(now)
        self.keys.look(now)
        for streams in (*self.keys.lossy, *self._streams):
            if dropped := streams.take_dropped():
                text = f"{dropped} points were not published: the run is faster than samples can be sent"
                self._publish_log(LogLine(streams.runner.name, "warning", "stream", text, streams.runner.point))
        for name, publisher in self._status_publishers.items():
            if matches(publisher):
                publisher.put(msgspec.json.encode(self._activity.status(name)))
        for line in self._activity.look_at_waits():
            self._publish_log(line)
        if (hang := self._activity.look_at_steps()) is not None:
            self._on_hang(hang)

    # --- queries

    def _serve_others(self, job: Job) -> None:
        """From any thread: let the server's thread do something for somebody else; in a flood it rests after each."""

        def serve() -> None:
            began = time.monotonic()
            job()
            if self._jobs.qsize() > _FLOOD:
                self._hurries.wait(_STREAM_SHARE * (time.monotonic() - began))

        self._jobs.put(serve)

    def _declare(self) -> None:
        session = self._session
        try:
            for name in (instance.name for instance in self._plan.instances):
                root = self._names.instance(name)
                self._entities.append(session.liveliness().declare_token(root))
                take = self._inbox.refusals.answering(partial(self._answer, name), self._serve_others)
                for key in (f"{root}/**", *([f"{root}/set/{BY}/**"] if self._plan.secured else ())):
                    self._entities.append(session.declare_queryable(key, take))
                publisher = partial(session.declare_publisher, encoding=json_encoding)
                # A log message must not be lost; the status is published again.
                drop, block = zenoh.CongestionControl.DROP, zenoh.CongestionControl.BLOCK
                self._status_publishers[name] = publisher(f"{root}/status", congestion_control=drop)
                self._log_publishers[name] = publisher(f"{root}/log", congestion_control=block)
        finally:
            self._visible.set()
        for line in self._early_lines:
            self._publish_log(line)

    def _answer(self, name: str, query: zenoh.Query) -> None:
        if SUBSCRIBED in query.parameters:
            self._look(name, None if query.attachment is None else query.attachment.to_bytes())
        self._answers.answer(name, query)

    # --- publishing

    def say_everything(self, *, heard: bool = False) -> None:
        """Wait until all log messages so far are published, before their consequences; at most for `_LAST_WORDS_S`.

        With ``heard``, wait as long again for any answer of the master: then it has them.
        """
        said = threading.Event()
        self._hurries.set()
        self._jobs.put(said.set)
        said.wait(_LAST_WORDS_S)
        if heard:
            next(iter(self._session.get(self._names.mesh_key("status"), timeout=_LAST_WORDS_S)), None)

    def _search(self) -> None:
        """Go on looking for new subscribers: Zenoh reports only the first one of an instance, and when all are gone."""
        for streams in self._streams:
            if streams.look(_SEARCH_S / _LOOK_SHARE):
                self._inbox.post(partial(self._update, streams))
        self._searches = any(streams.is_followed for streams in self._streams)
        self._next_search = time.monotonic() + _SEARCH_S

    def _look(self, name: str, names: bytes | None) -> None:
        """Find what a program has subscribed to before it asked: the variables that it names, or any."""
        asked = decode_json(names, dict[str, list[str] | None]).get(name, []) if names is not None else None
        for streams in (own for own in self._streams if own.runner.name == name):
            if streams.look() if asked is None else streams.look_at(asked):
                self._inbox.post(partial(self._update, streams))

    def _update(self, streams: InstanceStreams) -> None:
        self.stepped()  # the earlier rows belong to the old set of variables
        streams.update()

    def _publish_rows(self) -> None:
        """Publish a part of the first rows that wait; the others are jobs after those that wait already."""
        if not self._rows:
            return
        batch, started = self._rows[0], time.monotonic()
        streams, (part, rest) = batch.streams, batch.parts()
        streams.publish(part.steps, part.blocks)
        self._waiting_rows -= len(part.steps)
        if len(rest.steps):
            self._rows[0] = rest
            self._jobs.put(self._publish_rows)
        else:
            self._rows.popleft()
        if self._waiting_rows > streams.backlog:
            # Subscribers are slower than this run: publishing gets a share of the node's time, and samples are dropped.
            self._hurries.wait(_STREAM_SHARE * (time.monotonic() - started))

    def _publish_log(self, line: LogLine) -> None:
        publisher = self._log_publishers.get(line.instance)
        if publisher is not None:
            publisher.put(msgspec.json.encode(line))
        elif len(self._early_lines) < _EARLY_LINES:
            self._early_lines.append(line)
