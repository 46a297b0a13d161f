"""Results as arrays in a file of this host: what `record="memory"` writes in one process and reads in another.

The file is a sequence of blocks, each with the rows of one `write`. It lasts only as long as its run, so its format may
change with every version.
"""

from __future__ import annotations

import os
import struct
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Self

import msgspec
import numpy as np
from numpy.typing import NDArray

from ..files import Kept
from ..variables.value_types import DTYPES, VariableType, is_text
from .block_file import BlockFile
from .recording import Columns, Recording, Tail

__all__ = ["ArraysFile", "bytes_of_a_row"]

_HEAD = struct.Struct("<qq")
"""Number of bytes that follow, and number of rows in them."""


def bytes_of_a_row(types: Iterable[VariableType]) -> int:
    """The size of a row in bytes, time included; texts are not counted, as their size is not known."""
    return 8 + sum(np.dtype(DTYPES[type_]).itemsize for type_ in types if not is_text(type_))


class ArraysFile(BlockFile):
    """Writes rows of results as blocks of arrays."""

    @classmethod
    def open(cls, path: Path, recording: Recording) -> Self:
        """Open a file for what a run records."""
        return cls(path, 1 + len(recording.recorded))

    @staticmethod
    def keep_whole_rows(path: Path, kept: Kept) -> int:  # noqa: ARG004  the blocks are found from the first one on
        """Cut a file off after its last whole block; returns the number of its rows."""
        blocks = [(0, 0, memoryview(b"")), *_blocks(path)]
        os.truncate(path, blocks[-1][0])
        return sum(rows for _, rows, _ in blocks)

    @staticmethod
    def pieces(path: Path, types: Mapping[str, VariableType]) -> Iterator[Columns]:
        """The rows of each block; there are none if the file does not exist. ``types`` are those of all columns."""
        yield Columns(np.zeros(0), {name: np.zeros(0, DTYPES[type_]) for name, type_ in types.items()})
        for _, _, block in _blocks(path) if path.exists() else ():
            times, *columns = msgspec.msgpack.decode(block)
            values = {
                name: np.array(part, object) if is_text(type_) else np.frombuffer(part, DTYPES[type_])
                for (name, type_), part in zip(types.items(), columns, strict=True)
            }
            yield Columns(np.frombuffer(times, np.float64), values)

    @staticmethod
    def follow(path: Path) -> Tail | None:  # noqa: ARG004  who has the file knows no types, and no page has the file
        """There is nothing to follow."""
        return None

    def _block(self, columns: Sequence[NDArray[Any]]) -> bytes:
        block = msgspec.msgpack.encode(
            [column.tolist() if column.dtype == object else column.tobytes() for column in columns]
        )
        return _HEAD.pack(len(block), len(columns[0])) + block


def _blocks(path: Path) -> Iterator[tuple[int, int, memoryview]]:
    """The end, the number of rows and the bytes of each whole block: the writer may have been killed within one."""
    data, end = memoryview(path.read_bytes()), 0
    while (start := end + _HEAD.size) <= len(data):
        size, rows = _HEAD.unpack_from(data, end)
        end = start + size
        if end > len(data):
            return
        yield end, rows, data[start:end]
