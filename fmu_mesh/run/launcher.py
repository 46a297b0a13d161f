"""The launcher: starts one process per node and one for the master, and watches them until all have ended.

The fork server starts them (`fmu_mesh.run.fork_server`); a node that needs another Python is started by exec. Every
process should run until the master has reported the outcome. If a process ends before, the run ends with `MeshLost` and
the name of the process. A request to end goes to the master, which tells the nodes. Whatever happens, no process and no
file of the run is left at the end.
"""

from __future__ import annotations

import os
import queue
import signal
import time
from collections.abc import Callable, Sequence
from functools import partial

import msgspec
from msgspec.structs import replace

from ..awake import AwakeClock
from ..errors import DeadlineExceeded, FmuError, FmuMeshError, Interrupted, MeshLost, from_report
from ..files import remove_tree
from ..results.record_files import rows_left, what_is_kept
from ..system.plan import MASTER, RECORDER
from ..wire.runtime import (
    STOPPED,
    MeshNote,
    remove_stale_folders,
    run_folder,
    run_name,
    socket_endpoint,
    write_note,
)
from ..wire.views import GOING_ON
from .child import Child, Process, executed, how_it_ended, is_other_python
from .events import Event, OutputLine, Reachable, Status, decode_event
from .fork_server import ForkServer, fork_server
from .outcome import Outcome
from .run_plan import RunPlan

__all__ = ["Launcher"]

_MASTER = "the master"
_GATEWAY = "the gateway to ROS"
_SERVER = "the fork server"
_REPORT_S = 1.5
_TOLD_S = 8.0
_INTERRUPT_S = 0.9
_KILL_S = 0.7
_GATEWAY_S = 2.0
"""A gateway ends with its mesh. If it has ended so long before the mesh, it has lost its link."""

_SILENCE_S = 10.0
"""The master sends an event ten times per second. Without one for so long after the deadline of a step, it counts as
lost: its nodes have ended before, and said why."""

_TURN_S = 0.25
_SILENT = "does not answer any more"
_UNTOLD = "has ended; the fork server, which knows how, does not answer"


class Launcher:
    """Runs a plan as processes of this host.

    Args:
        run: the plan of the run.
        on_event: called with every event, on the thread that calls `run`.

    Attributes:
        outcome: how the run ended, also where `run` raises an error; None before.
    """

    def __init__(self, run: RunPlan, on_event: Callable[[Event], None]) -> None:
        self.outcome: Outcome | None = None
        self._run = replace(run, run=run_name())
        self._plan = run.plan
        self._timeouts = run.loaded.config.timeouts
        self._on_event = on_event
        self._happened: queue.SimpleQueue[Callable[[], None]] = queue.SimpleQueue()
        self._server: ForkServer | None = None
        self._processes: dict[str, Child] = {}
        self._lost: list[tuple[str, int, float]] = []
        self._gateway_ready = False
        self._gateway_ended: float | None = None
        self._how: dict[str, str] = {}
        self._outcome: Outcome | None = None
        self._files: tuple[tuple[str, int], ...] | None = None
        self._point: int | None = None
        self._starting = True
        self._stopping = False  # after that, the loss of a node is a warning of the master
        self._clock = AwakeClock()
        self._looked = 0.0
        self._stopped_since: dict[str, float] = {}
        self._heard = 0.0
        self._quiet = False
        self._ending = False
        self._signalled = False
        self._server_killed = False
        self._interrupted_at: float | None = None

    def run(self) -> Outcome:
        """Start all processes, wait for the end, and remove what the run has left.

        Raises:
            FmuMeshError: the run ended early, and why.
        """
        self._run.check_memory()
        remove_stale_folders()
        self._folder = run_folder(self._run.mesh, self._run.run)
        try:
            socket_endpoint(self._folder, MASTER)  # a path that is too long is found here
            self._file = str(self._run.write(self._folder))
            self._spawn_all()
            while not self._over():
                self._turn()
        finally:
            self._end_all()
            if self._files is None:  # the master could not say it any more
                self._files = rows_left([record.file for record in self._plan.system.records], self._folder)
            remove_tree(self._folder)
        return self._result()

    def interrupt(self) -> None:
        """From any thread or signal handler: end the run; a second call ends it without waiting."""
        self._happened.put(self._interrupt)

    # --- start

    def _spawn_all(self) -> None:
        self._server = server = fork_server()
        self._watch(_SERVER, server.process, partial(self._take_output, _SERVER))
        self._watch(_MASTER, self._fork("master"), self._take_event)
        section = self._run.loaded.config.ros
        if section is not None and section.profile != "rclpy":
            # The nodes are started when it is ready, so that it misses no sample.
            self._watch(_GATEWAY, self._fork("gateway"), self._take_gateway_line)
        else:
            self._spawn_nodes()

    def _spawn_nodes(self) -> None:
        for node, plan in self._plan.nodes.items():
            if node == RECORDER:
                continue
            if plan.interpreter is not None and is_other_python(plan.interpreter):
                process: Process = executed("node", self._file, node, interpreter=plan.interpreter)
            else:
                process = self._fork("node", node)
            self._watch(node, process, partial(self._take_output, node), limited=True)

    def _fork(self, role: str, *arguments: str) -> Process:
        assert self._server is not None
        return self._server.fork(self._run.mesh, role, self._file, *arguments)

    def _watch(self, name: str, process: Process, on_line: Callable[[bytes], None], *, limited: bool = False) -> None:
        self._processes[name] = child = Child(name, process, self._happened.put)
        on_exit = self._take_exit if name != _SERVER else self._take_exit_of_server
        child.watch(on_line, self._take_output, on_exit, limited=limited)

    # --- what happens; all of it on the thread that called `run`

    def _turn(self) -> None:
        try:
            self._happened.get(timeout=_TURN_S)()
            self._quiet = False
        except queue.Empty:
            self._quiet = True
        now = self._clock()
        if self._starting and now - self._looked >= _TURN_S:
            self._looked = now
            self._look_for_stopped(now)

    def _look_for_stopped(self, now: float) -> None:
        """Find processes that are stopped before the run begins: the others would only notice at the deadline."""
        met = {_MASTER: self._point is not None, _GATEWAY: self._gateway_ready}
        stopped = [name for name, process in self._processes.items() if not met.get(name) and process.stopped]
        self._stopped_since = {name: self._stopped_since.get(name, now) for name in stopped}
        for name in [name for name, since in self._stopped_since.items() if now - since > self._timeouts.link]:
            self._how[name] = STOPPED
            self._lost.append((name, -signal.SIGSTOP, time.monotonic()))

    def _take_event(self, line: bytes) -> None:
        try:
            event = decode_event(line)
        except msgspec.DecodeError:
            self._take_output(_MASTER, line)
            return
        self._heard = self._clock()
        match event:
            case Reachable(endpoints):
                prefix, file = self._run.loaded.config.zenoh.key_prefix, str(self._run.config_file)
                write_note(self._folder, MeshNote(self._run.mesh, prefix, endpoints, os.getpid(), file))
            case Status(status):
                self._point = status.point
                self._starting, self._stopping = status.state == "starting", status.state == "stopping"
                ended = self._gateway_ended
                if status.state in GOING_ON and ended is not None and self._heard - ended > _GATEWAY_S:
                    self._gateway_ended = None
                    self._lost.append((_GATEWAY, 0, ended))
            case Outcome(files=files, error=error):
                self._files = files
                asked = error is not None and error.kind == Interrupted.__name__
                if not (self._signalled and asked):  # this process has asked, and that is not why the run ends
                    self._outcome = event
        self._on_event(event)

    def _take_gateway_line(self, line: bytes) -> None:
        try:
            decode_event(line)  # it has one event: it is ready
        except msgspec.DecodeError:
            self._take_output(_GATEWAY, line)
            return
        self._gateway_ready = True
        self._spawn_nodes()

    def _take_output(self, name: str, line: bytes) -> None:
        self._on_event(OutputLine(name, line.decode(errors="replace").rstrip()))

    def _take_exit(self, name: str, code: int) -> None:
        if not self._signalled:  # afterwards the signal is the reason
            lost_link = code == MeshLost.exit_code and name in self._plan.nodes
            self._how.setdefault(name, "lost its link to the master" if lost_link else how_it_ended(code))
        if self._ending:
            return
        if self._outcome is None and (name == _MASTER or (code != 0 and not self._stopping)):
            self._lost.append((name, code, time.monotonic()))
        elif name == _GATEWAY:
            self._gateway_ended = self._clock()

    def _take_exit_of_server(self, name: str, code: int) -> None:
        """The server ends after all others. Otherwise it is lost, whatever the master reports of what that means."""
        if code != 0 and not self._server_killed:
            self._how[name] = how_it_ended(code)
            self._lost.insert(0, (name, code, time.monotonic()))

    def _interrupt(self) -> None:
        master = self._processes.get(_MASTER)
        if self._interrupted_at is None and master is not None and master.running:
            self._interrupted_at = time.monotonic()
            master.signal(signal.SIGTERM)
        else:
            self._interrupted_at = 0.0

    def _over(self) -> bool:
        """Whether there is nothing left to wait for."""
        now, heard_s = time.monotonic(), self._clock() - self._heard
        silent_s = heard_s if self._quiet else 0.0
        if self._outcome is not None:
            return not self._processes[_MASTER].running or silent_s > self._timeouts.stop
        if any(name == _MASTER or code == -signal.SIGSTOP for name, code, _ in self._lost):
            return True
        # If a node has ended, the master notices it within milliseconds and reports it; otherwise this process does.
        # A node that ended because of its FMU has told the master, which may wait for the recorder before it ends.
        told = bool(self._lost) and self._lost[0][1] == FmuError.exit_code
        if self._lost and now - self._lost[0][2] > (_TOLD_S if told else _REPORT_S):
            return True
        if self._interrupted_at is not None and now - self._interrupted_at > _INTERRUPT_S:
            return True
        if silent_s > _REPORT_S and not self._processes[_MASTER].running:
            return True  # a fork server that is stopped does not tell this
        patience_s = _SILENCE_S + self._timeouts.step if self._point is not None else self._timeouts.start
        return silent_s > patience_s

    # --- the end

    def _end_all(self) -> None:
        """Wait for the processes that end by themselves, then send SIGTERM, then SIGKILL."""
        self._ending = True
        self._how = {name: STOPPED for name, process in self._processes.items() if process.stopped} | self._how
        if self._server is not None:
            self._server.finish()
        patience = _KILL_S if self._outcome is not None else 0.1
        if self._outcome is not None and self._outcome.error is None:  # the gateway may still have samples for ROS
            patience = self._timeouts.stop
        grace_s = _KILL_S if self._interrupted_at is None else 0.3
        server = [process for process in self._processes.values() if process.name == _SERVER]
        for step in (None, signal.SIGTERM, signal.SIGKILL):
            running = [process for process in self._processes.values() if process.running and process not in server]
            if not running:
                break
            if step is not None:
                self._signalled = True
                for process in running:
                    process.signal(step)
            self._wait_for_end(running, patience if step is None else grace_s)
        self._wait_for_end(server, grace_s)
        for process in server:
            self._server_killed = process.running
            if self._server_killed:
                self._take_all()
                self._how = dict.fromkeys(self._processes, _UNTOLD) | self._how
            process.signal(signal.SIGKILL)
        self._wait_for_end(server, grace_s)
        self._close_all()

    def _wait_for_end(self, running: list[Child], timeout_s: float) -> None:
        deadline = time.monotonic() + timeout_s
        while any(process.running for process in running) and time.monotonic() < deadline:
            try:
                self._happened.get(timeout=0.05)()
            except queue.Empty:
                continue

    def _close_all(self) -> None:
        for process in self._processes.values():
            process.close()
        if self._server is not None:
            self._server.close()
        self._take_all()

    def _take_all(self) -> None:
        while not self._happened.empty():
            self._happened.get()()

    def _result(self) -> Outcome:
        """The outcome of a run that went well.

        Raises:
            FmuMeshError: it did not; as the master says, or as this process saw it if the master could not say it.
        """
        outcome, file, files = self._outcome, self._plan.system.result_file, self._files or ()
        unknown = any(name in (_GATEWAY, _SERVER) for name, _, _ in self._lost)  # to the master
        if outcome is None or unknown:
            error = self._own_account()
        elif outcome.error is None:
            self.outcome = outcome = replace(outcome, warnings=tuple(map(self._with_how, outcome.warnings)))
            return outcome
        else:
            error = self._with_cause(from_report(outcome.error), outcome)
            if isinstance(error, DeadlineExceeded) and _GATEWAY in self._processes and not self._gateway_ready:
                error = DeadlineExceeded(f"{_GATEWAY} was not ready within {self._timeouts.start:g} s")
        last = self._last_recorded(files)
        if type(error) in (Interrupted, MeshLost) and last > (error.point or 0):
            error.at(last, self._plan.grid.time(last))  # the last progress is older than the last row
        point, seconds = error.point or 0, outcome.seconds if outcome is not None else 0.0
        rows, time_s = files[0][1] if files else 0, self._plan.grid.time(point)
        warnings, report = outcome.warnings if outcome is not None else (), error.report()
        self.outcome = Outcome("failed", point, time_s, seconds, rows, file, report, files=files, warnings=warnings)
        raise error.with_hint(what_is_kept(files))

    def _last_recorded(self, files: Sequence[tuple[str, int]]) -> int:
        """The point of the last row in any of the result files."""
        records = self._plan.system.records
        counted = zip(records, files, strict=False)
        return max((record.point_of(rows - 1) for record, (_, rows) in counted if rows), default=0)

    def _own_account(self) -> FmuMeshError:
        """Why the run ended, if the master has not said it."""
        error = self._loss()
        return error.at(self._point or 0, self._plan.grid.time(self._point or 0))

    def _loss(self) -> FmuMeshError:
        if self._interrupted_at is not None:
            return Interrupted("interrupted")
        # A node that ends with this code only says that another process is missing.
        named = [loss for loss in self._lost if loss[0] in (_MASTER, _SERVER) or loss[1] != MeshLost.exit_code]
        if not named:
            return MeshLost(f"the master was lost: its process {self._how.get(_MASTER, 'does not answer any more')}")
        name, code, _ = named[0]
        if name in (_MASTER, _GATEWAY, _SERVER):
            hint = "Was it stopped for some seconds? Then the mesh lets go of it." if not code else None
            return MeshLost(f"{name} was lost: its process {self._how[name]}", hint=hint)
        instances = ", ".join(item.name for item in self._plan.nodes[name].instances)
        return MeshLost(f"node '{name}' was lost: its process {self._how[name]}", instance=instances)

    def _with_how(self, warning: str) -> str:
        """Add how the process of a lost node ended to a warning of the master."""
        for name, how in self._how.items():
            lost = f"node '{name}' was lost: its process "
            warning = warning.replace(lost + _SILENT, lost + how)
        return warning

    def _with_cause(self, error: FmuMeshError, outcome: Outcome) -> FmuMeshError:
        """Add how the process of a lost node ended, or who interrupted the run; only this process knows it."""
        if isinstance(error, MeshLost) and error.instance is not None:
            for name, how in self._how.items():
                lost = error.message.startswith(f"node '{name}' was lost")
                if lost and error.message.endswith(_SILENT):  # otherwise the node has said why
                    error.saying(f"node '{name}' was lost: its process {how}")
        elif isinstance(error, Interrupted) and self._interrupted_at is not None:
            error.saying("interrupted").at(outcome.point, outcome.time)
        elif isinstance(error, Interrupted) and outcome.signal is not None:
            text = f"{_MASTER} was lost: its process received {outcome.signal}"  # and this process has not sent it
            return MeshLost(text, point=outcome.point, time=outcome.time)
        return error
