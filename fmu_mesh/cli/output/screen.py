"""A terminal that shows one page after another until a key is pressed.

Owns the state of the terminal that is restored at the end of the block, also at SIGTERM: how keys are read, and what
was shown before.
"""

# Signals: SIGTERM is raised as SystemExit on the main thread, so that the terminal is restored. A signal that cannot be
# handled leaves the terminal as it is; `reset` helps.

from __future__ import annotations

import os
import select
import shutil
import signal
import sys
import termios
import time
import tty
from collections.abc import Sequence
from contextlib import ExitStack, suppress
from types import FrameType
from typing import Final, Self

from ...printing import printable, unguarded

__all__ = ["Screen"]

_OTHER_SCREEN: Final = "\x1b[?1049h\x1b[?25l"
_FIRST_SCREEN: Final = "\x1b[?25h\x1b[?1049l"
_HOME: Final = "\x1b[H"
_END_OF_LINE: Final = "\x1b[K"
_REST: Final = "\x1b[J"
_QUIT: Final = b"qQ"


class Screen:
    """The terminal of standard output, as long as the `with` block lasts; if it is not ``drawn``, this only waits."""

    def __init__(self, *, drawn: bool) -> None:
        self.drawn = drawn
        self._keys = sys.stdin.fileno() if drawn and sys.stdin is not None and sys.stdin.isatty() else None
        self._woken, self._waker = os.pipe()
        self._stack = ExitStack()

    def __enter__(self) -> Self:
        if self.drawn:
            self._stack.callback(signal.signal, signal.SIGTERM, signal.signal(signal.SIGTERM, _end))
            if self._keys is not None:
                self._stack.callback(termios.tcsetattr, self._keys, termios.TCSADRAIN, termios.tcgetattr(self._keys))
                tty.setcbreak(self._keys)  # Ctrl-C still sends SIGINT
            self._stack.callback(self._write, _FIRST_SCREEN)
            self._write(_OTHER_SCREEN)
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()
        os.close(self._woken)
        os.close(self._waker)

    @property
    def width(self) -> int:
        """The current width in columns."""
        return shutil.get_terminal_size().columns

    def show(self, lines: Sequence[str]) -> None:
        """Draw a page; if it is too long for the terminal, its beginning and the number of further lines."""
        height = shutil.get_terminal_size().lines
        if len(lines) > height:
            lines = [*lines[: height - 1], f"({len(lines) - height + 1} more lines)"]
        # Each line is erased before it is drawn: after a full line the cursor is still on its last character.
        text = "\r\n".join(_END_OF_LINE + printable(line) for line in lines)
        self._write(_HOME + text + ("\r\n" + _REST if len(lines) < height else ""))

    def quits_within(self, seconds: float) -> bool:
        """Wait for this time or until `wake` is called; True if `q` was pressed."""
        end = time.monotonic() + seconds
        watched = [self._woken, *([self._keys] if self._keys is not None else [])]
        while (left := end - time.monotonic()) > 0:
            ready, _, _ = select.select(watched, [], [], left)
            if self._woken in ready:
                return False
            if self._keys in ready:
                pressed = os.read(self._keys, 64) if self._keys is not None else b""
                if not pressed or any(key in _QUIT for key in pressed):  # without any, the terminal is gone
                    return True
        return False

    def wake(self) -> None:
        """From any thread: let `quits_within` return, now and from now on at once."""
        with suppress(OSError):
            os.write(self._waker, b".")

    def _write(self, text: str) -> None:
        stream = unguarded(sys.stdout)
        stream.write(text)
        stream.flush()


def _end(_number: int, _frame: FrameType | None) -> None:
    sys.exit(128 + signal.SIGTERM)
