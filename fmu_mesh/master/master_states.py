"""What the master of one run decides: a state machine that waits for nothing, sends nothing and reads no clock.

::

    starting        until every node is ready                    -> answer them all
    initializing    until every node is at point 0               (Initialization Mode is over)
    running/paused  until every node is at the last point, or at the one where an FMU ends the simulation:
                    grant it                                     (less if the wall clock or a pause limits it)
    stopping        until all nodes have reported their end
    done/failed
"""

# WHY events only store facts, and `decide` alone draws conclusions:
#
# Everything that happens to a run can happen in any order, and two of it in one turn: a node fails after its last step
# while another is lost, a command arrives with the report of an FMU that ends the simulation, a node reports its end
# before the memory shows its last point. When each handler acted on its own, each pair needed its own care. Now the
# caller reports all that has arrived, and then calls `decide` once. So the order within one turn matters only where
# it is a question of who was first: the first failure is the reason of the run.
#
# What may go wrong, and is decided here:
#   - A node is at a point that nobody has granted to it: another process sends with its name, or the node is broken.
#     The run ends, because all values may be wrong (ADR 0008). A malformed message only counts as refused; it never
#     comes here.
#   - A node ends although the run goes on: the same.
#   - A node fails or is lost after its last step. If all rows are recorded, that is a warning (`_end_of`).
#   - A pause must not run over nodes that step right now. So the caller first takes back the grant in the memory, and
#     gives the point that a node may already have claimed (`command`, ADR 0058). A grant that was sent as a message
#     cannot be taken back, so `Granting` sends it only a little ahead.
#   - Nothing moves. While the grant is ahead of the slowest node, that is a deadline. While the wall clock or a pause
#     holds the grant, it is none, and the clock of the deadline begins again with each grant. Times are of an
#     `AwakeClock`, so a host that was suspended goes on (ADR 0067).

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

import msgspec
from msgspec.structs import replace

from ..config.deadlines import Deadlines
from ..errors import (
    DeadlineExceeded,
    FmuMeshError,
    Interrupted,
    MeshLost,
    NotFinite,
    ProtocolBroken,
    RunReset,
    TerminationRequested,
    from_report,
)
from ..system.placement import placed
from ..system.plan import RECORDER, Plan
from ..wire.host_processes import OR_CUT
from ..wire.messages import FINISH, GRANT, SAVE, NodeReport
from ..wire.views import GOING_ON, Command, CommandAnswer, MeshState
from .actions import Action, AnswerAll, Commanded, EndAll, FollowClock, RaiseGrant, RaiseSent, SendToAll
from .granting import Granting
from .registrations import Registrations, spoken

__all__ = ["MasterStates"]


class _Course(msgspec.Struct, frozen=True):
    """Where the mesh pauses; after a restart, the last point that was seen before, and where it was stopped.

    And where all nodes save their states.
    """

    hold: int | None
    replays_to: int
    stopped_at: int | None
    saves_at: int | None = None


class MasterStates:
    """The state of one run, as its master sees it.

    Attributes:
        registrations: which nodes have registered. Its methods are events, too.
        granting: the grant, and the progress of the nodes.
        reports: how nodes have ended, by name.
        failure: why the run fails.
        ended_by: why the simulation ends before its last point, and not at once.
        warnings: nodes that failed or were lost after their last step.

    Call sequence: any events, then `decide` and do what it says until it says nothing; then wait for events, for at
    most as long as a heartbeat.
    """

    def __init__(
        self, plan: Plan, *, paused: bool = False, replays_to: int = 0, commanded: Commanded | None = None
    ) -> None:
        self.plan = plan
        self.state: MeshState = "starting"
        self.deadlines = Deadlines.of(
            plan.system.config.timeouts,
            max(len(node.instances) for node in plan.nodes.values()),
            waits_for_program=any(own.section.waits_for_program for n in plan.nodes.values() for own in n.instances),
        )
        self.registrations = Registrations(plan)
        self.granting = Granting(plan)
        again = commanded or Commanded("", plan.grid.first_point if paused else None)
        self._course = _Course(again.hold, replays_to, again.stopped_at)
        self.reports: dict[str, NodeReport] = {}
        self.failure: FmuMeshError | None = None
        self.ended_by: TerminationRequested | NotFinite | None = None
        self.warnings: list[str] = []
        self._actions: list[Action] = []
        self._entered_at = 0.0
        self._moved_at: float | None = None  # when any node has moved; None: since the last decision
        self._slowest_moved_at: float | None = None
        self._sent_at = 0.0

    @property
    def hold(self) -> int | None:
        """The point at which all nodes pause."""
        return self._course.hold

    @hold.setter
    def hold(self, point: int | None) -> None:
        self._course = replace(self._course, hold=point)

    @property
    def saves_at(self) -> int | None:
        """The point at which all nodes save their states, if they do; beyond it, nothing is granted until then."""
        return self._course.saves_at

    @property
    def is_over(self) -> bool:
        """Whether there is nothing more to decide."""
        return self.state in ("done", "failed")

    @property
    def takes_commands(self) -> bool:
        """Whether `command` may be called."""
        return self.state in ("running", "paused")

    @property
    def moves(self) -> bool:
        """Whether nodes may step: its wall-clock time counts."""
        return self.takes_commands and self.granting.slowest < self.wanted

    @property
    def rests(self) -> bool:
        """Whether all nodes have reached the point of a pause."""
        return self.state == "paused" and self.hold is not None and self.granting.slowest >= self.hold

    @property
    def wanted(self) -> int:
        """The point that is granted if the wall clock allows it."""
        course = self._course  # once: the recorder asks on its own thread
        limits = [self.granting.last_point, course.hold, course.saves_at]
        if self.is_replaying and self.plan.system.config.simulation.real_time_factor > 0.0:
            limits.append(course.replays_to)
        return min(limit for limit in limits if limit is not None)

    @property
    def is_replaying(self) -> bool:
        """Whether the run has not yet come to where it was before a restart."""
        return self._course.replays_to > 0 and self.granting.slowest < self._course.replays_to

    def silent_s(self, now: float) -> float:
        """For how long there was no progress although there should have been some, in s."""
        return now - self._moved_at if self._waits and self._moved_at is not None else 0.0

    def slowest_silent_s(self, now: float) -> float:
        """For how long the slowest node has not moved, in s: others may go on for as long as the window lets them."""
        return now - self._slowest_moved_at if self._waits and self._slowest_moved_at is not None else 0.0

    @property
    def _waits(self) -> bool:
        return self.takes_commands and self.hold is None and self.granting.slowest < self.granting.grant

    # --- events

    def progress(self, reported: Iterable[tuple[str, int]]) -> list[tuple[str, int]]:
        """Nodes, by name, know all outputs up to a point; returns those of which it is news."""
        before = self.granting.slowest
        try:
            news = self.granting.take(reported)
        except ProtocolBroken as error:
            self.fail(error)
            return []
        if news:
            self._moved_at = None
        if self.granting.slowest > before:
            self._slowest_moved_at = None
        return news

    def excuse(self, now: float) -> None:
        """A link is cut: that nobody moves or reports is no fault, until the link has been silent for too long."""
        self._moved_at = self._slowest_moved_at = None
        self._entered_at = now

    def report(self, report: NodeReport) -> None:
        """A node reports its end, or that an FMU ends the simulation."""
        node, granting = report.node, self.granting
        error = from_report(report.error) if report.error is not None else None
        if isinstance(error, TerminationRequested) or (isinstance(error, NotFinite) and error.point):
            # Its node continues with its other instances, and reports again at the end.
            last = error.last_point
            if last is not None and error.instance in self.plan.ahead:  # others lack its next row, and stay before it
                last -= last % self.plan.system.instances[error.instance].step_points
            if last is None or not granting.may_be_at(node, last):
                self.fail(granting.broken(node, f"has an FMU that ends the simulation at point {last}"))
            elif last < granting.last_point:
                self._end_at(last, error)
        elif error is None and self.state in GOING_ON:
            self.fail(granting.broken(node, f"has ended at point {report.point}"))
        else:
            self.reports[node] = report
            if error is not None:
                self._end_of(node, error)

    def lose(self, node: str, loss: str | None = None) -> None:
        """The process of a node is gone, with a router if there is a ``loss``; matters until the node has reported."""
        if node in self.reports:
            return
        why = f"{spoken(node)} was lost: its process does not answer any more"
        if node not in self.granting.seen:  # only Zenoh says so
            why += OR_CUT
        why = why if loss is None else f"{loss}, and {spoken(node)} with it"
        point = max(self.granting.progress[node], 0)
        error = MeshLost(why, instance=self.granting.instances_of(node))
        self._end_of(node, error.at(point, self.plan.grid.time(point)))

    def command(self, command: Command, claimed: int) -> CommandAnswer:
        """Handle pause, resume, step N and stop, which only change the grant, and reset, which ends the run.

        Only while it `takes_commands`. No node of this host passes ``claimed`` until the grant is raised again.
        """
        granting, before, rested = self.granting, self.hold, self.rests
        self.hold = point = granting.halt(claimed)
        self._actions.append(RaiseGrant(point))
        match command.command:
            case "pause":
                self.state = "paused"
            case "resume":
                self.state, self.hold = "running", None
            case "step":
                self.state, self.hold = "paused", (point if before is None else before) + max(1, command.points)
            case "stop":
                self._stop(point)
            case "reset":
                self.hold, slowest = before, granting.slowest
                text = f"reset by a command at point {slowest}"
                self.fail(RunReset(text, point=slowest, time=self.plan.grid.time(slowest)))
        if command.command in ("resume", "step"):
            self._actions.append(FollowClock(granting.reached, command.paced and not self.is_replaying))
        self._moved_at = self._slowest_moved_at = None
        if self.hold is not None and not rested:  # a message to all: the recorder may sleep until there are many rows
            self._sent_at = -math.inf
        where = (granting.slowest, self.hold) if command.command != "reset" else (0, None if before is None else 0)
        return CommandAnswer(command.command, self.state, *where)

    def save(self, claimed: int, every: int) -> bool:
        """Hold all nodes at the next multiple of ``every`` points, until `saved`; False if they do not come there.

        Only while it `takes_commands`. ``claimed`` is as in `command`.
        """
        at = -(-self.granting.halt(claimed) // every) * every
        self._moved_at = self._slowest_moved_at = None
        self._actions.append(RaiseGrant(self.granting.grant))
        if at <= self.wanted:
            self._course = replace(self._course, saves_at=at)
            self._actions.append(SendToAll(SAVE, at))
        return at <= self.wanted

    def saved(self) -> None:
        """The nodes have saved their states, or need not: they go on."""
        self._course = replace(self._course, saves_at=None)
        self._moved_at = self._slowest_moved_at = None

    def fail(self, error: FmuMeshError) -> None:
        """The run has to end; the first reason counts."""
        if self.failure is None:
            self.failure = placed(self.plan, error)

    def _stop(self, point: int) -> None:
        """End the run: where a pause would be if it has no stop time, otherwise as an interruption."""
        grid, slowest, self.hold = self.plan.grid, self.granting.slowest, None
        if grid.stop_time is not None:
            text = f"stopped by a command before its stop time of {grid.stop_time:.12g} s"
            self.fail(Interrupted(text, point=slowest, time=grid.time(slowest)))
        elif self.ended_by is None:
            text = "stopped by a command, the normal end of a run without a stop time"
            self._end_at(point, TerminationRequested(text, point=point, time=grid.time(point)))

    def _end_at(self, point: int, error: TerminationRequested | NotFinite) -> None:
        self.ended_by = error
        self.granting.end_at(point)

    def _end_of(self, node: str, error: FmuMeshError) -> None:
        """A node has failed or is lost. If all rows are recorded, the run is done, and this is a warning."""
        granting = self.granting
        if granting.slowest < granting.last_point or node == RECORDER:
            self.fail(error)
        else:
            self.reports.setdefault(node, NodeReport(node, granting.last_point))
            hint = "Its FMU was in terminate or freeInstance. " if isinstance(error, MeshLost) else ""
            self.warnings.append(str(error.with_hint(f"{hint}All rows are recorded.")))

    # --- what follows from them

    def decide(self, now: float, paced: int, stopped: Sequence[str] = ()) -> list[Action]:
        """What to do now; nothing, if it is to wait.

        ``now`` is in seconds since the start in which this process could run, ``paced`` the point that the wall clock
        allows, and ``stopped``, if `slowest_silent_s` exceeds its deadline, the nodes whose processes are stopped.
        """
        if self._moved_at is None:
            self._moved_at = now
        if self._slowest_moved_at is None:
            self._slowest_moved_at = now
        # What a command has decided is done first: the wall clock that limits the grant may begin anew with it.
        if self.failure is None and not self._actions:
            match self.state:
                case "starting":
                    self._wait_for_nodes(now)
                case "initializing":
                    self._wait_for_initialization(now)
                case "running" | "paused":
                    self._go_on(now, paced, stopped)
                case "stopping":
                    self._wait_for_reports(now)
                case _:
                    pass
        if self.failure is not None and self.state != "failed":
            self.state = "failed"
            self._actions.append(EndAll(self.failure))
        actions, self._actions = self._actions, []
        return actions

    def _wait_for_nodes(self, now: float) -> None:
        registrations = self.registrations
        if not registrations.missing:
            ways = registrations.ways()
            self.granting.go(ways)
            self._actions.append(AnswerAll(ways))
            self._enter("initializing", now)
        elif now - self._entered_at > self.deadlines.start:
            self.fail(registrations.absence(self.deadlines.start))

    def _wait_for_initialization(self, now: float) -> None:
        if self.granting.has_begun:
            self._enter("running" if self.hold is None else "paused", now)
            self._actions.append(FollowClock(self.granting.first_point, paced=not self.is_replaying))
            if self._course.stopped_at is not None and self.plan.grid.stop_time is None:
                self._stop(self._course.stopped_at)
            self._moved_at = self._slowest_moved_at = now
            return
        first = self.granting.first_point
        missing = [node for node, point in self.granting.progress.items() if point < first]
        self._check_deadline(now, self.deadlines.initialize, "Initialization Mode is not over in", missing)
        self._send_grant(now)

    def _go_on(self, now: float, paced: int, stopped: Sequence[str]) -> None:
        granting = self.granting
        if self._course.replays_to and not self.is_replaying:
            self._course = replace(self._course, replays_to=0)
            self._actions.append(FollowClock(granting.reached))
            return  # ``paced`` is from before: nothing limited it
        stopped_at = self._course.stopped_at if self.plan.grid.stop_time is not None else None
        if stopped_at is not None and not self.is_replaying:
            self._stop(stopped_at)
            return
        if granting.slowest >= granting.last_point and self.saves_at is None:
            if isinstance(self.ended_by, NotFinite):
                self.fail(self.ended_by)
            else:
                self._enter("stopping", now)
                self._send_finish(now)
            return
        grant = granting.led(min(self.wanted, paced), now)
        if grant > granting.grant:
            if granting.slowest >= granting.grant:  # they had nothing to do until now, because of the wall clock
                self._moved_at = self._slowest_moved_at = now
            granting.raise_to(grant)
            self._actions.append(RaiseGrant(grant))
        self._send_grant(now)
        silent_s = self.slowest_silent_s(now) if stopped else self.silent_s(now)
        if silent_s > (self.deadlines.step if stopped else self.deadlines.silence):
            self.fail(granting.no_progress(silent_s, stopped))

    def _wait_for_reports(self, now: float) -> None:
        if missing := [node for node in self.plan.nodes if node not in self.reports]:
            self._check_deadline(now, self.deadlines.stop, "the end was not reported by", missing)
            if now - self._sent_at >= self.deadlines.heartbeat:  # a router that was lost has passed nothing on
                self._send_finish(now)
        else:
            self.state = "done"

    def _send_grant(self, now: float) -> None:
        """Send the grant to nodes that cannot read it, and to all as a sign that the master lives."""
        owed, grown = self.granting.owed(now)
        if grown:
            self._actions.append(RaiseSent(owed))
        if (grown and self.granting.messages) or now - self._sent_at >= self.deadlines.heartbeat:
            self._sent_at = now
            self._actions.append(SendToAll(GRANT, owed))

    def _send_finish(self, now: float) -> None:
        self._sent_at = now
        self._actions.append(SendToAll(FINISH, self.granting.last_point))

    def _check_deadline(self, now: float, limit_s: float, what: str, missing: Sequence[str]) -> None:
        if now - self._entered_at > limit_s:
            self.fail(DeadlineExceeded(f"{what} {self.registrations.named(*missing)} within {limit_s:g} s"))

    def _enter(self, state: MeshState, now: float) -> None:
        self.state, self._entered_at = state, now
