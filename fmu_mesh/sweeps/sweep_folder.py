"""The folder of a sweep: what was asked, a line for each run that has ended, the curves, and the table.

```
sweep.json       what was asked: configuration, options, variants, columns
rows.jsonl       a line for each run, in the order in which they ended; a part of an array of jobs has a file of its own
table.csv        all rows in the order of the variants; written at the end
runs/<id>.csv    the curves of each run, as `launch` writes them
```

A line is written at once, and whole lines survive whatever ends the process. A run without a line is missing.
"""

from __future__ import annotations

import csv
import fcntl
import hashlib
import io
import json
import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any, Final

import msgspec

from ..errors import ConfigurationError
from ..files import decoded_json, is_file, replaced, write_whole
from .variant_run import Common, Row, path_of
from .variants import Parameters

__all__ = ["RowFile", "SweepFolder", "Wanted", "cells_of", "identity_of", "is_sweep"]

_WANTED: Final = "sweep.json"
_ROWS: Final = "rows"
_TABLE: Final = "table.csv"
_CURVES: Final = "runs"


class Wanted(Common, frozen=True, kw_only=True):
    """What was asked: `sweep.json`."""

    mesh: str
    names: tuple[str, ...]
    variants: tuple[tuple[Any, ...], ...]  # for each variant the values of the parameters, in this order
    recorded: tuple[str, ...] = ()
    # unit of each recorded variable and of each parameter; None without one
    units: dict[str, str | None] = msgspec.field(default_factory=dict)
    identities: tuple[str, ...] = ()  # the id of each variant
    curves: bool = True  # whether the curves of each run are kept
    # by the name of a model file, how many instances there may be at a time
    most_instances: dict[str, int] = msgspec.field(default_factory=dict)

    def parameters(self, number: int) -> Parameters:
        """The parameters of a variant."""
        return dict(zip(self.names, self.variants[number], strict=True))


class SweepFolder:
    """One folder, which may not exist yet; see above."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.table = path / _TABLE
        self.curves = path / _CURVES
        self.wanted_file = path / _WANTED

    def begin(self, wanted: Wanted) -> None:
        """Make the folder, and write down what is asked."""
        try:
            (self.curves if wanted.curves else self.path).mkdir(parents=True, exist_ok=True)
            with replaced(self.wanted_file) as draft:
                draft.write_bytes(msgspec.json.format(msgspec.json.encode(wanted, enc_hook=str)))
        except OSError as error:
            raise self._unwritable(error) from error

    def clear(self) -> None:
        """Remove what a sweep has written, and nothing else."""
        rows = [*self.path.glob(f"{_ROWS}*.jsonl")]
        for file in rows:
            RowFile(file).close()
        slurm = [self.path / "sweep.sbatch", self.path / "slurm.json", *self.path.glob("slurm-[0-9]*.log")]
        try:
            for file in (*rows, *self.curves.glob(f"{16 * '[0-9a-f]'}.csv*"), *slurm, self.table, self.wanted_file):
                file.unlink(missing_ok=True)
        except OSError as error:
            raise self._unwritable(error) from error

    def wanted(self) -> Wanted:
        """What was asked.

        Raises:
            ConfigurationError: there is no sweep in this folder, or another version has written it.
        """
        file = self.wanted_file
        try:
            return decoded_json(file.read_bytes(), Wanted, path_of)
        except OSError as error:
            text = f"there is no sweep in '{self.path}': '{file}' cannot be read ({error.strerror})"
            raise ConfigurationError(text) from error
        except ValueError as error:
            raise ConfigurationError(f"'{file}' is not what this version of fmu_mesh writes: {error}") from error

    def rows(self) -> dict[str, Row]:
        """The rows of all runs that have ended, by their id; of several the last one."""
        rows: dict[str, Row] = {}
        for file in sorted(self.path.glob(f"{_ROWS}*.jsonl")):
            rows |= {row.id: row for row in _lines(file)}
        return rows

    def writing(self, part: int | None = None) -> closing[RowFile]:
        """For a block in which rows can be added; one process at a time may do so for each part."""
        try:
            self.path.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise self._unwritable(error) from error
        name = _ROWS if part is None else f"{_ROWS}-{part}"
        return closing(RowFile(self.path / f"{name}.jsonl"))

    def _unwritable(self, error: OSError) -> ConfigurationError:
        return ConfigurationError(f"the folder '{self.path}' cannot be written: {error.strerror}")

    def write_table(self, wanted: Wanted, rows: Sequence[Row | None], columns: Sequence[str]) -> None:
        """Write the table; a variant without a row is left out."""
        text = io.StringIO()
        writer = csv.writer(text, lineterminator="\n")
        writer.writerow(["variant", *wanted.names, "exit_code", "message", *columns, "id", "seconds", "worker"])
        for number, row in enumerate(rows):
            if row is not None:
                cells = cells_of(wanted, number, row, columns) | {"seconds": f"{row.seconds:.4f}"}
                # All others, `csv` writes as we do: a float with the digits that give the same bits again.
                writer.writerow([json.dumps(own) if isinstance(own, bool | list) else own for own in cells.values()])
        write_whole(self.table, text.getvalue(), "the table ")


class RowFile:
    """A file to which rows are added."""

    def __init__(self, path: Path) -> None:
        self._path = path
        try:
            self._descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_APPEND | os.O_CLOEXEC, 0o666)
        except OSError as error:
            raise self._unwritable(error) from error
        try:
            fcntl.flock(self._descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            self.close()
            hint = "Wait for its end, or choose another folder."
            raise ConfigurationError(f"another sweep is writing into '{path.parent}'", hint=hint) from error
        except OSError:
            pass  # the file system has no locks: some that clusters share have none
        size = os.fstat(self._descriptor).st_size
        if size and os.pread(self._descriptor, 1, size - 1) != b"\n":  # its process was killed within a line
            self._write(b"\n")

    def add(self, rows: Sequence[Row]) -> None:
        """Add rows."""
        self._write("".join(f"{json.dumps(msgspec.to_builtins(row))}\n" for row in rows).encode())

    def close(self) -> None:
        """Close the file."""
        os.close(self._descriptor)

    def _write(self, line: bytes) -> None:
        try:
            while line:
                line = line[os.write(self._descriptor, line) :]
        except OSError as error:
            raise self._unwritable(error) from error

    def _unwritable(self, error: OSError) -> ConfigurationError:
        hint = "All rows before are kept: `resume=True` runs what is missing."
        return ConfigurationError(f"'{self._path}' cannot be written: {error.strerror}", hint=hint)


def cells_of(wanted: Wanted, number: int, row: Row, columns: Sequence[str]) -> dict[str, Any]:
    """A row of the table, by the names of its columns."""
    return {
        "variant": number,
        **wanted.parameters(number),
        "exit_code": row.exit_code,
        "message": row.message,
        **{name: row.values.get(name) for name in columns},
        "id": row.id,
        "seconds": row.seconds,
        "worker": row.worker,
    }


def is_sweep(path: Path) -> bool:
    """Whether a path is the folder of a sweep."""
    return is_file(path / _WANTED)


def identity_of(wanted: Wanted, parameters: Parameters, contents: Mapping[str, str]) -> str:
    """The id of a variant: the same configuration, options, parameters and SHA-256 of models have the same one."""
    options = {name: value for name, value in wanted.options.items() if name != "allow_code"}  # not what is calculated
    asked = [wanted.data, options, sorted(parameters.items()), sorted(contents.items())]
    return hashlib.sha256(msgspec.json.encode(asked, enc_hook=str)).hexdigest()[:16]


def _lines(file: Path) -> Iterator[Row]:
    """The rows of a file; a line that is no row is one within which its process was killed."""
    for line in file.read_bytes().splitlines():
        try:
            yield msgspec.convert(json.loads(line), Row)
        except (ValueError, msgspec.MsgspecError, RecursionError):
            continue
