"""The result files of a run: each gets its own columns, at its own points, from the same rows.

Knows neither where the values come from nor any format.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from ..files import unwritable
from ..simtime import TimeGrid
from .recording import ResultFile
from ..system.records import RecordPlan
from .growth import GrowthWatch, ReadColumn

__all__ = ["ReadColumn", "RecordFiles"]


class RecordFiles:
    """The open result files of a run.

    Call sequence: `begin`, then `write` and `flush` from one thread at a time; at the end, and after any exception,
    `close`. A file that cannot be written is only closed then; all others get their rows as before.

    Args:
        files: the files, in the order of their plans.
        growth: looks at all rows.
    """

    def __init__(self, files: Sequence[ResultFile], growth: GrowthWatch | None = None) -> None:
        self._growth = growth
        self._files = [_RecordFile(file) for file in files]

    @property
    def rows(self) -> int:
        """Number of rows of the first file, written so far; after `close`, of those in the file."""
        return self._files[0].file.rows if self._files else 0

    @property
    def warnings(self) -> tuple[str, ...]:
        """What the rows so far warn of."""
        return self._growth.warnings if self._growth is not None else ()

    @property
    def counted(self) -> tuple[tuple[str, int], ...]:
        """The path and the number of rows of each file."""
        return tuple((str(own.file.path), own.file.rows) for own in self._files)

    def begin(self, grid: TimeGrid, records: Sequence[RecordPlan], column_of: Callable[[str, str], ReadColumn]) -> None:
        """Choose what the files get.

        Args:
            grid: the communication points.
            records: the plan of each file.
            column_of: how the values of a variable of an instance are read.
        """
        columns: dict[tuple[str, str], ReadColumn] = {}
        for own, record in zip(self._files, records, strict=True):
            for key in record.variables:
                if key not in columns:
                    columns[key] = column_of(*key)
            own.begin(grid, record, [columns[key] for key in record.variables])
        if self._growth is not None:
            self._growth.begin(columns)

    def write(self, first: int, end: int) -> None:
        """Write the rows of the points first to end - 1, as far as they are not written yet.

        Raises:
            ConfigurationError: a file cannot be written; the others have their rows.
        """
        if self._growth is not None:
            self._growth.look(first, end)
        self._each(lambda own: own.write(first, end))

    def note(self, entry: Mapping[str, Any]) -> None:
        """Add what happened to the metadata of all files.

        Raises:
            ConfigurationError: a file cannot be written.
        """
        self._each(lambda own: own.note(entry))

    def flush(self) -> None:
        """Give all rows to the operating system.

        Raises:
            ConfigurationError: a file cannot be written.
        """
        self._each(_RecordFile.flush)

    def close(self) -> None:
        """Close all files. Nothing happens if they are closed.

        Raises:
            ConfigurationError: a file cannot be written.
        """
        self._each(_RecordFile.close)

    def _each(self, call: Callable[[_RecordFile], OSError | None]) -> None:
        """Call a method of each file; then raise the first error."""
        failed = [(own, error) for own in self._files if (error := call(own)) is not None]
        for own, error in failed:
            raise unwritable(own.file.path, error) from error


class _RecordFile:
    """One of the files. After its first error nothing more is written, and no other error is returned."""

    def __init__(self, file: ResultFile) -> None:
        self.file = file
        self._failed = False
        self._is_open = True
        self._next = 0
        self._columns: Sequence[ReadColumn] = ()

    def begin(self, grid: TimeGrid, record: RecordPlan, columns: Sequence[ReadColumn]) -> None:
        """See `RecordFiles.begin`."""
        self._grid, self._record, self._columns = grid, record, columns
        self._has_all_points = (record.first, record.every) == (0, 1)

    def write(self, first: int, end: int) -> OSError | None:
        """See `RecordFiles.write`."""
        first = max(first, self._next)
        if first >= end or not self._columns:
            return None
        error = self._tried(lambda: self._write(first, end))
        if error is None:
            self._next = end
        return error

    def note(self, entry: Mapping[str, Any]) -> OSError | None:
        """See `RecordFiles.note`."""
        return self._tried(lambda: self.file.note(entry))

    def flush(self) -> OSError | None:
        """See `RecordFiles.flush`."""
        return self._tried(self.file.flush)

    def close(self) -> OSError | None:
        """See `RecordFiles.close`."""
        if not self._is_open:
            return None
        self._is_open = False
        try:
            self.file.close()
        except OSError as error:
            return error if not self._failed else None
        return None

    def _tried(self, call: Callable[[], None]) -> OSError | None:
        """The error of a call that writes; nothing is called after the first error, or after the end."""
        if self._failed or not self._is_open:
            return None
        try:
            call()
        except OSError as error:
            self._failed = True
            return error
        return None

    def _write(self, first: int, end: int) -> None:
        if self._has_all_points:
            self.file.write(self._grid.times(first, end), [column(first, end) for column in self._columns])
            return
        rows = self._record.rows_within(first, end)
        times = self._grid.times(first, end)[rows]
        if len(times):
            self.file.write(times, [column(first, end)[rows] for column in self._columns])
