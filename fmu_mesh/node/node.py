"""The node: from a plan to the last communication point.

One step of a node, in pseudocode::

    while an instance has steps left:
        let the engine step for about 1 ms, or wait:      # fmu_mesh.node.engine
            for unit in units:                            # in the order of the plan
                step as far as the grant, the windows and the rows of the sources allow
        send new rows as frames to the nodes that do not read the rings
        handle the messages that arrived: frames go into mirrors of rings, a higher grant is stored
"""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext

import zenoh

from ..awake import AwakeClock
from ..errors import (
    ErrorReport,
    FmuError,
    FmuMeshError,
    Interrupted,
    MeshLost,
    MessageRefused,
    NotFinite,
    ProtocolBroken,
    RunReset,
    StepFailed,
    TerminationRequested,
    from_report,
)
from ..instances.contract import Instance, LogMessage
from ..rings.host_memory import ONE_CORE, HostMemory
from ..rings.row_streams import RowStreams
from ..system.live_keys import KeyValue
from ..system.plan import MASTER, RECORDER, Link, NodePlan
from ..system.states import BeginsWith
from ..wire.frames import FrameReceiver, SourceRows, of_text
from ..wire.inbox import Inbox, Message
from ..wire.journal import NodeJournal
from ..wire.meeting import Meeting
from ..wire.membership import Membership, Welcome
from ..wire.messages import (
    ABORT,
    FINISH,
    FRAME,
    GRANT,
    HEADER,
    INITIAL,
    PROGRESS,
    RESET,
    SAVE,
    NewStart,
    NodeReport,
    Noted,
    SetValue,
    decode_json,
    encode_news,
)
from ..wire.router_link import RouterLink
from ..wire.stream_keeper import StreamKeeper
from ..wire.streamed_rows import why_not
from ..wire.views import AuditEntry, LogLine
from ..wire.ways import Ways
from .activity import Activity
from .burst_engine import make_engine
from .engine import Engine, Windows
from .initialization import Initialization
from .inputs import with_times
from .links import OutLink
from .node_server import NodeServer
from .runner_states import load_states, set_again, state_messages
from .stepping import Runner, connect
from .stream_ends import streams_of
from .streams import PRIORITY
from .time_measurement import Profiler

__all__ = ["Node"]

# Threads and processes: this is the main thread, the only one that calls an FMU. Messages, lost tokens and requests
# to end arrive on threads of Zenoh and are handed over by the inbox; `register` runs on a thread of `Membership`
# while FMUs load; queries are served by `NodeServer`; `report_hang` and `interrupt` come from watching threads. Other
# nodes and the master are met in the memory of the host, or by frames (ADR 58).
#
# What may go wrong, and who decides:
# * The master's token is gone. That is a question, not a verdict (ADR 67): on this host its process answers, else a
#   query for the token; and its last message may still be on its way, so `_LAST_WORD_S` is given to it.
# * An FMU fails: the recorder first gets all rows that are complete, then the master gets the report. The order
#   matters: after the report it ends the others.

log = logging.getLogger(__name__)

# Whatever a node sleeps for, after this time it looks at everything again: a wake-up that a killed process has lost
# costs this much once (docs/rings.md), and silence of the master is noticed in steps that `AwakeClock` can count.
_LONGEST_SLEEP_S = 0.5
_TELL_S, _LAST_WORD_S = 0.1, 0.3
_NO_MASTER_S = 1.0
"""How long in s the report of a failure waits for a master that was never seen."""

_LOOK_S = 0.5
"""How often in s it looks whether its router is there."""

_LAZY_S = 0.05
"""How long in s rows that no step needs may wait for more rows: each frame wakes three threads of a process."""


class Node:
    """One node of a mesh.

    Args:
        session: the session of this process; the caller closes it.
        open_instance: opens an instance of the plan by name; the caller closes the instances too.
        on_hang: called on another thread if a step does not return in time.
        launch: the launcher that started this process; None if it was started manually.
        meeting: where it meets others for row streams; the caller closes it.
        strain: which limit of this process a failure of an FMU may come from, as a sentence; None: none.
        begins_with: the states of its instances at the first point, if it is not that after Initialization Mode.

    Attributes:
        failure_is_known: whether others know what ended the run: the master knows it, or is gone.
        new_start: how its process begins again after a reset, with new instances, and a new node.
        goes_on: whether another attempt of the run may follow, likewise.

    Call `run` once, from the main thread.
    """

    def __init__(  # noqa: PLR0913  one node and its surroundings
        self,
        plan: NodePlan,
        session: zenoh.Session,
        open_instance: Callable[[str], Instance],
        *,
        on_hang: Callable[[FmuError], None] = lambda _error: None,
        router: RouterLink | None = None,
        launch: str | None = None,
        meeting: Meeting | None = None,
        engine: Callable[..., Engine] = make_engine,
        strain: Callable[[], str | None] = lambda: None,
        table: int = 0,
        begins_with: BeginsWith | None = None,
    ) -> None:
        self._plan = plan
        self._session = session
        self._open_instance = open_instance
        self._make_engine, self._strain = engine, strain
        self._finish_at: float = math.inf
        self._token_went = self.failure_is_known = self.goes_on = False
        self.new_start: NewStart | None = None
        self._clock = AwakeClock()
        self._heard = self._lazy_sent = self._progress_told_at = self._look_at = 0.0
        self._progress_sent = self._lazy_covered = plan.grid.first_point - 1
        self._begins_with, self._saves_at = begins_with or BeginsWith(), -1
        self._router = router or RouterLink(session)
        self._runners: dict[str, Runner] = {}
        self._receivers: dict[int, FrameReceiver | Link] = {}
        self._memory = self._own_memory = HostMemory.private(plan.memory, plan.node)
        self._own_memory.begin_at(plan.grid.first_point, plan.rings)
        self._engine: Engine | None = None
        self._initialization = Initialization(plan, self._wait_for_message)
        self._inbox = Inbox(self._own_memory)
        silent_s = self._stream_silent_s
        self._membership = Membership(plan, session, self._inbox, launch, self._router, None, meeting, silent_s, table)
        self._meeting = meeting
        self._ways = Ways()
        self._streams: RowStreams | None = None
        self._keeper: StreamKeeper | None = None
        self._profiler: Profiler | None = None
        self._journal = NodeJournal(plan.attempt.journal)
        self._activity = Activity(plan, self._inbox.refusals)
        self.server = NodeServer(plan, session, self._inbox, self._activity, on_hang, self.tell_recorder)

    @property
    def finished(self) -> bool:
        """Whether all nodes have done all points, this one included: what an FMU does then changes no result."""
        return self._engine is not None and self._engine.covered >= self._finish_at

    def run(self) -> None:
        """Load, initialize and step to the last point, then report to the master.

        Raises:
            FmuMeshError: why the run ended early; it was reported to the master if that could be reached.
        """
        try:
            self._membership.register(self.server.open, self._master_token_went)
            self._load()
            self._connect(self._meet())
            self._step_to_the_end(self._initialize())
            for runner in self._runners.values():
                runner.instance.close()  # before the report, because afterwards nobody would get its log messages
            self.server.close()  # the last samples, while the master is there to route them to clients
            self._tell_end(None, self._plan.timeouts.stop + self._plan.timeouts.link)  # the link may be cut
        except FmuMeshError as error:
            located = self._located(error)
            if isinstance(located, FmuError) and located is error:
                located.with_hint(self._strain())
            if aborted := isinstance(error, _Aborted):
                self.new_start = error.new_start
            self.goes_on = type(located) is MeshLost and self._membership.attempt.may_be_followed
            if aborted or not self._membership.lost_master:  # its token may be gone before its last message arrives
                self._send_last_rows()
            if aborted:  # after the rows: the master ends when it has the log lines, or a second later
                self.server.say_everything(heard=self.new_start is None)
            self.failure_is_known = aborted or self._report_failure(located)
            raise located from error
        finally:
            self.server.close()
            if self._keeper is not None:
                self._keeper.close()
            if self._streams is not None:
                self._streams.close()
            self._membership.close()
            self._inbox.close()
            self._memory.close()
            self._journal.close()

    def interrupt(self, reason: str) -> None:
        """From any thread: end the run with `Interrupted` at the next point or during the current wait."""

        def end() -> None:
            raise Interrupted(reason)

        self._inbox.post(end, first=True)

    def tell_recorder(self, news: SetValue | AuditEntry | Noted | Sequence[KeyValue]) -> None:
        """What the metadata of results and the audit get, such as a value that another program has set."""
        self._journal.keep(news)
        self._put_set(encode_news(news))

    def report_hang(self, error: FmuError) -> bool:
        """On a watching thread, while an FMU does not return: report to the master; return whether it knows now."""
        if not self._membership.lost_master:
            with self._engine.sending if self._engine is not None else nullcontext():
                self._send_last_rows()  # should the step end now, the main thread waits for this
        runner = self._activity.runners.get(error.instance or "")
        if runner is not None and self._activity.state != "initializing":
            error = error.at(runner.point, self._plan.grid.time(runner.point))
        try:
            report = NodeReport(self._plan.node, error.point or 0, error.report())
            self._membership.report(report, self._patience_s())
        except FmuMeshError as unreachable:
            log.warning("hang_not_reported", extra={"error": str(unreachable)})
            return False
        return True

    # --- before the first point

    def _load(self) -> None:
        plan = self._plan
        self._activity.enter("loading")
        instances = {}
        given = self._journal.given()
        for item in plan.instances:
            own, instance = given.get(item.name, ()), self._open_instance(item.name)
            instances[item.name] = with_times(instance, item, plan.grid, self._warn, own)
        self._activity.enter("waiting for the mesh")
        self._membership.keys(plan.timeouts.start)
        self._memory = self._membership.memory or self._own_memory
        for place in plan.rings:
            if place.instance in instances:
                ring, counter = self._memory.ring(place), self._memory.counter(place.counter)
                item = plan.instance(place.instance)
                self._runners[place.instance] = Runner(item, instances[place.instance], plan.grid, ring, counter)

    def _warn(self, message: LogMessage) -> None:
        point = message.step * self._plan.instance(message.instance).step_points
        self.server.log_message(LogLine(message.instance, message.status, message.category, message.message, point))

    def _meet(self) -> Welcome:
        """Join the mesh: afterwards all other nodes are ready."""
        try:
            self.server.serve(self._runners, self._membership.attempt, self._journal.last_point)
            welcome = self._membership.join()
        except MeshLost as error:
            if not self._membership.given_up:
                raise
            raise self._membership.without_master() from error
        self._heard = self._clock()
        self._profiler = Profiler(self._plan.node, welcome.profile) if welcome.profile else None
        return welcome

    def _connect(self, welcome: Welcome) -> None:
        """Connect the runners with the rings of their sources, and make links for what no ring carries."""
        plan, membership = self._plan, self._membership
        keys = membership.keys(plan.timeouts.start)
        self._ways = ways = welcome.ways
        if ways.way(plan.node, MASTER) == "zenoh" and not ways.streams_of(plan.node):
            self._inbox.receive_directly()
        for link in plan.links_out:
            runner = self._runners[link.source]
            put = membership.sender(keys.frames(link.source, link.target_node))
            layout = link.layout if ways.way(plan.node, link.target_node) == "zenoh" else of_text(link.layout)
            links = self._initialization.out_links if link.initial_only else runner.out_links
            links.append(OutLink(link, layout, runner.outputs, put))
        self._receivers, mirrors = connect(plan, self._runners, self._memory, self._own_memory, ways)
        if self._meeting is not None and ways.streams_of(plan.node):
            self._open_streams(self._meeting, mirrors)
        elif self._meeting is not None:
            self._meeting.close()  # nobody needs its door
        self._put_progress = membership.sender(keys.progress(plan.node))
        self._put_set = membership.sender(keys.settings(plan.node))

    def _initialize(self) -> Engine:
        """Initialization Mode: set, get and exchange values level by level; then the outputs are those of point 0."""
        self._activity.enter("initializing")
        plan = self._plan
        self._initialization.run(self._runners.values(), begins_with=self._begins_with)
        load_states(self._begins_with, self._runners, plan.attempt)
        units = [[self._runners[name] for name in names] for names in plan.units]
        self._engine = engine = self._make_engine(
            plan, units, self._memory, self._windows(), spins=not ONE_CORE, streams=self._streams
        )
        self._inbox.move_to(self._memory, engine)
        self._activity.steps_with(engine, self._ways, self._keeper, self._initialization.solved)
        for runner in self._runners.values():
            runner.begin()
            runner.flush()
        set_again(self._begins_with, self._runners)
        for news in (*self._initialization.noted, *self._journal.entries()):  # for the metadata of this attempt
            self._put_set(encode_news(news))
        self.server.started()
        self._memory.progress[plan.node].raise_to(engine.covered + 1)
        self._tell_progress(engine)
        return engine

    def _windows(self) -> Windows:
        """Whose progress is known here, and how far each may be behind; the master keeps the windows of the others.

        This node is one of them: an instance of it may not be a window ahead of the others.
        """
        ways, node, targets = self._ways, self._plan.node, self._plan.step_targets
        told = {name: counter for name, counter in self._own_memory.progress.items() if name in targets}
        known = {"ring": self._memory.progress, "stream": told}
        ways_of = {name: ways.way(node, name) if name != node else "ring" for name, _ in self._plan.windows}
        nodes = [
            (name, counters[name], window)
            for name, window in self._plan.windows
            if name in (counters := known.get(ways_of[name], {}))
        ]
        return [*nodes, *self.server.keys.windows]

    def _open_streams(self, meeting: Meeting, mirrors: Mapping[int, SourceRows]) -> None:
        """Use the sockets to those that were met; from now on each side notices if the other is silent."""
        plan, ways, memory = self._plan, self._ways, self._memory
        self._streams = streams = streams_of(
            plan, ways, meeting.sockets, self._runners, mirrors, memory, self._own_memory
        )
        self._keeper = StreamKeeper(streams, meeting, ways.streams_of(plan.node), self._inbox.post)

    def _stream_silent_s(self) -> float:
        return self._streams.silent_s(MASTER) if self._streams is not None else math.inf

    def _check_streams(self) -> None:
        """Look for what streams have brought, and whether each can still be used.

        Raises:
            FmuMeshError: one has brought what is no part of this run.
        """
        if self._streams is not None and (end := self._memory.finish.value):
            self._finish_at = end - 1
        for peer, state, about, row in self._streams.states() if self._streams is not None else ():
            if (error := why_not(peer, state, about, row, (*self._plan.links_in, *self._plan.links_out))) is not None:
                raise error
        if self._keeper is not None:
            try:
                self._keeper.check(self._plan.node, self._plan.timeouts.link)
            except MeshLost:
                if MASTER in self._keeper.cut:
                    self._membership.note_lost_link()
                raise

    # --- from point to point

    def _step_to_the_end(self, engine: Engine) -> None:
        """The loop of the module's docstring."""
        self._activity.enter("running")
        eager = any(link.has_frames for runner in self._runners.values() for link in runner.out_links)
        if self._profiler is not None:
            self._profiler.start(engine)
        is_quiet = not eager and self._profiler is None and self._ways.way(self._plan.node, MASTER) != "zenoh"
        left_s = 0.0
        while not self.finished:
            try:
                saves, has_more = self._saves_at >= 0, self._inbox.is_direct or self._inbox.has_posted
                wait_s = 0.0 if has_more else left_s if eager else _LONGEST_SLEEP_S
                quiet = is_quiet and not saves and self.server.is_unfollowed  # it sleeps then, even if it is eager
                stepped = engine.run(wait_s, eager=eager or saves, quiet=quiet)
            except (TerminationRequested, NotFinite) as asked:
                stepped = True
                self._end_early(engine, asked)
            self._check_streams()
            if self._clock() > self._look_at:
                self._look_at_router()
            with engine.sending:
                left_s = self._send_rows(engine)
            if stepped:
                self.server.stepped()
            self._tell_progress(engine)
            if self._inbox.is_direct and engine.is_blocked:
                began = time.perf_counter()
                message = self._inbox.wait(left_s)
                engine.note_wait(time.perf_counter() - began)
            else:
                message = self._inbox.poll()
            if self._profiler is not None:
                self._profiler.look(engine)
            while message is not None:
                self._inbox.hand_on(message, self._take_from_master, self._take_from_node)
                message = self._inbox.poll()
            if self._token_went and not self._membership.master_runs:
                self._end_without_master()
            self._membership.check_silence(self._clock() - self._heard)
            self.server.keys.check(self._memory.grant.value, self._clock())

    def _end_early(self, engine: Engine, asked: TerminationRequested | NotFinite) -> None:
        """An FMU ends the simulation: its unit stops stepping, and the master ends the run at its point."""
        runner = self._runners[asked.instance or ""]
        # The master has to know it before the progress of this node, which is beyond the grant then.
        if isinstance(asked, TerminationRequested):
            asked.at(last := runner.reached_by_all, self._plan.grid.time(last))
        self._tell_end(asked, self._plan.timeouts.stop)
        for member in next(unit for unit in engine.units if runner in unit):
            member.stop()
            member.flush()
        self._memory.progress[self._plan.node].raise_to(engine.covered + 1)

    def _send_rows(self, engine: Engine) -> float:
        """Send the rows that a step may wait for; return how long in s this node may wait until the next call.

        Those for the recorder are sent every 50 ms, and when the grant may depend on them. A node that waits for
        another node holds back less than a quarter of the window, so the other node can still step.
        """
        now, covered = time.monotonic(), engine.covered
        is_due = now - self._lazy_sent >= _LAZY_S or covered - self._lazy_covered >= self._plan.progress_stride
        if lazy := is_due or covered >= self._memory.grant.value:
            self._lazy_sent, self._lazy_covered = now, covered
        for runner in self._runners.values():
            runner.flush(lazy=lazy)
        self._send_states(self._saves_at)
        return _LONGEST_SLEEP_S if lazy else self._lazy_sent + _LAZY_S - now

    def _look_at_router(self) -> None:
        """If it was lost and is back, send again what may be lost. What others have got already does not matter."""
        self._look_at = self._clock() + _LOOK_S
        if self._router.endpoints and self._router.is_back:
            for runner in self._runners.values():
                runner.send_again()
            if self._progress_sent >= self._plan.grid.first_point:
                self._put_progress(HEADER.pack(PROGRESS, 0, 0, self._progress_sent))

    def _wait_for_message(self, left_s: float) -> None:
        if (message := self._inbox.wait(left_s)) is not None:
            self._inbox.hand_on(message, self._take_from_master, self._take_from_node)

    def _take_from_node(self, message: Message) -> None:
        sender, kind, number, count, point, data = message
        receiver = self._receivers.get(number)
        link = receiver.link if isinstance(receiver, FrameReceiver) else receiver
        if link is None or link.source_node != sender:
            raise MessageRefused(f"there is no link {number} from it to this node")
        if kind == FRAME and isinstance(receiver, FrameReceiver):
            if point <= receiver.received or not self._router.is_unsteady():  # else its source will send it again
                receiver.take(point, count, data)
        elif kind == INITIAL:
            self._initialization.take(link, point, data)
        else:
            raise MessageRefused(f"a message of kind {kind} is not one that a node sends")

    def _take_from_master(self, message: Message) -> None:
        _, kind, _, _, point, data = message
        if kind == GRANT:
            self._heard = self._clock()
            if self._ways.way(self._plan.node, MASTER) != "zenoh":
                return  # the grant itself comes another way; this is a sign of life
            if point > (most := self._progress_sent + self._plan.window):
                raise ProtocolBroken(
                    f"the master grants point {point} to node '{self._plan.node}', which may be granted {most} at most",
                    hint="Does another process send messages with its name?",
                )
            self._memory.grant.raise_to(min(point, self._plan.grid.last_point))
        elif kind == FINISH:
            self._finish_at = point
        elif kind == SAVE:
            self._send_states(point if self._plan.saves else -1)
        elif kind == ABORT:
            raise _Aborted(from_report(decode_json(data[HEADER.size :], ErrorReport)))
        elif kind == RESET:
            raise _Aborted(RunReset("the mesh is reset"), decode_json(data[HEADER.size :], NewStart))
        else:
            raise MessageRefused(f"a message of kind {kind} is not one that the master sends")

    def _tell_progress(self, engine: Engine) -> None:
        """Send the progress of this node to a master that cannot read it, if the grant may depend on it.

        A node that waits for another node sends nothing: the progress that it has not sent is less than a quarter of
        the window, so the other node can still step.
        """
        covered = engine.covered
        if self._ways.way(self._plan.node, MASTER) != "zenoh" or covered == self._progress_sent:
            return
        now = time.monotonic()
        due = covered - self._progress_sent >= self._plan.progress_stride or now - self._progress_told_at > _TELL_S
        if due or covered >= self._memory.grant.value:
            self._progress_sent = covered
            self._progress_told_at = now
            self._put_progress(HEADER.pack(PROGRESS, 0, 0, covered))

    def _send_states(self, at: int) -> None:
        """At the point of a checkpoint, beyond which the master grants nothing: send the states of all instances."""
        messages = state_messages(self._runners, at) if at >= 0 else None
        self._saves_at = at if messages is None else -1
        for message in messages or ():
            self._put_progress(message)

    # --- the end

    def _master_token_went(self) -> None:
        """On a thread of Zenoh: the token of the master is gone, or a token with its key from another process."""
        if not self.finished:
            self._token_went = True
            self._inbox.post(self._end_without_master)

    def _end_without_master(self) -> None:
        """The master's token is gone: raise why it ended the run, which may still arrive, or that it is gone."""
        if not self._membership.master_is_gone:
            self._token_went = self._membership.doubts_master  # then it is asked again
            return
        error = self._membership.without_master(self._clock() - self._heard)
        deadline = time.monotonic() + _LAST_WORD_S
        while not self.finished and (left := deadline - time.monotonic()) > 0:
            self._wait_for_message(left)
        if not self.finished:
            raise error

    def _located(self, error: FmuMeshError) -> FmuMeshError:
        """The error with the point and time of its instance."""
        if isinstance(error, _Aborted):
            return error.cause
        runner = self._runners.get(error.instance or "")
        if runner is not None and isinstance(error, StepFailed) and error.point is None:
            return error.at(runner.point, self._plan.grid.time(runner.point))
        return error

    def _send_last_rows(self) -> None:
        """The run ends early, here or elsewhere: send the recorder the remaining rows, and that no more come."""
        running = self._activity.state == "running"
        try:
            for runner in self._runners.values():
                runner.send_last(runner.step + 1 if running else 0)
            if self._streams is not None and self._ways.way(self._plan.node, RECORDER) == "stream":
                for link in self._plan.links_out:
                    if link.target_node == RECORDER:
                        self._streams.say_last(link.index)
        except FmuMeshError as unreachable:
            log.info("last_rows_not_sent", extra={"error": str(unreachable)})

    def _report_failure(self, error: FmuMeshError) -> bool:
        """Report the failure to the master, unless the master is gone; return whether it knows now."""
        self._activity.enter("failed")
        if self._membership.lost_master:
            return not self._membership.lost_link
        self.server.say_everything()
        try:
            self._tell_end(self._activity.as_others_see(error), self._patience_s())
        except FmuMeshError as unreachable:
            log.info("failure_not_reported", extra={"error": str(unreachable)})
            return self._has_no_master()
        return True

    def _patience_s(self) -> float:
        return min(self._plan.timeouts.stop, math.inf if self._membership.is_admitted else _NO_MASTER_S)

    def _tell_end(self, error: FmuMeshError | None, timeout_s: float) -> None:
        point = min((runner.point for runner in self._runners.values()), default=0)
        profile = self._profiler.profile() if self._profiler is not None and error is None else None
        report = NodeReport(self._plan.node, point, error.report() if error is not None else None, profile)
        # After the last samples: the master routes them to clients, and ends when it has all reports.
        self._membership.report(report, timeout_s, self._is_cut_off, priority=PRIORITY)

    def _is_cut_off(self) -> bool:
        """Whether no answer of the master can come: it is gone, or the link to its host has been silent too long."""
        silent_s = self._clock() - self._heard if self._heard else 0.0
        return (silent_s > self._plan.timeouts.link and not self._membership.master_runs) or self._has_no_master()

    def _has_no_master(self) -> bool:
        return self._token_went and self._membership.master_is_gone


class _Aborted(FmuMeshError):
    """The master ended the run; contains the reason, and how this node begins again, if it does."""

    def __init__(self, cause: FmuMeshError, new_start: NewStart | None = None) -> None:
        super().__init__(cause.message)
        self.cause = cause
        self.new_start = new_start
