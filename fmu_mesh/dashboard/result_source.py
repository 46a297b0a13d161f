"""Feeds curves from the result file of a run: new rows as they come, and for a new curve the older ones.

Only reads, in pieces. The run neither knows nor waits.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from ..results.formats import followed
from ..results.recording import Tail
from .curve import BoundedCurve

__all__ = ["ResultSource"]

_PIECES: Final = 8
_OLD_PIECES: Final = 2
"""Of older rows fewer are read at once, so that new ones are not late."""
_FAR_BEHIND: Final = 64 << 20
"""Bytes of a result file that the dashboard reads late; beyond it, it leaves rows out."""


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
        """Read some megabytes into the curves, to return soon; ``forget`` them if the file is another one."""
        if self._new is not None and self._new.tail.replaced:
            self.close()
            forget()
        if self._new is None:
            if self._path is None or (new := followed(self._path)) is None:
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
        if added and self._old is None and (old := followed(self._new.tail.path)) is not None:
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
    """Feeds curves with the rows of one tail; ``after`` is the time of the last one in s, None if some are left out."""

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
            for name, curve in curves.items():
                curve.add(rows.times, as_floats(rows.values[name]), self.after)
            if len(rows.times):
                self.after = float(rows.times[-1])
        return False


def as_floats(values: NDArray[Any]) -> NDArray[np.float64]:
    """Values of any type as floats: a truth value as 0 or 1, and what is no number as NaN."""
    if values.dtype != object:
        return values.astype(np.float64)
    return np.array([value if isinstance(value, int | float) else np.nan for value in values], np.float64)
