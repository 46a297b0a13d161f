"""The node: from a plan to the last communication point.

One step of a node, in pseudocode::

    while an instance has steps left:
        for unit in units:                      # in the order of the plan
            step as far as k < grant and the inputs allow, for at most one burst (about 1 ms)
            send the frames that are full, or whose burst is over
        handle the messages that arrived: frames go into the input rings, a higher grant is stored
        if nothing was stepped:
            send all frames, send the progress to the master, wait for the next message

Owns the life of the process between `ready` and `done`. The FMUs are only called here, on the main thread; queries are
served by `fmu_mesh.node.node_server` from snapshots.
"""

from __future__ import annotations

import logging
import sys
import time
from collections.abc import Callable

import zenoh

from ..errors import (
    DeadlineExceeded,
    FmuError,
    FmuMeshError,
    Interrupted,
    MeshLost,
    MessageRefused,
    ProtocolBroken,
    StepFailed,
    TerminationRequested,
    from_report,
)
from ..instances.contract import Instance
from ..system.plan import NodePlan
from ..wire.frames import FrameReceiver
from ..wire.inbox import Inbox, Message
from ..wire.keys import MASTER
from ..wire.membership import Membership, shared_inbox
from ..wire.messages import (
    ABORT,
    FINISH,
    FRAME,
    GRANT,
    HEADER,
    INITIAL,
    PROGRESS,
    NodeReport,
    decode_abort,
)
from ..wire.session import RouterLink
from .activity import Activity
from .initialization import Initialization
from .inputs import TimedInputs
from .links import OutLink
from .node_server import NodeServer
from .stepping import LAZY_S, RemoteFeed, Runner, Unit, connect_feeds
from .streams import PRIORITY
from .time_measurement import Calls, Profiler

__all__ = ["Node"]

log = logging.getLogger(__name__)

_LOOK_S = 0.5
_TELL_S = 0.1
_LAST_WORD_S = 0.3
_ALONE_S = 60.0
_NO_MASTER_S = 1.0
"""How long in s the report of a failure waits for a master that was never seen."""

_NO_FEEDS: tuple[None, list[RemoteFeed]] = (None, [])


class Node:
    """One node of a mesh.

    Args:
        plan: what it has to do.
        session: the session of this process; the caller closes it.
        open_instance: opens an instance of the plan by name; the caller closes the instances too.
        on_hang: called on another thread if a step does not return in time.
        router: the link to the router that connects this node to the others, if there is one.
        launch: the launcher that started this process; None if it was started manually.

    Attributes:
        failure_is_known: whether others know what ended the run: the master knows it, or is gone.

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
    ) -> None:
        self._plan = plan
        self._session = session
        self._open_instance = open_instance
        self._grant = 0
        self._finished = False
        self.failure_is_known = False
        self._heard = time.monotonic()
        self._lazy_flushed = 0.0
        self._lazy_pending = False
        self._waited_long = False
        self._progress_sent = -1
        self._progress_told_at = 0.0
        self._runners: dict[str, Runner] = {}
        self._units: list[Unit] = []
        self._remote: dict[int, tuple[FrameReceiver, list[RemoteFeed]]] = {}
        self._initialization = Initialization(plan, self._wait_for_initial_value)
        self._inbox = Inbox(shared_inbox(plan, spins=True))
        self._membership = Membership(plan, session, self._inbox, launch, router)
        self._profiler: Profiler | None = None
        self._calls = Calls(self._inbox.poll, self._sort_in)
        self._activity = Activity(plan, self._inbox.refusals)
        self.server = NodeServer(plan, session, self._inbox, self._activity, self._membership.report, on_hang)

    def run(self) -> None:
        """Load, initialize and step to the last point, then report to the master.

        Raises:
            FmuMeshError: why the run ended early; it was reported to the master if the master could be reached.
        """
        try:
            self._membership.register(self.server.open, self._master_token_went)
            self._load()
            self._meet()
            self._connect()
            self._initialize()
            self._step_to_the_end()
            self.server.close()  # the last samples, while the master is there to route them to clients
            for runner in self._runners.values():
                runner.instance.close()  # before the report, so that the report can contain its error
            self._tell_end(None, self._plan.timeouts.stop)
        except FmuMeshError as error:
            located = self._located(error)
            aborted = isinstance(error, _Aborted)
            if aborted or not self._membership.lost_master:  # its token may be gone before its last message arrives
                self._send_last_rows()
            self.failure_is_known = aborted or self._report_failure(located)
            raise located from error
        finally:
            self.server.close()
            self._membership.close()
            self._inbox.close()

    def interrupt(self, reason: str) -> None:
        """From any thread: end the run with `Interrupted` at the next point or during the current wait."""
        self._inbox.post(lambda: _raise(Interrupted(reason)))

    def report_hang(self, error: FmuError) -> bool:
        """On a watching thread, while an FMU does not return: report to the master; return whether it knows now."""
        if (unit := self._activity.advancing) is not None and not self._membership.lost_master:
            unit.meanwhile(self._send_last_rows)  # should the step end now, the main thread waits for this
        elif self._activity.state == "running" and not self._membership.lost_master:
            sys.setswitchinterval(_ALONE_S)  # as above
            self._send_last_rows()
        return self.server.report_hang(error, self._patience_s())

    # --- before the first point

    def _load(self) -> None:
        """Instantiate the FMUs, and connect rings, feeds and links."""
        plan = self._plan
        self._activity.state = "loading"
        for item in plan.instances:
            instance = self._open_instance(item.name)
            if item.section.interpolation is not None:
                instance = TimedInputs(instance, item.section.interpolation)
            self._runners[item.name] = Runner(item, instance, plan.grid, plan.ring_rows)
        self._remote = connect_feeds(plan, self._runners)
        self._units = [Unit([self._runners[name] for name in names]) for names in plan.units]

    def _meet(self) -> None:
        """Join the mesh: afterwards all other nodes are ready."""
        self._activity.state = "waiting for the mesh"
        try:
            self._membership.keys(self._plan.timeouts.start)
            self.server.serve(self._runners)
            welcome = self._membership.join()
        except MeshLost as error:
            if not self._membership.given_up:
                raise
            raise self._membership.without_master() from error
        self._heard = time.monotonic()
        if welcome.profile:
            self._profiler = Profiler(self._plan.node, welcome.profile, self._plan.window)

    def _connect(self) -> None:
        """Create the senders to the other nodes and to the master."""
        plan, membership = self._plan, self._membership
        keys = membership.keys(plan.timeouts.start)
        for link in plan.links_out:
            runner = self._runners[link.source]
            put = membership.sender(link.target_node, keys.frames(link.source, link.target_node))
            if link.initial_only:
                self._initialization.out_links.append(OutLink(link, runner.outputs, put, plan.window))
            elif self._profiler is not None:
                runner.out_links.append(self._profiler.link(link, runner.outputs, put))
            else:
                runner.out_links.append(OutLink(link, runner.outputs, put, plan.window))
        self._calls = self._calls._replace(put_progress=membership.sender(MASTER, keys.progress(plan.node)))
        if self._profiler is not None:
            self._units = self._profiler.measured_units(self._units)
            self._calls = self._profiler.measured_calls(self._calls)

    def _initialize(self) -> None:
        """Initialization Mode: set, get and exchange values level by level; then the outputs are those of point 0."""
        self._activity.state = "initializing"
        grid = self._plan.grid
        for runner in self._runners.values():
            stop_time = grid.told_stop_time(runner.plan.step_points)
            runner.instance.enter_initialization(grid.start_time, stop_time, runner.plan.start_values)
        self._initialization.run(self._runners.values())
        for runner in self._runners.values():
            runner.instance.exit_initialization()
            runner.bind()
            runner.flush()
        self.server.started()
        self._tell_progress()

    def _wait_for_initial_value(self, left_s: float) -> None:
        if (message := self._inbox.wait(left_s)) is not None:
            self._calls.take(message)

    # --- from point to point

    def _step_to_the_end(self) -> None:
        """The loop of the module's docstring."""
        self._activity.state = "running"
        poll, take = self._calls.poll, self._calls.take
        if self._profiler is not None:
            self._profiler.start()
        while not self._finished:
            stepped = False
            for unit in tuple(self._units):
                self._activity.advancing = unit
                try:
                    stepped = unit.advance(self._grant) or stepped
                except TerminationRequested as asked:
                    self._end_early(unit, asked)
            self._activity.advancing = None
            taken = False
            while (message := poll()) is not None:
                take(message)
                taken = True
            if stepped:
                self._tell_progress()
                self.server.stepped()
            elif not taken:
                self._flush_before_waiting()
                self._tell_progress()
                self._wait()

    def _end_early(self, unit: Unit, asked: TerminationRequested) -> None:
        """An FMU asks to end the simulation: its unit stops stepping, and the master ends the run at its point."""
        self._units.remove(unit)
        point = self._runners[asked.instance or ""].covered
        for runner in unit.runners:
            runner.last_step = runner.step
            runner.flush()
        self._tell_end(asked.at(point, self._plan.grid.time(point)), self._plan.timeouts.stop)

    def _flush_before_waiting(self) -> None:
        """Send rows that a consumer may wait for; rows that are only recorded every 50 ms, and at the end."""
        now = time.monotonic()
        done = self._covered() == self._plan.grid.last_point
        lazy = done or self._waited_long or now - self._lazy_flushed > LAZY_S
        if lazy:
            self._lazy_flushed = now
        for runner in self._runners.values():
            runner.flush(lazy=lazy)
        self._lazy_pending = not lazy

    def _wait(self) -> None:
        """Wait for one message; no instance can step before it arrives."""
        started = time.monotonic()
        self._activity.waiting = True
        message = self._inbox.wait(LAZY_S if self._lazy_pending else _LOOK_S)
        self._activity.waiting = False
        self._waited_long = message is None
        if self._profiler is not None:
            self._profiler.waited(time.monotonic() - started, running=self._grant > 0)
        if message is not None:
            self._calls.take(message)
        now = time.monotonic()
        self._activity.waited_s += now - started
        if now - self._heard > self._plan.timeouts.step:
            text = f"the master has said nothing for {now - self._heard:.1f} s"
            raise DeadlineExceeded(text, hint="Is its process stopped, or its host gone?")

    def _sort_in(self, message: Message) -> None:
        """Put a frame into the rings, or store a new grant; any other message is refused."""
        self._inbox.hand_on(message, self._take_from_master, self._take_from_node)

    def _take_from_node(self, message: Message) -> None:
        sender, kind, number, count, point, data = message
        receiver, feeds = self._remote.get(number, _NO_FEEDS)
        if receiver is None or receiver.link.source_node != sender:
            raise MessageRefused(f"there is no link {number} from it to this node")
        if kind == FRAME:
            new = receiver.take(point, count, data)
            if new is not None:
                first, rows = new
                for feed in feeds:
                    feed.transfer.from_rows(first, rows)
                    feed.ready = feed.transfer.ready(receiver.received)
        elif kind == INITIAL:
            self._initialization.take(receiver.link, point, data)
        else:
            raise MessageRefused(f"a message of kind {kind} is not one that a node sends")

    def _take_from_master(self, message: Message) -> None:
        _, kind, _, _, point, data = message
        if kind == GRANT:
            most = self._progress_sent + self._plan.window
            if point > most:
                raise ProtocolBroken(
                    f"the master grants point {point} to node '{self._plan.node}', which may be granted {most} at most",
                    hint="Does another process send messages with its name?",
                )
            self._heard = time.monotonic()
            self._grant = max(self._grant, min(point, self._plan.grid.last_point))
        elif kind == FINISH:
            self._finished = True
        elif kind == ABORT:
            raise _Aborted(from_report(decode_abort(data)))
        else:
            raise MessageRefused(f"a message of kind {kind} is not one that the master sends")

    def _covered(self) -> int:
        return min(runner.covered for runner in self._runners.values())

    def _tell_progress(self) -> None:
        """Send the progress of this node to the master, if the grant may depend on it or a status needs it.

        A node that waits for another node sends nothing: the progress that it has not sent is less than a quarter of
        the window, so the other node can still step.
        """
        covered = self._covered()
        if covered == self._progress_sent:
            return
        now = time.monotonic()
        due = covered - self._progress_sent >= self._plan.progress_stride or now - self._progress_told_at > _TELL_S
        if due or covered >= self._grant:
            self._progress_sent = covered
            self._progress_told_at = now
            self._calls.put_progress(HEADER.pack(PROGRESS, 0, 0, covered))

    # --- the end

    def _master_token_went(self) -> None:
        """On a thread of Zenoh: the token of the master is gone, or a token with its key from another process."""
        if not self._finished:
            self._inbox.post(self._end_without_master)

    def _end_without_master(self) -> None:
        """The master's token is gone; its last message may still arrive.

        Raises:
            FmuMeshError: why the master ended the run, or that the master is gone.
        """
        if not self._membership.master_is_gone:
            return
        error = self._membership.without_master()
        deadline = time.monotonic() + _LAST_WORD_S
        while not self._finished and (left := deadline - time.monotonic()) > 0:
            if (message := self._inbox.wait(left)) is not None:
                self._calls.take(message)
        if not self._finished:
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
        except FmuMeshError as unreachable:
            log.info("last_rows_not_sent", extra={"error": str(unreachable)})

    def _report_failure(self, error: FmuMeshError) -> bool:
        """Report the failure to the master, unless the master is gone; return whether it knows now."""
        self._activity.advancing = None
        self._activity.state = "failed"
        if self._membership.lost_master:
            return True
        self.server.say_everything()
        try:
            self._tell_end(self._as_others_see(error), self._patience_s())
        except FmuMeshError as unreachable:
            log.info("failure_not_reported", extra={"error": str(unreachable)})
            return False
        return True

    def _as_others_see(self, error: FmuMeshError) -> FmuMeshError:
        """The error as other processes see it: if a signal ends this process, for them this node is lost."""
        if not isinstance(error, Interrupted):
            return error
        point = min((runner.point for runner in self._runners.values()), default=0)
        return MeshLost(
            f"node '{self._plan.node}' was lost: its process was told to end ({error.message})",
            instance=", ".join(item.name for item in self._plan.instances),
            point=point,
            time=self._plan.grid.time(point),
        )

    def _patience_s(self) -> float:
        """How long in s a report of a failure may take."""
        stop_s = self._plan.timeouts.stop
        return stop_s if self._membership.is_admitted else min(stop_s, _NO_MASTER_S)

    def _tell_end(self, error: FmuMeshError | None, timeout_s: float) -> None:
        point = min((runner.point for runner in self._runners.values()), default=0)
        profile = self._profiler.profile() if self._profiler is not None and error is None else None
        report = NodeReport(self._plan.node, point, error.report() if error is not None else None, profile)
        # After the last samples: the master routes them to clients, and ends when it has all reports.
        self._membership.report(report, timeout_s, priority=PRIORITY)


class _Aborted(FmuMeshError):
    """The master ended the run; contains the reason."""

    def __init__(self, cause: FmuMeshError) -> None:
        super().__init__(cause.message)
        self.cause = cause


def _raise(error: FmuMeshError) -> None:
    raise error
