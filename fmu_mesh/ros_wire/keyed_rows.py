"""Tables in messages: which element has a key. `definitions` says what a key in a path is.

Elements of a received message have any order, so `FieldReader` looks for the texts in each message. Those of a
published message have the order of the configuration, so `by_index` finds their indexes once.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping, Sequence
from itertools import count
from typing import Any

import numpy as np
from msgspec.structs import replace

from ..printing import printable
from ..text import listed
from .cdr import CdrError
from .definitions import FLOATS, Basic, FieldTypes, Key, Part
from .topics import Topic

__all__ = ["FieldReader", "by_index"]

_MAX_STRANGERS, _MAX_SHOWN = 100, 80
_EMPTY: Mapping[str, str | bool] = {"string": "", "bool": False}

_Rows = dict[str, int]
"""The index of each key in a table."""

_Table = tuple[str, str]
"""Where the texts of a table are, as in `Key`."""


def by_index(topic: Topic, types: FieldTypes) -> Topic:
    """The same published topic with an index for each key, and with constants for the keys and for what is not mapped.

    The order is that of the first mention, unless a constant has a key already. All mapped columns get the length of
    the keys. A float without a variable is NaN, as in the joint_state_broadcaster of ros2_control: readers drop NaN,
    while 0 would be a position that nobody has measured.

    Raises:
        ValueError: two constants have the same key.
    """
    tables, columns = _rows(topic, types)

    def indexed(path: str) -> str:
        steps = types.resolved(topic.message, path).steps
        return "".join(f"[{tables[part.table][part.text]}]" if isinstance(part, Key) else text for part, text in steps)

    ports = tuple(replace(port, path=indexed(port.path)) for port in topic.ports)
    constants = [(indexed(path), value) for path, value in topic.constants]
    for (head, tail), rows in tables.items():
        keys = [(indexed(f"{head}[{index}]{tail}"), key) for key, index in rows.items()]
        constants += [own for own in keys if own not in constants]
    used = {*(path for path, _ in constants), *(port.path for port in ports)}
    for column, table in columns.items():
        for path in sorted({indexed(f"{column}[{index}]") for index in tables[table].values()} - used):
            if isinstance(kind := types.field(topic.message, path), Basic):
                constants.append((path, math.nan if kind.kind in FLOATS else _EMPTY.get(kind.kind, 0)))
    return replace(topic, ports=ports, constants=tuple(constants))


def _rows(topic: Topic, types: FieldTypes) -> tuple[dict[_Table, _Rows], dict[str, _Table]]:
    """The index of each key in the tables of a published message, and the tables of the arrays that are parallel."""
    tables: dict[_Table, _Rows] = {}
    columns: dict[str, _Table] = {}
    for path in (*(port.path for port in topic.ports), *(path for path, _ in topic.constants)):
        array = ""
        for part, text in types.resolved(topic.message, path).steps:
            if isinstance(part, Key):
                rows = tables[part.table] = tables.get(part.table) or _fixed_rows(topic, *part.table)
                rows.setdefault(part.text, next(index for index in count() if index not in rows.values()))
                columns |= {} if part.table[1] else {array: part.table}
            array += text
    return tables, columns


def _fixed_rows(topic: Topic, head: str, tail: str) -> _Rows:
    """The keys that constants give to a table."""
    rows: _Rows = {}
    for path, key in topic.constants:
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
        self._paths = [(port.path, types.resolved(topic.message, port.path).steps) for port in topic.ports]
        self._keys: dict[_Table, set[str]] = {}
        for part in (part for _, steps in self._paths for part, _ in steps if isinstance(part, Key)):
            self._keys.setdefault(part.table, set()).add(part.text)
        self._found: dict[_Table, tuple[_Rows, int]] = {}  # in the present message, with the number of its rows

    @property
    def warning(self) -> str:
        """What to say of ignored keys that the last message has brought for the first time; empty if there are none."""
        if not self._strangers:
            return ""
        found, there = (listed(sorted(own)) for own in (self._strangers, set().union(*self._keys.values())))
        return printable(f"elements that no variable has are ignored: {found}; variables have {there}")

    def read(self, message: Any) -> list[Any]:  # noqa: ANN401 a message of any type
        """The value at each path; None, which keeps the present value, if the message lacks a key or has NaN there.

        Raises:
            CdrError: an array has no such index, or is not as long as its keys.
        """
        self._strangers = []
        self._found.clear()
        return [self._value(message, *own) for own in self._paths]

    def _value(self, message: Any, path: str, steps: Sequence[tuple[Part, str]]) -> Any:  # noqa: ANN401 as above
        value, reached = message, ""
        values = {reached: message}
        for part, text in steps:
            match part:
                case str():
                    value = self._get(value, part)
                case Key(field):
                    if part.table not in self._found:
                        self._find(part, value, values)
                    rows, length = self._found[part.table]
                    if len(value) not in (0, length):
                        raise CdrError(f"'{path}' is one of {len(value)} elements for {length} texts in '{field}'")
                    index = rows.get(part.text)
                    if index is None or not len(value):
                        return None
                    value = value[index]
                case _ if part >= len(value):
                    raise CdrError(f"it has no '{path}'")
                case _:
                    value = value[part]
            reached += text
            values[reached] = value
        is_nan = isinstance(value, float | np.floating) and math.isnan(value)
        return None if is_nan and any(isinstance(part, Key) for part, _ in steps) else value

    def _find(self, key: Key, array: Any, values: Mapping[str, Any]) -> None:  # noqa: ANN401 as above
        """Find the rows of a table by the texts in a message; of two that are equal, the last counts."""
        if key.table[1]:
            texts = [self._get(element, key.field) for element in array]
        else:
            holder = key.table[0].removesuffix(key.field).removesuffix(".")
            texts = self._get(values[holder], key.field)
        others = [text for text in texts if text not in self._keys[key.table]]
        self.ignored += len(others)
        shown = dict.fromkeys(text[:_MAX_SHOWN] for text in others)
        self._strangers += [text for text in shown if text not in self._known]
        self._known.update(self._strangers[: _MAX_STRANGERS - len(self._known)])
        self._found[key.table] = {text: index for index, text in enumerate(texts)}, len(texts)
