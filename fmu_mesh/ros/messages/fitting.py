"""Whether messages of a type can carry what an entry of `ros.topics` puts into them, and out of them.

Knows fields and their types, and no names of the mesh. What passes here can be sent and received: the last check
makes a message on trial, in the way in which it is made when the mesh runs.
"""

from __future__ import annotations

from collections.abc import Mapping

import msgspec

from ...config.findings import Findings
from ...config.mesh import RosTopicConfig
from ...text import listed, nearest, shown
from ...variables.model_description import Variable
from ...variables.value_types import nested
from ..gateway.topics import Direction, Port, Topic
from .assembling import Assembler, Disassembler
from .cdr import MAX_MESSAGE_SIZE, CdrError
from .definitions import (
    HEADER,
    Array,
    Basic,
    FieldType,
    MessageTypes,
    Nested,
    Sequence,
    UnknownField,
    UnknownType,
    carries,
    default_type,
    path_parts,
)

__all__ = ["Entry", "check_fields", "why_not_carried"]

_PLAIN: Mapping[str, type | tuple[type, ...]] = {
    "string": str,
    "bool": bool,
    "float32": (int, float),
    "float64": (int, float),
}
"""What a constant is in the file, by the kind of its field; for any other kind, an int."""


class Entry(msgspec.Struct, frozen=True):
    """One entry of `ros.topics`, where it stands, and where its variable stands."""

    item: RosTopicConfig
    path: str
    variable_path: str


def check_fields(  # noqa: PLR0913, PLR0917  an entry, what was found for it, and where findings go
    entry: Entry,
    message: str,
    ports: tuple[Port, ...],
    direction: Direction,
    types: MessageTypes,
    findings: Findings,
) -> None:
    """See whether each field is there, holds its variable or constant, and is given once."""
    before = len(findings)
    for port in ports:
        _check_port(entry, message, port, direction, types, findings)
    if len(findings) > before:
        return
    if entry.item.constants and direction == "in":
        found = "constants of a topic that is subscribed"
        findings.add(f"{entry.path}.constants", found, "constants of published messages only")
        return
    for field, value in entry.item.constants.items():
        _check_constant(f"{entry.path}.constants.{field}", message, field, value, types, findings)
    if len(findings) == before and direction == "out":
        _check_places(entry, message, ports, types, findings)


def why_not_carried(topic: Topic, types: MessageTypes) -> str | None:
    """Why no message of a topic can be made or read, as found by a trial; None if it can."""
    try:
        if topic.direction == "in":
            Disassembler(topic, types)
            return None
        empty = {"String": "", "Boolean": False}
        values = [
            nested([empty.get(port.variable.type, 0)] * port.variable.size, port.variable.shape) for port in topic.ports
        ]
        size = len(Assembler(topic, types).make(values, 0.0))
    except CdrError as error:
        return str(error)
    return None if size <= MAX_MESSAGE_SIZE else f"{size} bytes are too many for a message"


def _check_port(  # noqa: PLR0913, PLR0917  as above
    entry: Entry, message: str, port: Port, direction: Direction, types: MessageTypes, findings: Findings
) -> None:
    written = bool(entry.item.fields)
    place = f"{entry.path}.fields.{port.path}" if written else f"{entry.path}.type"
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
    reason = _unfit(kind, port.variable, direction)
    if reason is not None:
        found = f"'{port.path}' of '{message}' for '{port.instance}.{port.variable.name}': {reason}"
        best = default_type(port.variable.type, array=bool(port.variable.shape))
        findings.add(place, found, f"a field that holds it, as in {best}")


def _check_constant(  # noqa: PLR0913, PLR0917  as above
    place: str, message: str, field: str, value: str | float, types: MessageTypes, findings: Findings
) -> None:
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


def _check_places(entry: Entry, message: str, ports: tuple[Port, ...], types: MessageTypes, findings: Findings) -> None:
    """Whether each place of a message is given once; the stamp of a header is the simulation time already."""
    given: dict[tuple[str | int, ...], str] = {}
    fields = [*(("fields", port.path) for port in ports), *(("constants", field) for field in entry.item.constants)]
    for section, field in sorted(fields, key=lambda own: len(path_parts(own[1]))):
        parts = path_parts(field)
        heads = [tuple(parts[:end]) for end in range(1, len(parts) + 1)]
        other = next((given[head] for head in heads if head in given), None)
        if other is not None:
            found = f"'{field}', which '{other}' gives already"
            findings.add(f"{entry.path}.{section}.{field}", found, "a value once for each field")
        given[heads[-1]] = field
        stamp = field.rpartition(".stamp")[0]
        if stamp and types.field(message, stamp) == Nested(HEADER):
            found = f"'{field}', which is the simulation time"
            findings.add(f"{entry.path}.{section}.{field}", found, "a field that is no stamp of a header")


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
