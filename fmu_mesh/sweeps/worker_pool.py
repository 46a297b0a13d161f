"""The processes of a sweep on this host, each with one job at a time.

The loss of a process costs its job, and it is known which one; the next job goes to its successor. A server with one
thread forks them, after it has imported what they need. Where that is as good as a new process, it is a fork of the
program that uses them, which has imported most of it.
"""

# Processes (ADR 59). A fork copies the locks of other threads, which nobody would release, and what models have left in
# the memory of the process. So a program with threads, or one that has called models, gets a server of its own, which
# stays for its next sweep. Whether there are threads is known for certain just after a fork: libraries such as OpenBLAS
# end theirs before it. Until then the copy waits. It keeps no file of the program, never returns into its code, and
# collects none of its objects. The server ends with the program, because its socket ends then, and the kernel ends its
# workers with it. All of them ignore SIGINT, which is for the program.
#
# Threads: one for each worker takes jobs from a queue, and waits for the process. What the server tells is read under
# a lock.

from __future__ import annotations

import ast
import gc
import importlib
import locale
import os
import select
import signal
import socket
import sys
import threading
import traceback
import warnings
from collections.abc import Callable
from concurrent.futures import Executor, Future
from contextlib import suppress
from functools import partial
from inspect import currentframe
from multiprocessing import spawn, util
from multiprocessing.connection import Connection, Pipe
from multiprocessing.reduction import ForkingPickler
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import Any, Final, TypeVar

from ..errors import MeshLost
from ..run.child import how_it_ended
from ..run.process import die_with_parent
from ..run.threads import one_thread_from_now_on
from ..text import short_path

__all__ = ["WorkerLost", "WorkerPool", "prepare_workers", "serve", "unguarded_call"]

_ENDS_S: Final = 5.0
_PRELOADED: Final = "fmu_mesh.sweeps.preloaded"
_SERVER: Final = "import sys; sys.path[:] = {}; from fmu_mesh.sweeps.worker_pool import serve; serve({})"
_CALLING_MODELS: Final = {"fmpy.fmi1", "fmu_mesh.instances.python.python_instance"}
"""Modules that a program has imported if it, or we, may have called a model in it."""

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
        if _in_worker:
            msg = "a worker has no workers of its own"
            raise RuntimeError(msg)
        if not (_ready and _ready[0].is_usable()):
            prepare_workers()
        self._server = _ready.pop() if _ready[0].is_fork else _ready[0]
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
            worker.thread.join()
        if wait and self._server.is_fork:
            self._server.close()


def prepare_workers() -> None:
    """Start what the workers need, while the program does something else; where it has no threads yet, it is faster."""
    if _ready and (_ready[0].is_fork or not _ready[0].is_usable()):  # a fork is the program as it was
        _ready.pop().close()
    if not _ready:
        _ready.append(_Server())


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

    def __init__(self, server: _Server, jobs: _Jobs, is_spent: Callable[[Any], bool]) -> None:
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


class _Server:
    """The process that forks workers, as this program sees it.

    Attributes:
        is_fork: whether it is a fork of this program, and then for one pool.
    """

    def __init__(self) -> None:
        self._control, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._user = os.getpid()
        self._codes: dict[int, int] = {}
        self._reading = threading.Lock()
        with theirs:
            pid = _forked(theirs.fileno())
            self.is_fork = pid is not None
            self._pid = pid if pid is not None else _executed(theirs.fileno())

    def is_usable(self) -> bool:
        """Whether it runs, and serves this process, which may be a fork of the one that started it."""
        with suppress(ChildProcessError):
            return self._user == os.getpid() and os.waitpid(self._pid, os.WNOHANG)[0] == 0
        return False

    def preparation(self) -> tuple[dict[str, str], dict[str, Any]] | None:
        """What a worker gets to be as this program, if it is no fork of it."""
        if self.is_fork:
            return None
        main = spawn.get_preparation_data("worker")
        del main["authkey"]  # a worker connects to nobody
        return dict(os.environ), main

    def fork(self, descriptor: int) -> int:
        """Start a worker, whose jobs come by this descriptor; returns its process id.

        Raises:
            MeshLost: no more processes start.
        """
        try:
            with self._reading:
                socket.send_fds(self._control, [b"fork"], [descriptor])
                while not (pid := self._told()):
                    continue
        except OSError as error:
            raise MeshLost(f"no worker process starts: {error.strerror or error}") from error
        if pid < 0:
            hint = "Is the limit of processes (`ulimit -u`) too low?"
            raise MeshLost(f"the system starts no more processes: {os.strerror(-pid)}", hint=hint)
        return pid

    def kill(self, pid: int) -> None:
        """Kill a worker, if it still runs: nobody else knows whether another process has its id."""
        with suppress(OSError):
            self._control.send(str(pid).encode())

    def code_of(self, pid: int) -> int | None:
        """The exit code of a worker that ends now; negative: a signal. None if it does not end, or nobody knows."""
        with suppress(OSError), self._reading:
            while pid not in self._codes and select.select([self._control], [], [], _ENDS_S)[0]:
                self._told()
        return self._codes.pop(pid, None)

    def close(self) -> None:
        """Let go of it: it ends now."""
        self._control.close()
        with suppress(ChildProcessError):  # this process is another one, or does not care for the end of its children
            os.waitpid(self._pid, 0)

    def _told(self) -> int:
        """The process id of a worker that was started, or an error number below 0; 0 if one has ended, as is noted."""
        pid, _, code = self._control.recv(64).decode().partition(" ")
        if not pid:
            msg = "what starts them has ended"
            raise ConnectionError(msg)
        if code:
            self._codes[int(pid)] = int(code)
        return 0 if code else int(pid)


_in_worker: list[bool] = []
_ready: list[_Server] = []
"""The server of the next pool, if it runs."""


def _forked(control: int) -> int | None:
    """Start the server as a fork of this process; None if this has other threads, or may have called models."""
    is_fresh = not _CALLING_MODELS & sys.modules.keys() and locale.setlocale(locale.LC_NUMERIC) == "C"
    if threading.active_count() > 1 or not is_fresh:
        return None
    waiting, go = os.pipe()
    _flush()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # of Python 3.12 for threads; see below
        pid = os.fork()
        if pid == 0:
            os.close(go)
            _as_process(lambda: serve(control) if os.read(waiting, 1) else None)
    os.close(waiting)
    is_alone = len(os.listdir("/proc/self/task")) == 1  # noqa: PTH208  numbers
    if is_alone:
        os.write(go, b"!")
    os.close(go)
    if is_alone:
        return pid
    os.waitpid(pid, 0)
    return None


def _executed(control: int) -> int:
    """Start the server as a program of its own."""
    # With -P, Python does not look for modules in the current folder, where one may have a name of the standard library.
    command = [sys.executable, "-P", "-c", _SERVER.format(sys.path, control)]
    return util.spawnv_passfds(os.fsencode(sys.executable), command, [control])


def serve(control: int) -> None:
    """Be the server, until the program that uses it ends.

    Args:
        control: the descriptor of its socket.
    """
    _forget(control)
    importlib.import_module(_PRELOADED)
    gc.freeze()  # the memory of all that is there stays shared
    own, running = socket.socket(fileno=control), dict[int, int]()
    while True:
        watched: list[socket.socket | int] = [own, *running]
        ready, _, _ = select.select(watched, [], [])
        for ended in running.keys() & {*ready}:
            pid = running.pop(ended)
            os.close(ended)
            own.send(f"{pid} {os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])}".encode())
        if own not in ready:
            continue
        asked, descriptors, _, _ = socket.recv_fds(own, 16, 1)
        if not asked:
            return
        if descriptors:
            pid = _started(own, descriptors[0])
            if pid > 0:
                running[os.pidfd_open(pid)] = pid
            own.send(str(pid).encode())
        elif int(asked) in running.values():
            os.kill(int(asked), signal.SIGKILL)


def _forget(control: int) -> None:
    """Keep nothing of the program, if this is a fork of it: neither its signals, nor its objects, nor its files."""
    signal.set_wakeup_fd(-1)
    for number in signal.valid_signals():
        if callable(signal.getsignal(number)):
            signal.signal(number, signal.SIG_DFL)
    signal.signal(signal.SIGCHLD, signal.SIG_DFL)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    gc.freeze()
    nothing = os.open(os.devnull, os.O_RDWR | os.O_CLOEXEC)
    for name in os.listdir("/proc/self/fd"):  # noqa: PTH208  numbers
        if int(name) not in {1, 2, control, nothing}:
            os.dup2(nothing, int(name), inheritable=False)


def _started(own: socket.socket, descriptor: int) -> int:
    """Fork a worker, which gets its jobs by a descriptor: its process id, or an error number below 0."""
    server = os.getpid()
    try:
        pid = os.fork()
    except OSError as error:
        pid = -(error.errno or 1)
    if pid == 0:
        own.close()
        _as_process(partial(_work, descriptor, server))
    os.close(descriptor)
    return pid


def _work(descriptor: int, server: int) -> None:
    """Be a worker: do one job after another."""
    die_with_parent(signal.SIGKILL)
    if os.getppid() != server:  # it has ended before
        return
    _in_worker.append(True)
    pipe = Connection(descriptor)
    if (prepared := pipe.recv()) is not None:
        environment, main = prepared
        os.environ.clear()
        os.environ.update(environment)
        spawn.prepare(main)
    if (random := sys.modules.get("numpy.random")) is not None:  # Python itself does so with `random`
        random.seed()
    one_thread_from_now_on()
    pipe.send(None)
    while True:
        try:
            job = pipe.recv_bytes()
        except (EOFError, OSError):
            return
        try:
            answer = True, ForkingPickler.loads(job)()
        except Exception as error:  # noqa: BLE001  whoever waits for the job gets it
            answer = False, error
        _flush()
        pipe.send(answer)


def _as_process(work: Callable[[], object]) -> None:
    """Do this in a process that was just forked, and end it: it never returns into the code of the program."""
    code = 1
    try:
        work()
        code = 0
    except BaseException:  # noqa: BLE001  nobody else would tell it
        traceback.print_exc()
    finally:
        _flush()
        os._exit(code)


def _flush() -> None:
    for stream in (sys.stdout, sys.stderr):
        with suppress(AttributeError, ValueError, OSError):  # there is none, or nobody reads it
            stream.flush()
