"""A real terminal for a command: a pty, whose screen is what an emulator makes of all that is written to it."""

from __future__ import annotations

import fcntl
import os
import pty
import re
import signal
import struct
import subprocess
import sys
import termios
import threading
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import pyte

from tests.helpers import DEADLINE_S, Place, wait_until

__all__ = ["Terminal"]

_SWITCH = rb"\x1b\[\?1049([hl])"
_LONGEST = 7
"""Of the beginnings of a switch, in bytes."""


class Terminal:
    """``fmu-mesh`` with these arguments in a terminal of its own; killed at the end of the `with` block.

    Args:
        place: where it runs.
        arguments: of the command.
        columns: width of the terminal.
        lines: height of the terminal.
    """

    def __init__(self, place: Place, *arguments: str | Path, columns: int = 80, lines: int = 24) -> None:
        # The emulator has one screen; a terminal has another one for what is drawn page by page.
        self._screens = [pyte.Screen(columns, lines) for _ in range(2)]
        self._streams = [pyte.ByteStream(screen) for screen in self._screens]
        self._current = 0
        self._lock = threading.Lock()
        self._rest = b""
        self._main, self._other = pty.openpty()
        fcntl.ioctl(self._other, termios.TIOCSWINSZ, struct.pack("HHHH", lines, columns, 0, 0))
        self.modes_before = self.modes()
        environment: Mapping[str, str] = {k: v for k, v in place.environment.items() if k not in ("COLUMNS", "LINES")}
        self._popen = subprocess.Popen(
            ["setsid", "--ctty", sys.executable, "-m", "fmu_mesh", *map(str, arguments)],
            cwd=place.folder,
            env={**environment, "TERM": "xterm-256color"},
            stdin=self._other,
            stdout=self._other,
            stderr=self._other,
        )
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._popen.poll() is None:
            self._popen.kill()
            self._popen.wait(DEADLINE_S)
        os.close(self._other)
        self._reader.join(DEADLINE_S)
        os.close(self._main)

    @property
    def shown(self) -> list[str]:
        """The lines on the screen, without what is empty at their ends."""
        with self._lock:
            lines = [line.rstrip() for line in self._screens[self._current].display]
        while lines and not lines[-1]:
            lines.pop()
        return lines

    @property
    def shows_cursor(self) -> bool:
        """Whether there is a cursor on the screen."""
        with self._lock:
            return all(not screen.cursor.hidden for screen in self._screens)

    def modes(self) -> list[Any]:
        """How the terminal treats what is typed."""
        return termios.tcgetattr(self._other)

    def press(self, keys: str) -> None:
        """Type these keys."""
        os.write(self._main, keys.encode())

    def signal(self, number: signal.Signals) -> None:
        """Send the command a signal."""
        self._popen.send_signal(number)

    def wait_for(self, text: str) -> list[str]:
        """The screen as soon as this text is on it."""
        return wait_until(lambda: shown if text in "\n".join(shown := self.shown) else None, f"{text!r} on the screen")

    def wait(self) -> int:
        """Wait for the end of the command; its exit code, when all that it has written is on the screen."""
        code = self._popen.wait(DEADLINE_S)
        # A mark of our own comes behind what the command has written.
        os.write(self._other, b"\x1b]0;ended\x07")
        wait_until(lambda: self._screens[0].title == "ended", "the last of what was written")
        return code

    def _read(self) -> None:
        while True:
            try:
                data = os.read(self._main, 1 << 16)
            except OSError:  # nobody holds the other end any more
                return
            with self._lock:
                self._rest += data
                *switches, rest = re.split(_SWITCH, self._rest)
                for text, which in zip(switches[::2], switches[1::2], strict=True):
                    self._streams[self._current].feed(text)
                    self._current = int(which == b"h")
                # The beginning of a switch may be at the end.
                cut = rest.rfind(b"\x1b") if rest[-_LONGEST:].count(b"\x1b") else len(rest)
                self._streams[self._current].feed(rest[:cut])
                self._rest = rest[cut:]
