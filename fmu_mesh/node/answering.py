"""Answers to the queries of a node, and the values that others set.

All of it runs on the server thread. Values come from complete rows, or the main thread reads them at the next point.
Settings are checked here and made by the main thread. A query that waits too long for a point is refused.
"""

from __future__ import annotations

import socket
import time
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import suppress
from datetime import UTC, datetime
from functools import partial
from typing import Final

import msgspec
import zenoh
from msgspec.structs import replace

from ..errors import MessageRefused
from ..system.live_keys import key_views
from ..system.plan import NodePlan
from ..system.start_values import why_not_settable
from ..variables.model_description import Value, Variable
from ..variables.value_conversion import to_plain
from ..variables.value_types import is_text
from ..wire.host_processes import own_pid
from ..wire.inbox import Inbox
from ..wire.keys import BY, Keys, VariableKind, escape, sender_in, unescape
from ..wire.messages import SetValue, decode_json
from ..wire.solved_loop import SolvedLoop
from ..wire.values import (
    NO_ORIGIN,
    Origin,
    ValueRefused,
    attachment,
    decode_origin,
    decode_value,
    encode_value,
    json_encoding,
    who_sent,
)
from ..wire.views import AuditEntry, ConnectionView, InstanceInfo, LogLine, SetAnswer, VariableView, Way
from ..wire.ways import Ways
from .activity import Activity
from .inputs import set_input
from .stepping import Runner
from .streams import VariableKeys, kind_of

__all__ = ["Answers", "Job"]

_ANSWER_S = 2.0
_BEFORE_VALUES = ("waiting for the mesh", "initializing")
"""States of a node that has its FMUs and no values yet. A mesh can be running for others already."""

_OLD_KINDS: Final[tuple[VariableKind, ...]] = ("in", "param")
"""On the keys of such values they could be set, before there was a key for it; for two more minor versions."""

_LOOKS = 3
_FEW_PUT, _MOST_PUT = 8, 1 << 14
"""Values that were put: so few are no flood, and no more than so many wait."""

_MOST_WARNED = 100
"""Largest number of senders that are warned of."""

_CAPABILITIES = (
    "can_handle_variable_step_size",
    "can_get_and_set_state",
    "can_serialize_state",
    "can_interpolate_inputs",
    "has_event_mode",
    "needs_execution_tool",
    "only_once_per_process",
)

Job = Callable[[], None]


class Answers:
    """Answers for the instances of one node.

    Args:
        post: lets the server thread do something; may be called from any thread.
        log: publishes a log message; on the server's thread.
        tell: tells the recorder and the master which value was set, or was refused.
    """

    def __init__(  # noqa: PLR0913, PLR0917  one node and whom it tells
        self,
        plan: NodePlan,
        inbox: Inbox,
        activity: Activity,
        post: Callable[[Job], None],
        log: Callable[[LogLine], None],
        tell: Callable[[SetValue | AuditEntry], None],
    ) -> None:
        self._plan = plan
        self._keys = Keys(plan.key_prefix, plan.mesh)
        self._inbox = inbox
        self._activity = activity
        self._post = post
        self._log = log
        self._tell = tell
        self._before: list[Job] | None = []
        self._pending: list[_Pending] = []
        self._early: list[_Pending] = []
        self._put: deque[tuple[Runner, zenoh.Sample]] = deque()
        self._without_time: set[str] = set()
        self._old: set[str] = set()
        self._refused: dict[tuple[str, str], AuditEntry] = {}

    def begin(self) -> None:
        """On the main thread, at point 0: set the values that came before; the initialization is as without them."""
        before, self._before = self._before or [], None
        for take in before:
            take()

    def answer(self, name: str, query: zenoh.Query) -> None:
        """Answer for every key of the instance that the query's key expression matches."""
        root, runner, pending = self._keys.instance(name), self._activity.runners.get(name), _Pending(name, query)
        if query.payload is not None:
            if runner is None:
                pending.refuse(f"'{name}' is still being loaded")
            else:
                self._set(runner, query, pending)
            return
        views: dict[str, Callable[[], object]] = {"status": lambda: self._activity.status(name)}
        if runner is not None:
            views["info"] = lambda: instance_info(self._plan, runner, self._activity.ways, self._activity.loops)
        for what, view in views.items():
            if query.key_expr.intersects(zenoh.KeyExpr(f"{root}/{what}")):
                query.reply(f"{root}/{what}", msgspec.json.encode(view()), encoding=json_encoding)
        self._answer_values(pending, pending.asked)

    def _answer_values(self, pending: _Pending, now: float) -> None:
        """Answer with the variables that a query matches; keep it for `turn` if there are no values yet."""
        name, query = pending.instance, pending.query
        runner = self._activity.runners.get(name)
        wanted = [*VariableKeys(self._keys, runner).matching(query.key_expr)] if runner is not None else []
        if runner is None or not wanted:
            query.drop()
            return
        plays = runner.player is not None  # it has no values of its own before the point of its state
        if (self._activity.state in _BEFORE_VALUES or plays) and now - pending.asked <= _ANSWER_S:
            self._early.append(pending)
            return
        if self._activity.state != "running" or plays:
            pending.refuse(f"'{name}' has no values now: {'restarting' if plays else self._activity.state}")
            return
        known, step = self._from_rows(runner, wanted)
        self._reply_values(runner, query, known, step)
        answered = {key for key, _ in known}
        unknown = [(key, variable) for key, variable in wanted if key not in answered]
        if not unknown:
            query.drop()
            return
        pending = _Pending(name, query)
        self._pending.append(pending)

        def read() -> None:
            values = runner.instance.get_values([variable.name for _, variable in unknown])
            pairs = [(key, value) for (key, _), value in zip(unknown, values, strict=True)]
            reply = partial(self._reply_values, runner, query, pairs, runner.step)
            self._post(partial(pending.finish, reply))

        self._inbox.post(read)

    def setting_keys(self, name: str) -> tuple[str, ...]:
        """The keys on which values for an instance are put."""
        keys = self._keys
        own = *(keys.variables(name, kind) for kind in _OLD_KINDS), keys.setting(name)
        return tuple(f"{key}/**" for key in (*own, *([f"{own[-1]}/{BY}"] if self._plan.secured else ())))

    def put_arrived(self, runner: Runner, sample: zenoh.Sample) -> None:
        """On a thread of Zenoh: accept a value that was put."""
        if len(self._put) >= _MOST_PUT:
            self._inbox.refusals.add(str(sample.key_expr), f"{_MOST_PUT} other values wait")
        else:
            self._put.append((runner, sample))
            self._post(self._take_put)

    def _take_put(self) -> None:
        runner, sample = self._put.popleft()
        if len(self._put) == _FEW_PUT:
            self._inbox.post(lambda: None)  # wakes the main thread for those before: all that follow may be refused
        self._set(runner, sample)

    def turn(self, now: float) -> None:
        """Answer queries that waited for the first point; refuse those that have waited too long for a point."""
        early, self._early = self._early, []
        for pending in early:
            self._answer_values(pending, now)
        for pending in [p for p in self._pending if now - p.asked > _ANSWER_S]:
            pending.refuse(f"not at a point yet: {self._activity.status(pending.instance).activity}")
        self._pending = [pending for pending in self._pending if not pending.is_answered]
        self.tell_refused()

    def tell_refused(self) -> None:
        """Tell what was refused since the last time; of one sender at one key at once."""
        if self._before is None:  # the links are there
            refused, self._refused = self._refused, {}
            for entry in refused.values():
                self._tell(entry)

    def _from_rows(self, runner: Runner, wanted: list[tuple[str, Variable]]) -> tuple[list[tuple[str, Value]], int]:
        """The outputs in the rows of the newest own step, and that step; what only the FMU has is not included.

        An input or a parameter that was set since then has its new value in the FMU only, also if it is recorded.

        The main thread steps meanwhile, and may overwrite this row of the ring with values of a later step. Then the
        values are read again; after a few attempts the main thread reads them.
        """
        ring = runner.outputs
        for _ in range(_LOOKS):
            step = runner.step
            values = [
                (key, ring.value(step, v.name))
                for key, v in wanted
                if v.name in ring.layout and v.causality == "output"
            ]
            if runner.step + 1 - step < ring.rows:
                return values, step
        return [], runner.step

    def _reply_values(self, runner: Runner, query: zenoh.Query, values: list[tuple[str, Value]], step: int) -> None:
        point = step * runner.plan.step_points
        stamp = attachment(point, self._plan.grid.time(point))
        for key, value in values:
            query.reply(key, encode_value(value), encoding=json_encoding, attachment=stamp)

    def _set(self, runner: Runner, sent: zenoh.Query | zenoh.Sample, pending: _Pending | None = None) -> None:
        """Let the main thread set variables between two steps, if all values that were sent are allowed.

        The ``pending`` query, if they were sent with one, is answered with the point from which on they hold. If they
        are refused, the log and the audit have the reason, too.
        """
        refuse = partial(self._refuse, runner, sent, pending)

        def take() -> None:
            if self._before is not None:
                self._before.append(take)
                return
            at, when, step = runner.point, origin.time, runner.step
            if pending is None and when is not None and when > runner.grid.latest(at, streamed=True):
                self._post(partial(self._warn_of_time, runner, origin.who, when, at))
                when = None  # nobody hears a refusal, and a command must not be lost
            try:
                for own, (name, value) in values.items():
                    step = set_input(runner, name, value, when)
                    self._tell(SetValue(runner.name, name, to_plain(value), at, when, own, origin.who, by))
            except ValueRefused as refused:
                self._post(partial(refuse, str(refused)))
            else:
                if pending is not None:
                    self._post(partial(self._confirm, runner, key, pending, step, when))

        key = str(sent.key_expr)
        try:
            values, origin, by = self._checked_settings(runner, key, sent.payload, sent.attachment)
        except ValueRefused as refused:
            refuse(str(refused))
            return
        if pending is not None:
            self._pending.append(pending)
        # Where more values wait, the last of them wake the main thread for all.
        self._inbox.post(take, later=len(self._put) > _FEW_PUT)

    def _refuse(self, runner: Runner, sent: zenoh.Query | zenoh.Sample, pending: _Pending | None, reason: str) -> None:
        key, now, at = str(sent.key_expr), datetime.now(UTC).isoformat(timespec="milliseconds"), runner.point
        who = sender_in(key)
        with suppress(MessageRefused):
            who = who or who_sent(sent.attachment)
        new = AuditEntry("refused", who, now, at, key, reason)
        if (known := self._refused.get((who, key))) is not None:
            self._refused[who, key] = known.and_again(new)
        elif len(self._refused) < _MOST_WARNED:
            self._refused[who, key] = new
            self._log(LogLine(runner.name, "warning", "set", reason, at))
        if pending is not None:  # at last: nothing can be read of a query that was answered
            pending.refuse(reason)

    def _confirm(self, runner: Runner, key: str, pending: _Pending, step: int, when: float | None) -> None:
        grid, points = self._plan.grid, runner.plan.step_points
        late = when is not None and step > grid.step_at(when, points)
        answer = msgspec.json.encode(SetAnswer(key, step * points, grid.time(step * points), late))
        pending.finish(partial(pending.query.reply, key, answer, encoding=json_encoding))

    def _warn_of_time(self, runner: Runner, who: str, time: float, at: int) -> None:
        if who not in self._without_time and len(self._without_time) < _MOST_WARNED:
            self._without_time.add(who)
            text = f"the time {time:.12g} s that '{who}' sends is no simulation time of this run, which is at"
            text += f" {runner.grid.time(at):.12g} s: its values take effect at once. Does it run with use_sim_time?"
            self._log(LogLine(runner.name, "warning", "set", text, at))

    def _checked_settings(
        self, runner: Runner, key: str, payload: zenoh.ZBytes | None, attachment: zenoh.ZBytes | None
    ) -> tuple[dict[str, tuple[str, Value]], Origin, str]:
        """What arrived for one variable or several: by key, name and value; when they hold, who sent them, his name.

        Raises:
            ValueRefused: one of them is not allowed.
        """
        kind, *names = key.removeprefix(f"{self._keys.instance(runner.name)}/").split("/")
        is_named = kind == "set" and names[:1] == [BY] and len(names) > 1
        by, names = (names[1], names[2:]) if is_named else ("", names)
        if len(names) > 1 or "*" in key:
            raise ValueRefused(f"'{key}' is not the key of one variable")
        if kind in _OLD_KINDS or bool(by) != self._plan.secured:
            self._look_at_old_key(runner, key, kind, names)
        data = payload.to_bytes() if payload is not None else b""
        try:
            sent = {unescape(names[0]): data} if names else decode_json(data, dict[str, msgspec.Raw])
        except MessageRefused as error:
            raise ValueRefused(f"'{key}' takes an object with a value for each variable ({error})") from error
        values = {}
        for name, value in sent.items():
            variable = self._settable(runner, kind if kind != "set" else None, name)
            try:
                own = decode_value(bytes(value), variable, finite=runner.plan.not_finite == "stop")
            except ValueRefused as refused:
                raise ValueRefused(f"'{runner.name}.{name}': {refused}") from refused
            values[key if names else f"{key}/{escape(name)}"] = name, own
        try:
            return values, decode_origin(attachment.to_bytes()) if attachment is not None else NO_ORIGIN, by
        except ValueRefused as refused:
            raise ValueRefused(f"'{runner.name}.{', '.join(sent)}': {refused}") from refused

    def _look_at_old_key(self, runner: Runner, key: str, kind: str, names: list[str]) -> None:
        """Say which key takes the place of an old one, or of one without a name.

        Raises:
            ValueRefused: the mesh has security, where only keys with a name set something.
        """
        new = replace(self._keys, by="NAME" if self._plan.secured else None)
        new_key = new.setting(runner.name, *map(unescape, names))
        if self._plan.secured:
            raise ValueRefused(f"this mesh has security: '{new_key}' sets it, with your name, and not '{key}'")
        if kind in _OLD_KINDS and key not in self._old and len(self._old) < _MOST_WARNED:
            self._old.add(key)
            text = f"'{key}' sets nothing from version 0.6 on: send to '{new_key}'"
            self._log(LogLine(runner.name, "warning", "set", text, runner.point))

    def _settable(self, runner: Runner, kind: str | None, name: str) -> Variable:
        """A variable that may be set; for an old key, by the part of the key space that it is in."""
        variable = runner.instance.description.variable(name)
        if variable is None or (kind is not None and kind_of(variable) != kind):
            clock = runner.instance.description.clock(name)
            under = f" under '{kind}'" if kind is not None else ""
            raise ValueRefused(clock or f"'{runner.name}' has no variable '{name}'{under}")
        try:
            runner.plan.check_settable(variable)
        except ValueRefused as refused:
            raise ValueRefused(f"'{runner.name}.{name}' {refused}") from refused
        return variable


class _Pending:
    """A query that waits until its instance reaches a point; it is answered once."""

    def __init__(self, instance: str, query: zenoh.Query) -> None:
        self.instance = instance
        self.query = query
        self.asked = time.monotonic()
        self.is_answered = False

    def finish(self, reply: Job) -> None:
        if not self.is_answered:
            self.is_answered = True
            reply()
            self.query.drop()

    def refuse(self, reason: str) -> None:
        self.finish(partial(self.query.reply_err, reason))


def instance_info(plan: NodePlan, runner: Runner, ways: Ways | None, loops: Sequence[SolvedLoop]) -> InstanceInfo:
    """What `info` answers for an instance of this process."""
    description, start_values = runner.instance.description, runner.plan.start_values
    sources, timeouts = runner.plan.sources, {own.variable: str(own) for own in runner.plan.timeouts}
    nodes = {link.source: link.source_node for link in plan.links_in}

    def way_of(source: str, target: str, *, initial_only: bool) -> Way | None:
        if ways is None or source not in nodes:
            return None
        of = description.variable_of(target)
        by_message = initial_only or (of is not None and is_text(of.type))
        return "zenoh" if by_message else ways.way(plan.node, nodes[source])

    return InstanceInfo(
        instance=runner.name,
        model_name=description.model_name,
        description=description.description,
        fmi_version=description.fmi_version,
        kind=description.kind,
        fmu=runner.plan.fmu,
        generation_tool=description.generation_tool,
        capabilities={name: getattr(description, name) for name in _CAPABILITIES},
        default_experiment=description.default_experiment,
        step_size=plan.grid.step_size * runner.plan.step_points,
        variables=tuple(
            VariableView(
                v.name,
                f"{kind}/{escape(v.name)}",
                v.declared_type or v.type,
                v.causality,
                v.variability,
                v.unit,
                start_values.get(v.name, to_plain(v.start) if v.start is not None else None),
                v.description,
                v.shape,
                v.minimum,
                v.maximum,
                v.items,
                why_not_settable(v, sources.get(v.name)) is None,
                timeouts.get(v.name),
            )
            for v in description.variables
            if (kind := kind_of(v)) is not None
        ),
        connections=tuple(
            ConnectionView(
                f"{feed.source}.{own.source}",
                f"{runner.name}.{own.target}",
                feed.rule.delay,
                own.factor,
                own.offset,
                own.map,
                initial_only,
                way_of(feed.source, own.target, initial_only=initial_only),
            )
            for initial_only, feeds in ((False, runner.plan.feeds), (True, runner.plan.parameters))
            for feed in feeds
            for own in feed.columns
        ),
        node=plan.node,
        pid=own_pid(),
        host=socket.gethostname(),
        problems=description.problems,
        clocks=description.clocks,
        keys=key_views(runner.name, *runner.plan.keys_in, *runner.plan.keys_out),
        deploy_host=plan.host or "",
        loops=tuple(own for own in loops if any(name.startswith(f"{runner.name}.") for name in own.outputs)),
    )
