"""Rings: preallocated rows that hold values between an instance, a frame and another instance.

Row ``n`` is in slot ``n & mask``. This module owns the memory; it knows neither FMI nor Zenoh.
"""

from __future__ import annotations

import mmap
import sys
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..system.layout import Layout, Place, row_offsets
from ..variables.value_types import DTYPES, Value, VariableType, flattened, is_text, nested, zero

__all__ = ["Ring", "Rows"]

_LARGE_BYTES = 1 << 20

Rows = tuple[NDArray[Any], ...]
"""Consecutive rows: one array of shape (rows, elements) for each part of a layout."""


class Ring:
    """A ring of rows in one piece of memory: a row has a stamp, and then its numbers by type; text is beside it.

    Example:
        >>> ring = Ring(Layout.of([("y", "Float64")]), rows=4)
        >>> ring.put(5, "y", 0.5)
        >>> ring.value(5, "y"), ring.value(1, "y")  # rows 5 and 1 share a slot
        (0.5, 0.5)

    Args:
        rows: how many rows; a power of two.
        memory: as many bytes as the rows have, such as shared memory; None: memory of its own.

    Attributes:
        parts: arrays of shape (rows, elements), in the order of ``layout.parts``; text as Python objects.
        stamps: an array with the stamp of each row.
        offsets: the place of each part in a row, in bytes.
        stride: distance of two rows in bytes.
        mask: ``rows - 1``; the slot of row ``n`` is ``n & mask``.
    """

    def __init__(self, layout: Layout, rows: int, memory: memoryview | None = None) -> None:
        if rows < 1 or rows & (rows - 1):
            msg = f"a ring has a power of two of rows, not {rows}"
            raise ValueError(msg)
        self.layout = layout
        self.rows = rows
        self.mask = rows - 1
        *self.offsets, self.stride = row_offsets(layout)
        self._types = tuple(part.type for part in layout.parts)
        self._places: dict[str, Place] = {}
        size = rows * self.stride
        if memory is None and size >= _LARGE_BYTES:  # malloc would keep what was freed, and clear it for the next ring
            memory = memoryview(mmap.mmap(-1, size, mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS))
        flat = np.frombuffer(memory, np.uint8) if memory is not None else np.zeros(size, np.uint8)
        self.address = int(flat.ctypes.data)
        self._flat = flat
        self.stamps = self._array(np.dtype(np.int64), 0, 1)[:, 0]
        self.parts: Rows = tuple(
            np.full((rows, part.width), zero(part.type), dtype=DTYPES[part.type])
            if is_text(part.type)
            else self._array(np.dtype(DTYPES[part.type]), offset, part.width)
            for part, offset in zip(layout.parts, self.offsets, strict=True)
        )

    def _array(self, dtype: np.dtype[Any], offset: int, width: int) -> NDArray[Any]:
        """The elements of one type: those of a row are neighbours, and the rows are ``stride`` bytes apart."""
        shape, strides = (self.rows, width), (self.stride, dtype.itemsize)
        return np.ndarray(shape, dtype, self._flat.data, offset, strides)

    def clear(self) -> None:
        """Make all rows as they were at first."""
        self.stamps[:] = 0
        for part, array in zip(self.layout.parts, self.parts, strict=True):
            array[...] = zero(part.type)

    def place_in_row(self, part: int, element: int) -> int:
        """Where an element of a part lies in a row, in bytes."""
        return self.offsets[part] + element * self.parts[part].itemsize

    def stamp(self, row: int) -> None:
        """Mark a row as complete."""
        self.stamps[row & self.mask] = row + 1

    def has_row(self, row: int) -> bool:
        """Whether a row is complete, and has not been overwritten."""
        return bool(self.stamps[row & self.mask] == row + 1)

    def pieces(self, first: int, end: int, most: int = sys.maxsize) -> Iterator[tuple[int, slice]]:
        """The slots of rows ``first .. end - 1``, with the first row of each piece: ``most`` rows, neighbours."""
        while first < end:
            slot = first & self.mask
            size = min(end - first, self.rows - slot, most)
            yield first, slice(slot, slot + size)
            first += size

    def memory(self, slots: slice) -> memoryview:
        """The bytes of the rows in neighbouring slots, each with its stamp; without text."""
        return self._flat.data[slots.start * self.stride : slots.stop * self.stride]

    def part(self, type_: VariableType) -> NDArray[Any]:
        """The array of one type, of shape (rows, elements); it has no elements if no column has this type."""
        if type_ in self._types:
            return self.parts[self._types.index(type_)]
        return np.zeros((self.rows, 0), dtype=DTYPES[type_])

    def floats(self, type_: VariableType) -> memoryview:
        """The memory of all rows as numbers of a float type."""
        return memoryview(self._flat.view(DTYPES[type_]).data)

    def array(self, name: str) -> NDArray[Any]:
        """The elements of a column in all slots, of shape (rows, *shape)."""
        part, first, size, shape = self._place(name)
        return self.parts[part][:, first : first + size].reshape(self.rows, *shape)

    def value(self, row: int, name: str) -> Value:
        """The value of a column of ``row``, or of one element of it, as a Python object."""
        part, first, size, shape = self._place(name)
        if not shape:
            element: Value = self.parts[part].item(row & self.mask, first)
            return element
        return nested(self.parts[part][row & self.mask, first : first + size].tolist(), shape)

    def put(self, row: int, name: str, value: Value | NDArray[Any]) -> None:
        """Write a value that the type can hold to a column of ``row``, or to one element of it; an array also of numpy.

        A value beyond the range of a Float32 becomes infinite, as in C.
        """
        part, first, size, shape = self._place(name)
        array, slot = self.parts[part], row & self.mask
        if not shape and array.dtype != np.float32:
            array[slot, first] = value
            return
        elements = value.reshape(-1) if isinstance(value, np.ndarray) else flattened(value, len(shape))
        with np.errstate(over="ignore"):
            array[slot, first : first + size] = np.asarray(elements, array.dtype)

    def reader(self, name: str) -> Callable[[int], Value]:
        """`value` of one column as a function of the row: the fast way for a caller that reads it at every point.

        Of an array it is a view of the row, which a later row overwrites.
        """
        part, first, _, shape = self._place(name)
        mask, width, start = self.mask, *self._in_numbers(part)
        if shape:
            array: Any = self.array(name)
            return lambda row: array[row & mask]
        if self._types[part] != "Float64":
            return lambda row: self.value(row, name)
        first += start
        memory: Any = self._flat.view(np.float64).data  # a memory view: it takes half the time of an array
        return lambda row: memory[(row & mask) * width + first]

    def writer(self, name: str) -> Callable[[int, Value], None]:
        """`put` of one column as a function of row and value: the fast way for a caller that writes at every point."""
        part, first, _, shape = self._place(name)
        mask, width, start = self.mask, *self._in_numbers(part)
        if self._types[part] in ("Float32", "String", "Binary") or (self._types[part] != "Float64" and not shape):
            return lambda row, value: self.put(row, name, value)
        first += start
        memory: Any = self._flat.view(np.float64).data if not shape else self.array(name)

        def write(row: int, value: Value) -> None:
            memory[(row & mask) * width + first] = value

        def write_array(row: int, value: Value) -> None:
            memory[row & mask] = value

        return write_array if shape else write

    def _in_numbers(self, part: int) -> tuple[int, int]:
        """The distance of two rows, and the place of a part in a row, in numbers of eight bytes."""
        return self.stride // 8, self.offsets[part] // 8

    def _place(self, name: str) -> Place:
        if name not in self._places:
            self._places[name] = self.layout.place(name)
        return self._places[name]
