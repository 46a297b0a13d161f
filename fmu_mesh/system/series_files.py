"""Tables with values over time: the columns of a CSV or Parquet file, read once per process.

Owns what a table may look like, and how a schedule gets its values from there. What a scenario may say is
`fmu_mesh.system.scenario`.
"""

from __future__ import annotations

import csv
import hashlib
import math
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from functools import lru_cache
from io import TextIOWrapper
from pathlib import Path
from typing import Any

import msgspec

from ..errors import ConfigurationError
from ..files import opened
from ..simtime import TimeGrid
from ..text import listed, nearest
from ..variables.model_description import ModelDescription, Value, Variable
from ..variables.value_conversion import ValueRefused, to_value
from ..variables.value_types import INTEGERS, is_float
from .arrow import open_parquet, parquet_batches, places_of, values_at
from .schedule import Course, Schedule, SeriesFile

__all__ = ["SeriesRefused", "columns_of", "content_of", "course_of", "courses_of", "read_series"]

_PARQUET = ".parquet"
_DELIMITERS = ",;\t"
_TRUTH = {"true": True, "1": True, "1.0": True, "false": False, "0": False, "0.0": False}


class SeriesRefused(ValueError):
    """A table that cannot be used: what was found and expected, and the key of the scenario that it is about."""

    def __init__(self, found: str, expected: str, key: str = "file", suggestion: str | None = None) -> None:
        super().__init__(found)
        self.expected = expected
        self.key = key
        self.suggestion = suggestion


class Series(msgspec.Struct, frozen=True):
    """A column of a table: times in s, in ascending order, and what stands beside them."""

    times: tuple[float, ...]
    cells: tuple[Any, ...]


def content_of(path: Path) -> str:
    """The SHA-256 of a file.

    Raises:
        SeriesRefused: it cannot be read.
    """
    with _reading(path), opened(path) as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def columns_of(path: Path) -> list[str]:
    """The names of the columns of a table.

    Raises:
        SeriesRefused: it is no table.
    """
    with _reading(path), opened(path) as file:
        if path.suffix.lower() == _PARQUET:
            return [*places_of(open_parquet(file).schema_arrow)]
        return _header(file.readline().decode("utf-8-sig"), path)[0]


def course_of(schedule: Schedule, variable: Variable, grid: TimeGrid, points: int) -> Course:
    """What the steps of an instance use for one variable; its table is read here.

    Raises:
        SeriesRefused: the table cannot be read.
        ConfigurationError: the table has changed since the run was planned.
    """
    pairs = list(zip(schedule.times, (to_value(value, variable) for value in schedule.values), strict=True))
    if schedule.file is not None:
        times, values = read_series(schedule.file, variable)
        pairs = sorted([*zip(times, values, strict=True), *pairs], key=lambda pair: pair[0])
    return Course(
        [time for time, _ in pairs],
        [value for _, value in pairs],
        grid,
        points,
        linear=schedule.linear,
        initial=schedule.initial,
        tolerance=schedule.tolerance,
        every=schedule.every,
    )


def courses_of(
    schedules: Iterable[Schedule], description: ModelDescription, grid: TimeGrid, points: int
) -> dict[str, Course]:
    """What the steps of an instance use, by variable; tables are read here.

    Raises:
        ConfigurationError: a table cannot be read, or has changed since the run was planned.
    """
    courses = {}
    for schedule in schedules:
        variable = description.variable(schedule.variable)
        assert variable is not None  # the plan is valid
        try:
            courses[variable.name] = course_of(schedule, variable, grid, points)
        except SeriesRefused as refused:
            raise ConfigurationError(
                f"values of '{variable.name}': {refused}; expected {refused.expected}"
            ) from refused
    return courses


def read_series(file: SeriesFile, variable: Variable) -> tuple[Sequence[float], list[Value]]:
    """The times in s and the values of one column; its cells are values of ``variable``.

    Raises:
        SeriesRefused: a cell is no time or no value of the variable; says the line.
        ConfigurationError: the file has changed since the run was planned.
    """
    series = _read(file.path, file.sha256, file.time, file.column)
    values = []
    for place, cell in enumerate(series.cells):
        try:
            values.append(_value(cell, file, variable))
        except ValueRefused as refused:
            where = f"{cell!r} in row {place + 1} of the column '{file.column}'"
            raise SeriesRefused(where, refused.expected or str(refused), "column") from refused
    return series.times, values


def _value(cell: Any, file: SeriesFile, variable: Variable) -> Value:  # noqa: ANN401  text or a number
    """A cell as a value of the variable, in its unit."""
    plain = cell
    if isinstance(cell, str):
        plain = _plain(cell.strip(), variable)
    elif isinstance(cell, float) and cell.is_integer() and not is_float(variable.type):
        plain = int(cell)
    if variable.type == "Boolean" and type(plain) is int and plain in (0, 1):
        plain = bool(plain)
    if (file.factor, file.offset) != (1.0, 0.0) and isinstance(plain, int | float):
        plain = file.factor * plain + file.offset
    return to_value(plain, variable)


def _plain(text: str, variable: Variable) -> object:
    """The text of a cell as a number or a truth value, as the type of the variable says; else the text itself."""
    if variable.type == "Boolean":
        return _TRUTH.get(text.lower(), text)
    if not is_float(variable.type) and variable.type not in INTEGERS:
        return text
    with suppress(ValueError):
        return int(text)
    try:
        number = float(text)
    except ValueError:
        return text
    return int(number) if variable.type in INTEGERS and number.is_integer() else number


@lru_cache(maxsize=256)
def _read(path: str, sha256: str, time: str, column: str) -> Series:
    place = Path(path)
    if content_of(place) != sha256:
        raise ConfigurationError(
            f"'{path}' has changed since the run was planned", hint="Start the run again with the file as it is now."
        )
    pairs = _parquet_pairs(place, time, column) if place.suffix.lower() == _PARQUET else _csv_pairs(place, time, column)
    times, cells, last = [], [], -math.inf
    for row, when, cell in pairs:
        try:
            moment = float(when)
        except (TypeError, ValueError):
            moment = math.nan
        if not math.isfinite(moment):
            raise SeriesRefused(f"{when!r} in {row} of the column '{time}'", "a time in s", "time")
        if moment < last:
            found = f"the time {moment:g} s in {row}, after {last:g} s"
            raise SeriesRefused(found, "times in ascending order", "time")
        last = moment
        times.append(moment)
        cells.append(cell)
    if not times:
        raise SeriesRefused(f"'{path}' without a row", "a table with values")
    return Series(tuple(times), tuple(cells))


def _csv_pairs(path: Path, time: str, column: str) -> Iterator[tuple[str, str, str]]:
    """(where, time, cell) of each row of a CSV."""
    with _reading(path), TextIOWrapper(opened(path), "utf-8-sig", newline="") as file:
        names, delimiter = _header(file.readline(), path)
        first, second = _place(names, time, "time", path), _place(names, column, "column", path)
        for number, row in enumerate(csv.reader(file, delimiter=delimiter), start=2):
            if not row:
                continue
            if len(row) <= max(first, second):
                raise SeriesRefused(f"{len(row)} cells in line {number} of '{path}'", f"{len(names)} cells")
            yield f"line {number}", row[first], row[second]


def _header(line: str, path: Path) -> tuple[list[str], str]:
    """The names of the columns, and what stands between them."""
    delimiter = max(_DELIMITERS, key=line.count)
    try:
        names = [name.strip() for name in next(csv.reader([line], delimiter=delimiter), [])]
    except csv.Error as error:
        raise SeriesRefused(f"'{path}', whose first line cannot be read ({error})", "a line with names") from error
    if not any(names):
        raise SeriesRefused(f"'{path}' without a first line", "a line with the names of the columns")
    return names, delimiter


def _parquet_pairs(path: Path, time: str, column: str) -> Iterator[tuple[str, Any, Any]]:
    """(where, time, cell) of each row of a Parquet file."""
    with _reading(path), opened(path) as file:
        table = open_parquet(file)
        places = places_of(table.schema_arrow)
        for name, key in ((time, "time"), (column, "column")):
            _place([*places], name, key, path)
        row, both = 0, [places[time], places[column]]
        for batch in parquet_batches(table, list(dict.fromkeys(field for field, _ in both))):
            for when, cell in zip(*(values_at(batch, place).to_pylist() for place in both), strict=True):
                row += 1
                yield f"row {row}", when, cell


@contextmanager
def _reading(path: Path) -> Iterator[None]:
    """In the block a table is read; whatever is wrong with it is refused."""
    try:
        yield
    except SeriesRefused:
        raise
    except Exception as error:  # each format has errors of its own for damaged bytes
        reason = (error.strerror if isinstance(error, OSError) else None) or error
        raise SeriesRefused(f"'{path}', which cannot be read ({reason})", "a table in UTF-8") from error


def _place(names: Sequence[str], name: str, key: str, path: Path) -> int:
    if name not in names:
        found = f"the unknown column '{name}' of '{path.name}'"
        raise SeriesRefused(found, f"one of {listed(list(names))}", key, nearest(name, names))
    return [*names].index(name)
