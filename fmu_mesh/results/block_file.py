"""Result files whose rows are written in blocks; each block goes to the operating system at once."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..config.findings import Findings
from ..files import Kept, open_alone
from .recording import Recording

__all__ = ["BlockFile"]

_BLOCK_NUMBERS = 16384
"""How many numbers a block has: those of more, and their text, do not fit into the cache."""


class BlockFile(ABC):
    """A result file (`ResultFile`) whose rows can be read while it grows; a subclass says what a block is.

    Args:
        path: the file; its folder is created, and the first row replaces an older file.
        width: number of columns, with the time.

    Attributes:
        path: the file.
        rows: number of rows in the file.
        kept: these rows, and their size in bytes.

    Raises:
        ConfigurationError: the file cannot be written, or another run writes into it.
    """

    def __init__(self, path: Path, width: int) -> None:
        self.path = path
        self.rows = 0
        self.kept = Kept()
        self._block_rows = max(1, _BLOCK_NUMBERS // width)
        self._file = open_alone(path)

    def resume(self, rows: int) -> None:
        """Go on after the rows that are in the file; see `Resumable`."""
        self._file.append_after(self.path.stat().st_size)
        self.rows, self.kept = rows, Kept(rows, self._file.size)

    @classmethod  # noqa: B027  there is nothing to find
    def check(cls, recording: Recording, findings: Findings) -> None:
        """Do nothing: the file can hold values of all types."""

    @staticmethod
    def growing_file(path: Path) -> Path:
        """The file itself."""
        return path

    @staticmethod
    @abstractmethod
    def keep_whole_rows(path: Path, kept: Kept) -> int:
        """Cut a file off after its last complete row; return the number of its rows. See `ResultFormat`."""

    @abstractmethod
    def _block(self, columns: Sequence[NDArray[Any]]) -> bytes | memoryview:
        """The bytes of some rows, valid until the next call; ``columns`` are arrays of one length, the times first."""

    def write(self, times: NDArray[np.float64], columns: Sequence[NDArray[Any]]) -> None:
        """Append one row per time; ``columns`` are arrays of the same length, of their types' dtypes."""
        for first in range(0, len(times), self._block_rows):
            rows = slice(first, first + self._block_rows)
            block = [column[rows] for column in (times, *columns)]
            left = memoryview(self._block(block))
            try:
                while left:
                    left = left[self._file.write(left) :]
            except OSError:
                with suppress(OSError):
                    self.rows = self.keep_whole_rows(self.path, self.kept) if self.path.is_file() else self.rows
                raise
            self.rows += len(block[0])
            self.kept = Kept(self.rows, self._file.size)

    def note(self, entry: Mapping[str, Any]) -> None:  # noqa: B027  not every format has a place for it
        """Do nothing: rows are all that the file has."""

    def flush(self) -> None:  # noqa: B027  nothing is left
        """Do nothing: `write` gives everything to the operating system."""

    def close(self) -> None:
        """Close the file. Without a row, nothing has changed."""
        self._file.close()
