"""Which topics an FMU has in a ROS node, and how values are put into their messages and taken out of them.

Owns the parameters `names`, `messages` and `stamped` of the node. Knows nothing of publishers and subscriptions. The
messages are objects of the user's own ROS, with the default values that ROS gives their fields.
"""

# Threads: rclpy calls `arrived` on threads of its executor. Messages go through the queue of the `FmuThread`, which
# takes inputs and publishes outputs; `_count` is the lock for the number of those that wait, because a queue without
# a limit would take all memory while an FMU hangs (ADR 0031).

from __future__ import annotations

import re
import threading
from collections.abc import Callable, Iterable, Mapping, Sequence
from itertools import pairwise
from typing import Any

import msgspec
from msgspec.structs import replace

from ...config.findings import Findings
from ...config.yaml_text import Plain, read
from ...errors import CallRefused, ConfigurationError
from ...ros_wire.cdr import CdrError
from ...ros_wire.definitions import Basic, UnknownField, path_parts
from ...ros_wire.fitting import default_type
from ...ros_wire.keyed_rows import FieldReader, by_index
from ...ros_wire.rclpy_profile import RosNode, message_class, ros_module
from ...ros_wire.ros_names import topic_problem
from ...ros_wire.stamp import in_nanoseconds
from ...ros_wire.topics import Port, Topic
from ...text import listed, nearest
from ...variables.model_description import ModelDescription, Value, Variable
from ...variables.value_types import flattened, nested
from .driving import FmuDriver, FmuThread, Update
from .rclpy_modules import RosTypes, time_message
from .variable_parameters import names_of

__all__ = ["LOG_INTERVAL_S", "FmuTopics", "fill", "message_time", "own_names", "topics_of", "values_in"]

STAMPED = "geometry_msgs/msg/PointStamped"
"""The smallest message type in every ROS that has a header and a float64."""
STAMPED_FIELD = "point.x"

_SEQUENCE = re.compile(r"sequence<(?P<element>.*?)(, (?P<bound>\d+))?>")

_EMPTY: Mapping[str, str | bytes | bool] = {"string": "", "wstring": "", "boolean": False, "octet": b"\0"}
"""The value of a new element of a sequence, by type; a number is 0."""
LOG_INTERVAL_S = 10.0
"""Time in s between two equal messages in the log."""

_DEPTH = 1000
_MAX_WAITING = 10_000


class _Message(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One entry of the parameter `messages`."""

    type: str
    fields: dict[str, str]
    frame_id: str = ""


def own_names(entries: Iterable[str]) -> dict[str, str]:
    """Read the parameter `names`: ROS names by variable, from entries `VARIABLE: NAME`.

    Raises:
        ConfigurationError: an entry has another form.
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
    """The topics of an FMU: one per input and output, as in `fmi_adapter`, and those of ``messages``.

    A variable that no message of `std_msgs` carries (Binary, an array of Boolean or String) has no topic of its own,
    nor has one in an entry `TOPIC: {type: PACKAGE/msg/TYPE, fields: {PATH: VARIABLE}, frame_id: FRAME}` of
    ``messages``. The ``names`` are ROS names by variable, for those whose usual name cannot be used. If they are
    ``stamped``, all numeric inputs and outputs have a second topic `NAME_stamped` whose messages have a header.

    Raises:
        ConfigurationError: names everything that is wrong.
    """
    ends = {variable.name: variable for variable in description.with_causality("input", "output")}
    by_variable = names_of(description.variables, names)
    problems: list[str] = []
    topics = [topic for entry in messages if (topic := _mapped(entry, ends, problems)) is not None]
    mapped = {port.variable.name for topic in topics for port in topic.ports}
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
    """Set the fields of a message to the values of their variables, and the stamp of its headers to ``time`` in ns.

    Headers get the frame of the topic. Sequences are made as long as the paths need them.
    """
    _set_header(message, time, topic.frame_id)
    given = [(port.path, values[port.variable.name], port.variable.shape) for port in topic.ports]
    for path, value, shape in (*given, *((path, value, ()) for path, value in topic.constants)):
        owner, last = _place(message, path, lambda element: _set_header(element, time, topic.frame_id))
        if isinstance(last, int):
            owner[last] = value
        elif shape:
            setattr(owner, last, flattened(value, len(shape)))
        else:
            # A field of a ROS message refuses every type but its own, so an int must become a float.
            setattr(owner, last, type(getattr(owner, last))(value))


def values_in(fields: FieldReader, message: Any) -> dict[str, Value]:  # noqa: ANN401 a ROS message
    """The values in a message, by variable.

    Raises:
        CdrError: a sequence in the message is too short for a path, or not as long as its keys.
    """
    values: dict[str, Value] = {}
    for port, value in zip(fields.topic.ports, fields.read(message), strict=True):
        shape = port.variable.shape
        if value is not None:
            values[port.variable.name] = nested(list(value), shape) if shape else value
    return values


def message_time(message: Any, now: int) -> int:  # noqa: ANN401 a ROS message
    """The time from which on a message holds, in ns: the stamp of its header, or ``now`` without one."""
    stamp = getattr(getattr(message, "header", None), "stamp", None)
    return now if stamp is None else in_nanoseconds(stamp.sec, stamp.nanosec) or now


def _own_topics(variable: Variable, name: str, *, stamped: bool) -> list[Topic]:
    message = default_type(variable.type, array=bool(variable.shape))
    if message is None:
        return []
    topics = [_topic(name, message, {"data": variable})]
    if stamped and not variable.shape and message != "std_msgs/msg/String":
        topics.append(_topic(f"{name}_stamped", STAMPED, {STAMPED_FIELD: variable}))
    return topics


def _topic(name: str, message: str, fields: Mapping[str, Variable]) -> Topic:
    """A topic whose variables, by the paths of their fields, are all inputs or all outputs."""
    ports = tuple(
        Port(path, "", variable, "in" if variable.causality == "input" else "out") for path, variable in fields.items()
    )
    return Topic(name, message, ports[0].direction, ports)


def _mapped(entry: str, ends: Mapping[str, Variable], problems: list[str]) -> Topic | None:
    """The topic of one entry of the parameter `messages`; None after a problem, which is added to ``problems``."""
    found = _parsed(entry)
    if found is None:
        problems.append(f"'{entry}' is not of the form 'TOPIC: {{type: PACKAGE/msg/TYPE, fields: {{PATH: VARIABLE}}}}'")
        return None
    name, mapping = found
    before = len(problems)
    if (problem := topic_problem(name)) is not None:
        problems.append(f"'{name}' is no topic: {problem}")
    for path, variable in mapping.fields.items():
        if variable not in ends:
            near = nearest(variable, ends)
            hint = f"did you mean '{near}'?" if near else f"there are {listed(tuple(ends))}"
            problems.append(f"'{variable}' in '{name}' is no input and no output; {hint}")
        elif ends[variable].shape:
            problems.append(f"'{variable}' in '{name}' is an array, and a field of `messages` takes one value")
        else:
            _check_field(name, mapping.type, path, problems)
    if len({ends[own].causality for own in mapping.fields.values() if own in ends}) > 1:
        problems.append(f"'{name}' has inputs and outputs; a topic goes in one direction")
    if len(problems) > before:
        return None
    topic = _topic(name, mapping.type, {path: ends[variable] for path, variable in mapping.fields.items()})
    topic = replace(topic, frame_id=mapping.frame_id)
    if topic.direction == "in":
        return topic
    topic = by_index(topic, RosTypes())
    paths = [*(port.path for port in topic.ports), *(path for path, _ in topic.constants)]
    problems += [f"'{path}' in '{name}' has two sources" for path in dict.fromkeys(paths) if paths.count(path) > 1]
    return topic


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
        kind = RosTypes().field(message, path)
    except ConfigurationError as error:
        problems.append(f"'{topic}': {error.message.rstrip('.')}")
    except UnknownField as error:
        near = nearest(path, error.names)
        problems.append(f"'{topic}': {error}{f'; did you mean {near!r}?' if near else ''}")
    else:
        if not isinstance(kind, Basic):
            problems.append(f"'{topic}': '{path}' of '{message}' is no single value")


def _place(message: Any, path: str, passed: Callable[[Any], None]) -> tuple[Any, Any]:  # noqa: ANN401 a ROS message
    """The message or array that holds the field at a path, and the name or index of the field there.

    Sequences on the way are made as long as the path needs them.
    """
    parts = path_parts(path)
    owner = message
    for part, following in pairwise(parts):
        if isinstance(part, int):
            owner = owner[part]
            passed(owner)
            continue
        if isinstance(following, int):
            _lengthen(owner, str(part), following + 1)
        owner = getattr(owner, str(part))
    return owner, parts[-1]


def _lengthen(owner: Any, name: str, length: int) -> None:  # noqa: ANN401 a ROS message
    """Make the array ``name`` of a message at least ``length`` elements long; new elements are empty."""
    elements = getattr(owner, name)
    sequence = _SEQUENCE.fullmatch(owner.get_fields_and_field_types()[name])
    if sequence is not None and length > len(elements):
        kind = sequence["element"]
        package, slash, own = kind.partition("/")
        make = message_class(f"{package}/msg/{own}") if slash else lambda: _EMPTY.get(kind, 0)
        elements.extend(make() for _ in range(length - len(elements)))


def _set_header(message: Any, time: int, frame_id: str) -> None:  # noqa: ANN401 a ROS message
    if hasattr(message, "header"):
        message.header.stamp = time_message(time)
        message.header.frame_id = message.header.frame_id or frame_id  # a variable may have given it


class FmuTopics:
    """Publishes the outputs of an FMU, and takes its inputs.

    While the node is inactive, only the last message of each topic is kept, for `start`.
    """

    def __init__(self, node: RosNode, driver: FmuDriver, thread: FmuThread, now: Callable[[], int]) -> None:
        self._node = node
        self._log = node.get_logger()
        self._driver = driver
        self._thread = thread
        self._now = now
        self._publishers: list[tuple[Topic, Any, Any]] = []
        self._subscriptions: list[Any] = []
        self._held: dict[str, tuple[FieldReader, Any, int]] = {}
        self._started = False
        self._closed = False
        self._waiting = 0
        self._count = threading.Lock()

    @property
    def outputs(self) -> Sequence[str]:
        """The variables that are published."""
        return [port.variable.name for topic, _, _ in self._publishers for port in topic.ports]

    def open(self, topic: Topic) -> None:
        """Create the publisher or the subscription of a topic.

        Raises:
            ConfigurationError: ROS has no such message type.
        """
        kind = message_class(topic.message)
        policies = ros_module("rclpy.qos").QoSPolicyKind
        names = ("HISTORY", "DEPTH", "RELIABILITY", "DURABILITY", "DEADLINE")
        overriding = ros_module("rclpy.qos_overriding_options").QoSOverridingOptions
        overrides = overriding([policies[name] for name in names])
        if topic.direction == "out":
            publisher = self._node.create_publisher(kind, topic.name, _DEPTH, qos_overriding_options=overrides)
            self._publishers.append((topic, publisher, kind))
            return

        fields = FieldReader(topic, RosTypes(), getattr)

        def arrived(message: Any) -> None:  # noqa: ANN401 a ROS message
            self._arrived(fields, message)

        self._subscriptions.append(
            self._node.create_subscription(kind, topic.name, arrived, _DEPTH, qos_overriding_options=overrides)
        )

    def start(self) -> None:
        """Give the FMU the messages that were kept, and from now on every message."""
        for fields, message, arrived in self._held.values():
            self._thread.call(self._take, fields, message, arrived)
        self._held.clear()
        self._started = True

    def stop(self) -> None:
        """From now on only keep the last message of each topic."""
        self._started = False

    def publish(self, update: Update) -> None:
        """Publish the outputs of an update; called on the thread of the FMU."""
        for topic, publisher, kind in self._publishers:
            message = kind()
            fill(topic, message, update.values, update.time)
            publisher.publish(message)

    def close_inputs(self) -> None:
        """Destroy the subscriptions and drop the messages that wait; before the FMU is closed."""
        self._closed = True
        for subscription in self._subscriptions:
            self._node.destroy_subscription(subscription)

    def close_outputs(self) -> None:
        """Destroy the publishers; after the FMU is closed, because its thread publishes."""
        for _, publisher, _ in self._publishers:
            self._node.destroy_publisher(publisher)

    def _arrived(self, fields: FieldReader, message: Any) -> None:  # noqa: ANN401 a ROS message
        arrived, name = self._now(), fields.topic.name
        if not self._started:
            self._held[name] = (fields, message, arrived)
            return
        with self._count:
            full = self._waiting >= _MAX_WAITING
            self._waiting += not full
        if full:
            self._log.error(
                f"{_MAX_WAITING} messages wait for the FMU; one on '{name}' is lost",
                throttle_duration_sec=LOG_INTERVAL_S,
            )
            return
        self._thread.submit(self._take, fields, message, arrived, waited=1)

    # --- on the thread of the FMU

    def _take(self, fields: FieldReader, message: Any, arrived: int, waited: int = 0) -> None:  # noqa: ANN401 a ROS message
        with self._count:
            self._waiting -= waited
        if self._closed:
            return
        try:
            for variable, value in values_in(fields, message).items():
                self._driver.set_input(variable, message_time(message, arrived), value)
        except (CallRefused, CdrError) as error:
            text = f"a message on '{fields.topic.name}' was left out: {error}"
            self._log.error(text, throttle_duration_sec=LOG_INTERVAL_S)
        if fields.warning:
            self._log.warning(f"'{fields.topic.name}': {fields.warning}")
