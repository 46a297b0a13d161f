"""One child process of the launcher: its start and end, and the threads that read its output.

Does not know what a mesh is. What happens is posted to the launcher's thread.
"""

# Threads for each child: two read its pipes, because one that is full would stop it, and one waits for its end and for
# the readers. They post to the launcher's thread, which alone decides (ADR 71). A reader ends when all that have the
# pipe are gone: what an FMU has forked may keep it open, so others of the child's group are ended after it.

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import partial
from typing import IO, Protocol

from ..errors import Interrupted
from ..wire.host_processes import is_stopped

__all__ = ["Child", "Process", "how_it_ended"]


class Process(Protocol):
    """A process that was started by exec, by the fork server, or on another host.

    It leads a process group of the number of its `pid`, which is None before it has started, and on another host.
    """

    @property
    def pid(self) -> int | None: ...  # noqa: D102  those of `subprocess.Popen`
    @property
    def stdin(self) -> IO[bytes] | None: ...  # noqa: D102  as above
    @property
    def stdout(self) -> IO[bytes] | None: ...  # noqa: D102  as above
    @property
    def stderr(self) -> IO[bytes] | None: ...  # noqa: D102  as above
    def poll(self) -> int | None: ...  # noqa: D102  as above
    def wait(self) -> int: ...  # noqa: D102  as above
    def send_signal(self, number: int, /) -> None: ...  # noqa: D102  as above


_SHOWN_LINES = 200
_LINE_BYTES = 1000


class Child:
    """One process that the launcher watches.

    Args:
        name: the name that the callbacks of `watch` get.
        process: the process, in a session of its own.
        post: calls a function on the launcher's thread.
    """

    def __init__(self, name: str, process: Process, post: Callable[[Callable[[], None]], None]) -> None:
        self.name = name
        self._process = process
        self._post = post
        self._threads: list[threading.Thread] = []
        self._left_others = False
        self._others_asked = threading.Event()

    def watch(
        self,
        on_line: Callable[[bytes], None],
        on_error_line: Callable[[str, bytes], None],
        on_exit: Callable[[str, int], None],
        *,
        limited: bool = False,
    ) -> None:
        """Pass on what it writes, and its exit code.

        If ``limited``, only the beginning of its output is passed on, because an FMU may write without end.
        """
        output, errors = self._process.stdout, self._process.stderr
        assert output is not None
        assert errors is not None
        pipes = ((output, on_line), (errors, partial(on_error_line, self.name)))
        readers = [threading.Thread(target=self._read, args=(*pipe, limited), daemon=True) for pipe in pipes]
        self._threads = [*readers, threading.Thread(target=self._wait, args=(readers, on_exit), daemon=True)]
        for thread in self._threads:
            thread.start()

    @property
    def running(self) -> bool:
        """Whether it has not ended yet."""
        return self._process.poll() is None

    @property
    def pid(self) -> int | None:
        """Its process id; None before it has started."""
        return self._process.pid

    @property
    def stopped(self) -> bool:
        """Whether it is stopped by SIGSTOP; being held by a debugger does not count."""
        pid = self._process.pid
        return pid is not None and self.running and is_stopped(pid)

    def signal(self, number: signal.Signals) -> None:
        """Send a signal if it still runs."""
        self._process.send_signal(number)

    def close(self) -> None:
        """Kill the processes it has left behind, wait for the readers and close the pipes; call it after the end."""
        if self._threads:  # the end is known before its thread has looked for others
            self._others_asked.wait(1.0)
        if self._left_others:
            self._signal_others(signal.SIGKILL)
        for thread in self._threads:
            thread.join(1.0)
        if self._process.stdin is not None:
            self._process.stdin.close()

    def _signal_others(self, number: int) -> None:
        """Send a signal to the processes that it has started and left behind; an FMU may start some."""
        pid = self._process.pid
        if pid is None:
            return
        with suppress(ProcessLookupError, PermissionError):
            os.killpg(pid, number)
            self._left_others = True

    def _read(self, pipe: IO[bytes], on_line: Callable[[bytes], None], limited: bool) -> None:  # noqa: FBT001  for a thread
        """Read everything, so that the process never blocks; if ``limited``, pass on only `_SHOWN_LINES` lines."""
        count = 0
        with pipe:  # a process that was left behind may keep the other end open
            while line := pipe.readline(_LINE_BYTES if limited else -1):
                count += 1
                if not limited or count <= _SHOWN_LINES:
                    self._post(partial(on_line, line))
                elif count == _SHOWN_LINES + 1:
                    self._post(partial(on_line, b"(it writes a lot; nothing more of it is shown)"))

    def _wait(self, readers: Sequence[threading.Thread], on_exit: Callable[[str, int], None]) -> None:
        code = self._process.wait()
        self._signal_others(signal.SIGTERM)
        self._others_asked.set()
        for reader in readers:
            reader.join(1.0)
        self._post(lambda: on_exit(self.name, code))


def how_it_ended(code: int) -> str:
    """Describe an exit code in a message; a negative one is the number of a signal."""
    if code == Interrupted.exit_code:
        return "was asked to end by a signal"
    if code >= 0:
        return f"ended with exit code {code}"
    try:
        return f"was ended by {signal.Signals(-code).name}"
    except ValueError:
        return f"was ended by signal {-code}"
