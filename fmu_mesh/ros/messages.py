"""Between values of the mesh and ROS messages: assembling a message of values, and taking one apart.

Owns which values belong into one message: those of one communication point, never those that came last.
"""

from __future__ import annotations

import math
import re
from collections import deque
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from ..model.description import Value
from ..model.types import flattened, nested
from .cdr import CdrError, Codec, Message
from .stamp import from_stamp, to_stamp
from .topics import Port, Topic
from .types import Basic, MessageTypes, Sequence

__all__ = ["Assembler", "Disassembler"]

_WAITING = 1 << 14
_PART = re.compile(r"[^.\[\]]+|\[[0-9]+\]")
_FLOATS = {"NaN": float("nan"), "INF": float("inf"), "-INF": float("-inf")}


class Assembler:
    """Makes the messages of one published topic.

    A message belongs to one point. Where its variables are of instances with different step sizes, there is one at
    every point of any of them, with the values that hold there.
    """

    def __init__(self, topic: Topic, types: MessageTypes) -> None:
        self.topic = topic
        self._codec = Codec(types, topic.message)
        self._message = self._codec.empty()
        self._setters = [_setter(self._message, port, types, topic.message) for port in topic.ports]
        self._steps = [port.step_points for port in topic.ports]
        self._waiting: list[deque[tuple[int, float, Any]]] = [deque(maxlen=_WAITING) for _ in topic.ports]
        self._last = -1
        if topic.stamped:
            self._message["header"]["frame_id"] = topic.frame_id

    def add(self, port: int, point: int, time: float, value: Value) -> Iterator[tuple[bytes, float]]:
        """Take the value of a port at a point, and yield the messages that are complete now, with their times in s.

        Raises:
            CdrError: a value does not fit into its field.
        """
        self._waiting[port].append((point, time, value))
        while all(self._waiting):
            heads = [waiting[0] for waiting in self._waiting]
            ends = [head[0] + step for head, step in zip(heads, self._steps, strict=True)]
            now = max(head[0] for head in heads)
            # What holds no longer at this point goes; after a message, what ends first.
            until = now if now > self._last else min(ends)
            over = [waiting for waiting, end in zip(self._waiting, ends, strict=True) if end <= until]
            for waiting in over:
                waiting.popleft()
            if not over:
                self._last = now
                stamp = next(head[1] for head in heads if head[0] == now)
                yield self.make([head[2] for head in heads], stamp), stamp

    def make(self, values: list[Any], time: float) -> bytes:
        """The message that has these values, one per port, at ``time`` s.

        Raises:
            CdrError: a value does not fit into its field.
        """
        for put, value in zip(self._setters, values, strict=True):
            put(value)
        if self.topic.stamped:
            self._message["header"]["stamp"] = to_stamp(time)
        return self._codec.encode(self._message)


class Disassembler:
    """Takes the messages of one subscribed topic apart."""

    def __init__(self, topic: Topic, types: MessageTypes) -> None:
        self.topic = topic
        self._codec = Codec(types, topic.message)
        self._paths = [_parts(port.path) for port in topic.ports]

    def values(self, data: bytes) -> tuple[list[Value], float | None]:
        """The values of the ports, and the stamp in s; None without a header, or with a stamp of zero.

        Raises:
            CdrError: the bytes are no such message, or an element that a port needs is not in it.
        """
        message = self._codec.decode(data)
        values = []
        for port, path in zip(self.topic.ports, self._paths, strict=True):
            value: Any = message
            try:
                for part in path:
                    value = value[part]
            except IndexError as error:
                raise CdrError(f"the message has no '{port.path}'") from error
            values.append(_in_shape(value, port))
        if not self.topic.stamped:
            return values, None
        stamp = message["header"]["stamp"]
        time = from_stamp(stamp["sec"], stamp["nanosec"])
        return values, time or None


def _parts(path: str) -> list[str | int]:
    """`pose.covariance[7]` as `pose`, `covariance`, 7."""
    return [int(part[1:-1]) if part.startswith("[") else part for part in _PART.findall(path)]


def _setter(message: Message, port: Port, types: MessageTypes, name: str) -> Callable[[Any], None]:
    """A function that puts a value of the mesh into its field of ``message``."""
    parts = _parts(port.path)
    container: Any = message
    for depth, part in enumerate(parts[:-1]):
        following = container[part]
        if isinstance(parts[depth + 1], int):
            following = container[part] = _with_length(following, int(parts[depth + 1]) + 1, types, name, port.path)
        container = following
    kind = types.field(name, port.path)
    element = kind if isinstance(kind, Basic) else getattr(kind, "element", None)
    floats = isinstance(element, Basic) and element.kind in ("float64", "float32")
    last, shape = parts[-1], port.variable.shape
    if shape and "layout" in message:
        message["layout"]["dim"] = [
            {"label": f"dim{axis}", "size": size, "stride": math.prod(shape[axis:])} for axis, size in enumerate(shape)
        ]

    def one(value: Any) -> Any:  # noqa: ANN401 a value of any variable
        return _FLOATS[value] if floats and isinstance(value, str) else value

    def put(value: Any) -> None:  # noqa: ANN401 a value of any variable
        container[last] = [one(own) for own in flattened(value, len(shape))] if shape else one(value)

    return put


def _in_shape(value: Any, port: Port) -> Value:  # noqa: ANN401 a field of any message
    """A field as a value of the mesh: an array in the shape of its variable.

    Raises:
        CdrError: there are too many elements, or too few.
    """
    plain: Value = value.tolist() if isinstance(value, np.ndarray | np.generic) else value
    if not port.variable.shape:
        return plain
    if not isinstance(plain, list) or len(plain) != port.variable.size:
        raise CdrError(f"'{port.path}' needs {port.variable.size} elements for '{port.variable.name}'")
    return nested(plain, port.variable.shape)


def _with_length(
    elements: Any,  # noqa: ANN401 an array or a list
    length: int,
    types: MessageTypes,
    name: str,
    path: str,
) -> list[Any]:
    """The elements as a list, with zeros up to ``length`` where a sequence is shorter."""
    listed = elements if isinstance(elements, list) else list(elements)  # the list that another port has already
    kind = types.field(name, path[: path.rfind("[")])
    if isinstance(kind, Sequence) and isinstance(kind.element, Basic):
        zero: Any = "" if kind.element.kind == "string" else 0
        listed += [zero] * (length - len(listed))
    return listed
