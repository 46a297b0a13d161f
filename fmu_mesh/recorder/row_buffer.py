"""Collects rows of single values and writes many at once into the result files: used by a run in one process."""

# Two threads meet here: the one that steps, and the one that watches it, which saves the rows if a call of an FMU does
# not return. Both write under a lock. If the disk does not answer either, the watching thread gives up after half a
# second: a process that ends must not wait for it. The files are ADR 50 and 60.

from __future__ import annotations

import threading
import time
from collections.abc import Sequence
from contextlib import ExitStack
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..results.growth import GrowthWatch, ReadColumn
from ..results.record_files import RecordFiles
from ..results.recording import ResultFile
from ..simtime import TimeGrid
from ..system.records import RecordPlan, union_of
from ..variables.value_types import DTYPES, Value, VariableType

__all__ = ["RowBuffer"]

# Longer than a block takes to be written: whoever still writes then writes to a disk that does not answer.
_OTHER_WRITER_S = 0.5


class RowBuffer:
    """The rows of a run, from point 0 on.

    Args:
        files: the result files; empty: nothing is recorded.
        grid: their times.
        records: what each file gets.
        types: of the values of a row, which are those of `union_of` the records.
        growth: looks at all rows.

    Attributes:
        flushed_at: last time at which other processes could read all rows; monotonic, in s.

    Call `add` for every point and `write` from time to time; `close` at the end, also from another thread.
    """

    def __init__(
        self,
        files: Sequence[ResultFile],
        grid: TimeGrid,
        records: Sequence[RecordPlan],
        types: Sequence[VariableType],
        growth: GrowthWatch | None = None,
    ) -> None:
        self.flushed_at = 0.0
        self._files = RecordFiles(files, growth)
        self._types = types
        self._first = 0
        self._waiting: list[list[Value]] = []
        self._arrays: list[NDArray[Any]] = []
        self._writing = threading.Lock()
        places = {column: place for place, column in enumerate(union_of(records))}

        def column_of(instance: str, variable: str) -> ReadColumn:
            place = places[instance, variable]
            return lambda first, end: self._arrays[place][first - self._first : end - self._first]

        self._files.begin(grid, records, column_of)

    @property
    def counted(self) -> tuple[tuple[str, int], ...]:
        """Each file and the number of rows given to it; after `close`, the number of rows in the file."""
        return self._files.counted

    def add(self, row: list[Value]) -> None:
        """Add the row of the next point."""
        self._waiting.append(row)

    def write(self, *, flush: bool = False) -> None:
        """As `RecordFiles.write`, for the new rows; with ``flush``, other processes can read them then."""
        if flush:
            self.flushed_at = time.monotonic()
        with self._writing:
            self._write()
            if flush:
                self._files.flush()

    def close(self) -> None:
        """Write what is left and close the files (see `RecordFiles.close`)."""
        if self._writing.acquire(timeout=_OTHER_WRITER_S):  # else another thread writes to a disk that does not answer
            with ExitStack() as stack:
                stack.callback(self._writing.release)
                stack.callback(self._files.close)
                self._write()

    def _write(self) -> None:
        rows, self._waiting = self._waiting, []
        if not rows:
            return
        if {*self._types} == {"Float64"}:  # one call for all columns, which may be the elements of large arrays
            self._arrays = [*np.array(rows, dtype=np.float64).T]
        else:
            columns = zip(zip(*rows, strict=True), self._types, strict=True)
            self._arrays = [np.array(column, dtype=DTYPES[type_]) for column, type_ in columns]
        try:
            self._files.write(self._first, self._first + len(rows))
        finally:
            self._first += len(rows)
