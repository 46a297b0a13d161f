"""Follows the CSV that a run writes: all its rows from the first on, and each new one once.

Only reads. The run neither knows nor waits.
"""

from __future__ import annotations

import csv
import io
import os
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Final, Self

import numpy as np
from numpy.typing import NDArray

__all__ = ["CsvTail"]

_PIECE: Final = 1 << 20
"""Bytes that are read at once: the memory of one look."""
_FLAGS: Final = {b"true": 1.0, b"false": 0.0}

Table = tuple[NDArray[np.float64], NDArray[np.float64]]


class CsvTail:
    """The rows of a growing file in pieces.

    Args:
        path: the file.
        file: the open file, read up to some byte of a row.
        names: the columns without `time`.
        waiting: what was read of that row.

    Attributes:
        path: the file.
        names: the columns without `time`.
    """

    def __init__(self, path: Path, file: io.FileIO, names: Sequence[str], waiting: bytes) -> None:
        self.path = path
        self.names = names
        self._file = file
        self._waiting = waiting
        self._cut = False  # the next byte may be in the middle of a row

    @classmethod
    def open(cls, path: Path) -> Self | None:
        """Open a result file; None if there is none that this process can read."""
        try:
            file = io.FileIO(path)
        except OSError:
            return None
        heading, end, waiting = file.read(_PIECE).partition(b"\n")
        try:
            names = next(csv.reader([heading.decode()]), [])
        except (UnicodeDecodeError, csv.Error):
            names = []
        if not end or names[:1] != ["time"]:
            file.close()
            return None
        return cls(path, file, names[1:], waiting)

    @property
    def replaced(self) -> bool:
        """Whether another file has this name by now."""
        try:
            return not os.path.samestat(os.fstat(self._file.fileno()), self.path.stat())
        except OSError:
            return True

    @property
    def behind(self) -> int:
        """Bytes of the file that were not read yet."""
        return os.fstat(self._file.fileno()).st_size - self._file.tell()

    def skip(self) -> None:
        """Go on with the rows that are written from now on."""
        self._file.seek(0, os.SEEK_END)
        self._waiting, self._cut = b"", True

    def read(self, columns: Sequence[str]) -> Table | None:
        """The next rows, at most a megabyte of them; None if there is no new one.

        Returns:
            The times in s, shape `(rows,)`, and the values, shape `(columns, rows)`. What is no number is NaN.
        """
        piece = self._file.read(_PIECE)
        data = self._waiting + piece
        if self._cut:
            _, found, data = data.partition(b"\n")
            self._cut = not found
        end = data.rfind(b"\n") + 1
        self._waiting = data[end:] if len(data) - end <= _PIECE else b""
        if not end:
            return None
        at = [0, *(1 + self.names.index(name) for name in columns)]
        table = _table(data[:end], at, 1 + len(self.names))
        return (table[0], table[1:]) if table.shape[1] else None

    def close(self) -> None:
        """Close the file."""
        self._file.close()


def _table(data: bytes, at: Sequence[int], width: int) -> NDArray[np.float64]:
    """These columns of whole rows, shape `(columns, rows)`."""
    if b'"' in data:  # a text, which may contain commas and line ends
        return _texts(csv.reader(io.StringIO(data.decode(errors="replace"), newline="")), at, width)
    needed = 1 + max(at)
    rows = [line.split(b",", needed) for line in data.splitlines()]
    try:
        return np.array([[float(row[i]) for row in rows] for i in at])
    except (ValueError, IndexError):
        return _texts([[cell.decode(errors="replace") for cell in row] for row in rows], at, 0)


def _texts(rows: Iterable[Sequence[str]], at: Sequence[int], width: int) -> NDArray[np.float64]:
    whole = [row for row in rows if len(row) > max(at) and width in (0, len(row))]
    return np.array([[_number(row[i].encode()) for row in whole] for i in at]).reshape(len(at), len(whole))


def _number(text: bytes) -> float:
    if (flag := _FLAGS.get(text)) is not None:
        return flag
    try:
        return float(text)
    except ValueError:
        return float("nan")
