"""The result CSV: the first column is `time`, the others are `<instance>.<variable>`.

A float has the smallest number of digits that gives the same bits when it is read; a Boolean is `true` or `false`, a
String is quoted text, a Binary is base64.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from ..config.findings import Findings
from ..files import Kept, open_alone
from ..system.recording import Recording
from ..variables.value_types import VariableType
from .lines import lines_of

__all__ = ["CsvFile"]

_CHUNK_NUMBERS = 16384
"""How much is formatted at once: the text of more does not fit into the cache."""

_BUFFER_BYTES = 1 << 16
_READ_BYTES = 1 << 20


class CsvFile:
    """Writes rows of results, always complete rows.

    Args:
        path: the file; its folder is created, and the first row replaces an older file.
        columns: (name, type) of every column but `time`.

    Attributes:
        path: the file.
        rows: number of rows written so far; after `close`, the number of rows in the file.
        kept: what the operating system has.

    Raises:
        ConfigurationError: the file cannot be written, or another run writes into it.
    """

    def __init__(self, path: Path, columns: Sequence[tuple[str, VariableType]]) -> None:
        self.path = path
        self.rows = 0
        self.kept = Kept()
        self._chunk_rows = max(1, _CHUNK_NUMBERS // (1 + len(columns)))
        self._file = open_alone(path)
        header = io.StringIO()
        csv.writer(header, lineterminator="\n").writerow(["time", *(name for name, _ in columns)])
        self._header = header.getvalue().encode()  # it is written with the first rows
        self._lines = lines_of([type_ for _, type_ in columns], self._chunk_rows, _BUFFER_BYTES)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    @classmethod
    def check(cls, recording: Recording, findings: Findings) -> None:
        """Do nothing: a CSV file can hold values of all types."""

    @classmethod
    def open(cls, path: Path, recording: Recording) -> Self:
        """Open a result file for what a run records."""
        return cls(path, recording.columns)

    @staticmethod
    def keep_whole_rows(path: Path, kept: Kept) -> int:
        """Cut a result file off after its last complete row; return the number of its rows.

        Args:
            path: the file, which no process writes any more.
            kept: rows that are known to be complete; only what follows them is read.
        """
        lines, end, quoted = 0, kept.size, False
        with path.open("r+b") as file:
            offset = file.seek(kept.size)
            while piece := file.read(_READ_BYTES):
                for number, part in enumerate(piece.split(b'"')):  # a String may contain line ends
                    if number:
                        quoted = not quoted
                        offset += 1
                    if not quoted and (last := part.rfind(b"\n")) >= 0:
                        lines += part.count(b"\n")
                        end = offset + last + 1
                    offset += len(part)
            rows = kept.rows + lines - (0 if kept.size else 1)  # the first line is the heading
            file.truncate(end if rows > 0 else 0)
        return max(rows, 0)

    def write(self, times: NDArray[np.float64], columns: Sequence[NDArray[Any]]) -> None:
        """Append one row per time; ``columns`` are arrays of the same length, of their types' dtypes."""
        for first in range(0, len(times), self._chunk_rows):
            part = slice(first, first + self._chunk_rows)
            self._lines.append([times[part], *(column[part] for column in columns)])
            self.rows += len(times[part])
            if self._lines.size >= _BUFFER_BYTES:
                self.flush()

    def flush(self) -> None:
        """Give everything to the operating system, so that it is not lost if this process dies."""
        if not self._lines.size:
            return
        left = self._lines.take()
        if self._header:
            left, self._header = memoryview(self._header + left), b""
        try:
            while left:
                left = left[self._file.write(left) :]
        except OSError:
            self.rows = self._rows_in_file()
            raise
        self.kept = Kept(self.rows, self._file.size)

    def close(self) -> None:
        """Write what is left and close the file. Without a row, nothing has changed."""
        try:
            self.flush()
        finally:
            self._file.close()

    def _rows_in_file(self) -> int:
        """Number of complete rows in the file after a write has failed."""
        with suppress(OSError):
            if self.path.is_file():
                return self.keep_whole_rows(self.path, self.kept)
        return self.kept.rows
