"""Makes lines of a CSV file from columns: in C for numbers, in Python for texts and where the library is missing.

Both write the same characters. A float has the smallest number of digits that gives the same bits when it is read.
"""

from __future__ import annotations

import base64
import ctypes
import math
from collections.abc import Sequence
from ctypes import c_int64, c_void_p
from functools import cache
from itertools import chain
from typing import Any, Final, Protocol

import numpy as np
import orjson
from numpy.typing import NDArray

from ..rings.library import load_library
from ..rings.native import NUMBER_TYPES
from ..variables.value_types import DTYPES, Value, VariableType, is_text

__all__ = ["Lines", "NativeLines", "PythonLines", "lines_of"]

_VALUE_BYTES: Final = 25
_END_BYTES: Final = 40
_LEAST_POWER, _MOST_POWER, _EXPONENTS = -293, 325, 2047
"""The sizes of the tables in `csv_rows.c`."""

_COLUMN_FIELDS = 6
"""A column in `csv_rows.c`: its address, stride, type; and three fields of its own."""


class Lines(Protocol):
    """The text of rows that are not in a file yet.

    Attributes:
        size: its number of bytes.
    """

    size: int

    def append(self, columns: Sequence[NDArray[Any]]) -> None:
        """Append a line for each row; ``columns`` are arrays of the same length, the times first."""

    def take(self) -> memoryview:
        """The text, which is valid until the next call of `append`; there is none left then."""


def lines_of(types: Sequence[VariableType], rows: int, size: int) -> Lines:
    """What makes the lines of a file.

    Args:
        types: the types of the columns but the time.
        rows: how many rows are appended at most at once, and only while there are fewer than ``size`` bytes.
        size: see ``rows``.
    """
    if _native() is None or any(is_text(type_) for type_ in types):
        return PythonLines(types)
    return NativeLines(types, rows, size)


class PythonLines:
    """Lines of values of all types, written by orjson and Python."""

    def __init__(self, types: Sequence[VariableType]) -> None:
        self.size = 0
        self._parts: list[bytes] = []
        self._has_text = any(is_text(type_) for type_ in types)
        self._is_float = all(type_ == "Float64" for type_ in types)

    def append(self, columns: Sequence[NDArray[Any]]) -> None:
        """Append a line for each row."""
        lines = self._format(columns)
        self._parts.append(lines)
        self.size += len(lines)

    def take(self) -> memoryview:
        """The text so far."""
        text = b"".join(self._parts)
        self._parts, self.size = [], 0
        return memoryview(text)

    def _format(self, columns: Sequence[NDArray[Any]]) -> bytes:
        # JSON numbers also have the smallest number of digits, and orjson writes an array without Python objects.
        if self._is_float:
            values = np.stack(columns, axis=1)
            if np.isfinite(values).all():
                return _in_lines(orjson.dumps(values.ravel(), option=orjson.OPT_SERIALIZE_NUMPY), len(columns))
        rows = zip(*(column.tolist() for column in columns), strict=True)
        if self._has_text or not all(np.isfinite(column).all() for column in columns):
            return "".join(",".join(map(_text, row)) + "\n" for row in rows).encode()
        return _in_lines(orjson.dumps(list(chain.from_iterable(rows))), len(columns))


def _in_lines(numbers: bytes, width: int) -> bytes:
    """Lines with ``width`` numbers each, from a JSON array: the comma after a line's last number becomes a line end."""
    characters = np.frombuffer(numbers, dtype=np.uint8).copy()
    characters[np.flatnonzero(characters == ord(","))[width - 1 :: width]] = ord("\n")
    characters[-1] = ord("\n")
    return characters[1:].tobytes()


def _text(value: Value) -> str:
    """One value as text: `nan`, `inf`, `-inf` and strings are not as in JSON; all others are."""
    match value:
        case str():
            return '"' + value.replace('"', '""') + '"'
        case bytes():
            return base64.b64encode(value).decode()
        case float() if not math.isfinite(value):
            return repr(value)
        case _:
            return orjson.dumps(value).decode()


class _Native:
    """The function of `csv_rows.c`: ``rows(columns, number of columns, rows, tables, text)``; and its tables."""

    def __init__(self, path: str) -> None:
        library = ctypes.CDLL(path)
        self.rows = ctypes.CFUNCTYPE(c_int64, c_void_p, c_int64, c_int64, c_void_p, c_void_p)(("csv_rows", library))
        powers = (_power(n) for n in range(_LEAST_POWER, _MOST_POWER + 1))
        halves = [half for power in powers for half in divmod(power, 2**64)]
        self._tables = np.array(halves + [0, 0] * _EXPONENTS, dtype=np.uint64)
        self.tables: int = self._tables.ctypes.data
        ctypes.CFUNCTYPE(None, c_void_p)(("csv_prepare", library))(self.tables)


def _power(exponent: int) -> int:
    """The first 128 bits of a power of ten, rounded down."""
    bits = 127 - math.floor(exponent * math.log2(10))
    numerator, denominator = (10**exponent, 1) if exponent >= 0 else (1, 10**-exponent)
    return (numerator << bits) // denominator if bits >= 0 else numerator >> -bits


@cache
def _native() -> _Native | None:
    path = load_library()
    return _Native(path) if path is not None else None


class NativeLines:
    """Lines of numbers, written by `csv_rows.c` into memory that is used again and again.

    New memory from the operating system would take as long as its text.
    """

    def __init__(self, types: Sequence[VariableType], rows: int, size: int) -> None:
        native = _native()
        if native is None:
            msg = "there is no library for this platform"
            raise OSError(msg)
        all_types: tuple[VariableType, ...] = ("Float64", *types)
        self.size = 0
        self._native = native
        self._dtypes = [np.dtype(DTYPES[type_]) for type_ in all_types]
        self._columns = np.zeros((len(all_types), _COLUMN_FIELDS), np.int64)
        self._columns_address: int = self._columns.ctypes.data
        self._columns[:, 2] = [NUMBER_TYPES[type_] for type_ in all_types]
        self._rows, self._limit = rows, size
        self._text = np.empty(size + rows * len(all_types) * _VALUE_BYTES + _END_BYTES, np.uint8)
        self._text_address: int = self._text.ctypes.data

    def append(self, columns: Sequence[NDArray[Any]]) -> None:
        """Append a line for each row."""
        arrays = [np.asarray(column, dtype) for column, dtype in zip(columns, self._dtypes, strict=True)]
        rows = len(arrays[0])
        if any(array.shape != (rows,) for array in arrays) or self.size >= self._limit or rows > self._rows:
            msg = f"{rows} rows after {self.size} bytes, in columns of shape {[array.shape for array in arrays]}"
            raise ValueError(msg)  # the library would read or write beyond the end of an array
        self._columns[:, 0] = [array.ctypes.data for array in arrays]
        self._columns[:, 1] = [array.strides[0] for array in arrays]
        end = self._text_address + self.size
        self.size += self._native.rows(self._columns_address, len(arrays), rows, self._native.tables, end)

    def take(self) -> memoryview:
        """The text so far."""
        text = self._text.data[: self.size]
        self.size = 0
        return text
