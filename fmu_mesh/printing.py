"""What may reach a terminal, a log or a picture: one way out for text that others have written, and our own streams.

Names, units, descriptions and messages of models are data. On a terminal, some characters are commands, others change
the order of what is shown, and a line break begins a line that looks like one of ours.
"""

from __future__ import annotations

import io
import os
import re
import sys
import unicodedata
from collections.abc import Callable, Iterable
from contextlib import redirect_stderr, redirect_stdout
from typing import Any, Final, TextIO

__all__ = ["OutputFailed", "guard_streams", "page", "paragraph", "printable", "unguarded", "write_data"]

_NO_TEXT: Final = re.compile(r"[^ -~]")
"""What may be more than text in one line."""
_NO_LINES: Final = re.compile(r"[^ -~\n\t]")


class OutputFailed(OSError):
    """Standard output cannot be written, such as to a full disk."""


def printable(text: str) -> str:
    r"""A text in one line: line breaks and other characters that a terminal acts on are escaped.

    Example:
        >>> printable("pump\n2")
        'pump\\n2'
    """
    return _NO_TEXT.sub(_escaped, text)


def paragraph(text: str) -> str:
    r"""A text of several lines: as `printable`, and all lines but the first are indented, so that none looks like ours.

    Example:
        >>> paragraph("the FMU says: bad\nfmu-mesh: all is well")
        'the FMU says: bad\n    fmu-mesh: all is well'
    """
    return text if text.isprintable() else "\n    ".join(map(printable, text.expandtabs().splitlines()))


def page(lines: Iterable[str]) -> str:
    """The text of a page: its lines, each of them as `printable`."""
    return "\n".join(map(printable, lines))


def guard_streams() -> None:
    """From now on, what this process prints cannot control the terminal; a full disk raises `OutputFailed`."""
    for stream, redirect in ((sys.stdout, redirect_stdout), (sys.stderr, redirect_stderr)):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")  # what its encoding does not have
        if not isinstance(stream, _GuardedStream):
            redirect(_GuardedStream(stream, needed=stream is sys.stdout)).__enter__()  # until the process has ended


def write_data(data: bytes) -> None:
    """Write what programs read to standard output: it has its own escapes, and is UTF-8 whatever the terminal takes."""
    sys.stdout.flush()
    _written(sys.stdout.buffer.write, data)
    sys.stdout.flush()


def unguarded(stream: TextIO) -> TextIO:
    """The stream itself, for what moves the cursor and has made all text printable before."""
    return stream.stream if isinstance(stream, _GuardedStream) else stream


class _GuardedStream:
    """A text stream that escapes all but text, line breaks and tabs.

    Args:
        stream: the stream.
        needed: whether text that cannot be written is an error.
    """

    def __init__(self, stream: TextIO, *, needed: bool) -> None:
        self.stream = stream
        self._needed = needed

    def __getattr__(self, name: str) -> Any:  # noqa: ANN401  whatever the stream has
        return getattr(self.stream, name)

    def write(self, text: str) -> int:
        """Write a text."""
        _written(self.stream.write, _NO_LINES.sub(_escaped, text), needed=self._needed)
        return len(text)

    def flush(self) -> None:
        """Write what is in the buffer."""
        _written(self.stream.flush, needed=self._needed)


def _written(write: Callable[..., object], *data: str | bytes, needed: bool = True) -> None:
    try:
        write(*data)
    except BrokenPipeError:
        if needed:
            raise
    except OSError as error:
        if needed:
            os.dup2(os.open(os.devnull, os.O_WRONLY), 1)  # what is in the buffer goes nowhere, too
            raise OutputFailed(f"standard output cannot be written: {error.strerror}") from error


def _escaped(found: re.Match[str]) -> str:
    sign = found[0]
    return sign if sign.isprintable() or unicodedata.category(sign) == "Zs" else repr(sign)[1:-1]
