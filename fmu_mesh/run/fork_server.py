"""The fork server: a process that has imported what the processes of a run need, and forks them.

It is started by exec, never forked from the program of a user, and has one thread and no Zenoh session. It imports, and
then forks a process for each request of its launcher. It loads no model. A forked process starts in milliseconds, and
shares the memory of all imported modules with the others.

Launcher and server share a pair of sockets. A request has the arguments of `fmu_mesh.run.__main__`, and two descriptors
for standard output and standard error; the numbers of further ones are its last arguments. The server answers with the
process id, and later with the exit code. When the launcher sends no more requests, the server ends after its last
process. A batch uses the server as a launcher does.
"""

# Who meets here (ADR 71). In the launcher: the thread of `Launcher.run`, which asks for processes, the thread "fork
# server" of `ForkServer`, which takes what the server answers, and for each process the thread of `Child` that waits
# for its end. `Forked` is what they share: what the server has told is set once, and the end is an `Event`. In the
# server: one thread, because only the thread that forks is there in the new process, and every lock that another one
# held would stay locked.
#
# Signals. SIGCHLD, SIGTERM and SIGINT of the server only write a byte into a pipe (the wakeup descriptor): the loop
# reads it between two requests, so no handler ever runs in the middle of a fork. They are blocked around `os.fork`: a
# signal for the server must not run its handler in the new process. The kernel signals the death of the launcher's
# thread to the server, and the death of the server to all it has forked.
#
# What may go wrong. The server is killed: nobody can tell exit codes any more, so each `Forked` becomes an orphan, and
# the code says that another process is missing. The server is stopped: it tells nothing, so `Forked.poll` asks the
# kernel as well; and where the launcher is killed then, SIGTERM would wait in the server for ever. So the server has
# SIGKILL for that until it forks, and afterwards a process whose standard input has ended wakes it
# (`fmu_mesh.run.process`). A process ends: it stays a zombie until the launcher knows its code, or another process
# could get its id, and a signal that was meant for it.

from __future__ import annotations

import gc
import os
import select
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from functools import partial
from typing import IO, Final

import msgspec

from ..errors import ConfigurationError, Interrupted, MeshLost
from ..wire.host_processes import is_alive
from .threads import ONE_THREAD

__all__ = ["ForkServer", "Forked", "executed", "executed_command", "fork_server", "serve", "started_ahead"]

Job = Callable[[], None]
"""What a process does, from its start to its end."""

_ROOM: Final = "-" * 64
"""An argument that makes room for the titles of the processes: a title is not longer than the command."""

_SIGNALS: Final = (signal.SIGCHLD, signal.SIGINT, signal.SIGTERM)
_REQUEST_BYTES: Final = 1 << 16
_MOST_DESCRIPTORS: Final = 4
_KILL_S: Final = 5.0
"""How long processes may take to end after the server was asked to end them. Each ends itself in less."""


class _Request(msgspec.Struct, frozen=True):
    """A process with these arguments; without arguments: the exit code of the process of this number is known."""

    number: int
    mesh: str
    arguments: tuple[str, ...]


class _News(msgspec.Struct, frozen=True):
    """The process of a request has started, or has ended with a code: the negative number of a signal if it was one."""

    number: int
    pid: int
    code: int | None = None


def executed(*arguments: str, interpreter: str | None = None, pass_fds: Sequence[int] = ()) -> subprocess.Popen[bytes]:
    """Start the program `fmu_mesh.run.__main__` by exec, with these arguments, in this Python or in ``interpreter``.

    It has a session of its own, so that Ctrl-C reaches only the launcher.
    """
    return subprocess.Popen(
        executed_command(*arguments, interpreter=interpreter),
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        start_new_session=True,
        pass_fds=pass_fds,
        # Without the last one, setproctitle would overwrite what `/proc/PID/environ` shows.
        env=os.environ | ONE_THREAD | {"SPT_NOENV": "1"},
    )


def executed_command(*arguments: str, interpreter: str | None = None) -> list[str]:
    """The command line of `executed`."""
    # With -P, Python does not look for modules in the current folder. Otherwise a `random.py` of the user would be
    # imported instead of that of the standard library.
    return [interpreter or sys.executable, "-Pm", "fmu_mesh.run", *arguments]


class ForkServer:
    """The fork server as its launcher sees it. It starts at once.

    The kernel ends the server with the thread that makes this object, and the server ends what it has forked.

    Attributes:
        process: its process.
    """

    def __init__(self) -> None:
        self._control, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        with theirs:
            self.process = executed("forks", str(theirs.fileno()), _ROOM, pass_fds=(theirs.fileno(),))
        self._forked: list[Forked] = []
        self._reader = threading.Thread(target=self._read, name="fork server", daemon=True)
        self._reader.start()

    def fork(self, mesh: str, *arguments: str) -> Forked:
        """Ask for a process of the mesh ``mesh``, with these arguments of `fmu_mesh.run.__main__`."""
        output, errors = os.pipe(), os.pipe()
        forked = Forked(os.fdopen(output[0], "rb"), os.fdopen(errors[0], "rb"))
        self._ask(forked, mesh, arguments, [output[1], errors[1]])
        os.close(output[1])
        os.close(errors[1])
        return forked

    def fork_with(self, mesh: str, *arguments: str, descriptors: Sequence[int]) -> Forked:
        """As `fork`, with the output of this process, and with descriptors, whose numbers are its last arguments."""
        forked = Forked()
        with open(os.devnull, "w", encoding="utf-8") as nowhere:  # noqa: PTH123  it has to be closed
            output = [number if _is_open(number) else nowhere.fileno() for number in (1, 2)]
            self._ask(forked, mesh, arguments, [*output, *descriptors])
        return forked

    def _ask(self, forked: Forked, mesh: str, arguments: tuple[str, ...], descriptors: Sequence[int]) -> None:
        self._forked.append(forked)
        request = msgspec.msgpack.encode(_Request(len(self._forked) - 1, mesh, arguments))
        try:
            socket.send_fds(self._control, [request], descriptors)
        except OSError:  # the server is gone, which its own end tells
            forked.orphaned()

    def finish(self) -> None:
        """Ask for no more processes: the server ends when all have ended."""
        with suppress(OSError):
            self._control.shutdown(socket.SHUT_WR)

    def discard(self) -> None:
        """End a server that has forked nothing."""
        self.process.kill()
        with suppress(subprocess.TimeoutExpired):  # it waits for a disk that does not answer (state D)
            self.process.communicate(timeout=_KILL_S)
        self.close()

    def close(self) -> None:
        """After the end of the server: close what is open."""
        self._reader.join(1.0)
        self._control.close()

    def _read(self) -> None:
        with suppress(OSError):
            while data := self._control.recv(_REQUEST_BYTES):
                news = msgspec.msgpack.decode(data, type=_News)
                self._forked[news.number].take(news.pid, news.code)
                if news.code is not None:
                    with suppress(OSError):  # no more requests; the server ends soon
                        self._control.send(msgspec.msgpack.encode(_Request(news.number, "", ())))
        for forked in self._forked:
            forked.orphaned()


_ahead: list[ForkServer] = []
"""The server that was started ahead, until a run takes it."""


@contextmanager
def started_ahead() -> Iterator[None]:
    """Start the server of the next run of this process now: it imports while this process imports and plans.

    At the end of the block it is ended if no run has taken it. Use it on a thread that lives as long as the run.
    """
    _ahead.append(ForkServer())
    try:
        yield
    finally:
        while _ahead:
            _ahead.pop().discard()


def fork_server() -> ForkServer:
    """The server for one run: the one that was started ahead, or a new one."""
    return _ahead.pop() if _ahead else ForkServer()


class Forked:
    """A process that the fork server was asked for; offers what `subprocess.Popen` does.

    Attributes:
        pid: its process id; None before it has started.
        stdout: the reading end of its standard output; None: it has that of this process.
        stderr: the same of its standard error.
    """

    stdin: None = None

    def __init__(self, stdout: IO[bytes] | None = None, stderr: IO[bytes] | None = None) -> None:
        self.stdout = stdout
        self.stderr = stderr
        self.pid: int | None = None
        self._code: int | None = None
        self._orphaned = False
        self._signal: int | None = None
        self._ended = threading.Event()

    def take(self, pid: int, code: int | None) -> None:
        """It has started, or has ended with ``code``."""
        self.pid = pid
        self._code = code
        if code is not None:
            self._ended.set()
        elif self._signal is not None:
            self.send_signal(self._signal)

    def orphaned(self) -> None:
        """The server is gone. Nobody can tell the exit code any more, and the kernel asks this process to end."""
        self._orphaned = True
        self._ended.set()

    def poll(self) -> int | None:
        """None if it still runs, or has not started yet; otherwise its exit code, as `wait` tells it."""
        if self._code is None and (is_alive(self.pid) if self.pid is not None else not self._orphaned):
            return None
        return self._known_code()

    def wait(self, timeout_s: float | None = None) -> int:
        """Wait until the server has told its exit code, or is gone; then the code says that a process is missing."""
        self._ended.wait(timeout_s)
        return self._known_code()

    def send_signal(self, number: int) -> None:
        """Send a signal if it still runs; if it has not started yet, at its start."""
        self._signal = number
        if self.pid is not None and self.poll() is None:
            with suppress(ProcessLookupError):
                os.kill(self.pid, number)

    def _known_code(self) -> int:
        return self._code if self._code is not None else MeshLost.exit_code


def serve(control: int) -> Job | None:
    """Be the fork server. Returns in each forked process, with its job; in the server at its end, with None.

    Args:
        control: the descriptor of the server's end of the pair of sockets.

    Raises:
        ConfigurationError: the system starts no more processes.
        Interrupted: the server was asked to end.
    """
    from ..instances.registry import preload  # noqa: PLC0415 only the server needs it
    from ..system.run_metadata import versions  # noqa: PLC0415 as above
    from .roles import job_of  # noqa: PLC0415 as above

    preload()
    versions()
    gc.collect()
    gc.freeze()  # otherwise the next collection in a forked process would copy the memory that it shares
    gc.enable()
    return _Server(control, partial(job_of, forks=True)).run()


def _is_open(descriptor: int) -> bool:
    try:
        os.fstat(descriptor)
    except OSError:
        return False
    return True


class _Server:
    """The fork server itself.

    Args:
        control: see `serve`.
        job: returns the job of a request from its arguments. It is called in the server: what it opens or reads, all
            processes have that are forked later.
    """

    def __init__(self, control: int, job: Callable[..., Job]) -> None:
        os.set_inheritable(control, False)  # noqa: FBT003 it takes no keyword
        self._control = socket.socket(fileno=control)
        self._job = job
        self._reading, self._writing = os.pipe()
        os.set_blocking(self._reading, False)
        os.set_blocking(self._writing, False)
        self._numbers: dict[int, int] = {}
        """The requests of the running processes by process id."""
        self._ended: dict[int, int] = {}
        """The process ids of the ended processes by request, until the launcher knows their exit codes."""
        self._accepting = True
        self._asked: str | None = None
        self._deadline: float | None = None

    def run(self) -> Job | None:
        """Serve; see `serve`."""
        from .process import only_wake  # noqa: PLC0415 the launcher does without it

        self._before = {number: signal.signal(number, only_wake) for number in _SIGNALS}
        signal.set_wakeup_fd(self._writing, warn_on_full_buffer=False)
        while self._accepting or self._numbers:
            requests: list[int | socket.socket] = [self._control] if self._accepting else []
            left_s = max(0.0, self._deadline - time.monotonic()) if self._deadline is not None else None
            ready, _, _ = select.select([self._reading, *requests], [], [], left_s)
            if self._reading in ready:
                self._take_signals()
            if self._control in ready and (job := self._take_request()) is not None:
                return job
            if not ready:
                self._end_all(signal.SIGKILL)
        if self._asked is not None:
            raise Interrupted(f"{self._asked} was received").already_reported()  # the launcher tells it by the code
        return None

    def _take_request(self) -> Job | None:
        """Fork a process; returns its job there, and None in the server."""
        from setproctitle import setproctitle  # noqa: PLC0415 the launcher does without it

        from .process import die_with_parent  # noqa: PLC0415 as above

        data, descriptors, _, _ = socket.recv_fds(self._control, _REQUEST_BYTES, _MOST_DESCRIPTORS)
        if not data:
            self._accepting = False
            return None
        request = msgspec.msgpack.decode(data, type=_Request)
        if not request.arguments:
            os.waitpid(self._ended.pop(request.number), 0)
            return None
        setproctitle(f"fmu-mesh fork server {request.mesh}")
        die_with_parent()  # no longer by SIGKILL: the signal is passed on
        job = self._job(*request.arguments, *map(str, descriptors[2:]))
        # A signal for the server must not run the handler of the server in the new process.
        signal.pthread_sigmask(signal.SIG_BLOCK, _SIGNALS)
        server = os.getpid()
        try:
            pid = os.fork()
        except OSError as error:
            text = f"the system starts no more processes: {error.strerror}"
            raise ConfigurationError(text, hint="Is the limit of processes (`ulimit -u`) too low?") from error
        if pid == 0:
            self._become(request, descriptors, server)
            return job
        self._numbers[pid] = request.number
        self._tell(_News(request.number, pid))
        for descriptor in descriptors:
            os.close(descriptor)
        signal.pthread_sigmask(signal.SIG_UNBLOCK, _SIGNALS)
        return None

    def _become(self, request: _Request, descriptors: list[int], server: int) -> None:
        """In the new process: keep nothing of the server but its memory and its standard input."""
        from .process import forked_by  # noqa: PLC0415 as above

        os.setsid()
        signal.set_wakeup_fd(-1)
        for number, handler in self._before.items():
            signal.signal(number, handler)
        signal.pthread_sigmask(signal.SIG_UNBLOCK, _SIGNALS)
        forked_by(server)
        if os.getppid() != server:  # it has died before
            os._exit(0)
        self._control.close()
        for own in (self._reading, self._writing):
            os.close(own)
        for target, descriptor in enumerate(descriptors[:2], start=1):
            os.dup2(descriptor, target)
            os.close(descriptor)
        sys.argv[1:] = request.arguments
        if (random := sys.modules.get("numpy.random")) is not None:  # Python itself does so with `random`
            random.seed()

    def _take_signals(self) -> None:
        numbers = os.read(self._reading, 4096)
        for pid, request in list(self._numbers.items()):
            ended = os.waitid(os.P_PID, pid, os.WEXITED | os.WNOHANG | os.WNOWAIT)
            if ended is not None:
                self._ended[self._numbers.pop(pid)] = pid
                exited = ended.si_code == os.CLD_EXITED
                self._tell(_News(request, pid, ended.si_status if exited else -ended.si_status))
        asked = next((number for number in numbers if number != signal.SIGCHLD), None)
        if asked is not None:  # by somebody, or by the kernel because the launcher is gone
            self._asked = signal.Signals(asked).name
            self._accepting = False
            self._deadline = time.monotonic() + _KILL_S
            self._end_all(signal.SIGTERM)

    def _end_all(self, number: signal.Signals) -> None:
        for pid in self._numbers:
            os.kill(pid, number)

    def _tell(self, news: _News) -> None:
        with suppress(OSError):  # the launcher is gone
            self._control.send(msgspec.msgpack.encode(news))
