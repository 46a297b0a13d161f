"""Inputs that are arrays of which only some elements are connected.

An FMU reads and writes arrays as a whole (FMI 3.0, 2.2.6.2), so an element that is not connected is set to the value
that the FMU already has.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence

import numpy as np

from ..system.layout import Column, Layout
from ..variables.value_types import Value
from .ring import Ring

__all__ = ["element_of", "fill_unconnected", "merged", "scaled"]

Get = Callable[[Sequence[str]], list[Value]]


def merged(values: Mapping[str, Value], layout: Layout, get: Get) -> dict[str, Value]:
    """Values of whole variables, from values of variables and of elements of arrays: `u[2]` is an element of `u`.

    ``get`` reads the current values of variables; the other elements of an array keep them.
    """
    found = {name: layout.column(name) for name in values}
    if all(_is_number(column, name) and isinstance(values[name], float) for name, column in found.items()):
        return dict(values)
    row = Ring(layout, 1)
    columns = {name: column.name for name, column in found.items()}
    arrays = list(dict.fromkeys(column for name, column in columns.items() if name != column))
    if arrays:
        for array, value in zip(arrays, get(arrays), strict=True):
            row.put(0, array, value)
    for name, value in values.items():
        row.put(0, name, value)
    return {column: row.value(0, column) for column in dict.fromkeys(columns.values())}


def element_of(value: Value, column: Column, name: str) -> Value:
    """The element called ``name`` of the value of a column, or the value itself if that is the column's own name."""
    if _is_number(column, name) and isinstance(value, float):
        return value
    row = Ring(Layout((column,)), 1)
    row.put(0, column.name, value)
    return row.value(0, name)


def _is_number(column: Column, name: str) -> bool:
    """Whether the value of a column called ``name`` is the same in a ring: to make one takes a while."""
    return column.type == "Float64" and not column.shape and column.name == name


def fill_unconnected(ring: Ring, connected: Iterable[str], get: Get) -> None:
    """Write the current values of the FMU to the elements of input arrays that are not ``connected``, in every row."""
    names = {*connected}
    for column in ring.layout.columns:
        if not column.shape or column.name in names:
            continue
        free = [offset for offset, element in enumerate(column.elements) if element not in names]
        if free:
            place = ring.layout.place(column.name)
            row = Ring(Layout((column,)), 1)
            row.put(0, column.name, get([column.name])[0])
            ring.parts[place.part][:, [place.first + offset for offset in free]] = row.parts[0][0, free]


def scaled(value: Value, factor: float, offset: float) -> Value:
    """``value * factor + offset`` with one rounding each, for each element of an array.

    With factor 1 and offset 0, and for text, the result is ``value`` itself.
    """
    if (factor, offset) == (1.0, 0.0) or isinstance(value, str | bytes):
        return value
    if isinstance(value, np.ndarray):
        with np.errstate(all="ignore"):
            return value * np.float64(factor) + np.float64(offset)
    if isinstance(value, list):
        return [scaled(element, factor, offset) for element in value]
    return value * factor + offset
