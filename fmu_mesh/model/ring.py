"""Rings: the preallocated rows in which values wait between an FMU, a frame and an FMU.

A row holds the values of one instance at one of its own steps; row ``n`` lives in slot ``n & mask``. Owns the memory
layout and nothing else: no FMI, no Zenoh.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from .description import Value, VariableType

__all__ = ["Layout", "Ring", "is_real", "rows_for"]


def is_real(type_: VariableType) -> bool:
    """Whether values of this type live in the float64 part of a row; all others live in the int32 part."""
    return type_ == "Real"


class Layout(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The columns of a row: first the Real ones (float64), then Integer, Boolean and Enumeration (int32).

    Attributes:
        reals: names of the Real columns.
        integers: names of the int32 columns.
        integer_types: their types, in the same order.
    """

    reals: tuple[str, ...] = ()
    integers: tuple[str, ...] = ()
    integer_types: tuple[VariableType, ...] = ()

    @classmethod
    def of(cls, columns: Sequence[tuple[str, VariableType]]) -> Layout:
        """The layout that holds these (name, type) columns, keeping their order within each part."""
        others = [(name, type_) for name, type_ in columns if not is_real(type_)]
        return cls(
            reals=tuple(name for name, type_ in columns if is_real(type_)),
            integers=tuple(name for name, _ in others),
            integer_types=tuple(type_ for _, type_ in others),
        )

    @property
    def names(self) -> tuple[str, ...]:
        """All column names, Real ones first."""
        return self.reals + self.integers

    @property
    def row_size(self) -> int:
        """Size of one row in bytes when packed."""
        return 8 * len(self.reals) + 4 * len(self.integers)

    def types(self) -> tuple[VariableType, ...]:
        """The types of all columns, in the order of `names`."""
        real: VariableType = "Real"
        return (*(real for _ in self.reals), *self.integer_types)

    def place(self, name: str) -> tuple[int, int]:
        """Part (0: Real, 1: others) and column of a variable."""
        if name in self.reals:
            return 0, self.reals.index(name)
        return 1, self.integers.index(name)


class Ring:
    """A ring of rows in two preallocated arrays.

    Args:
        layout: the columns.
        rows: how many rows; a power of two.

    Attributes:
        reals: float64 array of shape (rows, number of Real columns).
        integers: int32 array of shape (rows, number of other columns).
        mask: ``rows - 1``; the slot of row ``n`` is ``n & mask``.
    """

    def __init__(self, layout: Layout, rows: int) -> None:
        if rows < 1 or rows & (rows - 1):
            msg = f"a ring has a power of two of rows, not {rows}"
            raise ValueError(msg)
        self.layout = layout
        self.rows = rows
        self.mask = rows - 1
        self.reals: NDArray[np.float64] = np.zeros((rows, len(layout.reals)), dtype=np.float64)
        self.integers: NDArray[np.int32] = np.zeros((rows, len(layout.integers)), dtype=np.int32)

    def parts(self) -> tuple[NDArray[Any], NDArray[Any]]:
        """Both arrays, Real part first."""
        return self.reals, self.integers

    def value(self, row: int, name: str) -> Value:
        """The value of one column of ``row`` as the Python type of its variable."""
        slot = row & self.mask
        if name in self.layout.reals:
            return float(self.reals[slot, self.layout.reals.index(name)])
        column = self.layout.integers.index(name)
        value = int(self.integers[slot, column])
        return bool(value) if self.layout.integer_types[column] == "Boolean" else value


def rows_for(window: int) -> int:
    """Rows that a ring needs so that no row is overwritten while a node runs ``window`` points ahead."""
    return 1 << (window + 3).bit_length()
