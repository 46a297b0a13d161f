"""The server that forks the workers of a sweep, after it has imported what they need, and what a worker does.

It has one thread. Where that is as good as a new process, it is a fork of the program that uses it, which has imported
most of it. Knows nothing of sweeps but what workers import.
"""

# Processes (ADR 59). A fork copies the locks of other threads, which nobody would release, and what models have left in
# the memory of the process. So a program with threads, or one that has called models, gets a server of its own, which
# stays for its next sweep. Whether there are threads is known for certain just after a fork: libraries such as OpenBLAS
# end theirs before it. Until then the copy waits. It keeps no file of the program, never returns into its code, and
# collects none of its objects. The server ends with the program, because its socket ends then, and the kernel ends its
# workers with it. All of them ignore SIGINT, which is for the program.

from __future__ import annotations

import gc
import importlib
import locale
import os
import select
import signal
import socket
import sys
import threading
import time
import traceback
import warnings
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from multiprocessing import spawn, util
from multiprocessing.connection import Connection
from multiprocessing.reduction import ForkingPickler
from pathlib import Path
from typing import Any, Final

from ..errors import MeshLost
from ..instances.process_state import floating_point_changed
from ..run.process import die_with_parent
from ..run.threads import one_thread_from_now_on

__all__ = ["WorkerServer", "join", "prepare_workers", "serve"]

_ENDS_S: Final = 5.0
_PRELOADED: Final = "fmu_mesh.sweeps.preloaded"
_SERVER: Final = "import sys; sys.path[:] = {}; from fmu_mesh.sweeps.worker_server import serve; serve({})"
_CALLING_MODELS: Final = {"fmu_mesh.instances.fmi.opening", "fmu_mesh.instances.python.python_instance"}
"""Modules that a program has imported if we have called a model in it."""
_LIBRARIES: Final = "/binaries/"
"""The folder of the libraries in an FMU (FMI 2.0, 2.3), in the path of one that somebody else has loaded."""

_in_worker: list[bool] = []
_preparing = threading.Lock()
_ready: list[WorkerServer] = []
"""The server of the next pool, if it runs."""


def join(thread: threading.Thread, timeout: float | None = None) -> None:
    """Wait for the end of a thread, and until the system has it no more: the next sweep may fork this program."""
    thread.join(timeout)
    task, deadline = Path(f"/proc/self/task/{thread.native_id}"), time.monotonic() + _ENDS_S
    while not thread.is_alive() and task.exists() and time.monotonic() < deadline:
        os.sched_yield()


def prepare_workers() -> None:
    """Start what the workers need, while the program does something else; where it has no threads yet, it is faster."""
    with _preparing:
        _prepare()


def _prepare() -> None:
    if _ready and (_ready[0].is_fork or not _ready[0].is_usable()):  # a fork is the program as it was
        _ready.pop().close()
    if not _ready:
        _ready.append(WorkerServer())


class WorkerServer:
    """The process that forks workers, as this program sees it.

    Attributes:
        is_fork: whether it is a fork of this program, and then for one pool.
    """

    def __init__(self) -> None:
        self._control, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._user = os.getpid()
        self._codes: dict[int, int] = {}
        self._reading = threading.Lock()
        try:
            with theirs:
                pid = _forked(theirs.fileno())
                self.is_fork = pid is not None
                self._pid = pid if pid is not None else _executed(theirs.fileno())
        except OSError as error:
            raise _no_process(error.errno) from error

    @classmethod
    def taken(cls) -> WorkerServer:
        """The server for a new pool.

        Raises:
            MeshLost: the system starts no more processes.
        """
        if _in_worker:
            msg = "a worker has no workers of its own"
            raise RuntimeError(msg)
        with _preparing:
            if not (_ready and _ready[0].is_usable()):
                _prepare()
            return _ready.pop() if _ready[0].is_fork else _ready[0]

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
            raise _no_process(-pid)
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
        """End it; its workers have ended."""
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


def _no_process(number: int | None) -> MeshLost:
    text = f"the system starts no more processes: {os.strerror(number or 0)}"
    return MeshLost(text, hint="Is the limit of processes (`ulimit -u`) too low?")


def _forked(control: int) -> int | None:
    """Start the server as a fork of this process; None if a model could find there what it does not in a new one."""
    maps = Path("/proc/self/maps").read_text("utf-8", "replace")
    has_models = _CALLING_MODELS & sys.modules.keys() or _LIBRARIES in maps
    is_plain = locale.setlocale(locale.LC_NUMERIC) == "C" and not floating_point_changed()
    if threading.active_count() > 1 or has_models or not is_plain:
        return None
    waiting, go = os.pipe()
    _flush()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # of Python 3.12, for other threads
        pid = os.fork()
        if pid == 0:
            os.close(go)
            _as_process(lambda: serve(control) if os.read(waiting, 1) else None)
    os.close(waiting)
    is_alone = len(os.listdir("/proc/self/task")) == 1  # noqa: PTH208  numbers; threads of other libraries, too
    if is_alone:
        os.write(go, b"!")
    os.close(go)
    if is_alone:
        return pid
    os.waitpid(pid, 0)
    return None


def _executed(control: int) -> int:
    """Start the server as a program of its own."""
    # With -P, Python does not look for modules in the current folder: one may have a name of the standard library.
    command = [sys.executable, "-P", "-c", _SERVER.format(sys.path, control)]
    return util.spawnv_passfds(os.fsencode(sys.executable), command, [control])


def serve(control: int) -> None:
    """Be the server, until the program that uses it ends.

    Args:
        control: the descriptor of its socket.
    """
    _forget(control)
    gc.disable()  # what an import makes stays, and each collection would look at all of it
    importlib.import_module(_PRELOADED)
    gc.enable()
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
