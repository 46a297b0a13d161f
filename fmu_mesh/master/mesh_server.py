"""What other programs see of the master: answers to queries, its status, and the log of all instances.

Queries and samples arrive on threads of Zenoh, and are posted to the main thread.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Collection, Mapping
from functools import partial
from typing import Literal, Protocol, get_args

import msgspec
import zenoh
from msgspec.structs import replace
from zenoh.handlers import Callback

from ..config.access_sections import Role
from ..errors import MessageRefused
from ..system.attempt import Attempt
from ..wire.inbox import Inbox
from ..wire.keys import Keys
from ..wire.messages import decode_json
from ..wire.session import matches, undeclare_all
from ..wire.values import json_encoding
from ..wire.views import WAITING, LogLine, MeshHello, MeshStatus

__all__ = ["STATUS_S", "Events", "MasterServer", "MasterSettings"]

STATUS_S = 0.1
"""Time in s between two publications of the status."""

_MOST_LOG_BYTES = 1 << 20
_MOST_LINES = 1000
_MOST_BYTES = 1 << 20
"""Of the log, the newest lines are retained, up to both limits."""


class Events(Protocol):
    """What the master reports to the program that started it. Called on the master's main thread."""

    def status(self, status: MeshStatus) -> None:
        """The state of the run, about ten times a second."""
        ...

    def log(self, line: LogLine) -> None:
        """A log message of an FMU, or about a setting that was refused."""
        ...


class MasterSettings(msgspec.Struct, frozen=True):
    """How a master runs its mesh, besides the plan.

    Attributes:
        endpoints: where tools can reach this process, for `mesh/info`.
        config_file: name of the configuration file, for `mesh/info`.
        launch: the launcher that started this process; None if it was started manually.
        profile: whether nodes measure their time, and the master what limits the grant.
        paused: whether the run begins paused at its first point.
        table: number of the table of roles; 0: it has none of our authority.
        as_file: a state file with the states of all instances at a point.
        checkpoint_s: how often in s there is a checkpoint for a restart; None: never.
        keep: gets these checkpoints, and their points.
        attempt: which attempt of the run this is.
    """

    endpoints: tuple[str, ...] = ()
    config_file: str = ""
    launch: str | None = None
    profile: bool = False
    paused: bool = False
    table: int = 0
    as_file: Callable[[int, Mapping[str, bytes]], bytes] = lambda _point, _states: b""
    checkpoint_s: float | None = None
    keep: Callable[[int, bytes], None] = lambda _point, _data: None
    attempt: Attempt = Attempt()


class MasterServer:
    """Serves the queries of one run."""

    def __init__(  # noqa: PLR0913, PLR0917  the run and who learns of it
        self,
        session: zenoh.Session,
        keys: Keys,
        inbox: Inbox,
        events: Events,
        status: Callable[[], MeshStatus],
        instances: Collection[str],
    ) -> None:
        self._session = session
        self._keys = keys
        self._inbox = inbox
        self._events = events
        self._status = status
        self._instances = frozenset(instances)
        self._status_published = 0.0
        self._entities: list[zenoh.Queryable[None] | zenoh.Subscriber[None]] = []
        self._of_run: list[zenoh.Queryable[None] | zenoh.Subscriber[None]] = []
        self._log_lines = 0
        self._waits: dict[str, LogLine] = {}
        self._newest_lines: deque[msgspec.Raw] = deque()
        self._newest_bytes = 0
        declare, drop = partial(session.declare_publisher, encoding=json_encoding), zenoh.CongestionControl.DROP
        self._log_publisher = declare(keys.mesh_key("log"), congestion_control=drop)
        self._status_publisher = declare(keys.mesh_key("status"), congestion_control=drop)

    def serve(self, key: str, answer: Callable[[zenoh.Query], None], *, of_run: bool = False) -> None:
        """From now on ``answer`` handles the queries of a key; if it refuses one, the reply is the reason.

        A key ``of_run`` is served until `forget_run`.
        """
        take = self._inbox.refusals.answering(answer, self._inbox.post)
        (self._of_run if of_run else self._entities).append(self._session.declare_queryable(key, take))

    def show(self, what: Literal["info", "status", "plan", "log", "audit"], view: Callable[[], object]) -> None:
        """From now on queries of a key of the mesh are answered with a view."""
        key = self._keys.mesh_key(what)

        def reply(query: zenoh.Query) -> None:
            query.reply(key, msgspec.json.encode(view()), encoding=json_encoding)
            query.drop()

        self.serve(key, reply)

    def greet(self, table: int) -> None:
        """From now on a client with a certificate learns that the mesh is there, and which role it has.

        The rules let it ask only for its own role; so an answer is all that it needs.
        """
        answer = msgspec.json.encode(MeshHello(self._keys.mesh, table))

        def reply(key: str, query: zenoh.Query) -> None:
            query.reply(key, answer, encoding=json_encoding)
            query.drop()

        for key in (self._keys.mesh_key("hello"), *map(self._keys.role, get_args(Role))):
            self._entities.append(self._session.declare_queryable(key, partial(reply, key)))

    def watch(self, tokens: str, changed: Callable[[zenoh.Sample], None], *, of_run: bool = False) -> None:
        """From now on ``changed`` gets every change of these liveliness tokens; ``of_run`` as in `serve`."""
        post = self._inbox.post
        (self._of_run if of_run else self._entities).append(
            self._session.liveliness().declare_subscriber(
                tokens, lambda sample: post(lambda: changed(sample)), history=True
            )
        )

    def forget_run(self) -> None:
        """The run has ended, and another one follows: its keys are not served any more."""
        undeclare_all(self._of_run)
        self._of_run.clear()

    def hand_on_logs(self) -> None:
        """From now on the log messages of all instances go to `Events.log` and into one log, which is published."""
        self.show("log", lambda: [*self._newest_lines])
        post = self._inbox.post
        # On the thread that reads the link: a line is taken before the report of its node, which came after it.
        take: Callback[zenoh.Sample] = Callback(lambda sample: post(lambda: self._log(sample)), indirect=False)
        self._entities.append(self._session.declare_subscriber(f"{self._keys.root}/*/log", take))

    def _log(self, sample: zenoh.Sample) -> None:
        key = str(sample.key_expr)
        if key == self._keys.mesh_key("log"):  # our own: `*` of the subscriber fits it, too
            return
        with self._inbox.refusals.guard(key):
            line = decode_json(sample.payload.to_bytes(), LogLine, _MOST_LOG_BYTES)
            if key != f"{self._keys.instance(line.instance)}/log" or line.instance not in self._instances:
                raise MessageRefused("it is not the log of an instance of this mesh")
            if (line.status, line.category) == WAITING:
                self._waits[line.instance] = line
            self._events.log(line)
            self._keep(line)

    def waits(self, point: int) -> str | None:
        """In words what instances that have reached ``point`` have said that they wait for; None: none has."""
        said = (
            f"{name} at point {line.point}: {line.message}" for name, line in self._waits.items() if line.point >= point
        )
        return f"{'; '.join(said)}." if any(line.point >= point for line in self._waits.values()) else None

    def say(self, line: LogLine) -> None:
        """From any thread: add a line of the mesh itself to the log of all instances."""
        self._inbox.post(lambda: self._keep(line))

    def _keep(self, new: LogLine) -> None:
        """Publish a line of the log of all instances, and keep it; forget the oldest ones beyond the limits."""
        self._log_lines += 1
        line = msgspec.json.encode(replace(new, number=self._log_lines))
        self._log_publisher.put(line)
        self._newest_lines.append(msgspec.Raw(line))
        self._newest_bytes += len(line)
        while len(self._newest_lines) > _MOST_LINES or self._newest_bytes > _MOST_BYTES:
            self._newest_bytes -= len(self._newest_lines.popleft())

    def publish_status(self, *, at_once: bool = False) -> None:
        """Publish the status if it is due, or ``at_once``."""
        now = time.monotonic()
        if not at_once and now - self._status_published < STATUS_S:
            return
        self._status_published = now
        status = self._status()
        self._events.status(status)
        if matches(self._status_publisher):
            self._status_publisher.put(msgspec.json.encode(status))

    def close(self) -> None:
        """Undeclare everything."""
        undeclare_all(self._entities, self._of_run, [self._status_publisher, self._log_publisher])
