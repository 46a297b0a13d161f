"""Values as any Zenoh client sees them: JSON, with the point and the time in the attachment."""

from __future__ import annotations

import math
from typing import Annotated, Any

import msgspec
import zenoh

from ..errors import MessageRefused
from ..simtime import ENDLESS
from ..variables.model_description import Value, Variable
from ..variables.value_conversion import MAX_TEXT_SIZE, ValueRefused, checked_value, to_plain
from .messages import decode_json

__all__ = [
    "Stamp",
    "ValueRefused",
    "attachment",
    "decode_time",
    "decode_value",
    "encode_time",
    "encode_value",
    "json_encoding",
]

MAX_VALUE_SIZE = 2 * MAX_TEXT_SIZE

json_encoding = zenoh.Encoding.APPLICATION_JSON


class Stamp(msgspec.Struct, frozen=True):
    """The communication point of a value and its time in s."""

    point: Annotated[int, msgspec.Meta(ge=0, le=ENDLESS)]
    time: float


def attachment(point: int, time: float) -> bytes:
    """The attachment of a value at ``point``, whose time is ``time`` s."""
    return msgspec.json.encode(Stamp(point, time))


def decode_time(data: bytes) -> float:
    """The time in s in the attachment of a value that is sent to an input, such as `{"time": 1.5}` or a `Stamp`.

    Raises:
        ValueRefused: it has none.
    """
    try:
        time = decode_json(data, _Moment).time
    except MessageRefused as error:
        raise ValueRefused(f'its attachment has no time, such as {{"time": 1.5}} in s ({error})') from error
    if not math.isfinite(time):
        raise ValueRefused(f"the time {time} in its attachment is not finite")
    return time


def encode_time(time: float) -> bytes:
    """The attachment of a value that is sent to an input and holds from ``time`` (s) on."""
    return msgspec.json.encode(_Moment(time))


class _Moment(msgspec.Struct, frozen=True):
    time: float


def encode_value(value: Value) -> bytes:
    """A value as JSON; NaN and infinities are text as in FMI 3.0, because JSON does not have them; Binary is base64."""
    return msgspec.json.encode(to_plain(value))


def decode_value(data: bytes, variable: Variable) -> Value:
    """The value that JSON ``data`` gives for ``variable``.

    Raises:
        ValueRefused: it is not JSON, or has a wrong type, shape or range.
    """
    if len(data) > MAX_VALUE_SIZE:
        raise ValueRefused(f"{len(data)} bytes are too many for a value")
    try:
        value: Any = decode_json(data, object)
    except MessageRefused as error:
        raise ValueRefused(f"it is no JSON value ({error})") from error
    return checked_value(value, variable, data[:80].decode(errors="replace"))
