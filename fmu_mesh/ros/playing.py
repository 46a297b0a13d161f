"""A bag as input: recorded topics go into the inputs of a running mesh, each value at the point of its stamp.

Owns which sample belongs to which communication point, and holds the mesh there while it sets the values: the mesh runs
from sample to sample, so the result depends on the bag alone and not on how fast anybody is. Bags are read by
`rosbags`: MCAP and SQLite, of `ros2 bag` and of our own.
"""

from __future__ import annotations

import math
import re
import threading
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, Self

import msgspec
import numpy as np
from msgspec.structs import replace

from ..errors import ConfigurationError, DeadlineExceeded, MeshLost
from ..model.config import RosConfig, RosTopicConfig
from ..model.description import Value
from ..model.findings import listed, nearest
from ..model.loading import LoadedConfig
from ..simtime import TimeGrid
from ..wire.client import MeshClient
from ..wire.readings import Target
from ..wire.values import encode_value
from ..wire.views import Command, InstanceInfo, MeshInfo
from .mapping import message_types
from .seen import descriptions_of
from .stamp import nanoseconds
from .topics import Resolver, Topic
from .types import MessageTypes

if TYPE_CHECKING:
    from rosbags.highlevel import AnyReader

__all__ = ["Bag", "Moment", "Played", "Sample", "chosen_topics", "grid_of", "play", "schedule"]

_LOOK_S = 0.001
_LONGEST_LOOK_S = 0.05
_PART = re.compile(r"[^.\[\]]+|\[\d+\]")
_CHOICE = re.compile(r"(?P<topic>/?[^=:]+)(:(?P<field>[^=]+))?=(?P<variable>.+)")

StampSource = Literal["header", "log"]


class Sample(msgspec.Struct, frozen=True):
    """One recorded value.

    Attributes:
        stamp: when it holds from, in ns.
        instance: of the input.
        variable: name of the input.
    """

    stamp: int
    instance: str
    variable: str
    value: Value


class Moment(msgspec.Struct, frozen=True):
    """What the inputs are given at one point, by (instance, variable)."""

    point: int
    values: dict[tuple[str, str], Value]


class Played(msgspec.Struct, frozen=True):
    """What was played.

    Attributes:
        samples: values that were set.
        merged: samples that a later one for the same point replaced before they held.
        beyond: samples whose time is at or after the end of the simulation.
    """

    samples: int
    merged: int
    beyond: int
    first_point: int
    last_point: int


class Bag:
    """A bag that is open for reading; use it as a context manager.

    Args:
        path: an MCAP file, or the folder of a `ros2 bag`.

    Raises:
        ConfigurationError: it cannot be read, or `rosbags` is not installed.
    """

    def __init__(self, path: Path) -> None:
        try:
            from rosbags.highlevel import AnyReader, AnyReaderError  # noqa: PLC0415 an optional dependency
        except ImportError as error:
            raise ConfigurationError(
                "reading a bag needs the package rosbags", hint="Install it: pip install 'fmu-mesh[ros]'."
            ) from error
        self.path = path
        try:
            self._reader: AnyReader = AnyReader([path])
            self._reader.open()
        except (AnyReaderError, OSError, ValueError) as error:
            raise ConfigurationError(f"'{path}' cannot be read as a bag: {error}.") from error

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._reader.close()

    @property
    def topics(self) -> dict[str, str]:
        """The message type of every topic."""
        return {name: info.msgtype or "" for name, info in self._reader.topics.items()}

    def add_types(self, types: MessageTypes) -> None:
        """Let ``types`` have the message types of this bag, too."""
        for name, definition in self._reader.typestore.fielddefs.items():
            types.store.fielddefs.setdefault(name, definition)

    def samples(self, topics: Sequence[Topic], stamps: StampSource) -> Iterator[Sample]:
        """The values of ``topics`` in the order in which they were recorded.

        Args:
            topics: subscribed topics.
            stamps: `header` takes the stamp of the header where there is one, `log` when it was recorded.

        Raises:
            ConfigurationError: a message does not have what its topic needs.
        """
        wanted = {topic.name: [(_parts(port.path), port) for port in topic.ports] for topic in topics}
        connections = [connection for connection in self._reader.connections if connection.topic in wanted]
        for connection, logged, data in self._reader.messages(connections) if connections else ():
            message: Any = self._reader.deserialize(data, connection.msgtype)
            stamp = _header_stamp(message) if stamps == "header" else None
            for parts, port in wanted[connection.topic]:
                value = _value_at(message, parts, f"{connection.topic}:{port.path}")
                yield Sample(logged if stamp is None else stamp, port.instance, port.variable.name, value)


def chosen_topics(
    loaded: LoadedConfig, infos: Mapping[str, InstanceInfo], bag: Bag, choices: Sequence[str] = ()
) -> list[Topic]:
    """The topics of a bag that go into inputs of a mesh.

    Args:
        loaded: the configuration of the mesh.
        infos: what its instances say of themselves.
        bag: the bag.
        choices: `TOPIC=INSTANCE.VARIABLE` or `TOPIC:FIELD=INSTANCE.VARIABLE` each; without any, the topics are those
            that the mesh subscribes to by its `ros` section, or by the names that it would give its inputs.

    Raises:
        ConfigurationError: a choice is wrong, or no topic fits.
    """
    there = bag.topics
    section = loaded.config.ros or RosConfig()
    if choices:
        section = replace(section, topics=list(_entries(choices, there)))
    config = replace(loaded.config, ros=section)
    findings = loaded.findings()
    types = message_types(replace(loaded, config=config), findings)
    findings.raise_any()
    assert types is not None
    bag.add_types(types)
    plan = Resolver(config, section, descriptions_of(infos), types, findings).plan()
    if choices and len(findings):
        problems = "; ".join(f"{finding.found}, where {finding.expected} is possible" for finding in findings)
        raise ConfigurationError(f"--topic: {problems}.")
    topics = [topic for topic in plan.topics if topic.direction == "in" and topic.name in there]
    for topic in topics:
        if there[topic.name] != topic.message:
            raise ConfigurationError(
                f"the topic '{topic.name}' has messages of '{there[topic.name]}' in '{bag.path}', and of "
                f"'{topic.message}' in the mesh.",
                hint=f"Say which field goes where: --topic {topic.name}:FIELD=INSTANCE.VARIABLE.",
            )
    if not topics:
        wanted = [topic.name for topic in plan.topics if topic.direction == "in"]
        raise ConfigurationError(
            f"no topic of '{bag.path}' is one that the mesh subscribes to: it has {listed(sorted(there))}, and the "
            f"mesh wants {listed(wanted)}.",
            hint="Say what goes where: --topic TOPIC=INSTANCE.VARIABLE.",
        )
    return topics


def grid_of(info: MeshInfo) -> TimeGrid:
    """The communication points of a running mesh."""
    return TimeGrid(info.start_time, info.step_size, round((info.stop_time - info.start_time) / info.step_size))


def schedule(
    samples: Iterable[Sample], grid: TimeGrid, step_points: Mapping[str, int], *, start: float | None
) -> tuple[list[Moment], int, int]:
    """Put samples to the points from which on they hold.

    A value holds from the first point of its instance that is not before its stamp, as the value of a trajectory does.
    Of several for one point the last one counts.

    Args:
        samples: in any order.
        grid: the communication points.
        step_points: points per step of every instance.
        start: simulation time in s of the earliest stamp; None: stamps are simulation times.

    Returns:
        The moments in order, how many samples were replaced, and how many are too late to be seen.
    """
    ordered = sorted(samples, key=lambda sample: sample.stamp)
    shift = 0 if start is None or not ordered else nanoseconds(start) - ordered[0].stamp
    moments: dict[int, dict[tuple[str, str], Value]] = {}
    merged = beyond = 0
    for sample in ordered:
        point = _point_of(sample.stamp + shift, grid, step_points[sample.instance])
        if point >= grid.last_point:
            beyond += 1
            continue
        values = moments.setdefault(point, {})
        merged += (sample.instance, sample.variable) in values
        values[sample.instance, sample.variable] = sample.value
    return [Moment(point, moments[point]) for point in sorted(moments)], merged, beyond


def play(
    client: MeshClient, moments: Sequence[Moment], step_points: Mapping[str, int], timeout_s: float
) -> tuple[int, int]:
    """Let a mesh run from moment to moment, and set the values of each while it rests there; then let it run on.

    Moments that are past already count as the present: of each input the last one is set.

    Args:
        client: the mesh; it is paused, or is going to be.
        moments: in the order of their points.
        step_points: points per step of every instance.
        timeout_s: how long the mesh may rest without having come where it should, in s.

    Returns:
        How many values were set, and the point of the first.

    Raises:
        ConfigurationError: a value was refused.
        MeshLost: the mesh has ended, or does not come to the next moment.
    """
    hold = _commanded(client, Command("pause"))
    together = math.lcm(*step_points.values())  # where every instance can rest
    hold = _go_on(client, hold, -(-hold // together) * together)
    targets: dict[tuple[str, str], Target] = {}
    first, count = hold, 0
    for moment in _from(hold, moments):
        hold = _go_on(client, hold, moment.point)
        for instance in {instance for instance, _ in moment.values}:
            _wait_until_at(client, instance, hold, timeout_s)
        for (instance, variable), value in moment.values.items():
            key = (instance, variable)
            if key not in targets:
                targets[key] = client.target(f"{instance}.{variable}")
            answer = client.set(targets[key], encode_value(value).decode())
            if answer.point != hold:
                raise MeshLost(f"the value for point {hold} came to '{instance}.{variable}' at point {answer.point}.")
            count += 1
    client.command(Command("resume"))
    return count, first


def _commanded(client: MeshClient, command: Command) -> int:
    """Give a command that lets the mesh rest; the point where it is going to."""
    hold = client.command(command).hold
    if hold is None:
        raise ConfigurationError("the mesh does not say where it rests.", hint="Is it another version of fmu_mesh?")
    return hold


def _go_on(client: MeshClient, hold: int, point: int) -> int:
    """Let the mesh go on from the point where it rests, or is going to, to a later one; returns that."""
    if point > hold and _commanded(client, Command("step", point - hold)) != point:
        raise MeshLost(f"the mesh goes to another point than {point}: somebody else commands it, too.")
    return point


def _from(point: int, moments: Sequence[Moment]) -> Iterator[Moment]:
    """The moments from ``point`` on; what is past is one moment at ``point``."""
    past: dict[tuple[str, str], Value] = {}
    for moment in moments:
        if moment.point <= point:
            past |= moment.values
            continue
        if past:
            yield Moment(point, past)
            past = {}
        yield moment
    if past:
        yield Moment(point, past)


def _wait_until_at(client: MeshClient, instance: str, point: int, timeout_s: float) -> None:
    """Wait until an instance rests at ``point``."""
    never = threading.Event()
    look, reached, moved = _LOOK_S, -1, time.monotonic()
    while (status := client.instance_status(instance)).point != point:
        now = time.monotonic()
        if status.point != reached:
            look, reached, moved = _LOOK_S, status.point, now
        if now - moved > timeout_s:
            raise DeadlineExceeded(
                f"it does not come to point {point}: {status.activity}.", instance=instance, point=reached
            )
        never.wait(look)
        look = min(2 * look, _LONGEST_LOOK_S)


def _point_of(stamp: int, grid: TimeGrid, points: int) -> int:
    """The first point of an instance that is not before ``stamp``; a stamp is good to a nanosecond."""
    exact = (stamp / 1e9 - grid.start_time) / (points * grid.step_size)
    near = round(exact)
    step = near if abs(nanoseconds(grid.time(near * points)) - stamp) <= 1 else math.ceil(exact)
    return max(0, step) * points


def _entries(choices: Sequence[str], there: Mapping[str, str]) -> Iterator[RosTopicConfig]:
    fields: dict[str, dict[str, str]] = {}
    for choice in choices:
        found = _CHOICE.fullmatch(choice)
        if found is None:
            raise ConfigurationError(f"--topic {choice}: expected TOPIC=INSTANCE.VARIABLE or TOPIC:FIELD=….")
        topic = "/" + found["topic"].lstrip("/")
        if topic not in there:
            near = nearest(topic, there)
            hint = f"Did you mean '{near}'?" if near else f"It has {listed(sorted(there))}."
            raise ConfigurationError(f"--topic {choice}: the bag has no topic '{topic}'.", hint=hint)
        fields.setdefault(topic, {})[found["field"] or "data"] = found["variable"]
    for topic, own in fields.items():
        yield RosTopicConfig(topic=topic, type=there[topic], fields=own)


def _header_stamp(message: Any) -> int | None:  # noqa: ANN401 a message of rosbags
    stamp = getattr(getattr(message, "header", None), "stamp", None)
    if stamp is None or not (stamp.sec or stamp.nanosec):
        return None
    return int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)


def _parts(path: str) -> list[str | int]:
    """`pose.covariance[7]` as `pose`, `covariance`, 7."""
    return [int(part[1:-1]) if part.startswith("[") else part for part in _PART.findall(path)]


def _value_at(message: Any, parts: Sequence[str | int], what: str) -> Value:  # noqa: ANN401 a message of rosbags
    value = message
    try:
        for part in parts:
            value = value[part] if isinstance(part, int) else getattr(value, part)
    except IndexError as error:
        raise ConfigurationError(f"a message has no '{what}'.") from error
    plain: Value = value.tolist() if isinstance(value, np.generic | np.ndarray) else value
    return plain
