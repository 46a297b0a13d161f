"""Results as Parquet: one column for the time, and one for each variable, with its own type and its unit.

The rows of an array are lists of one size, unless only some of its elements are recorded: these have a column each.

A Parquet file cannot be read without its end. While a run goes on, its rows are in an Arrow IPC stream beside it,
`<file>.arrows`, in batches that the operating system has after every `flush`. The same rows are compressed into a draft
of the Parquet file, group by group; `close` writes its end, renames it and removes the stream. After the writer was
killed, `keep_whole_rows` makes the file of all batches that are complete in the stream.
`docs/adr/0062-a-parquet-file-grows-as-a-stream.md` says why.

Metadata are JSON under `fmu_mesh`, in the schema of the stream and at the end of the Parquet file. What is noted during
the run is in the metadata of a batch, and at the end of the Parquet file together with the rest.
"""

from __future__ import annotations

import io
import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from itertools import islice
from pathlib import Path
from typing import Any, Final, Self

import msgspec
import numpy as np
from numpy.typing import NDArray

from ..config.findings import Findings
from ..errors import ConfigurationError
from ..files import Kept, decoded_json, exists, is_file, open_alone, opened
from ..system.arrow import DIMENSIONS, elements_of, open_parquet, parquet_batches, parquet_module, pyarrow_module
from .recording import Columns, Recording, joined, with_notes
from ..variables.model_description import Variable
from ..variables.value_types import DTYPES, VariableType, element_name
from .parquet_groups import KEY, GroupWriter, decoded

__all__ = ["ParquetFile"]

_STREAM: Final = ".arrows"
_TIME: Final = "time"
_UNIT: Final = b"unit"
_ABOUT_TIME: Final = {"type": "Float64", "unit": "s"}

_BLOCK_ROWS: Final = 16384
_BLOCK_BYTES: Final = 1 << 22
"""A batch has at most so many rows, and numbers of so many bytes; likewise texts, but at least one row."""

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
        schema: the columns as pyarrow has them, the time first.

    Attributes:
        path: the file.
        rows: number of rows written so far; after `close`, the number of rows in the file.
        kept: what the operating system has of the stream.

    Raises:
        ConfigurationError: the file cannot be written, or another run writes it.
    """

    def __init__(self, path: Path, schema: Any) -> None:  # noqa: ANN401  pyarrow has no types
        parquet_module()  # importing it with the first rows would delay the run
        self.path = path
        self.rows = 0
        self.kept = Kept()
        shapes = [(field.type.list_size,) if DIMENSIONS in field.metadata else () for field in schema]
        dtypes = [np.dtype(DTYPES[field.metadata[b"type"].decode()]) for field in schema]
        row = [np.empty(shape, dtype) for shape, dtype in zip(shapes, dtypes, strict=True)]
        self._block_rows = min(max(1, _BLOCK_BYTES // sum(own.nbytes for own in row)), _BLOCK_ROWS)
        self._block = [np.empty((self._block_rows, *own.shape), own.dtype) for own in row]
        self._texts = [place for place, own in enumerate(row) if own.dtype == object]
        self._waiting = 0
        self._notes: list[Mapping[str, Any]] = []
        self._noted: list[Mapping[str, Any]] = []
        self._schema = schema
        self._file = open_alone(self.growing_file(path), path)
        self._sink = _Sink()
        self._stream: Any = None
        self._groups: GroupWriter | None = None
        self._stream_only = False  # the draft could not be written

    @classmethod
    def check(cls, recording: Recording, findings: Findings) -> None:  # noqa: ARG003  it can hold everything
        """Check that pyarrow is installed."""
        pyarrow_module()

    @classmethod
    def open(cls, path: Path, recording: Recording) -> Self:
        """Open a result file for what a run records."""
        if exists(path) and not is_file(path):
            hint = "Record into a .csv file."
            raise ConfigurationError(f"'{path}' is not a file, and a Parquet file cannot replace it.", hint=hint)
        return cls(path, _schema_of(recording))

    @classmethod
    def of_columns(cls, path: Path, types: Mapping[str, VariableType], columns: Columns) -> Self:
        """Open a file for columns of which only the types, units and metadata are known."""
        pa = pyarrow_module()
        fields = [pa.field(_TIME, pa.float64(), nullable=False, metadata=_ABOUT_TIME)]
        for name, type_ in types.items():
            about = {"type": type_} | ({"unit": columns.units[name]} if name in columns.units else {})
            fields.append(pa.field(name, getattr(pa, _ARROW_TYPES[type_])(), nullable=False, metadata=about))
        return cls(path, pa.schema(fields, {KEY: msgspec.json.encode(columns.metadata)}))

    @staticmethod
    def growing_file(path: Path) -> Path:
        """The stream, beside the file that a link refers to."""
        return Path(f"{os.path.realpath(path)}{_STREAM}")

    @staticmethod
    def keep_whole_rows(path: Path, kept: Kept) -> int:  # noqa: ARG004  the batches are found from the first one on
        """Make the Parquet file of the stream that a killed process has left; return the number of its rows."""
        stream = ParquetFile.growing_file(path)
        if not stream.exists():
            if not is_file(path):
                return 0
            with opened(path) as file:
                return int(open_parquet(file).metadata.num_rows)
        rows = 0
        if stream.stat().st_size:
            with _Stream(stream) as batches, GroupWriter(path, batches.schema) as groups:
                for batch in batches:
                    groups.add(batch)
                rows = groups.finish(batches.notes)
        stream.unlink()
        return rows

    @staticmethod
    def read(path: Path) -> Columns:
        """Read a result file; while its run goes on, or after it was killed, the complete batches of its stream."""
        return joined(ParquetFile.pieces(path))

    @staticmethod
    def pieces(path: Path) -> Iterator[Columns]:
        """The same, piece by piece."""
        pyarrow_module()
        stream = ParquetFile.growing_file(path)
        if stream.is_file() and not path.exists():
            with _Stream(stream) as batches:
                none, names = _columns_of(path, batches.schema)
                for batch in batches:
                    yield none._replace(**_arrays_of(batch, names))
                yield none._replace(metadata=with_notes(none.metadata, batches.notes))
            return
        with opened(path) as file:
            content = open_parquet(file)
            none, names = _columns_of(path, content.schema_arrow)
            none = none._replace(metadata=decoded(content.metadata))
            if not content.metadata.num_rows:
                yield none
            for batch in parquet_batches(content):
                yield none._replace(**_arrays_of(batch, names))

    def write(self, times: NDArray[np.float64], columns: Sequence[NDArray[Any]]) -> None:
        """Append one row per time; ``columns`` are arrays of the same length, of their types' dtypes."""
        left, done = iter((times, *columns)), 0
        arrays = [
            next(left) if own.ndim == 1 else np.stack([*islice(left, own.shape[1])], axis=1) for own in self._block
        ]
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
                self._finish()
        finally:
            self._file.close()

    def _finish(self) -> None:
        """Write the end of the draft; if there is none because it could not be written, make it of the stream again."""
        stream = self.growing_file(self.path)
        if self._groups is not None:
            with self._groups as groups:
                groups.finish(self._noted)
            stream.unlink()
        elif self.kept.rows:
            self.keep_whole_rows(self.path, self.kept)
        elif self._stream is not None:
            stream.unlink()

    def _send(self) -> None:
        """Write the rows that are waiting as one batch."""
        pa = pyarrow_module()
        fields = zip(self._block, self._schema, strict=True)
        arrays = [_arrow_array(array[: self._waiting], field.type) for array, field in fields]
        self._waiting = 0
        batch = pa.RecordBatch.from_arrays(arrays, schema=self._schema)
        notes, self._notes = self._notes, []
        self._noted += notes
        if self._stream is None:
            self._stream = pa.ipc.new_stream(self._sink, self._schema)
        self._stream.write_batch(batch, {KEY: msgspec.json.encode(notes)} if notes else None)
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
        if self._stream_only:
            return
        try:
            if self._groups is None:
                self._groups = GroupWriter(self.path, self._schema)
            self._groups.add(batch)
        except OSError:
            groups, self._groups, self._stream_only = self._groups, None, True
            if groups is not None:
                groups.abandon()
            raise

    @staticmethod
    def _rows_of_texts(columns: Sequence[NDArray[Any]]) -> int:
        """How many of these rows fit into a batch; at least one."""
        sizes = np.cumsum([sum(map(len, row)) for row in np.column_stack(columns).tolist()])
        return max(1, int(np.searchsorted(sizes, _BLOCK_BYTES, side="right")))


class _Stream:
    """The batches of a stream, up to the first one that is not complete.

    Args:
        path: the stream.

    Attributes:
        schema: of the stream.
        notes: the entries of the batches that were read.
    """

    def __init__(self, path: Path) -> None:
        self.notes: list[Mapping[str, Any]] = []
        self._pa = pyarrow_module()
        self._file = path.open("rb")
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
                batch.validate(full=True)  # wrong offsets of texts would crash
                if own is not None:
                    self.notes += decoded_json(own[KEY], list[dict[str, Any]])
            except (StopIteration, self._pa.ArrowException, OSError, KeyError, ValueError):
                # The end, or a batch that is cut off.
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


def _schema_of(recording: Recording) -> Any:  # noqa: ANN401  pyarrow has no types
    """The columns of a recording as pyarrow has them, with what is known of each variable."""
    pa = pyarrow_module()
    fields = [pa.field(_TIME, pa.float64(), nullable=False, metadata=_ABOUT_TIME)]
    recorded, place = recording.recorded, 0
    while place < len(recorded):
        instance, name = recorded[place]
        variable = recording.descriptions[instance].variable_of(name)
        assert variable is not None  # the system is valid
        arrow_type, about, end = getattr(pa, _ARROW_TYPES[variable.type])(), _about(variable), place + variable.size
        is_first = bool(variable.shape) and name == element_name(variable.name, (0,) * len(variable.shape))
        if is_first and recorded[place:end] == tuple((instance, element) for element in variable.elements):
            arrow_type = pa.list_(pa.field("element", arrow_type, nullable=False), variable.size)
            about[DIMENSIONS.decode()] = msgspec.json.encode(variable.shape).decode()
            name, place = variable.name, end - 1
        fields.append(pa.field(f"{instance}.{name}", arrow_type, nullable=False, metadata=about))
        place += 1
    return pa.schema(fields, {KEY: msgspec.json.encode(recording.metadata)})


def _about(variable: Variable) -> dict[str, str]:
    """What the field of a variable says about it."""
    about: dict[str, str] = {"type": variable.type}
    about |= {"causality": variable.causality, "variability": variable.variability}
    known = {"unit": variable.unit, "description": variable.description}
    about |= {key: text for key, text in known.items() if text is not None}
    if variable.items:
        about["items"] = msgspec.json.encode(dict(variable.items)).decode()
    return about


def _arrow_array(values: NDArray[Any], type_: Any) -> Any:  # noqa: ANN401  pyarrow has no types
    """A copy of the values as pyarrow has it. `pyarrow.array` would import pandas, which takes half a second."""
    pa = pyarrow_module()
    if values.ndim > 1:
        elements = _arrow_array(values.reshape(-1), type_.value_type)
        return pa.Array.from_buffers(type_, len(values), [None], null_count=0, children=[elements])
    if values.dtype == object:
        texts = [value.encode() if isinstance(value, str) else value for value in values.tolist()]
        ends = np.zeros(1 + len(texts), np.int32)
        np.cumsum([len(text) for text in texts], out=ends[1:])
        buffers = [ends, b"".join(texts)]
    elif values.dtype == np.bool_:
        buffers = [np.packbits(values, bitorder="little")]
    else:
        buffers = [values.copy()]
    return pa.Array.from_buffers(type_, len(values), [None, *map(pa.py_buffer, buffers)], null_count=0)


def _columns_of(path: Path, schema: Any) -> tuple[Columns, list[tuple[str, ...]]]:  # noqa: ANN401  pyarrow has no types
    """The columns without rows, and the names of those of each field."""
    pa = pyarrow_module()
    if not schema.names or schema.names[0] != _TIME or not pa.types.is_float64(schema[0].type):
        raise _no_result(path, f"its first column is not '{_TIME}' in float64")
    names = [elements_of(field) for field in schema]
    known = [(field.metadata or {}).get(_UNIT) for field in schema]
    units = {name: unit.decode() for unit, own in zip(known, names, strict=True) if unit is not None for name in own}
    return Columns(**_arrays_of(schema.empty_table(), names), units=units, metadata=decoded(schema)), names


def _arrays_of(batch: Any, names: Sequence[tuple[str, ...]]) -> dict[str, Any]:  # noqa: ANN401  pyarrow has no types
    """The times and values of a batch, as numpy has them; ``names`` are those of the columns of each field."""
    arrays: dict[str, NDArray[Any]] = {}
    for name, own, column in zip(batch.schema.names, names, batch.columns, strict=True):
        if own == (name,):
            arrays[name] = _array(column)
        else:
            from pyarrow.compute import list_flatten  # noqa: PLC0415  an optional dependency, slow to import

            table = _array(list_flatten(column)).reshape(len(column), len(own))
            arrays |= zip(own, np.ascontiguousarray(table.T), strict=True)
    return {"times": arrays.pop(_TIME), "values": arrays}


def _array(column: Any) -> NDArray[Any]:  # noqa: ANN401  pyarrow has no types
    """A column as numpy has it; `object` for texts and bytes."""
    pa = pyarrow_module()
    if pa.types.is_string(column.type) or pa.types.is_binary(column.type):
        return np.array([*column.to_pylist(), None], object)[:-1]  # never an array of more dimensions
    array: NDArray[Any] = column.to_numpy(zero_copy_only=False)
    return array


def _no_result(path: Path, why: str) -> ConfigurationError:
    return ConfigurationError(f"'{path}' is no result file: {why}.".replace("..", "."))
