"""Reads the columns of a result file, whose last row may be cut off where a run was killed."""

from __future__ import annotations

import base64
import csv
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from io import BytesIO
from pathlib import Path
from typing import Any, Final, cast

import numpy as np
from numpy.typing import NDArray

from ..errors import ConfigurationError
from ..recorder.csv_file import CsvFile
from ..recorder.notes_file import read_notes
from ..system.recording import Columns, ReadableFormat, result_format
from ..text import listed, matching, nearest, nearest_file
from ..variables.value_types import DTYPES, VariableType, is_float

__all__ = ["Columns", "chosen_names", "read_csv", "read_result", "require_readable"]

_TIME = "time"
_FLAGS: Final = {"true": True, "false": False}
_FIELD = re.compile(rb'"((?:[^"]|"")*)"|([^,]*)')


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
    """Read a result file of any format.

    Args:
        path: the file.
        types: the types of the columns, by name, if they are known.

    Raises:
        ConfigurationError: there is no such file, or it is no result file.
    """
    require_readable(path)
    format_ = result_format(path)
    if format_ in (CsvFile, None):
        return read_csv(path, types)
    try:
        return cast("ReadableFormat", format_).read(path)
    except OSError as error:
        raise _unreadable(path, error) from error


def read_csv(path: Path, types: Mapping[str, VariableType] | None = None) -> Columns:
    """Read a CSV of results.

    Args:
        path: the file.
        types: the types of the columns, by name. Without them, the first row tells truth values, whole numbers, floats
            and texts apart.

    Raises:
        ConfigurationError: there is no such file, or it is no result file; says in which line.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise _unreadable(path, error) from error
    heading, _, body = data.partition(b"\n")
    try:
        body.decode()
        names = next(csv.reader([heading.decode()]), [])
    except (UnicodeDecodeError, csv.Error) as error:
        raise ConfigurationError(f"'{path}' is no result file: {error}.") from error
    if not names or names[0] != _TIME:
        found = f"its first column is '{names[0][:40]}'" if names else "it is empty"
        raise ConfigurationError(f"'{path}' is no result file: {found}, not '{_TIME}'.")
    metadata = read_notes(path)
    about = {name: known for name, known in metadata.get("variables", {}).items() if name in names}
    known = {name: of["type"] for name, of in about.items()} | dict(types or {})
    units = {name: of["unit"] for name, of in about.items() if of.get("unit") is not None}
    return _columns(path, names, body, known)._replace(units=units, metadata=metadata)


def _unreadable(path: Path, error: OSError) -> ConfigurationError:
    near = nearest_file(path) if isinstance(error, FileNotFoundError) else None
    hint = f"Did you mean '{near}'?" if near is not None else None
    return ConfigurationError(f"the result file '{path}' cannot be read: {error.strerror}.", hint=hint)


def _columns(path: Path, names: Sequence[str], body: bytes, types: Mapping[str, VariableType]) -> Columns:
    first = _fields(body.partition(b"\n")[0])
    of_columns = [types.get(name, _type_of(text)) for name, text in zip(names[1:], first[1:], strict=False)]
    if all(map(is_float, of_columns)) and (table := _table_of_floats(names, body)) is not None:
        return Columns(table[:, 0], dict(zip(names[1:], table.T[1:], strict=True)))
    rows = list(_rows(path, names, body))
    texts = list(zip(*rows, strict=True)) if rows else [()] * len(names)
    columns = {}
    for name, type_, values in zip(names[1:], of_columns or ["Float64"] * (len(names) - 1), texts[1:], strict=True):
        # Another program may write 0 for 0.0.
        guessed_wrong = name not in types and type_ == "Int64" and not all(map(_is_whole, values))
        columns[name] = _array(path, "Float64" if guessed_wrong else type_, values)
    return Columns(_array(path, "Float64", texts[0]), columns)


def _table_of_floats(names: Sequence[str], body: bytes) -> NDArray[np.float64] | None:
    """All rows of a file with nothing but floats, fast; None where the file has something else, or no rows."""
    whole = body[: body.rfind(b"\n") + 1]
    if not whole.strip():
        return None
    try:
        table: NDArray[np.float64] = np.loadtxt(BytesIO(whole), delimiter=",", comments=None, ndmin=2)
    except ValueError:
        return None
    # `loadtxt` passes over empty lines.
    return table if table.shape == (whole.count(b"\n"), len(names)) else None


def _rows(path: Path, names: Sequence[str], body: bytes) -> Iterable[list[bytes]]:
    """The fields of every whole row; a text keeps its quotation marks."""
    waiting, first = b"", 2
    for number, line in enumerate(body.split(b"\n")[:-1], 2):
        waiting = waiting + b"\n" + line if waiting else line
        if waiting.count(b'"') % 2:  # a text with line ends in it
            continue
        fields = waiting.split(b",") if b'"' not in waiting else _fields(waiting)
        if len(fields) != len(names):
            found = f"{len(fields)} values where the heading has {len(names)}"
            raise ConfigurationError(f"'{path}' is no result file: line {first}: {found}.")
        yield fields
        waiting, first = b"", number + 1


def _fields(line: bytes) -> list[bytes]:
    fields, at = [], 0
    while at <= len(line):
        match = _FIELD.match(line, at)
        assert match is not None  # the second alternative matches anything
        fields.append(match.group())
        at = match.end() + 1
    return fields


def _type_of(text: bytes) -> VariableType:
    """The type of a column whose first value is ``text``: a float always has a point, an exponent or letters."""
    if text in (b"true", b"false"):
        return "Boolean"
    if text.startswith(b'"'):
        return "String"
    return "Int64" if _is_whole(text) else "Float64"


def _is_whole(text: bytes) -> bool:
    return text.removeprefix(b"-").isdigit()


def _array(path: Path, type_: VariableType, texts: Sequence[bytes]) -> NDArray[Any]:
    read = _READERS.get(type_, float if is_float(type_) else int)
    values: list[Any] = []
    text = b""
    try:
        for text in texts:
            values.append(read(text))
        return np.array(values, dtype=DTYPES[type_])
    except (ValueError, KeyError, OverflowError) as error:
        what = f"{text.decode(errors='replace')!r} is no value of type {type_}"
        raise ConfigurationError(f"'{path}' is no result file: line {len(values) + 2}: {what}.") from error


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
    for one, and `re:` begins a regular expression.

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
        found.update(dict.fromkeys(own))
        unknown += [text] if not own else []
    if unknown:
        meant = [name for text in unknown for name in _meant(text, names)]
        hint = f"Did you mean {_either(meant)}?" if meant else f"There are: {listed(names)}."
        raise ConfigurationError(f"'{path}' has no variable {_either(unknown)}.", hint=hint)
    return [*found] or names


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
