"""From values of the mesh to ROS messages, and back.

Owns which values belong into one message: those of one communication point, not those that arrived last.
"""

from __future__ import annotations

import math
from base64 import b64decode
from collections import deque
from collections.abc import Callable, Iterator
from itertools import pairwise
from operator import getitem
from typing import Any

import numpy as np

from ..variables.model_description import Value
from ..variables.value_types import DTYPES, flattened, nested
from .cdr import CdrError, Codec, Message
from .definitions import FLOATS, HEADER, Array, Basic, FieldType, MessageTypes, Nested, Part, Sequence, path_parts
from .keyed_rows import FieldReader
from .stamp import in_nanoseconds, to_stamp
from .topics import Port, Topic

__all__ = ["Assembler", "Disassembler"]

_MAX_WAITING = 1 << 14


class Assembler:
    """Makes the messages of one published topic.

    A message belongs to one point. If the variables have different step sizes, every point of one of them has a
    message, with the values that hold at that point. The paths of the topic have no keys, only indexes.

    Raises:
        CdrError: messages of this type cannot be encoded.
    """

    def __init__(self, topic: Topic, types: MessageTypes) -> None:
        self.topic = topic
        self._codec = Codec(types, topic.message)
        self._message = self._codec.empty()
        self._setters = [self._setter(port, types) for port in topic.ports]
        for path, value in topic.constants:
            owner, last = self._place(path, types)
            owner[last] = value
        self._steps = [port.step_points for port in topic.ports]
        self._waiting: list[deque[tuple[int, float, Any]]] = [deque(maxlen=_MAX_WAITING) for _ in topic.ports]
        self._last = -1
        self._headers = list(_headers(self._message, Nested(topic.message), types))
        named = {path for path, _ in topic.constants} | {port.path for port in topic.ports}
        for path, header in self._headers:
            if f"{path}.frame_id" not in named:
                header["frame_id"] = topic.frame_id

    def add(self, port: int, point: int, time: float, value: Value) -> Iterator[tuple[bytes, float]]:
        """Take the value of a port at a point, and yield every message that is complete now, in CDR, and its time in s.

        Raises:
            CdrError: a value does not fit into its field.
        """
        self._waiting[port].append((point, time, value))
        while all(self._waiting):
            heads = [waiting[0] for waiting in self._waiting]
            ends = [head[0] + step for head, step in zip(heads, self._steps, strict=True)]
            now = max(head[0] for head in heads)
            # Drop the values that do not hold at this point any more; after a message, those that end first.
            until = now if now > self._last else min(ends)
            over = [waiting for waiting, end in zip(self._waiting, ends, strict=True) if end <= until]
            for waiting in over:
                waiting.popleft()
            if not over:
                self._last = now
                stamp = next(head[1] for head in heads if head[0] == now)
                yield self.make([head[2] for head in heads], stamp), stamp

    def begin_again(self) -> None:
        """Forget the values so far: the points begin again."""
        self._last = -1
        for waiting in self._waiting:
            waiting.clear()

    def make(self, values: list[Any], time: float) -> bytes:
        """Make the message with these values, one per port, at ``time`` in s.

        Arrays are lists, or flat in numpy; a Binary is bytes, or base64 as in JSON.

        Raises:
            CdrError: a value does not fit into its field.
        """
        for put, value in zip(self._setters, values, strict=True):
            put(value)
        stamp = to_stamp(time) if self._headers else None
        for _, header in self._headers:
            header["stamp"] = stamp
        return self._codec.encode(self._message)

    def _setter(self, port: Port, types: MessageTypes) -> Callable[[Any], None]:
        """Make a function that puts a value of the mesh into its field."""
        container, last = self._place(port.path, types)
        kind = types.field(self.topic.message, port.path)
        element = kind if isinstance(kind, Basic) else getattr(kind, "element", None)
        floats = isinstance(element, Basic) and element.kind in FLOATS
        dtype = np.float64 if floats else DTYPES[port.variable.type]
        shape, is_binary = port.variable.shape, port.variable.type == "Binary"
        if shape and "layout" in self._message:
            self._message["layout"]["dim"] = [
                {"label": f"dim{axis}", "size": size, "stride": math.prod(shape[axis:])}
                for axis, size in enumerate(shape)
            ]

        def put(value: Any) -> None:  # noqa: ANN401 a value of any variable
            if shape:
                elements = value if isinstance(value, np.ndarray) else flattened(value, len(shape))
                container[last] = np.asarray(elements, dtype)  # "-INF" becomes a float, too
            elif is_binary:
                container[last] = np.frombuffer(b64decode(value) if isinstance(value, str) else value, np.uint8)
            else:
                container[last] = float(value) if floats and isinstance(value, str) else value

        return put

    def _place(self, path: str, types: MessageTypes) -> tuple[Any, Part]:
        """The message or list that holds the field at ``path``, and the name or index of the field there.

        Sequences on the way are made as long as the path needs them; new elements are empty.
        """
        parts = path_parts(path)
        container: Any = self._message
        reached = ""
        for part, following in pairwise(parts):
            reached += f"[{part}]" if isinstance(part, int) else f".{part}" if reached else str(part)
            if isinstance(following, int):
                kind = types.field(self.topic.message, reached)
                container[part] = self._with_length(container[part], following + 1, kind)
            container = container[part]
        return container, parts[-1]

    def _with_length(self, elements: Any, length: int, kind: FieldType) -> list[Any]:  # noqa: ANN401 an array or a list
        """The elements as a list; a sequence is made at least ``length`` long."""
        # It is a list already if another port has a field in it.
        listed: list[Any] = elements if isinstance(elements, list) else elements.tolist()
        if isinstance(kind, Sequence):
            listed += [self._codec.empty_field(kind.element) for _ in range(length - len(listed))]
        return listed


class Disassembler:
    """Reads the values of the variables from the messages of one subscribed topic.

    Attributes:
        fields: where the values are; it counts what has no variable.
    """

    def __init__(self, topic: Topic, types: MessageTypes) -> None:
        self.topic = topic
        self.fields = FieldReader(topic, types, getitem)
        self._codec = Codec(types, topic.message)
        self._stamped = types.has_header(topic.message)

    def values(self, data: bytes) -> tuple[list[Value | None], int | None]:
        """The values of the ports, and the stamp in ns; the stamp is None if it is 0 or if there is no header.

        A value is None if the message has none, so that the present one holds.

        Raises:
            CdrError: the bytes are not such a message, or an element of a port is not in it.
        """
        message = self._codec.decode(data)
        values = [
            _in_shape(value, port) if value is not None else None
            for port, value in zip(self.topic.ports, self.fields.read(message), strict=True)
        ]
        if not self._stamped:
            return values, None
        stamp = message["header"]["stamp"]
        return values, in_nanoseconds(stamp["sec"], stamp["nanosec"]) or None


def _headers(value: Any, kind: FieldType, types: MessageTypes, path: str = "") -> Iterator[tuple[str, Message]]:  # noqa: ANN401 any field
    """The path and the value of every header in a message and in the elements of its arrays."""
    match kind:
        case Nested(message) if message == HEADER and path:
            yield path, value
        case Nested(message):
            for name, own in types.fields(message):
                yield from _headers(value[name], own, types, f"{path}.{name}" if path else name)
        case Array(Nested() as element) | Sequence(Nested() as element):
            for index, own_value in enumerate(value):
                yield from _headers(own_value, element, types, f"{path}[{index}]")


def _in_shape(value: Any, port: Port) -> Value:  # noqa: ANN401 a field of any message
    """A field as a value of the mesh, an array in the shape of its variable."""
    if port.variable.type == "Binary":
        return bytes(value)
    plain: Value = value.tolist() if isinstance(value, np.ndarray | np.generic) else value
    if not port.variable.shape:
        return plain
    if not isinstance(plain, list) or len(plain) != port.variable.size:
        raise CdrError(f"'{port.path}' needs {port.variable.size} elements for '{port.variable.name}'")
    return nested(plain, port.variable.shape)
