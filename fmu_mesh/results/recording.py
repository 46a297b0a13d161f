"""What a run records, and the contract of a result format: how its files are written, read, followed and recovered.

A package offers a format through the entry points `fmu_mesh.recorders`, under the ending of its files without the dot.
CSV, Parquet and MCAP are found in the same way (`fmu_mesh.results.formats`). `docs/extending.md` shows how to write
one.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import msgspec
import numpy as np
from numpy.typing import NDArray

from ..config.findings import Findings
from ..config.loading import LoadedConfig
from ..files import Kept, decoded_json
from ..system.defect import Defect
from ..variables.model_description import ModelDescription, Variable
from ..variables.value_types import VariableType

__all__ = [
    "Columns",
    "Recording",
    "ResultFile",
    "ResultFormat",
    "Resumable",
    "Tail",
    "joined",
    "metadata_in",
    "with_notes",
]


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
        return [(f"{instance}.{name}", self.variable(instance, name).type) for instance, name in self.recorded]

    def variable(self, instance: str, name: str) -> Variable:
        """The variable of a column: of an element of an array, the array."""
        variable = self.descriptions[instance].variable_of(name)
        assert variable is not None  # the system is valid
        return variable


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


class ResultFormat(Protocol):
    """What an entry point names: a class with these six methods, whose instances are `ResultFile`s.

    The call sequence of both, where a run writes a file:

    1. `check`, before anything is started, in another process than the rest.
    2. `open`, when the run starts. Another run must not be able to open the same file, and what is at ``path`` must
       not change before the first row. `fmu_mesh.files.open_alone` opens a file in this way.
    3. `write`, with rows in the order of their points, from `Recording.first` on at every `Recording.every`-th point;
       `flush` in between, about five times a second; `note` at any time, also before the first row. They are called
       from one thread at a time.
    4. `close`, once, also after an error. It may be called from another thread than `write`.
    5. `keep_whole_rows`, only if the process was killed before `close`, in another process.

    `pieces` and `follow` read a file at any time, in any process, also while a run writes it. They may be missing:
    results of a format without `pieces` can only be written, and no page shows those of one without `follow`.

    A format whose files cannot be read without their end writes into a file of another name, its `growing_file`, from
    which `close` or `keep_whole_rows` makes the file at ``path``.
    """

    def check(self, recording: Recording, findings: Findings) -> None:
        """Add a finding for everything that a file of this format cannot hold.

        A finding has a path in the configuration: `Recording.place` and a key, such as `record[1].variables`.

        Raises:
            ConfigurationError: a package that the format needs is missing.
        """
        ...

    def open(self, path: Path, recording: Recording) -> ResultFile:
        """Open a result file for what `check` has found nothing wrong with. The folder of the path may not exist yet.

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

    def pieces(self, path: Path, types: Mapping[str, VariableType]) -> Iterator[Columns]:
        """The rows of a result file, piece by piece, so that a file may be larger than the memory.

        Args:
            path: the file.
            types: the types of the columns by name, where the caller knows them and the file may not say them.

        Returns:
            At least one piece; all have the same columns.

        Raises:
            ConfigurationError: it is not a result file of this format.
            OSError: it cannot be read.
        """
        ...

    def follow(self, path: Path) -> Tail | None:
        """Open a result file that may still grow; None if it has no heading yet, or cannot be followed.

        The errors are those of `pieces`.
        """
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
        that has no place for metadata does nothing. The entry is an object of JSON, and is not changed any more.
        """
        ...

    def flush(self) -> None:
        """Give all rows to the operating system, so that others can read them and they survive the process."""
        ...

    def close(self) -> None:
        """Write what is left and close the file. Without a row, what was at the path stays as it was."""
        ...


class Resumable(Protocol):
    """What a `ResultFile` may have besides: then the rows of a run that starts again stay in its file."""

    def resume(self, rows: int) -> None:
        """The next `write` goes after the ``rows`` whole rows that the file at the path has; called before it.

        The file is one that `close` or `keep_whole_rows` has finished. Until this call it stays as it is.
        """
        ...


class Tail(Protocol):
    """The rows of a result file in pieces, while it grows and afterwards; only reads, and the run never waits for it.

    Attributes:
        path: the result file.
        names: the columns without `time`.
        replaced: whether the file is gone, or that of another run.
        behind: bytes of the file that were not read yet.
    """

    path: Path
    names: Sequence[str]

    @property
    def replaced(self) -> bool: ...  # noqa: D102 see above

    @property
    def behind(self) -> int: ...  # noqa: D102 see above

    def skip(self) -> None:
        """Go on with the rows that are written from now on."""
        ...

    def read(self, names: Sequence[str]) -> Columns | None:
        """These columns of the next rows, a few megabytes of the file at most; None if there is no new row."""
        ...

    def close(self) -> None:
        """Close the file."""
        ...


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
            values = [*entry.get("set", values)]  # the run has started again
            noted |= entry
    return {**noted, "set": values} if values else noted


class _Metadata(msgspec.Struct):
    """The metadata that are used when a file is read, with their types."""

    mesh: str = ""
    first: int = 0
    every: int = 1
    versions: dict[str, str] = {}
    variables: dict[str, _Described] = {}
    set: list[dict[str, Any]] = []
    defects: dict[str, Defect] = {}


class _Described(msgspec.Struct):
    type: VariableType
    unit: str | None = None
    variability: str = ""


def metadata_in(data: bytes | str) -> dict[str, Any]:
    """The metadata of a run, from the JSON in a result file.

    Raises:
        ValueError: they are none.
    """
    decoded_json(data, _Metadata)
    return decoded_json(data, dict[str, Any])
