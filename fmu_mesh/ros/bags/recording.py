"""Recording into MCAP: a file that `ros2 bag` and Foxglove read as ROS messages, by simulation time.

Owns which topics a recording has and how rows become messages. What a topic is and how it is named is
`fmu_mesh.ros.messages.topics`; who hands over the rows does not matter.
"""

from __future__ import annotations

from collections.abc import Sequence
from io import BufferedWriter
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import msgspec
import numpy as np
from msgspec.structs import replace
from numpy.typing import NDArray

from ...config.findings import Findings
from ...config.loading import LoadedConfig
from ...config.mesh import RosConfig
from ...errors import ConfigurationError
from ...files import Kept, open_alone
from ...variables.value_types import nested, split_element
from ..gateway.mapping import message_types
from ..gateway.resolver import Resolver
from ..messages.assembling import Assembler
from ..messages.cdr import Codec
from ..messages.definitions import CLOCK, MessageTypes
from ..messages.stamp import nanoseconds, to_stamp
from ..messages.topics import Descriptions, RosPlan, Topic

__all__ = ["BagTopics", "McapFile", "bag_topics", "is_bag"]

SUFFIX = ".mcap"
_BUFFER_BYTES = 1 << 16
_QOS = (
    "- history: keep_last\n  depth: 10\n  reliability: reliable\n  durability: volatile\n"
    "  deadline:\n    sec: 9223372036\n    nsec: 854775807\n"
    "  lifespan:\n    sec: 9223372036\n    nsec: 854775807\n"
    "  liveliness: automatic\n  liveliness_lease_duration:\n    sec: 9223372036\n    nsec: 854775807\n"
    "  avoid_ros_namespace_conventions: false"
)
"""The quality of service that a player offers, in the words of rosbag2: reliable and volatile."""


class BagTopics(msgspec.Struct, frozen=True):
    """The topics of a recording.

    Attributes:
        plan: topics and clock.
        types: their message types.
    """

    plan: RosPlan
    types: MessageTypes


def is_bag(path: str | Path | None) -> bool:
    """Whether a result file is to be an MCAP."""
    return path is not None and Path(path).suffix.lower() == SUFFIX


def bag_topics(
    loaded: LoadedConfig, descriptions: Descriptions, recorded: Sequence[tuple[str, str]], findings: Findings
) -> BagTopics | None:
    """The topics that hold the recorded variables.

    A topic of the `ros` section whose variables are all recorded is there as it is; every other recorded variable has
    one of its own, named and typed as that section does by default.

    Args:
        loaded: the configuration.
        descriptions: the model descriptions by instance.
        recorded: (instance, variable), or an element of an array as `y[1,2]`.
        findings: where all that is wrong goes.

    Returns:
        None after a finding that leaves nothing to go on with.
    """
    section = loaded.config.ros or RosConfig()
    config = replace(loaded.config, ros=section)
    types = message_types(replace(loaded, config=config), findings)
    if types is None:
        return None
    recorded = _whole(recorded, descriptions, findings)
    wanted = set(recorded)
    # What is wrong with the section itself is told where it is checked, and once is enough.
    plan = Resolver(config, section, descriptions, types, Findings(str(loaded.file))).plan()
    configured = tuple(topic for topic in plan.topics if _variables(topic) <= wanted) if loaded.config.ros else ()
    covered = {variable for topic in configured for variable in _variables(topic)}
    rest = replace(section, topics=[f"{i}.{v}" for i, v in recorded if (i, v) not in covered])
    own = Findings(str(loaded.file))
    others = Resolver(config, rest, descriptions, types, own).plan().topics
    for finding in own:
        findings.add("record.file", f"in '{loaded.config.record.file}': {finding.found}", finding.expected)
    if loaded.config.simulation.start_time < 0.0:
        findings.add("record.file", "an MCAP of times before 0, which it cannot hold", "a CSV file, or another start")
    return BagTopics(replace(plan, topics=(*configured, *others)), types)


class McapFile:
    """Writes rows of results as ROS messages into an MCAP, and `/clock` with them.

    A message is logged and published at its simulation time. There is one at every point of one of its variables.

    Args:
        path: the file; its folder is made, an older file is replaced by the first row.
        columns: (name, type) of every column that `write` is given, the name being `instance.variable`.
        topics: what to make of them.

    Attributes:
        path: the file.
        rows: rows written so far; once it is closed, those that are in the file.
        kept: what the operating system has by now.

    Raises:
        ConfigurationError: the file cannot be written, or the package `mcap` is not there.
    """

    def __init__(self, path: Path, columns: Sequence[tuple[str, str]], topics: BagTopics) -> None:
        writer = _writer_class()
        self.path = path
        self.rows = 0
        index = {name: number for number, (name, _) in enumerate(columns)}
        self.kept = Kept()
        self._own = open_alone(path)
        self._file = BufferedWriter(self._own, _BUFFER_BYTES)
        self._mcap = writer(self._file)
        self._types = topics.types
        self._schemas: dict[str, int] = {}
        self._outputs = [
            _Output(topic, index, self._channel(topic.name, topic.message), topics.types)
            for topic in topics.plan.topics
        ]
        self._clock_points = topics.plan.clock_points
        if self._clock_points is not None:
            self._clock = Codec(topics.types, CLOCK)
            self._clock_channel = self._channel("/clock", CLOCK)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def write(self, times: NDArray[np.float64], columns: Sequence[NDArray[Any]]) -> None:
        """Append one row per time; ``columns`` are arrays of the same length."""
        if not self.rows:
            self._mcap.start(profile="ros2", library="fmu_mesh")
        rows = zip(*(column.tolist() for column in columns), strict=True) if columns else iter([()] * len(times))
        for time, row in zip(times.tolist(), rows, strict=True):
            point, stamp = self.rows, nanoseconds(time)
            if self._clock_points is not None and point % self._clock_points == 0:
                self._add(self._clock_channel, stamp, self._clock.encode({"clock": to_stamp(time)}), point)
            for output in self._outputs:
                if output.due(point):
                    self._add(output.channel, stamp, output.message(row, time), point)
            self.rows += 1

    def flush(self) -> None:
        """Hand everything to the operating system, so that it survives the end of this process."""
        self._mcap.flush()
        self.kept = Kept(self.rows, self._own.size)

    def close(self) -> None:
        """Write what is left and close the file; without a row, nothing has changed."""
        if self._file.closed:
            return
        written, self.rows = self.rows, self.kept.rows
        try:
            if written:
                self._mcap.finish()
        finally:
            self._file.close()
        self.rows, self.kept = written, Kept(written, self._own.size)

    def _add(self, channel: int, stamp: int, data: bytes, point: int) -> None:
        self._mcap.add_message(channel, log_time=stamp, publish_time=stamp, data=data, sequence=point & 0xFFFFFFFF)

    def _channel(self, topic: str, message: str) -> int:
        if message not in self._schemas:
            definition = self._types.definition(message).encode()
            self._schemas[message] = self._mcap.register_schema(message, "ros2msg", definition)
        metadata = {"offered_qos_profiles": _QOS, "topic_type_hash": self._types.type_hash(message)}
        channel: int = self._mcap.register_channel(topic, "cdr", self._schemas[message], metadata)
        return channel


class _Output:
    """One topic of a recording."""

    def __init__(self, topic: Topic, index: dict[str, int], channel: int, types: MessageTypes) -> None:
        self.channel = channel
        self._steps = sorted({port.step_points for port in topic.ports})
        self._columns = [[index[f"{port.instance}.{name}"] for name in port.variable.elements] for port in topic.ports]
        self._shapes = [port.variable.shape for port in topic.ports]
        self._assembler = Assembler(topic, types)

    def due(self, point: int) -> bool:
        """Whether one of the variables has a value of its own at ``point``."""
        return any(point % step == 0 for step in self._steps)

    def message(self, row: Sequence[Any], time: float) -> bytes:
        """The message of a row."""
        values = [
            nested([row[column] for column in columns], shape)
            for columns, shape in zip(self._columns, self._shapes, strict=True)
        ]
        return self._assembler.make(values, time)


def _whole(
    recorded: Sequence[tuple[str, str]], descriptions: Descriptions, findings: Findings
) -> list[tuple[str, str]]:
    """The recorded variables, each array once; a message has all of an array, so all of it has to be recorded."""
    columns = set(recorded)
    whole: dict[tuple[str, str], None] = {}
    for instance, name in recorded:
        description = descriptions[instance]
        split = split_element(name)
        variable = description.variable(name) or (description.variable(split[0]) if split is not None else None)
        if variable is None:
            continue
        if (instance, variable.name) not in whole and not {(instance, e) for e in variable.elements} <= columns:
            findings.add(
                "record.variables", f"some elements of the array '{instance}.{variable.name}'", "all of it in an MCAP"
            )
        whole[instance, variable.name] = None
    return list(whole)


def _variables(topic: Topic) -> set[tuple[str, str]]:
    return {(port.instance, port.variable.name) for port in topic.ports} if topic.direction == "out" else {("", "")}


def _writer_class() -> Any:  # noqa: ANN401 a class of an optional dependency
    try:
        from mcap.writer import Writer  # noqa: PLC0415 an optional dependency
    except ImportError as error:
        raise ConfigurationError(
            "a recording into .mcap needs the package mcap", hint="Install it: pip install 'fmu-mesh[ros]'."
        ) from error
    return Writer
