"""ROS message types: their fields, how a path addresses a field, and their RIHS01 hashes.

A path has the names of fields, indexes (`poses[0]`), and keys. A key finds an element by the text in a field of it
(`transforms[child_frame_id=tool]`), or in a parallel array of texts (`position[name=elbow]`).

The definitions come from `rosbags` as data; no code that `rosbags` could generate from them is run. The bytes of a
message are the matter of `fmu_mesh.ros_wire.cdr`.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any, Final, Literal

import msgspec
from msgspec.structs import replace

from ..errors import ConfigurationError
from ..installing import importing

if TYPE_CHECKING:
    from rosbags.typesys.store import Typestore

__all__ = [
    "CLOCK",
    "FLOATS",
    "HEADER",
    "MAX_ELEMENTS",
    "NUMBERS",
    "TIME",
    "Array",
    "Basic",
    "Distribution",
    "FieldPath",
    "FieldType",
    "FieldTypes",
    "Key",
    "MessageTypes",
    "Nested",
    "Part",
    "Sequence",
    "UnknownField",
    "UnknownType",
    "is_message_name",
    "path_parts",
]

CLOCK = "rosgraph_msgs/msg/Clock"
TIME = "builtin_interfaces/msg/Time"
HEADER = "std_msgs/msg/Header"

MAX_ELEMENTS: Final = 1 << 16
"""Largest number of strings and nested messages in all arrays of one message; every index is below it."""

FLOATS: Final = frozenset({"float32", "float64"})
NUMBERS: Final = FLOATS | {"bool", *(f"{sign}int{bits}" for sign in ("", "u") for bits in (8, 16, 32, 64))}
"""Kinds of fields that numpy has by the same names; `byte` and `char` are other names of `uint8`."""

Distribution = Literal["humble", "jazzy", "kilted", "lyrical"]

_NO_FIELDS: Any = [("structure_needs_at_least_one_member", (1, ("uint8", 0)))]
"""What ROS gives a message without fields, on the wire, too."""

_MESSAGE_NAME = re.compile(r"[a-z][a-z0-9_]*/(?:msg|srv)/[A-Z][A-Za-z0-9_]*")
_INDEX = re.compile(r"[0-9]{1,9}")
_PART = re.compile(r"""(?:^|\.)([^.\[\]]+)|\[(\w+)=(["']?)(.+?)\3\]|\[([^\]]*)\]""")
_USUAL_KEY = re.compile(r"(.*_)?(names?|key|id)")
"""Names of fields whose texts tell rows apart, as in every message of ROS that is a table."""


class Basic(msgspec.Struct, frozen=True):
    """A number, a bool or a string; ``bound`` is the length limit of a string, 0 for no limit."""

    kind: str
    bound: int = 0


class Nested(msgspec.Struct, frozen=True):
    """A message in a message."""

    message: str


class Array(msgspec.Struct, frozen=True):
    """An array with a fixed number of elements."""

    element: Basic | Nested
    length: int


class Sequence(msgspec.Struct, frozen=True):
    """An array with any number of elements, at most ``bound`` if that is not 0."""

    element: Basic | Nested
    bound: int = 0


FieldType = Basic | Nested | Array | Sequence


class Key(msgspec.Struct, frozen=True):
    """A part of a path that finds an element by the text of a field; without ``field`` it is an index that is wrong.

    Attributes:
        table: where the texts are: a path, which an index follows, and the rest; none if they are in a parallel array.
    """

    field: str
    text: str
    table: tuple[str, str] = ("", "")


Part = str | int | Key


class FieldPath(msgspec.Struct, frozen=True):
    """What a path leads to, its parts with their texts, and the path with a key for each index that could be one."""

    kind: FieldType
    steps: tuple[tuple[Part, str], ...]
    by_key: str


class UnknownType(ValueError):
    """No message type has this name; ``names`` lists the known types."""

    def __init__(self, message: str, names: tuple[str, ...]) -> None:
        super().__init__(f"there is no message type '{message}'")
        self.names = names


class UnknownField(ValueError):
    """A message has no field at this path; ``names`` lists the paths of its fields."""

    def __init__(self, message: str, path: str, names: tuple[str, ...], reason: str = "") -> None:
        super().__init__(f"'{message}' has no field '{path}'{f': {reason}' if reason else ''}")
        self.names = names


class FieldTypes:
    """What messages consist of, and what is at a path in them."""

    def fields(self, message: str) -> tuple[tuple[str, FieldType], ...]:
        """The fields of a message, in order."""
        raise NotImplementedError

    def field(self, message: str, path: str) -> FieldType:
        """The type of the field at a path such as `twist.linear.x`, `pose.covariance[7]` or `position[name=elbow]`.

        Raises:
            UnknownType: there is no such type.
            UnknownField: there is no such field, or the array has no such index or key.
        """
        return self.resolved(message, path).kind

    def resolved(self, message: str, path: str) -> FieldPath:
        """What a path leads to; raises as `field` does."""
        kind: FieldType = Nested(message)
        outer: list[tuple[str, str]] = []  # the messages on the way, by their paths
        steps: list[tuple[Part, str]] = []
        reached = by_key = ""
        for part, text in _pieces(path) or [("", "")]:
            if isinstance(kind, Nested):
                outer.append((reached, kind.message))
            element = kind.element if isinstance(kind, Array | Sequence) else None
            keys = self._keys(element, outer, reached) if element is not None else {}
            found = dict(self.fields(kind.message)).get(str(part)) if isinstance(kind, Nested) else element
            names: tuple[str, ...] = ()
            usual = reason = ""
            match part:
                case str():
                    found = None if element is not None else found
                    if isinstance(element, Nested):
                        reason = f"'{reached}' is an array, write an index, such as {reached}[0]{text}"
                case _ if element is None:
                    reason = "it is no array"
                case Key(field, own) if field:
                    reason = "" if field in keys else f"'{field}' is no text that tells its elements apart"
                    rest = path[len(reached) + len(text) :]
                    names = tuple(f"{reached}[{key}={own}]{rest}" for key in keys)
                case _:
                    reason = _index_problem(kind, part)
                    likely = (key for key, (_, rest) in keys.items() if bool(rest) == isinstance(element, Nested))
                    usual = next(filter(_USUAL_KEY.fullmatch, likely), "")
            if found is None or reason:
                raise UnknownField(message, path, names or tuple(self.paths(message)), reason)
            steps.append((replace(part, table=keys[part.field]) if isinstance(part, Key) else part, text))
            kind, reached = found, reached + text
            by_key += f"[{usual}=…]" if usual else text
        return FieldPath(kind, tuple(steps), by_key)

    def paths(self, message: str, prefix: str = "") -> Iterator[str]:
        """The paths of all fields that are not messages; for an array of messages, the paths in its first element."""
        for name, kind in self.fields(message):
            if isinstance(kind, Nested):
                yield from self.paths(kind.message, f"{prefix}{name}.")
            elif isinstance(kind, Array | Sequence) and isinstance(kind.element, Nested):
                yield from self.paths(kind.element.message, f"{prefix}{name}[0].")
            else:
                yield f"{prefix}{name}"

    def _keys(self, element: Basic | Nested, outer: list[tuple[str, str]], array: str) -> dict[str, tuple[str, str]]:
        """The keys that an array of such elements can have, with the table of each."""
        own = self.fields(element.message) if isinstance(element, Nested) else ()
        keys = {name: (array, f".{name}") for name, kind in own if getattr(kind, "kind", "") == "string"}
        for reached, message in reversed(outer):
            for name, kind in self.fields(message):
                path = f"{reached}.{name}" if reached else name
                if path != array and getattr(getattr(kind, "element", None), "kind", "") == "string":
                    keys.setdefault(name, (path, ""))
        return keys


class MessageTypes(FieldTypes):
    """The message types of a ROS distribution, and custom ones.

    Args:
        distribution: the ROS 2 distribution whose definitions are used.
        custom: definitions in the syntax of a `.msg` file, by full name (`my_msgs/msg/Wheel`).

    Raises:
        ConfigurationError: `rosbags` is not installed, or a custom definition is wrong.
    """

    def __init__(self, distribution: Distribution = "jazzy", custom: Mapping[str, str] | None = None) -> None:
        with importing("rosbags", "message types of ROS"):
            from rosbags.typesys import Stores, get_typestore  # noqa: PLC0415  an optional dependency
        self.distribution = distribution
        # New types are put into `fielddefs`: `register` would execute code that it generates from a definition.
        self.store: Typestore = get_typestore(Stores[f"ROS2_{distribution.upper()}"])
        self._hashes: dict[str, str] = {}
        # In ROS 2 char is uint8, in type hashes too; rosbags would hash it as a separate type.
        for name, (constants, fields) in self.store.fielddefs.items():
            if any("char" in repr(kind) for _, kind in fields):
                self.store.fielddefs[name] = (constants, [(own, _without_char(kind)) for own, kind in fields])
        for name, text in (custom or {}).items():
            self.define(name, text)
        for name in custom or {}:
            try:
                list(self.paths(name))
            except UnknownType as error:
                raise ConfigurationError(f"the definition of '{name}': {error}") from error

    def define(self, name: str, text: str) -> None:
        """Add a definition in the syntax of a `.msg` file.

        Raises:
            ConfigurationError: the text is not a definition, or the name has another definition already.
        """
        from rosbags.typesys import TypesysError, get_types_from_msg  # noqa: PLC0415  as above

        if not is_message_name(name):
            raise ConfigurationError(f"'{name}' is no name of a message type; write package/msg/Name.")
        try:
            defined = get_types_from_msg(text, name)
        except TypesysError as error:
            raise ConfigurationError(f"the definition of '{name}' is not understood: {error}") from error
        for own, (constants, known) in defined.items():
            fields = (constants, known or _NO_FIELDS)
            if self.store.fielddefs.setdefault(own, fields) != fields:
                raise ConfigurationError(f"'{own}' is defined already, with other fields")

    def __contains__(self, message: str) -> bool:
        return message in self.store.fielddefs

    def fields(self, message: str) -> tuple[tuple[str, FieldType], ...]:
        """The fields of a message, in order.

        Raises:
            UnknownType: there is no such type.
        """
        if message not in self.store.fielddefs:
            raise UnknownType(message, tuple(self.store.fielddefs))
        return tuple((name, _field_type(description)) for name, description in self.store.fielddefs[message][1])

    def has_header(self, message: str) -> bool:
        """Whether a message has a field `header` of the type `std_msgs/msg/Header`, and so a stamp."""
        return ("header", Nested(HEADER)) in self.fields(message)

    def type_hash(self, message: str) -> str:
        """The RIHS01 hash of a message, or of a service that `define_service` has added (REP 2016)."""
        if message not in self._hashes:
            self.fields(message)
            self._hashes[message] = self.store.hash_rihs01(message)
        return self._hashes[message]

    def define_service(self, name: str, request: str, response: str) -> None:
        """Add a service as the messages that ROS derives from it: request, response and event (REP 2016)."""
        one: dict[str, object] = {}
        for part, text in (("Request", request), ("Response", response)):
            as_message = f"{name.replace('/srv/', '/msg/')}_{part}"
            self.define(as_message, text)
            self.store.fielddefs[f"{name}_{part}"] = self.store.fielddefs.pop(as_message)
            one[part] = (2, f"{name}_{part}")
        event = [
            ("info", (2, "service_msgs/msg/ServiceEventInfo")),
            ("request", (4, (one["Request"], 1))),
            ("response", (4, (one["Response"], 1))),
        ]
        whole = [
            ("request_message", one["Request"]),
            ("response_message", one["Response"]),
            ("event_message", (2, f"{name}_Event")),
        ]
        self.store.fielddefs.update(msgspec.convert({f"{name}_Event": ([], event), name: ([], whole)}, Any))

    def definition(self, message: str) -> str:
        """The text of a definition with every type that it refers to, in the format `ros2msg` of MCAP and Foxglove."""
        self.fields(message)
        text, _md5 = self.store.generate_msgdef(message, ros_version=2)
        return text


def path_parts(path: str) -> tuple[Part, ...]:
    """Split a path: `pose.covariance[7]` becomes `("pose", "covariance", 7)`; what is no path has no parts."""
    return tuple(part for part, _ in _pieces(path))


def _pieces(path: str) -> list[tuple[Part, str]]:
    """The parts of a path, and the text of each."""
    pieces: list[tuple[Part, str]] = []
    end = 0
    while (found := _PART.match(path, end)) is not None:
        name, key, _, text, index = found.groups()
        number: Part = int(index) if _INDEX.fullmatch(index or "") else Key("", index or "")
        pieces.append((name or (Key(key, text) if key else number), found[0]))
        end = found.end()
    return pieces if end == len(path) else []


def is_message_name(name: str) -> bool:
    """Whether ``name`` has the form `package/msg/Name`."""
    return _MESSAGE_NAME.fullmatch(name) is not None


def _without_char(description: Any) -> Any:  # noqa: ANN401 a nested tuple of rosbags
    if isinstance(description, tuple):
        return tuple(_without_char(part) for part in description)
    return "uint8" if description == "char" else description


def _field_type(description: object) -> FieldType:
    """The field that `rosbags` describes as (kind, (name, bound)), (kind, name), or (kind, (element, length))."""
    match description:
        case (1, (str(kind), int(bound))):
            return Basic(kind, bound)
        case (2, str(message)):
            return Nested(message)
        case (3, (element, int(length))):
            return Array(_element_type(element), length)
        case (4, (element, int(bound))):
            return Sequence(_element_type(element), bound)
    raise ConfigurationError(f"rosbags describes a field in a way that is not known: {description!r}")


def _element_type(description: object) -> Basic | Nested:
    kind = _field_type(description)
    assert isinstance(kind, Basic | Nested)  # ROS has no arrays of arrays
    return kind


def _index_problem(kind: FieldType, index: int | Key) -> str:
    """Why a field cannot have an element with this index; empty if it can."""
    last = MAX_ELEMENTS - 1
    match kind:
        case Array(_, length):
            last = min(last, length - 1)
        case Sequence(_, bound) if bound:
            last = min(last, bound - 1)
    return "" if isinstance(index, int) and index <= last else f"an index is a whole number from 0 to {last}"
