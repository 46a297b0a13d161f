"""Feeds curves from the result file of a run: new rows as they come, and for a new curve the older ones.

Only reads, in pieces. The run neither knows nor waits.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Final, Protocol

import numpy as np
from numpy.typing import NDArray

from ..results.csv_tail import CsvTail
from ..results.recording import result_format
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
        from ..results.parquet_tail import ParquetTail  # noqa: PLC0415  pyarrow is optional
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
        self._new: _Reader | None = None
        self._old: _Reader | None = None
        self._filling: dict[str, BoundedCurve] = {}
        self._filled: dict[str, BoundedCurve] = {}

    @property
    def names(self) -> Sequence[str]:
        """The variables in the file."""
        return self._new.tail.names if self._new is not None else ()

    def read(self, held: Callable[[], Mapping[str, BoundedCurve]], forget: Callable[[], None]) -> None:
        """Read some megabytes, so that this returns soon.

        Args:
            held: gives the curves.
            forget: called when the file is another one than before.
        """
        if self._new is not None and self._new.tail.replaced:
            self.close()
            forget()
        if self._new is None:
            if self._path is None or (new := open_tail(self._path)) is None:
                return
            self._new = _Reader(new)
            self._new.skip()
        curves = {name: curve for name, curve in held().items() if name in self.names}
        if self._new.tail.behind > _FAR_BEHIND or not curves:
            self._new.skip()
        if not curves:
            return
        self._new.feed(curves)
        added = {name: curve for name, curve in curves.items() if self._filled.get(name) is not curve}
        if added and self._old is None and (old := open_tail(self._new.tail.path)) is not None:
            self._old, self._filling = _Reader(old), added
            self._filled = {name: curve for name, curve in self._filled.items() if name in curves} | added
        if self._old is not None and self._old.feed(self._filling, _OLD_PIECES):
            if self._new.after is None:  # it has skipped a part of a row, which this one goes on with
                self._old, self._new = self._new, self._old
            self._old.tail.close()
            self._old = None

    @property
    def replaced(self) -> bool:
        """Whether another file has its name by now."""
        return self._new is None or self._new.tail.replaced

    def read_all(self, held: Callable[[], Mapping[str, BoundedCurve]]) -> None:
        """Read to the end of a file that nobody writes any more."""
        self.read(held, lambda: None)
        if self._new is not None:
            while not self._new.feed({n: c for n, c in held().items() if n in self.names}):
                pass
        while self._old is not None and not self._old.feed(self._filling):
            pass

    def close(self) -> None:
        """Close the files."""
        for reader in (self._new, self._old):
            if reader is not None:
                reader.tail.close()
        self._new = self._old = None
        self._filled = {}


class _Reader:
    """Feeds curves with the rows of one tail.

    Attributes:
        tail: the rows.
        after: the time of the row that was read last in s; None at the start, and after rows that were left out.
    """

    def __init__(self, tail: Tail) -> None:
        self.tail = tail
        self.after: float | None = None

    def skip(self) -> None:
        """Leave out the rows that are there."""
        self.tail.skip()
        self.after = None

    def feed(self, curves: Mapping[str, BoundedCurve], pieces: int = _PIECES) -> bool:
        """Add some rows to curves; True at the end of the file."""
        for _ in range(pieces):
            rows = self.tail.read(list(curves))
            if rows is None:
                return True
            times, values = rows
            for curve, column in zip(curves.values(), values, strict=True):
                curve.add(times, column, self.after)
            if len(times):
                self.after = float(times[-1])
        return False
