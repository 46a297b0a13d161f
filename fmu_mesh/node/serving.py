"""The node's face to the rest of the world: info, status, current values, settings, streams and log.

Runs on a thread of its own. Values come from the rings (rows that were completed), or are read by the main thread at
the next point; settings are checked here and made by the main thread. So a query never waits for a step, a step never
waits for a query, and `status` answers while an FMU hangs.
"""

from __future__ import annotations

import logging
import queue
import threading
import time
from collections.abc import Callable, Mapping
from functools import partial

import msgspec
import zenoh

from ..errors import FmuError, FmuMeshError, StepFailed
from ..model.description import Value, Variable
from ..model.plan import NodePlan
from ..wire.inbox import Inbox
from ..wire.keys import Keys
from ..wire.messages import NodeReport
from ..wire.session import ask, matches, undeclare_all
from ..wire.values import ValueRefused, attachment, encode_value, json_encoding
from ..wire.views import InstanceStatus, LogLine, SetAnswer
from .info import instance_info
from .inputs import set_input
from .settings import checked_setting
from .stepping import Runner, Unit
from .streams import MAX_WAITING_ROWS, Batch, InstanceStreams, kind_of

__all__ = ["Server"]

log = logging.getLogger(__name__)

_TICK_S = 0.25
_ANSWER_S = 2.0
_LAST_ROWS_S = 1.0
_LAST_WORDS_S = 0.5
_STREAM_SHARE = 4.0

Job = Callable[[], None]


class Server:
    """Serves the instances of one node.

    Attributes:
        state: what the node is doing, for `status`.
        advancing: the unit that the main thread steps, if it does.
        waited_s: how long the main thread has waited since the first point.
    """

    def __init__(self, plan: NodePlan, session: zenoh.Session, keys: Keys, inbox: Inbox) -> None:
        self.state = "starting"
        self.waiting = False
        self.advancing: Unit | None = None
        self.waited_s = 0.0
        self._started: float | None = None
        self.on_hang: Callable[[FmuError], None] = lambda _error: None
        self._plan = plan
        self._session = session
        self._keys = keys
        self._inbox = inbox
        self._runners: Mapping[str, Runner] = {}
        self._streams: list[InstanceStreams] = []
        self._waiting_rows = 0
        self._pending: list[_Pending] = []
        self._jobs: queue.SimpleQueue[Job | None] = queue.SimpleQueue()
        self._entities: list[zenoh.Queryable[None] | zenoh.Subscriber[None]] = []
        self._status_publishers: dict[str, zenoh.Publisher] = {}
        self._log_publishers: dict[str, zenoh.Publisher] = {}
        self._under_way: tuple[str, int, float] | None = None
        for instance in plan.instances:
            self._declare_early(instance.name)
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name="server", daemon=True)
        self._thread.start()

    # --- called by the main thread

    def serve(self, runners: Mapping[str, Runner]) -> None:
        """From now on values can be asked for and set, and outputs be subscribed."""
        self._runners = runners
        for runner in runners.values():
            self._streams.append(
                InstanceStreams(runner, self._session, self._keys, self._plan.grid, self._streams_changed)
            )
            for kind in ("in", "param"):
                key = f"{self._keys.instance(runner.name)}/{kind}/*"
                take = partial(self._put_arrived, runner)
                self._entities.append(self._session.declare_subscriber(key, take, allowed_origin=zenoh.Locality.REMOTE))

    def stepped(self) -> None:
        """Hand rows that were just stepped to the streams that have subscribers."""
        for streams in self._streams:
            collected = streams.collect(self._waiting_rows)
            if collected is not None:
                rows, batch = collected
                self._waiting_rows += rows
                self._jobs.put(partial(self._publish_rows, rows, batch))

    def started(self) -> None:
        """All streams begin at the first point: subscriptions made before it are looked at now."""
        self._started = time.monotonic()
        for streams in self._streams:
            streams.update()
        self.stepped()

    def log_message(self, line: LogLine) -> None:
        """Publish one log message; never waits."""
        self._jobs.put(partial(self._publish_log, line))

    def close(self) -> None:
        """Publish what is waiting, for a second at most, and undeclare everything."""
        if self._closing.is_set():
            return
        self._jobs.put(None)
        self._thread.join(_LAST_ROWS_S)
        self._closing.set()
        undeclare_all(self._entities, self._status_publishers.values(), self._log_publishers.values())
        for streams in self._streams:
            streams.close()

    # --- the thread

    def _run(self) -> None:
        published = 0.0
        while True:
            try:
                job = self._jobs.get(timeout=_TICK_S)
            except queue.Empty:
                pass
            else:
                if job is None:
                    return
                try:
                    job()
                except zenoh.ZError as error:  # the peer that asked is gone
                    log.info("answer_not_sent", extra={"error": str(error)})
            now = time.monotonic()
            if now - published >= _TICK_S:
                published = now
                self._tick(now)

    def _tick(self, now: float) -> None:
        for pending in [p for p in self._pending if now - p.asked > _ANSWER_S]:
            self._pending.remove(pending)
            pending.refuse(f"not at a point yet: {self._status(pending.instance).activity}")
        for streams in self._streams:
            if dropped := streams.take_dropped():
                text = f"{dropped} points were not published: the run is faster than samples can be sent"
                self._publish_log(LogLine(streams.runner.name, "warning", "stream", text, streams.runner.point))
        for name, publisher in self._status_publishers.items():
            if matches(publisher):
                publisher.put(msgspec.json.encode(self._status(name)))
        self._look_at_steps(now)

    def _look_at_steps(self, now: float) -> None:
        """End a burst of steps that takes long, and find a step that meets its deadline.

        Other calls of an FMU are watched by `fmu_mesh.fmu.guard.CallWatch`.
        """
        if (unit := self.advancing) is None or self.state != "running":
            self._under_way = None
            return
        runner = unit.current
        under_way_s = now - self._since(runner, now)
        unit.hurry = True
        if under_way_s > self._plan.timeouts.step:
            self.on_hang(
                StepFailed(
                    f"the FMU has not returned for {under_way_s:.1f} s from doStep; its process is ended",
                    instance=runner.name,
                    point=runner.point,
                    time=self._plan.grid.time(runner.point),
                    hint="If it needs that long, raise `timeouts.step` in the configuration.",
                )
            )

    def _since(self, runner: Runner, now: float) -> float:
        """Since when the step of a runner has been under way, as far as was seen; costs the hot loop nothing."""
        if self._under_way is None or self._under_way[:2] != (runner.name, runner.step):
            self._under_way = (runner.name, runner.step, now)
        return self._under_way[2]

    def report_hang(self, error: FmuError, deadline_s: float) -> bool:
        """From a watching thread: tell the master that an FMU does not return; whether it knows now."""
        runner = self._runners.get(error.instance or "")
        if runner is not None and self.state != "initializing":
            error.point, error.time = runner.point, self._plan.grid.time(runner.point)
        report = NodeReport(self._plan.node, error.point or 0, error.report())
        try:
            ask(self._session, self._keys.report, msgspec.json.encode(report), deadline_s, "the master")
        except FmuMeshError as unreachable:
            log.warning("hang_not_reported", extra={"error": str(unreachable)})
            return False
        return True

    # --- queries

    def _declare_early(self, name: str) -> None:
        """What can be asked from the start, even before the FMU is loaded."""
        root = self._keys.instance(name)
        self._entities.append(self._session.declare_queryable(f"{root}/**", partial(self._query_arrived, name)))
        # A log message is not lost; the status is told again.
        for what, publishers, congestion_control in (
            ("status", self._status_publishers, zenoh.CongestionControl.DROP),
            ("log", self._log_publishers, zenoh.CongestionControl.BLOCK),
        ):
            publishers[name] = self._session.declare_publisher(
                f"{root}/{what}", encoding=json_encoding, congestion_control=congestion_control
            )

    def _query_arrived(self, name: str, query: zenoh.Query) -> None:
        self._jobs.put(partial(self._answer, name, query))

    def _answer(self, name: str, query: zenoh.Query) -> None:
        """Answer everything under the instance's key that the query's key expression matches."""
        root = self._keys.instance(name)
        asked = query.key_expr
        runner = self._runners.get(name)
        if query.payload is not None:
            self._answer_setting(name, query)
            return
        for what in ("info", "status"):
            if asked.intersects(zenoh.KeyExpr(f"{root}/{what}")):
                if what == "status":
                    query.reply(f"{root}/status", msgspec.json.encode(self._status(name)), encoding=json_encoding)
                elif runner is not None:
                    query.reply(
                        f"{root}/info", msgspec.json.encode(instance_info(self._plan, runner)), encoding=json_encoding
                    )
        wanted = self._variables_matching(runner, asked) if runner is not None else []
        if runner is None or not wanted:
            query.drop()
            return
        if self.state != "running":
            query.reply_err(f"'{name}' has no values now: {self.state}")
            query.drop()
            return
        known, unknown = self._split(runner, wanted)
        self._reply_values(runner, query, known, runner.step)
        if unknown:
            self._read_at_next_point(runner, query, unknown)
        else:
            query.drop()

    def _variables_matching(self, runner: Runner, asked: zenoh.KeyExpr) -> list[tuple[str, Variable]]:
        """(key, variable) of all variables that a key expression matches."""
        matching = []
        for variable in runner.instance.description.variables:
            kind = kind_of(variable)
            if kind is not None:
                key = self._keys.variable(runner.name, kind, variable.name)
                if asked.intersects(zenoh.KeyExpr(key)):
                    matching.append((key, variable))
        return matching

    def _split(
        self, runner: Runner, wanted: list[tuple[str, Variable]]
    ) -> tuple[list[tuple[str, Value]], list[tuple[str, Variable]]]:
        """Values that the rings hold, and variables that only the FMU knows."""
        names = {*runner.outputs.layout.names}
        known = [(key, runner.outputs.value(runner.step, v.name)) for key, v in wanted if v.name in names]
        return known, [(key, v) for key, v in wanted if v.name not in names]

    def _reply_values(self, runner: Runner, query: zenoh.Query, values: list[tuple[str, Value]], step: int) -> None:
        point = step * runner.plan.step_points
        stamp = attachment(point, self._plan.grid.time(point))
        for key, value in values:
            query.reply(key, encode_value(value), encoding=json_encoding, attachment=stamp)

    def _read_at_next_point(self, runner: Runner, query: zenoh.Query, wanted: list[tuple[str, Variable]]) -> None:
        pending = _Pending(runner.name, query)
        self._pending.append(pending)

        def read() -> None:
            values = runner.instance.get_values([variable.name for _, variable in wanted])
            pairs = [(key, value) for (key, _), value in zip(wanted, values, strict=True)]
            step = runner.step
            self._jobs.put(lambda: self._finish(pending, lambda: self._reply_values(runner, query, pairs, step)))

        self._inbox.post(read)

    def _finish(self, pending: _Pending, reply: Job) -> None:
        """Answer a query that waited for a point, unless it was refused in the meantime."""
        if pending in self._pending:
            self._pending.remove(pending)
            reply()
            pending.query.drop()

    # --- settings

    def _put_arrived(self, runner: Runner, sample: zenoh.Sample) -> None:
        attachment = sample.attachment.to_bytes() if sample.attachment is not None else None
        data = sample.payload.to_bytes()
        self._jobs.put(partial(self._take_put, runner, str(sample.key_expr), data, attachment))

    def _take_put(self, runner: Runner, key: str, data: bytes, attachment: bytes | None) -> None:
        try:
            new = checked_setting(runner, self._keys.instance(runner.name), key, data, attachment)
        except ValueRefused as refused:
            self._publish_log(LogLine(runner.name, "warning", "set", str(refused), runner.point))
            return

        def take() -> None:
            try:
                set_input(runner.instance, new.variable, new.value, new.time, runner.step)
            except ValueRefused as refused:
                self.log_message(LogLine(runner.name, "warning", "set", str(refused), runner.point))

        self._inbox.post(take)

    def _answer_setting(self, name: str, query: zenoh.Query) -> None:
        """A query with a payload sets a value and is told from which point on it holds, or why it was refused."""
        runner = self._runners.get(name)
        key = str(query.key_expr)
        if runner is None:
            query.reply_err(f"'{name}' is still being loaded")
            query.drop()
            return
        data = query.payload.to_bytes() if query.payload else b""
        attachment = query.attachment.to_bytes() if query.attachment is not None else None
        try:
            new = checked_setting(runner, self._keys.instance(runner.name), key, data, attachment)
        except ValueRefused as refused:
            query.reply_err(str(refused))
            query.drop()
            return
        pending = _Pending(name, query)
        self._pending.append(pending)

        def take() -> None:
            try:
                step = set_input(runner.instance, new.variable, new.value, new.time, runner.step)
            except ValueRefused as refused:
                reason = str(refused)
                self._jobs.put(lambda: self._finish(pending, lambda: query.reply_err(reason)))
                return
            point = step * runner.plan.step_points
            answer = SetAnswer(key, point, self._plan.grid.time(point))
            self._jobs.put(
                lambda: self._finish(
                    pending, lambda: query.reply(key, msgspec.json.encode(answer), encoding=json_encoding)
                )
            )

        self._inbox.post(take)

    # --- views

    def _status(self, name: str) -> InstanceStatus:
        runner = self._runners.get(name)
        if runner is None:
            return InstanceStatus(name, self.state, self.state, 0, self._plan.grid.time(0), 0.0, 0.0)
        return InstanceStatus(
            instance=name,
            state=self.state,
            activity=self._activity(runner),
            point=runner.point,
            time=self._plan.grid.time(runner.point),
            step_time=runner.step_seconds / runner.step if runner.step else 0.0,
            wait_time=self.waited_s,
            running_time=time.monotonic() - self._started if self._started is not None else 0.0,
        )

    def _activity(self, runner: Runner) -> str:
        if self.state != "running":
            return self.state
        if self.waiting:
            return f"waiting at point {runner.point} for {runner.lacking()}"
        unit = self.advancing
        current = unit.current if unit is not None else runner
        if current is not runner:
            return f"waiting at point {runner.point} for its turn: '{current.name}' is in doStep"
        now = time.monotonic()
        return f"in doStep at point {runner.point} for {now - self._since(runner, now):.1f} s"

    # --- publishing

    def say_everything(self) -> None:
        """Let what was logged so far go out before what follows from it; not for longer than `_LAST_WORDS_S`."""
        said = threading.Event()
        self._jobs.put(said.set)
        said.wait(_LAST_WORDS_S)

    def _streams_changed(self, streams: InstanceStreams) -> None:
        def update() -> None:
            self.stepped()  # what was stepped before belongs to the old set of variables
            streams.update()

        self._inbox.post(update)

    def _publish_rows(self, rows: int, batch: Batch) -> None:
        streams, first, columns = batch
        started = time.monotonic()
        streams.publish(first, columns)
        self._waiting_rows -= rows
        if self._waiting_rows > MAX_WAITING_ROWS // 2:
            # Subscribers cannot keep up with this run: they get a share of the node's time, and samples are left out.
            self._closing.wait(_STREAM_SHARE * (time.monotonic() - started))

    def _publish_log(self, line: LogLine) -> None:
        self._log_publishers[line.instance].put(msgspec.json.encode(line))


class _Pending:
    """A query that waits for its instance to come to a point."""

    def __init__(self, instance: str, query: zenoh.Query) -> None:
        self.instance = instance
        self.query = query
        self.asked = time.monotonic()

    def refuse(self, reason: str) -> None:
        self.query.reply_err(reason)
        self.query.drop()
