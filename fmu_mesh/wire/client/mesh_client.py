"""A client of a running mesh: its views, values, settings and streams.

Owns the queries of the commands. `fmu_mesh.wire.client.reaching` finds meshes, and the mesh that a key means. Nothing
here prints. A mesh itself does not need this module: any Zenoh program can do the same (docs/key-space.md), but here
there are deadlines, and names instead of keys.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from functools import cached_property, partial
from itertools import chain
from typing import Any, TypeVar, cast

import msgspec
import numpy as np
import zenoh
from msgspec.structs import replace

from ...config.access_sections import Role
from ...errors import ConfigurationError, DeadlineExceeded, FmuMeshError, MeshLost, MessageRefused, from_report
from ...text import did_you_mean, is_pattern, listed, matching, shown
from ..keys import SUBSCRIBED, Keys
from ..messages import decode_json
from ..session import Question, answer_of, answers, reason_of
from ..values import encode_origin, encode_value, this_program
from ..views import (
    AuditView,
    Command,
    CommandAnswer,
    InstanceInfo,
    InstanceStatus,
    LogLine,
    MeshInfo,
    MeshStatus,
    RosView,
    SetAnswer,
)
from .following import Follower
from .readings import Reading, Target, reading_among

__all__ = ["MeshClient", "is_key", "key_expression"]

View = TypeVar("View")

# How often a wait for the mesh asks whether it has ended meanwhile; there is no event for both.
_END_CHECK_S = 0.05
_ANSWER_S = 0.25
"""So long before the deadline of `rest`, the mesh says what it still waits for."""


class MeshClient:
    """One running mesh, seen from outside.

    Args:
        session: a session that reaches the mesh; the caller closes it.
        endpoints: where the session reaches the mesh, for messages.
        over: raises `MeshLost` if the mesh has ended, where the caller knows it; otherwise returns False.
        role: what the certificate of this process may do; None: it comes by a socket, or there is no security.

    Raises:
        ConfigurationError: (every method) a name is unknown, or the mesh refused; the message has the reason.
        DeadlineExceeded: (every method) there was no answer in time.
    """

    def __init__(  # noqa: PLR0913, PLR0917  one mesh, and how it is reached
        self,
        session: zenoh.Session,
        keys: Keys,
        endpoints: Sequence[str],
        timeout_s: float,
        over: Callable[[], bool] = lambda: False,
        role: Role | None = None,
    ) -> None:
        self.keys = keys
        self.endpoints = tuple(endpoints)
        self.session = session
        self._who = f"mesh '{keys.mesh}'"
        self._timeout_s = timeout_s
        self._over = over
        self._role = role
        self._lost = threading.Event()
        self._known: dict[str, dict[str, Target]] = {}
        self._known_run = ""

    def info(self) -> MeshInfo:
        """The description of the mesh."""
        return self._view(self.keys.mesh_key("info"), MeshInfo, self._who)

    def info_if_running(self) -> MeshInfo | None:
        """The description of the mesh if it runs now; None otherwise. This does not wait for a mesh, as `info` does.

        A query for the token of the master would not do: beside a subscriber for that token, such as `until_end`
        has, its answer is empty now and then although the mesh runs.
        """
        samples = self._get(self.keys.mesh_key("info"))
        return _understood(samples[0], MeshInfo, self._who) if samples else None

    def status(self) -> MeshStatus:
        """The state and the point of the mesh."""
        return self._view(self.keys.mesh_key("status"), MeshStatus, self._who)

    def ros(self) -> list[RosView]:
        """The links of the gateways to ROS; empty if the mesh has no gateway."""
        # This does not wait for a queryable, because a mesh without a gateway has none.
        samples = self._get(f"{self.keys.mesh_key('ros')}/*")
        return [_understood(sample, RosView, f"the gateway of {self._who}") for sample in samples]

    def instance_info(self, instance: str) -> InstanceInfo:
        """The description of an instance: variables, connections, process. Waits while its FMU is being loaded."""
        return self._view(f"{self._instance_key(instance)}/info", InstanceInfo, f"instance '{instance}'")

    def instance_status(self, instance: str) -> InstanceStatus:
        """The state, the point and the activity of an instance."""
        return self._view(f"{self._instance_key(instance)}/status", InstanceStatus, f"instance '{instance}'")

    def all_status(
        self, subscribed: Mapping[str, Sequence[str] | None] | None = None
    ) -> tuple[MeshStatus, dict[str, InstanceStatus]]:
        """The status of the mesh and of its instances, with one query; instances that do not answer are left out.

        It tells the nodes what this session has just ``subscribed`` to: by instance, variables, or None for all.
        """
        key = f"{self.keys.root}/*/status" + (f"?{SUBSCRIBED}" if subscribed is not None else "")
        names = msgspec.json.encode(subscribed) if subscribed is not None else None
        # A querier does not notice several queryables that match its key (zenoh 1.10), so this is a get.
        found = {str(sample.key_expr): sample for sample in self._get(key, names)}
        mesh = found.pop(self.keys.mesh_key("status"), None)
        # Without an answer of the mesh, this session does not know it yet, or it is gone.
        status = _understood(mesh, MeshStatus, self._who) if mesh is not None else self.status()
        views = [_understood(sample, InstanceStatus, self._who) for sample in found.values()]
        return status, {view.instance: view for view in views}

    @contextmanager
    def noticing(self) -> Iterator[None]:
        """In the block, a question to a mesh that has ended raises `MeshLost` at once."""
        with self.until_end(self._lost.set):
            yield

    @contextmanager
    def until_end(self, tell: Callable[[], None] = lambda: None) -> Iterator[threading.Event]:
        """An event that is set when the mesh ends or is gone; then ``tell`` is called, on a thread of Zenoh."""
        ended = threading.Event()

        def end() -> None:
            ended.set()
            tell()

        with Follower[None](self.session, self.keys, end) as follower:
            if not self._is_there(follower, self._timeout_s):
                ended.set()
            yield ended

    def instance_in(self, reference: str) -> str | None:
        """The instance that a reference names; None if the reference means the whole mesh."""
        name = self._within(reference).removeprefix(self.keys.root).strip("/")
        name = name.removesuffix("/info").removesuffix("/status")
        return None if name in ("", "mesh") or reference == self.keys.mesh else name

    def targets(self, *references: str) -> list[Target]:
        """The variables that references mean, each once: `instance.variable`, `mesh/instance.variable`, or a key.

        All may be patterns: in the short forms `*` means any characters, `?` one, and `re:` begins a regular
        expression; a key has the wildcards of Zenoh.
        """
        info = self.info()
        found = [target for reference in references for target in self._meant(self._within(reference), info)]
        return [*{target.key: target for target in found}.values()]

    def _meant(self, reference: str, info: MeshInfo, *, to_set: bool = False) -> list[Target]:
        if not is_key(reference, self.keys):
            return self._targets_by_name(reference, info, to_set=to_set)
        asked = key_expression(reference)
        instances = [
            name for name in info.instances if asked.intersects(zenoh.KeyExpr(f"{self.keys.instance(name)}/**"))
        ]
        if not instances:
            chunk = reference.removeprefix(self.keys.root + "/").partition("/")[0]
            raise self._unknown_instance(chunk)
        found = [target for name in instances for target in self._variables(name, info.run).values()]
        matching = [target for target in found if asked.intersects(zenoh.KeyExpr(target.key))]
        if not matching:
            raise _unknown(f"no variable has the key '{reference}'", reference, [target.key for target in found])
        return matching

    def target(self, reference: str, *, to_set: bool = False) -> Target:
        """The one variable that a reference means; for an unknown name, ``to_set`` suggests what can be set."""
        found = self._meant(self._within(reference), self.info(), to_set=to_set)
        if len(found) > 1:
            names = listed([target.name for target in found])
            raise ConfigurationError(f"'{reference}' means {len(found)} variables: {names}.")
        return found[0]

    def get(self, targets: Sequence[Target]) -> list[Reading]:
        """The current values with their points, in the order of the targets."""
        readings: dict[str, Reading] = {}
        for root in dict.fromkeys(target.root for target in targets):
            own = {target.key: target for target in targets if target.root == root}
            instance = next(iter(own.values())).instance
            # A wider key lies in no rule of a mesh with security.
            key = next(iter(own)) if len(own) == 1 else f"{root}/*"
            # An answer may be lost where this process reads too slowly; it is asked for again.
            for asked in chain([key], (own_key for own_key in own if own_key not in readings)):
                for sample in self._ask(Question(asked, f"the values of instance '{instance}'", self._timeout_s)):
                    if (reading := reading_among(own, sample)) is not None:
                        readings[reading.key] = reading
        return [readings[target.key] for target in targets if target.key in readings]

    def set(self, target: Target, value: object, at: float | None = None) -> SetAnswer:
        """Set an unconnected input or a tunable parameter; the answer says from which point on the value holds.

        That is the next one, or the one ``at`` a simulation time in s.
        """
        self.check_may("setting a value")
        plain = value.tolist() if isinstance(value, np.ndarray | np.generic) else value
        try:
            payload = encode_value(cast("Any", plain))
        except (TypeError, msgspec.MsgspecError) as error:
            raise ConfigurationError(f"{shown(value)} is no value of a variable: {error}") from error
        key = self.keys.setting(target.instance, target.variable.name)
        return self._view(key, SetAnswer, f"'{target.name}'", payload, encode_origin(at, this_program()))

    def command(self, command: Command, timeout_s: float | None = None) -> CommandAnswer:
        """Pause, resume, step or stop the mesh; the answer comes before the mesh has paused."""
        return _understood(self._commanded(command, timeout_s), CommandAnswer, self._who)

    def checkpoint(self, timeout_s: float | None = None) -> bytes:
        """The states of all instances at one point, as the content of a state file; `ConfigurationError` if not."""
        timeout_s = timeout_s if timeout_s is not None else self._timeout_s
        command = Command("checkpoint", wait=max(timeout_s - _ANSWER_S, timeout_s / 2))
        return self._commanded(command, timeout_s).payload.to_bytes()

    def _commanded(self, command: Command, timeout_s: float | None) -> zenoh.Sample:
        self.check_may(f"'{command.command}'")
        payload = msgspec.json.encode(command)
        who, limit_s = encode_origin(None, this_program()), timeout_s or self._timeout_s
        return self._ask(Question(self._command_key, self._who, limit_s, payload, who, once=True))[0]

    def check_may(self, what: str, needs: Role = "operator") -> None:
        """Check that the role of this process may do something: what is not allowed would vanish without an answer.

        Raises:
            ConfigurationError: it may only read, or only read, set and command.
        """
        if self._role not in (None, needs, "node"):
            raise ConfigurationError(f"you are {self._role} '{self.keys.by}'; {what} needs {needs}.")

    def rest(self, command: Command, timeout_s: float | None = None) -> CommandAnswer:
        """Pause or step the mesh; the answer comes when it has paused, and has the point at which it has.

        Raises:
            FmuMeshError: it does not come to this point, or not in ``timeout_s``, by default the deadline of a query.
        """
        timeout_s = timeout_s if timeout_s is not None else self._timeout_s
        answer = self.command(replace(command, wait=max(timeout_s - _ANSWER_S, timeout_s / 2)), timeout_s)
        if answer.error is not None:
            raise from_report(answer.error)
        return answer

    @contextmanager
    def statuses(self, timeout_s: float | None = None) -> Iterator[Iterator[MeshStatus]]:
        """The status of the mesh and every later one to the last; none if the mesh is gone already.

        They come ten times a second, and at once with another state or when the mesh has come to rest. After
        ``timeout_s`` seconds (by default the deadline of a query) the iterator raises `DeadlineExceeded`.
        """
        timeout_s = timeout_s if timeout_s is not None else self._timeout_s
        deadline = time.monotonic() + timeout_s
        with Follower[MeshStatus](self.session, self.keys) as follower:
            follower.subscribe({self.keys.mesh_key("status")}, partial(_decoded, kind=MeshStatus))
            there = self._is_there(follower, min(timeout_s, self._timeout_s))
            now = []
            if there:
                with suppress(FmuMeshError):  # it has just ended, and its last status has come
                    now.append(self.status())
            yield chain(now, follower.to_the_last(deadline)) if there else iter(())

    @contextmanager
    def watch(self, targets: Sequence[Target]) -> Iterator[Iterator[Reading]]:
        """Every value from now on, in the order of arrival; ends when the mesh ends.

        A reader that is much too slow loses the newest samples; the points show which.
        """
        with Follower[Reading](self.session, self.keys) as follower:
            by_instance: dict[str, dict[str, Target]] = {}
            subscribed: dict[str, list[str] | None] = {}
            for target in targets:
                by_instance.setdefault(target.instance, {})[target.key] = target
            for name, own in by_instance.items():
                every = len(own) == len(self._known.get(name, ()))
                through = {f"{target.root}/*" for target in own.values()} if every else None
                follower.subscribe(own.keys(), partial(reading_among, own), through)
                subscribed[name] = None if every else [target.variable.name for target in own.values()]
            there = self._is_there(follower, self._timeout_s)
            if there:
                # An answer of a node comes after the subscribers of this session have come to it.
                with suppress(ConfigurationError, MeshLost):  # it is about to end
                    self.all_status(subscribed)
            yield follower.to_the_last() if there else iter(())

    @contextmanager
    def logs(self, *, follow: bool) -> Iterator[Iterator[LogLine]]:
        """The log messages that the mesh has kept, the oldest first; then all new ones until it ends, if ``follow``."""
        with Follower[LogLine](self.session, self.keys) as follower:
            if follow:  # from before the question, so that no message is missing between the two
                follower.subscribe({self.keys.mesh_key("log")}, partial(_decoded, kind=LogLine))
            kept = self._view(self.keys.mesh_key("log"), list[LogLine], self._who)
            last = kept[-1].number if kept else 0
            there = follow and self._is_there(follower, self._timeout_s)
            new = follower.to_the_last() if there else iter(())
            yield chain(kept, (line for line in new if line.number > last))

    def audit(self) -> AuditView:
        """Who has joined, set a value, commanded or was refused."""
        return self._view(self.keys.mesh_key("audit"), AuditView, self._who)

    def _is_over(self) -> bool:
        """Raise `MeshLost` if the mesh has ended, in the words of who knows it; otherwise False."""
        if self._lost.is_set() and self.info_if_running() is None:  # a token that was lost may be there again
            raise MeshLost(f"{self._who} has ended")
        return self._over()

    def _is_there(self, follower: Follower[Any], timeout_s: float) -> bool:
        """Whether a follower finds the mesh in time."""
        end = time.monotonic() + timeout_s
        while not follower.there.wait(_END_CHECK_S):
            if self._is_over() or time.monotonic() >= end:
                return False
        return True

    # --- names

    def _within(self, reference: str) -> str:
        """A reference without the name of this mesh in front; of `mesh/instance/out/y` the whole key."""
        short = reference.removeprefix(f"{self.keys.mesh}/")
        if short == reference or reference.startswith(f"{self.keys.prefix}/"):
            return reference
        return f"{self.keys.root}/{short}" if "/" in short.partition(".")[0] else short

    def _targets_by_name(self, reference: str, info: MeshInfo, *, to_set: bool) -> list[Target]:
        instance, _, name = reference.partition(".")
        names = info.instances
        if not name and not is_pattern(reference):
            known = instance if instance in names else "INSTANCE"
            raise ConfigurationError(
                f"'{reference}' names no variable.", hint=f"Write '{known}.VARIABLE', or '{known}.*' for all."
            )
        if instance not in names and not is_pattern(reference):
            raise self._unknown_instance(instance, names)
        instances = [instance] if instance in names else names
        each = [self._variables(one, info.run) for one in instances]
        found = each[0] if len(each) == 1 else {full: target for own in each for full, target in own.items()}
        meant = [found[full_name] for full_name in matching(reference, found)]
        if not meant and instance in names:
            own = [target.variable.name for target in found.values() if target.variable.settable or not to_set]
            for clock in self.instance_info(instance).clocks:
                if clock.name == name:
                    raise ConfigurationError(f"{clock.refusal}.")
            raise _unknown(f"instance '{instance}' has no variable '{name}'", name, own)
        if not meant:
            raise _unknown(f"{self._who} has no variable '{reference}'", reference, [*found])
        return meant

    def _variables(self, instance: str, run: str) -> dict[str, Target]:
        """The variables of an instance by `instance.variable`; asked for once in a run, because there may be 60,000."""
        if run != self._known_run:
            self._known, self._known_run = {}, run
        if instance not in self._known:
            root, info = self.keys.instance(instance), self.instance_info(instance)
            found = [Target(instance, f"{root}/{view.key}", view) for view in info.variables]
            self._known[instance] = {target.name: target for target in found}
        return self._known[instance]

    def _instance_key(self, instance: str) -> str:
        if instance not in (names := self.info().instances):
            raise self._unknown_instance(instance, names)
        return self.keys.instance(instance)

    def _unknown_instance(self, name: str, names: Sequence[str] | None = None) -> ConfigurationError:
        there = names if names is not None else self.info().instances
        return _unknown(f"{self._who} has no instance '{name}'", name, there)

    # --- questions

    @cached_property
    def _command_key(self) -> zenoh.KeyExpr:
        key: zenoh.KeyExpr = self.session.declare_keyexpr(self.keys.command)
        return key

    def _view(
        self, key: str, kind: type[View], who: str, payload: bytes | None = None, attachment: bytes | None = None
    ) -> View:
        return _understood(self._ask(Question(key, who, self._timeout_s, payload, attachment))[0], kind, who)

    def _ask(self, question: Question) -> list[zenoh.Sample]:
        try:
            return answers(self.session, question, self._is_over)
        except DeadlineExceeded:
            text = f"no answer from {question.whom} within {question.deadline_s:g} s."
            raise DeadlineExceeded(text, hint="A larger `timeout=...` waits longer.") from None
        except MeshLost as error:
            self._is_over()
            raise ConfigurationError(error.message) from error

    def _get(self, key: str, attachment: bytes | None = None) -> list[zenoh.Sample]:
        """The answers of all queryables that exist now; this does not wait for others."""
        try:
            replies = self.session.get(key, timeout=self._timeout_s, attachment=attachment)
            return [sample for reply in replies if (sample := answer_of(reply)) is not None]
        except MeshLost as error:
            raise ConfigurationError(error.message) from error


def is_key(reference: str, keys: Keys) -> bool:
    """Whether a reference is a key; otherwise it is a name, or `instance.variable`."""
    return reference.startswith(f"{keys.prefix}/") or "/" in reference.partition(".")[0]


def key_expression(text: str) -> zenoh.KeyExpr:
    """The key expression in a text of the user.

    Raises:
        ConfigurationError: it is not a key expression.
    """
    try:
        return zenoh.KeyExpr(text)
    except zenoh.ZError as error:
        reason = reason_of(error).rpartition("`: ")[2].removesuffix(".")
        raise ConfigurationError(f"'{text}' is no key expression: {reason}") from error


def _decoded(sample: zenoh.Sample, kind: type[View]) -> View:
    return decode_json(sample.payload.to_bytes(), kind)


def _understood(answer: zenoh.Sample, kind: type[View], who: str) -> View:
    try:
        return _decoded(answer, kind)
    except MessageRefused as error:
        text = f"the answer of {who} is not understood: {error}."
        raise ConfigurationError(text, hint="Is it another version of fmu_mesh?") from error


def _unknown(message: str, name: str, names: Sequence[str]) -> ConfigurationError:
    return ConfigurationError(f"{message}.", hint=did_you_mean(name, names, f"There are: {listed(names)}."))
