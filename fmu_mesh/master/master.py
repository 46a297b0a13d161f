"""The master: starts a run, grants points, and ends the run.

::

    wait until every node has registered; answer them all        (ready/ack)
    wait until every node is at point 0                          (Initialization Mode is over)
    until every node is at the last point, or at the one where an FMU asked to end the simulation:
        grant what all can step in about 50 ms                   (less if the wall clock or a pause limits it)
        wait for progress
    tell the nodes to finish; wait for their reports

The master never sees a value. Grants and progress are counters in the memory of the host, and the nodes there keep the
windows among themselves; a node that does not share this memory gets grants and tells its progress by messages.
"""

from __future__ import annotations

import operator
import time
from collections.abc import Callable

import msgspec
import zenoh

from ..errors import (
    ConfigurationError,
    DeadlineExceeded,
    ErrorReport,
    FmuMeshError,
    Interrupted,
    MeshLost,
    MessageRefused,
    ProtocolBroken,
    TerminationRequested,
    from_report,
)
from ..rings.host_memory import HostMemory, Offer, Wish, can_share
from ..system.plan import MASTER, RECORDER, Plan
from ..wire.inbox import Inbox
from ..wire.keys import Keys, RunKeys
from ..wire.messages import FINISH, GRANT, PROGRESS, NodeReport, decode_json
from ..wire.refusals import payload_of
from ..wire.session import RouterLink, tokens
from ..wire.time_profile import TIME_LINE_ENTRIES, MeshProfile
from ..wire.values import json_encoding
from ..wire.views import GOING_ON, Command, CommandAnswer, MeshInfo, MeshState, MeshStatus
from .members import Followers, Members, spoken
from .mesh_server import STATUS_S, Events, MasterServer, mesh_info
from .pacing import CLOCK, PAUSE, GrantWatch, Pacer, Reach, RunClock

__all__ = ["Master", "MasterSettings"]

_HEARTBEAT_S = 0.5
_LEAST_HEARTBEAT_S = 0.01


class MasterSettings(msgspec.Struct, frozen=True):
    """How a master runs its mesh, besides the plan.

    Attributes:
        endpoints: where tools can reach this process, for `mesh/info`.
        config_file: name of the configuration file, for `mesh/info`.
        launch: the launcher that started this process; None if it was started manually.
        profile: whether nodes measure their time, and the master what limits the grant.
        paused: whether the run begins paused at its first point.
    """

    endpoints: tuple[str, ...] = ()
    config_file: str = ""
    launch: str | None = None
    profile: bool = False
    paused: bool = False


class Master:
    """The master of one run.

    Args:
        plan: the plan of the whole mesh.
        session: the session of this process; the caller closes it.
        events: gets the status and the log messages of the run.
        settings: how the mesh is run.
        router: the link to the router that connects the nodes, if there is one.

    Attributes:
        ended_by: why the simulation ended before its last point without a failure: an FMU asked for it, or there was a
            `stop` and no stop time.

    Call `claim`, then `run` once, from the main thread, then `wait_for_followers` if it went well, then `close`.
    """

    def __init__(
        self,
        plan: Plan,
        session: zenoh.Session,
        events: Events,
        settings: MasterSettings,
        router: RouterLink | None = None,
    ) -> None:
        config = plan.system.config
        self._plan = plan
        self._session = session
        self._settings = settings
        self._timeouts = config.timeouts
        self._heartbeat_s = max(_LEAST_HEARTBEAT_S, min(_HEARTBEAT_S, config.timeouts.step / 4))
        self._keys = Keys(config.zenoh.key_prefix, config.mesh)
        self._run_keys = RunKeys.new(self._keys)
        self._router = router or RouterLink(session)
        self._nodes = list(plan.nodes)
        self._numbers = {node: number for number, node in enumerate(self._nodes)}
        # The progress of a slower instance is the point up to which its outputs hold: its next own point minus one.
        self._most_ahead = 2 * max(item.step_points for item in plan.system.instances.values()) - 2
        self._windows = [plan.nodes[node].window for node in self._nodes]
        self._sharing: list[int] = []
        self._told = 0
        self._most_instances = max(len(node.instances) for node in plan.nodes.values())
        self._progress = [-1] * len(self._nodes)
        self._slowest = -1
        self._reports: dict[str, NodeReport] = {}
        self._failure: FmuMeshError | None = None
        self.ended_by: TerminationRequested | None = None
        self._state: MeshState = "starting"
        self._grant = 0
        self._hold: int | None = None
        self._watch = GrantWatch() if settings.profile else None
        self._pacer = Pacer(plan, config.simulation.real_time_factor)
        self._reach = Reach(plan.window)
        self._stepping = [number for number, node in enumerate(self._nodes) if node != RECORDER]
        self._clock = RunClock()
        self._published = 0.0
        self._moved = time.monotonic()
        self._shares = config.zenoh.shared_memory and can_share()
        memory_of = HostMemory.create if self._shares else HostMemory.private
        self._memory = memory_of(next(iter(plan.nodes.values())).memory, MASTER)
        self._inbox = Inbox(self._memory)
        self._inbox.open(session, self._run_keys, MASTER, {self._run_keys.progress(node): node for node in self._nodes})
        self._followers = Followers(self._inbox, lambda: self._state in ("running", "paused"))
        self._members = Members(plan, session, self._run_keys, self._offer(), self._lose, settings.launch)
        self._send = self._members.send
        self._server = MasterServer(session, self._keys, self._inbox, events, self.last_status, plan.system.instances)
        self._publish_status = self._server.publish_status

    def memory_for(self, participant: str) -> HostMemory | None:
        """The memory of the host for a participant in this process; None if nothing is shared."""
        return self._memory.participant(participant) if self._shares else None

    def _offer(self) -> Offer | None:
        return self._memory.offer if self._shares else None

    def claim(self) -> None:
        """Become the visible master of this mesh; from now on queries wait until `run` answers them.

        Raises:
            ConfigurationError: another process that this session can reach is the master; it is not affected.
        """
        self._router.wait()
        self._token = self._session.liveliness().declare_token(self._run_keys.master)
        others = [key for key in tokens(self._session, self._keys.run("*").master) if key != self._run_keys.master]
        if others:
            self._token.undeclare()
            raise ConfigurationError(
                f"mesh '{self._keys.mesh}' is already running where this master connects",
                hint="Stop it first, or give this mesh another name or another `zenoh.key_prefix`.",
            )
        self._declare()
        self._mesh_token = self._session.liveliness().declare_token(self._keys.master)

    def run(self) -> None:
        """Run the mesh to its last point.

        Raises:
            FmuMeshError: why the run ended early; all nodes have been informed.
        """
        try:
            self._wait_for_nodes()
            self._enter("initializing")
            self._wait_for(lambda: self._slowest >= 0, self._timeouts.initialize, "Initialization Mode is not over in")
            self._grant_to_the_end()
            self._enter("stopping")
            self._send(FINISH, 0)
            self._wait_for(
                lambda: len(self._reports) == len(self._nodes),
                self._timeouts.stop + self._timeouts.terminate * self._most_instances,
                "the end was not reported by",
            )
            self._state = "done"
        except FmuMeshError as error:
            self._state = "failed"
            self._failure = error
            self._members.abort(error)
            raise
        finally:
            self._clock.stop()
            self._publish_status(at_once=True)
            self._mesh_token.undeclare()
            self._token.undeclare()

    def wait_for_followers(self) -> None:
        """Wait, because this process routes messages, until all followers have the last sample."""
        if self._failure is None:
            self._followers.wait(self._timeouts.stop)

    def close(self) -> None:
        """Undeclare everything."""
        self._server.close()
        self._members.close()
        self._inbox.close()
        self._memory.close()

    @property
    def has_begun(self) -> bool:
        """Whether all nodes have reached the first point; from any thread."""
        return self._slowest >= 0

    @property
    def seconds(self) -> float:
        """Wall-clock time from the first grant to the last point in s, without pauses."""
        return self._clock.elapsed()

    def profile(self) -> MeshProfile | None:
        """What the nodes without a failure have measured; None if nothing was measured."""
        if self._watch is None:
            return None
        reports = [self._reports[node] for node in self._nodes if node in self._reports]
        return MeshProfile(tuple(r.profile for r in reports if r.profile is not None), self._watch.held_s)

    def interrupt(self, reason: str) -> None:
        """From any thread: end the run with `Interrupted`."""
        self._inbox.post(lambda: self._fail(Interrupted(reason)))

    # --- phases

    def _enter(self, state: MeshState) -> None:
        """Change the state, and publish it at once."""
        self._state = state
        self._publish_status(at_once=True)

    def _wait_for_nodes(self) -> None:
        deadline = time.monotonic() + self._timeouts.start
        while not self._members.complete:
            if time.monotonic() > deadline:
                raise self._members.absence()
            self._turn(0.25)
        self._members.welcome(TIME_LINE_ENTRIES // len(self._nodes) if self._watch is not None else 0)
        self._sharing = [self._numbers[node] for node in self._members.shared]

    def _grant_to_the_end(self) -> None:
        if self._settings.paused:
            self._hold = 0
        else:
            self._clock.start()
        self._enter("paused" if self._settings.paused else "running")
        self._pacer.start(0)
        self._moved = time.monotonic()
        # Each instance has its own deadline for a step; the instances of a group step one after the other.
        patience_s = 3 * self._timeouts.step * self._most_instances
        while self._slowest < self._last_point:
            self._turn(self._publish_grant())
            if self._hold is not None and self._slowest >= self._hold:
                self._clock.stop()
            silent_s = time.monotonic() - self._moved
            if silent_s > patience_s and self._slowest < self._grant and self._hold is None:
                raise DeadlineExceeded(
                    f"no progress for {silent_s:.1f} s",
                    instance=spoken(self._nodes[self._progress.index(self._slowest)]),
                    point=self._slowest,
                    time=self._plan.grid.time(self._slowest),
                )
        self._clock.stop()

    def _publish_grant(self) -> float:
        """Raise the grant if it can be increased; return how long to wait until the next check, in s."""
        ahead = min(self._progress[number] for number in self._stepping)
        grant = min(ahead + self._reach.points(ahead, time.monotonic()), self._last_point)
        if self._hold is not None:
            grant = min(grant, self._hold)
        paced, pause = self._pacer.limit(grant, self._slowest)
        grant = max(self._grant, min(grant, paced))
        if self._watch is not None:
            self._watch.look(self._holder(grant, paced))
        if grant > self._grant:
            now = time.monotonic()
            if self._slowest >= self._grant:  # they had nothing to do until now, because of the wall clock
                self._moved = now
            self._grant = grant
            self._memory.grant.raise_to(grant)
        self._tell_grant()
        return min(pause, STATUS_S, self._heartbeat_s)

    def _tell_grant(self) -> None:
        """Send the grant to nodes that cannot read it, and to all as a sign that the master lives."""
        now = time.monotonic()
        is_due = now - self._published >= self._heartbeat_s
        if len(self._sharing) < len(self._nodes):
            credit = min(map(operator.add, self._progress, self._windows))
            granted = max(self._told, min(self._grant, credit))
            if granted > self._told:
                self._told = granted
                is_due = True
        if is_due:
            self._published = now
            self._send(GRANT, self._told)

    def _holder(self, grant: int, paced: int) -> str | None:
        """What limits the steps at present, for a profile."""
        if grant == self._last_point:
            return None
        if grant in (self._hold, paced):
            return PAUSE if grant == self._hold else CLOCK
        return self._nodes[min(range(len(self._nodes)), key=lambda n: self._progress[n] + self._windows[n])]

    @property
    def _last_point(self) -> int:
        """The last point, or the one at which the simulation ends early."""
        ended = self.ended_by.point if self.ended_by is not None else None
        return self._plan.grid.last_point if ended is None else ended

    def _wait_for(self, reached: Callable[[], bool], timeout_s: float, what: str) -> None:
        deadline = time.monotonic() + timeout_s
        while not reached():
            if time.monotonic() > deadline:
                missing = [
                    node
                    for number, node in enumerate(self._nodes)
                    if (self._progress[number] < 0 if self._state == "initializing" else node not in self._reports)
                ]
                raise DeadlineExceeded(f"{what} {spoken(*missing)} within {timeout_s:g} s")
            if self._state == "initializing":
                self._tell_grant()
            self._turn(min(0.1, self._heartbeat_s))

    def _turn(self, timeout_s: float) -> None:
        """Handle all messages that have arrived; wait up to ``timeout_s`` seconds for the first one.

        Raises:
            FmuMeshError: a node failed or was lost.
        """
        message, moved = self._inbox.wait(timeout_s, self._wishes()), False
        while message is not None:
            moved = self._take_progress(*message) or moved
            message = self._inbox.poll()
        for number in self._sharing:
            moved = self._progressed(number, self._memory.progress[self._nodes[number]].value - 1) or moved
        if moved:  # whichever it is: the slowest node may wait for another slow one
            self._slowest = min(self._progress)
            self._moved = time.monotonic()
        self._publish_status()
        if self._failure is not None:
            raise self._failure

    def _take_progress(self, node: str, kind: int, _link: int, _count: int, point: int, _data: bytes) -> bool:
        """Store the progress of a node; return whether it has increased."""
        if kind != PROGRESS:
            self._inbox.refusals.add(spoken(node), f"a message of kind {kind} is not one that the master accepts")
            return False
        number = self._numbers[node]
        if number in self._sharing or not self._progressed(number, point):
            return False
        self._memory.progress[node].raise_to(point + 1)
        return True

    def _progressed(self, number: int, point: int) -> bool:
        """Store the progress of a node; return whether it has increased."""
        if not self._may_be_at(self._nodes[number], point):
            self._fail(self._broken(self._nodes[number], f"is at point {point}"))
            return False
        if point <= self._progress[number]:
            return False
        self._progress[number] = point
        return True

    def _wishes(self) -> list[Wish]:
        """Wake up when the slowest node of this host has come so far that there is something to do."""
        if not self._sharing:
            return []
        numbers = self._sharing if self._grant >= self._last_point else [*{*self._sharing} & {*self._stepping}]
        slowest = min(numbers or self._sharing, key=self._progress.__getitem__)
        reached = self._progress[slowest]
        goal = self._grant if self._grant >= self._last_point else (reached + self._grant) // 2
        if reached >= self._grant or self._state == "stopping":
            return [] if reached >= 0 else [(self._memory.progress[self._nodes[slowest]], 1)]
        return [(self._memory.progress[self._nodes[slowest]], max(goal, reached + 1) + 1)]

    def _fail(self, error: FmuMeshError) -> None:
        if self._failure is None:
            self._failure = error

    # --- what arrives; all of it on the main thread

    def _declare(self) -> None:
        server, keys = self._server, self._run_keys
        server.serve(self._keys.register, self._members.register)
        server.serve(keys.ready("*"), self._members.ready)
        server.serve(keys.report("*"), self._take_report)
        server.show("info", self._info)
        server.show("status", self.last_status)
        server.show("plan", lambda: self._plan.nodes)
        server.serve(self._keys.mesh_key("command"), self._command)
        server.watch(keys.node("*"), self._members.token_changed)
        server.watch(keys.follower("*"), self._followers.changed)
        server.hand_on_logs()

    def _take_report(self, query: zenoh.Query) -> None:
        node = RunKeys.node_in(str(query.key_expr))
        report = decode_json(payload_of(query), NodeReport)
        if report.node != node or not self._members.is_admitted(node):
            raise MessageRefused("its sender has not registered")
        error = from_report(report.error) if report.error is not None else None
        if isinstance(error, TerminationRequested):
            # Its node continues with its other instances, and reports this again at the end.
            if error.point is None or not self._may_be_at(node, error.point):
                self._fail(self._broken(node, f"has an FMU that ends the simulation at point {error.point}"))
            elif error.point < self._last_point:
                self.ended_by = error
        elif error is None and self._state in GOING_ON:
            self._fail(self._broken(node, f"has ended at point {report.point}"))
        else:
            self._reports[node] = report
            if error is not None:
                self._fail(error)
        query.reply(query.key_expr, b"")
        query.drop()

    def _may_be_at(self, node: str, point: int) -> bool:
        """Whether a node can have reached this point with its grants."""
        ended = self.ended_by is not None and node != RECORDER
        most = self._plan.grid.last_point if ended else self._grant + self._most_ahead
        return -1 <= point <= most

    def _broken(self, node: str, what: str) -> ProtocolBroken:
        return ProtocolBroken(
            f"{spoken(node)} says that it {what}, and the master has granted point {self._grant}",
            instance=self._instances_of(node),
            hint="Does another process send messages with its name?",
        )

    def _instances_of(self, node: str) -> str | None:
        return ", ".join(item.name for item in self._plan.nodes[node].instances) or None

    def _lose(self, node: str) -> None:
        """The process of a node is gone; this is an error unless the node has reported its end."""
        if node in self._reports:
            return
        point = max(self._progress[self._numbers[node]], 0)
        loss = self._router.loss()
        self._fail(
            MeshLost(
                f"{loss}, and {spoken(node)} with it"
                if loss is not None
                else f"{spoken(node)} was lost: its process does not answer any more",
                instance=self._instances_of(node),
                point=point,
                time=self._plan.grid.time(point),
            )
        )

    def _command(self, query: zenoh.Query) -> None:
        """Handle pause, resume, step N and stop, which only change the grant."""
        if query.payload is None and str(query.key_expr) != self._keys.mesh_key("command"):
            query.drop()  # a query for all keys
            return
        data = payload_of(query)
        try:
            command = decode_json(data, Command)
        except MessageRefused as error:
            raise MessageRefused(f"not a command: {error}") from error
        if self._state not in ("running", "paused"):
            query.reply_err(f"the mesh is {self._state}; there is nothing to {command.command}")
            query.drop()
            return
        match command.command:
            case "pause":
                self._state, self._hold = "paused", self._grant
            case "resume":
                self._state, self._hold = "running", None
                self._clock.start()
                self._pacer.start(self._slowest)
            case "step":
                self._state, self._hold = "paused", max(self._hold or 0, self._grant) + max(1, command.points)
                self._clock.start()
                self._pacer.start(self._slowest)
            case "stop":
                self._stop()
        self._moved = time.monotonic()
        answer = CommandAnswer(command.command, self._state, self._slowest, self._hold)
        query.reply(self._keys.mesh_key("command"), msgspec.json.encode(answer), encoding=json_encoding)
        query.drop()

    def _stop(self) -> None:
        """End the run: at the granted point if it has no stop time, otherwise as an interruption."""
        grid, self._hold = self._plan.grid, None
        if grid.stop_time is not None:
            text = f"stopped by a command before its stop time of {grid.stop_time:.12g} s"
            self._fail(Interrupted(text, point=self._slowest, time=grid.time(self._slowest)))
        elif self.ended_by is None:
            text = "stopped by a command, the normal end of a run without a stop time"
            self.ended_by = TerminationRequested(text, point=self._grant, time=grid.time(self._grant))

    # --- views

    def _info(self) -> MeshInfo:
        shared = (*self._members.shared, MASTER) if self._members.shared else ()
        return mesh_info(self._plan, self._run_keys.run, self._settings.config_file, self._settings.endpoints, shared)

    def last_status(self) -> MeshStatus:
        """The state of the run right now."""
        point = min(max(self._slowest, 0), self._last_point)
        elapsed = self._clock.elapsed()
        rate = point / elapsed if elapsed > 0 else 0.0
        failure: ErrorReport | None = self._failure.report() if self._failure is not None else None
        return MeshStatus(
            mesh=self._keys.mesh,
            state=self._state,
            point=point,
            last_point=self._plan.grid.last_point,
            time=self._plan.grid.time(point),
            points_per_second=rate,
            real_time_factor=rate * self._plan.grid.step_size,
            progress={node: max(progress, 0) for node, progress in zip(self._nodes, self._progress, strict=True)},
            error=failure,
            overruns=self._pacer.overruns,
            refused=self._inbox.refusals.count,
        )
