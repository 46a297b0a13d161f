"""The processes of a sweep on this host, each with one job at a time.

The loss of a process costs its job, and it is known which one; the next job goes to its successor. `worker_server` has
what forks them.
"""

# Threads (ADR 59): one for each worker takes jobs from a queue, and waits for its process. That of the user ends them.

from __future__ import annotations

import ast
import sys
import threading
from collections.abc import Callable
from concurrent.futures import Executor, Future
from contextlib import suppress
from functools import partial
from inspect import currentframe
from multiprocessing.connection import Connection, Pipe
from multiprocessing.reduction import ForkingPickler
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import Any, TypeVar

from ..errors import MeshLost
from ..run.child import how_it_ended
from ..text import short_path
from .worker_server import WorkerServer, join

__all__ = ["WorkerLost", "WorkerPool", "unguarded_call"]

T = TypeVar("T")

_Jobs = SimpleQueue[tuple[Callable[[], Any], Future[Any]] | None]


class WorkerLost(MeshLost):
    """The process that was running a variant has ended: it was killed, or an FMU crashed it.

    ``began`` says whether it was ready to run anything.
    """

    def __init__(self, message: str, *, began: bool) -> None:
        super().__init__(message)
        self.began = began


class WorkerPool(Executor):
    """Processes of this host. A job whose process is lost raises `WorkerLost`, and the others go on.

    Args:
        workers: how many processes.
        is_spent: whether a process is of no use after a job with this result; another one takes its place.
    """

    def __init__(self, workers: int, is_spent: Callable[[Any], bool] = lambda _result: False) -> None:
        self._server = WorkerServer.taken()
        self._jobs: _Jobs = SimpleQueue()
        self._workers = [_Worker(self._server, self._jobs, is_spent) for _ in range(workers)]

    @property
    def pids(self) -> list[int]:
        """The process ids of the processes that run."""
        return [worker.pid for worker in self._workers if worker.pid]

    def submit(self, fn: Callable[..., T], /, *args: Any, **kwargs: Any) -> Future[T]:  # noqa: ANN401  those of any function
        """Run a job in the next process that has none."""
        future: Future[T] = Future()
        self._jobs.put((partial(fn, *args, **kwargs), future))
        return future

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:  # noqa: FBT001, FBT002  as the base has it
        """End all processes: when they have done their jobs, or at once with ``cancel_futures``."""
        with suppress(Empty):
            while cancel_futures and (job := self._jobs.get_nowait()) is not None:
                job[1].cancel()
        for worker in self._workers:
            worker.end(now=cancel_futures)
        for worker in self._workers if wait else ():
            join(worker.thread)
        if wait and self._server.is_fork:
            self._server.close()


def unguarded_call() -> str | None:
    """The line at the top of the main program that calls this, if workers would come to it when they import it.

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


class _Worker:
    """One process and its successors, and the thread that gives them jobs."""

    def __init__(self, server: WorkerServer, jobs: _Jobs, is_spent: Callable[[Any], bool]) -> None:
        self.pid = 0
        self._server, self._jobs, self._is_spent = server, jobs, is_spent
        self._pipe: Connection | None = None
        self._ends = self._began = False
        self.thread = threading.Thread(target=self._run, name="worker", daemon=True)
        self.thread.start()

    def end(self, *, now: bool) -> None:
        self._ends = now
        if now:
            self._kill()
        self._jobs.put(None)

    def _run(self) -> None:
        """Do the jobs of the queue, until there are no more."""
        with suppress(MeshLost, OSError):  # the first job meets the same error, and tells it
            self._begin()
        while (job := self._jobs.get()) is not None:
            function, future = job
            if not future.set_running_or_notify_cancel():
                continue
            try:
                is_done, answer = self._answer(ForkingPickler.dumps(function))
            except Exception as error:  # noqa: BLE001  whoever waits for the job gets it
                is_done, answer = False, error
            if is_done and self._is_spent(answer):
                self._kill()
                self._let_go()
            (future.set_result if is_done else future.set_exception)(answer)
        self._let_go()

    def _answer(self, job: memoryview) -> tuple[bool, Any]:
        """Whether a job has returned, and what it has returned or raised.

        Raises:
            WorkerLost: the process has ended before.
            MeshLost: there are no more processes.
        """
        try:
            pipe = self._begin()
            if not self._began:
                pipe.recv()
                self._began = True
            pipe.send_bytes(job)
            answer: tuple[bool, Any] = pipe.recv()
        except (EOFError, OSError) as error:
            began, code = self._began, self._let_go()
            how = how_it_ended(code) if code is not None else "is gone"
            raise WorkerLost(f"the worker process {how}", began=began) from error
        return answer

    def _begin(self) -> Connection:
        """Start a process, if there is none."""
        if self._pipe is None:
            own, theirs = Pipe()
            with theirs:
                self.pid = self._server.fork(theirs.fileno())
            self._pipe, self._began = own, False
            if self._ends:
                self._kill()
            own.send(self._server.preparation())
        return self._pipe

    def _let_go(self) -> int | None:
        """Wait for the end of the process, which has no job; returns its exit code, if that is known."""
        if self._pipe is None:
            return None
        self._pipe.close()
        self._pipe, pid, self.pid = None, self.pid, 0
        return self._server.code_of(pid)

    def _kill(self) -> None:
        if pid := self.pid:
            self._server.kill(pid)
