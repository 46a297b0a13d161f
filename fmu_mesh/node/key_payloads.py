"""Payloads under the keys of a configuration: JSON, text, doubles, and messages of ROS, as values of variables.

Nothing here is trusted: a payload that is no such value is refused with a reason.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, Final, NamedTuple

import msgspec
import numpy as np
import zenoh

from ..errors import MessageRefused
from ..ros_wire.cdr import CdrError
from ..ros_wire.key_messages import message_reader, message_writer
from ..system.given_units import changed
from ..system.live_keys import KeyInput, KeyOutput, KeyPath, field_parts, seconds_of
from ..variables.model_description import Value, Variable
from ..variables.units import Linear
from ..variables.value_conversion import ValueRefused, checked_value, to_plain, to_value
from ..variables.value_types import PlainValue
from ..wire.messages import decode_json
from ..wire.values import MAX_VALUE_SIZE

__all__ = ["KeyReader", "TimedValue", "key_writer"]

_SHOWN: Final = 80
_ENCODINGS: Final = {
    "application/json": "json",
    "text/json": "json",
    "text/plain": "text",
    "zenoh/string": "text",
    "application/cdr": "cdr",
}
_VALUE: Final = "value"
_NOTHING: Final = object()


class TimedValue(NamedTuple):
    """A value, its time in s (None: it takes effect on arrival), and whether that is simulation time."""

    value: Value
    time: float | None = None
    is_simulated: bool = False


class KeyReader:
    """Reads the values of one variable from the payloads of its key."""

    def __init__(self, own: KeyInput, variable: Variable, *, finite: bool) -> None:
        self._own, self._variable, self._finite = own, variable, finite
        self._field = field_parts(own.field) if own.field is not None and own.encoding != "cdr" else None
        has_field = own.encoding != "cdr" and own.time not in ("arrival", "timestamp")
        self._time = field_parts(own.time) if has_field else None
        self._change = Linear(own.factor, own.offset)
        bounded = variable.minimum is not None or variable.maximum is not None
        self._any_float = variable.type == "Float64" and not variable.shape and not bounded
        self._messages = message_reader(own, variable) if own.encoding == "cdr" else None

    def read(self, sample: zenoh.Sample) -> TimedValue:
        """The value of a sample, and when it takes effect.

        Raises:
            ValueRefused: it has none, or one that is not allowed; says why.
        """
        if sample.kind == zenoh.SampleKind.DELETE:
            raise ValueRefused("the key was deleted")
        data = sample.payload.to_bytes()
        if len(data) > MAX_VALUE_SIZE:
            raise ValueRefused(f"{len(data)} bytes are too many for a value")
        plain, time = self._decoded(data, str(sample.encoding).partition(";")[0])
        if self._own.time == "timestamp":
            if sample.timestamp is None:
                raise ValueRefused("it has no timestamp of Zenoh: its publisher or a router has to add them")
            time = sample.timestamp.get_time_as_ntp64().as_nanos() / 1e9
        said = plain
        if self._own.map and (word := _word(plain)) in self._own.map:
            plain = self._own.map[word]
        value = changed(plain, self._change)
        if not (self._any_float and type(value) is float and math.isfinite(value)):  # the usual number needs no check
            try:
                value = to_value(value, self._variable, finite=self._finite)
            except ValueRefused:  # in words, which take longer than a value
                value = checked_value(value, self._variable, repr(said)[:_SHOWN], finite=self._finite)
        is_simulated = self._own.simulated and not isinstance(time, str)
        return TimedValue(value, seconds_of(time) if time is not None else None, is_simulated)

    def _decoded(self, data: bytes, encoding: str) -> tuple[Any, Any]:
        """The value, and its time in s or as ISO 8601; the time is None where the payload does not say it."""
        match self._own.encoding if self._own.encoding != "auto" else _ENCODINGS.get(encoding, "auto"):
            case "cdr" if self._messages is not None:
                try:
                    (value,), stamp = self._messages.values(data)
                except CdrError as error:
                    raise ValueRefused(f"it is no '{self._own.type}': {error}") from error
                if value is None or (stamp is None and self._own.time not in ("arrival", "timestamp")):
                    raise ValueRefused("the message has no such value, or no stamp")
                return value, stamp / 1e9 if stamp is not None else None
            case "cdr":
                raise ValueRefused("it is a message of ROS, for which there is no `encoding: cdr` with a type")
            case "float64":
                if not data or len(data) % 8:
                    raise ValueRefused(f"{len(data)} bytes are no doubles")
                numbers = np.frombuffer(data, "<f8")
                is_whole = numbers.size == self._variable.size
                return (numbers.reshape(self._variable.shape) if is_whole else numbers).tolist(), None
            case kind:
                return self._from_text(data, kind)

    def _from_text(self, data: bytes, kind: str) -> tuple[Any, Any]:
        has_parts = self._field is not None or self._time is not None
        is_one_text = self._variable.type == "String" and not self._variable.shape and not has_parts
        try:
            found = decode_json(data, object) if kind != "text" or not is_one_text else _NOTHING
        except MessageRefused as error:
            if kind == "json" or has_parts:
                raise ValueRefused(f"it is no JSON ({error})") from error
            found = _NOTHING
        if found is _NOTHING:
            try:
                return data.decode(), None
            except UnicodeDecodeError as error:
                raise ValueRefused("it is no text in UTF-8") from error
        time = None
        if self._time is not None and seconds_of(time := _at(found, self._time, self._own.time)) is None:
            raise ValueRefused(f"its '{self._own.time}' is no time: neither seconds nor ISO 8601")
        if self._field is not None:
            return _at(found, self._field, self._own.field or ""), time
        return (_at(found, (_VALUE,), _VALUE) if isinstance(found, dict) else found), time


def _at(found: Any, parts: KeyPath, path: str) -> Any:  # noqa: ANN401  any JSON
    """What is at a path of JSON; of several elements with a text, the last one counts, as in messages of ROS."""
    for part in parts:
        match part:
            case str() if isinstance(found, dict) and part in found:
                found = found[part]
            case int() if isinstance(found, list) and part < len(found):
                found = found[part]
            case (name, text) if isinstance(found, list):
                rows = [one for one in found if isinstance(one, dict) and _word(one.get(name)) == text]
                if not rows:
                    raise ValueRefused(f"it has no '{path}'")
                found = rows[-1]
            case _:
                raise ValueRefused(f"it has no '{path}'")
    return found


def _word(plain: object) -> str:
    """What a map calls a value: true, 1, open."""
    return str(plain).lower() if isinstance(plain, bool) else str(plain)


def key_writer(own: KeyOutput, variable: Variable) -> tuple[Callable[[Value, int, float], bytes], zenoh.Encoding]:
    """What makes a payload of a value, its point and its time in s, and its encoding.

    The value is that of the variable, or of its element.
    """
    change = Linear(own.factor, own.offset)

    def value_of(value: Value) -> PlainValue:
        return own.map.get(_word(value), to_plain(changed(value, change)))

    match own.encoding:
        case "json":
            encode = msgspec.json.encode
            return (
                lambda value, point, time: encode({"value": value_of(value), "time": time, "point": point}),
                zenoh.Encoding.APPLICATION_JSON,
            )
        case "text":

            def text(value: Value, _point: int, _time: float) -> bytes:
                plain = value_of(value)
                return plain.encode() if isinstance(plain, str) else msgspec.json.encode(plain)

            return text, zenoh.Encoding.TEXT_PLAIN
        case "float64":

            def doubles(value: Value, _point: int, _time: float) -> bytes:
                return np.asarray(changed(value, change), "<f8").tobytes()

            return doubles, zenoh.Encoding.ZENOH_BYTES
        case "cdr":
            messages = message_writer(own, variable)
            return lambda value, _point, time: messages.make([value_of(value)], time), zenoh.Encoding.APPLICATION_CDR
