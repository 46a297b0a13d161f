"""Recording into MCAP, which `ros2 bag` and Foxglove read as ROS messages, by simulation time.

Owns which topics a recording has, and how rows become messages. `fmu_mesh.ros_wire.topics` says what a topic is.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from collections.abc import Set as AbstractSet
from io import BufferedWriter
from pathlib import Path
from typing import Any, Self

import msgspec
import numpy as np
from msgspec.structs import replace
from numpy.typing import NDArray

from ...config.findings import Findings
from ...config.mesh import Qos, RosConfig, RosTopicConfig
from ...files import Kept, open_alone
from ...installing import importing
from ...results.recording import Columns, Recording, Tail
from ...ros_wire.assembling import Assembler
from ...ros_wire.cdr import Codec
from ...ros_wire.definitions import CLOCK, MessageTypes
from ...ros_wire.fitting import TopicEntry, check_topic
from ...ros_wire.stamp import nanoseconds, to_stamp
from ...ros_wire.topics import CLOCK_TOPIC, RosPlan, Topic
from ...variables.model_description import ModelDescription
from ...variables.value_types import VariableType
from ..gateway.mapping import Resolver, message_types
from .mcap_layout import NOTE, RECORDING, ROWS, RecordedColumn, RecordedMcap, TopicColumns

__all__ = ["McapFile"]

_BUFFER_BYTES = 1 << 16
_QOS = (
    "- history: keep_last\n  depth: {0.depth}\n  reliability: {0.reliability}\n  durability: {0.durability}\n"
    "  deadline:\n    sec: 9223372036\n    nsec: 854775807\n"
    "  lifespan:\n    sec: 9223372036\n    nsec: 854775807\n"
    "  liveliness: automatic\n  liveliness_lease_duration:\n    sec: 9223372036\n    nsec: 854775807\n"
    "  avoid_ros_namespace_conventions: false"
)
"""The quality of service that a player offers, as rosbag2 writes it; of a bag, no player needs a deadline."""


class McapFile:
    """Writes rows of results as ROS messages into an MCAP, and `/clock` with them.

    The log time and the publish time of a message are its simulation time. A topic has a message in every row in which
    one of its variables has a new value.

    Args:
        path: the file. Its folder is made; the first row replaces an older file.
        recording: what is recorded.
        plan: the topics, and how often the clock ticks.

    Raises:
        ConfigurationError: the file cannot be written, or the package `mcap` is not installed.
    """

    rounds = True
    """Whether a value that is read may be rounded, as by a field of 32 bits."""

    def __init__(self, path: Path, recording: Recording, plan: RosPlan) -> None:
        writer = _writer_class()
        self._first, self._every = recording.first, recording.every
        self.path = path
        self.rows = 0
        self.kept = Kept()
        self._resumed = False
        index = {name: number for number, (name, _) in enumerate(recording.columns)}
        self._own = open_alone(path)
        self._file = BufferedWriter(self._own, _BUFFER_BYTES)
        self._mcap = writer(self._file)
        self._types = types = plan.types
        self._schemas: dict[str, int] = {}
        layout = _layout(recording, plan)
        self._topics = [
            _RecordedTopic(topic, columns, index, self._channel(topic), types)
            for topic, columns in zip(plan.topics, layout.topics, strict=False)
        ]
        self._clock_ticks = layout.topics[-1] if plan.clock_points is not None else None
        if self._clock_ticks is not None:
            self._clock = Codec(types, CLOCK)
            self._clock_channel = self._channel(Topic(CLOCK_TOPIC, CLOCK, "out", (), qos=Qos(depth=10)))
        self._about = {
            "metadata": msgspec.json.encode(recording.metadata).decode(),
            "recording": msgspec.json.encode(layout).decode(),
        }
        self._waiting: list[Mapping[str, Any]] = []

    @classmethod
    def check(cls, recording: Recording, findings: Findings) -> None:
        """Check that topics can be made of what is recorded, and that their messages have a place for it."""
        _writer_class()
        _topics(recording, findings)

    @classmethod
    def open(cls, path: Path, recording: Recording) -> Self:
        """Open a result file for what a run records."""
        findings = recording.loaded.findings()
        found = _topics(recording, findings)
        findings.raise_any()
        assert found is not None  # or there is a finding
        return cls(path, recording, found)

    @staticmethod
    def growing_file(path: Path) -> Path:
        """The bag itself: its messages can be read while it grows."""
        return path

    @staticmethod
    def keep_whole_rows(path: Path, kept: Kept) -> int:
        """Cut a bag off after its last whole row, and write its index; returns the number of its rows."""
        _writer_class()
        from .mcap_records import finish_mcap  # noqa: PLC0415 an optional dependency

        return finish_mcap(path, kept)

    @staticmethod
    def pieces(path: Path, types: Mapping[str, VariableType]) -> Iterator[Columns]:  # noqa: ARG004 the file has them
        """All rows. What a field has rounded, such as a Float64 in a float32, comes back rounded."""
        _writer_class()
        from .mcap_records import read_mcap  # noqa: PLC0415 an optional dependency

        yield read_mcap(path)

    @staticmethod
    def follow(path: Path) -> Tail | None:  # noqa: ARG004 as above
        """There is nothing to follow: Foxglove and `ros2 bag` show bags."""
        return None

    def write(self, times: NDArray[np.float64], columns: Sequence[NDArray[Any]]) -> None:
        """Append one row per time; ``columns`` are arrays of the same length."""
        if not self.rows:
            self._mcap.start(profile="ros2", library="fmu_mesh")
            self._mcap.add_metadata(RECORDING, self._about)
            for entry in self._waiting:
                self._add_note(entry)
        values = [topic.values(columns) for topic in self._topics]
        for row, time in enumerate(times.tolist()):
            point, stamp = self._first + self.rows * self._every, nanoseconds(time)
            before = point - self._every if self.rows else -1
            if self._clock_ticks is not None and self._clock_ticks.is_due(before, point):
                self._add(self._clock_channel, stamp, self._clock.encode({"clock": to_stamp(time)}), point)
            for topic, fields in zip(self._topics, values, strict=True):
                if topic.is_due(before, point):
                    self._add(topic.channel, stamp, topic.message([field[row] for field in fields], time), point)
            self.rows += 1

    def resume(self, rows: int) -> None:
        """Go on after the rows that are in the file; see `Resumable`. Its index is made anew at the end."""
        from .mcap_records import end_of_rows  # noqa: PLC0415 an optional dependency

        self._own.append_after(end_of_rows(self.path))
        self._file.seek(self._own.size)
        self.rows, self.kept, self._resumed = rows, Kept(rows, self._own.size), True
        self._add_note({"set": []})  # what was set before is noted again

    def note(self, entry: Mapping[str, Any]) -> None:
        """Add an entry to the metadata."""
        if self.rows:
            self._add_note(entry)
        else:
            self._waiting.append(entry)

    def flush(self) -> None:
        """Give all rows to the operating system, so that they survive the end of this process."""
        self._mcap.flush()
        self.kept = Kept(self.rows, self._own.size)

    def close(self) -> None:
        """Write what is left and close the file. Without a row, nothing has changed."""
        if self._file.closed:
            return
        written, self.rows = self.rows, self.kept.rows
        try:
            if self._resumed:  # the writer knows nothing of the rows before
                self._mcap.flush()
                self.keep_whole_rows(self.path, Kept(written, self._own.size))
            elif written:
                self._mcap.flush()  # the number of rows follows the last message
                self._mcap.add_metadata(ROWS, {"rows": str(written)})
                self._mcap.finish()
        finally:
            self._file.close()
        self.rows, self.kept = written, Kept(written, self._own.size)

    def _add_note(self, entry: Mapping[str, Any]) -> None:
        self._mcap.add_metadata(NOTE, {"entry": msgspec.json.encode(entry).decode()})

    def _add(self, channel: int, stamp: int, data: bytes, point: int) -> None:
        self._mcap.add_message(channel, log_time=stamp, publish_time=stamp, data=data, sequence=point & 0xFFFFFFFF)

    def _channel(self, topic: Topic) -> int:
        message = topic.message
        if message not in self._schemas:
            definition = self._types.definition(message).encode()
            self._schemas[message] = self._mcap.register_schema(message, "ros2msg", definition)
        metadata = {"offered_qos_profiles": _QOS.format(topic.qos), "topic_type_hash": self._types.type_hash(message)}
        channel: int = self._mcap.register_channel(topic.name, "cdr", self._schemas[message], metadata)
        return channel


class _RecordedTopic:
    """One topic of a recording."""

    def __init__(
        self, topic: Topic, columns: TopicColumns, index: dict[str, int], channel: int, types: MessageTypes
    ) -> None:
        self.channel = channel
        self.is_due = columns.is_due
        self._columns = [[index[name] for name in names] for _, names in columns.fields]
        self._are_arrays = [bool(port.variable.shape) for port in topic.ports]
        self.message = Assembler(topic, types).make

    def values(self, columns: Sequence[NDArray[Any]]) -> list[Any]:
        """The value of each field in each row: of an array all elements, as a row of one block."""
        return [
            np.stack([columns[column] for column in own], axis=1) if is_array else columns[own[0]].tolist()
            for own, is_array in zip(self._columns, self._are_arrays, strict=True)
        ]


def _layout(recording: Recording, plan: RosPlan) -> RecordedMcap:
    """Where the columns are in the file, for those who read it."""
    topics = [
        TopicColumns(
            topic.name,
            tuple(sorted({port.step_points for port in topic.ports})),
            tuple(
                (port.path, tuple(f"{port.instance}.{name}" for name in port.variable.elements)) for port in topic.ports
            ),
        )
        for topic in plan.topics
    ]
    if plan.clock_points is not None:
        topics.append(TopicColumns(CLOCK_TOPIC, (plan.clock_points,)))
    columns = [
        RecordedColumn(f"{instance}.{name}", variable.type, variable.unit)
        for instance, name in recording.recorded
        for variable in [recording.variable(instance, name)]
    ]
    simulation = recording.loaded.config.simulation
    return RecordedMcap(
        simulation.start_time,
        simulation.step_size,
        plan.types.distribution,
        tuple(columns),
        tuple(topics),
        recording.first,
        recording.every,
    )


def _topics(recording: Recording, findings: Findings) -> RosPlan | None:
    """The topics that hold the recorded variables; None if a finding makes it impossible to go on.

    A topic of the `ros` section is recorded as it is if all of its variables are recorded; a subscribed
    one has what its inputs had at each point, and one without variables has a message in the first row. Every other
    recorded variable has a topic of its own, with the name and the type that the section gives it by default.
    """
    loaded, descriptions = recording.loaded, recording.descriptions
    section = loaded.config.ros or RosConfig()
    types = message_types(loaded, section, findings)
    if types is None:
        return None
    recorded = _whole(recording, findings)
    wanted = set(recorded)
    # The findings about the section itself are reported where the section is checked.
    plan = Resolver(loaded, section, descriptions, types, Findings(str(loaded.file))).plan()
    published = (_published_topic(topic, types) for topic in plan.topics if _variables(topic) <= wanted)
    configured = tuple(topic for topic in published if topic is not None) if loaded.config.ros else ()
    covered = {variable for topic in configured for variable in _variables(topic)}
    rest = replace(section, topics=[f"{i}.{v}" for i, v in recorded if (i, v) not in covered])
    own = Findings(str(loaded.file))
    others = Resolver(loaded, rest, _published(descriptions, wanted), types, own).plan().topics
    section_file = loaded.config.records[recording.place].file
    for finding in own:
        findings.add(f"{recording.place}.file", f"in '{section_file}': {finding.found}", finding.expected)
    if loaded.config.simulation.start_time < 0.0:
        findings.add(
            f"{recording.place}.file", "an MCAP of times before 0, which it cannot hold", "a CSV file, or another start"
        )
    return replace(plan, topics=(*configured, *others))


def _published(
    descriptions: Mapping[str, ModelDescription], recorded: AbstractSet[tuple[str, str]]
) -> dict[str, ModelDescription]:
    """The model descriptions with all recorded variables as outputs: a bag publishes inputs and parameters, too."""
    return {
        instance: replace(
            description,
            variables=tuple(
                replace(variable, causality="output") if (instance, variable.name) in recorded else variable
                for variable in description.variables
            ),
        )
        for instance, description in descriptions.items()
    }


def _whole(recording: Recording, findings: Findings) -> list[tuple[str, str]]:
    """(instance, variable) of what is recorded. A message holds a whole array, so all of it must be recorded."""
    columns = set(recording.recorded)
    whole: dict[tuple[str, str], None] = {}
    for instance, name in recording.recorded:
        variable = recording.variable(instance, name)
        if (instance, variable.name) not in whole and not {(instance, e) for e in variable.elements} <= columns:
            findings.add(
                f"{recording.place}.variables",
                f"some elements of the array '{instance}.{variable.name}'",
                "all of it in an MCAP",
            )
        whole[instance, variable.name] = None
    return list(whole)


def _variables(topic: Topic) -> set[tuple[str, str]]:
    """(instance, variable) of what a topic carries."""
    return {(port.instance, port.variable.name) for port in topic.ports}


def _published_topic(topic: Topic, types: MessageTypes) -> Topic | None:
    """A topic as a bag publishes it; None if its messages cannot hold all values that the inputs may have."""
    if topic.direction == "out":
        return topic
    problems = Findings("")
    entry = TopicEntry(RosTopicConfig(), "", "")
    published = check_topic(entry, replace(topic, direction="out"), types, problems, [])
    return None if problems else published


def _writer_class() -> Any:  # noqa: ANN401 a class of an optional dependency
    with importing("mcap"):
        from mcap.writer import Writer  # noqa: PLC0415 an optional dependency
    return Writer
