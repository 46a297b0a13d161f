"""The result CSV: the first column is `time`, the others are `<instance>.<variable>`.

A float has the smallest number of digits that gives the same bits when it is read; a Boolean is `true` or `false`, a
String is quoted text, a Binary is base64. `csv_rows.c` writes numbers; Python writes the same characters where there is
text, or no library.

The last row may be cut off where a run was killed, or goes on.
"""

# Why lines are made in C, and why twice. The recorder shares the processors with nodes that step, and most of its
# time is the text of numbers. orjson makes it fast, but it has to be split into cells again: to find its commas took
# NumPy a quarter of the recorder's time (ADR 7). `csv_rows.c` writes the digits of a whole block into memory that is
# used again, and copies the text of a value that has not changed. Python has the same characters for texts and for
# machines without the library; tests compare both.
#
# What may go wrong: the writer may be killed at any byte, and a reader may look at any moment. So `write` gives whole
# rows to the operating system, nothing is buffered, and everybody who reads finds the end of the last whole row with
# `_end_of_rows`: quotation marks are counted, because a text may contain line ends. Threads: rows are written by one
# thread at a time, and the file may be closed by another one (`RecordFiles`); the C function holds no lock and keeps
# nothing but the memory that it is given. An old result is replaced by the first row only (ADR 50).

from __future__ import annotations

import base64
import csv
import ctypes
import io
import math
import re
from codecs import BOM_UTF8
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from ctypes import c_int64, c_void_p
from functools import cache
from pathlib import Path
from typing import Any, BinaryIO, Final, Self

import numpy as np
import orjson
from numpy.typing import NDArray

from ..config.findings import Findings
from ..errors import ConfigurationError
from ..files import Kept, exists, is_file, opened
from ..rings.library import load_library
from ..variables.value_types import DTYPES, VariableType, is_float, is_text
from .block_file import BlockFile
from .notes_file import NotesFile, read_notes
from .recording import Columns, Recording
from .tails import LineTail

__all__ = ["CsvFile", "NativeLines", "python_lines"]

_DEVICES: Final = ("/dev", "/dev/fd", "/proc/self/fd")
_READ_BYTES: Final = 1 << 20
_PIECE_BYTES: Final = 1 << 22
_TIME: Final = "time"

_MOST_ELEMENTS: Final = 10_000
"""How many elements of an array may be columns: a file with more takes seconds per row, and few programs open it."""

_COLUMN_FIELDS: Final = 6
_CELLS: Final = 512
_CELL_BYTES: Final = 16
_VALUE_BYTES: Final = 25
_END_BYTES: Final = 40
"""What `csv_rows.c` needs."""

_WIDE: Final = {"f": np.float64, "i": np.int64, "u": np.uint64, "b": np.int64}
"""The 64 bits of a number for `csv_rows.c`, by its kind in NumPy."""

_FIELD = re.compile(rb'(?:(?<=,)|(?<!.))("[^"]*(?:""[^"]*)*"|[^,"]*)(?=,|\Z)', re.DOTALL)
_BEGUN = re.compile(rb'(?:(?:"[^"]*(?:""[^"]*)*"|[^,"]*),)*(?:"[^"]*(?:""[^"]*)*"?|[^,"]*)')
_READERS: Final[dict[VariableType, Callable[[bytes], object]]] = {
    "Boolean": {b"true": True, b"false": False}.__getitem__,
    "String": lambda field: field[1:-1].decode().replace('""', '"'),
    "Binary": base64.b64decode,
}


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
        self._has_notes = False
        header = io.StringIO()
        csv.writer(header, lineterminator="\n").writerow([_TIME, *(name for name, _ in columns)])
        self._header = header.getvalue().encode()  # it is written with the first rows
        has_text = any(is_text(type_) for _, type_ in columns)
        self._lines: Callable[[Sequence[NDArray[Any]]], bytes | memoryview] = (
            python_lines if has_text or _native() is None else NativeLines(1 + len(columns), self._block_rows)
        )

    @classmethod
    def check(cls, recording: Recording, findings: Findings) -> None:
        """Add a finding for each array that is too large for a file with a column for each element."""
        known = [(own, recording.variable(own, name)) for own, name in recording.recorded]
        arrays = Counter(f"{own}.{variable.name}" for own, variable in known if variable.shape)
        for array, count in arrays.items():
            if count > _MOST_ELEMENTS:
                found = f"{count:,} elements of '{array}', for which this format has a column each"
                ways = f"a file ending in .parquet or .mcap, or variables without '{array}'"
                expected = f"at most {_MOST_ELEMENTS:,} elements, {ways}"
                findings.add(f"{recording.place}.variables", found, expected)

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
        with path.open("r+b") as file:
            start = file.read(1 + len(_TIME)).decode(errors="replace").lstrip('"')
            if not kept.size and not (start.startswith(_TIME) or _TIME.startswith(start)):
                raise ConfigurationError(f"'{path}' is no result file: its first column is not '{_TIME}'.")
            end, rest = file.seek(kept.size), b""
            rows = kept.rows if kept.size else -1  # the first line is the heading
            while piece := file.read(_READ_BYTES):
                rest += piece
                size = _end_of_rows(rest)
                rows += sum(part.count(b"\n") for part in rest[:size].split(b'"')[::2])  # not within texts
                end, rest = end + size, rest[size:]
            file.truncate(end if rows > 0 else 0)
        return max(rows, 0)

    @staticmethod
    def pieces(path: Path, types: Mapping[str, VariableType]) -> Iterator[Columns]:
        """The rows of a file, piece by piece.

        Args:
            path: the file.
            types: the types of the columns, by name. Without them, the first row tells truth values, whole numbers,
                floats and texts apart; a column with a number that is not whole is one of floats from there on.

        Raises:
            ConfigurationError: it is no result file; with the line.
        """
        with opened(path) as file:
            table = _Table(path, file, types)
            data, body = file.read(_PIECE_BYTES), b""
            while True:
                body += data
                end = _end_of_rows(body)
                if end or not data:
                    yield table.columns(body[:end])
                    body = body[end:]
                if not data:
                    table.check_end(body)
                    return
                data = file.read(_PIECE_BYTES)

    @staticmethod
    def follow(path: Path) -> LineTail | None:
        """Open a file that may still grow; None if its heading is not complete."""
        with ExitStack() as stack:
            file = stack.enter_context(opened(path))
            table = _Table(path, file, {})
            if not table.is_begun:
                return None
            stack.pop_all()
        return LineTail(path, file, table.names, table.columns, _end_of_rows)

    def write(self, times: NDArray[np.float64], columns: Sequence[NDArray[Any]]) -> None:
        """Append one row per time; ``columns`` are arrays of the same length, of their types' dtypes."""
        if self._notes is not None and not self._has_notes:
            self._has_notes = True
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
    powers = {}
    for n in range(-293, 326):  # the first 128 bits of each power of ten, rounded down
        bits = 127 - math.floor(n * math.log2(10))
        numerator, denominator = (10**n, 1) if n >= 0 else (1, 10**-n)
        powers[n] = (numerator << bits) // denominator if bits >= 0 else numerator >> -bits
    scales = []
    for q in range(-1075, 972):
        n = -1 - math.floor(q * math.log10(2))
        scales.append(powers[n] >> (-1 - q - math.floor(n * math.log2(10))))
    tables = b"".join(factor.to_bytes(16, "little") for factor in (*powers.values(), *scales))
    types = (c_void_p, c_int64, c_int64, c_void_p, c_void_p, c_int64, c_void_p)
    return ctypes.CFUNCTYPE(c_int64, *types)(("csv_rows", ctypes.CDLL(path))), np.frombuffer(tables, np.uint64)


class _Table:
    """Turns the rows of a file into columns, piece by piece.

    Args:
        path: the file.
        file: it, open at its beginning; afterwards at its first row.
        types: the types of the columns by name, as far as they are known.

    Attributes:
        names: the columns without `time`.
        is_begun: whether the heading is complete.

    Raises:
        ConfigurationError: the first column is not `time`.
    """

    def __init__(self, path: Path, file: BinaryIO, types: Mapping[str, VariableType]) -> None:
        heading = file.readline().removeprefix(BOM_UTF8)  # Excel writes one
        while heading.count(b'"') % 2 and len(heading) < _PIECE_BYTES and (more := file.readline(_PIECE_BYTES)):
            heading += more  # a name may contain line ends
        names = next(csv.reader([heading.decode()], strict=True), [])
        if names[:1] != [_TIME]:
            found = f"its first column is '{names[0][:40]}'" if names else "it is empty"
            raise ConfigurationError(f"'{path}' is no result file: {found}, not '{_TIME}'.")
        self.names = names[1:]
        self.is_begun = heading.endswith(b"\n")
        self._path = path
        self._line = 1 + heading.count(b"\n")
        self._metadata = read_notes(path)
        about = {name: own for name, own in self._metadata.get("variables", {}).items() if name in self.names}
        self._units = {name: own["unit"] for name, own in about.items() if own.get("unit") is not None}
        self._known = {name: own["type"] for name, own in about.items()} | dict(types)
        self._types: list[VariableType] = []

    def columns(self, body: bytes, wanted: Sequence[str] | None = None) -> Columns:
        """Some or all columns of whole rows, which follow those of the last call."""
        body.decode()  # not every number would tell a byte that is no text
        if not self._types:
            first = next(self._rows(body), [b"0.0"] * (1 + len(self.names)))
            of_columns = zip(self.names, first[1:], strict=True)
            self._types = ["Float64", *(self._known.get(name, _type_of(text)) for name, text in of_columns)]
        names = self.names if wanted is None else wanted
        places = range(1 + len(names)) if wanted is None else [0, *(1 + self.names.index(name) for name in wanted)]
        if all(is_float(self._types[place]) for place in places) and (table := self._floats(body, places)) is not None:
            arrays: list[NDArray[Any]] = [*table.T]
        elif texts := [*zip(*self._rows(body), strict=True)]:
            arrays = [self._array(place, texts[place]) for place in places]
        else:
            arrays = [np.zeros(0, DTYPES[self._types[place]]) for place in places]
        self._line += body.count(b"\n")
        return Columns(arrays[0], dict(zip(names, arrays[1:], strict=True)), self._units, self._metadata)

    def check_end(self, rest: bytes) -> None:
        """Check that what follows the last whole row is the beginning of a row; its writer was killed there."""
        if not _BEGUN.fullmatch(rest):
            raise self._refused(self._line, "a quotation mark in the wrong place")

    def _floats(self, body: bytes, places: Sequence[int]) -> NDArray[np.float64] | None:
        """All rows of columns with nothing but floats, fast; None where they have something else, or no rows."""
        if not body.strip():
            return None
        some = None if isinstance(places, range) else places
        try:
            table: NDArray[np.float64] = np.loadtxt(
                io.BytesIO(body), delimiter=",", comments=None, ndmin=2, usecols=some
            )
        except ValueError:
            return None
        # `loadtxt` passes over empty lines.
        return table if table.shape == (body.count(b"\n"), len(places)) else None

    def _rows(self, body: bytes) -> Iterator[list[bytes]]:
        """The fields of every row; a text keeps its quotation marks."""
        waiting, first = b"", self._line
        for number, line in enumerate(body.split(b"\n")[:-1], self._line):
            waiting = waiting + b"\n" + line if waiting else line
            if waiting.count(b'"') % 2:  # a text with line ends in it
                continue
            row = waiting.removesuffix(b"\r")
            fields = row.split(b",") if b'"' not in row else _FIELD.findall(row)
            if b",".join(fields) != row:
                raise self._refused(first, "a quotation mark in the wrong place")
            if len(fields) != 1 + len(self.names):
                raise self._refused(first, f"{len(fields)} values where the heading has {1 + len(self.names)}")
            yield fields
            waiting, first = b"", number + 1

    def _array(self, place: int, texts: Sequence[bytes]) -> NDArray[Any]:
        """The values of a column; the first one is `time`."""
        type_ = self._types[place]
        if type_ == "Int64" and self.names[place - 1] not in self._known and not all(map(_is_whole, texts)):
            type_ = self._types[place] = "Float64"  # another program may write 0 for 0.0
        read = _READERS.get(type_, float if is_float(type_) else int)
        values: list[Any] = []
        text = b""
        try:
            for text in texts:
                values.append(read(text))
            return np.array(values, dtype=DTYPES[type_])
        except (ValueError, KeyError, OverflowError) as error:
            what = f"{text.decode(errors='replace')!r} is no value of type {type_}"
            raise self._refused(self._line + len(values), what) from error

    def _refused(self, line: int, what: str) -> ConfigurationError:
        return ConfigurationError(f"'{self._path}' is no result file: line {line}: {what}.")


def _end_of_rows(body: bytes) -> int:
    """The end of the last whole row; a text may contain line ends."""
    end = body.rfind(b"\n") + 1
    quotes = body.count(b'"', 0, end)
    while quotes % 2:
        start = body.rfind(b"\n", 0, end - 1) + 1
        quotes -= body.count(b'"', start, end)
        end = start
    return end


def _type_of(text: bytes) -> VariableType:
    """The type of a column whose first value is ``text``: a float always has a point, an exponent or letters."""
    if text in (b"true", b"false"):
        return "Boolean"
    if text.startswith(b'"'):
        return "String"
    return "Int64" if _is_whole(text) else "Float64"


def _is_whole(text: bytes) -> bool:
    """Whether a text is a whole number; with a sign, 0 is a float."""
    return text.removeprefix(b"-").isdigit() and text != b"-0" and -(1 << 63) <= int(text) < 1 << 63
