"""From the `ros` section of a configuration to a plan: the section is checked and its topics are resolved.

A topic that passes can be sent and received; every problem with a name is reported. Knows neither Zenoh nor FMPy.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from pathlib import Path

import msgspec
from msgspec.structs import replace

from ...config.findings import Findings
from ...config.loading import LoadedConfig
from ...config.mesh import Config, ConstantFile, Qos, RosConfig, RosTopicConfig
from ...errors import ConfigurationError
from ...files import opened
from ...ros_wire.cdr import MAX_MESSAGE_SIZE
from ...ros_wire.definitions import MessageTypes, is_message_name
from ...ros_wire.fitting import TopicEntry, check_topic, default_type
from ...ros_wire.ros_names import absolute, name_problems, ros_name, topic_problem
from ...ros_wire.topics import Descriptions, Direction, Kind, NodeParameter, Port, RosPlan, Topic
from ...system.couplings import driven_inputs
from ...system.start_values import sized
from ...text import listed, nearest, nearest_file
from ...variables.model_description import Causality, ModelDescription, Variability, Variable
from ...variables.value_types import FMI2_TYPES, VariableType
from ...wire.views import InstanceInfo, VariableView
from .shapes import expanded

__all__ = ["Resolver", "descriptions_of", "message_types", "resolve"]

_CHOOSE_NAME = "a name of your choice: {topic: /a_name, variable: %s}"
_DATA = "data"
_KINDS: Mapping[str, Kind] = {"output": "out", "local": "local", "input": "in"}


def message_types(loaded: LoadedConfig, section: RosConfig, findings: Findings) -> MessageTypes | None:
    """The message types of a section `ros` with its custom ones; None after a finding."""
    custom = {}
    for name, file in section.messages.items():
        path = f"ros.messages.{name}"
        if not is_message_name(name):
            findings.add(path, f"'{name}'", "the full name of a message type, such as lab_msgs/msg/Wheel")
            continue
        if (text := _text_of(loaded.resolve(file), (path, file, "a .msg file"), findings)) is not None:
            custom[name] = text
    try:
        return MessageTypes(section.distribution, custom)
    except ConfigurationError as error:
        expected = f"a Python that has it. {error.hint}" if error.hint else "definitions that are complete"
        findings.add("ros.messages" if custom else "ros", error.message, expected)
        return None


def _text_of(place: Path, about: tuple[str, str, str], findings: Findings) -> str | None:
    """The text of a file; ``about`` is its key and its value in the configuration, and what is expected there."""
    key, file, expected = about
    try:
        with opened(place) as source:
            data = source.read(MAX_MESSAGE_SIZE + 1)
        if len(data) <= MAX_MESSAGE_SIZE:
            return data.decode()
        reason = f"it has more than {MAX_MESSAGE_SIZE} bytes"
    except (OSError, UnicodeDecodeError) as error:
        reason = (error.strerror if isinstance(error, OSError) else None) or str(error)
    findings.add(key, f"'{file}', which cannot be read ({reason})", expected, nearest_file(place))
    return None


def resolve(loaded: LoadedConfig, descriptions: Descriptions, findings: Findings, warnings: Findings) -> RosPlan | None:
    """Make the plan of the `ros` section; ``warnings`` gets what works and may not be meant.

    A topic of an instance without a description is not checked.

    Returns:
        The plan; None without a section or without message types. After findings it is incomplete.
    """
    section = loaded.config.ros
    if section is None:
        return None
    types = message_types(loaded, section, findings)
    _check_section(loaded.config, section, findings)
    # Array sizes that are too large are reported with the start values that set them, so not here.
    instances, ignored = loaded.config.instances, loaded.findings()
    full = {name: sized(name, own, instances[name], ignored) for name, own in descriptions.items() if name in instances}
    resolver = Resolver(loaded, section, full, types, findings)
    if types is None:  # the names can be checked
        resolver.topics()
        return None
    plan = resolver.plan()
    for warning in resolver.warnings:
        warnings.add(*warning)
    return plan


def descriptions_of(infos: Mapping[str, InstanceInfo]) -> dict[str, ModelDescription]:
    """The model descriptions of running instances, from their answers, with only what topics need.

    The instances may run on another host, so their FMUs cannot be read here.
    """
    return {
        name: ModelDescription(
            model_name=info.model_name,
            model_identifier=info.model_name,
            fmi_version=info.fmi_version,
            kind="co_simulation",
            guid="",
            variables=tuple(_variable(view) for view in info.variables),
        )
        for name, info in infos.items()
    }


def _variable(view: VariableView) -> Variable:
    return Variable(
        name=view.name,
        value_reference=0,
        type=msgspec.convert(FMI2_TYPES.get(view.type, view.type), VariableType),
        causality=msgspec.convert(view.causality, Causality),
        variability=msgspec.convert(view.variability, Variability),
        unit=view.unit,
        description=view.description,
        declared_type=view.type,
        shape=view.shape,
    )


def _check_section(config: Config, section: RosConfig, findings: Findings) -> None:
    if section.node is not None:
        problem = "a slash" if "/" in section.node else topic_problem(section.node)
        if problem is not None:
            findings.add("ros.node", f"'{section.node}': {problem}", "letters, digits and underscores, no digit first")
    if section.namespace != "/" and (problem := topic_problem(section.namespace)):
        findings.add("ros.namespace", f"'{section.namespace}': {problem}", "a name such as /robot")
    elif not section.namespace.startswith("/"):
        findings.add("ros.namespace", f"'{section.namespace}'", "a name that starts with a slash")
    if section.clock_rate is not None and not (math.isfinite(section.clock_rate) and section.clock_rate > 0):
        findings.add("ros.clock_rate", f"{section.clock_rate:g}", "a rate > 0 in Hz, or null for no /clock")
    if section.interfaces is not None and section.profile == "ros2dds":
        findings.add("ros.simulation_interfaces", "with the profile ros2dds", "the profile rmw_zenoh or rclpy")
    if not section.connect and not section.listen:
        findings.add("ros.connect", "no endpoint", "where the bridge or the router is, or an endpoint in ros.listen")
    if config.simulation.start_time < 0:
        found = f"{config.simulation.start_time:g}, while `ros` is there"
        findings.add("simulation.start_time", found, "a time >= 0: a ROS clock has no negative times")


class Resolver:
    """Resolves the topics of a section `ros`, or of another one in its place; without types, only names are checked.

    Attributes:
        warnings: what works and may not be meant, as the arguments of `Findings.add`.
    """

    def __init__(
        self,
        loaded: LoadedConfig,
        section: RosConfig,
        descriptions: Descriptions,
        types: MessageTypes | None,
        findings: Findings,
    ) -> None:
        self._loaded = loaded
        self._config = config = loaded.config
        self._section = section
        self._descriptions = descriptions
        self._types = types
        self._findings = findings
        self.warnings: list[tuple[str, str, str]] = []
        self._driven = driven_inputs(config, descriptions)
        self._owners: dict[tuple[str, Direction], str] = {}
        self._messages: dict[str, tuple[str, str]] = {}

    def topics(self) -> list[Topic]:
        """The topics without a finding."""
        topics = []
        for entry in self._entries():
            for topic in self._topics(entry):
                self._check_unique(topic, entry.path)
                topics.append(topic)
        return topics

    def plan(self) -> RosPlan:
        """The plan; after findings it is incomplete. It needs message types."""
        assert self._types is not None
        step_size, rate = self._config.simulation.step_size, self._section.clock_rate
        return RosPlan(
            types=self._types,
            topics=tuple(self.topics()),
            parameters=tuple(self._parameters()),
            node=self._section.node or ros_name(self._config.mesh),
            namespace=self._section.namespace,
            clock_points=max(1, round(1 / (rate * step_size))) if rate and step_size > 0 else None,
            may_fail=tuple(name for name, own in self._config.instances.items() if own.on_failure != "stop"),
            time_source=next(
                (
                    self._as_port(instance, variable, "")
                    for instance, description in self._descriptions.items()
                    for variable in description.with_causality("output", "local", "input")
                    if variable.type not in ("String", "Binary")
                ),
                None,
            ),
        )

    def _entries(self) -> Iterator[TopicEntry]:
        if self._section.topics is None:
            for instance in self._config.instances:
                yield TopicEntry(RosTopicConfig(variable=instance), "ros", "ros")
            return
        for index, entry in enumerate(self._section.topics):
            path = f"ros.topics[{index}]"
            if isinstance(entry, str):
                yield TopicEntry(RosTopicConfig(variable=entry), path, path)
            else:
                topic = TopicEntry(entry, path, f"{path}.variable")
                made = expanded(topic, self._config.instances, self._descriptions, self._findings)
                yield from [made] if made is not None else []

    # --- topics

    def _topics(self, entry: TopicEntry) -> Iterator[Topic]:
        item = entry.item
        if item.variable is None and not item.fields and item.constants:
            yield from self._message_of_fields(entry)
        elif (item.variable is None) == (not item.fields):
            found = "neither `variable` nor `fields`" if item.variable is None else "both `variable` and `fields`"
            self._findings.add(entry.path, found, "one of them, or neither and `constants`")
        elif item.variable is None:
            yield from self._message_of_fields(entry)
        elif item.variable in self._config.instances:
            yield from self._all_of_instance(entry, item.variable)
        else:
            yield from self._single(entry, item.variable)

    def _all_of_instance(self, entry: TopicEntry, instance: str) -> Iterator[Topic]:
        item = entry.item
        if item.type is not None:
            found = f"one type for all topics of the instance '{instance}'"
            self._findings.add(f"{entry.path}.type", found, "a topic per variable")
            return
        description = self._descriptions.get(instance)
        wanted = [
            variable
            for variable in (description.variables if description is not None else ())
            if variable.causality in ("output", "input") and f"{instance}.{variable.name}" not in self._driven
            if default_type(variable.type, array=bool(variable.shape)) is not None
        ]
        problems = name_problems(variable.name for variable in wanted)
        for problem in problems:
            expected = _CHOOSE_NAME % f"'{instance}.{problem.variables[0]}'"
            self._findings.add(entry.variable_path, f"in '{instance}' {problem}", expected)
        unusable = {name for problem in problems for name in problem.variables}
        for variable in wanted:
            if variable.name not in unusable:
                topic = f"{item.topic}/{ros_name(variable.name)}" if item.topic is not None else None
                own = replace(item, topic=topic, variable=f"{instance}.{variable.name}")
                yield from self._single(replace(entry, item=own), f"{instance}.{variable.name}")

    def _single(self, entry: TopicEntry, reference: str) -> Iterator[Topic]:
        port = self._port(reference, _DATA, entry.variable_path)
        if port is None:
            return
        name = entry.item.topic
        if name is None:
            problems = name_problems([port.variable.name])
            for problem in problems:
                self._findings.add(entry.variable_path, str(problem), _CHOOSE_NAME % f"'{reference}'")
            if problems:
                return
            name = f"{ros_name(port.instance)}/{ros_name(port.variable.name)}"
        message = entry.item.type or default_type(port.variable.type, array=bool(port.variable.shape))
        if message is None:
            text = f"'{reference}' of the type {port.variable.type}, which no message of std_msgs carries"
            self._findings.add(entry.variable_path, text, "a message in `type` and its field in `fields`")
            return
        yield from self._topic(entry, name, message, (port,))

    def _message_of_fields(self, entry: TopicEntry) -> Iterator[Topic]:
        item = entry.item
        if item.topic is None or item.type is None:
            key = "topic" if item.topic is None else "type"
            self._findings.add(f"{entry.path}.{key}", f"no `{key}`", f"a {key}: no variable gives one to this message")
            return
        found = [self._port(own, field, entry.place(field)) for field, own in item.fields.items()]
        ports = [port for port in found if port is not None]
        directions: dict[Direction, str] = {}
        for port in ports:
            directions.setdefault(port.direction, f"{port.instance}.{port.variable.name}")
        if len(directions) > 1:
            text = f"the output '{directions['out']}' and the input '{directions['in']}' in one message"
            self._findings.add(f"{entry.path}.fields", text, "a topic for each direction")
        elif len(ports) == len(item.fields):
            yield from self._topic(entry, item.topic, item.type, tuple(ports))

    def _topic(self, entry: TopicEntry, name: str, message: str, ports: tuple[Port, ...]) -> Iterator[Topic]:
        full_name = absolute(name, self._section.namespace)
        before = len(self._findings)
        if (problem := topic_problem(full_name)) is not None:
            expected = "letters, digits, underscores and slashes, no part that starts with a digit"
            self._findings.add(f"{entry.path}.topic", f"'{name}': {problem}", expected)
        topic = Topic(
            name=full_name,
            message=message,
            direction=ports[0].direction if ports else "out",
            ports=ports,
            profile=entry.item.profile or self._section.profile,
            frame_id=entry.item.frame_id,
            qos=self._qos(entry, is_constant=not ports),
            constants=tuple(self._constants(entry)),
        )
        if self._types is not None and len(self._findings) == before:
            topic = check_topic(entry, topic, self._types, self._findings, self.warnings)
        if len(self._findings) == before:
            yield topic

    def _qos(self, entry: TopicEntry, *, is_constant: bool) -> Qos:
        item, path = entry.item, entry.path
        if is_constant and item.durability == "volatile":
            expected = "transient_local: it is published once, so who subscribes later would never get it"
            self._findings.add(f"{path}.durability", "volatile for a topic without variables", expected)
        if item.deadline is not None and (is_constant or not 0 < item.deadline < math.inf):
            found = f"{item.deadline:g} for a topic that is published once" if is_constant else f"{item.deadline:g}"
            self._findings.add(f"{path}.deadline", found, "no deadline" if is_constant else "a time > 0 in s")
        durability = item.durability or ("transient_local" if is_constant else "volatile")
        return Qos(item.reliability, durability, item.depth or (1 if is_constant else Qos().depth), item.deadline)

    def _constants(self, entry: TopicEntry) -> Iterator[tuple[str, str | float | bool]]:
        for field, value in entry.item.constants.items():
            if not isinstance(value, ConstantFile):
                yield field, value
                continue
            about = f"{entry.path}.constants.{field}.file", value.file, "a file of text"
            if (text := _text_of(self._loaded.resolve(value.file), about, self._findings)) is not None:
                yield field, text

    # --- variables

    def _port(self, reference: str, field: str, path: str) -> Port | None:
        """The variable with the name ``reference`` in a field; None after a finding."""
        variable = self._variable(reference, path)
        if variable is None:
            return None
        if variable.causality == "input" and reference in self._driven:
            self._findings.add(path, f"the connected input '{reference}'", self._driven[reference])
            return None
        if variable.causality not in _KINDS:
            expected = "an output, a local variable or an input; parameters are parameters in ROS, too"
            self._findings.add(path, f"'{reference}', a {variable.causality}", expected)
            return None
        return self._as_port(reference.partition(".")[0], variable, field)

    def _variable(self, reference: str, path: str) -> Variable | None:
        """The variable with the name `instance.variable`; None after a finding, or if the FMU could not be read."""
        instance, dot, name = reference.partition(".")
        names = list(self._config.instances)
        if instance not in names:
            expected = f"one of the instances {listed(names)}"
            self._findings.add(path, f"the unknown instance '{instance}'", expected, nearest(instance, names))
            return None
        description = self._descriptions.get(instance)
        variable = description.variable(name) if dot and description is not None else None
        if variable is None and description is not None:
            ends = description.with_causality("output", "input")
            near = [own.name for own in ends if f"{instance}.{own.name}" not in self._driven]
            found = f"the unknown variable '{name}' of instance '{instance}'"
            if (clock := description.clock(name)) is not None:
                self._findings.add(path, clock, "")
            else:
                self._findings.add(path, found, f"one of {listed(near)}", nearest(name, near))
        return variable

    def _as_port(self, instance: str, variable: Variable, field: str) -> Port:
        step, base = self._config.instances[instance].step_size, self._config.simulation.step_size
        points = max(1, round(step / base)) if step is not None and base > 0 else 1
        return Port(field, instance, variable, _KINDS[variable.causality], points)

    def _parameters(self) -> Iterator[NodeParameter]:
        for instance, description in self._descriptions.items():
            own = [variable for variable in description.with_causality("parameter") if not variable.shape]
            unusable = {name for problem in name_problems(v.name for v in own) for name in problem.variables}
            for variable in own:
                if variable.name not in unusable:
                    yield NodeParameter(f"{ros_name(instance)}.{ros_name(variable.name)}", instance, variable)

    # --- the whole

    def _check_unique(self, topic: Topic, path: str) -> None:
        owners = ", ".join(f"'{port.instance}.{port.variable.name}'" for port in topic.ports) or f"constants ({path})"
        first = self._owners.setdefault((topic.name, topic.direction), owners)
        message, owner = self._messages.setdefault(topic.name, (topic.message, owners))
        if first is not owners:
            found = f"the topic '{topic.name}' for {owners} and for {first}"
            self._findings.add(path, found, _CHOOSE_NAME % owners.partition(",")[0])
        elif message != topic.message:
            found = f"the topic '{topic.name}' with '{topic.message}' for {owners}, and with '{message}' for {owner}"
            self._findings.add(path, found, "one message type for one topic")
