"""One child process of the launcher: its start and end, the threads that read its output, and how long it was stopped.

Does not know what a mesh is. What happens is posted to the launcher's thread.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import IO

from ..errors import Interrupted
from ..wire.runtime import process_state
from .threads import ONE_THREAD

__all__ = ["Child", "StopWatch", "how_it_ended", "is_other_python", "own_command"]

_SHOWN_LINES = 200
_LINE_BYTES = 1000


def own_command(*arguments: str, interpreter: str | None = None) -> list[str]:
    """The program of the processes of a run (`fmu_mesh.run.__main__`) with these arguments.

    It runs in this Python, or in ``interpreter``. With -P, Python does not look for modules in the current folder.
    Otherwise a `random.py` of the user would be imported instead of that of the standard library.
    """
    return [interpreter or sys.executable, "-Pm", "fmu_mesh.run", *arguments]


def is_other_python(interpreter: str) -> bool:
    """Whether ``interpreter`` is not the Python that runs this process, with the packages that it has.

    The Python of a virtual environment is a link in the folder of the environment.
    """
    own, other = Path(sys.executable), Path(interpreter)
    return (own.parent.resolve(), own.resolve()) != (other.parent.resolve(), other.resolve())


class Child:
    """One child process.

    Args:
        name: the name that the callbacks of `start` get.
        command: the program and its arguments.
        post: calls a function on the launcher's thread.
    """

    def __init__(self, name: str, command: list[str], post: Callable[[Callable[[], None]], None]) -> None:
        self.name = name
        self._command = command
        self._post = post
        self._popen: subprocess.Popen[bytes] | None = None
        self._threads: list[threading.Thread] = []
        self._left_others = False

    def start(
        self,
        on_line: Callable[[bytes], None],
        on_error_line: Callable[[str, bytes], None],
        on_exit: Callable[[str, int], None],
        *,
        limited: bool = False,
    ) -> None:
        """Start it in a session of its own, so that Ctrl-C reaches only the launcher.

        If ``limited``, only the beginning of its output is passed on, because an FMU may write without end.
        """
        self._popen = popen = subprocess.Popen(
            self._command,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            start_new_session=True,
            env=os.environ | ONE_THREAD,
        )
        assert popen.stdout is not None
        assert popen.stderr is not None
        read = self._read_beginning if limited else self._read
        readers = [
            threading.Thread(target=read, args=(popen.stdout, on_line), daemon=True),
            threading.Thread(
                target=read, args=(popen.stderr, lambda line: on_error_line(self.name, line)), daemon=True
            ),
        ]
        waiter = threading.Thread(target=self._wait, args=(readers, on_exit), daemon=True)
        self._threads = [*readers, waiter]
        for thread in self._threads:
            thread.start()

    @property
    def running(self) -> bool:
        """Whether it has not ended yet."""
        return self._popen is not None and self._popen.poll() is None

    @property
    def stopped(self) -> bool:
        """Whether it is stopped by SIGSTOP; being held by a debugger does not count."""
        return self._popen is not None and self.running and process_state(self._popen.pid) == "T"

    def signal(self, number: signal.Signals) -> None:
        """Send a signal if it still runs."""
        if self._popen is not None and self.running:
            self._popen.send_signal(number)

    def close(self) -> None:
        """Kill the processes it has left behind, wait for the readers and close the pipes; call it after the end."""
        if self._left_others:
            self._signal_others(signal.SIGKILL)
        for thread in self._threads:
            thread.join(1.0)
        if self._popen is not None and self._popen.stdin is not None:
            self._popen.stdin.close()

    def _signal_others(self, number: int) -> None:
        """Send a signal to the processes that it has started and left behind; an FMU may start some."""
        assert self._popen is not None
        with suppress(ProcessLookupError, PermissionError):
            os.killpg(self._popen.pid, number)
            self._left_others = True

    # Each reader closes its pipe, because a process that was left behind may keep the other end open.

    def _read(self, pipe: IO[bytes], on_line: Callable[[bytes], None]) -> None:
        with pipe:
            for line in pipe:
                self._post(partial(on_line, line))

    def _read_beginning(self, pipe: IO[bytes], on_line: Callable[[bytes], None]) -> None:
        """Read everything, so that the process never blocks, but pass on only `_SHOWN_LINES` lines."""
        count = 0
        with pipe:
            while line := pipe.readline(_LINE_BYTES):
                count += 1
                if count <= _SHOWN_LINES:
                    self._post(partial(on_line, line))
                elif count == _SHOWN_LINES + 1:
                    self._post(partial(on_line, b"(it writes a lot; nothing more of it is shown)"))

    def _wait(self, readers: Sequence[threading.Thread], on_exit: Callable[[str, int], None]) -> None:
        assert self._popen is not None
        code = self._popen.wait()
        self._signal_others(signal.SIGTERM)
        for reader in readers:
            reader.join(1.0)
        self._post(lambda: on_exit(self.name, code))


class StopWatch:
    """Measures how long children have been stopped.

    The launcher itself may have been stopped (Ctrl-Z), so of the time between two looks at most two turns count.

    Args:
        patience_s: how long a child may be stopped, in s.
        turn_s: about how often the launcher looks, in s.
    """

    def __init__(self, patience_s: float, turn_s: float) -> None:
        self._patience_s = patience_s
        self._turn_s = turn_s
        self._looked: float | None = None
        self._stopped_s: dict[str, float] = {}

    def due(self, now: float) -> bool:
        """Whether it is time for the next look."""
        return self._looked is None or now - self._looked >= self._turn_s

    def look(self, now: float, stopped: Iterable[str]) -> list[str]:
        """Note which children are stopped now; returns those that have been stopped for too long."""
        passed_s = min(now - self._looked, 2 * self._turn_s) if self._looked is not None else 0.0
        self._looked = now
        self._stopped_s = {name: self._stopped_s.get(name, 0.0) + passed_s for name in stopped}
        return [name for name, seconds in self._stopped_s.items() if seconds > self._patience_s]


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
