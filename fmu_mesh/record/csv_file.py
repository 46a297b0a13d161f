"""The result CSV: first column `time`, then `<instance>.<variable>`, floats written shortest-round-trip.

A float is written with as few digits as read back to the same bits; Boolean as `true` or `false`.
"""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import msgspec
import numpy as np
from numpy.typing import NDArray

from ..errors import ConfigurationError
from ..model.description import VariableType

__all__ = ["CsvFile"]

_CHUNK_ROWS = 512


class CsvFile:
    """Writes rows of results.

    Args:
        path: the file; its folder is made, an older file is replaced.
        columns: (name, type) of every column but `time`.

    Raises:
        ConfigurationError: the file cannot be written.
    """

    def __init__(self, path: Path, columns: Sequence[tuple[str, VariableType]]) -> None:
        self.path = path
        self.rows = 0
        self._booleans = [index for index, (_, type_) in enumerate(columns) if type_ == "Boolean"]
        self._encode = msgspec.json.Encoder().encode_lines
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._file = path.open("wb", buffering=1 << 16)
        except OSError as error:
            raise ConfigurationError(f"the result file '{path}' cannot be written: {error.strerror}") from error
        header = io.StringIO()
        csv.writer(header, lineterminator="\n").writerow(["time", *(name for name, _ in columns)])
        self._file.write(header.getvalue().encode())

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def write(self, times: NDArray[np.float64], columns: Sequence[NDArray[Any]]) -> None:
        """Append one row per time; ``columns`` are arrays of the same length, float64 or int32."""
        for first in range(0, len(times), _CHUNK_ROWS):
            part = slice(first, first + _CHUNK_ROWS)
            chunk = [times[part], *(column[part] for column in columns)]
            self._file.write(self._format(chunk))
        self.rows += len(times)

    def flush(self) -> None:
        """Hand everything to the operating system, so that it survives the end of this process."""
        self._file.flush()

    def close(self) -> None:
        """Write what is left and close the file."""
        self._file.close()

    def _format(self, columns: Sequence[NDArray[Any]]) -> bytes:
        finite = all(np.isfinite(column).all() for column in columns)
        lists = [column.tolist() for column in columns]
        for index in self._booleans:
            lists[index + 1] = [bool(value) for value in lists[index + 1]]
        rows = zip(*lists, strict=True)
        if not finite:
            return "".join(",".join(map(_text, row)) + "\n" for row in rows).encode()
        # JSON numbers are shortest-round-trip, too, and msgspec writes a hundred times faster than `repr`.
        return self._encode(list(rows)).translate(None, b"[]")


def _text(value: float) -> str:
    """One value where JSON has no word for it: `nan`, `inf` and `-inf`; all others as JSON has them."""
    if not math.isfinite(value):
        return repr(value)
    return msgspec.json.encode(value).decode()
