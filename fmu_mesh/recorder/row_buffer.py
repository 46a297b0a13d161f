"""Collects rows of single values and writes many at once into a result file: used by a run in one process."""

from __future__ import annotations

import threading
import time
from collections.abc import Sequence

import numpy as np

from ..files import unwritable
from ..simtime import TimeGrid
from ..system.recording import ResultFile
from ..variables.value_types import DTYPES, Value, VariableType

__all__ = ["RowBuffer"]

_CLOSE_S = 0.5


class RowBuffer:
    """The rows of a run, from point 0 on.

    Args:
        file: the result file; None: nothing is recorded.
        grid: their times.
        types: of their columns.

    Attributes:
        flushed_at: last time at which other processes could read all rows; monotonic, in s.

    Call `add` for every point and `write` from time to time; `close` at the end, also from another thread.
    """

    def __init__(self, file: ResultFile | None, grid: TimeGrid, types: Sequence[VariableType]) -> None:
        self.flushed_at = 0.0
        self._file = file
        self._grid = grid
        self._types = types
        self._first = 0
        self._waiting: list[list[Value]] = []
        self._writing = threading.Lock()

    @property
    def count(self) -> int:
        """Number of rows given to the file; after `close`, the number of rows in the file."""
        return self._file.rows if self._file is not None else 0

    def add(self, row: list[Value]) -> None:
        """Add the row of the next point."""
        self._waiting.append(row)

    def write(self, *, flush: bool = False) -> None:
        """Give the new rows to the file; with ``flush``, other processes can read them then.

        Raises:
            ConfigurationError: it cannot be written.
        """
        if flush:
            self.flushed_at = time.monotonic()
        if self._file is None:
            return
        try:
            with self._writing:
                self._write(self._file)
                if flush:
                    self._file.flush()
        except OSError as error:
            raise unwritable(self._file.path, error) from error

    def close(self) -> None:
        """Write what is left and close the file.

        Raises:
            ConfigurationError: it cannot be written.
        """
        if self._file is None or not self._writing.acquire(timeout=_CLOSE_S):
            return  # another thread is writing to a disk that does not answer
        try:
            try:
                self._write(self._file)
            finally:
                self._file.close()
        except OSError as error:
            raise unwritable(self._file.path, error) from error
        finally:
            self._writing.release()

    def _write(self, file: ResultFile) -> None:
        rows, self._waiting = self._waiting, []
        if not rows:
            return
        first, self._first = self._first, self._first + len(rows)
        columns = zip(zip(*rows, strict=True), self._types, strict=True)
        arrays = [np.array(column, dtype=DTYPES[type_]) for column, type_ in columns]
        file.write(self._grid.times(first, self._first), arrays)
