"""The result CSV: the first column is `time`, the others are `<instance>.<variable>`.

A float has the smallest number of digits that gives the same bits when it is read; a Boolean is `true` or `false`, a
String is quoted text, a Binary is base64. `csv_rows.c` writes numbers; Python writes the same characters where there is
text, or no library.
"""

from __future__ import annotations

import base64
import csv
import ctypes
import io
import math
from collections.abc import Callable, Mapping, Sequence
from ctypes import c_int64, c_void_p
from functools import cache
from pathlib import Path
from typing import Any, Final, Self

import numpy as np
import orjson
from numpy.typing import NDArray

from ..config.findings import Findings
from ..errors import ConfigurationError
from ..files import Kept, exists, is_file
from ..rings.library import load_library
from .recording import Recording
from ..variables.value_types import VariableType, is_text
from .block_file import BlockFile
from .notes_file import NotesFile

__all__ = ["CsvFile", "NativeLines", "python_lines"]

_DEVICES: Final = ("/dev", "/dev/fd", "/proc/self/fd")
_READ_BYTES = 1 << 20
_TIME: Final = b"time"

_COLUMN_FIELDS: Final = 6
_CELLS: Final = 512
_CELL_BYTES: Final = 16
_VALUE_BYTES: Final = 25
_END_BYTES: Final = 40
"""What `csv_rows.c` needs."""

_WIDE: Final = {"f": np.float64, "i": np.int64, "u": np.uint64, "b": np.int64}
"""The 64 bits of a number for `csv_rows.c`, by its kind in NumPy."""


class CsvFile(BlockFile):
    """Writes rows of results, always complete rows.

    Args:
        path: the file; its folder is created, and the first row replaces an older file.
        columns: (name, type) of every column but `time`.
        metadata: of the run; if there are some, they are in `<path>.json`.

    Raises:
        ConfigurationError: the file cannot be written, or another run writes into it.
    """

    def __init__(
        self, path: Path, columns: Sequence[tuple[str, VariableType]], metadata: Mapping[str, Any] | None = None
    ) -> None:
        super().__init__(path, 1 + len(columns))
        is_device = str(path.parent) in _DEVICES or (exists(path) and not is_file(path))
        self._notes = NotesFile(path, metadata) if metadata and not is_device else None
        header = io.StringIO()
        csv.writer(header, lineterminator="\n").writerow(["time", *(name for name, _ in columns)])
        self._header = header.getvalue().encode()  # it is written with the first rows
        has_text = any(is_text(type_) for _, type_ in columns)
        self._lines: Callable[[Sequence[NDArray[Any]]], bytes | memoryview] = (
            python_lines if has_text or _native() is None else NativeLines(1 + len(columns), self._block_rows)
        )

    @classmethod
    def check(cls, recording: Recording, findings: Findings) -> None:
        """Check that no array is too large."""
        recording.check_arrays(findings)

    @classmethod
    def open(cls, path: Path, recording: Recording) -> Self:
        """Open a result file for what a run records."""
        return cls(path, recording.columns, recording.metadata)

    @staticmethod
    def keep_whole_rows(path: Path, kept: Kept) -> int:
        """Cut a result file off after its last complete row; return the number of its rows.

        Args:
            path: the file, which no process writes any more.
            kept: rows that are known to be complete; only what follows them is read.

        Raises:
            ConfigurationError: nothing is known, and it does not begin as a result file does.
        """
        lines, end, quoted = 0, kept.size, False
        with path.open("r+b") as file:
            start = file.read(1 + len(_TIME)).lstrip(b'"')
            if not kept.size and not (start.startswith(_TIME) or _TIME.startswith(start)):
                raise ConfigurationError(f"'{path}' is no result file: its first column is not '{_TIME.decode()}'.")
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
        if self._notes is not None and not self.rows:
            self._notes.begin()
        super().write(times, columns)

    def note(self, entry: Mapping[str, Any]) -> None:
        """Add an entry to the metadata."""
        if self._notes is not None:
            self._notes.note(entry)

    def close(self) -> None:
        """Close the file. Without a row, nothing has changed."""
        if self._notes is not None:
            self._notes.close()
        super().close()

    def _block(self, columns: Sequence[NDArray[Any]]) -> bytes | memoryview:
        lines = self._lines(columns)
        return lines if self.rows else self._header + lines


def python_lines(columns: Sequence[NDArray[Any]]) -> bytes:
    """A line for each row of columns of any type; there is at least one row."""
    return b"\n".join(map(b",".join, zip(*map(_texts, columns), strict=True))) + b"\n"


def _texts(column: NDArray[Any]) -> list[bytes]:
    if column.dtype == object:
        return [
            b'"' + value.replace('"', '""').encode() + b'"' if isinstance(value, str) else base64.b64encode(value)
            for value in column.tolist()
        ]
    values = np.ascontiguousarray(column, np.float64 if column.dtype == np.float32 else None)
    # JSON numbers also have the smallest number of digits; it has no `nan`, `inf` and `-inf`.
    texts = orjson.dumps(values, option=orjson.OPT_SERIALIZE_NUMPY)[1:-1].split(b",")
    for row in np.flatnonzero(~np.isfinite(values)):
        texts[row] = repr(float(values[row])).encode()
    return texts


class NativeLines:
    """Lines of numbers, written by `csv_rows.c` into memory that is used again and again.

    Args:
        width: number of columns.
        rows: how many rows there are at most at once.
    """

    def __init__(self, width: int, rows: int) -> None:
        native = _native()
        assert native is not None
        self._function, tables = native
        self._columns = np.zeros((width, _COLUMN_FIELDS), np.int64)
        self._cells = np.zeros(max(width, _CELLS) * _CELL_BYTES, np.uint8)
        # New memory takes as long as its text: the system gives it here, before there are rows.
        self._text = np.full(rows * width * _VALUE_BYTES + _END_BYTES, ord(" "), np.uint8)
        self._addresses = [array.ctypes.data for array in (self._columns, tables, self._cells, self._text)]

    def __call__(self, columns: Sequence[NDArray[Any]]) -> memoryview:
        """A line for each row, valid until the next call."""
        arrays = [np.asarray(column, _WIDE[column.dtype.kind]) for column in columns]
        rows = len(arrays[0])
        size = rows * len(arrays) * _VALUE_BYTES + _END_BYTES
        if any(array.shape != (rows,) for array in arrays) or size > len(self._text):
            msg = f"{rows} rows in columns of shape {[array.shape for array in arrays]}"
            raise ValueError(msg)  # the library would read or write beyond the end of an array
        self._columns[:, 0] = [array.ctypes.data for array in arrays]
        self._columns[:, 1] = [array.strides[0] for array in arrays]
        self._columns[:, 2] = [ord(column.dtype.kind) for column in columns]
        first, tables, cells, text = self._addresses
        size = self._function(first, len(arrays), rows, tables, cells, len(self._cells) // _CELL_BYTES, text)
        return self._text.data[:size]


@cache
def _native() -> tuple[Callable[..., int], NDArray[np.uint64]] | None:
    """The function of `csv_rows.c`, and its tables."""
    path = load_library()
    if path is None:
        return None
    powers = {n: _power(n) for n in range(-293, 326)}
    scales = []
    for q in range(-1075, 972):
        n = -1 - math.floor(q * math.log10(2))
        scales.append(powers[n] >> (-1 - q - math.floor(n * math.log2(10))))
    tables = b"".join(factor.to_bytes(16, "little") for factor in (*powers.values(), *scales))
    types = (c_void_p, c_int64, c_int64, c_void_p, c_void_p, c_int64, c_void_p)
    return ctypes.CFUNCTYPE(c_int64, *types)(("csv_rows", ctypes.CDLL(path))), np.frombuffer(tables, np.uint64)


def _power(exponent: int) -> int:
    """The first 128 bits of a power of ten, rounded down."""
    bits = 127 - math.floor(exponent * math.log2(10))
    numerator, denominator = (10**exponent, 1) if exponent >= 0 else (1, 10**-exponent)
    return (numerator << bits) // denominator if bits >= 0 else numerator >> -bits
