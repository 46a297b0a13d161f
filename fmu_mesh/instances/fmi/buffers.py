"""C memory for values of one type, where a function of an FMU cannot work on the memory of a ring.

Owns the conversion between the elements of a row (numbers, `str`, `bytes`) and what a function of an FMU reads or
writes. Knows no function of FMI.
"""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from itertools import groupby
from typing import Any, Final, TypeAlias

import numpy as np
from numpy.typing import DTypeLike, NDArray

from ...rings.native import NUMBER_TYPES, Move, RowBase
from ...variables.value_types import DTYPES, VariableType

__all__ = ["BinaryBuffer", "Buffer", "NumberBuffer", "StringBuffer"]

_TYPE_IN_MOVE: Final = {
    np.dtype(DTYPES[type_]): number for type_, number in NUMBER_TYPES.items() if type_ not in ("Boolean", "Enumeration")
}
"""The types of `Move` by the C type of a number."""


class NumberBuffer:
    """Numbers whose C type differs from that of a row: a Boolean of FMI 2.0 is an `int`.

    ``signs`` are -1 for an FMI 1.0 alias with the opposite sign, otherwise 1; None if all are 1.
    """

    def __init__(
        self, type_: VariableType, dtype: DTypeLike, count: int, signs: NDArray[np.int8] | None = None
    ) -> None:
        self._memory: NDArray[Any] = np.zeros(count, dtype=dtype)
        self._type = type_
        self._is_boolean = type_ == "Boolean"
        self._signs = signs
        self.address: int = self._memory.ctypes.data
        self.size = self._memory.nbytes

    def load(self, elements: Sequence[Any] | NDArray[Any]) -> None:
        """Write numbers to the memory; `OverflowError` if the C type cannot hold one of them, or its opposite."""
        if self._is_boolean and self._signs is not None:
            self._memory[:] = np.asarray(elements, dtype=np.bool_) ^ (self._signs < 0)
            return
        self._memory[:] = elements
        if self._memory.dtype.kind == "i" and not self._is_boolean and (self._memory != elements).any():
            raise OverflowError(f"a value is out of the range of {self._memory.dtype}")
        if self._signs is not None:
            self._memory[:] = self._signed(self._memory)

    def values(self) -> NDArray[Any]:
        """The numbers in the memory; a Boolean is true for every number but 0."""
        if self._is_boolean:
            truth: NDArray[np.bool_] = self._memory != 0
            return truth if self._signs is None else truth ^ (self._signs < 0)
        return self._memory if self._signs is None else self._signed(self._memory)

    def moves(self, base: RowBase, place: int, *, load: bool) -> list[Move]:
        """What `load`, or `values`, does: as moves of the library, one for each run of elements with the same sign.

        ``place`` is that of the elements in a row, in bytes. ``load`` moves from the row to the memory, otherwise back.
        """
        made, first = [], 0
        signs = [1] * self._memory.size if self._signs is None else self._signs.tolist()
        row_item = np.dtype(DTYPES[self._type]).itemsize
        row_type, own_type = NUMBER_TYPES[self._type], _TYPE_IN_MOVE[self._memory.dtype]
        for sign, run in groupby(signs):
            count = len(list(run))
            ends = [
                (base, place + first * row_item, row_type),
                (RowBase.FIXED, self.address + first * self._memory.itemsize, own_type),
            ]
            (from_base, from_, from_type), (to_base, to, to_type) = ends if load else reversed(ends)
            move = Move(from_base, from_, to_base, to, count, from_type, to_type, negated=sign < 0, factor=1.0)
            made.append(move)
            first += count
        return made

    def _signed(self, numbers: NDArray[Any]) -> NDArray[Any]:
        assert self._signs is not None
        if numbers.dtype.kind == "i" and np.any(numbers[self._signs < 0] == np.iinfo(numbers.dtype).min):
            raise OverflowError(f"{np.iinfo(numbers.dtype).min} has no opposite in its type")
        signed: NDArray[Any] = np.where(self._signs < 0, -numbers, numbers)
        return signed


class StringBuffer:
    """Pointers to null-terminated text in UTF-8; invalid bytes from an FMU become U+FFFD."""

    def __init__(self, count: int) -> None:
        self._pointers = (ctypes.c_char_p * count)()
        self.address: int = ctypes.addressof(self._pointers)

    def load(self, elements: Sequence[Any] | NDArray[Any]) -> None:
        """Point at copies of the texts; they live as long as this memory does."""
        for place, text in enumerate(elements):
            self._pointers[place] = text.encode()

    def values(self) -> Sequence[str]:
        """The texts; a missing one is empty."""
        return [(text or b"").decode(errors="replace") for text in self._pointers]


class BinaryBuffer:
    """Pointers to bytes, and their sizes (FMI 3.0, 2.2.6.2)."""

    def __init__(self, count: int) -> None:
        self._pointers = (ctypes.c_void_p * count)()
        self._sizes = (ctypes.c_size_t * count)()
        self._loaded: list[ctypes.Array[ctypes.c_char]] = []
        self.address: int = ctypes.addressof(self._pointers)
        self.sizes_address: int = ctypes.addressof(self._sizes)

    def load(self, elements: Sequence[Any] | NDArray[Any]) -> None:
        """Point at copies of the bytes; they live as long as this memory does."""
        self._loaded = [ctypes.create_string_buffer(data, max(len(data), 1)) for data in elements]
        self._pointers[:] = [ctypes.addressof(data) for data in self._loaded]
        self._sizes[:] = [len(data) for data in elements]

    def values(self) -> Sequence[bytes]:
        """The bytes; what has no address is empty."""
        pairs = zip(self._pointers, self._sizes, strict=True)
        return [ctypes.string_at(pointer, size) if pointer and size else b"" for pointer, size in pairs]


Buffer: TypeAlias = NumberBuffer | StringBuffer | BinaryBuffer
"""Memory for a fixed number of elements, from `address` on: `load`, then a setter; or a getter, then `values`.

Text is copied by `values`, because the FMU may free it in its next call.
"""
