"""A whole mesh in one process: `launch --local`, `Mesh.run(processes=False)`, and what any distributed run must equal.

`LocalMesh` is the loop over the points of a `LocalSystem`, with what a run has around them: the result file, progress,
the wall clock and the watch over FMUs that do not return. `InProcessRun` runs it on a thread of its own.
"""

# Who meets here (ADR 12). The thread that called `InProcessRun.run` only waits. A thread of the run does all the work,
# and alone calls FMUs. The thread of `CallWatch` takes a hang: the thread of the run is inside an FMU then and changes
# nothing, so that the rows can be saved from outside. `interrupt` may come from any thread or a signal handler; a
# thread "grace" gives up if the run does not come to its next point.
#
# What may go wrong: a call into an FMU that does not return cannot be ended from within a process. Then the run is over
# for whoever waits for it, what was recorded is kept, and the thread is left. Neither signal handlers nor the process
# as a whole are touched, so that a program can have several such runs. A process that ends with its run, as that of
# `launch --local`, closes the instances after it has printed everything: an FMU may crash there.

from __future__ import annotations

import atexit
import logging
import os
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Mapping
from contextlib import ExitStack, closing, suppress
from functools import partial
from pathlib import Path
from types import MappingProxyType

from ..config.loading import LoadedConfig
from ..errors import FmuError, FmuMeshError, Interrupted, TerminationRequested
from ..files import remove_tree
from ..instances.call_guard import ENDED, CallWatch, Guarded
from ..instances.contract import Instance, LogMessage, Showing
from ..instances.process_end import end_process, process_ends
from ..instances.registry import open_instance
from ..master.pacing import Pacer
from ..recorder.row_buffer import RowBuffer
from ..results.growth import GrowthWatch
from ..results.record_files import open_results, what_is_kept
from ..system.layout import Layout
from ..system.plan import Plan
from ..wire.runtime import remove_stale_folders, run_folder, run_name
from ..wire.views import LogLine, MeshStatus
from .events import Event, Log, Status
from .local_system import LocalSystem, opening_of
from .one_process import OneProcess
from .outcome import Outcome, outcome_at
from .run_plan import RunPlan

__all__ = ["InProcessRun", "LocalMesh"]

log = logging.getLogger(__name__)

_ROWS = 1024
_FLUSH_S = 0.2
_STATUS_S = 0.1
_GRACE_S = 1.0
"""How long an interrupted run may take to come to its next point."""


class LocalMesh:
    """Runs a plan in this process, as fast as its real-time factor allows.

    ```python
    outcome = LocalMesh(fmu_mesh.load("configs/pendulum_delay.yaml").plan().plan).run()
    print(outcome.point, outcome.file)
    ```

    Args:
        plan: the plan; its nodes and its window are not used.
        log: called with every log message of an FMU.
        progress: called with the point now and then.
        open_instance: opens an instance by name, instead of the model of the plan; it is closed here.
        on_hang: called on another thread if an FMU does not return in time. All rows so far are in the result file.
            The thread that is inside the FMU cannot be stopped, so the caller has to end the process.
        parent: an existing folder to extract FMUs into; by default the folder for temporary files.
        showing: whether and how a physics engine shows its world.
        loaded: the configuration; None: that of the plan, with paths relative to the working directory.
        contents: the SHA-256 of the model of each instance, for the metadata of the result.

    Attributes:
        files: each result file and the number of its rows, once the run is over.
    """

    def __init__(  # noqa: PLR0913, PLR0917  what a caller may want to hear of
        self,
        plan: Plan,
        log: Callable[[LogMessage], None] = lambda _message: None,
        progress: Callable[[int], None] = lambda _point: None,
        open_instance: Callable[[str], Instance] | None = None,
        on_hang: Callable[[FmuError], None] = lambda error: log.error("%s", error),
        parent: Path | None = None,
        showing: Showing = Showing(),  # noqa: B008  a frozen Struct
        loaded: LoadedConfig | None = None,
        contents: Mapping[str, str] = MappingProxyType({}),
    ) -> None:
        self._stack = ExitStack()
        self._seconds = 0.0
        self._begun = False
        self._ended_by: TerminationRequested | None = None
        self._buffer: RowBuffer | None = None
        self.files: tuple[tuple[str, int], ...] = ()
        self._plan = plan
        self._growth = GrowthWatch(plan)
        self._system = LocalSystem(plan)
        self._log = log
        self._progress = progress
        self._open_instance = open_instance
        self._on_hang = on_hang
        self._parent = parent
        self._showing = showing
        self._loaded = loaded if loaded is not None else LoadedConfig(plan.system.config, Path())
        self._contents = contents
        self._stop: str | None = None
        self._stopped = threading.Event()
        self._folder: Path | None = None

    @property
    def point(self) -> int:
        """The last point reached."""
        return self._system.point

    @property
    def warnings(self) -> tuple[str, ...]:
        """What the rows so far warn of."""
        return self._growth.warnings

    def interrupt(self, reason: str) -> None:
        """From any thread: end the run with `Interrupted` at the next point."""
        self._stop = reason
        self._stopped.set()

    def clean_up(self) -> None:
        """From another thread, if the main thread does not return from an FMU: keep the rows, remove other files."""
        self._save_from_outside()
        if self._folder is not None:
            remove_tree(self._folder)

    def run(self, *, closes: bool = True) -> Outcome:
        """Run from the first to the last point.

        Args:
            closes: whether the instances are closed at the end; otherwise the caller calls `close` on this thread.

        Raises:
            FmuMeshError: an FMU failed, the run was interrupted, or this system cannot run in one process. The rows
                that were recorded before are kept.
        """
        if self._open_instance is None:
            OneProcess().check(self._plan, self._contents)
        try:
            self._run()
        except FmuMeshError as error:
            error.with_hint(what_is_kept(self.files))
            raise
        finally:
            if closes:
                self.close()
        end, files, warnings = self._ended_by, self.files, self.warnings
        return outcome_at(self._plan, self.point, files, None, end, seconds=self._seconds, warnings=warnings)

    def close(self) -> None:
        """Close the instances and remove their files. May be called twice."""
        self._stack.close()

    def _run(self) -> None:
        plan, system = self._plan, self._system
        layouts = {name: Layout.of(i.description.variables) for name, i in plan.system.instances.items()}
        types = [layouts[instance].column(name).type for instance, name in plan.system.recorded]
        enter = self._stack.enter_context
        self._folder = Path(enter(tempfile.TemporaryDirectory(prefix="fmu_mesh-", dir=self._parent)))
        watch = enter(closing(CallWatch(self._take_hang, survives=process_ends())))
        files = open_results(self._loaded, plan.system, digest=plan.digest, contents=self._contents)
        self._buffer = rows = RowBuffer(files, plan.grid, plan.system.records, types, self._growth)
        self._stack.callback(system.close)
        try:
            timeouts = plan.system.config.timeouts
            system.start(lambda name: Guarded(name, partial(self._open, name), watch, timeouts))
            started = time.perf_counter()
            self._begun = True
            try:
                with watch.stepping(self._position, plan.system.config.timeouts.step):
                    self._loop(rows)
            finally:
                self._seconds = time.perf_counter() - started
        finally:
            self._save()

    def _open(self, name: str) -> Instance:
        if self._open_instance is not None:
            return self._open_instance(name)
        assert self._folder is not None
        return open_instance(opening_of(self._plan, name, self._folder, self._log, self._showing))

    def _take_hang(self, error: FmuError) -> None:
        """From the watching thread. This is safe: the main thread is blocked in an FMU."""
        if self._begun:
            error.at(self._system.begun_at, self._plan.grid.time(self._system.begun_at))
        self._save_from_outside()
        self._on_hang(error.with_hint(what_is_kept(self.files)))

    def _save_from_outside(self) -> None:
        with suppress(FmuMeshError):  # the process ends now for another reason
            self._save()

    def _position(self) -> tuple[str, int, str]:
        """See `CallWatch.stepping`; between two points, the answer changes all the time."""
        stepping = self._system.stepping
        return (stepping, self.point, self._system.doing(stepping)) if stepping else ("", time.monotonic_ns(), "")

    def _loop(self, rows: RowBuffer) -> None:
        plan, system, last_point = self._plan, self._system, self._plan.grid.last_point
        recorded = [system.reader(instance, variable) for instance, variable in plan.system.recorded]
        factor = plan.system.config.simulation.real_time_factor
        pacer = Pacer(plan, factor)
        pacer.start(0)
        step = system.step
        try:
            for point in range(last_point + 1):
                if recorded:
                    rows.add([read(point // points) for read, points in recorded])
                if point % _ROWS == _ROWS - 1:
                    rows.write()
                    self._progress(point)
                if factor and point < last_point:
                    self._wait_for_the_clock(pacer, rows)
                if self._stop is not None:
                    raise Interrupted(self._stop, point=point, time=plan.grid.time(point))
                if point < last_point:
                    step()
        except TerminationRequested as asked:
            self._ended_by = asked
        rows.write()
        self._progress(self.point)

    def _wait_for_the_clock(self, pacer: Pacer, rows: RowBuffer) -> None:
        """Wait until the wall clock allows the next step, or the run has to end; meanwhile write what was recorded."""
        while not self._stopped.is_set():
            granted, pause_s = pacer.limit(self.point + 1, self.point)
            if granted > self.point:
                return
            if time.monotonic() - rows.flushed_at > _FLUSH_S:
                rows.write(flush=True)
                self._progress(self.point)
            self._stopped.wait(pause_s)

    def _save(self) -> None:
        """Write all rows to the file and close it, once; the watching thread calls this if the main thread cannot."""
        rows, self._buffer = self._buffer, None
        if rows is None:
            return
        try:
            rows.close()
        finally:
            self.files = rows.counted


class InProcessRun:
    """Runs a plan in this process; it has the interface of `Launcher`.

    Args:
        run: the plan of the run.
        on_event: called with every event, on the thread of the run.

    Attributes:
        outcome: how the run ended, also where `run` raises an error; None before.
    """

    def __init__(self, run: RunPlan, on_event: Callable[[Event], None]) -> None:
        self.outcome: Outcome | None = None
        self._run = run
        self._on_event = on_event
        self._started: float | None = None
        self._told = 0.0
        self._error: BaseException | None = None
        self._over = threading.Event()
        self._mesh: LocalMesh | None = None
        self._interrupted = False
        self._folder: Path | None = None

    def run(self) -> Outcome:
        """Run from the first to the last point.

        Raises:
            FmuMeshError: the run ended early, and why.
        """
        threading.Thread(target=self._work, name=f"run of {self._run.mesh}", daemon=True).start()
        self._over.wait()
        if self._error is not None:
            if isinstance(self._error, FmuMeshError):
                mesh = self._mesh
                point, files, warnings = (mesh.point, mesh.files, mesh.warnings) if mesh is not None else (0, (), ())
                self.outcome = outcome_at(self._run.plan, point, files, self._error, warnings=warnings)
                self._on_event(self.outcome)
            raise self._error
        assert self.outcome is not None
        self._on_event(self.outcome)
        return self.outcome

    def interrupt(self) -> None:
        """From any thread: end the run at its next point; if it does not come there in time, without it."""
        self._interrupted = True
        if self._mesh is not None:
            self._mesh.interrupt("interrupted")
        threading.Thread(target=self._give_up, name="grace", daemon=True).start()

    def _work(self) -> None:
        try:
            remove_stale_folders()
            self._folder = folder = run_folder(self._run.mesh, run_name())
            (fmus := folder / "fmus").mkdir()
            self._mesh = mesh = LocalMesh(
                self._run.plan,
                self._log,
                self._progress,
                on_hang=self._end,
                parent=fmus,
                showing=self._run.showing,
                loaded=self._run.loaded,
                contents=self._run.contents,
            )
            if self._interrupted:
                mesh.interrupt("interrupted")
            self.outcome = mesh.run(closes=not process_ends())
        except BaseException as error:  # noqa: BLE001 `run` raises it on the thread of the caller
            self._error = self._error or error
        if process_ends() and self._mesh is not None and not self._over.is_set():
            self._close_at_exit(self._mesh)
        self._leave()

    def _close_at_exit(self, mesh: LocalMesh) -> None:
        """Close the instances on this thread, when the process is about to end."""
        ending, closed = threading.Event(), threading.Event()

        def end() -> None:
            with suppress(OSError):  # nobody reads it
                sys.stdout.flush()
            os.dup2(2, 1)  # standard output is for results, and not for what an FMU prints
            ending.set()
            closed.wait()  # each call has its deadline

        atexit.register(end)
        self._over.set()
        ending.wait()
        mesh.close()
        self._leave()
        closed.set()

    def _give_up(self) -> None:
        if not self._over.wait(_GRACE_S) and self._mesh is not None:
            point = self._mesh.point
            self._end(Interrupted("interrupted", point=point, time=self._run.plan.grid.time(point)))

    def _end(self, error: FmuError | Interrupted) -> None:
        """From another thread: the thread of the run does not return from an FMU."""
        assert self._mesh is not None
        self._mesh.clean_up()
        if self._over.is_set():  # the outcome is printed
            self._leave()
            sys.stderr.write(f"fmu-mesh: warning: {error}\n")
            end_process()
        self._error = error.saying(error.message.removesuffix(ENDED))  # here, the process goes on
        self._leave()

    def _leave(self) -> None:
        if self._folder is not None:
            remove_tree(self._folder)
        self._over.set()

    def _log(self, message: LogMessage) -> None:
        point = self._mesh.point if self._mesh is not None else 0
        self._on_event(Log(LogLine(message.instance, message.status, message.category, message.message, point)))

    def _progress(self, point: int) -> None:
        now = time.monotonic()
        self._started = now if self._started is None else self._started
        if now - self._told < _STATUS_S:
            return
        self._told = now
        plan, elapsed = self._run.plan, now - self._started
        rate = point / elapsed if elapsed > 0.0 else 0.0
        progress = dict.fromkeys(plan.nodes, point)
        grid = plan.grid
        status = MeshStatus(
            self._run.mesh, "running", point, grid.last_point, grid.time(point), rate, rate * grid.step_size, progress
        )
        self._on_event(Status(status))
