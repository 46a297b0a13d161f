"""Result formats: found by the ending of a file's name, checked with the plan of a run, read, followed and recovered.

Knows no format but by its contract (`fmu_mesh.results.recording`).
"""

from __future__ import annotations

import warnings as python_warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, cast

from ..config.call_options import checked
from ..config.findings import Findings
from ..config.loading import LoadedConfig
from ..errors import ConfigurationError, FmuMeshError
from ..files import Kept, is_file, open_alone
from ..plugins import plugin, plugin_names
from ..system.records import IN_MEMORY, RecordPlan, record_paths
from ..text import meant, nearest_file, printable
from ..variables.model_description import ModelDescription
from ..variables.value_types import VariableType
from .recording import Columns, Recording, ResultFormat, Tail, joined

__all__ = [
    "check_record",
    "followed",
    "goes_on",
    "near_hint",
    "read_result",
    "reading",
    "recover",
    "require_readable",
    "required_format",
    "result_endings",
    "result_format",
    "result_pieces",
    "warn_of_endings",
]

_GROUP = "fmu_mesh.recorders"
_DEFAULT = "csv"

_PLAIN = ("", "txt")
"""Endings that ask for no format in particular; a number, as in `result.2`, does not either."""

_OTHER_FORMATS = frozenset(
    ("arrow", "bag", "db3", "feather", "h5", "hdf5", "json", "mat", "npz", "ods", "parquet", "xls", "xlsx")
)
"""Endings of known formats that nobody may have installed. The programs for them could not open a CSV."""


def result_format(path: str | Path) -> ResultFormat | None:
    """The format of a result file of this name, or None if its ending is that of a format that no package writes.

    A name without an ending is that of a CSV, and so is one with any other ending (see `warn_of_endings`).

    Raises:
        ConfigurationError: two packages write this format, or the package cannot be imported.
    """
    ending = _ending(path)
    found = plugin(_GROUP, ending)
    if found is None and ending not in _OTHER_FORMATS:
        found = plugin(_GROUP, _DEFAULT)
    return cast("ResultFormat | None", found)


def required_format(path: str | Path) -> ResultFormat:
    """As `result_format`.

    Raises:
        ConfigurationError: also if no package writes this format.
    """
    if (found := result_format(path)) is None:
        raise ConfigurationError(f"no installed package writes the format of '{path}'.")
    return found


def goes_on(path: str | Path) -> bool:
    """Whether a file of this format can be continued by a run that starts again; see `Resumable`.

    The errors are those of `required_format`.
    """
    return hasattr(required_format(path), "resume")


def result_endings() -> list[str]:
    """The endings that result files can have, such as `.csv`, ours first."""
    return [ending for name in plugin_names(_GROUP) if (ending := f".{name}") != IN_MEMORY]


def check_record(
    loaded: LoadedConfig,
    record: RecordPlan,
    place: str,
    descriptions: Mapping[str, ModelDescription],
    findings: Findings,
) -> None:
    """Add findings if no file of this name can be written, or it cannot hold what is recorded.

    ``place`` is the path of its section, `record` or `record[1]`.
    """
    try:
        if (format_ := result_format(record.file)) is None:
            found = f"'{loaded.config.records[place].file}', a format that is not written"
            findings.add(f"{place}.file", found, f"a name ending in {' or '.join(result_endings())}")
        else:
            recording = Recording(loaded, descriptions, record.variables, place, record.first, record.every)
            format_.check(recording, findings)
    except ConfigurationError as error:  # a package is missing
        findings.add(f"{place}.file", str(error), "")


def warn_of_endings(loaded: LoadedConfig, records: Sequence[RecordPlan], warnings: Findings) -> None:
    """Warn of files with an ending that no installed package offers: they still give a CSV."""
    files = {record.file for record in records}
    for place, path in record_paths(loaded).items():
        if str(path) in files and plugin(_GROUP, _ending(path)) is None:
            name = loaded.config.records[place].file
            found = f"'{name}', an ending of no installed format, so the file becomes a CSV"
            endings = " or ".join(result_endings())
            warnings.add(f"{place}.file", found, f"a name ending in {endings}; from version 0.4 on this is an error")


def require_readable(path: Path) -> ResultFormat:
    """The format of a file whose results can be read; a CSV where no package writes files with its ending.

    Raises:
        ConfigurationError: they can only be written.
    """
    format_ = result_format(path) or cast("ResultFormat", plugin(_GROUP, _DEFAULT))
    if not (hasattr(format_, "pieces") or hasattr(format_, "read")):
        hint = "Record into a .csv or .parquet file."
        raise ConfigurationError(f"results cannot be read from '{path}': its format can only be written.", hint=hint)
    return format_


def read_result(path: Path, types: Mapping[str, VariableType] | None = None) -> Columns:
    """Read a result file of any format; the arguments and errors are those of `result_pieces`."""
    return joined(result_pieces(path, types))


def result_pieces(path: Path, types: Mapping[str, VariableType] | None = None) -> Iterator[Columns]:
    """The rows of a result file of any format, piece by piece; there is at least one piece.

    Args:
        path: the file.
        types: the types of the columns by name, for formats whose files may not say them (see `CsvFile.pieces`).

    Raises:
        ConfigurationError: there is no such file, or it is no result file; of a CSV it says in which line.
    """
    format_: Any = require_readable(path)
    with reading(path):
        if hasattr(format_, "read"):  # the contract until version 0.2
            text = f"`read(path)` of {format_} becomes pieces(path, types); see docs/upgrading.md"
            python_warnings.warn(text, DeprecationWarning, stacklevel=2)
            yield format_.read(path)
        else:
            yield from format_.pieces(path, types or {})


def followed(path: Path) -> Tail | None:
    """Open a result file that may still grow; None if there is none, or none that this process can follow."""
    with suppress(FmuMeshError), reading(path):
        if hasattr(format_ := result_format(path), "follow"):
            return cast("ResultFormat", format_).follow(path)
    return None


@checked
def recover(path: str | Path) -> int:
    """Finish the result file of a run that was killed, and return the number of its rows, which are all whole.

    A CSV is cut off after its last whole row. A Parquet file is made of the stream beside it (`<file>.arrows`). An MCAP
    is cut off after its last whole row and gets its index. A file that is complete stays as it is.

    `launch` does this itself if only its master was killed; `recover` is for a computer or a container that went down.

    Example:
        >>> import fmu_mesh
        >>> mesh = fmu_mesh.load("configs/pendulum_delay.yaml")
        >>> result = mesh.run(stop_time=0.1, output="results/short.csv")
        >>> fmu_mesh.recover("results/short.csv")
        51

    Args:
        path: the result file, under the name that the run was given.

    Raises:
        ConfigurationError: there is no such file, a run is still writing it, it is no result file, or it cannot be
            written.
    """
    path = Path(path)
    format_ = required_format(path)
    growing = format_.growing_file(path)
    with reading(path):
        try:
            if is_file(growing):
                with open_alone(growing, path):
                    return format_.keep_whole_rows(path, Kept())
            if not is_file(path):
                raise ConfigurationError(f"the result file '{path}' does not exist.", hint=near_hint(path))
            return format_.keep_whole_rows(path, Kept())
        except OSError as error:
            text = f"the result file '{path}' cannot be recovered: {error.strerror or error}."
            raise ConfigurationError(text) from error


@contextmanager
def reading(path: Path, what: str = "result file") -> Iterator[None]:
    """In the block a result file, or another kind of file, is read. Whatever is wrong with it is one error.

    Raises:
        ConfigurationError: it cannot be read, or it is none.
    """
    try:
        yield
    except FmuMeshError:
        raise
    except OSError as error:
        hint = near_hint(path) if isinstance(error, FileNotFoundError) else None
        text = f"the {what} '{path}' cannot be read: {error.strerror or error}.".replace("..", ".")
        raise ConfigurationError(text, hint=hint) from error
    except Exception as error:  # each library of a format has errors of its own for damaged bytes
        text = f"'{path}' is no {what}: {printable(str(error)) or type(error).__name__}."
        raise ConfigurationError(text.replace("..", ".")) from error


def near_hint(path: Path) -> str | None:
    """The nearest file as a question, for an error about one that is not there."""
    return meant(nearest_file(path))


def _ending(path: str | Path) -> str:
    ending = Path(path).suffix.removeprefix(".").lower()
    return _DEFAULT if ending in _PLAIN or ending.isdecimal() else ending
