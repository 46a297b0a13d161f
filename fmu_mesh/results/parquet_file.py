"""Results as Parquet: one column for the time, and one for each variable, with its own type and its unit.

A Parquet file cannot be read without its end. While a run goes on, its rows are in an Arrow IPC stream beside it,
`<file>.arrows`, in batches that the operating system has after every `flush`. The same rows are compressed into a draft
of the Parquet file, group by group; `close` writes its end, renames it and removes the stream. After the writer was
killed, `keep_whole_rows` makes the file of all batches that are complete in the stream.
`docs/adr/0062-a-parquet-file-grows-as-a-stream.md` says why.

Metadata are JSON under `fmu_mesh`, in the schema of the stream and at the end of the Parquet file. What is noted during
the run is in the metadata of a batch, and at the end of the Parquet file together with the rest.
"""

# Two threads meet here: the one that writes rows, and one of `_GroupWriter` that compresses a row group. Only one
# group is compressed at a time: whoever hands over the next one waits for it first, and gets its error. A batch that
# waits for its group owns its memory, because `write` gets arrays that are overwritten. pyarrow itself starts no
# thread (`fmu_mesh.system.arrow` says why).
#
# What may go wrong: a full disk stops the draft, and the stream goes on alone, as its rows are what survives
# (ADR 62); a stream that cannot be written is cut off after its last whole batch. Compressing everything at the end
# was given up: it took 1 s for 500 MB, in a process that says nothing meanwhile.

from __future__ import annotations

import io
import os
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack, closing, contextmanager, suppress
from itertools import islice
from pathlib import Path
from typing import Any, Final, Self

import msgspec
import numpy as np
from numpy.typing import NDArray

from ..config.findings import Findings
from ..errors import ConfigurationError
from ..files import Kept, decoded_json, exists, is_file, open_alone, opened, replaced
from ..system.arrow import DIMENSIONS, open_parquet, parquet_batches, parquet_module, pyarrow_module
from ..variables.value_types import DTYPES, VariableType
from .parquet_arrays import KEY, arrays_of, arrow_array, columns_of, decoded, no_result, plain_schema, schema_of
from .recording import Columns, Recording, Tail, with_notes

__all__ = ["ParquetFile"]

_STREAM: Final = ".arrows"

_BLOCK_ROWS: Final = 16384
_BLOCK_BYTES: Final = 1 << 22
"""A batch has at most so many rows, and numbers of so many bytes; likewise texts, but at least one row."""

_GROUP_ROWS: Final = 131072
_GROUP_BYTES: Final = 1 << 26
"""A row group of the Parquet file has at most so many rows, and about so many bytes before they are compressed."""

_MERGED: Final = 32


class ParquetFile:
    """Writes rows of results, which become a Parquet file at the end.

    Args:
        path: the file; its folder is created, and the first row replaces an older file.
        schema: the columns as pyarrow has them, the time first.

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
        self._sink = io.BytesIO()  # of the pieces that pyarrow writes
        self._stream: Any = None
        self._groups: _GroupWriter | None = None
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
        return cls(path, schema_of(recording))

    @classmethod
    def of_columns(cls, path: Path, types: Mapping[str, VariableType], columns: Columns) -> Self:
        """Open a file for columns of which only the types, units and metadata are known."""
        return cls(path, plain_schema(types, columns))

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
        if is_file(path):  # `resume` was not over: the stream has no row that the file has not
            with opened(path) as file:
                rows = int(open_parquet(file).metadata.num_rows)
        elif stream.stat().st_size:
            with _batches(stream) as (schema, batches, notes), closing(_GroupWriter(path, schema)) as groups:
                for batch in batches:
                    groups.add(batch)
                rows = groups.finish(notes)
        stream.unlink()
        return rows

    @staticmethod
    def pieces(path: Path, types: Mapping[str, VariableType]) -> Iterator[Columns]:  # noqa: ARG004  the file has them
        """The rows of a file; while its run goes on, or after it was killed, the complete batches of its stream."""
        pyarrow_module()
        stream = ParquetFile.growing_file(path)
        if stream.is_file() and not path.exists():
            with _batches(stream) as (schema, batches, notes):
                none, names = columns_of(path, schema)
                for batch in batches:
                    yield none._replace(**arrays_of(batch, names))
                yield none._replace(metadata=with_notes(none.metadata, notes))
            return
        with opened(path) as file:
            content = open_parquet(file)
            none, names = columns_of(path, content.schema_arrow)
            none = none._replace(metadata=decoded(content.metadata))
            if not content.metadata.num_rows:
                yield none
            for batch in parquet_batches(content):
                yield none._replace(**arrays_of(batch, names))

    @staticmethod
    def follow(path: Path) -> Tail | None:
        """Open a file, or the stream that becomes it; None if neither is complete enough."""
        pyarrow_module()
        from .parquet_tail import ParquetTail  # noqa: PLC0415  it imports pyarrow, which is optional

        return ParquetTail.open(path, ParquetFile.growing_file(path))

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
                texts = np.column_stack([arrays[place][done : done + count] for place in self._texts]).tolist()
                sizes = np.cumsum([sum(map(len, row)) for row in texts])
                count = max(1, int(np.searchsorted(sizes, _BLOCK_BYTES, side="right")))
            block = slice(self._waiting, self._waiting + count)
            for own, array in zip(self._block, arrays, strict=True):
                own[block] = array[done : done + count]
            done, self._waiting, self.rows = done + count, self._waiting + count, self.rows + count
            if self._waiting == self._block_rows or self._texts:
                self._send()

    def resume(self, rows: int) -> None:
        """Go on after the rows that are in the file, which becomes a stream again; see `Resumable`."""
        pa = pyarrow_module()
        self._stream = pa.ipc.new_stream(self._sink, self._schema)
        with opened(self.path) as file:
            for batch in parquet_batches(open_parquet(file)):
                self._stream.write_batch(pa.RecordBatch.from_arrays(batch.columns, schema=self._schema))
                self._write_pieces()
        self.rows, self.kept, self._stream_only = rows, Kept(rows, self._file.size), True
        Path(os.path.realpath(self.path)).unlink()

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
            with closing(self._groups) as groups:
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
        arrays = [arrow_array(array[: self._waiting], field.type) for array, field in fields]
        self._waiting = 0
        batch = pa.RecordBatch.from_arrays(arrays, schema=self._schema)
        notes, self._notes = self._notes, []
        self._noted += notes
        if self._stream is None:
            self._stream = pa.ipc.new_stream(self._sink, self._schema)
        self._stream.write_batch(batch, {KEY: msgspec.json.encode(notes)} if notes else None)
        try:
            self._write_pieces()
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
                self._groups = _GroupWriter(self.path, self._schema)
            self._groups.add(batch)
        except OSError:
            groups, self._groups, self._stream_only = self._groups, None, True
            if groups is not None:
                groups.close()
            raise

    def _write_pieces(self) -> None:
        """Give the operating system what pyarrow has written."""
        left = memoryview(self._sink.getvalue())
        self._sink.seek(0)
        self._sink.truncate()
        while left:
            left = left[self._file.write(left) :]


@contextmanager
def _batches(path: Path) -> Iterator[tuple[Any, Iterator[Any], list[dict[str, Any]]]]:
    """The schema of a stream, its batches up to the first one that is not complete, and the entries noted in them."""
    pa, notes = pyarrow_module(), list[dict[str, Any]]()
    with path.open("rb") as file:
        try:
            reader = pa.ipc.open_stream(file)
        except (pa.ArrowException, OSError) as error:
            raise no_result(path, f"its heading is not complete ({error})") from error

        def complete() -> Iterator[Any]:
            while True:
                try:
                    batch, own = reader.read_next_batch_with_custom_metadata()
                    batch.validate(full=True)  # wrong offsets of texts would crash
                    if own is not None:
                        notes.extend(decoded_json(own[KEY], list[dict[str, Any]]))
                except (StopIteration, pa.ArrowException, OSError, KeyError, ValueError):
                    return  # the end, or a batch that is cut off
                yield batch

        yield reader.schema, complete(), notes


class _GroupWriter:
    """Writes a draft of the Parquet file, which gets its name at the end; `close` removes the draft.

    A batch is kept until its row group is complete. So it must own its memory. A row group is compressed on a thread of
    its own, because that takes tens of milliseconds, in which nodes would have to wait for the recorder. If two groups
    are waiting, `add` waits too.

    Args:
        path: the file.
        schema: its columns and metadata.
    """

    def __init__(self, path: Path, schema: Any) -> None:  # noqa: ANN401  pyarrow has no types
        self._schema = schema
        self._levels: list[list[Any]] = [[]]
        self._rows = self._size = self._written = 0
        floats: list[str] = []
        others: list[str] = []
        for field in schema:
            element = getattr(field.type, "value_type", None)  # of lists
            column = field.name if element is None else f"{field.name}.list.element"
            (floats if str(element or field.type) in ("double", "float") else others).append(column)
        ways = {
            "compression": "zstd",
            "compression_level": 1,
            "use_dictionary": others,
            "use_byte_stream_split": floats,
        }
        with ExitStack() as draft:
            file = draft.enter_context(draft.enter_context(replaced(path)).open("wb"))
            self._writer = parquet_module().ParquetWriter(file, schema, **ways)
            self._draft = draft.pop_all()
        self._compressing = ThreadPoolExecutor(1, "parquet")
        self._begun: Future[None] | None = None

    def add(self, batch: Any) -> None:  # noqa: ANN401  pyarrow has no types
        while batch.num_rows:
            part = batch.slice(0, _GROUP_ROWS - self._rows)
            batch = batch.slice(part.num_rows)
            self._keep(part)
            self._rows, self._size = self._rows + part.num_rows, self._size + part.nbytes
            if self._rows == _GROUP_ROWS or self._size >= _GROUP_BYTES:
                self._write()

    def finish(self, notes: Sequence[Mapping[str, Any]]) -> int:
        """Write the end, and give the file its name; return the number of its rows. Without a row, there is no file."""
        if self._rows:
            self._write()
        self._wait()
        self._compressing.shutdown()
        if self._written:
            metadata = with_notes(decoded(self._schema), notes)
            self._writer.add_key_value_metadata({KEY: msgspec.json.encode(metadata)})
            self._writer.close()
            self._writer = None
            self._draft.close()
        return self._written

    def close(self) -> None:
        """Remove the draft, unless it has become the file."""
        writer, self._writer = self._writer, None
        if writer is None:
            return
        self._compressing.shutdown(cancel_futures=True)
        with suppress(OSError):
            writer.close()
        with suppress(OSError), self._draft:
            raise OSError("the draft is of no use")  # so it is removed

    def _keep(self, batch: Any) -> None:  # noqa: ANN401  pyarrow has no types
        """Keep a batch for the row group; many small ones become a large one, which takes less memory."""
        for level in self._levels:
            level.append(batch)
            if len(level) < _MERGED:
                return
            [batch] = pyarrow_module().Table.from_batches(level).combine_chunks().to_batches()
            level.clear()
        self._levels.append([batch])

    def _write(self) -> None:
        """Begin to write what is waiting as one row group, as soon as the one before it is written."""
        table = pyarrow_module().Table.from_batches([batch for level in reversed(self._levels) for batch in level])
        self._written += self._rows
        self._levels, self._rows, self._size = [[]], 0, 0
        self._wait()
        self._begun = self._compressing.submit(self._writer.write_table, table, row_group_size=_GROUP_ROWS)

    def _wait(self) -> None:
        """Wait until the row group that was begun is written, or raise why it cannot be."""
        begun, self._begun = self._begun, None
        if begun is not None:
            begun.result()
