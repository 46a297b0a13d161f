"""The types of variables: one vocabulary for all versions of FMI, that of FMI 3.0 (2.4.4).

Owns what a type can hold, in which memory its values lie, and which type takes which other one without loss. FMI 1.0
and 2.0 have Real (here Float64), Integer (Int32), Boolean, Enumeration and String. Knows nothing of variables.
"""

from __future__ import annotations

import itertools
import re
from typing import TYPE_CHECKING, Any, Final, Literal

__all__ = [
    "DTYPES",
    "FMI2_TYPES",
    "INTEGERS",
    "MAX_ELEMENTS",
    "TYPES",
    "PlainValue",
    "Value",
    "VariableType",
    "element_name",
    "element_names",
    "flattened",
    "is_float",
    "is_text",
    "nested",
    "split_element",
    "takes",
    "zero",
]

VariableType = Literal[
    "Float64",
    "Int64",
    "UInt64",
    "Enumeration",
    "Float32",
    "Int32",
    "UInt32",
    "Int16",
    "UInt16",
    "Int8",
    "UInt8",
    "Boolean",
    "String",
    "Binary",
]

PlainValue = float | int | bool | str | list[Any]
"""A value as in YAML and JSON: an array as nested lists, row by row; Binary as base64; NaN, INF, -INF as text."""

if TYPE_CHECKING:
    Value = float | int | bool | str | bytes | list[Any]
else:
    Value = Any  # msgspec cannot decode a union of str and bytes, although MessagePack tells them apart
"""A value as Python has it: an array as nested lists, row by row; Binary as bytes."""

DTYPES: Final[dict[VariableType, str]] = {
    "Float64": "float64",
    "Int64": "int64",
    "UInt64": "uint64",
    "Enumeration": "int64",
    "Float32": "float32",
    "Int32": "int32",
    "UInt32": "uint32",
    "Int16": "int16",
    "UInt16": "uint16",
    "Int8": "int8",
    "UInt8": "uint8",
    "Boolean": "bool",
    "String": "object",
    "Binary": "object",
}
"""The array type of each type, in the order of the parts of a row: larger elements first, so all are aligned."""

TYPES: Final[tuple[VariableType, ...]] = tuple(DTYPES)

FMI2_TYPES: Final[dict[str, VariableType]] = {
    "Real": "Float64",
    "Integer": "Int32",
    "Boolean": "Boolean",
    "Enumeration": "Enumeration",
    "String": "String",
}
"""The types of FMI 1.0 and 2.0 by their own names (FMI 2.0, 2.2.7)."""

INTEGERS: Final[dict[VariableType, range]] = {
    "Int64": range(-(2**63), 2**63),
    "UInt64": range(2**64),
    "Enumeration": range(-(2**63), 2**63),
    "Int32": range(-(2**31), 2**31),
    "UInt32": range(2**32),
    "Int16": range(-(2**15), 2**15),
    "UInt16": range(2**16),
    "Int8": range(-(2**7), 2**7),
    "UInt8": range(2**8),
}
"""The range of each integer type."""

MAX_ELEMENTS: Final = 2**20
"""Largest number of elements of an array."""

_ELEMENT: Final = re.compile(r"(?s)(.+)\[(\s*\d+\s*(?:,\s*\d+\s*)*)\]")
_MANTISSA_BITS: Final[dict[VariableType, int]] = {"Float64": 53, "Float32": 24}


def is_float(type_: VariableType) -> bool:
    """Whether values of this type are floating-point numbers. Only these can be scaled or continuous."""
    return type_ in _MANTISSA_BITS


def is_text(type_: VariableType) -> bool:
    """Whether values of this type have a variable size: String and Binary."""
    return type_ in ("String", "Binary")


def zero(type_: VariableType) -> Value:
    """The value of a variable of this type before it is set."""
    match type_:
        case "Float64" | "Float32":
            return 0.0
        case "Boolean":
            return False
        case "String":
            return ""
        case "Binary":
            return b""
        case _:
            return 0


def takes(target: VariableType, source: VariableType, items: tuple[int, ...] = ()) -> bool:
    """Whether every value of type ``source`` is also one of type ``target``: a connection then loses nothing.

    ``items`` are the numbers that the source can have if it is an Enumeration; empty if they are not known.
    """
    if source == target:
        return True
    match source:
        case "Float32":
            return target == "Float64"
        case "Boolean":
            whole: tuple[int, ...] = (0, 1)
        case "Enumeration":
            whole = items or (-(2**31), 2**31 - 1)
        case _ if source in INTEGERS:
            whole = (INTEGERS[source][0], INTEGERS[source][-1])
            if target in _MANTISSA_BITS:
                return bool(whole[1] < 2 ** _MANTISSA_BITS[target])
        case _:
            return False
    return target in INTEGERS and target != "Enumeration" and all(number in INTEGERS[target] for number in whole)


def flattened(value: Value, rank: int) -> list[Any]:
    """The elements of an array of ``rank`` dimensions, row by row (FMI 3.0, 2.2.6.1); for a scalar the value itself."""
    values: list[Any] = [value]
    for _ in range(rank):
        values = [element for row in values for element in row]
    return values


def nested(values: list[Any], shape: tuple[int, ...]) -> Value:
    """The value with this shape and these elements; the inverse of `flattened`."""
    if not shape:
        element: Value = values[0]
        return element
    for size in reversed(shape[1:]):
        values = [values[first : first + size] for first in range(0, len(values), size)]
    return values


def element_name(name: str, index: tuple[int, ...]) -> str:
    """The name of an element of an array: indices start at 1, the last one runs fastest (`y[1,2]`)."""
    return f"{name}[{','.join(str(number + 1) for number in index)}]"


def element_names(name: str, shape: tuple[int, ...]) -> tuple[str, ...]:
    """The names of all elements of an array, row by row; for a scalar its own name."""
    return tuple(element_name(name, index) if index else name for index in itertools.product(*map(range, shape)))


def split_element(name: str) -> tuple[str, tuple[int, ...]] | None:
    """The name of the array and the index from 0, from the name of an element; None for any other name."""
    match = _ELEMENT.fullmatch(name)
    if match is None:
        return None
    return match[1], tuple(int(number) - 1 for number in match[2].split(","))
