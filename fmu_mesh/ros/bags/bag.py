"""Reading a bag (MCAP or SQLite, by `ros2 bag` or by a mesh), which of its topics are inputs, and bags in scenarios.

`rosbags` finds messages and definitions; our own `Disassembler` reads them, as it does in the gateway.

Knows no communication points: `fmu_mesh.ros.bags.playing` finds the point of a sample.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Literal, Self

import msgspec
from msgspec.structs import replace

from ... import files
from ...config.findings import Findings
from ...config.loading import LoadedConfig
from ...config.mesh import RosConfig, RosTopicConfig
from ...config.scenario_section import ScenarioSource, ScenarioValues
from ...errors import ConfigurationError
from ...installing import importing
from ...results.formats import near_hint, reading
from ...ros_wire.assembling import Disassembler
from ...ros_wire.cdr import CdrError
from ...ros_wire.definitions import MessageTypes
from ...ros_wire.stamp import nanoseconds
from ...ros_wire.topics import Topic
from ...system.scenario import BagValues, is_bag
from ...text import did_you_mean, listed, nearest
from ...variables.model_description import ModelDescription, Value
from ..gateway.mapping import Resolver, message_types

if TYPE_CHECKING:
    from rosbags.interfaces.typing import Typesdict
    from rosbags.rosbag2 import Reader

__all__ = ["Bag", "BagSample", "bag_values", "timed", "topics_for"]

_CHOICE = re.compile(r"""(?P<topic>/?[^=:]+)(:(?P<field>([^=\[]|\[([^\]"']|"[^"]*"|'[^']*')*\])+))?=(?P<variable>.+)""")

StampSource = Literal["header", "log"]


class BagSample(msgspec.Struct, frozen=True):
    """One recorded value of an input, which holds from ``stamp`` on, in ns; an array has the shape of the variable."""

    stamp: int
    instance: str
    variable: str
    value: Value


class Bag:
    """A bag (an MCAP file, or the folder of a `ros2 bag`) that is open for reading; use it as a context manager.

    Raises:
        ConfigurationError: the file cannot be read, or `rosbags` is not installed.
    """

    def __init__(self, path: Path) -> None:
        with importing("rosbags"):
            from rosbags.rosbag2 import Reader  # noqa: PLC0415 an optional dependency
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
            self._reader = Reader(path)
            self._reader.open()
            try:
                self._definitions = _definitions(self._reader)
            except BaseException:
                self._reader.close()
                raise
        self._types = MessageTypes()
        self._types.store.fielddefs.update(self._definitions)  # its own come first

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
        for name, definition in self._definitions.items():
            types.store.fielddefs.setdefault(name, definition)

    def samples(self, topics: Sequence[Topic], stamps: StampSource) -> Iterator[BagSample]:
        """The values of subscribed ``topics`` in the order in which they were recorded.

        With ``stamps`` = `header` the stamp in the header counts, if there is one; `log` takes the time of recording.

        Raises:
            ConfigurationError: a message has no such array element, or an array of another size.
        """
        wanted: dict[str, list[Disassembler]] = {}
        with reading(self.path, "bag"):
            for topic in topics:  # several of one name give one message to several variables
                wanted.setdefault(topic.name, []).append(Disassembler(topic, self._types))
            connections = [connection for connection in self._reader.connections if connection.topic in wanted]
            for connection, logged, data in self._reader.messages(connections) if connections else ():
                for own in wanted[connection.topic]:
                    try:
                        values, stamp = own.values(data)
                    except CdrError as error:
                        raise ConfigurationError(f"a message of '{connection.topic}': {error}.") from error
                    at = logged if stamp is None or stamps == "log" else stamp
                    for port, value in zip(own.topic.ports, values, strict=True):
                        if value is not None:
                            yield BagSample(at, port.instance, port.variable.name, value)


def _definitions(reader: Reader) -> Typesdict:
    """The message types that a bag defines. The reader for all kinds of bags would run code that it makes of them."""
    from rosbags.interfaces import MessageDefinitionFormat  # noqa: PLC0415 an optional dependency
    from rosbags.typesys import get_types_from_idl, get_types_from_msg  # noqa: PLC0415 as above

    found: Typesdict = {}
    for connection in reader.connections:
        text, kind = connection.msgdef.data, connection.msgdef.format
        if kind == MessageDefinitionFormat.MSG:
            found |= get_types_from_msg(text, connection.msgtype)
        elif kind == MessageDefinitionFormat.IDL:
            # Several files have lines of `=` between them, and each begins with its name.
            for file in filter(None, text.split("=" * 80 + "\n")):
                found |= get_types_from_idl(file.partition("\n")[2] if file.startswith("IDL: ") else file)
    if reader.connections and not found:
        raise ConfigurationError(f"the bag '{reader.path}' has no definitions of its messages.")
    return found


def topics_for(
    loaded: LoadedConfig, descriptions: Mapping[str, ModelDescription], bag: Bag, choices: Sequence[str] = ()
) -> list[Topic]:
    """The topics of a bag that are played into inputs of a mesh.

    Each of the ``choices`` is `TOPIC=INSTANCE.VARIABLE` or `TOPIC:FIELD=INSTANCE.VARIABLE`. Without choices, the topics
    are those that the mesh subscribes to: by its `ros` section, or by the default names of its inputs.

    Raises:
        ConfigurationError: a choice is wrong, or the mesh subscribes to no topic of the bag.
    """
    there = bag.topics
    section = loaded.config.ros or RosConfig()
    findings = loaded.findings()
    types = message_types(loaded, section, findings)
    findings.raise_any()
    assert types is not None
    bag.add_types(types)
    # Each choice is a section of its own: a field may go to several variables.
    sections = [replace(section, topics=[_entry(choice, there)]) for choice in choices] or [section]
    found = [one for own in sections for one in Resolver(loaded, own, descriptions, types, findings).topics()]
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

    The earliest stamp is at ``start``, in s; None: stamps are simulation times.
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
        hint = did_you_mean(topic, there, f"It has {listed(sorted(there))}.")
        raise ConfigurationError(f"`topics=[{choice!r}]`: the bag has no topic '{topic}'.", hint=hint)
    return RosTopicConfig(topic=topic, type=there[topic], fields={found["field"] or "data": found["variable"]})


def bag_values(
    source: ScenarioSource, loaded: LoadedConfig, descriptions: Mapping[str, ModelDescription], findings: Findings
) -> dict[str, BagValues]:
    """Read the bags of a scenario; the result has the values by `instance.variable`, in the order of their times.

    What refers to no variable of ``descriptions`` is left out; what is wrong with a bag is added to ``findings``.
    """
    # One reading for all that name the same file, stamps, and time of the first message.
    wanted: dict[tuple[str, str, float | None], dict[str, ScenarioValues]] = {}
    for reference, values in source.config.values.items():
        instance, _, name = reference.partition(".")
        known = instance in descriptions and descriptions[instance].variable(name) is not None
        if isinstance(values, ScenarioValues) and values.file and values.topic and is_bag(values) and known:
            key = values.file, values.stamps or "header", values.start
            wanted.setdefault(key, {})[reference] = values
    found: dict[str, BagValues] = {}
    for (file, stamps, start), entries in wanted.items():
        places = {reference: f"{source.prefix}values.{reference}" for reference in entries}
        try:
            with Bag(source.resolve(file)) as bag:
                topics = _topics(entries, bag, partial(topics_for, loaded, descriptions, bag), source.prefix, findings)
                samples = timed(bag.samples(topics, "log" if stamps == "log" else "header"), start)
        except ConfigurationError as error:
            _add(f"{next(iter(places.values()))}.file", error, "a bag that can be read", findings)
            continue
        pairs: dict[str, list[tuple[float, Value]]] = {}
        for time, sample in samples:
            pairs.setdefault(f"{sample.instance}.{sample.variable}", []).append((time, sample.value))
        for reference, place in places.items():
            if own := pairs.get(reference):
                times, values_ = zip(*own, strict=True)
                found[reference] = BagValues(times, values_)
            elif reference in {f"{port.instance}.{port.variable.name}" for topic in topics for port in topic.ports}:
                findings.add(f"{place}.topic", f"'{entries[reference].topic}' without a message", "a topic with some")
    return found


def _add(place: str, error: ConfigurationError, expected: str, findings: Findings) -> None:
    found = error.message.removeprefix("`topics=...`: ").rstrip(".")
    findings.add(place, found, (error.hint or expected).rstrip("."))


def _topics(
    entries: Mapping[str, ScenarioValues],
    bag: Bag,
    find: Callable[[list[str]], list[Topic]],
    prefix: str,
    findings: Findings,
) -> list[Topic]:
    """The topics of all entries, each as for `fmu-mesh play --topic`, and a finding for each entry without one."""
    topics: list[Topic] = []
    for reference, values in entries.items():
        topic, place = "/" + (values.topic or "").partition(":")[0].lstrip("/"), f"{prefix}values.{reference}.topic"
        if topic not in bag.topics:
            found, expected = f"the unknown topic '{topic}' of '{values.file}'", f"one of {listed(sorted(bag.topics))}"
            findings.add(place, found, expected, nearest(topic, bag.topics))
            continue
        try:
            topics += find([f"{values.topic}={reference}"])
        except ConfigurationError as error:
            _add(place, error, "another field", findings)
    return topics
