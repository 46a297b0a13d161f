"""What a run records, the contract of what writes it into a file, and how that is found.

A package offers a result format through the entry points `fmu_mesh.recorders`, under the ending of its files without
the dot. CSV, Parquet and MCAP are found in the same way. `docs/extending.md` shows how to write one.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple, Protocol, cast, runtime_checkable

import msgspec
import numpy as np
from numpy.typing import NDArray

from fmu_mesh.config.findings import Findings
from fmu_mesh.config.loading import LoadedConfig
from fmu_mesh.errors import ConfigurationError, FmuMeshError
from fmu_mesh.files import Kept, decoded_json
from fmu_mesh.plugins import plugin, plugin_names
from fmu_mesh.text import nearest_file, printable
from fmu_mesh.variables.model_description import ModelDescription
from fmu_mesh.variables.value_types import VariableType

__all__ = [
    "Columns",
    "PiecewiseFormat",
    "ReadableFormat",
    "Recording",
    "ResultFile",
    "ResultFormat",
    "has_unknown_ending",
    "is_in_memory",
    "joined",
    "metadata_in",
    "reading",
    "result_endings",
    "result_format",
    "with_notes",
]

_GROUP = "fmu_mesh.recorders"
_DEFAULT = "csv"
_IN_MEMORY = "arrays"
"""What the library keeps in memory; no file that anybody names."""

_PLAIN = ("", "txt")
"""Endings that ask for no format in particular; a number, as in `result.2`, does not either."""

_OTHER_FORMATS = frozenset(
    ("arrow", "bag", "db3", "feather", "h5", "hdf5", "json", "mat", "npz", "ods", "parquet", "xls", "xlsx")
)
"""Endings of known formats that nobody may have installed. The programs for them could not open a CSV."""

_MOST_ELEMENTS = 10_000
"""How many elements of an array may be columns: a file with more takes seconds per row, and few programs open it."""


class Recording(msgspec.Struct, frozen=True):
    """What a run records into one file.

    Attributes:
        loaded: the configuration; `loaded.resolve` gives the absolute path of a path in it.
        descriptions: the model descriptions by instance name, with the units of all variables.
        recorded: (instance, variable) of every column, in order; of an array every element is a column of its own,
            as `y[1,2]`.
        place: the path of its section in the configuration, `record` or `record[1]`, for findings.
        first: point of the first row.
        every: number of points from row to row.
        metadata: about the run, as JSON can hold it; `Result.metadata` reads it from the file. May be empty.
    """

    loaded: LoadedConfig
    descriptions: Mapping[str, ModelDescription]
    recorded: tuple[tuple[str, str], ...]
    place: str = "record"
    first: int = 0
    every: int = 1
    metadata: Mapping[str, Any] = msgspec.field(default_factory=dict)

    @property
    def columns(self) -> list[tuple[str, VariableType]]:
        """(`instance.variable`, type) of every column, in order; the time is not among them."""
        columns: list[tuple[str, VariableType]] = []
        for instance, name in self.recorded:
            variable = self.descriptions[instance].variable_of(name)
            assert variable is not None  # the system is valid
            columns.append((f"{instance}.{name}", variable.type))
        return columns

    def check_arrays(self, findings: Findings) -> None:
        """Add a finding for each array that is too large for a file with a column for each element."""
        known = ((own, name, self.descriptions[own].variable_of(name)) for own, name in self.recorded)
        arrays = Counter(f"{own}.{variable.name}" for own, _, variable in known if variable and variable.shape)
        for array, count in arrays.items():
            if count > _MOST_ELEMENTS:
                found = f"{count:,} elements of '{array}', for which this format has a column each"
                ways = f"a file ending in .parquet or .mcap, or variables without '{array}'"
                expected = f"at most {_MOST_ELEMENTS:,} elements, {ways}"
                findings.add(f"{self.place}.variables", found, expected)


class Columns(NamedTuple):
    """The columns of a result.

    Attributes:
        times: the times in s, shape `(rows,)`.
        values: an array of this shape for each variable, by name: of floats, whole numbers, truth values, or of dtype
            `object` for texts and bytes.
        units: the units that the file has, by name.
        metadata: those of the run, if the file has any (`Recording.metadata`, with what was noted).
    """

    times: NDArray[np.float64]
    values: dict[str, NDArray[Any]]
    units: Mapping[str, str] = {}
    metadata: Mapping[str, Any] = {}


class _Metadata(msgspec.Struct):
    """The metadata that are used when a file is read, with their types."""

    mesh: str = ""
    first: int = 0
    every: int = 1
    versions: dict[str, str] = {}
    variables: dict[str, _Described] = {}
    set: list[dict[str, Any]] = []


class _Described(msgspec.Struct):
    type: VariableType
    unit: str | None = None
    variability: str = ""


class ResultFormat(Protocol):
    """What an entry point names: a class with these four methods, whose instances are `ResultFile`s.

    The call sequence of both is:

    1. `check`, before anything is started, in another process than the rest.
    2. `open`, when the run starts. Another run must not be able to open the same file, and what is at ``path`` must
       not change before the first row. `fmu_mesh.files.open_alone` opens a file in this way.
    3. `write`, with rows in the order of their points, from `Recording.first` on at every `Recording.every`-th point;
       `flush` in between, about five times a second; `note` at any time, also before the first row. They are called
       from one thread at a time.
    4. `close`, once, also after an error. It may be called from another thread than `write`.
    5. `keep_whole_rows`, only if the process was killed before `close`, in another process.

    A format whose files cannot be read without their end writes into a file of another name, its `growing_file`, from
    which `close` or `keep_whole_rows` makes the file at ``path``.
    """

    def check(self, recording: Recording, findings: Findings) -> None:
        """Add a finding for everything that a file of this format cannot hold.

        Args:
            recording: what is to be recorded.
            findings: where findings go, each with its path in the configuration: that of the section and a key, such
                as `record.variables` or `record[1].variables`.

        Raises:
            ConfigurationError: a package that the format needs is missing.
        """
        ...

    def open(self, path: Path, recording: Recording) -> ResultFile:
        """Open a result file.

        Args:
            path: absolute path of the file; its folder may not exist yet.
            recording: what is recorded; `check` has found nothing wrong with it.

        Raises:
            ConfigurationError: the file cannot be written, or another run is writing it.
        """
        ...

    def growing_file(self, path: Path) -> Path:
        """The file that rows are written into while the run goes on; for most formats it is ``path`` itself."""
        ...

    def keep_whole_rows(self, path: Path, kept: Kept) -> int:
        """Finish a file after its last whole row; its writer was killed. A complete file stays as it is.

        Args:
            path: the file; nobody is writing it, or its `growing_file`, any more.
            kept: the last `ResultFile.kept` that was noted, of the `growing_file`. What follows these bytes may end
                within a row. (0, 0) if nothing is known.

        Returns:
            The number of rows in the file.

        Raises:
            ConfigurationError: it is not a result file of this format.
            OSError: it cannot be written.
        """
        ...


class ReadableFormat(Protocol):
    """What a `ResultFormat` also has if `Result.read` can read its files."""

    def read(self, path: Path) -> Columns:
        """Read a result file.

        Raises:
            ConfigurationError: it is not a result file of this format.
            OSError: it cannot be read.
        """
        ...


@runtime_checkable
class PiecewiseFormat(Protocol):
    """What a `ReadableFormat` also has whose files may be larger than the memory."""

    def pieces(self, path: Path) -> Iterator[Columns]:
        """The rows of a result file, piece by piece; there is at least one piece. The errors are those of `read`."""
        ...


class ResultFile(Protocol):
    """An open result file. `ResultFormat` has the call sequence.

    All methods raise OSError if the file cannot be written; the run ends with it.

    Attributes:
        path: the file.
        rows: number of rows written so far. After `close` it is the number of rows in the file, also on a full disk.
        kept: how many rows the operating system has, and in how many bytes of the file, or of the `growing_file` of
            its format. These rows survive if the process is killed.
    """

    @property
    def path(self) -> Path: ...  # noqa: D102 see above

    @property
    def rows(self) -> int: ...  # noqa: D102 see above

    @property
    def kept(self) -> Kept: ...  # noqa: D102 see above

    def write(self, times: NDArray[np.float64], columns: Sequence[NDArray[Any]]) -> None:
        """Append one row per time.

        Args:
            times: simulation times in s; at least one.
            columns: an array of the same length for each of `Recording.columns`, with the dtype of its type (`object`
                for String and Binary). The arrays are overwritten after the call; copy what is needed later.
        """
        ...

    def note(self, entry: Mapping[str, Any]) -> None:
        """Add what happened during the run to the metadata of the file (see `with_notes`).

        The operating system has it after the next `flush` at the latest. Without a row, nothing is written. A format
        that has no place for metadata does nothing.

        Args:
            entry: an object of JSON; it is not changed any more.
        """
        ...

    def flush(self) -> None:
        """Give all rows to the operating system, so that others can read them and they survive the process."""
        ...

    def close(self) -> None:
        """Write what is left and close the file. Without a row, what was at the path stays as it was."""
        ...


def result_format(path: str | Path) -> ResultFormat | None:
    """The format of a result file of this name, or None if its ending is that of a format that no package writes.

    A name without an ending is that of a CSV, and so is one with any other ending (see `has_unknown_ending`).

    Raises:
        ConfigurationError: two packages write this format, or the package cannot be imported.
    """
    ending = _ending(path)
    found = plugin(_GROUP, ending)
    if found is None and ending not in _OTHER_FORMATS:
        found = plugin(_GROUP, _DEFAULT)
    return cast("ResultFormat | None", found)


def has_unknown_ending(path: str | Path) -> bool:
    """Whether no installed package writes files with this ending."""
    return plugin(_GROUP, _ending(path)) is None


def is_in_memory(path: str | Path) -> bool:
    """Whether a result of this name is kept in memory and is no file."""
    return _ending(path) == _IN_MEMORY


def result_endings() -> list[str]:
    """The endings that result files can have, such as `.csv`, ours first."""
    return [f".{name}" for name in plugin_names(_GROUP) if name != _IN_MEMORY]


def with_notes(metadata: Mapping[str, Any], entries: Iterable[Mapping[str, Any]]) -> dict[str, Any]:
    """The metadata of a run with all that was noted while it went on.

    An entry with a `variable` is a value that was set; these are listed under `set`, in their order. The members of any
    other entry, such as `{"end": ...}`, become members of the metadata.

    Example:
        >>> with_notes({"mesh": "pair"}, [{"variable": "u", "value": 3.0}, {"end": {"point": 5}}])
        {'mesh': 'pair', 'end': {'point': 5}, 'set': [{'variable': 'u', 'value': 3.0}]}
    """
    noted: dict[str, Any] = {**metadata}
    values = [*noted.get("set", ())]
    for entry in entries:
        if "variable" in entry:
            values.append(entry)
        else:
            noted |= entry
    return {**noted, "set": values} if values else noted


def joined(pieces: Iterable[Columns]) -> Columns:
    """All rows of a result. Besides its columns, only one piece is in memory at a time."""
    columns: dict[str, NDArray[Any]] = {}
    rows = 0
    for piece in pieces:
        end = rows + len(piece.times)
        for name, part in (("", piece.times), *piece.values.items()):
            own = columns.setdefault(name, np.empty(0, part.dtype))
            if own.dtype != part.dtype:  # it has nulls, as the files of other programs may, or is no whole number
                own = columns[name] = own.astype(np.result_type(own, part))
            if len(own) < end:
                own.resize(max(end, rows + rows // 4), refcheck=False)  # large memory grows where it is
            own[rows:end] = part
        rows = end
    for own in columns.values():
        own.resize(rows, refcheck=False)
    return piece._replace(times=columns.pop(""), values=columns)


def metadata_in(data: bytes | str) -> dict[str, Any]:
    """The metadata of a run, from the JSON in a result file.

    Raises:
        ValueError: they are none.
    """
    decoded_json(data, _Metadata)
    return decoded_json(data, dict[str, Any])


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
        near = nearest_file(path) if isinstance(error, FileNotFoundError) else None
        hint = f"Did you mean '{near}'?" if near is not None else None
        text = f"the {what} '{path}' cannot be read: {error.strerror or error}.".replace("..", ".")
        raise ConfigurationError(text, hint=hint) from error
    except Exception as error:  # each library of a format has errors of its own for damaged bytes
        text = f"'{path}' is no {what}: {printable(str(error)) or type(error).__name__}."
        raise ConfigurationError(text.replace("..", ".")) from error


def _ending(path: str | Path) -> str:
    ending = Path(path).suffix.removeprefix(".").lower()
    return _DEFAULT if ending in _PLAIN or ending.isdecimal() else ending
