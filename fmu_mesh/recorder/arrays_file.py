"""Results as arrays in a file of this host: what `record="memory"` writes in one process and reads in another.

The file is a sequence of blocks, each with the rows of one `write`. It lasts only as long as its run, so its format may
change with every version.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Self

import msgspec
import numpy as np
from numpy.typing import NDArray

from ..config.findings import Findings
from ..files import Kept, open_alone
from ..system.recording import Recording
from ..variables.value_types import DTYPES, VariableType, is_text

__all__ = ["ENDING", "ArraysFile", "bytes_of_a_row", "read_arrays"]

ENDING = ".arrays"

_HEAD = struct.Struct("<qq")
"""Number of bytes that follow, and number of rows in them."""

_BLOCK_BYTES = 1 << 16
"""The size of a block: for a larger one, each time, the operating system would give new memory, page by page."""


def bytes_of_a_row(types: Sequence[VariableType]) -> int:
    """The size of a row in bytes, time included; texts are not counted, as their size is not known."""
    return 8 + sum(np.dtype(DTYPES[type_]).itemsize for type_ in types if not is_text(type_))


def read_arrays(path: Path, types: Sequence[VariableType]) -> tuple[NDArray[np.float64], list[NDArray[Any]]]:
    """Read a file of this module.

    Args:
        path: the file; if it does not exist there are no rows.
        types: the types of the columns.

    Returns:
        The times in s, shape `(rows,)`, and an array of the same shape for each column.
    """
    data = memoryview(path.read_bytes() if path.exists() else b"")
    times: list[NDArray[np.float64]] = [np.zeros(0)]
    columns: list[list[NDArray[Any]]] = [[np.zeros(0, DTYPES[type_])] for type_ in types]
    offset = 0
    while offset + _HEAD.size <= len(data):
        size, _ = _HEAD.unpack_from(data, offset)
        offset += _HEAD.size
        if offset + size > len(data):  # the writer was killed within a block
            break
        stamps, *parts = msgspec.msgpack.decode(data[offset : offset + size])
        offset += size
        times.append(np.frombuffer(stamps))
        for column, part, type_ in zip(columns, parts, types, strict=True):
            column.append(np.array(part, object) if is_text(type_) else np.frombuffer(part, DTYPES[type_]))
    return np.concatenate(times), [np.concatenate(column) for column in columns]


class ArraysFile:
    """Writes rows of results as blocks of arrays.

    Args:
        path: the file.
        types: the types of the columns but `time`.

    Attributes:
        path: the file.
        rows: rows written so far.
    """

    def __init__(self, path: Path, types: Sequence[VariableType]) -> None:
        self.path = path
        self.rows = 0
        self._types = types
        self._block_rows = max(1, _BLOCK_BYTES // bytes_of_a_row(types))
        self._file = open_alone(path)

    @classmethod
    def check(cls, recording: Recording, findings: Findings) -> None:
        """The file can hold everything."""

    @classmethod
    def open(cls, path: Path, recording: Recording) -> Self:
        """Open a file for what a run records."""
        return cls(path, [type_ for _, type_ in recording.columns])

    @staticmethod
    def keep_whole_rows(path: Path, kept: Kept) -> int:
        """Cut a file off after its last whole block; returns the number of its rows."""
        rows, end, total = kept.rows, kept.size, path.stat().st_size
        with path.open("r+b") as file:
            while end + _HEAD.size <= total:
                file.seek(end)
                size, more = _HEAD.unpack(file.read(_HEAD.size))
                if end + _HEAD.size + size > total:
                    break
                rows, end = rows + more, end + _HEAD.size + size
            file.truncate(end)
        return rows

    @property
    def kept(self) -> Kept:
        """All rows: each block is written at once."""
        return Kept(self.rows, self._file.size)

    def write(self, times: NDArray[np.float64], columns: Sequence[NDArray[Any]]) -> None:
        """Append one row per time; ``columns`` are arrays of the same length."""
        for first in range(0, len(times), self._block_rows):
            part = slice(first, first + self._block_rows)
            self._write(times[part], [column[part] for column in columns])

    def flush(self) -> None:
        """Do nothing: `write` gives everything to the operating system."""

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def _write(self, times: NDArray[np.float64], columns: Sequence[NDArray[Any]]) -> None:
        parts = [
            column.tolist() if is_text(type_) else np.ascontiguousarray(column, DTYPES[type_]).tobytes()
            for column, type_ in zip(columns, self._types, strict=True)
        ]
        block = msgspec.msgpack.encode([np.ascontiguousarray(times).tobytes(), *parts])
        left = memoryview(_HEAD.pack(len(block), len(times)) + block)
        while left:
            left = left[self._file.write(left) :]
        self.rows += len(times)
