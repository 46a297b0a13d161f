"""What the terminal and the environment allow, and what is said beside the output of a command."""

from __future__ import annotations

import ctypes
import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import IO, TYPE_CHECKING

from ...printing import paragraph, unguarded
from .flag_words import in_flags

if TYPE_CHECKING:
    from rich.console import Console

__all__ = ["error_console", "may_draw", "say", "say_warning", "stdout_as_stderr", "teller"]


def error_console() -> Console:
    """Standard error: plain text if it is no terminal or `NO_COLOR` is set; with colours if `FORCE_COLOR` is set."""
    from rich.console import Console  # noqa: PLC0415 only a run draws

    stream = unguarded(sys.stderr)  # Rich moves the cursor; whoever prints text on this makes it printable before
    return Console(file=stream, stderr=True, highlight=False, force_terminal=False if _plain() else None)


def may_draw(stream: IO[str]) -> bool:
    """Whether the cursor may be moved: the stream is a terminal, and `NO_COLOR` is not set."""
    return stream.isatty() and not _plain()


def say(text: str) -> None:
    """Print one line on standard error before a run."""
    print(f"fmu-mesh: {paragraph(in_flags(text))}", file=sys.stderr, flush=True)


def say_warning(text: str) -> None:
    """As `say`, with a colour where there are colours."""
    from rich.text import Text  # noqa: PLC0415  as above

    error_console().print(Text(f"fmu-mesh: warning: {paragraph(in_flags(text))}", "yellow"), soft_wrap=True)


def teller(*, quiet: bool) -> Callable[[str], None]:
    """`say`, or nothing if ``quiet``."""
    return (lambda _text: None) if quiet else say


@contextmanager
def stdout_as_stderr() -> Iterator[None]:
    """In the block, output of an FMU in this process goes to standard error: standard output is for results."""
    sys.stdout.flush()
    stdout = os.dup(1)
    os.dup2(2, 1)
    try:
        yield
    finally:
        sys.stdout.flush()
        ctypes.CDLL(None).fflush(None)  # output of the FMU may still be in the buffer of the C library
        os.dup2(stdout, 1)
        os.close(stdout)


def _plain() -> bool:
    return bool(os.environ.get("NO_COLOR"))
