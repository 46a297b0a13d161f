"""Results as JSON lines: every row is an object, as `{"time": 0.002, "pendulum.a": 1.3}`."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from fmu_mesh.config.findings import Findings
from fmu_mesh.errors import ConfigurationError
from fmu_mesh.files import Kept, open_alone, opened
from fmu_mesh.results.recording import Columns, Recording
from fmu_mesh.results.tails import LineTail
from fmu_mesh.variables.value_types import DTYPES, VariableType

_BUFFER_BYTES = 1 << 16
_LINES = 10_000


class JsonLinesFile:
    """Writes each row of the results as one line of JSON.

    Args:
        path: the file.
        names: `instance.variable` of every column.
    """

    def __init__(self, path: Path, names: Sequence[str]) -> None:
        self.path = path
        self.rows = 0
        self.kept = Kept()
        self._names = ("time", *names)
        self._waiting = bytearray()
        self._file = open_alone(path)

    @classmethod
    def check(cls, recording: Recording, findings: Findings) -> None:
        """JSON has no place for bytes."""
        for name, type_ in recording.columns:
            if type_ == "Binary":
                findings.add("record.variables", f"'{name}', which is Binary", "types that JSON has, or a .csv file")

    @classmethod
    def open(cls, path: Path, recording: Recording) -> Self:
        """Open a file for what a run records."""
        return cls(path, [name for name, _ in recording.columns])

    @staticmethod
    def growing_file(path: Path) -> Path:
        """The file itself: its rows can be read while it grows."""
        return path

    @staticmethod
    def keep_whole_rows(path: Path, kept: Kept) -> int:
        """Every line is a row, and a row without its line end is not whole."""
        with path.open("r+b") as file:
            file.seek(kept.size)
            rest = file.read()
            file.truncate(kept.size + rest.rfind(b"\n") + 1)
        return kept.rows + rest.count(b"\n")

    @staticmethod
    def pieces(path: Path, types: Mapping[str, VariableType]) -> Iterator[Columns]:
        """Some thousands of rows at a time; the last line may be cut off where the run was killed, or goes on."""
        with opened(path) as file:
            names = _names(path, file.readline())
            file.seek(0)
            while lines := [line for _, line in zip(range(_LINES), file, strict=False)]:
                yield _columns(b"".join(lines[: -1 if not lines[-1].endswith(b"\n") else None]), names, types)

    @staticmethod
    def follow(path: Path) -> LineTail | None:
        """The page shows the rows while they are written."""
        file = opened(path)
        try:
            names = _names(path, file.readline())
            file.seek(0)
        except BaseException:
            file.close()
            raise
        return LineTail(path, file, names, _columns)

    def write(self, times: NDArray[np.float64], columns: Sequence[NDArray[Any]]) -> None:
        """Append one row per time."""
        for row in zip(times.tolist(), *(column.tolist() for column in columns), strict=True):
            self._waiting += json.dumps(dict(zip(self._names, row, strict=True))).encode() + b"\n"
            self.rows += 1
        if len(self._waiting) >= _BUFFER_BYTES:
            self.flush()

    def note(self, entry: Mapping[str, Any]) -> None:
        """Do nothing: the file has rows and nothing else."""

    def flush(self) -> None:
        """Give all rows to the operating system."""
        if not self._waiting:
            return
        try:
            while self._waiting:
                del self._waiting[: self._file.write(self._waiting)]
        except OSError:
            self._waiting.clear()  # nothing may follow a gap
            self.rows = self.keep_whole_rows(self.path, self.kept) if self.path.is_file() else self.kept.rows
            raise
        self.kept = Kept(self.rows, self._file.size)

    def close(self) -> None:
        """Write what is left and close the file."""
        try:
            self.flush()
        finally:
            self._file.close()


def _names(path: Path, line: bytes) -> list[str]:
    """The columns without the time, which are those of the first row."""
    time, *names = json.loads(line)
    if time != "time":
        raise ConfigurationError(f"'{path}' is no result file: its first value is '{time}', not 'time'.")
    return names


def _columns(data: bytes, names: Sequence[str], types: Mapping[str, VariableType] = {}) -> Columns:
    """Some columns of whole rows; without a type, numpy finds it."""
    rows = [json.loads(line) for line in data.splitlines()]
    values = {
        name: np.array([row[name] for row in rows], DTYPES[types[name]] if name in types else None) for name in names
    }
    texts = {name: array.astype(object) for name, array in values.items() if array.dtype.kind == "U"}
    return Columns(np.array([row["time"] for row in rows], np.float64), values | texts)
