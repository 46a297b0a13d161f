"""Reading a bag (MCAP or SQLite, by `ros2 bag` or by a mesh) with `rosbags`, and which of its topics are inputs.

Knows no communication points: `fmu_mesh.ros.bags.playing` finds the point of a sample.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, Self

import msgspec
import numpy as np
from msgspec.structs import replace

from ... import files
from ...config.loading import LoadedConfig
from ...config.mesh import RosConfig, RosTopicConfig
from ...errors import ConfigurationError
from ...installing import importing
from ...results.formats import near_hint, reading
from ...text import listed, nearest
from ...variables.model_description import ModelDescription, Value
from ...variables.value_types import nested
from ...wire.views import InstanceInfo
from ..gateway.mapping import descriptions_of, message_types
from ..gateway.resolver import Resolver
from ..messages.definitions import MessageTypes, path_parts
from ..messages.stamp import nanoseconds
from ..messages.topics import Port, Topic

if TYPE_CHECKING:
    from rosbags.highlevel import AnyReader

__all__ = ["Bag", "BagSample", "chosen_topics", "timed", "topics_for"]

_CHOICE = re.compile(r"(?P<topic>/?[^=:]+)(:(?P<field>[^=]+))?=(?P<variable>.+)")

StampSource = Literal["header", "log"]


class BagSample(msgspec.Struct, frozen=True):
    """One recorded value.

    Attributes:
        stamp: the time from which on the value holds, in ns.
        instance: name of the instance.
        variable: name of its input.
        value: an array has the shape of the variable.
    """

    stamp: int
    instance: str
    variable: str
    value: Value


class Bag:
    """A bag that is open for reading; use it as a context manager.

    Args:
        path: an MCAP file, or the folder of a `ros2 bag`.

    Raises:
        ConfigurationError: the file cannot be read, or `rosbags` is not installed.
    """

    def __init__(self, path: Path) -> None:
        with importing("rosbags", "bags of ROS"):
            from rosbags.highlevel import AnyReader  # noqa: PLC0415 an optional dependency
        self.path = path
        if not files.exists(path):
            raise ConfigurationError(f"the bag '{path}' does not exist.", hint=near_hint(path))
        if files.is_folder(path) and not (path / "metadata.yaml").is_file():
            raise ConfigurationError(
                f"the folder '{path}' is no bag: it has no metadata.yaml.",
                hint="Name the folder that `ros2 bag record` made, or an .mcap file.",
            )
        with reading(path, "bag"):
            if not files.is_folder(path):
                files.opened(path).close()  # no pipe
            self._reader: AnyReader = AnyReader([path])
            self._reader.open()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._reader.close()

    @property
    def topics(self) -> dict[str, str]:
        """The message type of every topic."""
        return {name: info.msgtype or "" for name, info in self._reader.topics.items()}

    def add_types(self, types: MessageTypes) -> None:
        """Add the message types of this bag to ``types``."""
        for name, definition in self._reader.typestore.fielddefs.items():
            types.store.fielddefs.setdefault(name, definition)

    def samples(self, topics: Sequence[Topic], stamps: StampSource) -> Iterator[BagSample]:
        """The values of ``topics`` in the order in which they were recorded.

        Args:
            topics: subscribed topics.
            stamps: `header` takes the stamp in the header if there is one; `log` takes the time of the recording.

        Raises:
            ConfigurationError: a message has no such array element, or an array of another size.
        """
        wanted: dict[str, list[tuple[list[str | int], Port]]] = {}
        for topic in topics:  # several of one name give one message to several variables
            wanted.setdefault(topic.name, []).extend((path_parts(port.path), port) for port in topic.ports)
        connections = [connection for connection in self._reader.connections if connection.topic in wanted]
        with reading(self.path, "bag"):
            for connection, logged, data in self._reader.messages(connections) if connections else ():
                message: Any = self._reader.deserialize(data, connection.msgtype)
                stamp = _header_stamp(message) if stamps == "header" else None
                for parts, port in wanted[connection.topic]:
                    value = _value_at(message, parts, port, connection.topic)
                    yield BagSample(logged if stamp is None else stamp, port.instance, port.variable.name, value)


def chosen_topics(
    loaded: LoadedConfig, infos: Mapping[str, InstanceInfo], bag: Bag, choices: Sequence[str] = ()
) -> list[Topic]:
    """The topics of a bag that are played into inputs of a mesh.

    Args:
        loaded: the configuration of the mesh.
        infos: the information of every instance, by name.
        bag: the bag.
        choices: each is `TOPIC=INSTANCE.VARIABLE` or `TOPIC:FIELD=INSTANCE.VARIABLE`. Without choices, the topics are
            those that the mesh subscribes to: by its `ros` section, or by the default names of its inputs.

    Raises:
        ConfigurationError: a choice is wrong, or the mesh subscribes to no topic of the bag.
    """
    return topics_for(loaded, descriptions_of(infos), bag, choices)


def topics_for(
    loaded: LoadedConfig, descriptions: Mapping[str, ModelDescription], bag: Bag, choices: Sequence[str] = ()
) -> list[Topic]:
    """As `chosen_topics`, for model descriptions by instance name."""
    there = bag.topics
    section = loaded.config.ros or RosConfig()
    config = replace(loaded.config, ros=section)
    findings = loaded.findings()
    types = message_types(replace(loaded, config=config), findings)
    findings.raise_any()
    assert types is not None
    bag.add_types(types)
    # Each choice is a section of its own: a field may go to several variables.
    sections = [replace(section, topics=[_entry(choice, there)]) for choice in choices] or [section]
    found = [one for own in sections for one in Resolver(config, own, descriptions, types, findings).topics()]
    if choices and len(findings):
        problems = "; ".join(f"{finding.found}, where {finding.expected} is possible" for finding in findings)
        raise ConfigurationError(f"`topics=...`: {problems}.")
    topics = [topic for topic in found if topic.direction == "in" and topic.name in there]
    for topic in topics:
        if there[topic.name] != topic.message:
            raise ConfigurationError(
                f"the topic '{topic.name}' has messages of '{there[topic.name]}' in '{bag.path}', and of "
                f"'{topic.message}' in the mesh.",
                hint=f"Say which field goes where: `topics=['{topic.name}:FIELD=INSTANCE.VARIABLE']`.",
            )
    if not topics:
        wanted = [topic.name for topic in found if topic.direction == "in"]
        raise ConfigurationError(
            f"no topic of '{bag.path}' is one that the mesh subscribes to: it has {listed(sorted(there))}, and the "
            f"mesh wants {listed(wanted)}.",
            hint="Say what goes where: `topics=['TOPIC=INSTANCE.VARIABLE']`.",
        )
    return topics


def timed(samples: Iterable[BagSample], start: float | None) -> list[tuple[float, BagSample]]:
    """Samples in the order of their stamps, each with its simulation time in s.

    Args:
        samples: in any order.
        start: simulation time in s of the earliest stamp; None: stamps are simulation times.
    """
    ordered = sorted(samples, key=lambda sample: sample.stamp)
    shift = 0 if start is None or not ordered else nanoseconds(start) - ordered[0].stamp
    return [((sample.stamp + shift) / 1e9, sample) for sample in ordered]


def _entry(choice: str, there: Mapping[str, str]) -> RosTopicConfig:
    """A choice as an entry of a `ros` section; ``there`` has the message type of every topic of the bag."""
    found = _CHOICE.fullmatch(choice)
    if found is None:
        raise ConfigurationError(f"`topics=[{choice!r}]`: expected TOPIC=INSTANCE.VARIABLE or TOPIC:FIELD=….")
    topic = "/" + found["topic"].lstrip("/")
    if topic not in there:
        near = nearest(topic, there)
        hint = f"Did you mean '{near}'?" if near else f"It has {listed(sorted(there))}."
        raise ConfigurationError(f"`topics=[{choice!r}]`: the bag has no topic '{topic}'.", hint=hint)
    return RosTopicConfig(topic=topic, type=there[topic], fields={found["field"] or "data": found["variable"]})


def _header_stamp(message: Any) -> int | None:  # noqa: ANN401 a message of rosbags
    """The stamp of the header in ns; None without a header, or if it is 0."""
    stamp = getattr(getattr(message, "header", None), "stamp", None)
    if stamp is None or not (stamp.sec or stamp.nanosec):
        return None
    return int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)


def _value_at(message: Any, parts: Sequence[str | int], port: Port, topic: str) -> Value:  # noqa: ANN401 of rosbags
    """A field as the value of a variable; an array gets the shape of the variable."""
    value = message
    try:
        for part in parts:
            value = value[part] if isinstance(part, int) else getattr(value, part)
    except IndexError as error:
        raise ConfigurationError(f"a message of '{topic}' has no '{port.path}'.") from error
    plain: Value = value.tolist() if isinstance(value, np.generic | np.ndarray) else value
    if not port.variable.shape:
        return plain
    if not isinstance(plain, list) or len(plain) != port.variable.size:
        raise ConfigurationError(
            f"a message of '{topic}' does not have the {port.variable.size} elements of "
            f"'{port.instance}.{port.variable.name}'."
        )
    return nested(plain, port.variable.shape)
