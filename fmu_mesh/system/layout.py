"""The layout of a row: which variables it has and at which places.

A row has the values of one instance at one of its own steps. The memory itself is `fmu_mesh.rings.ring`.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from functools import cached_property
from typing import NamedTuple

import msgspec
import numpy as np

from ..variables.model_description import Variable
from ..variables.value_types import DTYPES, TYPES, VariableType, element_names, is_text, split_element

__all__ = ["Column", "Layout", "Part", "Place", "row_bytes", "row_offsets"]

_TEXT_BYTES = 64
"""Assumed size of a String or Binary without a maximum size, to plan memory and frames."""


_STAMP_BYTES = 8
_ALIGNMENT = 8


class Column(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One variable in a row. The elements of an array are neighbours, in row-major order."""

    name: str
    type: VariableType
    shape: tuple[int, ...] = ()
    max_size: int | None = None

    @property
    def size(self) -> int:
        """Number of elements; 1 for a scalar."""
        return math.prod(self.shape)

    @property
    def elements(self) -> tuple[str, ...]:
        """The names of its elements, as `y[1,2]`; for a scalar, its own name."""
        return element_names(self.name, self.shape)


class Part(NamedTuple):
    """The columns of one type; their values are in one array.

    Attributes:
        width: number of elements of all columns together.
    """

    type: VariableType
    columns: tuple[Column, ...]
    width: int


class Place(NamedTuple):
    """The place of a variable or of one array element in a row: elements ``first .. first + size - 1`` of a part."""

    part: int
    first: int
    size: int
    shape: tuple[int, ...]


class Layout(msgspec.Struct, frozen=True, forbid_unknown_fields=True, dict=True):
    """The columns of a row, grouped by type in the order of `TYPES`, Float64 first.

    Make it with `of`, which sorts the columns. What follows from them is computed once: a row may have 60,000 columns.
    """

    columns: tuple[Column, ...] = ()

    @classmethod
    def of(
        cls, columns: Iterable[tuple[str, VariableType] | tuple[str, VariableType, tuple[int, ...]] | Variable]
    ) -> Layout:
        """The layout for these variables, or for (name, type) or (name, type, shape); keeps the order within a type."""
        made = [Column(c.name, c.type, c.shape, c.max_size) if isinstance(c, Variable) else Column(*c) for c in columns]
        return cls(tuple(sorted(made, key=lambda column: TYPES.index(column.type))))

    @cached_property
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

    @cached_property
    def parts(self) -> tuple[Part, ...]:
        """The parts that have columns, in their order in memory and in a frame."""
        by_type: dict[VariableType, list[Column]] = {}
        for column in self.columns:
            by_type.setdefault(column.type, []).append(column)
        return tuple(Part(type_, tuple(own), sum(c.size for c in own)) for type_, own in by_type.items())

    def __contains__(self, name: str) -> bool:
        """Whether a variable has a column; an element of an array has none of its own."""
        return name in self._found

    def column(self, name: str) -> Column:
        """The column of a variable, or of the array that ``name`` is an element of.

        Raises:
            KeyError: there is none.
        """
        if name not in self._found and (parts := split_element(name)) is not None:
            name = parts[0]
        return self._found[name][0]

    def place(self, name: str) -> Place:
        """The place of a variable, or of an array element such as `y[2]`, unless a variable has exactly that name.

        Raises:
            KeyError: there is no such column.
        """
        if name in self._found:
            return self._found[name][1]
        array, index = split_element(name) or (name, ())
        part, first, _, shape = self._found[array][1]
        return Place(part, first + int(np.ravel_multi_index(index, shape)), 1, ())

    @cached_property
    def _found(self) -> dict[str, tuple[Column, Place]]:
        found = {}
        for number, part in enumerate(self.parts):
            first = 0
            for column in part.columns:
                found[column.name] = column, Place(number, first, column.size, column.shape)
                first += column.size
        return found


def row_offsets(layout: Layout) -> list[int]:
    """The place of each part in a row of a ring in bytes, and last the size of a row.

    A row begins with its stamp: its number plus 1, or 0 while its values are being written. Text lies beside the row.
    """
    offsets, end = [], _STAMP_BYTES
    for part in layout.parts:
        offsets.append(end)
        if not is_text(part.type):
            end += -(-part.width * _itemsize(part.type) // _ALIGNMENT) * _ALIGNMENT
    return [*offsets, end]


def row_bytes(layout: Layout) -> int:
    """Size of a row of a ring in bytes."""
    return row_offsets(layout)[-1]


def _itemsize(type_: VariableType) -> int:
    return np.dtype(DTYPES[type_]).itemsize
