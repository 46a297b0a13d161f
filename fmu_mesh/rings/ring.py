"""Rings: the preallocated rows in which values wait between an FMU, a frame and an FMU.

A row holds the values of one instance at one of its own steps; row ``n`` lives in slot ``n & mask``. Owns the memory
layout and nothing else: no FMI, no Zenoh.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from ..variables.model_description import Variable
from ..variables.value_types import (
    DTYPES,
    TYPES,
    Value,
    VariableType,
    element_names,
    flattened,
    is_text,
    nested,
    split_element,
    zero,
)

__all__ = ["Column", "Layout", "Part", "Place", "Ring", "Rows", "rows_for"]

Rows = tuple[NDArray[Any], ...]
"""Consecutive rows: one array of shape (rows, elements) for each part of a layout."""

_TEXT_BYTES = 64
"""What a String or Binary is taken for where memory and frames are planned, if it does not say how long it can be."""


class Column(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One variable in a row; an array takes as many neighbouring elements as it has, row by row."""

    name: str
    type: VariableType
    shape: tuple[int, ...] = ()
    max_size: int | None = None

    @property
    def size(self) -> int:
        """How many elements it has."""
        return math.prod(self.shape)

    @property
    def elements(self) -> tuple[str, ...]:
        """The names of its elements, as `y[1,2]`; of a scalar, its own name."""
        return element_names(self.name, self.shape)


class Part(NamedTuple):
    """The columns of one type, which lie in one array.

    Attributes:
        width: how many elements they have together.
    """

    type: VariableType
    columns: tuple[Column, ...]
    width: int


class Place(NamedTuple):
    """Where a variable, or one element of an array, lies in a row: elements ``first .. first + size - 1`` of a part."""

    part: int
    first: int
    size: int
    shape: tuple[int, ...]


class Layout(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The columns of a row, those of each type together: first Float64, then the others in the order of `TYPES`.

    Make it by `of`, which puts the columns in that order.
    """

    columns: tuple[Column, ...] = ()

    @classmethod
    def of(
        cls, columns: Iterable[tuple[str, VariableType] | tuple[str, VariableType, tuple[int, ...]] | Variable]
    ) -> Layout:
        """The layout that holds these variables, or (name, type) or (name, type, shape), in their order per type."""
        made = [Column(c.name, c.type, c.shape, c.max_size) if isinstance(c, Variable) else Column(*c) for c in columns]
        return cls(tuple(sorted(made, key=lambda column: TYPES.index(column.type))))

    @property
    def names(self) -> tuple[str, ...]:
        """All column names, Float64 ones first."""
        return tuple(column.name for column in self.columns)

    @property
    def row_size(self) -> int:
        """Size of one row in bytes when packed; for String and Binary an estimate."""
        return sum(
            column.size * (column.max_size or _TEXT_BYTES if is_text(column.type) else _itemsize(column.type))
            for column in self.columns
        )

    @property
    def parts(self) -> tuple[Part, ...]:
        """The parts that have columns, in the order in which they lie in memory and in a frame."""
        by_type: dict[VariableType, list[Column]] = {}
        for column in self.columns:
            by_type.setdefault(column.type, []).append(column)
        return tuple(Part(type_, tuple(own), sum(c.size for c in own)) for type_, own in by_type.items())

    def column(self, name: str) -> Column:
        """The column of a variable, or of the array that ``name`` is an element of.

        Raises:
            KeyError: there is none.
        """
        by_name = {column.name: column for column in self.columns}
        if name not in by_name and (parts := split_element(name)) is not None:
            return by_name[parts[0]]
        return by_name[name]

    def place(self, name: str) -> Place:
        """Where a variable lies, or an element of an array such as `y[2]`; a variable of that very name comes first.

        Raises:
            KeyError: there is no such column.
        """
        wanted = self.column(name)
        for number, part in enumerate(self.parts):
            first = 0
            for column in part.columns:
                if column == wanted:
                    if name == column.name:
                        return Place(number, first, column.size, column.shape)
                    _, index = split_element(name) or ("", ())
                    return Place(number, first + int(np.ravel_multi_index(index, column.shape)), 1, ())
                first += column.size
        raise KeyError(name)


class Ring:
    """A ring of rows, with one preallocated array for each part of its layout.

    Args:
        layout: the columns.
        rows: how many rows; a power of two.

    Attributes:
        parts: arrays of shape (rows, elements), in the order of ``layout.parts``; text as Python objects.
        mask: ``rows - 1``; the slot of row ``n`` is ``n & mask``.
    """

    def __init__(self, layout: Layout, rows: int) -> None:
        if rows < 1 or rows & (rows - 1):
            msg = f"a ring has a power of two of rows, not {rows}"
            raise ValueError(msg)
        self.layout = layout
        self.rows = rows
        self.mask = rows - 1
        self._types = tuple(part.type for part in layout.parts)
        self._places: dict[str, Place] = {}
        self.parts: Rows = tuple(
            np.full((rows, part.width), zero(part.type), dtype=DTYPES[part.type]) for part in layout.parts
        )

    def part(self, type_: VariableType) -> NDArray[Any]:
        """The array of one type, of shape (rows, elements); without elements if no column has it."""
        if type_ in self._types:
            return self.parts[self._types.index(type_)]
        return np.zeros((self.rows, 0), dtype=DTYPES[type_])

    def value(self, row: int, name: str) -> Value:
        """The value of a column of ``row``, or of an element of it, as Python has it."""
        part, first, size, shape = self._place(name)
        if not shape:
            element: Value = self.parts[part].item(row & self.mask, first)
            return element
        return nested(self.parts[part][row & self.mask, first : first + size].tolist(), shape)

    def put(self, row: int, name: str, value: Value) -> None:
        """Give a column of ``row``, or an element of it, a value that its type can hold.

        What is beyond the range of a Float32 becomes an infinity, as in C.
        """
        part, first, _, shape = self._place(name)
        array, slot = self.parts[part], row & self.mask
        if array.dtype == np.float32:
            with np.errstate(over="ignore"):
                array[slot, first : first + math.prod(shape)] = flattened(value, len(shape))
        elif not shape:
            array[slot, first] = value
        else:
            for place, element in enumerate(flattened(value, len(shape)), first):
                array[slot, place] = element

    def reader(self, name: str) -> Callable[[int], Value]:
        """`value` of one column as a function of the row, for whoever asks for it at every point."""
        part, first, _, shape = self._place(name)
        mask, (_, width) = self.mask, self.parts[part].shape
        if self._types[part] != "Float64" or shape:
            return lambda row: self.value(row, name)
        memory: Any = self.parts[part].reshape(-1).data  # a view; its index takes half the time of one of numpy
        return lambda row: memory[(row & mask) * width + first]

    def writer(self, name: str) -> Callable[[int, Value], None]:
        """`put` of one column as a function of the row and the value, for whoever sets it at every point."""
        part, first, _, shape = self._place(name)
        mask, (_, width) = self.mask, self.parts[part].shape
        if self._types[part] != "Float64" or shape:
            return lambda row, value: self.put(row, name, value)
        memory: Any = self.parts[part].reshape(-1).data

        def write(row: int, value: Value) -> None:
            memory[(row & mask) * width + first] = value

        return write

    def _place(self, name: str) -> Place:
        if name not in self._places:
            self._places[name] = self.layout.place(name)
        return self._places[name]


def rows_for(window: int) -> int:
    """Rows that a ring needs so that no row is overwritten while a node runs ``window`` points ahead."""
    return 1 << (window + 3).bit_length()


def _itemsize(type_: VariableType) -> int:
    return np.dtype(DTYPES[type_]).itemsize
