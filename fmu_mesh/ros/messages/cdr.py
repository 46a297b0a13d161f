"""CDR, the bytes of a ROS message: plain CDR version 1, as every ROS 2 middleware sends it (DDSI-RTPS 2.5, clause 10).

A message is a dict of its fields, and a nested message is a dict in it. An array of numbers is a numpy array, any other
array is a list.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

from .cdr_fields import HEADER_SIZE, ByteOrder, CdrError, Message, MessageReader, field_of
from .definitions import FieldType, MessageTypes, Nested

__all__ = ["MAX_MESSAGE_SIZE", "CdrError", "Codec", "Message"]

MAX_MESSAGE_SIZE: Final = 4 * 2**20
"""Largest size of a message, in bytes."""

_BYTE_ORDERS: Mapping[bytes, ByteOrder] = {b"\x00\x00": ">", b"\x00\x01": "<"}


class Codec:
    """Encodes and decodes the messages of one type.

    Args:
        types: has the definition of the type.
        message: full name of the type.

    Raises:
        UnknownType: there is no such type.
        CdrError: the type has a field that cannot be encoded here (wstring, float128).

    Example:
        >>> codec = Codec(MessageTypes(), "std_msgs/msg/Float64")
        >>> codec.decode(codec.encode({"data": 1.5}))
        {'data': 1.5}
    """

    def __init__(self, types: MessageTypes, message: str) -> None:
        self.message = message
        self._types = types
        self._field = field_of(types, Nested(message), "")

    def empty(self) -> Message:
        """A message in which every number is 0, and every string and every sequence is empty."""
        message: Message = self._field.empty()
        return message

    def empty_field(self, kind: FieldType) -> Any:  # noqa: ANN401 a value of any type
        """The value of a field of this kind in an empty message."""
        return field_of(self._types, kind, "").empty()

    def encode(self, message: Mapping[str, Any]) -> bytes:
        """The bytes of a message, little endian.

        Raises:
            CdrError: a field is missing, or its value does not fit.
        """
        data = bytearray(b"\x00\x01\x00\x00")
        self._field.encode(data, message)
        return bytes(data)

    def decode(self, data: bytes) -> Message:
        """The message in ``data``.

        Raises:
            CdrError: ``data`` is not a message of this type.
        """
        if len(data) > MAX_MESSAGE_SIZE:
            raise CdrError(f"{len(data)} bytes are too many for a message")
        byte_order = _BYTE_ORDERS.get(data[:2]) if len(data) >= HEADER_SIZE else None
        if byte_order is None:
            raise CdrError(f"it does not start as CDR does ({data[:HEADER_SIZE].hex(' ')})")
        reader = MessageReader(data, byte_order)
        message: Message = self._field.decode(reader)
        if reader.rest >= HEADER_SIZE:  # up to three bytes may fill a word
            raise CdrError(f"{reader.rest} bytes are left behind the message")
        return message
