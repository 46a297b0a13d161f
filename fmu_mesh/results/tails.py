"""Follows a file that a run writes: all its rows from the first one on, and each new one once.

Only reads. The run neither knows nor waits.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import BinaryIO, Final

import numpy as np

from .recording import Columns

__all__ = ["GrowingFile", "LineTail"]

_PIECE: Final = 1 << 20
"""Bytes that are read at once: the memory of one call."""


class GrowingFile:
    """An open file that another process writes, and that may lose its name.

    Args:
        path: the file.
        file: it, open; `close` closes it.
    """

    def __init__(self, path: Path, file: BinaryIO) -> None:
        self.path = path
        self._file = file

    @property
    def replaced(self) -> bool:
        """Whether the file is gone, or another one has its name."""
        try:
            return not os.path.samestat(os.fstat(self._file.fileno()), self.path.stat())
        except OSError:
            return True

    @property
    def behind(self) -> int:
        """Bytes of the file that were not read yet."""
        return os.fstat(self._file.fileno()).st_size - self._file.tell()

    def close(self) -> None:
        """Close the file."""
        self._file.close()


class LineTail(GrowingFile):
    """A `Tail` of a file in which every row ends with a line end.

    Args:
        path: the file.
        file: it, open, at the beginning of its first row; closed with this.
        names: its columns without `time`.
        columns: makes some columns of whole rows, given their bytes and the names of the columns.
        end_of_rows: the number of bytes of the whole rows at the beginning of some bytes.
    """

    def __init__(
        self,
        path: Path,
        file: BinaryIO,
        names: Sequence[str],
        columns: Callable[[bytes, Sequence[str]], Columns],
        end_of_rows: Callable[[bytes], int] = lambda data: data.rfind(b"\n") + 1,
    ) -> None:
        super().__init__(path, file)
        self.names = names
        self._columns = columns
        self._end_of_rows = end_of_rows
        self._waiting = b""
        self._is_cut = False  # the next byte may be in the middle of a row

    def skip(self) -> None:
        """Go on with the rows that are written from now on."""
        self._file.seek(0, os.SEEK_END)
        self._waiting, self._is_cut = b"", True

    def read(self, names: Sequence[str]) -> Columns | None:
        """These columns of the next rows, at most a megabyte of them; None if there is no new one."""
        data = self._waiting + self._file.read(_PIECE)
        if self._is_cut:
            _, found, data = data.partition(b"\n")
            self._is_cut = not found
        end = self._end_of_rows(data)
        self._waiting = data[end:]
        if len(self._waiting) > _PIECE:
            self._waiting, self._is_cut = b"", True  # no row is as long
        if not end:
            return None
        try:
            return self._columns(data[:end], names)
        except Exception:  # noqa: BLE001  each format has errors of its own for damaged rows, or for a text that is cut
            self._is_cut = True
            return Columns(np.zeros(0), {name: np.zeros(0) for name in names})
