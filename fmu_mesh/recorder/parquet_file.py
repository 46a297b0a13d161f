"""Results as Parquet: one column for the time, and one for each variable, with its own type and its unit.

A Parquet file cannot be read without its end. While a run goes on, its rows are in an Arrow IPC stream beside it,
`<file>.arrows`, in batches that the operating system has after every `flush`. `close` makes the Parquet file of the
stream, and so does `keep_whole_rows` after the writer was killed: it has all batches that are complete in the stream.
`docs/adr/0062-a-parquet-file-is-made-of-a-stream.md` says why.

Metadata are JSON under `fmu_mesh` in the schema. What is noted during the run is in the metadata of a batch, and in the
Parquet file together with the rest.
"""

from __future__ import annotations

import io
import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, Final, Self

import msgspec
import numpy as np
from numpy.typing import NDArray

from ..config.findings import Findings
from ..errors import ConfigurationError
from ..files import Kept, is_file, open_alone, replaced
from ..system.recording import Columns, Recording, with_notes
from ..variables.model_description import Variable
from ..variables.value_types import DTYPES, VariableType, is_text

__all__ = ["ParquetFile"]

_STREAM: Final = ".arrows"
_KEY: Final = b"fmu_mesh"
_TIME: Final = "time"
_UNIT: Final = b"unit"

_BLOCK_ROWS: Final = 16384
_BLOCK_BYTES: Final = 1 << 22
"""A batch has at most so many rows, and numbers of so many bytes; likewise texts, but at least one row."""

_GROUP_ROWS: Final = 131072
_GROUP_BYTES: Final = 1 << 26
"""A row group of the Parquet file has at most so many rows, and about so many bytes before they are compressed."""

_ARROW_TYPES: Final[dict[VariableType, str]] = {
    "Float64": "float64",
    "Int64": "int64",
    "UInt64": "uint64",
    "Enumeration": "int64",
    "Float32": "float32",
    "Int32": "int32",
    "UInt32": "uint32",
    "Int16": "int16",
    "UInt16": "uint16",
    "Int8": "int8",
    "UInt8": "uint8",
    "Boolean": "bool_",
    "String": "string",
    "Binary": "binary",
}


class ParquetFile:
    """Writes rows of results, which become a Parquet file at the end.

    Args:
        path: the file; its folder is created, and the first row replaces an older file.
        columns: (name, type) of every column but `time`.
        schema: the same with `time`, as pyarrow has it.

    Attributes:
        path: the file.
        rows: number of rows written so far; after `close`, the number of rows in the file.
        kept: what the operating system has of the stream.

    Raises:
        ConfigurationError: the file cannot be written, or another run writes it.
    """

    def __init__(self, path: Path, columns: Sequence[tuple[str, VariableType]], schema: Any) -> None:  # noqa: ANN401  pyarrow has no types
        self.path = path
        self.rows = 0
        self.kept = Kept()
        types: list[VariableType] = ["Float64", *(type_ for _, type_ in columns)]
        row_bytes = sum(np.dtype(DTYPES[type_]).itemsize for type_ in types)
        self._block_rows = min(max(1, _BLOCK_BYTES // row_bytes), _BLOCK_ROWS)
        self._block = [np.empty(self._block_rows, DTYPES[type_]) for type_ in types]
        self._texts = [place for place, type_ in enumerate(types) if is_text(type_)]
        self._waiting = 0
        self._notes: list[Mapping[str, Any]] = []
        self._schema = schema
        self._file = open_alone(self.growing_file(path))
        self._sink = _Sink()
        self._stream: Any = None

    @classmethod
    def check(cls, recording: Recording, findings: Findings) -> None:  # noqa: ARG003  it can hold values of all types
        """Check that pyarrow is installed."""
        _pyarrow()

    @classmethod
    def open(cls, path: Path, recording: Recording) -> Self:
        """Open a result file for what a run records."""
        if path.exists() and not path.is_file():
            hint = "Record into a .csv file."
            raise ConfigurationError(f"'{path}' is not a file, and a Parquet file cannot replace it.", hint=hint)
        return cls(path, recording.columns, _schema_of(recording))

    @staticmethod
    def growing_file(path: Path) -> Path:
        """The stream, beside the file that a link refers to."""
        return Path(f"{os.path.realpath(path)}{_STREAM}")

    @staticmethod
    def keep_whole_rows(path: Path, kept: Kept) -> int:  # noqa: ARG004  the batches are found from the first one on
        """Make the Parquet file of the stream that a killed process has left; return the number of its rows."""
        stream = ParquetFile.growing_file(path)
        if not stream.exists():
            return _rows_of(path) if is_file(path) else 0
        rows = _converted(stream, path)
        stream.unlink()
        return rows

    @staticmethod
    def read(path: Path) -> Columns:
        """Read a result file; while its run goes on, or after it was killed, the complete batches of its stream."""
        pa = _pyarrow()
        stream = ParquetFile.growing_file(path)
        try:
            if stream.is_file() and not path.exists():
                with _Stream(stream) as batches:
                    table = pa.Table.from_batches(list(batches), batches.schema)
                    metadata = with_notes(_decoded(table.schema), batches.notes)
            else:
                with path.open("rb") as file:
                    table = _parquet().ParquetFile(file).read()
                    metadata = _decoded(table.schema)
        except (pa.ArrowException, msgspec.DecodeError) as error:
            raise _no_result(path, str(error)) from error
        if not table.column_names or table.column_names[0] != _TIME or not pa.types.is_float64(table.schema[0].type):
            raise _no_result(path, f"its first column is not '{_TIME}' in float64")
        columns = {name: _array(column) for name, column in zip(table.column_names, table.columns, strict=True)}
        units = {f.name: f.metadata[_UNIT].decode() for f in table.schema if f.metadata and _UNIT in f.metadata}
        return Columns(columns.pop(_TIME), columns, units, metadata)

    def write(self, times: NDArray[np.float64], columns: Sequence[NDArray[Any]]) -> None:
        """Append one row per time; ``columns`` are arrays of the same length, of their types' dtypes."""
        arrays, done = [times, *columns], 0
        if not self.rows:
            with suppress(FileNotFoundError):
                Path(os.path.realpath(self.path)).unlink()  # the first row replaces it, as in all formats
        while done < len(times):
            count = min(len(times) - done, self._block_rows - self._waiting)
            if self._texts:
                count = self._rows_of_texts([arrays[place][done : done + count] for place in self._texts])
            block = slice(self._waiting, self._waiting + count)
            for own, array in zip(self._block, arrays, strict=True):
                own[block] = array[done : done + count]
            done, self._waiting, self.rows = done + count, self._waiting + count, self.rows + count
            if self._waiting == self._block_rows or self._texts:
                self._send()

    def note(self, entry: Mapping[str, Any]) -> None:
        """Add an entry to the metadata."""
        self._notes.append(entry)

    def flush(self) -> None:
        """Give all rows to the operating system, so that others can read them in the stream."""
        if self._waiting or (self.rows and self._notes):
            self._send()

    def close(self) -> None:
        """Write what is left, and make the Parquet file. Without a row, nothing has changed.

        If the file cannot be written, the stream stays; `recover` can make the file later.
        """
        if self._file.closed:
            return
        try:
            try:
                self.flush()
            finally:
                self.rows = self.kept.rows
                if self.kept.size:
                    self.keep_whole_rows(self.path, self.kept)
        finally:
            self._file.close()

    def _send(self) -> None:
        """Write the rows that are waiting as one batch."""
        pa = _pyarrow()
        fields = zip(self._block, self._schema, strict=True)
        arrays = [pa.array(array[: self._waiting], field.type, from_pandas=False) for array, field in fields]
        self._waiting = 0
        batch = pa.record_batch(arrays, schema=self._schema)
        notes, self._notes = self._notes, []
        if self._stream is None:
            self._stream = pa.ipc.new_stream(self._sink, self._schema)
        self._stream.write_batch(batch, {_KEY: msgspec.json.encode(notes)} if notes else None)
        left = memoryview(self._sink.taken())
        try:
            while left:
                left = left[self._file.write(left) :]
        except OSError:
            self.rows = self.kept.rows
            with suppress(OSError):
                os.truncate(self.growing_file(self.path), self.kept.size)
            raise
        self.kept = Kept(self.rows, self._file.size)

    @staticmethod
    def _rows_of_texts(columns: Sequence[NDArray[Any]]) -> int:
        """How many of these rows fit into a batch; at least one."""
        sizes = np.cumsum([sum(map(len, row)) for row in zip(*(column.tolist() for column in columns), strict=True)])
        return max(1, int(np.searchsorted(sizes, _BLOCK_BYTES, side="right")))


class _Stream:
    """The batches of a stream, up to the first one that is not complete.

    Args:
        path: the stream.
        mapped: whether its bytes are only mapped into memory: columns that nobody uses are not read.

    Attributes:
        schema: of the stream.
        notes: the entries of the batches that were read.
    """

    def __init__(self, path: Path, *, mapped: bool = False) -> None:
        self.notes: list[Mapping[str, Any]] = []
        self._pa = _pyarrow()
        self._file = self._pa.memory_map(str(path)) if mapped else path.open("rb")
        try:
            self._reader = self._pa.ipc.open_stream(self._file)
        except (self._pa.ArrowException, OSError) as error:
            self._file.close()
            raise _no_result(path, f"its heading is not complete ({error})") from error
        self.schema = self._reader.schema

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()

    def __iter__(self) -> Iterator[Any]:
        while True:
            try:
                batch, own = self._reader.read_next_batch_with_custom_metadata()
                if own is not None:
                    self.notes += msgspec.json.decode(own[_KEY], type=list[dict[str, Any]])
            except (StopIteration, self._pa.ArrowException, OSError):  # the end, or a batch that is cut off
                return
            yield batch


class _Sink(io.RawIOBase):
    """Collects what pyarrow writes in many small pieces."""

    def __init__(self) -> None:
        super().__init__()
        self._parts: list[bytes] = []

    def writable(self) -> bool:
        return True

    def write(self, data: Any, /) -> int:  # noqa: ANN401  any buffer
        self._parts.append(bytes(data))
        return len(self._parts[-1])

    def taken(self) -> bytes:
        """All that was written since the last call."""
        taken = b"".join(self._parts)
        self._parts.clear()
        return taken


def _converted(stream: Path, path: Path) -> int:
    """Write the Parquet file of a stream; return the number of its rows. Without a row nothing is written."""
    if not stream.stat().st_size:
        return 0
    with _Stream(stream, mapped=True) as batches:
        rows = sum(int(batch.num_rows) for batch in batches)
        metadata = with_notes(_decoded(batches.schema), batches.notes)
        schema = batches.schema.with_metadata({_KEY: msgspec.json.encode(metadata)})
    if not rows:
        return 0
    floats = [field.name for field in schema if str(field.type) in ("double", "float")]
    others = [field.name for field in schema if field.name not in floats]
    ways = {"compression": "zstd", "compression_level": 1, "use_dictionary": others, "use_byte_stream_split": floats}
    with (
        _Stream(stream) as batches,
        replaced(path) as draft,
        _parquet().ParquetWriter(draft, schema, **ways) as writer,
    ):
        for group in _grouped(batches):
            writer.write_table(group, row_group_size=_GROUP_ROWS)
    return rows


def _grouped(batches: _Stream) -> Iterator[Any]:
    """The rows of a stream in tables that become one row group each."""
    pa = _pyarrow()
    waiting: list[Any] = []
    rows = size = 0
    for batch in batches:
        rest = batch
        while rest.num_rows:
            part = rest.slice(0, _GROUP_ROWS - rows)
            rest = rest.slice(part.num_rows)
            waiting.append(part)
            rows, size = rows + part.num_rows, size + part.nbytes
            if rows == _GROUP_ROWS or size >= _GROUP_BYTES:
                yield pa.Table.from_batches(waiting)
                waiting, rows, size = [], 0, 0
    if waiting:
        yield pa.Table.from_batches(waiting)


def _rows_of(path: Path) -> int:
    """The number of rows of a complete Parquet file.

    Raises:
        ConfigurationError: it is none.
    """
    try:
        with path.open("rb") as file:
            rows: int = _parquet().ParquetFile(file).metadata.num_rows
    except _pyarrow().ArrowException as error:
        raise _no_result(path, str(error)) from error
    return rows


def _schema_of(recording: Recording) -> Any:  # noqa: ANN401  pyarrow has no types
    """The columns of a recording as pyarrow has them, with what is known of each variable."""
    pa = _pyarrow()
    fields = [pa.field(_TIME, pa.float64(), nullable=False, metadata={"unit": "s"})]
    for (instance, name), (column, type_) in zip(recording.recorded, recording.columns, strict=True):
        variable = recording.descriptions[instance].variable_of(name)
        assert variable is not None  # the system is valid
        arrow_type = getattr(pa, _ARROW_TYPES[type_])()
        fields.append(pa.field(column, arrow_type, nullable=False, metadata=_about(variable)))
    return pa.schema(fields, {_KEY: msgspec.json.encode(recording.metadata)})


def _about(variable: Variable) -> dict[str, str]:
    """What the field of a variable says about it."""
    about: dict[str, str] = {"type": variable.type}
    about |= {"causality": variable.causality, "variability": variable.variability}
    known = {"unit": variable.unit, "description": variable.description}
    about |= {key: text for key, text in known.items() if text is not None}
    if variable.items:
        about["items"] = msgspec.json.encode(dict(variable.items)).decode()
    return about


def _array(column: Any) -> NDArray[Any]:  # noqa: ANN401  pyarrow has no types
    """A column as numpy has it, of its own memory; `object` for texts and bytes."""
    pa = _pyarrow()
    if pa.types.is_string(column.type) or pa.types.is_binary(column.type):
        return np.array([*column.to_pylist(), None], object)[:-1]  # never an array of more dimensions
    return np.array(column.to_numpy())


def _decoded(schema: Any) -> dict[str, Any]:  # noqa: ANN401  pyarrow has no types
    return msgspec.json.decode((schema.metadata or {}).get(_KEY, b"{}"), type=dict[str, Any])


def _no_result(path: Path, why: str) -> ConfigurationError:
    return ConfigurationError(f"'{path}' is no result file: {why}.".replace("..", "."))


def _pyarrow() -> Any:  # noqa: ANN401  an optional dependency
    try:
        import pyarrow as pa  # noqa: PLC0415  an optional dependency
        from pyarrow import ipc  # noqa: F401, PLC0415  an optional dependency; `pa.ipc`
    except ImportError as error:
        raise ConfigurationError(
            "results in .parquet need the package pyarrow", hint="Install it: pip install 'fmu-mesh[parquet]'."
        ) from error
    return pa


def _parquet() -> Any:  # noqa: ANN401  an optional dependency
    _pyarrow()
    from pyarrow import parquet  # noqa: PLC0415  slow to import, and writing rows does without

    return parquet
