"""The values of a component as rows of a ring: how its inputs are read from a row and its outputs written to one.

Owns which Python values an output may have. A value of another type, or of another shape, is refused with its name.
"""

from __future__ import annotations

from collections.abc import Callable, Container
from typing import Any

import numpy as np
from msgspec.structs import replace
from numpy.typing import NDArray

from ...rings.ring import Ring
from ...variables.model_description import Variable
from ...variables.value_conversion import ValueRefused, to_value
from ...variables.value_types import DTYPES, INTEGERS, Value, is_float, is_text, nested

__all__ = ["as_attribute", "as_value", "reader", "writer"]

Array = NDArray[Any]

_TEXT_CHARACTERS = 60


def as_attribute(value: Value, variable: Variable) -> Any:  # noqa: ANN401 a value of any type
    """A value as the component sees it: an array is one of numpy, which belongs to the component."""
    return np.array(value, dtype=DTYPES[variable.type]).reshape(variable.shape) if variable.shape else value


def as_value(attribute: object, variable: Variable) -> Value:
    """The value of an attribute; an array as nested lists.

    Raises:
        ValueRefused: it is no value of the variable's type and shape.
    """
    if variable.shape:
        return nested(_array(attribute, variable).reshape(-1).tolist(), variable.shape)
    return _scalar(attribute, variable)


def reader(ring: Ring, variable: Variable) -> Callable[[int], Any]:
    """A function that returns the value of an input, as the component sees it, from a slot of a ring."""
    place = ring.layout.place(variable.name)
    part, first = ring.parts[place.part], place.first
    if place.shape:
        array = ring.array(variable.name)
        return lambda slot: array[slot].copy()
    if variable.type != "Float64":
        return lambda slot: part.item(slot, first)
    memory = _memory(part)
    return lambda slot: memory[slot, first]


def writer(ring: Ring, variable: Variable) -> Callable[[int, object], None]:
    """A function that writes the value of an output to a slot of a ring.

    Raises:
        ValueRefused: by the function: it is no value of the variable's type and shape.
    """
    place = ring.layout.place(variable.name)
    part, first = ring.parts[place.part], place.first

    if place.shape:
        array = ring.array(variable.name)

        def write_array(slot: int, attribute: object) -> None:
            array[slot] = _array(attribute, variable)

        return write_array

    if variable.type != "Float64":
        kind, allowed = _exact(variable)

        def write_scalar(slot: int, attribute: object) -> None:
            exact = attribute.__class__ is kind and attribute in allowed
            part[slot, first] = attribute if exact else _scalar(attribute, variable)

        return write_scalar

    memory = _memory(part)

    def write_float(slot: int, attribute: object) -> None:
        memory[slot, first] = attribute if attribute.__class__ is float else _scalar(attribute, variable)

    return write_float


def _exact(variable: Variable) -> tuple[type, Container[object]]:
    """A class, and which of its objects are values of a variable as they are."""
    if variable.type == "Boolean":
        return bool, (False, True)
    if variable.type in INTEGERS:
        return int, [number for _, number in variable.items] or INTEGERS[variable.type]
    return type(None), ()


def _memory(part: Any) -> Any:  # noqa: ANN401 an array, and a view of its memory
    """The numbers of an array by row and column: indexing this takes half the time of indexing numpy."""
    return part.data


def _scalar(attribute: object, variable: Variable) -> Value:
    plain = attribute.item() if isinstance(attribute, np.generic) else attribute
    if isinstance(plain, np.ndarray) and not plain.shape:
        plain = plain.item()
    # In a file, a text can also stand for a number or for bytes.
    in_a_file = isinstance(plain, str) and variable.type not in ("String", "Enumeration")
    try:
        return to_value(None if in_a_file else plain, variable)
    except ValueRefused as refused:
        raise ValueRefused(f"its value is {_shown(attribute)}, expected {refused.expected}") from None


def _array(attribute: object, variable: Variable) -> Array:
    """An attribute as an array of the variable's type and shape."""
    dtype, shape = np.dtype(DTYPES[variable.type]), variable.shape
    if is_text(variable.type):
        return _text_array(attribute, variable)
    if isinstance(attribute, np.ndarray) and attribute.dtype == dtype and attribute.shape == shape:
        return attribute
    try:
        array = np.asarray(attribute)
    except ValueError:  # rows of different lengths
        raise _refused(attribute, variable) from None
    is_boolean = array.dtype == np.bool_
    fits = is_boolean == (variable.type == "Boolean") and np.can_cast(array.dtype, dtype, "same_kind")
    if not fits or array.shape != shape:
        raise _refused(attribute, variable)
    with np.errstate(over="ignore"):
        converted = array.astype(dtype)
    if not is_float(variable.type) and not np.array_equal(converted, array):
        raise _refused(attribute, variable)  # a whole number that the type cannot hold
    return converted


def _text_array(attribute: Any, variable: Variable) -> Array:  # noqa: ANN401 whatever a user assigns
    array = np.empty(variable.shape, dtype=object)
    try:
        array[...] = attribute
    except ValueError:
        raise _refused(attribute, variable) from None
    if np.shape(attribute) != variable.shape:
        raise _refused(attribute, variable)
    element = replace(variable, shape=(), dimensions=())
    for place, text in np.ndenumerate(array):
        array[place] = _scalar(text, element)
    return array


def _refused(attribute: object, variable: Variable) -> ValueRefused:
    expected = f"an array of {variable.type} with the shape {variable.shape}"
    return ValueRefused(f"its value is {_shown(attribute)}, expected {expected}")


def _shown(attribute: object) -> str:
    if isinstance(attribute, np.ndarray):
        return f"an array of {attribute.dtype} with the shape {attribute.shape}"
    text = " ".join(repr(attribute).split())
    return text if len(text) <= _TEXT_CHARACTERS else f"{text[:_TEXT_CHARACTERS]}..."
