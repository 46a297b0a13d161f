"""Ways back to the first point for copies that were there before: the states of their FMUs, and some memory.

Owns the states of the first point, and how the library brings copies back to them. What a state has is
`fmu_mesh.run.system_copy`.
"""

# A way back is little work, but a copy has that memory in many places, so the time goes into the caches of the
# processor. Therefore the memory of a copy is in one piece where that can be (`HostMemory.rooms`), what is kept is
# there once for all copies that have the same (as most do), and of the outputs one row is brought back.
#
# Tried and given up, because nothing was gained: to fetch the places of the next copies ahead, to go place by place
# through all copies, and large pages.

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import FmuError
from ..rings import native
from ..rings.native import WorkKind
from .copy_threads import CopyThreads
from .system_copy import SavedCopy, SystemCopy

__all__ = ["FirstPoints"]


class FirstPoints:
    """The first points of copies.

    Call sequence, for a copy: `note` at its first point; then `restore`, and `by_python` where it is left, and after
    that it is there; `leave` where its FMUs have failed, and `free` before it is made anew. All but `restore` on the
    thread of the copy.

    Args:
        threads: of the copies.
        copies: the copies; it may get longer.
        tables: their tables, for all that there will be.
    """

    def __init__(self, threads: CopyThreads, copies: Sequence[SystemCopy], tables: Any) -> None:  # noqa: ANN401  ctypes
        self._threads, self._copies, self._tables = threads, copies, tables
        self._saved: dict[int, SavedCopy] = {}
        self._kept = b""
        self._sizes = 0, 0
        self._calls: Any = None
        self._pieces: Any = None
        self._zeros = (ctypes.c_int64 * 2)()

    def note(self, number: int) -> None:
        """A copy is at its first point: from now on, it comes back by what it has there.

        Raises:
            FmuError: an FMU cannot save its state.
        """
        copy = self._copies[number]
        saved = copy.save(0)
        if saved.kept == self._kept:
            saved = saved._replace(kept=self._kept)
        self._saved[number], self._kept = saved, saved.kept
        by_calls = copy.restored_by(saved)
        if by_calls is None or native.library is None:
            return
        calls, pieces = by_calls
        point = ctypes.addressof(self._tables[number]) + native.CopyTable.point.offset  # and the goal is beside it
        pieces = [native.Keep(point, ctypes.addressof(self._zeros), 2), *pieces]
        if self._pieces is None:
            self._sizes = len(calls), len(pieces)
            self._calls = (native.CopyCall * (len(self._tables) * len(calls)))()
            self._pieces = (native.Keep * (len(self._tables) * len(pieces)))()
        of_calls, of_pieces = self._sizes
        self._calls[number * of_calls : (number + 1) * of_calls] = calls
        self._pieces[number * of_pieces : (number + 1) * of_pieces] = pieces

    def leave(self, number: int) -> None:
        """A copy cannot come back to its first point."""
        if self._pieces is not None:
            self._pieces[number * self._sizes[1]] = native.Keep()

    def free(self, number: int) -> None:
        """Free the states of a copy, if there are any; it cannot come back then."""
        self.leave(number)
        saved = self._saved.pop(number, None)
        if saved is not None:
            self._copies[number].free(saved)

    def by_python(self, number: int) -> bool:
        """Bring a copy that has not failed back to its first point, where the library cannot; whether that worked."""
        saved = self._saved.get(number)
        if saved is None:
            return False
        try:
            self._copies[number].restore(saved)
        except FmuError:
            return False
        return True

    def restore(self, wanted: NDArray[np.bool_]) -> NDArray[np.bool_] | None:
        """Bring the ``wanted`` copies, shape (count,), back to their first points; which ones are left, if any."""
        left = wanted.copy()
        if self._pieces is None:
            return left
        is_any_left = self._threads.work(
            WorkKind.RESTORE,
            calls=ctypes.addressof(self._calls),
            calls_each=self._sizes[0],
            pieces=ctypes.addressof(self._pieces),
            pieces_each=self._sizes[1],
            wanted=left.ctypes.data,
        )
        return left if is_any_left else None
