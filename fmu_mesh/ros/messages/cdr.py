"""CDR, the bytes of a ROS message: plain CDR version 1, as every ROS 2 middleware sends it (DDSI-RTPS 2.5, clause 10).

A message is a dict of its fields, a nested message a dict in it; a sequence or array of numbers is a numpy array, of
anything else a list. Decoding trusts nothing: whatever the bytes say, the work and the memory are bounded by the size
of the message, and what does not fit is a `CdrError`.
"""

from __future__ import annotations

import struct
import sys
from collections.abc import Callable, Mapping
from typing import Any, Final

import numpy as np

from .definitions import MAX_ELEMENTS, Array, Basic, FieldType, MessageTypes, Nested, Sequence

__all__ = ["MAX_MESSAGE_SIZE", "CdrError", "Codec", "Message"]

MAX_MESSAGE_SIZE: Final = 4 * 2**20
"""Bytes that a message may have."""

Message = dict[str, Any]
"""A decoded message."""

_HEADER_SIZE = 4
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
_ENDS = {b"\x00\x00": ">", b"\x00\x01": "<"}


class CdrError(ValueError):
    """Bytes that are no message of the type, or a value that does not fit into its field; names the field."""


class _Reader:
    """The bytes of one message, and how far they have been read. Alignment counts from the end of the header."""

    __slots__ = ("data", "elements", "position")

    def __init__(self, data: bytes) -> None:
        self.data = data
        self.position = _HEADER_SIZE
        self.elements = MAX_ELEMENTS

    def need(self, count: int, name: str) -> int:
        """The position of the next ``count`` bytes, which are read then."""
        start = self.position
        if count > len(self.data) - start:
            raise CdrError(f"the message ends in '{name}'")
        self.position = start + count
        return start

    def take_elements(self, count: int, name: str) -> None:
        """Note that ``count`` Python objects are about to be made."""
        self.elements -= count
        if self.elements < 0:
            raise CdrError(f"'{name}': more than {MAX_ELEMENTS} elements")


_Encode = Callable[[bytearray, Any], None]
_Decode = Callable[[_Reader], Any]


class Codec:
    """Encodes and decodes the messages of one type.

    Args:
        types: where the definition is.
        message: full name of the type.

    Raises:
        UnknownType: there is no such type.
        CdrError: the type has a field that CDR cannot carry here (wstring, float128).
    """

    def __init__(self, types: MessageTypes, message: str) -> None:
        self.message = message
        self._types = types
        self._encode = self._encoder(Nested(message), "")
        self._decode = {end: self._decoder(Nested(message), "", end) for end in "<>"}

    def empty(self) -> Message:
        """A message in which every number is 0, every string and every sequence empty."""
        message: Message = self.empty_field(Nested(self.message))
        return message

    def encode(self, message: Mapping[str, Any]) -> bytes:
        """The bytes of a message, little endian.

        Raises:
            CdrError: a field is missing or its value does not fit.
        """
        data = bytearray(b"\x00\x01\x00\x00")
        self._encode(data, message)
        return bytes(data)

    def decode(self, data: bytes) -> Message:
        """The message in ``data``.

        Raises:
            CdrError: it is none of this type; nothing of it is used.
        """
        if len(data) > MAX_MESSAGE_SIZE:
            raise CdrError(f"{len(data)} bytes are too many for a message")
        end = _ENDS.get(data[:2]) if len(data) >= _HEADER_SIZE else None
        if end is None:
            raise CdrError(f"it does not start as CDR does ({data[:_HEADER_SIZE].hex(' ')})")
        reader = _Reader(data)
        message: Message = self._decode[end](reader)
        if len(data) - reader.position >= _HEADER_SIZE:  # up to three bytes may fill a word
            raise CdrError(f"{len(data) - reader.position} bytes are left behind the message")
        return message

    def empty_field(self, kind: FieldType) -> Any:  # noqa: ANN401 a value of any type
        """What a field of this kind has in an empty message."""
        match kind:
            case Basic("string"):
                return ""
            case Basic(basic):
                return struct.unpack(_format(basic, "<"), bytes(struct.calcsize(_format(basic, "<"))))[0]
            case Nested(message):
                return {name: self.empty_field(own) for name, own in self._types.fields(message)}
            case Sequence(element) | Array(element):
                length = kind.length if isinstance(kind, Array) else 0
                if (dtype := _dtype(element)) is not None:
                    return np.zeros(length, dtype)
                return [self.empty_field(element) for _ in range(length)]

    # --- encoding

    def _encoder(self, kind: FieldType, name: str) -> _Encode:
        match kind:
            case Basic("string", bound):
                return _string_encoder(bound, name)
            case Basic(basic):
                return _number_encoder(basic, name)
            case Nested(message):
                return self._message_encoder(message, name)
            case Array(element, length):
                return self._elements_encoder(element, name, length=length)
            case Sequence(element, bound):
                return self._elements_encoder(element, name, bound=bound)

    def _message_encoder(self, message: str, name: str) -> _Encode:
        parts = [(own, self._encoder(kind, _path(name, own))) for own, kind in self._types.fields(message)]

        def encode(data: bytearray, value: Mapping[str, Any]) -> None:
            try:
                for own, part in parts:
                    part(data, value[own])
            except (KeyError, TypeError) as error:
                raise CdrError(f"'{name or message}' is no complete {message}: {error!r}") from error

        return encode

    def _elements_encoder(
        self, element: Basic | Nested, name: str, *, length: int | None = None, bound: int = 0
    ) -> _Encode:
        dtype = _dtype(element)
        one = self._encoder(element, name)
        write_length = _number_encoder("uint32", name)

        def encode(data: bytearray, value: Any) -> None:  # noqa: ANN401 any sequence
            count = len(value)
            if (length is not None and count != length) or (bound and count > bound):
                raise CdrError(f"'{name}' has {count} elements where {length or f'at most {bound}'} are right")
            if length is None:
                write_length(data, count)
            if dtype is None:
                for item in value:
                    one(data, item)
            elif count:
                _align(data, dtype.itemsize)
                data += _exact(value, dtype, name).tobytes()

        return encode

    # --- decoding

    def _decoder(self, kind: FieldType, name: str, end: str) -> _Decode:
        match kind:
            case Basic("string", bound):
                return _string_decoder(bound, name, end)
            case Basic(basic):
                return _number_decoder(basic, name, end)
            case Nested(message):
                parts = [
                    (own, self._decoder(own_kind, _path(name, own), end))
                    for own, own_kind in self._types.fields(message)
                ]
                return lambda reader: {own: part(reader) for own, part in parts}
            case Array(element, length):
                return self._elements_decoder(element, name, end, lambda _reader: length)
            case Sequence(element, bound):
                count = _number_decoder("uint32", name, end)

                def read_count(reader: _Reader) -> int:
                    number: int = count(reader)
                    if bound and number > bound:
                        raise CdrError(f"'{name}' has {number} elements where at most {bound} are right")
                    return number

                return self._elements_decoder(element, name, end, read_count)

    def _elements_decoder(
        self, element: Basic | Nested, name: str, end: str, read_count: Callable[[_Reader], int]
    ) -> _Decode:
        dtype = _dtype(element)
        if dtype is None:
            one = self._decoder(element, name, end)

            def decode_each(reader: _Reader) -> list[Any]:
                count = read_count(reader)
                reader.take_elements(count, name)
                return [one(reader) for _ in range(count)]

            return decode_each
        raw = dtype.newbyteorder("<" if end == "<" else ">")
        if element == Basic("bool"):
            raw = np.dtype(np.uint8)

        def decode(reader: _Reader) -> Any:  # noqa: ANN401 an array
            count = read_count(reader)
            if not count:
                return np.zeros(0, dtype)
            reader.position += (_HEADER_SIZE - reader.position) % raw.itemsize
            start = reader.need(count * raw.itemsize, name)
            return np.frombuffer(reader.data, raw, count, start).astype(dtype)

        return decode


def _path(name: str, own: str) -> str:
    return f"{name}.{own}" if name else own


def _format(basic: str, end: str) -> str:
    if basic not in _FORMATS:
        raise CdrError(f"a field of the type {basic} cannot be sent or received")
    return end + _FORMATS[basic]


def _dtype(element: Basic | Nested) -> np.dtype[Any] | None:
    """The dtype of an array of numbers; None for anything else."""
    if isinstance(element, Nested) or element.kind == "string":
        return None
    return np.dtype(_format(element.kind, "=" if sys.byteorder == "little" else "<"))


def _exact(value: Any, dtype: np.dtype[Any], name: str) -> np.ndarray[Any, np.dtype[Any]]:  # noqa: ANN401 any sequence
    """The elements as little-endian numbers; whole ones must fit."""
    try:
        array = np.asarray(value)
        if dtype.kind in "iu" and array.dtype.kind not in "iub":
            raise CdrError(f"'{name}' takes whole numbers only")
        if dtype.kind in "iu":
            limits = np.iinfo(dtype)
            if int(array.min()) < limits.min or int(array.max()) > limits.max:
                raise CdrError(f"'{name}' takes numbers from {limits.min} to {limits.max}")
        return array.astype(dtype)
    except (TypeError, OverflowError) as error:
        raise CdrError(f"'{name}': {error}") from error


def _align(data: bytearray, size: int) -> None:
    data += _PADDING[(_HEADER_SIZE - len(data)) % size]


def _number_encoder(basic: str, name: str) -> _Encode:
    packer = struct.Struct(_format(basic, "<"))
    pack, size = packer.pack, packer.size

    def encode(data: bytearray, value: Any) -> None:  # noqa: ANN401 a number
        try:
            packed = pack(value)
        except (struct.error, OverflowError) as error:
            raise CdrError(f"'{name}' cannot be {value!r}: {error}") from error
        data += _PADDING[(_HEADER_SIZE - len(data)) % size]
        data += packed

    return encode


def _number_decoder(basic: str, name: str, end: str) -> _Decode:
    packer = struct.Struct(_format(basic, end))
    unpack, size = packer.unpack_from, packer.size

    def decode(reader: _Reader) -> Any:  # noqa: ANN401 a number
        reader.position += (_HEADER_SIZE - reader.position) % size
        return unpack(reader.data, reader.need(size, name))[0]

    return decode


def _string_encoder(bound: int, name: str) -> _Encode:
    write_length = _number_encoder("uint32", name)

    def encode(data: bytearray, value: Any) -> None:  # noqa: ANN401 checked
        if not isinstance(value, str):
            raise CdrError(f"'{name}' takes text, not {value!r}")
        if bound and len(value) > bound:
            raise CdrError(f"'{name}' takes at most {bound} characters")
        try:
            text = value.encode()
        except UnicodeEncodeError as error:
            raise CdrError(f"'{name}': {error}") from error
        if b"\0" in text:
            raise CdrError(f"'{name}' cannot hold a NUL character")
        write_length(data, len(text) + 1)
        data += text
        data += b"\0"

    return encode


def _string_decoder(bound: int, name: str, end: str) -> _Decode:
    read_length = _number_decoder("uint32", name, end)

    def decode(reader: _Reader) -> str:
        length = read_length(reader)
        start = reader.need(length, name)
        data = reader.data[start : start + length]
        try:
            text = data.removesuffix(b"\0").decode()
        except UnicodeDecodeError as error:
            raise CdrError(f"'{name}' is no UTF-8: {error}") from error
        if bound and len(text) > bound:
            raise CdrError(f"'{name}' has more than {bound} characters")
        return text

    return decode
