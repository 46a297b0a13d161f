"""CDR, the bytes of a ROS message: plain CDR version 1, as every ROS 2 middleware sends it (DDSI-RTPS 2.5, clause 10).

A message is a dict of its fields, and a nested message is a dict in it. An array of numbers is a numpy array, any other
array is a list.

The decoder trusts no input: the size of the message limits its work and its memory, and bytes that do not fit the
definition raise `CdrError`. It interprets definitions: the decoder of `rosbags` would execute code that it generates
from a definition, and a definition may come from a file of somebody else.
"""

from __future__ import annotations

import struct
import sys
from collections.abc import Mapping, Sized
from typing import Any, Final, Literal, Protocol

import numpy as np

from .definitions import MAX_ELEMENTS, Array, Basic, FieldType, MessageTypes, Nested, Sequence

__all__ = ["HEADER_SIZE", "MAX_MESSAGE_SIZE", "CdrError", "Codec", "Message"]

Message = dict[str, Any]
"""A decoded message."""

ByteOrder = Literal["<", ">"]
"""Little or big endian, as in `struct`."""

MAX_MESSAGE_SIZE: Final = 64 * 2**20
"""Largest size of a message, in bytes: an image of 3840x2160 points with four bytes each has 32 MiB."""

_ZEROS: Final = bytes(MAX_MESSAGE_SIZE)
"""The decoder makes an empty message of them; the operating system gives no memory for what nobody writes."""

HEADER_SIZE: Final = 4
"""Size of the header, in bytes; alignment counts from its end."""

_BYTE_ORDERS: Mapping[bytes, ByteOrder] = {b"\x00\x00": ">", b"\x00\x01": "<"}
_PADDING = tuple(bytes(count) for count in range(8))
_FORMATS: Mapping[str, str] = {
    "bool": "?",
    "byte": "B",
    "char": "B",
    "int8": "b",
    "uint8": "B",
    "int16": "h",
    "uint16": "H",
    "int32": "i",
    "uint32": "I",
    "int64": "q",
    "uint64": "Q",
    "float32": "f",
    "float64": "d",
}


class CdrError(ValueError):
    """Bytes that are not a message of the type, or a value that does not fit into its field; names the field."""


class Codec:
    """Encodes and decodes the messages of one type.

    Raises:
        UnknownType: there is no such type.
        CdrError: the type has a field that cannot be encoded here (wstring, float128).

    Example:
        >>> codec = Codec(MessageTypes(), "std_msgs/msg/Float64")
        >>> codec.decode(codec.encode({"data": 1.5}))
        {'data': 1.5}
    """

    def __init__(self, types: MessageTypes, message: str) -> None:
        self._types = types
        self._field = _field_of(types, Nested(message), "")

    def empty(self) -> Message:
        """A message in which every number is 0, and every string and every sequence is empty."""
        message: Message = self._field.decode(_Reader(_ZEROS, "<"))
        return message

    def empty_field(self, kind: FieldType) -> Any:  # noqa: ANN401 a value of any type
        """The value of a field of this kind in an empty message."""
        return _field_of(self._types, kind, "").decode(_Reader(_ZEROS, "<"))

    def encode(self, message: Mapping[str, Any]) -> bytes:
        """The bytes of a message, little endian.

        Raises:
            CdrError: a field is missing, its value does not fit, or it is all too large.
        """
        data = bytearray(b"\x00\x01\x00\x00")
        self._field.encode(data, message)
        _check_size(data)
        return bytes(data)

    def decode(self, data: bytes) -> Message:
        """The message in ``data``.

        Raises:
            CdrError: ``data`` is not a message of this type.
        """
        _check_size(data)
        byte_order = _BYTE_ORDERS.get(data[:2]) if len(data) >= HEADER_SIZE else None
        if byte_order is None:
            raise CdrError(f"it does not start as CDR does ({data[:HEADER_SIZE].hex(' ')})")
        reader = _Reader(data, byte_order)
        message: Message = self._field.decode(reader)
        if reader.rest >= HEADER_SIZE:  # up to three bytes may fill a word
            raise CdrError(f"{reader.rest} bytes are left behind the message")
        return message


class _Reader:
    """The bytes of one message, and how far they have been read."""

    __slots__ = ("_elements", "_position", "byte_order", "data")

    def __init__(self, data: bytes, byte_order: ByteOrder) -> None:
        self.data = data
        self.byte_order = byte_order
        self._position = HEADER_SIZE
        self._elements = MAX_ELEMENTS

    @property
    def rest(self) -> int:
        """The number of bytes that have not been read."""
        return len(self.data) - self._position

    def take(self, size: int, alignment: int, name: str) -> int:
        """Read the next ``size`` bytes at a multiple of ``alignment`` after the header; returns their position."""
        start = self._position + (HEADER_SIZE - self._position) % alignment
        if size > len(self.data) - start:
            raise CdrError(f"the message ends in '{name}'")
        self._position = start + size
        return start

    def count_elements(self, count: int, name: str) -> None:
        """Note that ``count`` Python objects will be made; a few bytes could ask for very many of them."""
        self._elements -= count
        if self._elements < 0:
            raise CdrError(f"'{name}': more than {MAX_ELEMENTS} elements")


class _Field(Protocol):
    """One field: how its value becomes bytes and back."""

    def encode(self, data: bytearray, value: Any) -> None: ...  # noqa: ANN401 a value of any type

    def decode(self, reader: _Reader) -> Any: ...  # noqa: ANN401 as above


def _field_of(types: MessageTypes, kind: FieldType, name: str) -> _Field:
    """The field of this kind; ``name`` is its path, for errors."""
    match kind:
        case Basic("string", bound):
            return _StringField(bound, name)
        case Basic(basic):
            return _NumberField(basic, name)
        case Nested(message):
            return _MessageField(types, message, name)
        case Array(Basic(basic)) | Sequence(Basic(basic)) if basic != "string":
            return _NumbersField(basic, kind, name)
        case Array() | Sequence():
            return _ElementsField(types, kind, name)


class _NumberField:
    def __init__(self, basic: str, name: str) -> None:
        self._name = name
        self._structs = {order: struct.Struct(order + _format(basic)) for order in _BYTE_ORDERS.values()}
        self._pack, self._size = self._structs["<"].pack, self._structs["<"].size

    def encode(self, data: bytearray, value: Any) -> None:  # noqa: ANN401 a number
        try:
            packed = self._pack(value)
        except (struct.error, OverflowError) as error:
            raise CdrError(f"'{self._name}' cannot be {value!r}: {error}") from error
        _align(data, self._size)
        data += packed

    def decode(self, reader: _Reader) -> Any:  # noqa: ANN401 a number
        start = reader.take(self._size, self._size, self._name)
        return self._structs[reader.byte_order].unpack_from(reader.data, start)[0]


class _StringField:
    def __init__(self, bound: int, name: str) -> None:
        self._bound = bound
        self._name = name
        self._length = _NumberField("uint32", name)

    def encode(self, data: bytearray, value: Any) -> None:  # noqa: ANN401 checked
        if not isinstance(value, str):
            raise CdrError(f"'{self._name}' takes text, not {value!r}")
        if self._bound and len(value) > self._bound:
            raise CdrError(f"'{self._name}' takes at most {self._bound} characters")
        try:
            text = value.encode()
        except UnicodeEncodeError as error:
            raise CdrError(f"'{self._name}': {error}") from error
        if b"\0" in text:
            raise CdrError(f"'{self._name}' cannot hold a NUL character")
        self._length.encode(data, len(text) + 1)
        data += text
        data += b"\0"

    def decode(self, reader: _Reader) -> str:
        length = self._length.decode(reader)
        start = reader.take(length, 1, self._name)
        try:
            text = reader.data[start : start + length].removesuffix(b"\0").decode()
        except UnicodeDecodeError as error:
            raise CdrError(f"'{self._name}' is no UTF-8: {error}") from error
        if self._bound and len(text) > self._bound:
            raise CdrError(f"'{self._name}' has more than {self._bound} characters")
        return text


class _MessageField:
    def __init__(self, types: MessageTypes, message: str, name: str) -> None:
        self._place = f"'{name or message}' is no complete {message}"
        prefix = f"{name}." if name else ""
        self._fields = [(own, _field_of(types, kind, prefix + own)) for own, kind in types.fields(message)]

    def encode(self, data: bytearray, value: Mapping[str, Any]) -> None:
        try:
            for own, field in self._fields:
                field.encode(data, value[own])
        except (KeyError, TypeError) as error:
            raise CdrError(f"{self._place}: {error!r}") from error

    def decode(self, reader: _Reader) -> Message:
        return {own: field.decode(reader) for own, field in self._fields}


class _ArrayField:
    """The number of elements of an array or sequence; only that of a sequence is in the message."""

    def __init__(self, kind: Array | Sequence, name: str) -> None:
        self._name = name
        self._fixed = kind.length if isinstance(kind, Array) else None
        self._bound = kind.bound if isinstance(kind, Sequence) else 0
        self._count = _NumberField("uint32", name)

    def _encode_count(self, data: bytearray, value: Sized) -> int:
        count = len(value)
        if self._fixed is not None and count != self._fixed:
            raise CdrError(f"'{self._name}' has {count} elements where {self._fixed} are right")
        if self._fixed is None:
            self._count.encode(data, self._checked(count))
        return count

    def _decode_count(self, reader: _Reader) -> int:
        return self._fixed if self._fixed is not None else self._checked(self._count.decode(reader))

    def _checked(self, count: int) -> int:
        if self._bound and count > self._bound:
            raise CdrError(f"'{self._name}' has {count} elements where at most {self._bound} are right")
        return count


class _ElementsField(_ArrayField):
    def __init__(self, types: MessageTypes, kind: Array | Sequence, name: str) -> None:
        super().__init__(kind, name)
        self._element = _field_of(types, kind.element, name)

    def encode(self, data: bytearray, value: Any) -> None:  # noqa: ANN401 any sequence
        self._encode_count(data, value)
        for item in value:
            self._element.encode(data, item)

    def decode(self, reader: _Reader) -> list[Any]:
        count = self._decode_count(reader)
        reader.count_elements(count, self._name)
        return [self._element.decode(reader) for _ in range(count)]


class _NumbersField(_ArrayField):
    def __init__(self, basic: str, kind: Array | Sequence, name: str) -> None:
        super().__init__(kind, name)
        # Numbers are native in memory and little endian in the bytes that are sent.
        self._dtype = np.dtype(_format(basic)).newbyteorder("=" if sys.byteorder == "little" else "<")
        # A byte other than 0 and 1 is no bool in memory.
        sent = np.dtype(np.uint8) if basic == "bool" else self._dtype
        self._sent = {order: sent.newbyteorder(order) for order in _BYTE_ORDERS.values()}

    def encode(self, data: bytearray, value: Any) -> None:  # noqa: ANN401 any sequence
        if self._encode_count(data, value):
            _align(data, self._dtype.itemsize)
            data += self._array(value).tobytes()

    def decode(self, reader: _Reader) -> np.ndarray[Any, np.dtype[Any]]:
        count = self._decode_count(reader)
        if not count:
            return np.zeros(0, self._dtype)
        sent = self._sent[reader.byte_order]
        start = reader.take(count * sent.itemsize, sent.itemsize, self._name)
        return np.frombuffer(reader.data, sent, count, start).astype(self._dtype)

    def _array(self, value: Any) -> np.ndarray[Any, np.dtype[Any]]:  # noqa: ANN401 any sequence
        """The elements as numbers; whole numbers must fit."""
        try:
            array = np.asarray(value)
            if self._dtype.kind in "iu":
                if array.dtype.kind not in "iub":
                    raise CdrError(f"'{self._name}' takes whole numbers only")
                limits = np.iinfo(self._dtype)
                if int(array.min()) < limits.min or int(array.max()) > limits.max:
                    raise CdrError(f"'{self._name}' takes numbers from {limits.min} to {limits.max}")
            return array.astype(self._dtype)
        except (TypeError, OverflowError) as error:
            raise CdrError(f"'{self._name}': {error}") from error


def _format(basic: str) -> str:
    if basic not in _FORMATS:
        raise CdrError(f"a field of the type {basic} cannot be sent or received")
    return _FORMATS[basic]


def _check_size(data: bytes | bytearray) -> None:
    if len(data) > MAX_MESSAGE_SIZE:
        raise CdrError(f"{len(data)} bytes are too many for a message")


def _align(data: bytearray, size: int) -> None:
    data += _PADDING[(HEADER_SIZE - len(data)) % size]
