"""The result CSV: first column `time`, then `<instance>.<variable>`, floats written shortest-round-trip.

A float is written with as few digits as read back to the same bits; Boolean as `true` or `false`; String as quoted
text; Binary as base64.
"""

from __future__ import annotations

import base64
import csv
import io
import math
from collections.abc import Sequence
from itertools import chain
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
import orjson
from numpy.typing import NDArray

from ..files import open_alone
from ..model.types import Value, VariableType, is_text
from .lines import in_lines, prepare

__all__ = ["CsvFile"]

_CHUNK_NUMBERS = 4096
"""What is formatted at once: more would not stay in the cache, and its memory would come from the system each time."""


class CsvFile:
    """Writes rows of results.

    Args:
        path: the file; its folder is made, an older file is replaced.
        columns: (name, type) of every column but `time`.

    Raises:
        ConfigurationError: the file cannot be written, or another run writes into it.
    """

    def __init__(self, path: Path, columns: Sequence[tuple[str, VariableType]]) -> None:
        self.path = path
        self.rows = 0
        self._has_text = any(is_text(type_) for _, type_ in columns)
        self._is_float = all(type_ == "Float64" for _, type_ in columns)
        self._chunk_rows = max(1, _CHUNK_NUMBERS // (1 + len(columns)))
        if not self._has_text:
            prepare()
        self._file = open_alone(path)
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
        """Append one row per time; ``columns`` are arrays of the same length, of their types' dtypes."""
        for first in range(0, len(times), self._chunk_rows):
            part = slice(first, first + self._chunk_rows)
            chunk = [times[part], *(column[part] for column in columns)]
            self._file.write(self._format(chunk))
        self.rows += len(times)

    def flush(self) -> None:
        """Hand everything to the operating system, so that it survives the end of this process."""
        self._file.flush()

    def close(self) -> None:
        """Write what is left and close the file."""
        self._file.close()

    def _format(self, columns: Sequence[NDArray[Any]]) -> bytes | memoryview:
        # JSON's numbers are shortest-round-trip, too, and orjson writes those of an array without a Python object each.
        if self._is_float:
            values = np.stack(columns, axis=1)
            if np.isfinite(values).all():
                return in_lines(orjson.dumps(values.ravel(), option=orjson.OPT_SERIALIZE_NUMPY), len(columns))
        rows = zip(*(column.tolist() for column in columns), strict=True)
        if self._has_text or not all(np.isfinite(column).all() for column in columns):
            return "".join(",".join(map(_text, row)) + "\n" for row in rows).encode()
        return in_lines(orjson.dumps(list(chain.from_iterable(rows))), len(columns))


def _text(value: Value) -> str:
    """One value where JSON has no word for it: `nan`, `inf`, `-inf`, text; all others as JSON has them."""
    match value:
        case str():
            return '"' + value.replace('"', '""') + '"'
        case bytes():
            return base64.b64encode(value).decode()
        case float() if not math.isfinite(value):
            return repr(value)
        case _:
            return orjson.dumps(value).decode()
