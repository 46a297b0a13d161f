"""Reads a result file, all of it or in pieces; its last row may be cut off where a run was killed."""

from __future__ import annotations

import base64
import csv
import re
from codecs import BOM_UTF8
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from io import BytesIO
from pathlib import Path
from typing import Any, Final, cast

import numpy as np
from numpy.typing import NDArray

from ..errors import ConfigurationError
from ..files import opened
from .csv_file import CsvFile
from .notes_file import read_notes
from .recording import Columns, PiecewiseFormat, ReadableFormat, joined, reading, result_format
from ..text import listed, matching, nearest
from ..variables.value_types import DTYPES, VariableType, is_float

__all__ = ["Columns", "chosen_names", "of_one_instance", "read_result", "require_readable", "result_pieces"]

_TIME = "time"
_FLAGS: Final = {"true": True, "false": False}
_FIELD = re.compile(rb'(?:(?<=,)|(?<!.))("[^"]*(?:""[^"]*)*"|[^,"]*)(?=,|\Z)', re.DOTALL)
_BEGUN = re.compile(rb'(?:(?:"[^"]*(?:""[^"]*)*"|[^,"]*),)*(?:"[^"]*(?:""[^"]*)*"?|[^,"]*)')
_PIECE_BYTES: Final = 1 << 22


def require_readable(path: Path) -> None:
    """Check that results can be read from a file of this name.

    Raises:
        ConfigurationError: they cannot.
    """
    format_ = result_format(path)
    if format_ not in (CsvFile, None) and not hasattr(format_, "read"):
        hint = "Record into a .csv or .parquet file."
        raise ConfigurationError(f"results cannot be read from '{path}': its format can only be written.", hint=hint)


def read_result(path: Path, types: Mapping[str, VariableType] | None = None) -> Columns:
    """Read a result file of any format; the arguments and errors are those of `result_pieces`."""
    return joined(result_pieces(path, types))


def result_pieces(path: Path, types: Mapping[str, VariableType] | None = None) -> Iterator[Columns]:
    """The rows of a result file of any format, piece by piece; there is at least one piece.

    Args:
        path: the file.
        types: the types of the columns of a CSV, by name. Without them, the first row tells truth values, whole
            numbers, floats and texts apart; a column with a number that is not whole is one of floats from there on.

    Raises:
        ConfigurationError: there is no such file, or it is no result file; of a CSV it says in which line.
    """
    require_readable(path)
    format_ = result_format(path)
    with reading(path):
        if format_ in (CsvFile, None):
            yield from _csv_pieces(path, types or {})
        elif isinstance(format_, PiecewiseFormat):
            yield from format_.pieces(path)
        else:
            yield cast("ReadableFormat", format_).read(path)


def _csv_pieces(path: Path, types: Mapping[str, VariableType]) -> Iterator[Columns]:
    with opened(path) as file:
        heading = file.readline().removeprefix(BOM_UTF8)  # Excel writes one
        while heading.count(b'"') % 2 and len(heading) < _PIECE_BYTES and (more := file.readline(_PIECE_BYTES)):
            heading += more  # a name may contain line ends
        names = next(csv.reader([heading.decode()], strict=True), [])
        if not names or names[0] != _TIME:
            found = f"its first column is '{names[0][:40]}'" if names else "it is empty"
            raise ConfigurationError(f"'{path}' is no result file: {found}, not '{_TIME}'.")
        metadata = read_notes(path)
        about = {name: known for name, known in metadata.get("variables", {}).items() if name in names}
        units = {name: of["unit"] for name, of in about.items() if of.get("unit") is not None}
        known = {name: of["type"] for name, of in about.items()} | dict(types)
        table = _CsvTable(path, names, known, 1 + heading.count(b"\n"))
        data, body = file.read(_PIECE_BYTES), b""
        while True:
            body += data
            end = _end_of_rows(body)
            if end or not data:
                yield table.columns(body[:end])._replace(units=units, metadata=metadata)
                body = body[end:]
            if not data:
                table.check_end(body)
                return
            data = file.read(_PIECE_BYTES)


def _end_of_rows(body: bytes) -> int:
    """The end of the last whole row; a text may contain line ends."""
    end = body.rfind(b"\n") + 1
    quotes = body.count(b'"', 0, end)
    while quotes % 2:
        start = body.rfind(b"\n", 0, end - 1) + 1
        quotes -= body.count(b'"', start, end)
        end = start
    return end


class _CsvTable:
    """Turns the rows of a CSV into columns, piece by piece.

    Args:
        path: the file, for errors.
        names: its columns.
        types: their types by name, as far as they are known.
        line: the line of the first row, for errors.
    """

    def __init__(self, path: Path, names: Sequence[str], types: Mapping[str, VariableType], line: int) -> None:
        self._path, self._names, self._known = path, names, types
        self._types: list[VariableType] = []
        self._line = line

    def columns(self, body: bytes) -> Columns:
        """The columns of whole rows, which follow those of the last call."""
        body.decode()  # not every number would tell a byte that is no text
        if not self._types:
            first = next(self._rows(body), [b"0.0"] * len(self._names))
            of_columns = zip(self._names[1:], first[1:], strict=True)
            self._types = [self._known.get(name, _type_of(text)) for name, text in of_columns]
        if all(map(is_float, self._types)) and (table := self._floats(body)) is not None:
            arrays: list[NDArray[Any]] = [*table.T]
        else:
            rows = list(self._rows(body))
            arrays = [self._array(*column) for column in enumerate(zip(*rows, strict=True))]
            arrays = arrays or [np.zeros(0, DTYPES[type_]) for type_ in ("Float64", *self._types)]
        self._line += body.count(b"\n")
        return Columns(arrays[0], dict(zip(self._names[1:], arrays[1:], strict=True)))

    def check_end(self, rest: bytes) -> None:
        """Check that what follows the last whole row is the beginning of a row; its writer was killed there."""
        if not _BEGUN.fullmatch(rest):
            raise self._refused(self._line, "a quotation mark in the wrong place")

    def _floats(self, body: bytes) -> NDArray[np.float64] | None:
        """All rows of a table with nothing but floats, fast; None where it has something else, or no rows."""
        if not body.strip():
            return None
        try:
            table: NDArray[np.float64] = np.loadtxt(BytesIO(body), delimiter=",", comments=None, ndmin=2)
        except ValueError:
            return None
        # `loadtxt` passes over empty lines.
        return table if table.shape == (body.count(b"\n"), len(self._names)) else None

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
            if len(fields) != len(self._names):
                raise self._refused(first, f"{len(fields)} values where the heading has {len(self._names)}")
            yield fields
            waiting, first = b"", number + 1

    def _array(self, place: int, texts: Sequence[bytes]) -> NDArray[Any]:
        """The values of a column."""
        type_ = self._types[place - 1] if place else "Float64"
        if type_ == "Int64" and self._names[place] not in self._known and not all(map(_is_whole, texts)):
            type_ = self._types[place - 1] = "Float64"  # another program may write 0 for 0.0
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


def _text(field: bytes) -> str:
    return field[1:-1].decode().replace('""', '"')


_READERS: dict[VariableType, Callable[[bytes], object]] = {
    "Boolean": lambda field: _FLAGS[field.decode()],
    "String": _text,
    "Binary": base64.b64decode,
}


def chosen_names(path: Path | str, names: Sequence[str], wanted: Sequence[str]) -> Sequence[str]:
    """The wanted variables of a result; all of them if none is named.

    A name may be that of an array, which means all of its elements, or a pattern: `*` stands for any characters, `?`
    for one, and `re:` begins a regular expression. In a result of one instance, it may lack the name of the instance.

    Example:
        >>> chosen_names("demo.csv", ["arm.a", "arm.v", "motor.i[1]", "motor.i[2]"], ["motor.i", "arm.?"])
        ['motor.i[1]', 'motor.i[2]', 'arm.a', 'arm.v']

    Raises:
        ConfigurationError: one is not there; with the nearest name. Or a regular expression is none.
    """
    found: dict[str, None] = {}
    unknown = []
    for text in wanted:
        own = matching(text, names) or _elements(text, names)
        if not own and (instance := of_one_instance(names)):
            own = matching(f"{instance}.{text}", names) or _elements(f"{instance}.{text}", names)
        found.update(dict.fromkeys(own))
        unknown += [text] if not own else []
    if unknown:
        meant = [name for text in unknown for name in _meant(text, names)]
        hint = f"Did you mean {_either(meant)}?" if meant else f"There are: {listed(names)}."
        raise ConfigurationError(f"'{path}' has no variable {_either(unknown)}.", hint=hint)
    return [*found] or names


def of_one_instance(names: Iterable[str]) -> str | None:
    """The instance that all columns are of; None if there are several."""
    instances = {name.partition(".")[0] for name in names}
    return min(instances) if len(instances) == 1 else None


def _elements(array: str, names: Sequence[str]) -> list[str]:
    """The columns of the elements of an array."""
    matches = re.compile(re.escape(array) + r"\[[0-9]+(,[0-9]+)*\]").fullmatch
    return [name for name in names if matches(name)]


def _meant(text: str, names: Sequence[str]) -> list[str]:
    """The columns that somebody may have meant: those of variables with this name, or else the nearest name."""
    alike = [name for name in names if name.partition(".")[2] == text]
    near = nearest(text, names) or nearest(text, {name.partition(".")[2]: name for name in names})
    if alike or near is None:
        return alike
    return [near] if near in names else [name for name in names if name.partition(".")[2] == near]


def _either(names: Sequence[str]) -> str:
    return " or ".join(filter(None, [listed([repr(name) for name in names[:-1]], nothing=""), repr(names[-1])]))
