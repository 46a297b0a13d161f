"""Answers to the queries of a node, and the values that others set.

All of it runs on the server thread. Values come from complete rows, or the main thread reads them at the next point.
Settings are checked here and made by the main thread. A query that waits too long for a point is refused.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial

import msgspec
import zenoh

from ..system.plan import NodePlan
from ..system.settable import check_settable
from ..variables.model_description import Value, Variable
from ..wire.inbox import Inbox
from ..wire.keys import Keys, unescape
from ..wire.values import ValueRefused, attachment, decode_time, decode_value, encode_value, json_encoding
from ..wire.views import LogLine, SetAnswer
from .activity import Activity
from .info import instance_info
from .inputs import set_input
from .stepping import Runner
from .streams import kind_of

__all__ = ["Answers", "Job"]

_ANSWER_S = 2.0
_BEFORE_VALUES = ("waiting for the mesh", "initializing")
"""States of a node that has its FMUs and no values yet. A mesh can be running for others already."""

_LOOKS = 3

Job = Callable[[], None]


class Answers:
    """Answers for the instances of one node.

    Args:
        plan: what the node has to do.
        inbox: the inbox of the node, to let the main thread do something.
        activity: what the node is doing.
        post: lets the server thread do something; may be called from any thread.
        log: publishes a log message; on the server's thread.
    """

    def __init__(
        self,
        plan: NodePlan,
        inbox: Inbox,
        activity: Activity,
        post: Callable[[Job], None],
        log: Callable[[LogLine], None],
    ) -> None:
        self._plan = plan
        self._keys = Keys(plan.key_prefix, plan.mesh)
        self._inbox = inbox
        self._activity = activity
        self._post = post
        self._log = log
        self._pending: list[_Pending] = []
        self._early: list[_Pending] = []

    def answer(self, name: str, query: zenoh.Query) -> None:
        """Answer for every key of the instance that the query's key expression matches."""
        root = self._keys.instance(name)
        asked = query.key_expr
        runner = self._activity.runners.get(name)
        if query.payload is not None:
            self._answer_setting(name, query)
            return
        for what in ("info", "status"):
            if asked.intersects(zenoh.KeyExpr(f"{root}/{what}")):
                if what == "status":
                    query.reply(
                        f"{root}/status", msgspec.json.encode(self._activity.status(name)), encoding=json_encoding
                    )
                elif runner is not None:
                    query.reply(
                        f"{root}/info", msgspec.json.encode(instance_info(self._plan, runner)), encoding=json_encoding
                    )
        pending = _Pending(name, query)
        self._answer_values(pending, pending.asked)

    def _answer_values(self, pending: _Pending, now: float) -> None:
        """Answer with the variables that a query matches; keep it for `turn` if there are no values yet."""
        name, query = pending.instance, pending.query
        runner = self._activity.runners.get(name)
        wanted = self._variables_matching(runner, query.key_expr) if runner is not None else []
        if runner is None or not wanted:
            query.drop()
            return
        if self._activity.state in _BEFORE_VALUES and now - pending.asked <= _ANSWER_S:
            self._early.append(pending)
            return
        if self._activity.state != "running":
            pending.refuse(f"'{name}' has no values now: {self._activity.state}")
            return
        known, step = self._from_rows(runner, wanted)
        self._reply_values(runner, query, known, step)
        answered = {key for key, _ in known}
        unknown = [(key, variable) for key, variable in wanted if key not in answered]
        if unknown:
            self._read_at_next_point(runner, query, unknown)
        else:
            query.drop()

    def put_arrived(self, runner: Runner, sample: zenoh.Sample) -> None:
        """On a thread of Zenoh: accept a value that was put; if it is refused, the reason is logged."""
        attachment = sample.attachment.to_bytes() if sample.attachment is not None else None
        data = sample.payload.to_bytes()
        self._post(partial(self._take_put, runner, str(sample.key_expr), data, attachment))

    def turn(self, now: float) -> None:
        """Answer queries that waited for the first point; refuse those that have waited too long for a point."""
        early, self._early = self._early, []
        for pending in early:
            self._answer_values(pending, now)
        for pending in [p for p in self._pending if now - p.asked > _ANSWER_S]:
            self._pending.remove(pending)
            pending.refuse(f"not at a point yet: {self._activity.status(pending.instance).activity}")

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

    def _from_rows(self, runner: Runner, wanted: list[tuple[str, Variable]]) -> tuple[list[tuple[str, Value]], int]:
        """The values in the rows of the newest own step, and that step; values that only the FMU has are not included.

        The main thread steps meanwhile, and may overwrite this row of the ring with values of a later step. Then the
        values are read again; after a few attempts the main thread reads them.
        """
        ring = runner.outputs
        names = {*ring.layout.names}
        for _ in range(_LOOKS):
            step = runner.step
            values = [(key, ring.value(step, v.name)) for key, v in wanted if v.name in names]
            if runner.step + 1 - step < ring.rows:
                return values, step
        return [], runner.step

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
            self._post(lambda: self._finish(pending, lambda: self._reply_values(runner, query, pairs, step)))

        self._inbox.post(read)

    def _finish(self, pending: _Pending, reply: Job) -> None:
        """Answer a query that waited for a point, unless it was refused in the meantime."""
        if pending in self._pending:
            self._pending.remove(pending)
            reply()
            pending.query.drop()

    def _take_put(self, runner: Runner, key: str, data: bytes, attachment: bytes | None) -> None:
        try:
            new = _checked_setting(runner, self._keys.instance(runner.name), key, data, attachment)
        except ValueRefused as refused:
            self._log(LogLine(runner.name, "warning", "set", str(refused), runner.point))
            return

        def take() -> None:
            try:
                set_input(runner, new.variable, new.value, new.time)
            except ValueRefused as refused:
                self._post(partial(self._log, LogLine(runner.name, "warning", "set", str(refused), runner.point)))

        self._inbox.post(take)

    def _answer_setting(self, name: str, query: zenoh.Query) -> None:
        """Answer a query that sets a value: from which point on the value holds, or why it was refused."""
        runner = self._activity.runners.get(name)
        key = str(query.key_expr)
        if runner is None:
            query.reply_err(f"'{name}' is still being loaded")
            query.drop()
            return
        data = query.payload.to_bytes() if query.payload else b""
        attachment = query.attachment.to_bytes() if query.attachment is not None else None
        try:
            new = _checked_setting(runner, self._keys.instance(runner.name), key, data, attachment)
        except ValueRefused as refused:
            query.reply_err(str(refused))
            query.drop()
            return
        pending = _Pending(name, query)
        self._pending.append(pending)

        def take() -> None:
            try:
                step = set_input(runner, new.variable, new.value, new.time)
            except ValueRefused as refused:
                reason = str(refused)
                self._post(lambda: self._finish(pending, lambda: query.reply_err(reason)))
                return
            point = step * runner.plan.step_points
            answer = SetAnswer(key, point, self._plan.grid.time(point))
            self._post(
                lambda: self._finish(
                    pending, lambda: query.reply(key, msgspec.json.encode(answer), encoding=json_encoding)
                )
            )

        self._inbox.post(take)


class _Pending:
    """A query that waits until its instance reaches a point."""

    def __init__(self, instance: str, query: zenoh.Query) -> None:
        self.instance = instance
        self.query = query
        self.asked = time.monotonic()

    def refuse(self, reason: str) -> None:
        self.query.reply_err(reason)
        self.query.drop()


class _Setting(msgspec.Struct, frozen=True):
    """A value for a variable; ``time`` (s) is from when on, of an input; None: from the next point on."""

    variable: str
    value: Value
    time: float | None = None


def _checked_setting(runner: Runner, root: str, key: str, data: bytes, attachment: bytes | None) -> _Setting:
    """The variable, value and time of a setting that arrived for an instance.

    Args:
        runner: the instance.
        root: what its keys start with.
        key: the key that the value was sent to.
        data: the value as JSON.
        attachment: the time of the value as JSON, if there is one.

    Raises:
        ValueRefused: with the reason.
    """
    parts = key.removeprefix(root + "/").split("/")
    if len(parts) != 2 or "*" in key:
        raise ValueRefused(f"'{key}' is not the key of one variable")
    kind, name = parts[0], unescape(parts[1])
    variable = runner.instance.description.variable(name)
    if variable is None or kind_of(variable) != kind:
        raise ValueRefused(f"'{runner.name}' has no variable '{name}' under '{kind}'")
    try:
        check_settable(runner.plan, variable)
    except ValueRefused as refused:
        raise ValueRefused(f"'{runner.name}.{name}' {refused}") from refused
    try:
        time = decode_time(attachment) if attachment is not None else None
        return _Setting(name, decode_value(data, variable), time)
    except ValueRefused as refused:
        raise ValueRefused(f"'{runner.name}.{name}': {refused}") from refused
