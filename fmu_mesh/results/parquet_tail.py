"""Follows the Parquet file of a run: the batches of the stream beside it while it grows, and its row groups afterwards.

Only the columns that are asked for are read from the disk. This module needs pyarrow, which is optional.
"""

from __future__ import annotations

import mmap
import os
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any, BinaryIO, Self, TypeVar

import pyarrow as pa

from ..system.arrow import open_parquet, places_of, values_at
from .parquet_arrays import TIME, array_of
from .recording import Columns
from .tails import GrowingFile

__all__ = ["ParquetTail"]


class ParquetTail:
    """The rows of a result, batch by batch; see `Tail`.

    Args:
        path: the result file.
        batches: of the stream, or of the file itself.

    Attributes:
        path: the result file.
        names: the columns of numbers without `time`.
    """

    def __init__(self, path: Path, batches: _Stream | _Groups) -> None:
        types = {field.name: str(getattr(field.type, "value_type", field.type)) for field in batches.schema}
        self.path = path
        self._places = places_of(batches.schema)
        self.names: Sequence[str] = [
            name
            for name, (field, _) in self._places.items()
            if name != TIME and types[field] not in ("string", "binary")
        ]
        self._batches = batches

    @classmethod
    def open(cls, path: Path, growing_file: Path) -> Self | None:
        """Open a result file, or the stream that becomes it; None if there is none that this process can read."""
        # As long as there is a stream, what is at `path` is of a run before.
        batches = _opened(_Stream, growing_file) if growing_file.exists() else _opened(_Groups, path)
        return cls(path, batches) if batches is not None else None

    @property
    def replaced(self) -> bool:
        """Whether the file is gone, or that of another run; a stream that has become the file is not."""
        return self._batches.replaced and not (self._batches.is_over and self.path.exists())

    @property
    def behind(self) -> int:
        """Bytes that were not read yet."""
        return self._batches.behind

    def skip(self) -> None:
        """Go on with the rows that are written from now on."""
        self._batches.skip()

    def read(self, names: Sequence[str]) -> Columns | None:
        """These columns of the next batch; None if there is no new one."""
        places, is_over = self._places, self._batches.is_over  # asked before the last batch is
        try:
            batch = self._batches.next([TIME, *dict.fromkeys(places[name][0] for name in names)])
        except (pa.ArrowException, OSError, ValueError):  # it is damaged
            batch = None
        if batch is not None:
            times, *values = [array_of(values_at(batch, places[name])) for name in (TIME, *names)]
            return Columns(times, dict(zip(names, values, strict=True)))
        if is_over and (file := _opened(_Groups, self.path)) is not None:
            file.skip()  # all of it was in the stream
            self._batches.close()
            self._batches = file
        return None

    def close(self) -> None:
        """Close the file."""
        self._batches.close()


class _Stream(GrowingFile):
    """The batches of a stream that another process writes.

    Attributes:
        schema: of the stream.
    """

    def __init__(self, path: Path, file: BinaryIO) -> None:
        super().__init__(path, file)
        self._content: Any = None
        self._at = 0
        heading = self._message()
        if heading is None:
            raise OSError(f"'{path}' has only begun")
        self.schema = pa.ipc.read_schema(heading)

    @property
    def is_over(self) -> bool:
        """Whether the run has ended: then the stream is removed."""
        return not self.path.exists()

    @property
    def behind(self) -> int:
        return os.fstat(self._file.fileno()).st_size - self._at

    def skip(self) -> None:
        while self._message() is not None:
            pass

    def next(self, columns: Sequence[str]) -> Any:  # noqa: ANN401, ARG002  pyarrow has no types; all columns are there
        message = self._message()
        if message is None:
            return None
        batch = pa.ipc.read_record_batch(message, self.schema)
        batch.validate()  # to read beyond its memory would crash
        return batch

    def _message(self) -> Any:  # noqa: ANN401  pyarrow has no types
        """The next message in the memory of the file; None if it is not complete."""
        size = os.fstat(self._file.fileno()).st_size
        if self._at >= size:
            return None
        if self._content is None or len(self._content) < size:
            self._content = pa.py_buffer(mmap.mmap(self._file.fileno(), size, access=mmap.ACCESS_READ))
        source = pa.BufferReader(self._content)
        source.seek(self._at)
        try:
            message = pa.ipc.read_message(source)
        except (EOFError, pa.ArrowException, OSError):
            return None
        self._at = source.tell()
        return message


class _Groups(GrowingFile):
    """The rows of a complete Parquet file.

    Attributes:
        schema: of the file.
    """

    is_over = False

    def __init__(self, path: Path, file: BinaryIO) -> None:
        super().__init__(path, file)
        self._content = open_parquet(self._file)
        self._group = 0
        self.schema = self._content.schema_arrow

    @property
    def behind(self) -> int:
        return 0  # the rest is read only for a new curve, and all of it

    def skip(self) -> None:
        self._group = self._content.num_row_groups

    def next(self, columns: Sequence[str]) -> Any:  # noqa: ANN401  pyarrow has no types
        if self._group == self._content.num_row_groups:
            return None
        self._group += 1
        return self._content.read_row_group(self._group - 1, columns=list(columns), use_threads=False)


_Batches = TypeVar("_Batches", _Stream, _Groups)


def _opened(kind: type[_Batches], path: Path) -> _Batches | None:
    """A file; None if there is none, or it is not complete enough to be read."""
    with ExitStack() as stack:
        try:
            opened = kind(path, stack.enter_context(path.open("rb")))
            if not places_of(opened.schema):  # or its names are no text
                return None
        except (OSError, ValueError, pa.ArrowException):
            return None
        stack.pop_all()
    return opened
