"""Finds the library that `burst.c` is built into."""

from __future__ import annotations

import platform
import sys
from pathlib import Path

__all__ = ["load_library"]


def load_library() -> str | None:
    """The path of the library for this platform; None if there is none."""
    path = Path(__file__).with_name(f"burst-{sys.platform}-{platform.machine()}.so")
    return str(path) if path.exists() else None
