"""What the terminal and the environment allow: colours, and anything else that is written with escape sequences."""

from __future__ import annotations

import os
import sys
from typing import IO

from rich.console import Console

from ...printing import unguarded

__all__ = ["error_console", "may_draw"]


def error_console() -> Console:
    """Standard error: plain text if it is no terminal or `NO_COLOR` is set; with colours if `FORCE_COLOR` is set."""
    stream = unguarded(sys.stderr)  # Rich moves the cursor; whoever prints text on this makes it printable before
    return Console(file=stream, stderr=True, highlight=False, force_terminal=False if _plain() else None)


def may_draw(stream: IO[str]) -> bool:
    """Whether the cursor may be moved: the stream is a terminal, and `NO_COLOR` is not set."""
    return stream.isatty() and not _plain()


def _plain() -> bool:
    return bool(os.environ.get("NO_COLOR"))
