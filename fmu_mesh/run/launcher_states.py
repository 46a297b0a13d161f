"""What the launcher decides: a state machine without I/O. Events go in, actions come out.

It knows no process, no pipe and no clock: each call says what time it is. `fmu_mesh.run.launcher` waits and does.
"""

# The phases of a run, in their order; each may be skipped:
#
#   RUNNING         until there is an outcome and the master has ended, or there is a reason not to wait for one
#   LEAVING         the processes end by themselves; nothing more is started
#   TERMINATED      those left have got SIGTERM
#   KILLED          those left have got SIGKILL
#   SERVER_LEAVING  the fork server ends by itself after its last process
#   SERVER_KILLED   it did not; what it knew of exit codes is lost
#   OVER
#
# Why so many things are known twice (that a process has ended: by `ended` and by `seen`; that a node is lost: by the
# master and by its exit code): each of the two may be missing or late. An exit code comes through the fork server,
# which may be stopped or killed; `ended` waits for the pipes, which an FMU may have given to a process of its own; a
# master that is stopped reports nothing. The first that comes counts, and the master's words win if they come in time,
# because only it knows the point.
#
# Silence counts only while nothing waits to be handled (`quiet`). Otherwise a launcher that was stopped, or
# is slow, would take its own delay for that of the master.

from __future__ import annotations

import math
import signal
from collections.abc import Collection, Mapping, Sequence
from enum import IntEnum

from msgspec import Struct

from ..config.deadlines import Deadlines
from ..errors import DeadlineExceeded, FmuError, FmuMeshError, Interrupted, MeshLost, from_report
from ..wire.host_processes import OR_CUT, STOPPED
from ..wire.views import GOING_ON, MeshStatus
from .child import how_it_ended
from .events import Event, Status
from .outcome import Outcome

__all__ = [
    "GATEWAY",
    "SERVER",
    "THE_MASTER",
    "FinishServer",
    "LaunchStates",
    "LaunchTerms",
    "Look",
    "Signal",
    "Start",
]

THE_MASTER = "the master"
GATEWAY = "the gateway to ROS"
SERVER = "the fork server"

_SILENT = "does not answer any more"
_UNTOLD = "has ended; the fork server, which knows how, does not answer"


class Start(Struct, frozen=True):
    """Start the process of this name: that of a node, or one of the three constants."""

    name: str


class Signal(Struct, frozen=True):
    """Send a signal to a process, if it still runs."""

    name: str
    number: signal.Signals


class FinishServer(Struct, frozen=True):
    """Tell the fork server that there are no more requests."""


class Look(Struct, frozen=True):
    """Look at all processes; then call `LaunchStates.seen`."""


Action = Start | Signal | FinishServer | Look


class LaunchTerms(Struct, frozen=True):
    """What is known before a run.

    Attributes:
        nodes: the instances of each node that is a process, by its name.
        has_gateway: whether there is a gateway to ROS.
        start_time: the simulation time of the first point in s.
    """

    nodes: Mapping[str, Sequence[str]]
    deadlines: Deadlines
    has_gateway: bool = False
    start_time: float = 0.0


class _Phase(IntEnum):
    RUNNING = 0
    LEAVING = 1
    TERMINATED = 2
    KILLED = 3
    SERVER_LEAVING = 4
    SERVER_KILLED = 5
    OVER = 6


class _Loss(Struct, frozen=True):
    """A process that has ended before its time."""

    name: str
    code: int
    at: float


class LaunchStates:
    """The states of a launch.

    Call sequence: `begin`; then, for whatever happens, the method of that name and `go_on`, until `is_ending`; then
    `end`, and the same until `is_over`. Afterwards there may still come what was on its way, and `error` says how the
    run ended. What is returned is to be done, in order. Times are in s, by a clock that stands still while the launcher
    cannot run.

    Attributes:
        outcome: how the run ended, as the master has said it.
    """

    def __init__(self, terms: LaunchTerms) -> None:
        self.outcome: Outcome | None = None
        self._terms = terms
        self._phase = _Phase.RUNNING
        self._until = math.inf
        self._running: set[str] = set()
        self._lost: list[_Loss] = []
        self._how: dict[str, str] = {}
        self._status: MeshStatus | None = None
        self._heard = 0.0
        self._looked = 0.0
        self._stopped_since: dict[str, float] = {}
        self._gateway_ready = False
        self._gateway_ended: float | None = None
        self._interrupted_at: float | None = None
        self._signalled = False

    @property
    def is_ending(self) -> bool:
        """Whether the launcher waits only for the end of its processes."""
        return self._phase is not _Phase.RUNNING

    @property
    def is_over(self) -> bool:
        """Whether there is nothing left to wait for."""
        return self._phase is _Phase.OVER

    @property
    def is_asked(self) -> bool:
        """Whether somebody has asked for the end."""
        return self._interrupted_at is not None

    @property
    def wait_s(self) -> float:
        """How long to wait for an event; then comes `go_on`."""
        return self._terms.deadlines.look_at_end if self.is_ending else self._terms.deadlines.look

    @property
    def point(self) -> int:
        """The last point that all instances are known to have reached."""
        return self._status.point if self._status is not None else 0

    def begin(self) -> Sequence[Action]:
        """Start the run. If there is a gateway, the nodes start when it is ready, so that it misses no sample."""
        return self._starts(SERVER, THE_MASTER, *([GATEWAY] if self._terms.has_gateway else self._terms.nodes))

    # --- what happens

    def reported(self, event: Event, now: float) -> None:
        """The master has sent an event."""
        self._heard = now
        if isinstance(event, Outcome):
            asked = event.error is not None and event.error.kind == Interrupted.__name__
            if not (self._signalled and asked):  # this process has asked, and that is not why the run ends
                self.outcome = event
        elif isinstance(event, Status):
            self._status, ended = event.status, self._gateway_ended
            limit = self._terms.deadlines.gateway
            if event.status.state in GOING_ON and ended is not None and now - ended > limit:
                self._gateway_ended = None
                self._lost.append(_Loss(GATEWAY, 0, ended))

    def gateway_ready(self) -> Sequence[Action]:
        """The gateway has declared everything and misses no sample any more."""
        self._gateway_ready = True
        return () if self.is_ending else self._starts(*self._terms.nodes)

    def ended(self, name: str, code: int, now: float, why: str | None = None) -> None:
        """A process has ended with an exit code: the negative number of a signal if it was one; and why, if known."""
        self._running.discard(name)
        if name == SERVER:  # it ends after all others, or is lost, whatever the master reports of what that means
            if code != 0 and self._how.get(name) != _UNTOLD:  # otherwise this process has killed it
                self._how[name] = how_it_ended(code)
                self._lost.insert(0, _Loss(name, code, now))
            return
        if not self._signalled:  # afterwards the signal is the reason
            lost_link = code == MeshLost.exit_code and name in self._terms.nodes
            self._how.setdefault(name, why or ("lost its link to the master" if lost_link else how_it_ended(code)))
        if self.is_ending:
            return
        stopping = self._status is not None and self._status.state == "stopping"  # then the master warns of its loss
        if self.outcome is None and (name == THE_MASTER or (code != 0 and not stopping)):
            self._lost.append(_Loss(name, code, now))
        elif name == GATEWAY:
            self._gateway_ended = now

    def seen(self, running: Collection[str], stopped: Sequence[str], now: float) -> None:
        """Which processes run, and which of them are stopped by a signal."""
        self._running &= {*running}
        if self.is_ending:
            if not self._signalled:
                self._how = dict.fromkeys(stopped, STOPPED) | self._how
        elif self._starting:  # later, the others notice one that is stopped; now they would only at the deadline
            met = {THE_MASTER: self._status is not None, GATEWAY: self._gateway_ready}
            self._stopped_since = {n: self._stopped_since.get(n, now) for n in stopped if not met.get(n)}
            for name, since in self._stopped_since.items():
                if now - since > self._terms.deadlines.link:
                    self._how[name] = STOPPED
                    self._lost.append(_Loss(name, -signal.SIGSTOP, now))

    def interrupted(self, now: float) -> Sequence[Action]:
        """Somebody asks for the end: first the master ends the run in order; the second time, nobody waits for that."""
        if self._interrupted_at is None and THE_MASTER in self._running:
            self._interrupted_at = now
            return [Signal(THE_MASTER, signal.SIGTERM)]
        self._interrupted_at = -math.inf
        if self._phase is _Phase.LEAVING:
            self._until = now
        return ()

    @property
    def _starting(self) -> bool:
        return self._status is None or self._status.state == "starting"

    def _starts(self, *names: str) -> Sequence[Action]:
        self._running.update(names)
        return [Start(name) for name in names]

    # --- what follows

    def go_on(self, now: float, *, quiet: bool) -> Sequence[Action]:
        """What follows from what has happened, and from the time; ``quiet``: nothing waits to be handled."""
        if self.is_ending:
            return self._end_on(now, quiet=quiet)
        if self._is_decided(now, quiet=quiet):
            return self.end(now)
        if quiet or (self._starting and now - self._looked >= self._terms.deadlines.look):
            self._looked = now
            return [Look()]
        return ()

    def end(self, now: float) -> Sequence[Action]:
        """Wait only for the end from now on, however far the run has come. May be called twice."""
        if self.is_ending:
            return ()
        limits, outcome = self._terms.deadlines, self.outcome
        patience_s = limits.leave if outcome is not None else limits.leave_lost
        if outcome is not None and outcome.error is None:  # the gateway may still have samples for ROS
            patience_s = limits.finish
        self._phase, self._until = _Phase.LEAVING, now + patience_s
        return (FinishServer(), Look())

    def _is_decided(self, now: float, *, quiet: bool) -> bool:
        """Whether there is an outcome, or a reason not to wait for one."""
        limits = self._terms.deadlines
        silent_s = now - self._heard if quiet else 0.0
        has_master = THE_MASTER in self._running
        if self.outcome is not None:
            return not has_master or silent_s > limits.finish
        if self._lost:
            if any(loss.name == THE_MASTER or loss.code == -signal.SIGSTOP for loss in self._lost):
                return True
            first = self._lost[0]
            patience_s = limits.report_of_failure if first.code == FmuError.exit_code else limits.report
            if now - first.at > patience_s:
                return True
        if self._interrupted_at is not None and now - self._interrupted_at > limits.interrupt:
            return True
        if silent_s > limits.report and not has_master:
            return True  # a fork server that is stopped does not tell this
        return silent_s > (limits.no_event if self._status is not None else limits.start)

    def _end_on(self, now: float, *, quiet: bool) -> Sequence[Action]:
        """Go through the phases of the end: wait, SIGTERM, wait, SIGKILL, and the same for the fork server."""
        limits = self._terms.deadlines
        grace_s = limits.leave if self._interrupted_at is None else limits.leave_interrupted
        others, is_late = sorted(self._running - {SERVER}), now >= self._until
        if self._phase < _Phase.SERVER_LEAVING:
            if not others or (is_late and self._phase is _Phase.KILLED):
                self._phase, self._until, is_late = _Phase.SERVER_LEAVING, now + grace_s, False
            elif is_late:
                number = signal.SIGTERM if self._phase is _Phase.LEAVING else signal.SIGKILL
                self._phase, self._until, self._signalled = _Phase(self._phase + 1), now + grace_s, True
                return [Signal(name, number) for name in others]
        if self._phase >= _Phase.SERVER_LEAVING and (
            SERVER not in self._running or (is_late and self._phase is _Phase.SERVER_KILLED)
        ):
            self._phase = _Phase.OVER
        elif self._phase is _Phase.SERVER_LEAVING and is_late and quiet:  # all that it has told is known
            self._phase, self._until = _Phase.SERVER_KILLED, now + grace_s
            self._how = (
                dict.fromkeys((THE_MASTER, GATEWAY, *self._terms.nodes), _UNTOLD) | self._how | {SERVER: _UNTOLD}
            )
            return [Signal(SERVER, signal.SIGKILL)]
        return [Look()] if quiet and not self.is_over else ()

    # --- how it ended

    def error(self) -> FmuMeshError | None:
        """Why the run ended early: as the master says, or as this process saw it; None if it did not."""
        outcome = self.outcome
        if outcome is None or any(loss.name in (GATEWAY, SERVER) for loss in self._lost):  # the master knows neither
            status = self._status
            return self._loss().at(*((status.point, status.time) if status else (0, self._terms.start_time)))
        if outcome.error is None:
            return None
        error = from_report(outcome.error)
        if isinstance(error, DeadlineExceeded) and self._terms.has_gateway and not self._gateway_ready:
            error = DeadlineExceeded(f"{GATEWAY} was not ready within {self._terms.deadlines.start:g} s")
        elif isinstance(error, MeshLost) and error.instance is not None:
            error.saying(self.with_how(error.message))
        elif isinstance(error, Interrupted) and self._interrupted_at is not None:
            error.saying("interrupted").at(outcome.point, outcome.time)
        elif isinstance(error, Interrupted) and outcome.signal is not None:  # and this process has not sent it
            text = f"{THE_MASTER} was lost: its process received {outcome.signal}"
            error = MeshLost(text, point=outcome.point, time=outcome.time)
        return error

    def with_how(self, message: str) -> str:
        """Add how the process of a lost node ended to a message of the master; only this process knows it."""
        for name, how in self._how.items():
            lost = f"node '{name}' was lost: its process "
            message = message.replace(lost + _SILENT + OR_CUT, lost + _SILENT).replace(lost + _SILENT, lost + how)
        return message

    def _loss(self) -> FmuMeshError:
        if self._interrupted_at is not None:
            return Interrupted("interrupted")
        # A node that ends with this code only says that another process is missing.
        named = [loss for loss in self._lost if loss.name in (THE_MASTER, SERVER) or loss.code != MeshLost.exit_code]
        if not named:
            return MeshLost(f"{THE_MASTER} was lost: its process {self._how.get(THE_MASTER, _SILENT)}")
        name, code = named[0].name, named[0].code
        if name in (THE_MASTER, GATEWAY, SERVER):
            hint = "Was it stopped for some seconds? Then the mesh lets go of it." if not code else None
            return MeshLost(f"{name} was lost: its process {self._how[name]}", hint=hint)
        instances = ", ".join(self._terms.nodes[name])
        return MeshLost(f"node '{name}' was lost: its process {self._how[name]}", instance=instances)
