"""`sweep` and `Sweep`: run the variants of a mesh on an executor, and follow them.

A sweep, in pseudocode::

    for the next variants without a row, while few jobs are under way:
        executor.submit(run_variants, task, ...)           # fmu_mesh.sweeps.variant_run, in a worker
    as each job ends:
        its worker is lost: submit them again, each alone  # fmu_mesh.sweeps.worker_pool
        otherwise:          add its rows to the folder     # fmu_mesh.sweeps.sweep_folder
    at the end: write the table

What schedules is the executor: processes of this host by default, or any `concurrent.futures.Executor`.
"""

# Threads: the one of the sweep gives variants to the executor, and alone writes rows (ADR 59). Threads of the executor
# only put the futures that have ended into a queue. The thread of the user follows, or cancels: an Event that is looked
# at between two rows.

from __future__ import annotations

import gc
import os
import threading
import time
from abc import ABC, abstractmethod
from collections import Counter, deque
from collections.abc import Iterable, Iterator, Mapping
from concurrent.futures import BrokenExecutor, Executor, Future
from contextlib import contextmanager, nullcontext
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import Any, Final, NamedTuple, Self

from ..api.mesh_builder import Mesh
from ..config.call_options import takes
from ..errors import CallRefused, FmuMeshError, Interrupted, KeyboardInterrupted, MeshLost
from ..pictures.notebook_progress import ShownProgress, awaited
from ..text import counted
from ..wire.runtime import remove_stale_folders
from .planned_sweep import PlannedSweep, planned_sweep
from .sweep_folder import RowFile
from .sweep_options import SweepOptions
from .sweep_result import SweepResult
from .variant_run import Row, run_variants
from .worker_pool import WorkerLost, WorkerPool, unguarded_call
from .worker_server import join, prepare_workers

__all__ = ["ExecutorSweep", "Sweep", "SweepPart", "SweepProgress", "sweep"]

_TRIES: Final = 2
# How late a cancelled sweep stops: the end of a variant is an event, a cancellation is not.
_CANCEL_CHECK_S: Final = 0.2
_JOIN_S: Final = 10.0
_AHEAD: Final = 2
"""Jobs under way for each worker: one waits, so that the worker never does."""
_JOB_S: Final = 0.1
"""Short variants go to our own workers in jobs that take about so long: so much is lost with a worker or a sweep."""
_ELSEWHERE: Final = 64
"""Jobs of one variant under way on an executor of the user, whose number of workers is not known."""
_KILLED: Final = "KilledWorker"
"""The class with which Dask says that a job has ended several workers."""
_GUARD: Final = 'Write `if __name__ == "__main__":` before what your program does.'


class SweepPart(NamedTuple):
    """One of several parts of a sweep, numbered from 1 on, such as a task of an array of jobs."""

    number: int
    of: int


class SweepProgress(NamedTuple):
    """How far a sweep is.

    Attributes:
        total: number of variants.
        done: how many have a row, those of an earlier sweep included.
        failed: how many of these have failed.
        seconds: wall-clock time since the start in s.
        left: estimated time to the end in s; None while nothing is known.
    """

    total: int
    done: int
    failed: int
    seconds: float
    left: float | None


class Sweep(ABC):
    """A sweep that goes on; `fmu_mesh.sweep` starts it.

    Use it as a context manager, or call `wait` or `close`.

    Example:
        >>> import fmu_mesh
        >>> vary = {"pendulum.d": fmu_mesh.Range(0.1, 0.8, 4)}
        >>> options = {"stop_time": 1.0, "folder": "results/four"}
        >>> with fmu_mesh.sweep("configs/pendulum_delay.yaml", vary, **options) as running:
        ...     result = running.wait()
        ...     running.progress.done, running.progress.total, len(result)
        (4, 4, 4)
    """

    def __init__(self, planned: PlannedSweep, part: SweepPart | None = None) -> None:
        self._planned = planned
        self._part = part
        count = len(planned.wanted.identities)
        self._numbers = range(count) if part is None else range(part.number - 1, count, part.of)
        self._rows = {row.id: row for one in planned.wanted.identities if (row := planned.found.get(one)) is not None}
        self._waiting = deque(n for n in self._numbers if planned.wanted.identities[n] not in self._rows)
        self._left = self._to_do = len(self._waiting)
        self._failed = sum(1 for n in self._numbers if (row := self._row_at(n)) is not None and row.exit_code)
        self._started = time.monotonic()
        self._ended_at: float | None = None
        self._cancelled = threading.Event()
        self._interrupted = False
        self._end: Future[SweepResult] = Future()
        self._thread = threading.Thread(target=self._work, name=f"sweep of {self.mesh}", daemon=True)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __repr__(self) -> str:
        return f"<Sweep of {self._bar().text}>"

    def _repr_html_(self) -> str:
        return self._bar().html

    @property
    def mesh(self) -> str:
        """Name of the mesh."""
        return self._planned.wanted.mesh

    @property
    def ran(self) -> int:
        """How many variants have ended since the start."""
        return self._to_do - self._left

    @property
    def folder(self) -> Path:
        """The folder of the sweep."""
        return self._planned.folder.path

    @property
    def progress(self) -> SweepProgress:
        """How far it is."""
        seconds = (self._ended_at or time.monotonic()) - self._started
        total = len(self._numbers)
        left = 0.0 if not self._left else seconds / self.ran * self._left if self.ran else None
        return SweepProgress(total, total - self._left, self._failed, seconds, left)

    @property
    def result(self) -> SweepResult:
        """What has ended by now."""
        planned = self._planned
        return SweepResult(planned.wanted, planned.folder, self._so_far(), planned.columns, planned.plan.plan.system)

    def wait(self, timeout: float | None = None) -> SweepResult:
        """Wait for the end; a failed run is a row, and no error.

        Ctrl-C ends the sweep, and raises `KeyboardInterrupt`.

        Args:
            timeout: the longest time to wait in s; None: no limit.

        Raises:
            DeadlineExceeded: it goes on after this time.
            MeshLost: the executor runs nothing any more.
            ConfigurationError: the folder cannot be written.
            Interrupted: `interrupt` has ended it. Its `result` has the rows up to then, as that of the others.
        """
        try:
            return awaited(self._end, timeout, "the sweep", self._bar)
        except KeyboardInterrupt as error:
            if isinstance(error, FmuMeshError):
                raise
            self.interrupt()
            self.close()
            raise KeyboardInterrupted("interrupted", hint=self._way_on()).with_result(self.result) from None

    def cancel(self) -> None:
        """End it without an error: variants that are under way are lost, and `wait` returns the rows of the others."""
        self._cancelled.set()

    def interrupt(self) -> None:
        """As `cancel`, and `wait` raises `Interrupted`. It may be called in a signal handler."""
        self._interrupted = True
        self._cancelled.set()

    def close(self) -> None:
        """Let go of the sweep; if it goes on, it is cancelled. May be called twice."""
        self._cancelled.set()
        join(self._thread, _JOIN_S)

    def _bar(self) -> ShownProgress:
        now = self.progress
        left = f", {now.left:.0f} s left" if now.left else ""
        text = f"{self.mesh}: {now.done} of {counted(now.total, 'run')}, {now.failed} failed{left}"
        return ShownProgress(text, now.done, now.total)

    def _so_far(self) -> list[Row | None]:
        return [self._row_at(number) for number in range(len(self._planned.wanted.identities))]

    def _row_at(self, number: int) -> Row | None:
        return self._rows.get(self._planned.wanted.identities[number])

    def _way_on(self) -> str:
        done, total = len(self._numbers) - self._left, len(self._numbers)
        return f"{done} of {total} runs are in '{self.folder}'; `resume=True` runs the others."

    def _take(self, row: Row) -> None:
        self._rows[row.id] = row
        self._left -= 1
        self._failed += row.exit_code != 0

    @contextmanager
    def _table(self) -> Iterator[None]:
        """Write down what was asked; however the block ends, write the table of what is there then."""
        planned = self._planned
        planned.folder.begin(planned.wanted)
        try:
            yield
        finally:
            if self._rows:
                planned.folder.write_table(planned.wanted, self._so_far(), planned.columns)

    @abstractmethod
    def _run(self) -> None:
        """Run what is missing, until it has ended or the sweep is cancelled."""

    def _work(self) -> None:
        error: BaseException | None = None
        try:
            self._run()
            if self._interrupted and self._left:
                error = Interrupted("interrupted", hint=self._way_on())
        except BaseException as caught:  # noqa: BLE001  whoever waits gets it
            error = caught
        self._ended_at = time.monotonic()
        if error is None:
            self._end.set_result(self.result)
            return
        self._end.set_exception(error.with_result(self.result) if isinstance(error, FmuMeshError) else error)


class ExecutorSweep(Sweep):
    """A sweep whose variants run on an executor, which is not shut down here, or in as many processes of this host."""

    def __init__(
        self,
        planned: PlannedSweep,
        *,
        executor: Executor | None = None,
        workers: int | None = None,
        part: SweepPart | None = None,
    ) -> None:
        super().__init__(planned, part)
        if not workers:  # one for each processor that this process may use; fewer where a run has several processes
            processes = len(planned.plan.plan.nodes) + 1 if planned.wanted.processes else 1
            workers = len(os.sched_getaffinity(0)) // processes
        self._workers = max(1, min(workers, len(self._waiting), planned.at_once or len(self._waiting)))
        self._tries: Counter[int] = Counter()
        self._alone: set[int] = set()  # variants that were in a job whose worker was lost
        self._at_once = 1  # how many variants the next job has
        self._ended: SimpleQueue[Future[list[Row]]] = SimpleQueue()
        self._is_ours = executor is None
        self._executor = executor or WorkerPool(self._workers, lambda rows: bool(rows) and rows[-1].spent)
        self._thread.start()

    def _run(self) -> None:
        part = self._part.number if self._part is not None else None
        try:
            with self._planned.folder.writing(part) as rows, self._table() if part is None else nullcontext():
                self._run_variants(rows)
                if self._is_ours:  # they end while the table is written
                    self._executor.shutdown(wait=False, cancel_futures=bool(self._left))
        finally:
            if self._is_ours:
                self._executor.shutdown(cancel_futures=bool(self._left))
                remove_stale_folders()

    def _run_variants(self, rows: RowFile) -> None:
        """The loop of the module's docstring."""
        under_way: dict[Future[list[Row]], list[int]] = {}
        most = self._workers * _AHEAD if self._is_ours else _ELSEWHERE
        most = min(most, self._planned.at_once or most)
        try:
            while (self._waiting or under_way) and not self._cancelled.is_set():
                while self._waiting and len(under_way) < most:
                    numbers = self._next_job()
                    under_way[self._submit(numbers)] = numbers
                try:
                    future = self._ended.get(timeout=_CANCEL_CHECK_S)
                except Empty:
                    continue
                numbers = under_way.pop(future)
                found = self._rows_of(future, numbers)
                self._waiting.extendleft(reversed(numbers[len(found) :]))
                rows.add(found)
                for row in found:
                    self._take(row)
                if found and self._is_ours:
                    self._at_once = max(1, int(_JOB_S * len(found) / max(1e-6, sum(row.seconds for row in found))))
        finally:
            for future in under_way:
                future.cancel()

    def _next_job(self) -> list[int]:
        """Some of the variants that wait, so that all workers have some at the end."""
        count = min(self._at_once, -(-len(self._waiting) // (self._workers * _AHEAD)))
        numbers = [self._waiting.popleft()]
        while len(numbers) < count and not self._alone & {numbers[0], self._waiting[0]}:
            numbers.append(self._waiting.popleft())
        return numbers

    def _submit(self, numbers: list[int]) -> Future[list[Row]]:
        planned = self._planned
        variants = [(planned.wanted.identities[number], planned.wanted.parameters(number)) for number in numbers]
        try:
            future = self._executor.submit(run_variants, planned.task, planned.functions, variants, ours=self._is_ours)
        except RuntimeError as error:  # it is shut down, or broken
            raise self._executor_lost(error) from error
        future.add_done_callback(self._ended.put)
        return future

    def _rows_of(self, future: Future[list[Row]], numbers: list[int]) -> list[Row]:
        """The rows of variants that have ended; the others run again, because their worker was lost."""
        try:
            return future.result()
        except Exception as error:  # noqa: BLE001  `run_variants` itself raises nothing
            lost = error
        if isinstance(lost, WorkerLost) and not lost.began:
            text = f"the workers do not start: {lost.message} before it was ready"
            hint = f"What it was is on standard error. If the program has a thread for the sweep: {_GUARD}"
            raise MeshLost(text, hint=hint) from lost
        if len(numbers) > 1 and not isinstance(lost, BrokenExecutor):
            self._alone.update(numbers)
            return []
        self._tries[numbers[0]] += 1
        if self._tries[numbers[0]] < _TRIES and not isinstance(lost, BrokenExecutor):
            return []
        if isinstance(lost, WorkerLost) or type(lost).__name__ == _KILLED:
            text = f"{lost.message} in each of {_TRIES} attempts" if isinstance(lost, WorkerLost) else str(lost)
            return [Row(self._planned.wanted.identities[numbers[0]], MeshLost.exit_code, text, {}, 0.0, "")]
        raise self._executor_lost(lost) from lost

    def _executor_lost(self, error: BaseException) -> MeshLost:
        text = f"the executor runs no more variants: {type(error).__name__}: {error}".rstrip(": ")
        return MeshLost(text, hint=self._way_on())


@takes(SweepOptions)
def sweep(
    mesh: Mesh | str | Path, vary: Mapping[str, Any] | Iterable[Mapping[str, Any]], options: SweepOptions
) -> Sweep:
    """Run a mesh many times, with other values of its parameters; returns at once.

    Every run is a row of one table: parameters, exit code, message, and what `reduce` calculates from its curves. The
    floats of each run are those of `Mesh.run` with the same values, wherever it runs.

    Example:
        >>> import fmu_mesh
        >>> vary = {"pendulum.d": [0.1, 0.2, 0.4], "simulation.algorithm": ["jacobi", "gauss_seidel"]}
        >>> with fmu_mesh.sweep(
        ...     "configs/pendulum_delay.yaml", vary, stop_time=1.0, reduce=["min(pendulum.a)"], folder="results/six"
        ... ) as running:
        ...     result = running.wait()
        >>> len(result), result.columns
        (6, ('min(pendulum.a)',))
        >>> result[0].parameters, result[0].exit_code
        ({'pendulum.d': 0.1, 'simulation.algorithm': 'jacobi'}, 0)

    Args:
        mesh: the mesh, or its configuration file.
        vary: the values of each parameter, of which all combinations run: a list, a numpy array, or a `Range`. Or a
            list with the parameters of each variant. `instance.variable` is a start value, and any
            other name a key of the configuration.
        options: see `SweepOptions`.

    Raises:
        CallRefused: the program has no `if __name__ == "__main__":` before this, and the workers import it.
        ConfigurationError: the mesh, a parameter, or a column is wrong; or the folder holds another sweep.
    """
    if options.executor is None and (place := unguarded_call()) is not None:
        text = f"each worker of the sweep would come to '{place}', because it imports this program"
        raise CallRefused(text, hint=_GUARD)
    if options.executor is None:
        prepare_workers()
    collects = gc.isenabled()
    gc.disable()  # what the imports of a plan make stays, and each collection would look at all of it
    try:
        planned = planned_sweep(mesh, vary, **options.given())
    finally:
        if collects:
            gc.enable()
    return ExecutorSweep(planned, executor=options.executor, workers=options.workers)
