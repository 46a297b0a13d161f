"""Which topics an FMU has as a ROS node, and how their messages and the values of its variables become one another.

Owns the node's parameters `names`, `messages` and `stamped`. Knows nothing of publishers and subscriptions.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from itertools import pairwise
from typing import Any, Literal

import msgspec
import numpy as np

from ...config.findings import Findings
from ...config.yaml_text import Plain, read
from ...errors import ConfigurationError
from ...text import listed, nearest
from ...variables.model_description import ModelDescription, Value, Variable
from ...variables.value_types import flattened, nested
from ..messages.definitions import MAX_ELEMENTS, default_type, path_parts
from ..messages.ros_names import topic_problem
from .node_parameters import names_of
from .rclpy_modules import message_class

__all__ = ["Topic", "fill", "message_time", "own_names", "topics_of", "values_in"]

STAMPED = "geometry_msgs/msg/PointStamped"
"""The smallest message with a header and a float64 that every ROS has: the value is in `point.x`."""
STAMPED_FIELD = "point.x"

_PATH = re.compile(r"\w+(\[\d{1,9}\])?(\.\w+(\[\d{1,9}\])?)*", re.ASCII)
_SEQUENCE = re.compile(r"sequence<(?P<element>.*?)(, (?P<bound>\d+))?>")

_EMPTY: Mapping[str, str | bytes | bool] = {"string": "", "wstring": "", "boolean": False, "octet": b"\0"}
"""What an element of a sequence has until it is given a value; a number has 0."""


class Topic(msgspec.Struct, frozen=True):
    """One topic.

    Attributes:
        name: relative to the node's namespace unless it starts with `/`.
        message: type, such as `std_msgs/msg/Float64`.
        direction: seen from the FMU.
        fields: (path in the message, variable).
        shape: of the variable, where the message carries one array.
    """

    name: str
    message: str
    direction: Literal["in", "out"]
    fields: tuple[tuple[str, str], ...]
    shape: tuple[int, ...] = ()


class _Message(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One entry of the parameter `messages`."""

    type: str
    fields: dict[str, str]


def own_names(entries: Iterable[str]) -> dict[str, str]:
    """The parameter `names`: ROS names by variable, from entries `VARIABLE: NAME`.

    Raises:
        ConfigurationError: an entry is something else.
    """
    names: dict[str, str] = {}
    for entry in entries:
        variable, colon, name = entry.rpartition(":")
        if not colon or not variable.strip() or not name.strip():
            raise ConfigurationError(f"'{entry}' in the parameter 'names' is not of the form 'VARIABLE: NAME'.")
        names[variable.strip()] = name.strip()
    return names


def topics_of(
    description: ModelDescription, names: Mapping[str, str], messages: Sequence[str], *, stamped: bool
) -> list[Topic]:
    """The topics of an FMU: one per input and output, as `fmi_adapter` has them, and those of ``messages``.

    What no message of `std_msgs` carries (Binary, arrays of Boolean or String) has none.

    Args:
        description: of the FMU.
        names: ROS names by variable where the usual ones do not do.
        messages: entries `TOPIC: {type: PACKAGE/msg/TYPE, fields: {PATH: VARIABLE}}`; a variable in one of them has no
            topic of its own.
        stamped: whether every numeric input and output has a second topic `NAME_stamped` of messages with a header.

    Raises:
        ConfigurationError: with everything that is wrong.
    """
    ends = {variable.name: variable for variable in description.with_causality("input", "output")}
    by_variable = names_of(description.variables, names)
    problems: list[str] = []
    topics = [topic for entry in messages if (topic := _mapped(entry, ends, problems)) is not None]
    mapped = {variable for topic in topics for _, variable in topic.fields}
    for variable in ends.values():
        if variable.name not in mapped:
            topics += _own_topics(variable, by_variable[variable.name], stamped=stamped)
    seen: dict[str, Topic] = {}
    for topic in topics:
        other = seen.setdefault(topic.name, topic)
        if other is not topic:
            problems.append(f"the topic '{topic.name}' is used twice")
    if problems:
        raise ConfigurationError(f"the topics of this node are wrong: {'; '.join(problems)}.")
    return topics


def fill(topic: Topic, message: Any, values: Mapping[str, Value], time: int) -> None:  # noqa: ANN401 a ROS message
    """Set the fields of a message, and the stamp of its header if it has one, to ``time`` in ns.

    Sequences get the elements that a path needs; so does the header of such an element get the stamp.
    """
    _stamp(message, time)
    for path, variable in topic.fields:
        owner, last = _place(message, path, lambda own: _stamp(own, time))
        if isinstance(last, int):
            owner[last] = values[variable]
            continue
        value = values[variable]
        if topic.shape:
            value = flattened(value, len(topic.shape))
        # A field takes its own type only; a truth value or a whole number is a number there.
        setattr(owner, last, value if topic.shape else type(getattr(owner, last))(value))


def values_in(topic: Topic, message: Any) -> dict[str, Value]:  # noqa: ANN401 a ROS message
    """The values in a message, by variable.

    Raises:
        IndexError: the message has a sequence that is shorter than a path needs.
    """
    values: dict[str, Value] = {}
    for path, variable in topic.fields:
        value = message
        for part in path_parts(path):
            value = value[part] if isinstance(part, int) else getattr(value, part)
        values[variable] = nested(list(value), topic.shape) if topic.shape else value
    return values


def message_time(message: Any, now: int) -> int:  # noqa: ANN401 a ROS message
    """When a message is valid, in ns: what its header says, or else ``now``."""
    stamp = getattr(getattr(message, "header", None), "stamp", None)
    if stamp is None or not (stamp.sec or stamp.nanosec):
        return now
    return int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)


def _own_topics(variable: Variable, name: str, *, stamped: bool) -> list[Topic]:
    direction: Literal["in", "out"] = "in" if variable.causality == "input" else "out"
    message = default_type(variable.type, array=bool(variable.shape))
    if message is None:
        return []
    topics = [Topic(name, message, direction, (("data", variable.name),), variable.shape)]
    if stamped and not variable.shape and message != "std_msgs/msg/String":
        topics.append(Topic(f"{name}_stamped", STAMPED, direction, ((STAMPED_FIELD, variable.name),)))
    return topics


def _mapped(entry: str, ends: Mapping[str, Variable], problems: list[str]) -> Topic | None:
    """One entry of the parameter `messages`; None if it is wrong, which is told."""
    found = _parsed(entry)
    if found is None:
        problems.append(f"'{entry}' is not of the form 'TOPIC: {{type: PACKAGE/msg/TYPE, fields: {{PATH: VARIABLE}}}}'")
        return None
    name, mapping = found
    before = len(problems)
    if (problem := topic_problem(name)) is not None:
        problems.append(f"'{name}' is no topic: {problem}")
    directions = set()
    for path, variable in mapping.fields.items():
        if variable not in ends:
            near = nearest(variable, ends)
            hint = f"did you mean '{near}'?" if near else f"there are {listed(tuple(ends))}"
            problems.append(f"'{variable}' in '{name}' is no input and no output; {hint}")
            continue
        directions.add(ends[variable].causality)
        _check_field(name, mapping.type, path, problems)
    if len(directions) > 1:
        problems.append(f"'{name}' has inputs and outputs; a topic goes in one direction")
    if len(problems) > before:
        return None
    direction: Literal["in", "out"] = "in" if directions == {"input"} else "out"
    return Topic(name, mapping.type, direction, tuple(mapping.fields.items()))


def _parsed(entry: str) -> tuple[str, _Message] | None:
    findings = Findings("messages")
    plain: Plain = read(entry, findings, {})
    if findings or not isinstance(plain, dict) or len(plain) != 1:
        return None
    [(name, content)] = plain.items()
    try:
        mapping = msgspec.convert(content, _Message)
    except msgspec.ValidationError:
        return None
    return (name, mapping) if mapping.fields else None


def _check_field(topic: str, message: str, path: str, problems: list[str]) -> None:
    try:
        sample = message_class(message)()
    except ConfigurationError as error:
        problems.append(f"'{topic}': {error.message.rstrip('.')}")
        return
    if _PATH.fullmatch(path) is None:
        problems.append(f"'{topic}': '{path}' is no field such as 'poses[0].position.x'")
        return
    try:
        owner, last = _place(sample, path)
        field = owner[last] if isinstance(last, int) else getattr(owner, last)
    except IndexError as error:
        problems.append(f"'{topic}': '{path}' of '{message}' is beyond its {error} elements")
    except (AttributeError, TypeError):
        problems.append(f"'{topic}': '{message}' has no field '{path}'")
    else:
        if not isinstance(field, bool | int | float | str | bytes | np.generic):
            problems.append(f"'{topic}': '{path}' of '{message}' is no single value")


def _place(message: Any, path: str, passed: Callable[[Any], None] = lambda _owner: None) -> tuple[Any, str | int]:  # noqa: ANN401 a ROS message
    """What holds the field at a path, and its name or index there; sequences on the way are made long enough.

    Args:
        message: a ROS message.
        path: such as `poses[0].position.x`.
        passed: called with every message in an array that is on the way.

    Raises:
        AttributeError: there is no such field.
        IndexError: an array cannot have so many elements; the text is how many it can have.
        TypeError: something that has an index is no array.
    """
    parts = path_parts(path)
    owner = message
    for part, following in pairwise(parts):
        if isinstance(following, int):
            assert isinstance(part, str)  # ROS has no arrays of arrays
            _lengthen(owner, part, following + 1)
            owner = getattr(owner, part)
        elif isinstance(part, int):
            owner = owner[part]
            passed(owner)
        else:
            owner = getattr(owner, part)
    return owner, parts[-1]


def _lengthen(owner: Any, name: str, length: int) -> None:  # noqa: ANN401 a ROS message
    """Let the array ``name`` of a message have ``length`` elements at least; new ones are empty."""
    elements = getattr(owner, name)
    sequence = _SEQUENCE.fullmatch(owner.get_fields_and_field_types()[name])
    most = len(elements) if sequence is None else int(sequence["bound"] or MAX_ELEMENTS)
    if length > most:
        raise IndexError(most)
    if sequence is not None and length > len(elements):
        kind = sequence["element"]
        package, slash, own = kind.partition("/")
        make = message_class(f"{package}/msg/{own}") if slash else lambda: _EMPTY.get(kind, 0)
        elements.extend(make() for _ in range(length - len(elements)))


def _stamp(message: Any, time: int) -> None:  # noqa: ANN401 a ROS message
    if hasattr(message, "header"):
        message.header.stamp.sec, message.header.stamp.nanosec = divmod(time, 1_000_000_000)
