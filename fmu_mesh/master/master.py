"""The master: starts a run, grants points, and ends the run.

It waits for what arrives, reports it to `MasterStates`, and does what follows. The master never sees a value. Grants
and progress are counters in the memory of the host, and the nodes there keep the windows among themselves; a node that
does not share this memory gets grants and reports its progress by messages.
"""

# WHY one thread decides, and which others there are:
#
# The process of a master has its main thread, which is in `Master.run`; the thread of the recorder, which only reads
# `wanted`; and the threads of Zenoh, on which queries, tokens and messages arrive. None of those changes a state:
# they post to the inbox and ring the bell of this process, and the main thread runs what was posted when it next wakes
# (ADR 0008). So there is no lock here. `interrupt` posts in front of all others, because a person waits for it.
#
# The main thread sleeps in one place only, `Inbox.wait`, and each sleep has a limit: the wall clock, the next status,
# or the heartbeat. Progress on this host rings no bell. The master is woken only when the slowest node has come so far
# that there is something to do (`Granting.wake_at`), not at each point of each node (ADR 0058).
#
# What may go wrong, and what was tried:
#   - A token of Zenoh is lost although its process lives (a debugger, a suspended host). To end the run by the token
#     ended healthy runs. Now a lost token is a question: on this host the process answers it, between hosts the lease
#     has decided it already (ADR 0067).
#   - With a lost router, the tokens of all nodes are gone a moment before Zenoh reports the router. So the error of a
#     lost node first checks the router, and names it.
#   - Two masters of one mesh are started. The later one sees the token of the other and ends; of two at the same time,
#     both may end. Nobody disturbs the run of another: all keys of a run have its id.
#   - A reset ends a run as a failure does, but for the next one the same nodes register again: all that belongs to one
#     run is made anew, and nothing of the old one can reach the new one (ADR 75). Meanwhile this thread runs nothing of
#     what was posted: a node that registers early would meet the old run.
#   - A reader of the last samples (a gateway to ROS) gets them through this process, so the master waits for it after
#     the end of the nodes.

from __future__ import annotations

import logging
import math
import os
import socket
from collections.abc import Callable, Mapping

import msgspec
import zenoh
from msgspec.structs import replace

from .. import __version__
from ..awake import AwakeClock
from ..errors import (
    ConfigurationError,
    DeadlineExceeded,
    FmuMeshError,
    Interrupted,
    MeshLost,
    MessageRefused,
    NotFinite,
    RunReset,
    TerminationRequested,
)
from ..rings.host_memory import HostMemory, can_share
from ..system.attempt import Attempt
from ..system.defect import Defect
from ..system.memory_map import STREAMS
from ..system.plan import MASTER, RECORDER, Plan
from ..system.round_trip import round_trip_cost
from ..variables.value_types import PlainValue
from ..wire.inbox import Inbox
from ..wire.journal import Journal
from ..wire.keys import Keys, RunKeys, sender_in
from ..wire.meeting import Meeting
from ..wire.messages import FINISH, PROGRESS, STATE, NewStart, NodeReport, decode_json, sealed
from ..wire.refusals import payload_of
from ..wire.router_link import RouterLink
from ..wire.runtime import this_host
from ..wire.session import tokens, undeclare_all
from ..wire.time_profile import TIME_LINE_ENTRIES, MeshProfile
from ..wire.values import json_encoding, who_sent
from ..wire.views import Command, CommandAnswer, MeshInfo, MeshState, MeshStatus
from ..wire.ways import Ways
from .actions import Action, AnswerAll, Commanded, EndAll, FollowClock, RaiseGrant, RaiseSent, SendToAll
from .audit import Audit
from .checkpoints import Checkpoints
from .master_states import MasterStates
from .master_streams import MasterStreams
from .members import Followers, Members
from .mesh_server import STATUS_S, Events, MasterServer, MasterSettings
from .pacing import GrantWatch, Pacer, RunClock
from .registrations import spoken
from .resting import Resting

__all__ = ["Master"]

log = logging.getLogger(__name__)

_FAR_S = 0.001
"""From such a round trip on, it is said what lockstep costs."""

_LAST_WORDS_S = 1.0
"""For how long a run that fails waits until its nodes have left: what they said before comes in this time."""


Replan = Callable[[Mapping[str, PlainValue], int], Plan]


class Master:
    """The master of one mesh: of one run, and of those that follow a reset.

    Args:
        session: the session of this process; the caller closes it.
        replan: returns the plan of the first run with other start values, after this number of resets.
        router: the link to the router that connects the nodes, if there is one.
        meeting: where it meets nodes for row streams; the caller closes it.

    Call `claim`, then `run`, from the main thread; as long as it raises `RunReset`, `begin_again` and `run` again; then
    `wait_for_followers` if it went well, then `close`.
    """

    def __init__(  # noqa: PLR0913, PLR0917  one run and its surroundings
        self,
        plan: Plan,
        session: zenoh.Session,
        events: Events,
        settings: MasterSettings,
        replan: Replan,
        router: RouterLink | None = None,
        meeting: Meeting | None = None,
    ) -> None:
        self._session = session
        self._settings = settings
        self._keys = Keys(plan.system.config.zenoh.key_prefix, plan.system.config.mesh)
        self._router = router or RouterLink(session)
        self._first_plan = plan
        self._replan = replan
        self._resets, self._start = 0, NewStart(0, plan.digest, {})
        self._defects: dict[str, Defect] = {}
        attempt = settings.attempt
        self._journal: Journal[Commanded] = Journal(attempt.journal, Commanded)
        self._states = MasterStates(
            plan,
            paused=settings.paused,
            replays_to=attempt.replays_to,
            commanded=next(reversed([*self._journal.entries()]), None),
        )
        self._memory = self._made_memory()
        self._inbox = Inbox(self._memory)
        self._followers = Followers(self._inbox, lambda: self._states.takes_commands)
        self._server = MasterServer(session, self._keys, self._inbox, events, self.last_status, plan.system.instances)
        items = [(own.name, key) for node in plan.nodes.values() for own in node.instances for key in own.keys_in]
        fed = {f"{name}.{key.variable}": key.key for name, key in items}
        self.audit = Audit(session, self._keys, lambda: max(self._states.granting.slowest, 0), fed, self._server.say)
        self._token: zenoh.LivelinessToken | None = None
        self._prepare(meeting)
        self._first_keys = self._run_keys

    def _made_memory(self) -> HostMemory:
        nodes = [*self._states.plan.nodes.values()]
        memory_of = HostMemory.create if self._shares else HostMemory.private
        memory = memory_of(nodes[0].memory, MASTER)
        memory.begin_at(self._states.plan.grid.first_point, (place for node in nodes for place in node.rings))
        return memory

    def _prepare(self, meeting: Meeting | None) -> None:
        """Make all that belongs to one run, but its states and its memory."""
        session, plan, settings = self._session, self._states.plan, self._settings
        self._run_keys = keys = RunKeys.new(self._keys)
        self._pacer = Pacer(plan, plan.system.config.simulation.real_time_factor)
        self._clock = RunClock()
        self._watch = GrantWatch() if settings.profile else None
        self._meeting = meeting
        self.streams = None
        if meeting is not None:
            self.streams = MasterStreams(plan, self._memory.participant(STREAMS), meeting, self._fail_later)
        self._inbox.open(session, keys, MASTER, {keys.progress(node): node for node in plan.nodes})
        self.audit.follow(keys)
        offer = self._memory.offer if self._shares else None
        attempt = Attempt() if self._resets else replace(settings.attempt, journal="")
        own = settings.launch, attempt, meeting, settings.table
        self._members = Members(self._states.registrations, session, keys, offer, *own)
        self._resting = Resting(self._keys.mesh, self._states, self._answer)
        kept = replace(settings, checkpoint_s=None) if self._resets else settings  # after a reset, nothing starts again
        self._checkpoints = Checkpoints(
            self._keys.mesh, self._states, self._withdrawn_grant, kept, self._inbox.refusals
        )
        self._published: tuple[MeshState, bool] = ("starting", False)
        self._run_token = session.liveliness().declare_token(keys.master)

    def memory_for(self, participant: str) -> HostMemory | None:
        """The memory of this process for a participant in it; None if it neither shares any nor has row streams."""
        return self._memory.participant(participant) if self._shares or self.streams is not None else None

    @property
    def _shares(self) -> bool:
        return can_share() and self._states.plan.system.config.zenoh.shared_memory

    @property
    def _is_secured(self) -> bool:
        return next(iter(self._first_plan.nodes.values())).secured

    def claim(self) -> None:
        """Become the visible master of this mesh; from now on queries wait until `run` answers them.

        Raises:
            ConfigurationError: another process that this session can reach is the master; it is not affected.
        """
        self._router.wait()
        if [key for key in tokens(self._session, self._keys.run("*").master) if key != self._run_keys.master]:
            self._run_token.undeclare()
            raise ConfigurationError(
                f"mesh '{self._keys.mesh}' is already running where this master connects",
                hint="Stop it first, or give this mesh another name or another `zenoh.key_prefix`.",
            )
        server = self._server
        self._serve_nodes()
        server.watch(self._first_keys.follower("*"), self._followers.changed)
        server.serve(self._keys.register, lambda query: self._members.register(query))  # noqa: PLW0108  of the newest run
        server.show("info", self._info)
        server.show("status", self.last_status)
        server.show("plan", lambda: self._states.plan.nodes)
        server.show("audit", self.audit.view)
        for key in (self._keys.command, *([replace(self._keys, by="*").command] if self._is_secured else ())):
            server.serve(key, self._command)
        if self._is_secured:
            server.greet(self._settings.table)
        server.hand_on_logs()
        self._token = self._session.liveliness().declare_token(self._keys.master)

    def _serve_nodes(self) -> None:
        """Serve the keys of this run, and no longer those of the one before."""
        server, keys = self._server, self._run_keys
        server.forget_run()
        server.serve(keys.ready("*"), self._members.ready, of_run=True)
        server.serve(keys.report("*"), self._take_report, of_run=True)
        server.watch(keys.node("*"), self._members.token_changed, of_run=True)

    def run(self, check: Callable[[], None] = lambda: None, defects: Callable[[], dict[str, Defect]] = dict) -> None:
        """Run the mesh to its last point.

        Args:
            check: called several times a second; an error that it raises ends the run.
            defects: those for the status.

        Raises:
            FmuMeshError: why the run ended early; all nodes have been informed.
        """
        states, awake = self._states, AwakeClock()
        self._awake = awake
        try:
            while not states.is_over:
                try:
                    check()
                    self._defects = defects()
                except FmuMeshError as error:
                    states.fail(error)
                pause_s = self._decide(awake())
                if not states.is_over:
                    self._turn(min(pause_s, STATUS_S, states.deadlines.heartbeat))
        finally:
            self._clock.stop()
            if not isinstance(states.failure, RunReset):
                self._server.publish_status(at_once=True)
                if states.failure is not None:
                    # The log lines that nodes had said before they were told to end. And when this process is gone,
                    # what the network has not delivered yet is lost: why they have to end.
                    asked = isinstance(states.failure, Interrupted) and self._members.some_are_far
                    limit_s = states.deadlines.finish if asked else _LAST_WORDS_S
                    self._inbox.wait_until(lambda: self._members.have_left, limit_s)
                undeclare_all([own for own in (self._run_token, self._token) if own is not None])
        if isinstance(states.failure, DeadlineExceeded):
            states.failure.with_hint(self._server.waits(states.failure.point or 0))
        if states.failure is not None:
            raise states.failure

    def begin_again(self, plan: Plan, meeting: Meeting | None) -> None:
        """After `run` has raised `RunReset`, and the recorder has ended: be the master of the next run.

        Then call `run` again. Those who use the mesh, and do not belong to the run, notice only that its points begin
        again.

        Args:
            plan: the last one that ``replan`` has returned.
            meeting: a new one.
        """
        self._run_token.undeclare()
        self._close_run()
        self._resets += 1
        self._states = MasterStates(plan, paused=self._states.hold is not None)
        self._memory = self._made_memory()
        self._inbox.move_to(self._memory, self._memory)
        self._prepare(meeting)
        self._serve_nodes()

    def wait_for_followers(self) -> None:
        """Wait, because this process routes messages, until all followers have the last sample."""
        if self._states.failure is None:
            self._followers.wait(self._states.plan.system.config.timeouts.stop)

    def close(self) -> None:
        """Undeclare everything."""
        self._server.close()
        self._journal.close()
        self.audit.close()
        self._close_run()

    def _close_run(self) -> None:
        self._members.close()
        if self.streams is not None:
            self.streams.close()
        self._inbox.close()
        self._memory.close()

    def _fail_later(self, error: FmuMeshError) -> None:
        """From any thread."""
        self._inbox.post(lambda: self._states.fail(error))

    def interrupt(self, reason: str) -> None:
        """From any thread: end the run with `Interrupted`."""
        self._inbox.post(lambda: self._states.fail(Interrupted(reason)), first=True)

    # --- wait, and do

    def _decide(self, now: float) -> float:
        """Do what there is to do; return for how long there is nothing more if nothing arrives, in s."""
        states, pause_s = self._states, math.inf
        self._look_at_streams(now)
        self._checkpoints.settle(now)
        while True:
            paced = states.wanted
            if states.takes_commands:
                paced, pause_s = self._pacer.limit(paced, states.granting.reached)
            stopped = self._members.stopped() if states.slowest_silent_s(now) > states.deadlines.step else ()
            actions = states.decide(now, paced, stopped)
            if states.moves:
                self._clock.start()
            else:
                self._clock.stop()
            for action in actions:
                self._do(action)
            if not actions:
                break
        self._resting.settle(now)
        self._checkpoints.answer()
        # After what there is to do: to publish takes as long as thousands of points.
        (state, rested), self._published = self._published, (states.state, states.rests)
        if (states.state != state or (states.rests and not rested)) and not states.is_over:
            self._server.publish_status(at_once=True)
        if self._watch is not None and states.takes_commands:
            self._watch.note(states.granting.holder(hold=states.hold, paced=paced))
        return pause_s

    def _look_at_streams(self, now: float) -> None:
        """Note who was met, and that a cut link is no fault of a node until it has been silent for too long."""
        states = self._states
        if self._meeting is None or self.streams is None:
            return
        if states.state == "starting":
            states.registrations.meet(tuple(self._meeting.sockets))
        states.granting.measured(self.streams.round_trip_s)
        try:
            if self.streams.check():
                states.excuse(now)
        except MeshLost as error:
            states.fail(error)

    def _open_streams(self, ways: Ways) -> None:
        if self.streams is not None and self._meeting is not None:
            self.streams.start(ways)
            for both in self._states.registrations.unmet(ways):
                log.warning("%s and %s cannot reach each other: their rows go by Zenoh", *map(spoken, both))
            plan, round_trip_s = self._states.plan, self.streams.round_trip_s
            if plan.window == 1 and round_trip_s > _FAR_S:
                log.warning("a round trip takes %.3g s: %s", round_trip_s, *round_trip_cost(plan, round_trip_s))
            if not ways.streams_of(MASTER):
                self._meeting.close()  # nobody needs its door

    def _do(self, action: Action) -> None:
        match action:
            case AnswerAll(ways):
                self._open_streams(ways)
                entries = TIME_LINE_ENTRIES // len(self._states.plan.nodes) if self._watch is not None else 0
                self._members.welcome(entries, ways)
            case FollowClock(point, paced):
                self._pacer.start(point, paced=paced)
            case RaiseGrant(point):
                self._memory.grant.raise_to(point)
            case RaiseSent(point):
                if self.streams is not None:
                    self.streams.grant(point)
            case SendToAll(kind, point):
                if kind == FINISH:
                    self._memory.finish.raise_to(point + 1)
                self._members.send(kind, point)
            case EndAll(RunReset()):
                self._members.begin_again(self._start)
            case EndAll(error):
                self._members.abort(error)

    def _turn(self, timeout_s: float) -> None:
        """Report all that has arrived; wait up to ``timeout_s`` seconds for the first of it."""
        states, memory = self._states, self._memory
        seen, wake_at = states.granting.seen, states.granting.wake_at(states.wanted)
        wishes = []
        if wake_at is not None and states.state != "stopping":
            node, point = wake_at
            wishes = [(memory.progress[node], point + 1)]
        reported = []
        message = self._inbox.wait(timeout_s, wishes)
        while message is not None:
            node, kind, _, _, point, _ = message
            if kind == STATE:
                with self._inbox.refusals.guard(node):
                    self._checkpoints.take(node, point, message[5])
            elif kind != PROGRESS:
                self._inbox.refusals.add(spoken(node), f"a message of kind {kind} is not one that the master accepts")
            elif node not in seen:
                reported.append((node, point))
            message = self._inbox.poll()
        for node, point in states.progress(reported):
            memory.progress[node].raise_to(point + 1)
        states.progress((node, memory.progress[node].value - 1) for node in seen)
        self._server.publish_status()
        silent_s = self.streams.silent_s if self.streams is not None else lambda _node: math.inf
        for node in self._members.lost(self._router, states.deadlines.link, silent_s):
            states.lose(node, self._router.loss())

    def _take_report(self, query: zenoh.Query) -> None:
        report = decode_json(payload_of(query), NodeReport)
        is_of_sender = report.node == RunKeys.node_in(str(query.key_expr))
        if not is_of_sender or not self._states.registrations.is_of(report.node, sealed(report.secret)):
            raise MessageRefused("its sender is not the process that has registered")
        self._states.report(report)
        query.reply(query.key_expr, b"")
        query.drop()

    def _command(self, query: zenoh.Query) -> None:
        if query.payload is None and "*" in str(query.key_expr):
            query.drop()  # a query for all keys
            return
        key = str(query.key_expr)
        try:
            who, command = self._sent_command(query, key)
        except MessageRefused as refused:
            self.audit.note("refused", sender_in(key), key, str(refused))
            raise
        states, resets = self._states, self._resets
        try:
            if states.takes_commands and command.command == "reset":
                self._start, resets = self._new_start(command), resets + 1
        except ConfigurationError as error:  # nothing has changed
            self.audit.note("refused", who, key, str(error))
            query.reply_err(str(error))
            query.drop()
            return
        if states.takes_commands and command.command == "checkpoint":
            self.audit.note("commanded", who, key, command.command)
            self._checkpoints.ask(query, command.wait, self._awake())
        elif states.takes_commands:
            self.audit.note("commanded", who, key, command.command)
            self._checkpoints.give_up(MeshLost(f"another program gave the command '{command.command}' meanwhile"))
            answer = replace(states.command(command, self._withdrawn_grant()), resets=resets)
            if command.command != "reset":  # a mesh that was reset does not start again
                stopped_at = states.granting.last_point if command.command == "stop" else None
                self._journal.add(Commanded(command.command, answer.hold, stopped_at))
            if command.wait and answer.hold is not None and command.command != "reset":
                self._resting.add(query, answer, self._awake() + command.wait)
            else:
                self._answer(query, answer)
        else:
            self.audit.note("refused", who, key, f"'{command.command}' of a mesh that is {states.state}")
            query.reply_err(f"the mesh is {states.state}; there is nothing to {command.command}")
            query.drop()

    def _sent_command(self, query: zenoh.Query, key: str) -> tuple[str, Command]:
        """Who sent a command, and the command.

        Raises:
            MessageRefused: it is none, or has no name where the mesh has security.
        """
        data = payload_of(query)
        if self._is_secured and key == self._keys.command:
            named = replace(self._keys, by="NAME").command
            raise MessageRefused(f"this mesh has security: '{named}' takes commands, with your name")
        try:
            return sender_in(key) or who_sent(query.attachment), decode_json(data, Command)
        except MessageRefused as error:
            raise MessageRefused(f"not a command: {error}") from error

    def _answer(self, query: zenoh.Query, answer: CommandAnswer) -> None:
        key = query.key_expr
        with self._inbox.refusals.guard(str(key)):  # the client may be gone
            query.reply(key, msgspec.json.encode(answer), encoding=json_encoding)
            query.drop()

    def _withdrawn_grant(self) -> int:
        """Take the grant back: what a node may have claimed."""
        return self._memory.withdraw_grant() if self._states.granting.sharing else 0

    def _new_start(self, command: Command) -> NewStart:
        """What the nodes need for a reset.

        Raises:
            ConfigurationError: the mesh cannot begin again with these start values.
        """
        plan, resets = self._replan(command.start_values, self._resets + 1), self._resets + 1
        before = {item.name: item.start_values for node in self._first_plan.nodes.values() for item in node.instances}
        items = [item for node in plan.nodes.values() for item in node.instances]
        changed = {item.name: item for item in items if item.start_values != before[item.name]}
        timeouts = {name: item.timeouts for name, item in changed.items()}
        return NewStart(resets, plan.digest, {name: item.start_values for name, item in changed.items()}, timeouts)

    # --- views

    @property
    def wanted(self) -> int:
        """As that of the states; negative until all nodes have reached the first point. From any thread."""
        return self._states.wanted if self._states.granting.has_begun else -1

    @property
    def ended_by(self) -> TerminationRequested | NotFinite | None:
        """Why the simulation ended before its last point, and not at once, as `MasterStates` has it."""
        return self._states.ended_by

    @property
    def warnings(self) -> list[str]:
        """Nodes that failed or were lost after their last step."""
        return self._states.warnings

    @property
    def seconds(self) -> float:
        """Wall-clock time from the first grant to the last point in s, without pauses."""
        return self._clock.elapsed()

    def profile(self) -> MeshProfile | None:
        """What the nodes without a failure have measured; None if nothing was measured."""
        if self._watch is None:
            return None
        reports = [self._states.reports[node] for node in self._states.plan.nodes if node in self._states.reports]
        return MeshProfile(tuple(r.profile for r in reports if r.profile is not None), self._watch.held_s)

    def _info(self) -> MeshInfo:
        plan, shared = self._states.plan, self._states.granting.sharing
        config, grid = plan.system.config, plan.grid
        return MeshInfo(
            mesh=config.mesh,
            version=__version__,
            run=self._first_keys.run,
            config=self._settings.config_file,
            start_time=grid.start_time,
            stop_time=grid.stop_time,
            step_size=grid.step_size,
            algorithm=config.simulation.algorithm,
            window=plan.window,
            real_time_factor=config.simulation.real_time_factor,
            instances=tuple(plan.system.instances),
            nodes=tuple(plan.nodes),
            result_file=plan.system.result_file,
            result_files=tuple(record.file for record in plan.system.records),
            endpoints=self._settings.endpoints,
            pid=os.getpid(),
            host=socket.gethostname(),
            shared_memory=(*shared, MASTER) if {*shared} - {RECORDER} else (),
            row_streams=self._states.granting.ways.streams,
            host_id=this_host(),
            topics=plan.system.topics,
            deploy_hosts={name: own.host for name, own in plan.nodes.items() if own.host is not None},
        )

    def last_status(self) -> MeshStatus:
        """The state of the run right now."""
        states, grid = self._states, self._states.plan.grid
        first = grid.first_point
        point = min(max(states.granting.slowest, first), states.granting.last_point)
        elapsed = self._clock.elapsed()
        rate = (point - first) / elapsed if elapsed > 0 else 0.0
        attempt, failure = self._settings.attempt, states.failure
        goes_on = type(failure) is MeshLost and attempt.may_be_followed and not self._resets
        is_again = bool(str(attempt)) and not self._resets and (states.state == "starting" or states.is_replaying)
        state: MeshState = states.state
        if goes_on or (is_again and states.takes_commands):
            state = "restarting"
        return MeshStatus(
            mesh=self._keys.mesh,
            state=state,
            restarting=str(attempt) if is_again else "",
            restarts=attempt.number - 1,
            may_restart=attempt.may_be_followed and not self._resets,
            point=point,
            last_point=grid.last_point,
            time=grid.time(point),
            points_per_second=rate,
            real_time_factor=rate * grid.step_size,
            progress={node: max(point, first) for node, point in states.granting.progress.items()},
            error=failure.report() if failure is not None else None,
            overruns=self._pacer.overruns,
            refused=self._inbox.refusals.count,
            cut=self.streams.cut if self.streams is not None else {},
            resets=self._resets,
            missing=tuple(states.registrations.missing) if states.state == "starting" else (),
            defects=self._defects,
        )
