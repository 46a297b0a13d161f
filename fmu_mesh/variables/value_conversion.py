"""Conversion between plain values, as in files and on the wire, and values of variables.

The one place that knows which plain value stands for which value of a type: the configuration, settings over the wire
and programs that use the library all come through here, so all of them take and refuse the same.
"""

from __future__ import annotations

import base64
import binascii
import math
import sys
from collections.abc import Callable
from ctypes import c_float
from typing import TYPE_CHECKING, Any, cast

from ..text import listed, nearest, shown
from .model_description import Variable
from .value_types import DTYPES, INTEGERS, PlainValue, Value, VariableType, flattened, nested

if TYPE_CHECKING:
    from numpy.typing import NDArray

__all__ = [
    "FINITE",
    "MAX_TEXT_SIZE",
    "ValueRefused",
    "checked_value",
    "checker",
    "from_plain",
    "is_finite",
    "range_of",
    "to_plain",
    "to_value",
]

MAX_TEXT_SIZE = 16 * 2**20
"""Largest size of a String or Binary in bytes."""

FINITE = "a finite number, or `not_finite: record` for its instance"
"""What is expected where a value that is NaN or infinite is refused."""

_NOT_FINITE = {"NaN": math.nan, "INF": math.inf, "-INF": -math.inf}
_LARGEST = sys.float_info.max
_FLOAT32_MAX = (2 - 2**-23) * 2.0**127


class ValueRefused(ValueError):
    """A value that is not allowed for a variable.

    Args:
        message: why, where no ``expected`` says it.
        expected: what would be right.
        suggestion: the nearest right value, if there is one.
        out_of_range: whether only its size is wrong.
    """

    def __init__(
        self, message: str, *, expected: str = "", suggestion: str | None = None, out_of_range: bool = False
    ) -> None:
        super().__init__(message)
        self.expected = expected
        self.suggestion = suggestion
        self.out_of_range = out_of_range


def to_value(plain: object, variable: Variable, *, finite: bool = False) -> Value:
    """Convert a plain value, or a Python or numpy value, to the value of a variable.

    A floating-point number may be given as a whole number, or as `NaN`, `INF` or `-INF` (FMI 3.0, 2.4.8); an
    Enumeration by the name or the number of an item; Binary as bytes or as base64; an array as nested lists by rows.

    Args:
        plain: the value that somebody gave.
        variable: what it is for.
        finite: whether `NaN`, `INF` and `-INF` are refused.

    Raises:
        ValueRefused: it is no value of the variable's type and shape, or out of its range.
    """
    is_number = variable.type == "Float64" and not variable.shape
    if is_number and type(plain) is float and math.isfinite(plain) and _within(plain, variable):
        return plain  # most start values, in each run
    if hasattr(plain, "tolist"):
        import numpy as np  # noqa: PLC0415 only for whoever has given an array

        array: Any = plain
        values: list[Any] = array.tolist()
        plain = values
        if _is_value(array, variable) and not (finite and not np.isfinite(array).all()):
            return values
    values = [_element(element, variable) for element in _elements(plain, variable, variable.shape)]
    if finite and not is_finite(values):
        raise ValueRefused(f"{plain!r} is not finite", expected=FINITE)
    return nested(values, variable.shape)


def _is_value(array: NDArray[Any], variable: Variable) -> bool:
    """Whether an array is a value as it is: of a type whose numbers are all allowed, and of the right shape."""
    bounded = variable.minimum is not None or variable.maximum is not None
    is_number = variable.type not in ("Enumeration", "String", "Binary")
    return is_number and not bounded and array.dtype == DTYPES[variable.type] and array.shape == variable.shape != ()


def is_finite(value: Value) -> bool:
    """Whether neither a value nor one of its elements is NaN or infinite."""
    if isinstance(value, list):
        return all(map(is_finite, value))
    return not isinstance(value, float) or math.isfinite(value)


def checked_value(plain: object, variable: Variable, said: str, *, finite: bool = False) -> Value:
    """As `to_value`, with a whole sentence as the message of the error.

    ``said`` is the value as the sentence shows it.

    Raises:
        ValueRefused: it is no value of the variable's type and shape, or out of its range.
    """
    try:
        return to_value(plain, variable, finite=finite)
    except ValueRefused as refused:
        what = "is out of its range" if refused.out_of_range else f"is no {variable.type_name} value for it"
        near = f" (did you mean '{refused.suggestion}'?)" if refused.suggestion else ""
        raise ValueRefused(f"{said} {what}; expected {refused.expected}{near}") from refused


def checker(variable: Variable, *, finite: bool = False) -> Callable[[object], Value]:
    """`checked_value` for one variable and many values: what depends on the variable only is looked up once."""
    highest = _LARGEST if variable.maximum is None else min(variable.maximum, _LARGEST)
    lowest = -_LARGEST if variable.minimum is None else max(variable.minimum, -_LARGEST)
    is_number = variable.type == "Float64" and not variable.shape

    def check(plain: object) -> Value:
        if is_number and (isinstance(plain, float) or plain.__class__ is int) and lowest <= plain <= highest:
            return float(plain)
        return checked_value(plain, variable, shown(plain), finite=finite)

    return check


def to_plain(value: Value) -> PlainValue:
    """A value as in JSON and YAML; the inverse of `to_value`."""
    match value:
        case float() if not math.isfinite(value):
            return "NaN" if math.isnan(value) else "INF" if value > 0 else "-INF"
        case bytes():
            return base64.b64encode(value).decode()
        case list():
            return [to_plain(element) for element in value]
        case _:
            return value


def from_plain(plain: PlainValue, type_: str, shape: tuple[int, ...] = ()) -> Any:  # noqa: ANN401  the type says which
    """A plain value of a type as a program wants it: bytes for Binary, a numpy array for an array.

    Example:
        >>> from_plain([1.0, "NaN"], "Float64", (2,))
        array([ 1., nan])
    """
    if shape:
        elements = [from_plain(element, type_) for element in flattened(plain, len(shape))]
        import numpy as np  # noqa: PLC0415 only whoever wants arrays

        return np.array(elements, DTYPES[cast("VariableType", type_)]).reshape(shape)
    if type_ == "Binary" and isinstance(plain, str):
        return base64.b64decode(plain)
    if type_ in ("Float64", "Float32", "Real") and isinstance(plain, str | int):
        return _NOT_FINITE[plain] if isinstance(plain, str) else float(plain)
    return plain


def range_of(variable: Variable) -> str:
    """The allowed range of a variable, for a message."""
    if variable.minimum is None:
        return f"<= {variable.maximum:g}"
    return f">= {variable.minimum:g}" + (f" and <= {variable.maximum:g}" if variable.maximum is not None else "")


def _elements(plain: object, variable: Variable, shape: tuple[int, ...]) -> list[Any]:
    """The elements of an array; its lists must have the lengths of its dimensions."""
    elements: list[Any] = [plain]
    for size in shape:
        for row in elements:
            if not isinstance(row, list | tuple) or len(row) != size:
                raise _refused(variable)
        elements = [element for row in elements for element in row]
    return elements


def _element(plain: object, variable: Variable) -> Value:
    """One element of a variable, or the value of a scalar."""
    value = _converted(plain, variable)
    if value is None:
        names = [item for item, _ in variable.items]
        raise _refused(variable, nearest(plain, names) if isinstance(plain, str) else None)
    if not _within(value, variable):
        raise ValueRefused(
            f"{plain!r} is out of its range", expected=f"a value {range_of(variable)}", out_of_range=True
        )
    return value


def _refused(variable: Variable, suggestion: str | None = None) -> ValueRefused:
    expected = _expected(variable)
    return ValueRefused(f"expected {expected}", expected=expected, suggestion=suggestion)


def _converted(plain: object, variable: Variable) -> Value | None:
    """``plain`` as a value of the type of the variable, or None if it is not one."""
    converted: Value | None = None
    match variable.type, plain:
        case "Boolean", bool():
            converted = plain
        case _, bool():
            pass  # which Python would take for a number
        case "Float64" | "Float32", int() | float() | str():
            converted = _float(plain, variable)
        case "Enumeration", int() | str():
            items = dict(variable.items)
            number = items.get(plain) if isinstance(plain, str) else plain
            known = isinstance(number, int) and number in (items.values() if items else INTEGERS["Enumeration"])
            converted = number if known else None
        case _, int() if plain in INTEGERS.get(variable.type, ()):
            converted = plain
        case "String", str() if "\0" not in plain and len(plain) <= MAX_TEXT_SIZE and _is_unicode(plain):
            converted = plain
        case "Binary", bytes() | bytearray() if len(plain) <= MAX_TEXT_SIZE:
            converted = bytes(plain)
        case "Binary", str() if len(plain) <= 2 * MAX_TEXT_SIZE:
            converted = _binary(plain)
    return converted


def _float(plain: float | str, variable: Variable) -> float | None:
    """A floating-point number; a Float32 is rounded, and must not become infinite by that."""
    if isinstance(plain, str):
        return _NOT_FINITE.get(plain)
    try:
        value = float(plain)
    except OverflowError:
        return None
    if variable.type == "Float64" or not math.isfinite(value):
        return value
    return c_float(value).value if abs(value) <= _FLOAT32_MAX else None


def _binary(text: str) -> bytes | None:
    try:
        return base64.b64decode(text, validate=True)
    except (binascii.Error, ValueError):
        return None


def _is_unicode(text: str) -> bool:
    """Whether a text is valid Unicode: JSON allows a single surrogate."""
    try:
        text.encode()
    except UnicodeEncodeError:
        return False
    return True


def _within(value: Value, variable: Variable) -> bool:
    if isinstance(value, str | bytes | bool | list):
        return True
    above = variable.minimum is None or value >= variable.minimum
    return above and (variable.maximum is None or value <= variable.maximum)


def _expected(variable: Variable) -> str:
    one = _expected_element(variable)
    if not variable.shape:
        return one
    sizes = " x ".join(map(str, variable.shape))
    return f"a list of {sizes} values, row by row, each of them {one}"


def _expected_element(variable: Variable) -> str:
    match variable.type:
        case "Float64" | "Float32":
            return "a number" if variable.type == "Float64" else f"a number from -{_FLOAT32_MAX!r} to {_FLOAT32_MAX!r}"
        case "Boolean":
            return "true or false"
        case "String":
            return f"text without the character 0, {MAX_TEXT_SIZE} characters at most"
        case "Binary":
            return f"base64 of {MAX_TEXT_SIZE} bytes at most"
        case "Enumeration":
            items = [f"{item} ({number})" for item, number in variable.items]
            return f"one of {listed(items)}" if items else "the number of an item"
        case _:
            whole = INTEGERS[variable.type]
            return f"a whole number from {whole[0]} to {whole[-1]}"
