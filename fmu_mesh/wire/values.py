"""Values as any Zenoh client sees them: JSON, with the point and the time in the attachment."""

from __future__ import annotations

import math
import os
import pwd
import socket
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Final

import msgspec
import zenoh

from ..errors import MessageRefused
from ..simtime import ENDLESS
from ..variables.model_description import Value, Variable
from ..variables.value_conversion import MAX_TEXT_SIZE, ValueRefused, checked_value, to_plain
from .messages import decode_json

__all__ = [
    "NO_ORIGIN",
    "Origin",
    "Stamp",
    "ValueRefused",
    "attachment",
    "decode_origin",
    "decode_value",
    "encode_origin",
    "encode_value",
    "encode_values",
    "json_encoding",
    "this_program",
    "who_sent",
]

MAX_VALUE_SIZE = 2 * MAX_TEXT_SIZE

_LONGEST_WHO: Final = 200
_OURS: Final = ("fmu-mesh", "__main__.py")

json_encoding = zenoh.Encoding.APPLICATION_JSON


class Stamp(msgspec.Struct, frozen=True):
    """The communication point of a value and its time in s."""

    point: Annotated[int, msgspec.Meta(ge=0, le=ENDLESS)]
    time: float


def attachment(point: int, time: float) -> bytes:
    """The attachment of a value at ``point``, whose time is ``time`` s."""
    return msgspec.json.encode(Stamp(point, time))


class Origin(msgspec.Struct, frozen=True, omit_defaults=True):
    """The attachment of a value that is sent to an input or a parameter; all of it may be missing.

    Attributes:
        time: simulation time in s from which on the value holds; None: from the next point on.
        who: who sends it, for people and for the metadata of results.
    """

    time: float | None = None
    who: Annotated[str, msgspec.Meta(max_length=_LONGEST_WHO)] = "unknown"


NO_ORIGIN: Final = Origin()


def decode_origin(data: bytes) -> Origin:
    """When a value holds and who sends it, from its attachment, such as `{"time": 1.5, "who": "joystick"}`.

    Raises:
        ValueRefused: the attachment is something else.
    """
    try:
        origin = decode_json(data, Origin)
    except MessageRefused as error:
        text = f'its attachment is not like {{"time": 1.5, "who": "joystick"}}, with the time in s ({error})'
        raise ValueRefused(text) from error
    if origin == NO_ORIGIN:
        raise ValueRefused('its attachment has neither a time, such as {"time": 1.5} in s, nor who sends it')
    if origin.time is not None and not math.isfinite(origin.time):
        raise ValueRefused(f"the time {origin.time} in its attachment is not finite")
    return origin


def who_sent(attachment: zenoh.ZBytes | None) -> str:
    """Who sent a message, as its attachment says; `unknown` if it does not.

    Raises:
        MessageRefused: the attachment is no such object.
    """
    try:
        return decode_origin(attachment.to_bytes()).who if attachment is not None else NO_ORIGIN.who
    except ValueRefused as refused:
        raise MessageRefused(str(refused)) from refused


def encode_origin(time: float | None, who: str) -> bytes:
    """The attachment of a value that holds from ``time`` (s) on, or from the next point on if that is None."""
    return msgspec.json.encode(Origin(time, who[:_LONGEST_WHO]))


def encode_value(value: Value) -> bytes:
    """A value as JSON; NaN and infinities are text as in FMI 3.0, because JSON does not have them; Binary is base64."""
    return msgspec.json.encode(to_plain(value))


def encode_values(values: Mapping[str, Value]) -> bytes:
    """Values of several variables of an instance by name, which take effect at the same point."""
    return msgspec.json.encode({name: msgspec.Raw(encode_value(value)) for name, value in values.items()})


def decode_value(data: bytes, variable: Variable, *, finite: bool = False) -> Value:
    """The value that JSON ``data`` gives for ``variable``; ``finite``: see `to_value`.

    Raises:
        ValueRefused: it is not JSON, or has a wrong type, shape or range.
    """
    if len(data) > MAX_VALUE_SIZE:
        raise ValueRefused(f"{len(data)} bytes are too many for a value")
    try:
        value: Any = decode_json(data, object)
    except MessageRefused as error:
        raise ValueRefused(f"it is no JSON value ({error})") from error
    return checked_value(value, variable, data[:80].decode(errors="replace"), finite=finite)


def this_program() -> str:
    """This process in words: `anna@lab fmu-mesh set (pid 4711)`, or `anna@lab steer.py (pid 4711)`."""
    try:
        user = pwd.getpwuid(os.getuid()).pw_name
    except KeyError:  # a container may have users without names
        user = str(os.getuid())
    program, command = Path(sys.argv[0] if sys.argv else "").name, sys.argv[1:2]
    if program in _OURS:
        program = " ".join(["fmu-mesh", *command])
    return f"{user}@{socket.gethostname()} {program or 'python'} (pid {os.getpid()})"
