"""Ways back to the first point for copies that were there before: the states of their FMUs, and some memory.

Owns the states of the first point, and how the library brings copies back to them. What a state has is
`fmu_mesh.run.system_copy`.
"""

# A way back is little work, but a copy has that memory in many places, so the time goes into the caches of the
# processor. Therefore the memory of a copy is in one piece where that can be (`HostMemory.rooms`), what is kept is
# there once for all copies that have the same (as most do), sizes are there once for all copies, and of the outputs
# one row is brought back. What is left are some five cache lines of each copy, beside those of its FMU, that the
# library writes; a program in C that does nothing but set states writes none of them.
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
        self._calls: Any = None
        self._pieces: Any = None
        self._places: NDArray[np.int64] | None = None
        self._places_at = 0

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
        calls, pieces, places = by_calls
        if self._places is None:
            self._pieces = native.table(native.Keep, pieces)
            self._calls = (native.CopyCall * (len(self._tables) * len(calls)))()
            self._places = np.zeros((len(self._tables), 1 + len(pieces)), np.int64)
            self._places_at = self._places.ctypes.data
        self._calls[number * len(calls) : (number + 1) * len(calls)] = calls
        kept = ctypes.cast(ctypes.c_char_p(saved.kept), ctypes.c_void_p).value
        self._places[number] = kept or 0, *places

    def leave(self, number: int) -> None:
        """A copy cannot come back to its first point."""
        if self._places is not None:
            self._places[number, 0] = 0

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
        if self._places is None:
            return left
        is_any_left = self._threads.work(
            WorkKind.RESTORE,
            calls=ctypes.addressof(self._calls),
            calls_each=len(self._calls) // len(self._tables),
            pieces=ctypes.addressof(self._pieces),
            places=self._places_at,
            pieces_each=self._places.shape[1] - 1,
            wanted=left.ctypes.data,
        )
        return left if is_any_left else None
