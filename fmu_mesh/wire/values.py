"""Values as any Zenoh client sees them: JSON, with the point and the time in the attachment."""

from __future__ import annotations

import math
from typing import Any

import msgspec
import zenoh

from ..model.description import Value, Variable
from .messages import decode_json

__all__ = [
    "Stamp",
    "ValueRefused",
    "attachment",
    "decode_stamp",
    "decode_time",
    "decode_value",
    "encode_value",
    "json_encoding",
]

MAX_VALUE_SIZE = 1 << 20
_INT32 = range(-(2**31), 2**31)
_NOT_FINITE = ("NaN", "INF", "-INF")

json_encoding = zenoh.Encoding.APPLICATION_JSON


class ValueRefused(ValueError):
    """A value that was sent to the mesh cannot be taken; the message says why."""


class Stamp(msgspec.Struct, frozen=True):
    """The communication point of a value and its time in s."""

    point: int
    time: float


def attachment(point: int, time: float) -> bytes:
    """The attachment of a value at ``point``, whose time is ``time`` s."""
    return msgspec.json.encode(Stamp(point, time))


def decode_stamp(data: bytes) -> Stamp:
    """The point and time in an attachment.

    Raises:
        msgspec.DecodeError: it is none of ours.
    """
    return decode_json(data, Stamp)


def decode_time(data: bytes) -> float:
    """The time in s in the attachment of a value that is sent to an input: `{"time": 1.5}`, as a `Stamp` has it, too.

    Raises:
        ValueRefused: it has none.
    """
    try:
        time = decode_json(data, _Moment).time
    except msgspec.DecodeError as error:
        raise ValueRefused(f'its attachment has no time, such as {{"time": 1.5}} in s ({error})') from error
    if not math.isfinite(time):
        raise ValueRefused(f"the time {time} in its attachment is not finite")
    return time


class _Moment(msgspec.Struct, frozen=True):
    time: float


def encode_value(value: Value) -> bytes:
    """A value as JSON; NaN and the infinities, which JSON does not have, as the strings FMI 3.0 uses for them."""
    if isinstance(value, float) and not math.isfinite(value):
        return b'"NaN"' if math.isnan(value) else (b'"INF"' if value > 0 else b'"-INF"')
    return msgspec.json.encode(value)


def decode_value(data: bytes, variable: Variable) -> Value:
    """The value that JSON ``data`` gives for ``variable``.

    Raises:
        ValueRefused: it is no JSON, or not of the variable's type or range.
    """
    if len(data) > MAX_VALUE_SIZE:
        raise ValueRefused(f"{len(data)} bytes are too many for a value")
    try:
        value: Any = decode_json(data, object)
    except msgspec.DecodeError as error:
        raise ValueRefused(f"it is no JSON value ({error})") from error
    number = isinstance(value, int) and not isinstance(value, bool)
    match variable.type:
        case "Real" if number or isinstance(value, float) or value in _NOT_FINITE:
            return _checked_real(value, variable)
        case "Integer" if number and value in _INT32:
            return int(value)
        case "Boolean" | "String" if isinstance(value, bool if variable.type == "Boolean" else str):
            return value
        case "Enumeration":
            items = dict(variable.items)
            if value in items:
                return items[value]
            if number and (not items or value in items.values()):
                return int(value)
    raise ValueRefused(f"{data[:80].decode(errors='replace')} is no {variable.type} value for it")


def _checked_real(number: float, variable: Variable) -> float:
    try:
        value = float(number)
    except OverflowError as error:
        raise ValueRefused("it is larger than any Real") from error
    low, high = variable.minimum, variable.maximum
    if (low is not None and value < low) or (high is not None and value > high):
        raise ValueRefused(f"{value!r} is outside its range [{low}, {high}]")
    return value
