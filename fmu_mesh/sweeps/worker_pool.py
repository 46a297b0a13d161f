"""The processes of a sweep on this host: pools of the standard library, each with one process.

With one process in each pool, the loss of a process costs one run, and it is known which one. A pool that lost its
process is replaced. The processes are forked from the fork server of `multiprocessing`, which has imported what all
need. They end with the process that uses them, and the fork server ends with them.
"""

# Threads: each pool of the standard library has one that calls `_ended`, and the sweep's thread submits. `_changing` of
# a worker is held while its jobs or its pool change; it can be taken again, because a future that has ended already
# calls back at once. Jobs of a lost process are given to the next one in their order, but for the one that ran (ADR
# 59). Processes: a worker ignores SIGINT, which is for the program that uses it, and ends with it (`_end_with_user`).

from __future__ import annotations

import ast
import os
import signal
import sys
import threading
from collections import deque
from collections.abc import Callable, Mapping
from concurrent.futures import Executor, Future
from concurrent.futures.process import BrokenProcessPool, ProcessPoolExecutor
from contextlib import suppress
from functools import partial
from inspect import currentframe
from multiprocessing import forkserver
from multiprocessing.connection import Connection
from multiprocessing.context import ForkServerContext
from multiprocessing.process import BaseProcess, parent_process
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

from ..errors import MeshLost
from ..run.child import how_it_ended
from ..run.threads import one_thread_from_now_on
from ..text import short_path

__all__ = ["WorkerLost", "WorkerPool", "prepare_workers", "unguarded_call"]

_ENDS_S = 5.0
_PRELOADED = "fmu_mesh.sweeps.preloaded"

T = TypeVar("T")


class WorkerLost(MeshLost):
    """The process that was running a variant has ended: it was killed, or an FMU crashed it.

    ``began`` says whether it was ready to run anything.
    """

    def __init__(self, message: str, *, began: bool) -> None:
        super().__init__(message)
        self.began = began


class WorkerPool(Executor):
    """Processes of this host, each with one job at a time and one waiting.

    A job whose process is lost raises `WorkerLost`; jobs that waited for that process run in its successor. `submit`
    may be called on one thread at a time.
    """

    def __init__(self, workers: int) -> None:
        self._workers = [_Worker() for _ in range(workers)]

    @property
    def pids(self) -> list[int]:
        """The process ids of the processes that run."""
        return [pid for worker in self._workers if (pid := worker.pid) is not None]

    def submit(self, fn: Callable[..., T], /, *args: Any, **kwargs: Any) -> Future[T]:  # noqa: ANN401  those of any function
        """Run a job in the process with the fewest ones."""
        worker = min(self._workers, key=lambda own: len(own.jobs))
        return worker.submit(partial(fn, *args, **kwargs))

    def replace(self, pid: int) -> None:
        """End a process, which runs no job, because it is of no use any more; another one takes its place."""
        for worker in self._workers:
            if worker.pid == pid:
                worker.replace()

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:  # noqa: FBT001, FBT002  as the base has it
        """End all processes: when they have done their jobs, or at once with ``cancel_futures``."""
        for worker in self._workers:
            worker.shutdown(wait=wait, now=cancel_futures)


def prepare_workers() -> None:
    """Start the fork server, which imports what all workers need, while the program does something else."""
    _Context()
    forkserver.ensure_running()


def unguarded_call() -> str | None:
    """The line at the top of the main program that calls this, if the workers would come to it when they import it.

    Without `if __name__ == "__main__":` before it they would. They do not import the main program of a notebook or of
    an interactive session, which is no file, or that of a package.
    """
    main = sys.modules["__main__"]
    file, spec = getattr(main, "__file__", None), getattr(main, "__spec__", None)
    frame = currentframe()
    while frame is not None and not (frame.f_globals is vars(main) and frame.f_code.co_name == "<module>"):
        frame = frame.f_back
    if frame is None or file is None or (spec is not None and spec.name.endswith("__main__")):
        return None
    try:
        tree = ast.parse(Path(file).read_bytes())
    except (OSError, SyntaxError, ValueError):
        return None
    tests = [one for one in ast.walk(tree) if isinstance(one, ast.If) and "__name__" in ast.unparse(one.test)]
    is_guarded = any(one.lineno <= frame.f_lineno <= (one.end_lineno or one.lineno) for one in tests)
    is_own = Path(frame.f_code.co_filename).name == Path(file).name  # and no cell of a notebook
    return f"{short_path(file)}:{frame.f_lineno}" if is_own and not is_guarded else None


class _Job(NamedTuple):
    function: Callable[[], Any]
    future: Future[Any]


class _Worker:
    """One process and its successors."""

    def __init__(self) -> None:
        self.jobs: deque[_Job] = deque()  # what it has to do, the job that runs first
        self._changing = threading.RLock()
        self._closed = False
        self._renew()

    @property
    def pid(self) -> int | None:
        started = self._context.started
        return started[-1].pid if started else None

    def submit(self, function: Callable[[], T]) -> Future[T]:
        job = _Job(function, Future())
        with self._changing:
            self.jobs.append(job)
            self._give(job)
        return job.future

    def replace(self) -> None:
        with self._changing:
            if self._closed:
                return
            old, context = self._pool, self._context
            self._renew()
            context.kill()
            context.exit_code()  # it may have begun its next job, whose file it keeps open until it is gone
            for job in self.jobs:
                self._give(job)
        old.shutdown(wait=False, cancel_futures=True)

    def shutdown(self, *, wait: bool, now: bool) -> None:
        with self._changing:
            self._closed = True
            jobs = list(self.jobs)
        if now:
            self._context.kill()
            for job in jobs:
                job.future.cancel()
        self._pool.shutdown(wait=wait, cancel_futures=now)

    def _renew(self) -> None:
        self._context = _Context()
        self._began, telling = self._context.Pipe(duplex=False)
        self._pool = ProcessPoolExecutor(1, self._context, initializer=_begin, initargs=(telling, dict(os.environ)))

    def _give(self, job: _Job) -> None:
        try:
            future = self._pool.submit(job.function)
        except BrokenProcessPool:
            if len(self.jobs) > 1:
                return  # another job is about to tell the loss, and then this one is given to the next process
            self._renew()
            future = self._pool.submit(job.function)
        future.add_done_callback(partial(self._ended, self._pool, job))

    def _ended(self, pool: ProcessPoolExecutor, job: _Job, done: Future[Any]) -> None:
        """On a thread of a pool: a job is done, or its process is lost."""
        with self._changing:
            if pool is not self._pool or job not in self.jobs:
                return
            error = None if done.cancelled() else done.exception()
            if isinstance(error, BrokenProcessPool) and not self._closed:
                self._lost()
                return
            self.jobs.remove(job)
        if not done.cancelled() and job.future.set_running_or_notify_cancel():
            if error is not None:
                job.future.set_exception(error)
            else:
                job.future.set_result(done.result())

    def _lost(self) -> None:
        """The process is gone: the job that ran is lost, and the others go to the next process."""
        context, began = self._context, self._began.poll()
        self._renew()
        lost = self.jobs.popleft()
        for job in self.jobs:
            self._give(job)
        code = context.exit_code()
        how = how_it_ended(code) if code is not None else "is gone"
        lost.future.set_exception(WorkerLost(f"the worker process {how}", began=began))


class _Context(ForkServerContext):
    """The fork server, and what it has started for one pool."""

    def __init__(self) -> None:
        super().__init__()
        self.started: list[BaseProcess] = []
        self.set_forkserver_preload([_PRELOADED])

    def Process(self, *args: Any, **kwargs: Any) -> BaseProcess:  # type: ignore[override]  # noqa: ANN401, N802  a class in the base
        """Make a process, and keep it: its exit code tells how it ended."""
        self.started.append(ForkServerContext.Process(*args, **kwargs))
        return self.started[-1]

    def kill(self) -> None:
        for process in self.started:
            with suppress(ValueError):  # it is closed
                process.kill()

    def exit_code(self) -> int | None:
        """The exit code of the process that has just ended; negative: a signal."""
        if not self.started:
            return None
        self.started[-1].join(_ENDS_S)
        return self.started[-1].exitcode


def _begin(telling: Connection, environment: Mapping[str, str]) -> None:
    """In a new worker: Ctrl-C is for the process that uses it, with which it ends."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    os.environ.clear()  # it is that of the time when the fork server started
    os.environ.update(environment)
    one_thread_from_now_on()
    threading.Thread(target=_end_with_user, name="user", daemon=True).start()
    telling.send_bytes(b"ready")


def _end_with_user() -> None:
    """End this worker when the process that uses it is gone: the fork server, its parent, waits for the workers."""
    user = parent_process()
    assert user is not None
    user.join()
    os._exit(MeshLost.exit_code)
