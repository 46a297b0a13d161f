"""The row groups of a Parquet file, written into a draft."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack, suppress
from pathlib import Path
from types import TracebackType
from typing import Any, Final, Self

import msgspec

from ..files import replaced
from ..system.arrow import parquet_module, pyarrow_module
from .recording import metadata_in, with_notes

__all__ = ["KEY", "GroupWriter", "decoded"]

KEY: Final = b"fmu_mesh"
"""Of the metadata."""

_GROUP_ROWS: Final = 131072
_GROUP_BYTES: Final = 1 << 26
"""A row group of the Parquet file has at most so many rows, and about so many bytes before they are compressed."""

_MERGED: Final = 32


class GroupWriter:
    """Writes a draft of the Parquet file, which gets its name at the end; a context manager, which removes the draft.

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

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.abandon()

    def add(self, batch: Any) -> None:  # noqa: ANN401  pyarrow has no types
        """Add the rows of a batch.

        Raises:
            OSError: the draft cannot be written; it is removed.
        """
        while batch.num_rows:
            part = batch.slice(0, _GROUP_ROWS - self._rows)
            batch = batch.slice(part.num_rows)
            self._keep(part)
            self._rows, self._size = self._rows + part.num_rows, self._size + part.nbytes
            if self._rows == _GROUP_ROWS or self._size >= _GROUP_BYTES:
                self._write()

    def finish(self, notes: Sequence[Mapping[str, Any]]) -> int:
        """Write the end, and give the file its name; return the number of its rows. Without a row, there is no file.

        Raises:
            OSError: the draft cannot be written; it is removed.
        """
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

    def abandon(self) -> None:
        """Remove the draft, unless it has become the file."""
        writer, self._writer = self._writer, None
        if writer is None:
            return
        self._compressing.shutdown(cancel_futures=True)
        with suppress(OSError):
            writer.close()
        with suppress(_Abandoned, OSError), self._draft:
            raise _Abandoned

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
        """Wait until the row group that was begun is written.

        Raises:
            OSError: it cannot be written.
        """
        begun, self._begun = self._begun, None
        if begun is not None:
            begun.result()


class _Abandoned(Exception):
    """A draft is of no use."""


def decoded(container: Any) -> dict[str, Any]:  # noqa: ANN401  a schema of pyarrow, or the end of a file
    """The metadata of a run in it; empty if there are none."""
    return metadata_in((container.metadata or {}).get(KEY, b"{}"))
