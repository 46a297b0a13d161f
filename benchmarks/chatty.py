"""The FMU of the job `chatty`: it logs 20 messages at every step."""

from __future__ import annotations

from pathlib import Path

from benchmarks.first_step import FMU as BESIDE
from fmus.build import BuildError, build

__all__ = ["CHATTY", "build_chatty"]

CHATTY = str(Path(BESIDE).with_name("Chatty"))
"""Path of the FMU without `.fmu`."""


def build_chatty() -> None:
    """Build it.

    Raises:
        RuntimeError: it cannot be built here.
    """
    try:
        build(Path(__file__).parent / "models" / "Chatty", Path(CHATTY).parent)
    except BuildError as error:
        raise RuntimeError(str(error)) from None
