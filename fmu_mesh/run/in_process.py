"""A whole run in this process, on a thread of its own: `launch --local`, and `Mesh.run(processes=False)`.

Neither signal handlers nor the process as a whole are touched, so a program can have several such runs. A call into an
FMU that does not return cannot be ended from within a process: then the run is over for whoever waits for it, what was
recorded is kept, and the thread is left.

A process that ends with its run, as that of `launch --local`, closes the instances after it has printed everything.
"""

from __future__ import annotations

import atexit
import os
import sys
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

from ..errors import FmuError, FmuMeshError, Interrupted
from ..files import remove_tree
from ..instances.call_guard import ENDED
from ..instances.contract import LogMessage
from ..instances.process_end import end_process, process_ends
from ..wire.runtime import remove_stale_folders, run_folder, run_name
from ..wire.views import LogLine, MeshStatus
from .events import Event, Log, Status
from .local import LocalMesh
from .outcome import Outcome, outcome_at
from .run_plan import RunPlan

__all__ = ["InProcessRun"]

_STATUS_S = 0.1
_GRACE_S = 1.0
"""How long an interrupted run may take to come to its next point."""


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
