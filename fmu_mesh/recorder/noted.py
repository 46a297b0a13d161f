"""A result file with a note of how much of it is complete, for whoever has to say so when the recorder was killed.

The note is a small file in the folder of the run. It is made before the first row is written, so that without a note
the result file is not that of this run.
"""

from __future__ import annotations

import os
import struct
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..files import Kept
from .result_file import ResultFile

__all__ = ["NotedFile", "noted"]

_NAME = "recorded"
_NOTE = struct.Struct("<qq")


class NotedFile:
    """A result file that notes what is kept of it.

    Args:
        file: the result file; closed with this.
        folder: of the run; the note goes there.
    """

    def __init__(self, file: ResultFile, folder: Path) -> None:
        self._file = file
        self._note = folder / _NAME
        self._descriptor: int | None = None
        self._noted = Kept()

    @property
    def path(self) -> Path:
        """The file."""
        return self._file.path

    @property
    def rows(self) -> int:
        """Rows written so far."""
        return self._file.rows

    @property
    def kept(self) -> Kept:
        """What the operating system has by now."""
        return self._file.kept

    def write(self, times: NDArray[np.float64], columns: Sequence[NDArray[Any]]) -> None:
        """Append one row per time."""
        if self._descriptor is None:
            self._descriptor = os.open(self._note, os.O_WRONLY | os.O_CREAT | os.O_CLOEXEC, 0o600)
            os.pwrite(self._descriptor, _NOTE.pack(*self._noted), 0)
        self._file.write(times, columns)
        self._note_kept(self._descriptor)

    def flush(self) -> None:
        """Hand everything to the operating system."""
        self._file.flush()
        if self._descriptor is not None:
            self._note_kept(self._descriptor)

    def close(self) -> None:
        """Write what is left and close the file; the note stays."""
        try:
            self._file.close()
        finally:
            if self._descriptor is not None:
                self._note_kept(self._descriptor)
                os.close(self._descriptor)
                self._descriptor = None

    def _note_kept(self, descriptor: int) -> None:
        if (kept := self._file.kept) != self._noted:
            self._noted = kept
            os.pwrite(descriptor, _NOTE.pack(*kept), 0)


def noted(folder: Path) -> Kept | None:
    """What was kept of the result file of the run in ``folder``, at least; None if nothing was written to it."""
    try:
        return Kept(*_NOTE.unpack((folder / _NAME).read_bytes()))
    except (FileNotFoundError, struct.error):
        return None
