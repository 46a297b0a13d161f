"""What all processes of a run have in common: the folder of the run, signals, the parent process, and the end.

A process that was started by `launch` ends with it (design, invariant 5): the kernel signals the death of its parent,
and its standard input ends. A thread carries out a request to end, because the main thread may be inside an FMU.
"""

# Threads and signals: the main thread may be in an FMU for long, so no handler does anything: the number of a signal
# goes through the wakeup descriptor to a thread "signals", and the end of standard input is seen by a thread "stdin".
# Each asks the main thread to end, and after the grace cleans up and ends the process; the lock `ending` lets only one
# of them do it. The parent of a forked process is the fork server, which may be stopped: it is woken first (ADR 71).

from __future__ import annotations

import ctypes
import os
import signal
import socket
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from types import FrameType, TracebackType
from typing import Self

from ..errors import ConfigurationError, Interrupted
from ..wire.host_processes import is_stopped
from ..wire.runtime import (
    enter_run_folder,
    leave_run_folder,
    run_folder,
    socket_endpoint,
    tidy_run_folder,
)
from .run_plan import MANUAL

__all__ = [
    "GRACE_S",
    "Interruption",
    "RunProcess",
    "die_with_parent",
    "ended_by_signals",
    "forked_by",
    "interrupts_later",
    "launch_of",
    "only_wake",
]

GRACE_S = 1.0
"""How long the main thread may take to end the process before another thread does."""

_SIGNAL_RECEIVED = " was received"
_PR_SET_PDEATHSIG = 1

_servers: list[int] = []
"""The process id of the fork server that has forked this process; empty if it was started by exec."""


class Interruption:
    """A request to end the process. It may come before there is anything that can be ended.

    Attributes:
        reason: the reason of the first request; None if there was none.
    """

    def __init__(self) -> None:
        self.reason: str | None = None
        self._ends: list[Callable[[str], None]] = []

    @property
    def signal(self) -> str | None:
        """Name of the signal that was the request, such as `SIGTERM`."""
        return self.reason.removesuffix(_SIGNAL_RECEIVED) if self.reason is not None else None

    def request(self, reason: str) -> None:
        """From any thread: ask for the end."""
        if self.reason is None:
            self.reason = reason
        for end in self._ends:
            end(reason)

    def goes_to(self, end: Callable[[str], None]) -> None:
        """Call ``end`` with the reason of each request from now on, and at once if there was one."""
        self._ends.append(end)
        if self.reason is not None:
            end(self.reason)


def launch_of(run: str) -> str | None:
    """What identifies the launch of a run of this host; None if there is no launcher."""
    return f"{socket.gethostname()}.{run}" if run != MANUAL else None


class RunProcess:
    """One process of a run, from its start to its end; use it as a context manager on the main thread.

    ```python
    with RunProcess(mesh, run) as process:
        process.take_place(name, f"node '{name}' of mesh '{mesh}'")
        session = open_session(wiring)
        process.stack.callback(close_session, session)
        node = Node(plan, session, open_instance)
        process.interruption.goes_to(node.interrupt)
        node.run()
    ```

    Args:
        mesh: name of the mesh.
        run: name of the run; `MANUAL` if a person has started this process.
        launch: identifies the launch, if that of ``run`` is on another host.
        helper: the process id of the helper of the launcher on this host, if there is one.

    Attributes:
        is_child: whether a launcher has started this process and watches it.
        launch: identifies the launch among those that meet at a router; None if there is no launcher.
        folder: the folder of the run.
        stack: what to close at the end.
        interruption: requests to end, from signals or the parent.
    """

    def __init__(self, mesh: str, run: str, launch: str | None = None, helper: int | None = None) -> None:
        self._helper = helper
        self.is_child = run != MANUAL
        self.launch = launch or launch_of(run)
        self.folder = run_folder(mesh, run)
        self.stack = ExitStack()
        self.interruption = Interruption()
        self._clean_ups: list[Callable[[], None]] = [lambda: leave_run_folder(self.folder)]

    def __enter__(self) -> Self:
        if self.is_child:
            die_with_parent()
        self.stack.enter_context(ended_by_signals(self.interruption.request, self.clean_up, watch_stdin=self.is_child))
        self.stack.callback(leave_run_folder, self.folder)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.stack.__exit__(kind, error, trace)
        if error is not None and self._helper is not None and is_stopped(self._helper):  # it could not end by itself
            for number in (signal.SIGCONT, signal.SIGTERM):
                os.kill(self._helper, number)

    def take_place(self, name: str, who: str) -> None:
        """Note in the folder of the run that this process is ``name``, and what to remove if it is killed.

        Args:
            name: name of the node, or `MASTER`.
            who: the process in words, for the error.

        Raises:
            ConfigurationError: such a process runs already.
        """
        tidy_run_folder(self.folder)
        with socket.socket(socket.AF_UNIX) as probe:
            try:
                probe.connect(socket_endpoint(self.folder, name).partition("/")[2])
            except OSError:
                enter_run_folder(self.folder, name)
                return
        raise ConfigurationError(f"{who} runs already", hint="Stop it first, or give this mesh another name.")

    def cleans_up(self, action: Callable[[], None]) -> None:
        """Call ``action`` first if the process has to end although its main thread does not return from an FMU."""
        self._clean_ups.insert(0, action)

    def clean_up(self) -> None:
        """From another thread, before the end of a process whose main thread does not return from an FMU."""
        for action in self._clean_ups:
            action()

    def end_now(self, code: int) -> None:
        """From another thread: end the process with this exit code although its main thread does not return."""
        self.clean_up()
        sys.stderr.flush()
        os._exit(code)


@contextmanager
def ended_by_signals(
    interrupt: Callable[[str], None], clean_up: Callable[[], None], *, watch_stdin: bool
) -> Iterator[None]:
    """While inside: SIGTERM, SIGINT, or the end of standard input call ``interrupt`` with the reason.

    If the main thread has not left the block `GRACE_S` later, ``clean_up`` is called and the process exits with 130.
    Use it on the main thread.
    """
    left, ending = threading.Event(), threading.Lock()
    reading, writing = os.pipe()
    os.set_blocking(writing, False)

    def end(reason: str) -> None:
        interrupt(reason)
        if not left.wait(GRACE_S):
            with ending:  # a second thread would end the process while the first one still cleans up
                clean_up()
                _exit(reason, reported=watch_stdin)

    def wait_for_signal() -> None:
        number = os.read(reading, 1)
        if number:
            end(f"{signal.Signals(number[0]).name}{_SIGNAL_RECEIVED}")

    def wait_for_stdin() -> None:
        while os.read(0, 4096):
            pass
        if not left.is_set():
            _wake_server()
            end("the process that started this one is gone")

    # The C handler writes the number at once, whichever thread gets the signal and whatever that thread is doing.
    wakeup = signal.set_wakeup_fd(writing, warn_on_full_buffer=False)
    handlers = {number: signal.signal(number, only_wake) for number in (signal.SIGTERM, signal.SIGINT)}
    watcher = threading.Thread(target=wait_for_signal, name="signals", daemon=True)
    watcher.start()
    if watch_stdin:
        threading.Thread(target=wait_for_stdin, name="stdin", daemon=True).start()
    try:
        yield
    finally:
        with ending:
            left.set()
        for number, handler in handlers.items():
            signal.signal(number, handler)
        signal.set_wakeup_fd(wakeup)
        os.close(writing)
        watcher.join(GRACE_S)
        os.close(reading)


def _wake_server() -> None:
    """Let a fork server that is stopped take its signal to end."""
    if (server := os.getppid()) in _servers:
        with suppress(ProcessLookupError):
            os.kill(server, signal.SIGCONT)


def _exit(reason: str, *, reported: bool) -> None:
    """End the process although its main thread does not return; say why, unless the launcher does."""
    if not reported:
        os.write(2, f"fmu-mesh: {reason}\n".encode())
    os._exit(Interrupted.exit_code)


def die_with_parent(number: signal.Signals = signal.SIGTERM) -> None:
    """Ask the kernel for this signal when the parent dies; standard input tells if it died before."""
    if sys.platform.startswith("linux"):
        ctypes.CDLL(None, use_errno=True).prctl(_PR_SET_PDEATHSIG, number)


def forked_by(server: int) -> None:
    """Note that the parent is a fork server with this process id, and die with it."""
    _servers[:] = [server]
    die_with_parent()


def only_wake(_number: int, _frame: FrameType | None) -> None:
    """The handler of a signal whose number whoever reads the wakeup descriptor gets."""


@contextmanager
def interrupts_later() -> Iterator[Callable[[], bool]]:
    """In the block, Ctrl-C only answers the function with True, and is raised at the end.

    Where it was no `KeyboardInterrupt` before, or this is not the main thread, nothing changes.
    """
    asked: list[int] = []
    if threading.current_thread() is not threading.main_thread() or (
        signal.getsignal(signal.SIGINT) is not signal.default_int_handler
    ):
        yield lambda: False
        return
    signal.signal(signal.SIGINT, lambda number, _frame: asked.append(number))
    try:
        yield lambda: bool(asked)
    finally:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    if asked:
        raise KeyboardInterrupt
