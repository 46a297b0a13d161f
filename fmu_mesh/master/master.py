"""The master: starts a run, grants points, and ends the run.

::

    wait until every node has registered; answer them all        (ready/ack)
    wait until every node is at point 0                          (Initialization Mode is over)
    until every node is at the last point, or at the one where an FMU asked to end the simulation:
        grant it                                                 (less if the wall clock or a pause limits it)
        wait for progress
    tell the nodes to finish; wait for their reports

The master never sees a value. Grants and progress are counters in the memory of the host, and the nodes there keep the
windows among themselves; a node that does not share this memory gets grants and tells its progress by messages.
"""

from __future__ import annotations

import time
from collections.abc import Callable

import msgspec
import zenoh

from ..awake import AwakeClock
from ..errors import (
    ConfigurationError,
    DeadlineExceeded,
    ErrorReport,
    FmuMeshError,
    Interrupted,
    MeshLost,
    MessageRefused,
    NotFinite,
    TerminationRequested,
    from_report,
)
from ..rings.host_memory import HostMemory, can_share
from ..system.plan import MASTER, RECORDER, Plan
from ..wire.inbox import Inbox
from ..wire.keys import Keys, RunKeys
from ..wire.messages import FINISH, GRANT, PROGRESS, NodeReport, decode_json, sealed
from ..wire.refusals import payload_of
from ..wire.session import RouterLink, tokens
from ..wire.time_profile import TIME_LINE_ENTRIES, MeshProfile
from ..wire.values import json_encoding
from ..wire.views import GOING_ON, Command, CommandAnswer, MeshInfo, MeshState, MeshStatus
from .granting import Granting
from .members import Followers, Members, spoken
from .mesh_server import STATUS_S, Events, MasterServer, mesh_info
from .pacing import GrantWatch, Pacer, RunClock

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
        ended_by: why the simulation ends before its last point, and not at once: an FMU asked for it, an output is not
            finite, or there was a `stop` and no stop time.
        warnings: nodes that failed or were lost after their last step.

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
        self._most_instances = max(len(node.instances) for node in plan.nodes.values())
        self._reports: dict[str, NodeReport] = {}
        self._failure: FmuMeshError | None = None
        self.ended_by: TerminationRequested | NotFinite | None = None
        self.warnings: list[str] = []
        self._state: MeshState = "starting"
        self._hold: int | None = None
        self._watch = GrantWatch() if settings.profile else None
        self._pacer = Pacer(plan, config.simulation.real_time_factor)
        self._clock = RunClock()
        self._published = 0.0
        self._awake = AwakeClock()
        self._moved = 0.0
        self._shares = config.zenoh.shared_memory and can_share()
        memory_of = HostMemory.create if self._shares else HostMemory.private
        self._memory = memory_of(next(iter(plan.nodes.values())).memory, MASTER)
        self._granting = Granting(plan, self._memory)
        self._inbox = Inbox(self._memory)
        self._inbox.open(session, self._run_keys, MASTER, {self._run_keys.progress(node): node for node in self._nodes})
        self._followers = Followers(self._inbox, lambda: self._state in ("running", "paused"))
        offer = self._memory.offer if self._shares else None
        self._members = Members(plan, session, self._run_keys, offer, self._lose, settings.launch)
        self._server = MasterServer(session, self._keys, self._inbox, events, self.last_status, plan.system.instances)
        self._publish_status = self._server.publish_status

    def memory_for(self, participant: str) -> HostMemory | None:
        """The memory of the host for a participant in this process; None if nothing is shared."""
        return self._memory.participant(participant) if self._shares else None

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
            start_s = self._timeouts.initialize
            self._wait_for(lambda: self._granting.slowest >= 0, start_s, "Initialization Mode is not over in")
            self._grant_to_the_end()
            if isinstance(self.ended_by, NotFinite):
                raise self.ended_by
            self._enter("stopping")
            self._members.send(FINISH, self._last_point)
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
        return self._granting.slowest >= 0

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
        self._inbox.post(lambda: self._fail(Interrupted(reason)), first=True)

    # --- phases

    def _enter(self, state: MeshState) -> None:
        """Change the state, and publish it at once."""
        self._state = state
        self._publish_status(at_once=True)

    def _wait_for_nodes(self) -> None:
        deadline = self._awake() + self._timeouts.start
        while not self._members.complete:
            if self._awake() > deadline:
                raise self._members.absence()
            self._turn(0.25)
        self._members.welcome(TIME_LINE_ENTRIES // len(self._nodes) if self._watch is not None else 0)
        self._granting.share(self._members.shared)

    def _grant_to_the_end(self) -> None:
        self._hold = 0 if self._settings.paused else None
        self._enter("paused" if self._settings.paused else "running")
        if self._hold is None:
            self._clock.start()
        self._pacer.start(0)
        self._moved = self._awake()
        while self._granting.slowest < self._last_point:
            self._turn(self._publish_grant())
            if self._hold is not None and self._granting.slowest >= self._hold:
                self._clock.stop()
            if self._hold is None:
                self._granting.check_progress(self._awake() - self._moved, self._members)
        self._clock.stop()

    def _publish_grant(self) -> float:
        """Raise the grant if it can be increased; return how long to wait until the next check, in s."""
        granting = self._granting
        grant = self._last_point if self._hold is None else min(self._hold, self._last_point)
        paced, pause = self._pacer.limit(grant, granting.slowest)
        grant = max(granting.grant, min(grant, paced))
        if grant > granting.grant:
            if granting.slowest >= granting.grant:  # they had nothing to do until now, because of the wall clock
                self._moved = self._awake()
            granting.raise_to(grant)
        self._tell_grant()
        if self._watch is not None:
            at_end = granting.told == self._last_point
            self._watch.look(None if at_end else granting.holder(granting.told, hold=self._hold, paced=paced))
        return min(pause, STATUS_S, self._heartbeat_s)

    def _tell_grant(self) -> None:
        """Send the grant to nodes that cannot read it, and to all as a sign that the master lives."""
        now = time.monotonic()
        owed, grown = self._granting.owed()
        if grown or now - self._published >= self._heartbeat_s:
            self._published = now
            self._members.send(GRANT, owed)

    @property
    def _last_point(self) -> int:
        """The last point, or the one at which the simulation ends early."""
        ended = self.ended_by.last_point if self.ended_by is not None else None
        return self._plan.grid.last_point if ended is None else ended

    def _wait_for(self, reached: Callable[[], bool], timeout_s: float, what: str) -> None:
        deadline = self._awake() + timeout_s
        while not reached():
            if self._awake() > deadline:
                initializing = self._state == "initializing"
                progress = self._granting.progress
                missing = [n for n in self._nodes if (progress[n] < 0 if initializing else n not in self._reports)]
                raise DeadlineExceeded(f"{what} {spoken(*missing)} within {timeout_s:g} s")
            if self._state == "initializing":
                self._tell_grant()
            self._turn(min(0.1, self._heartbeat_s))

    def _turn(self, timeout_s: float) -> None:
        """Handle all messages that have arrived; wait up to ``timeout_s`` seconds for the first one.

        Raises:
            FmuMeshError: a node failed or was lost.
        """
        granting, ended = self._granting, self.ended_by is not None
        wishes = granting.wishes() if self._state != "stopping" else ()
        message, moved = self._inbox.wait(timeout_s, wishes), False
        while message is not None:
            node, kind, _, _, point, _ = message
            if kind == PROGRESS:
                moved = granting.take(node, point, ended=ended) or moved
            else:
                self._inbox.refusals.add(spoken(node), f"a message of kind {kind} is not one that the master accepts")
            message = self._inbox.poll()
        if granting.look(ended=self.ended_by is not None) or moved:  # the slowest node may wait for another slow one
            self._moved = self._awake()
        self._publish_status()
        if self._members.doubted:
            self._members.look_at_doubted(router_is_lost=self._router.is_lost)
        if self._failure is not None:
            raise self._failure

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
        report, granting = decode_json(payload_of(query), NodeReport), self._granting
        if report.node != node or not self._members.is_of(node, sealed(report.secret)):
            raise MessageRefused("its sender is not the process that has registered")
        error = from_report(report.error) if report.error is not None else None
        if isinstance(error, TerminationRequested) or (isinstance(error, NotFinite) and error.point):
            # Its node continues with its other instances, and reports again at the end.
            last = error.last_point
            if last is None or not granting.may_be_at(node, last, ended=self.ended_by is not None):
                self._fail(granting.broken(node, f"has an FMU that ends the simulation at point {last}"))
            elif last < self._last_point:
                self.ended_by = error
        elif error is None and self._state in GOING_ON:
            self._fail(granting.broken(node, f"has ended at point {report.point}"))
        else:
            self._reports[node] = report
            if error is not None:
                self._end_of(node, error)
        query.reply(query.key_expr, b"")
        query.drop()

    def _lose(self, node: str) -> None:
        """The process of a node is gone, which matters unless the node has reported its end."""
        if node in self._reports:
            return
        loss, point = self._router.loss(), max(self._granting.progress[node], 0)
        why = f"{spoken(node)} was lost: its process does not answer any more"
        why = why if loss is None else f"{loss}, and {spoken(node)} with it"
        error = MeshLost(why, instance=self._granting.instances_of(node))
        self._end_of(node, error.at(point, self._plan.grid.time(point)))

    def _end_of(self, node: str, error: FmuMeshError) -> None:
        """A node has failed or is lost. If all rows are recorded, the run is done, and this is a warning."""
        if self._granting.slowest < self._last_point or node == RECORDER:
            self._fail(error)
        else:
            self._reports.setdefault(node, NodeReport(node, self._last_point))
            hint = "Its FMU was in terminate or freeInstance. " if isinstance(error, MeshLost) else ""
            self.warnings.append(str(error.with_hint(f"{hint}All rows are recorded.")))

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
                self._state, self._hold = "paused", self._granting.halt()
            case "resume":
                self._state, self._hold = "running", None
                self._clock.start()
                self._pacer.start(self._granting.slowest)
            case "step":
                rest = self._hold if self._hold is not None else self._granting.halt()
                self._state, self._hold = "paused", rest + max(1, command.points)
                self._clock.start()
                self._pacer.start(self._granting.slowest)
            case "stop":
                self._stop()
        self._moved = self._awake()
        answer = CommandAnswer(command.command, self._state, self._granting.slowest, self._hold)
        query.reply(self._keys.mesh_key("command"), msgspec.json.encode(answer), encoding=json_encoding)
        query.drop()

    def _stop(self) -> None:
        """End the run: where a pause would be if it has no stop time, otherwise as an interruption."""
        grid, point, self._hold = self._plan.grid, self._granting.halt(), None
        if grid.stop_time is not None:
            text = f"stopped by a command before its stop time of {grid.stop_time:.12g} s"
            self._fail(Interrupted(text, point=self._granting.slowest, time=grid.time(self._granting.slowest)))
        elif self.ended_by is None:
            text = "stopped by a command, the normal end of a run without a stop time"
            self.ended_by = TerminationRequested(text, point=point, time=grid.time(point))

    # --- views

    def _info(self) -> MeshInfo:
        shared = (*self._members.shared, MASTER) if self._members.shared else ()
        return mesh_info(self._plan, self._run_keys.run, self._settings.config_file, self._settings.endpoints, shared)

    def last_status(self) -> MeshStatus:
        """The state of the run right now."""
        point = min(max(self._granting.slowest, 0), self._last_point)
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
            progress={node: max(point, 0) for node, point in self._granting.progress.items()},
            error=failure,
            overruns=self._pacer.overruns,
            refused=self._inbox.refusals.count,
        )
