"""A whole mesh in one process: `launch --local`, and what any distributed run must equal in every float.

The loop over the points of a `LocalSystem`, with what a run has around them: the result file, progress, the wall clock
and the watch over FMUs that do not return.
"""

from __future__ import annotations

import logging
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
from ..instances.call_guard import CallWatch, Guarded
from ..instances.contract import Instance, LogMessage, Showing
from ..instances.process_end import process_ends
from ..instances.registry import open_instance
from ..master.pacing import Pacer
from ..recorder.growth import GrowthWatch
from ..recorder.row_buffer import RowBuffer
from ..system.layout import Layout
from ..system.plan import Plan
from .local_system import LocalSystem, opening_of
from .one_process import OneProcess
from .outcome import Outcome
from .results import open_results, what_is_kept

__all__ = ["LocalMesh"]

log = logging.getLogger(__name__)

_ROWS = 1024
_FLUSH_S = 0.2


class LocalMesh:
    """Runs a plan in this process, as fast as its real-time factor allows.

    ```python
    outcome = LocalMesh(prepare(Path("configs/pendulum_delay.yaml"))).run()
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
            error.with_hint(self._kept())
            raise
        finally:
            if closes:
                self.close()
        ended_by = self._ended_by.report() if self._ended_by is not None else None
        return Outcome(
            state="done",
            point=self.point,
            time=self._plan.grid.time(self.point),
            seconds=self._seconds,
            rows=self.files[0][1] if self.files else 0,
            file=self._plan.system.result_file,
            ended_by=ended_by,
            files=self.files,
            warnings=self.warnings,
        )

    def close(self) -> None:
        """Close the instances and remove their files. May be called twice."""
        self._stack.close()

    def _kept(self) -> str | None:
        return what_is_kept(self.files)

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
            system.start(partial(self._guarded, folder=self._folder, watch=watch))
            started = time.perf_counter()
            self._begun = True
            try:
                with watch.stepping(self._position, plan.system.config.timeouts.step):
                    self._loop(rows)
            finally:
                self._seconds = time.perf_counter() - started
        finally:
            self._save()

    def _guarded(self, name: str, folder: Path, watch: CallWatch) -> Guarded:
        return Guarded(name, lambda: self._open(name, folder), watch, self._plan.system.config.timeouts)

    def _open(self, name: str, folder: Path) -> Instance:
        if self._open_instance is not None:
            return self._open_instance(name)
        return open_instance(opening_of(self._plan, name, folder, self._log, self._showing))

    def _take_hang(self, error: FmuError) -> None:
        """From the watching thread. This is safe: the main thread is blocked in an FMU."""
        if self._begun:
            error.at(self._system.begun_at, self._plan.grid.time(self._system.begun_at))
        self._save_from_outside()
        self._on_hang(error.with_hint(self._kept()))

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
