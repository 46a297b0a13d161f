"""The launcher: one process per node and one for the master, watched until the last of them has ended.

Desired is that every process runs until the master has said how the run ended. What happens otherwise: a process that
dies ends the run with `MeshLost` and its name; a request to end goes to the master, which tells the nodes. At the end
no process and no file of the run is left, whatever became of them.
"""

from __future__ import annotations

import os
import queue
import signal
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import msgspec

from ..errors import DeadlineExceeded, FmuError, FmuMeshError, Interrupted, MeshLost, from_report
from ..instances.registry import can_be_shown
from ..system.plan import RECORDER, Plan
from ..wire.runtime import MeshNote, remove_run_folder, remove_stale_folders, run_folder, runtime_folder, write_note
from ..wire.session import LEASE_MS
from ..wire.views import GOING_ON
from .child import Child, StopWatch, how_it_ended, own_command
from .events import End, Event, Ready, Status, decode_event
from .options import Options
from .results import rows_left, what_is_kept

__all__ = ["Launcher", "Output"]

_MASTER = "the master"
_GATEWAY = "the gateway to ROS"
_REPORT_S = 1.5
_TOLD_S = 8.0
_INTERRUPT_S = 0.9
_KILL_S = 0.7
_GATEWAY_S = 2.0
"""A gateway ends with its mesh; one that has ended so long before it has lost its link."""

_SILENCE_S = 10.0
"""The master says something ten times a second; after this time without a word it is taken for lost."""

_TURN_S = 0.25

Output = Callable[[str, str], None]
"""Called with the name of a process and a line that it wrote to its standard output or error."""


class Launcher:
    """Runs a plan as processes of this host.

    Args:
        config_file: the configuration file.
        options: what the command line changed; handed on.
        on_event: called with every event of the master, on the thread that calls `run`.
        on_output: called with every line that a process writes, likewise.
        restarts: how often the run was started before.
    """

    def __init__(  # noqa: PLR0913 a run and whom it tells
        self,
        plan: Plan,
        config_file: Path,
        options: Options,
        on_event: Callable[[Event], None],
        on_output: Output,
        *,
        restarts: int = 0,
    ) -> None:
        self._plan = plan
        self._restarts = restarts
        self._config_file = config_file
        self._options = options
        self._timeouts = plan.system.config.timeouts
        self._on_event = on_event
        self._on_output = on_output
        self._happened: queue.SimpleQueue[Callable[[], None]] = queue.SimpleQueue()
        self._processes: dict[str, Child] = {}
        self._lost: list[tuple[str, int, float]] = []
        self._gateway_ready = False
        self._gateway_ended: float | None = None
        self._how: dict[str, str] = {}
        self._end: End | None = None
        self._rows: int | None = None
        self._point: int | None = None
        self._starting = True
        self._stop_watch = StopWatch(LEASE_MS / 1000, _TURN_S)
        self._heard = time.monotonic()
        self._quiet = False
        self._ending = False
        self._signalled = False
        self._interrupted_at: float | None = None
        self._spawn_nodes: Callable[[], None] = lambda: None

    def run(self) -> End:
        """Start everything, wait for the end, clean up.

        Raises:
            FmuMeshError: the run ended early, and why.
        """
        remove_stale_folders()
        _remove_folders_without_note()
        run = str(os.getpid())
        folder = run_folder(self._plan.system.config.mesh, run)
        try:
            self._spawn_all(folder, run)
            while not self._over():
                self._turn()
        finally:
            self._end_all()
            if self._rows is None and (result_file := self._plan.system.result_file) is not None:
                self._rows = rows_left(result_file, folder)
            remove_run_folder(folder)
        return self._outcome()

    def interrupt(self) -> None:
        """From any thread or signal handler: end the run; a second call does not wait for anybody."""
        self._happened.put(self._interrupt)

    # --- start

    def _spawn_all(self, folder: Path, run: str) -> None:
        config_file = str(self._config_file)
        common = ["--run", run]
        for endpoint in self._options.connect:
            common += ["--connect", endpoint]
        for endpoint in self._options.listen:
            common += ["--listen", endpoint]
        changes = [f"--set={change}" for change in self._options.start_values]
        if self._options.window is not None:
            changes.append(f"--window={self._options.window}")
        if self._options.real_time_factor is not None:
            changes.append(f"--real-time-factor={self._options.real_time_factor!r}")
        if self._options.output is not None:
            changes.append(f"--output={self._options.output}")
        granting = ["--profile"] if self._options.profile else []
        if self._options.paused:
            granting.append("--paused")
        self._spawn(_MASTER, ["master", config_file, *common, *changes, *granting, "--events"], folder)
        self._spawn_nodes = partial(self._spawn_each_node, folder, common)
        section = self._plan.system.config.ros
        if section is not None and section.profile != "rclpy":
            # The nodes follow when it is ready: then it misses nothing.
            self._spawn(_GATEWAY, ["gateway", config_file, *common, *changes, "--events"], folder)
        else:
            self._spawn_nodes()

    def _spawn_each_node(self, folder: Path, common: Sequence[str]) -> None:
        for number, (node, plan) in enumerate(self._plan.nodes.items()):
            if node == RECORDER:
                continue
            plan_file = folder / f"{number}.json"
            plan_file.write_bytes(msgspec.json.encode(msgspec.structs.replace(plan, restarts=self._restarts)))
            shown = self._showing() if any(can_be_shown(own.section) for own in plan.instances) else []
            self._spawn(node, ["node", str(self._config_file), node, *common, *shown, "--plan", str(plan_file)], folder)

    def _showing(self) -> list[str]:
        """The options of the node with the physics engine."""
        showing = self._options.showing
        video = [f"--video={showing.video}"] if showing.video is not None else []
        return [*(["--view"] if showing.view else []), *video]

    def _spawn(self, name: str, arguments: Sequence[str], folder: Path) -> None:
        process = Child(name, own_command(*arguments), self._happened.put)
        self._processes[name] = process
        if name == _MASTER:
            process.start(lambda line: self._take_event(line, folder), self._take_output, self._take_exit)
        elif name == _GATEWAY:
            process.start(self._take_gateway_line, self._take_output, self._take_exit)
        else:
            process.start(lambda line: self._take_output(name, line), self._take_output, self._take_exit, limited=True)

    # --- what happens; all on the thread that called `run`

    def _turn(self) -> None:
        try:
            self._happened.get(timeout=_TURN_S)()
            self._quiet = False
        except queue.Empty:
            self._quiet = True
        if self._starting and self._stop_watch.due(now := time.monotonic()):
            self._look_for_stopped(now)

    def _look_for_stopped(self, now: float) -> None:
        """A process that is stopped before it has met the others is missed by nobody else until the deadline."""
        met = {_MASTER: self._point is not None, _GATEWAY: self._gateway_ready}
        stopped = [name for name, process in self._processes.items() if not met.get(name) and process.stopped]
        for name in self._stop_watch.look(now, stopped):
            self._how[name] = "is stopped"
            self._lost.append((name, -signal.SIGSTOP, now))

    def _take_event(self, line: bytes, folder: Path) -> None:
        try:
            event = decode_event(line)
        except msgspec.DecodeError:
            self._take_output(_MASTER, line)
            return
        self._heard = time.monotonic()
        if isinstance(event, Ready):
            config = self._plan.system.config
            note = MeshNote(
                config.mesh, config.zenoh.key_prefix, event.endpoints, os.getpid(), str(self._config_file.absolute())
            )
            write_note(folder, note)
        elif isinstance(event, Status):
            self._point = event.status.point
            self._starting = event.status.state == "starting"
            ended = self._gateway_ended
            if event.status.state in GOING_ON and ended is not None and self._heard - ended > _GATEWAY_S:
                self._gateway_ended = None
                self._lost.append((_GATEWAY, 0, ended))
        elif isinstance(event, End):
            self._rows = event.rows
            asked = event.error is not None and event.error.kind == Interrupted.__name__
            if not (self._signalled and asked):  # it was this process that asked, and not why the run ends
                self._end = event
        self._on_event(event)

    def _take_gateway_line(self, line: bytes) -> None:
        try:
            decode_event(line)  # the only one that it has: it is ready
        except msgspec.DecodeError:
            self._take_output(_GATEWAY, line)
            return
        self._gateway_ready = True
        self._spawn_nodes()

    def _take_output(self, name: str, line: bytes) -> None:
        self._on_output(name, line.decode(errors="replace").rstrip())

    def _take_exit(self, name: str, code: int) -> None:
        if not self._signalled:  # afterwards it says no more what was wrong
            self._how[name] = how_it_ended(code)
        if self._ending:
            return
        if self._end is None and (code != 0 or name == _MASTER):
            self._lost.append((name, code, time.monotonic()))
        elif name == _GATEWAY:
            self._gateway_ended = time.monotonic()

    def _interrupt(self) -> None:
        master = self._processes.get(_MASTER)
        if self._interrupted_at is None and master is not None and master.running:
            self._interrupted_at = time.monotonic()
            master.signal(signal.SIGTERM)
        else:
            self._interrupted_at = 0.0

    def _over(self) -> bool:
        """Whether there is nothing left to wait for."""
        now = time.monotonic()
        silent_s = now - self._heard if self._quiet else 0.0
        if self._end is not None:
            return not self._processes[_MASTER].running or silent_s > self._timeouts.stop
        if any(name == _MASTER or code == -signal.SIGSTOP for name, code, _ in self._lost):
            return True
        # A node is gone: the master sees it within milliseconds and says so; if it does not, we do.
        # One that ended because of its FMU has told the master, which may have to wait for its recorder before it ends.
        told = bool(self._lost) and self._lost[0][1] == FmuError.exit_code
        if self._lost and now - self._lost[0][2] > (_TOLD_S if told else _REPORT_S):
            return True
        if self._interrupted_at is not None and now - self._interrupted_at > _INTERRUPT_S:
            return True
        return silent_s > (_SILENCE_S if self._point is not None else self._timeouts.start)

    # --- the end

    def _end_all(self) -> None:
        """Wait for those that end by themselves, then ask, then kill."""
        self._ending = True
        patience = _KILL_S if self._end is not None else 0.1
        if self._end is not None and self._end.error is None:  # the gateway has samples to carry to ROS
            patience = self._timeouts.stop
        grace_s = _KILL_S if self._interrupted_at is None else 0.3
        for step in (None, signal.SIGTERM, signal.SIGKILL):
            running = [process for process in self._processes.values() if process.running]
            if not running:
                break
            if step is not None:
                self._signalled = True
                for process in running:
                    process.signal(step)
            deadline = time.monotonic() + (patience if step is None else grace_s)
            while any(process.running for process in running) and time.monotonic() < deadline:
                try:
                    self._happened.get(timeout=0.05)()
                except queue.Empty:
                    continue
        for process in self._processes.values():
            process.close()
        while not self._happened.empty():
            self._happened.get()()

    def _outcome(self) -> End:
        """How the run ended, as the master says; as this process saw it where the master could not say it any more."""
        result_file, rows = self._plan.system.result_file, self._rows or 0
        gateway_lost = any(name == _GATEWAY for name, _, _ in self._lost)  # of which the master knows nothing
        if self._end is not None and not gateway_lost:
            if self._end.error is None:
                return self._end
            error = self._with_cause(from_report(self._end.error))
            if isinstance(error, DeadlineExceeded) and _GATEWAY in self._processes and not self._gateway_ready:
                error = DeadlineExceeded(f"{_GATEWAY} was not ready within {self._timeouts.start:g} s")
        else:
            error = self._own_account()
        if type(error) in (Interrupted, MeshLost) and rows > (error.point or 0):
            # What is recorded is newer than what the last progress said.
            error.point, error.time = rows - 1, self._plan.grid.time(rows - 1)
        if kept := what_is_kept(result_file, rows):
            error.hint = f"{error.hint} {kept}" if error.hint else kept
        raise error

    def _own_account(self) -> FmuMeshError:
        """Why the run ended without a last word of the master."""
        point = self._point or 0
        if self._interrupted_at is not None:
            return Interrupted("interrupted", point=point, time=self._plan.grid.time(point))
        # A node that ends with this code only says that it misses another process.
        named = [loss for loss in self._lost if loss[0] == _MASTER or loss[1] != MeshLost.exit_code]
        if not named:
            text = "the master was lost: its process does not answer any more"
            return MeshLost(text, point=point, time=self._plan.grid.time(point))
        name = named[0][0]
        if name in (_MASTER, _GATEWAY):
            text = f"{name} was lost: its process {self._how[name]}"
            hint = "Was it stopped for some seconds? Then the mesh lets go of it." if not named[0][1] else None
            return MeshLost(text, point=point, time=self._plan.grid.time(point), hint=hint)
        instances = ", ".join(item.name for item in self._plan.nodes[name].instances)
        text = f"node '{name}' was lost: its process {self._how[name]}"
        return MeshLost(text, instance=instances, point=point, time=self._plan.grid.time(point))

    def _with_cause(self, error: FmuMeshError) -> FmuMeshError:
        """Say how the process of a lost node ended, or who interrupted the run; only the parent of all knows."""
        end = self._end
        if isinstance(error, MeshLost) and error.instance is not None:
            for name, how in self._how.items():
                lost = error.message.startswith(f"node '{name}' was lost")
                if lost and error.message.endswith("does not answer any more"):  # or it has said why by itself
                    error.message = f"node '{name}' was lost: its process {how}"
        elif isinstance(error, Interrupted) and end is not None and self._interrupted_at is not None:
            error.message, error.point, error.time = "interrupted", end.status.point, end.status.time
        elif isinstance(error, Interrupted) and end is not None and end.signal is not None:
            text = f"{_MASTER} was lost: its process received {end.signal}"  # and not from this process
            return MeshLost(text, point=end.status.point, time=end.status.time)
        return error


def _remove_folders_without_note() -> None:
    """Remove the folders of launchers that were killed before they knew where their master can be reached."""
    for folder in runtime_folder().glob("*.*"):
        pid = folder.suffix.removeprefix(".")
        if pid.isdigit() and not (folder / "mesh.json").exists():
            try:
                os.kill(int(pid), 0)
            except ProcessLookupError:
                remove_run_folder(folder)
            except PermissionError:
                continue
