"""Results as arrays in a file of this host: what `record="memory"` writes in one process and reads in another.

The file is a sequence of blocks, each with the rows of one `write`. It lasts only as long as its run, so its format may
change with every version.
"""

from __future__ import annotations

import os
import struct
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, Self

import msgspec
import numpy as np
from numpy.typing import NDArray

from ..files import Kept
from .recording import Recording
from ..variables.value_types import DTYPES, VariableType, is_text
from .block_file import BlockFile

__all__ = ["ENDING", "ArraysFile", "bytes_of_a_row", "read_arrays"]

ENDING = ".arrays"

_HEAD = struct.Struct("<qq")
"""Number of bytes that follow, and number of rows in them."""


def bytes_of_a_row(types: Sequence[VariableType]) -> int:
    """The size of a row in bytes, time included; texts are not counted, as their size is not known."""
    return 8 + sum(np.dtype(DTYPES[type_]).itemsize for type_ in types if not is_text(type_))


def read_arrays(path: Path, types: Sequence[VariableType]) -> tuple[NDArray[np.float64], list[NDArray[Any]]]:
    """Read a file of this module.

    Args:
        path: the file; if it does not exist there are no rows.
        types: the types of the columns.

    Returns:
        The times in s, shape `(rows,)`, and an array of the same shape for each column.
    """
    all_types: tuple[VariableType, ...] = ("Float64", *types)
    columns: list[list[NDArray[Any]]] = [[np.zeros(0, DTYPES[type_])] for type_ in all_types]
    for _, _, block in _blocks(path) if path.exists() else ():
        for column, part, type_ in zip(columns, msgspec.msgpack.decode(block), all_types, strict=True):
            column.append(np.array(part, object) if is_text(type_) else np.frombuffer(part, DTYPES[type_]))
    times, *others = (np.concatenate(column) for column in columns)
    return times, others


class ArraysFile(BlockFile):
    """Writes rows of results as blocks of arrays.

    Args:
        path: the file.
        types: the types of the columns but `time`.
    """

    def __init__(self, path: Path, types: Sequence[VariableType]) -> None:
        super().__init__(path, 1 + len(types))

    @classmethod
    def open(cls, path: Path, recording: Recording) -> Self:
        """Open a file for what a run records."""
        return cls(path, [type_ for _, type_ in recording.columns])

    @staticmethod
    def keep_whole_rows(path: Path, kept: Kept) -> int:  # noqa: ARG004  the blocks are found from the first one on
        """Cut a file off after its last whole block; returns the number of its rows."""
        blocks = [(0, 0, memoryview(b"")), *_blocks(path)]
        os.truncate(path, blocks[-1][0])
        return sum(rows for _, rows, _ in blocks)

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
