"""Whether messages of a type can carry the variables of a topic, and which type carries a variable by default.

Knows the fields of messages and their types, but not the names in a configuration. The last check makes or prepares a
message in the same way as the running gateway, so a topic that passes can be sent or received.
"""

from __future__ import annotations

from collections.abc import Mapping

import msgspec
import numpy as np

from ..config.findings import Findings
from ..config.mesh import RosTopicConfig
from ..text import listed, nearest, shown
from ..variables.model_description import Variable
from ..variables.value_types import VariableType, nested, zero
from .assembling import Assembler, Disassembler
from .cdr import CdrError
from .definitions import (
    FLOATS,
    HEADER,
    NUMBERS,
    Array,
    Basic,
    FieldType,
    MessageTypes,
    Nested,
    Part,
    Sequence,
    UnknownField,
    UnknownType,
    path_parts,
)
from .keyed_rows import by_index
from .topics import Direction, Port, Topic

__all__ = ["TopicEntry", "carries", "check_topic", "default_type"]

_OTHER_NAMES: Mapping[str, str] = {"byte": "uint8", "char": "uint8", "Boolean": "bool", "Enumeration": "int64"}

_BYTES = tuple(Basic(name) for name in ("uint8", "byte", "char"))

_PLAIN: Mapping[str, type | tuple[type, ...]] = {
    "string": str,
    "bool": bool,
    "float32": (int, float),
    "float64": (int, float),
}
"""The type of a constant in the configuration by the kind of its field; for any other kind it is an int."""


class TopicEntry(msgspec.Struct, frozen=True):
    """One entry of `ros.topics`, with its path in the file and the path of its variable.

    ``shape`` is the path of the ready shape that its fields come from, if the file does not have them.
    """

    item: RosTopicConfig
    path: str
    variable_path: str
    shape: str | None = None

    def place(self, field: str) -> str:
        """The path in the file that findings about a field name."""
        return self.shape or f"{self.path}.fields.{field}"


def default_type(variable_type: VariableType, *, array: bool = False) -> str | None:
    """The message type that carries a variable on a topic of its own; None if std_msgs has none.

    An array becomes a multi-array (`std_msgs/msg/Float64MultiArray`); std_msgs has these for numbers only.

    Example:
        >>> default_type("Boolean")
        'std_msgs/msg/Bool'
    """
    if variable_type == "Binary" or (array and variable_type in ("Boolean", "String")):
        return None
    name = {"Boolean": "Bool", "Enumeration": "Int64"}.get(variable_type, variable_type)
    return f"std_msgs/msg/{name}{'MultiArray' if array else ''}"


def carries(target: str, source: str) -> bool:
    """Whether every value of the kind ``source`` fits into ``target``; both are kinds of fields, or FMI types.

    Whole numbers are never rounded. float64 may go into float32: the user has chosen that precision.
    """
    to, of = (_OTHER_NAMES.get(name, name.lower()) for name in (target, source))
    if to == of:
        return True
    if not {to, of} <= NUMBERS:
        return False
    if to in FLOATS and of in FLOATS:
        return True
    # numpy counts 64-bit integers into float64 as safe, although they may be rounded.
    return np.can_cast(of, to) and not (to in FLOATS and of in ("int64", "uint64"))


def check_topic(
    entry: TopicEntry, topic: Topic, types: MessageTypes, findings: Findings, warnings: list[tuple[str, str, str]]
) -> Topic:
    """Add a finding for everything that keeps the messages of ``topic`` from carrying its variables and constants.

    The arguments of a finding go to ``warnings`` for each subscribed element by an index that could be a key.

    Returns:
        The topic; if it is published, with indexes instead of keys.
    """
    before = len(findings)
    for port in topic.ports:
        _check_port(entry, topic, port, types, findings)
    if len(findings) > before:
        return topic
    if topic.constants and topic.direction == "in":
        found = "constants of a topic that is subscribed"
        findings.add(f"{entry.path}.constants", found, "constants of published messages only")
        return topic
    for field, value in topic.constants:
        _check_constant(f"{entry.path}.constants.{field}", topic.message, (field, value), types, findings)
    for path in (port.path for port in topic.ports if port.direction == "in"):
        if (by_key := types.resolved(topic.message, path).by_key) != path:
            found = f"'{path}' of '{topic.message}', whose elements may come in any order"
            warnings.append((f"{entry.path}.fields.{path}", found, f"a key: {by_key}"))
    if len(findings) == before and topic.direction == "out":
        try:
            topic = _check_places(entry, topic, types, findings)
        except ValueError as error:
            findings.add(f"{entry.path}.constants", str(error), "each key once")
    if len(findings) == before and (reason := _why_not_carried(topic, types)) is not None:
        found = f"'{topic.message}' for '{topic.name}': {reason}"
        findings.add(f"{entry.path}.type", found, "messages that can be sent and received")
    return topic


def _why_not_carried(topic: Topic, types: MessageTypes) -> str | None:
    """Why no message of a topic can be made or read; None if it can. A message is made to find out."""
    try:
        if topic.direction == "in":
            Disassembler(topic, types)
            return None
        variables = [port.variable for port in topic.ports]
        values = [nested([zero(own.type)] * own.size, own.shape) for own in variables]
        Assembler(topic, types).make(values, 0.0)
    except CdrError as error:
        return str(error)
    return None


def _check_port(entry: TopicEntry, topic: Topic, port: Port, types: MessageTypes, findings: Findings) -> None:
    message, written = topic.message, bool(entry.item.fields)
    place = entry.place(port.path) if written else f"{entry.path}.type"
    try:
        kind = types.field(message, port.path)
    except UnknownType as error:
        near = nearest(message, error.names)
        findings.add(f"{entry.path}.type", f"the unknown message type '{message}'", "one of ROS", near)
        return
    except UnknownField as error:
        expected = f"one of {listed(error.names)}{'' if written else ', given in `fields`'}"
        findings.add(place, str(error), expected, nearest(port.path, error.names) if written else None)
        return
    if port.variable.type == "Binary":
        fits = not port.variable.shape and isinstance(kind, Sequence) and kind.element in _BYTES
        reason = None if fits else "only uint8[] holds a Binary, and one of them"
    else:
        reason = _unfit(kind, port.variable, topic.direction)
    if reason is not None:
        found = f"'{port.path}' of '{message}' for '{port.instance}.{port.variable.name}': {reason}"
        best = default_type(port.variable.type, array=bool(port.variable.shape))
        findings.add(place, found, f"a field that holds it{f', as in {best}' if best else ''}")


def _check_constant(
    place: str, message: str, constant: tuple[str, str | float], types: MessageTypes, findings: Findings
) -> None:
    field, value = constant
    try:
        kind = types.field(message, field)
    except UnknownField as error:
        findings.add(place, str(error), f"one of {listed(error.names)}", nearest(field, error.names))
        return
    found = f"{shown(value)} for '{field}' of '{message}'"
    if not isinstance(kind, Basic):
        findings.add(place, found, "a field of one value")
    elif not isinstance(value, _PLAIN.get(kind.kind, int)) or (isinstance(value, bool) and kind.kind != "bool"):
        findings.add(place, found, f"a value of the type {kind.kind}")


def _check_places(entry: TopicEntry, topic: Topic, types: MessageTypes, findings: Findings) -> Topic:
    """Check that each field has one source, and return the topic with indexes instead of keys.

    The stamp of a header is the simulation time already.
    """
    given: dict[tuple[Part, ...], str] = {}
    made = by_index(topic, types)
    written = [("fields", port.path) for port in topic.ports] + [("constants", field) for field, _ in topic.constants]
    added = [("fields", f"[…={value}]") for _, value in made.constants[len(topic.constants) :]]
    paths = [*(port.path for port in made.ports), *(path for path, _ in made.constants)]
    named = zip(paths, [*written, *added], strict=True)
    for path, (section, field) in sorted(named, key=lambda own: (len(path_parts(own[0])), own[1] not in added)):
        parts = path_parts(path)
        heads = [parts[:end] for end in range(1, len(parts) + 1)]
        other = next((given[head] for head in heads if head in given), None)
        if other is not None:
            found = f"'{field}', which '{other}' gives already"
            findings.add(f"{entry.path}.{section}.{field}", found, "a value once for each field")
        given[heads[-1]] = field
        stamp = path.rpartition(".stamp")[0]
        if stamp and types.field(topic.message, stamp) == Nested(HEADER):
            found = f"'{field}', which is the simulation time"
            findings.add(f"{entry.path}.{section}.{field}", found, "a field that is no stamp of a header")
    return made


def _unfit(kind: FieldType, variable: Variable, direction: Direction) -> str | None:
    """Why a field cannot hold a variable; None if it can."""
    if isinstance(kind, Nested):
        return "it is a message itself"
    array = bool(variable.shape)
    if array == isinstance(kind, Basic):
        return "an array into one value" if array else "one value into an array; write an index, such as data[0]"
    element = kind if isinstance(kind, Basic) else kind.element
    if not isinstance(element, Basic):
        return "its elements are messages themselves"
    if isinstance(kind, Array) and kind.length != variable.size:
        return f"it has {kind.length} elements, and the variable {variable.size}"
    if isinstance(kind, Sequence) and kind.bound and variable.size > kind.bound:
        return f"it has at most {kind.bound} elements, and the variable {variable.size}"
    source, target = (variable.type, element.kind) if direction == "out" else (element.kind, variable.type)
    return None if carries(target, source) else f"{source} into {target} may lose something"
