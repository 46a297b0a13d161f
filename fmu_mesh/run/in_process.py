"""A run in this process, with the interface of `Launcher`: `launch --local`, `Mesh.run(processes=False)`.

`RepeatedRuns` steps and records; around it are a thread of its own, the folder of the run, events, and an end within
a second where an FMU does not return.
"""

# Who meets here (ADR 12, 73). A thread of the run does all the work, and alone calls FMUs. The thread that called
# `InProcessRun.run` waits, and looks whether each write returns in time (ADR 89). The thread of `CallWatch` takes a
# hang: the thread of the run is inside an FMU then and changes nothing, so that the rows can be saved from outside.
# `interrupt` may come from any thread or a signal handler; a thread "grace" gives up if the run does not come to its
# next point.
#
# What may go wrong: a call into an FMU that does not return cannot be ended from within a process. Then the run is over
# for whoever waits for it, what was recorded is kept, and the thread is left. Neither signal handlers nor the process
# as a whole are touched, so that a program can have several such runs. A process that ends with its run, as that of
# `launch --local`, closes the instances after it has printed everything: an FMU may crash there.

from __future__ import annotations

import atexit
import os
import sys
import threading
import time
from collections.abc import Callable
from contextlib import closing, suppress
from functools import partial
from pathlib import Path

from ..awake import AwakeClock
from ..errors import DeadlineExceeded, FmuMeshError, Interrupted
from ..files import remove_tree
from ..instances.call_guard import ENDED
from ..instances.contract import LogMessage
from ..instances.process_end import end_process, process_ends
from ..results.record_files import open_results
from ..wire.runtime import remove_stale_folders, run_folder, run_name
from ..wire.views import MeshStatus
from .events import Event, Log, Status, log_line
from .outcome import Outcome, outcome_at
from .repeated import RepeatedRuns
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
        self._closed = threading.Event()
        self._runs: RepeatedRuns | None = None
        self._interrupted = False
        self._folder: Path | None = None

    def run(self) -> Outcome:
        """Run from the first to the last point.

        Raises:
            FmuMeshError: the run ended early, and why.
        """
        threading.Thread(target=self._work, name=f"run of {self._run.mesh}", daemon=True).start()
        clock = AwakeClock()
        while not self._over.wait(_STATUS_S):
            self._check_writing(clock())
        if self._error is not None:
            if isinstance(self._error, FmuMeshError):
                runs = self._runs
                point, warnings = (runs.point, runs.warnings) if runs is not None else (0, ())
                files = runs.writer.counted if runs is not None and runs.writer is not None else ()
                self.outcome = outcome_at(self._run.plan, point, files, self._error, warnings=warnings)
                self._on_event(self.outcome)
            raise self._error
        assert self.outcome is not None
        self._on_event(self.outcome)
        return self.outcome

    def interrupt(self) -> None:
        """From any thread: end the run at its next point; if it does not come there in time, without it."""
        self._interrupted = True
        if self._runs is not None:
            self._runs.interrupt("interrupted")
        threading.Thread(target=self._give_up, name="grace", daemon=True).start()

    def _check_writing(self, now: float) -> None:
        """On the thread that waits: if a disk does not take what is written, the run is over."""
        if (runs := self._runs) is None or (writer := runs.writer) is None:
            return
        try:
            writer.check_writing(now, self._run.plan.system.config.timeouts.write)
        except DeadlineExceeded as error:
            runs.interrupt("a write has not returned")  # if it does later, nothing goes on
            self._take(error.at(runs.point, self._run.plan.grid.time(runs.point)))
            self._leave()

    def _work(self) -> None:
        plan = self._run
        try:
            remove_stale_folders()
            self._folder = folder = run_folder(plan.mesh, run_name())
            (fmus := folder / "fmus").mkdir()
            before_close = self._wait_for_exit if process_ends() else None
            with closing(
                RepeatedRuns(fmus, log=self._log, progress=self._progress, on_hang=self._end, before_close=before_close)
            ) as runs:
                self._runs = runs
                if self._interrupted:
                    runs.interrupt("interrupted")
                system, digest = plan.plan.system, plan.plan.digest
                open_files = partial(open_results, plan.loaded, system, digest=digest, contents=plan.contents)
                self._take(runs.run(plan, open_files))
        except BaseException as error:  # noqa: BLE001 `run` raises it on the thread of the caller
            self._take(error)
        self._leave()
        self._closed.set()

    def _take(self, end: Outcome | BaseException) -> None:
        """Note how the run has ended; the first answer counts."""
        if self.outcome is not None or self._error is not None:
            return
        if isinstance(end, Outcome):
            self.outcome = end
        else:
            self._error = end

    def _wait_for_exit(self, end: Outcome | BaseException) -> None:
        """On the thread of the run, which closes the instances next: when the process is about to end."""
        if self._over.is_set():
            return
        self._take(end)
        ending = threading.Event()

        def exits() -> None:
            with suppress(OSError):  # nobody reads it
                sys.stdout.flush()
            os.dup2(2, 1)  # standard output is for results, and not for what an FMU prints
            ending.set()
            self._closed.wait()  # each call has its deadline

        atexit.register(exits)
        self._over.set()
        ending.wait()

    def _give_up(self) -> None:
        if not self._over.wait(_GRACE_S) and (runs := self._runs) is not None:
            error = Interrupted("interrupted", point=runs.point, time=self._run.plan.grid.time(runs.point))
            runs.save(error)
            self._end(error)

    def _end(self, error: FmuMeshError) -> None:
        """From another thread: the thread of the run does not return from an FMU."""
        if self._over.is_set():  # the outcome is printed
            self._leave()
            sys.stderr.write(f"fmu-mesh: warning: {error}\n")
            end_process()
        self._take(error.saying(error.message.removesuffix(ENDED)))  # here, the process goes on
        self._leave()

    def _leave(self) -> None:
        if self._folder is not None:
            remove_tree(self._folder)
        self._over.set()

    def _log(self, message: LogMessage) -> None:
        self._on_event(Log(log_line(message, self._run.plan.system.instances[message.instance].step_points)))

    def _progress(self, point: int) -> None:
        now = time.monotonic()
        self._started = now if self._started is None else self._started
        if now - self._told < _STATUS_S:
            return
        self._told = now
        plan, elapsed = self._run.plan, now - self._started
        grid, progress = plan.grid, dict.fromkeys(plan.nodes, point)
        rate = (point - grid.first_point) / elapsed if elapsed > 0.0 else 0.0
        status = MeshStatus(
            self._run.mesh, "running", point, grid.last_point, grid.time(point), rate, rate * grid.step_size, progress
        )
        self._on_event(Status(status))
