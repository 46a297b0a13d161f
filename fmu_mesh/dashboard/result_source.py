"""Feeds curves from the result file of a run: new rows as they come, and for a new curve the older ones.

Only reads, in pieces. The run neither knows nor waits.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Final, Protocol

import numpy as np
from numpy.typing import NDArray

from ..system.recording import result_format
from .csv_tail import CsvTail
from .curve import BoundedCurve

__all__ = ["ResultSource"]

_PIECES: Final = 8
_OLD_PIECES: Final = 2
"""Of older rows fewer are read at once, so that new ones are not late."""
_FAR_BEHIND: Final = 64 << 20
"""Bytes of a result file that the dashboard reads late; beyond it, it leaves rows out."""


class Tail(Protocol):
    """The rows of a result file in pieces, while it grows and afterwards.

    Attributes:
        path: the result file.
        names: the columns without `time`.
    """

    path: Path
    names: Sequence[str]

    @property
    def replaced(self) -> bool:
        """Whether the file is gone, or that of another run."""
        ...

    @property
    def behind(self) -> int:
        """Bytes of the file that were not read yet."""
        ...

    def skip(self) -> None:
        """Go on with the rows that are written from now on."""
        ...

    def read(self, columns: Sequence[str]) -> tuple[NDArray[np.float64], NDArray[np.float64]] | None:
        """The next rows, a few megabytes of them; None if there is no new one.

        Returns:
            The times in s, shape `(rows,)`, and the values, shape `(columns, rows)`. What is no number is NaN.
        """
        ...

    def close(self) -> None:
        """Close the file."""
        ...


def open_tail(path: Path) -> Tail | None:
    """Open a result file; None if there is none, or in a format that cannot be read while it grows."""
    if path.suffix == ".csv":
        return CsvTail.open(path)
    try:
        from .parquet_tail import ParquetTail  # noqa: PLC0415  pyarrow is optional
    except ImportError:
        return None
    found = result_format(path) if path.suffix == ".parquet" else None
    return ParquetTail.open(path, found.growing_file(path)) if found is not None else None


class ResultSource:
    """Feeds curves from a result file: new rows as they come, and for a new curve the older ones, piece by piece.

    Args:
        path: the file; None: there is none that can be read here.
    """

    def __init__(self, path: Path | None) -> None:
        self._path = path
        self._new: Tail | None = None
        self._old: Tail | None = None
        self._filling: dict[str, BoundedCurve] = {}
        self._filled: dict[str, BoundedCurve] = {}

    @property
    def names(self) -> Sequence[str]:
        """The variables in the file."""
        return self._new.names if self._new is not None else ()

    def read(self, held: Callable[[], Mapping[str, BoundedCurve]], forget: Callable[[], None]) -> None:
        """Read some megabytes, so that this returns soon.

        Args:
            held: gives the curves.
            forget: called when the file is another one than before.
        """
        if self._new is not None and self._new.replaced:
            self.close()
            forget()
        if self._new is None:
            if self._path is None or (new := open_tail(self._path)) is None:
                return
            self._new = new
            new.skip()
        curves = {name: curve for name, curve in held().items() if name in self._new.names}
        if self._new.behind > _FAR_BEHIND or not curves:
            self._new.skip()
        _feed(self._new, curves)
        added = {name: curve for name, curve in curves.items() if self._filled.get(name) is not curve}
        if added and self._old is None and (old := open_tail(self._new.path)) is not None:
            self._old, self._filling = old, added
            self._filled = {name: curve for name, curve in self._filled.items() if name in curves} | added
        if self._old is not None and _feed(self._old, self._filling, _OLD_PIECES):
            self._old.close()
            self._old = None

    @property
    def replaced(self) -> bool:
        """Whether another file has its name by now."""
        return self._new is None or self._new.replaced

    def read_all(self, held: Callable[[], Mapping[str, BoundedCurve]]) -> None:
        """Read to the end of a file that nobody writes any more."""
        self.read(held, lambda: None)
        if self._new is not None:
            while not _feed(self._new, {n: c for n, c in held().items() if n in self._new.names}):
                pass
        while self._old is not None and not _feed(self._old, self._filling):
            pass

    def close(self) -> None:
        """Close the files."""
        for tail in (self._new, self._old):
            if tail is not None:
                tail.close()
        self._new = self._old = None
        self._filled = {}


def _feed(tail: Tail, curves: Mapping[str, BoundedCurve], pieces: int = _PIECES) -> bool:
    """Add some rows to curves; True at the end of the file."""
    for _ in range(pieces):
        rows = tail.read(list(curves))
        if rows is None:
            return True
        times, values = rows
        for curve, column in zip(curves.values(), values, strict=True):
            curve.add(times, column)
    return False
