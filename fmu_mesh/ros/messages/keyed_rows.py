"""Tables in messages: which element has a key. `definitions` says what a key in a path is.

Elements of a received message have any order, so `FieldReader` looks for the texts in each message. Those of a
published message have the order of the configuration, so `by_index` finds their indexes once.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import count
from typing import Any

import numpy as np
from msgspec.structs import replace

from ...text import listed
from .cdr import CdrError
from .definitions import FLOATS, Basic, FieldTypes, Key, Part
from .topics import Topic

__all__ = ["FieldReader", "by_index"]

_MAX_STRANGERS = 100
_EMPTY: Mapping[str, str | bool] = {"string": "", "bool": False}

_Rows = dict[str, int]
"""The index of each key in a table."""


def by_index(topic: Topic, types: FieldTypes) -> Topic:
    """The same published topic with an index for each key, and with constants for the keys and for what is not mapped.

    The order is that of the first mention, unless a constant has a key already. All mapped columns get the length of
    the keys. A float without a variable is NaN, as in the joint_state_broadcaster of ros2_control: readers drop NaN,
    while 0 would be a position that nobody has measured.

    Raises:
        ValueError: two constants have the same key.
    """
    order = _Order(topic, types)
    ports = tuple(replace(port, path=order.indexed(port.path)) for port in topic.ports)
    constants = [(order.indexed(path), value) for path, value in topic.constants]
    constants += [own for own in order.keyed() if own not in constants]
    used = {*(path for path, _ in constants), *(port.path for port in ports)}
    for column, rows in order.columns.items():
        for path in sorted({f"{column}[{index}]" for index in rows.values()} - used):
            if isinstance(kind := types.field(topic.message, path), Basic):
                constants.append((path, math.nan if kind.kind in FLOATS else _EMPTY.get(kind.kind, 0)))
    return replace(topic, ports=ports, constants=tuple(constants))


class _Order:
    """The index of each key in one published message.

    Attributes:
        columns: the mapped arrays that are parallel to keys, and the indexes of these.
    """

    def __init__(self, topic: Topic, types: FieldTypes) -> None:
        self.columns: dict[str, _Rows] = {}
        # By where their keys are: at `head[index]` in an array of texts, else at `head[index].tail`.
        self._tables: dict[tuple[str, str], _Rows] = {}
        self._topic = topic
        self._types = types

    def indexed(self, path: str) -> str:
        """The path with an index for each key."""
        reached: list[str] = []
        for part, text, holder in self._types.resolved(self._topic.message, path).steps:
            if not isinstance(part, Key):
                reached.append(text)
                continue
            head, tail = "".join(reached[:holder]), f".{part.field}"
            if holder is not None:
                head, tail = f"{head}{tail}".removeprefix("."), ""
            if (head, tail) not in self._tables:
                self._tables[head, tail] = self._fixed(head, tail)
            rows = self._tables[head, tail]
            if holder is not None:
                self.columns["".join(reached)] = rows
            index = rows.setdefault(part.text, next(n for n in count() if n not in rows.values()))
            reached.append(f"[{index}]")
        return "".join(reached)

    def keyed(self) -> Iterator[tuple[str, str]]:
        """The place of each key, and the key."""
        for (head, tail), rows in self._tables.items():
            yield from ((f"{head}[{index}]{tail}", key) for key, index in rows.items())

    def _fixed(self, head: str, tail: str) -> _Rows:
        """The keys that constants give to a table."""
        rows: _Rows = {}
        for path, key in self._topic.constants:
            found = re.fullmatch(rf"{re.escape(head)}\[(\d+)\]{re.escape(tail)}", path)
            if found is not None and rows.setdefault(str(key), int(found[1])) != int(found[1]):
                raise ValueError(f"'{key}' at '{path}', and at '{head}[{rows[str(key)]}]{tail}'")
        return rows


class FieldReader:
    """Reads the fields of a topic from its messages; ``get`` reads a field of a message by its name.

    Attributes:
        ignored: how many elements have come whose keys no path has.
    """

    def __init__(self, topic: Topic, types: FieldTypes, get: Callable[[Any, str], Any]) -> None:
        self.topic = topic
        self.ignored = 0
        self._get = get
        self._strangers: list[str] = []
        self._known: set[str] = set()
        # The keys of each table, by the path to it; each part has the table that it belongs to.
        self._tables: dict[str, set[str]] = {}
        self._paths: list[tuple[str, list[tuple[Part, str, int | None]]]] = []
        for port in topic.ports:
            steps: list[tuple[Part, str, int | None]] = []
            reached: list[str] = []
            for part, text, holder in types.resolved(topic.message, port.path).steps:
                table = f"{''.join(reached[:holder])} {part.field}" if isinstance(part, Key) else ""
                if isinstance(part, Key):
                    self._tables.setdefault(table, set()).add(part.text)
                steps.append((part, table, holder))
                reached.append(text)
            self._paths.append((port.path, steps))
        self._found: dict[str, tuple[_Rows, int]] = {}  # in the present message, with the number of its rows

    @property
    def warning(self) -> str:
        """What to say of ignored keys that the last message has brought for the first time; empty if there are none."""
        if not self._strangers:
            return ""
        found, there = (listed(sorted(own)) for own in (self._strangers, set().union(*self._tables.values())))
        return f"elements that no variable has are ignored: {found}; variables have {there}"

    def read(self, message: Any) -> list[Any]:  # noqa: ANN401 a message of any type
        """The value at each path; None, which keeps the present value, if the message lacks a key or has NaN there.

        Raises:
            CdrError: an array has no such index, or is not as long as its keys.
        """
        self._strangers = []
        self._found.clear()
        return [self._value(message, *own) for own in self._paths]

    def _value(self, message: Any, path: str, steps: Sequence[tuple[Part, str, int | None]]) -> Any:  # noqa: ANN401 as above
        values = [message]
        for part, table, holder in steps:
            value = values[-1]
            if isinstance(part, str):
                values.append(self._get(value, part))
                continue
            index: int | None = part if isinstance(part, int) else None
            if isinstance(part, Key):
                if table not in self._found:
                    own = self._get(values[holder], part.field) if holder is not None else None
                    self._find(table, [self._get(element, part.field) for element in value] if own is None else own)
                rows, length = self._found[table]
                if len(value) not in (0, length):
                    raise CdrError(f"'{path}' is one of {len(value)} elements for {length} texts in '{part.field}'")
                index = rows.get(part.text) if len(value) else None
                if index is None:
                    return None
            if index is None or index >= len(value):
                raise CdrError(f"it has no '{path}'")
            values.append(value[index])
        value = values[-1]
        is_nan = isinstance(value, float | np.floating) and math.isnan(value)
        return None if is_nan and any(table for _, table, _ in steps) else value

    def _find(self, table: str, texts: Sequence[str]) -> None:
        """Find the rows of a table by the texts in a message; of two that are equal, the last counts."""
        others = [text for text in texts if text not in self._tables[table]]
        self.ignored += len(others)
        self._strangers += [text for text in dict.fromkeys(others) if text not in self._known]
        self._known.update(self._strangers[: _MAX_STRANGERS - len(self._known)])
        self._found[table] = {text: index for index, text in enumerate(texts)}, len(texts)
