"""The topics of a ROS simulator as variables: from the section of an instance to topics and a model description.

A field says which type its variable has. What cannot be read from messages, or sent in them, is a finding here.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator

import msgspec

from ...config.findings import Findings
from ...config.mesh import Qos, RosTopicConfig
from ...errors import ConfigurationError, LoadFailed
from ...ros_wire.cdr import CdrError
from ...ros_wire.definitions import Array, Basic, MessageTypes, Nested, Sequence, UnknownField, UnknownType
from ...ros_wire.fitting import TopicEntry, check_topic
from ...ros_wire.ros_names import absolute, topic_problem
from ...ros_wire.simulation_types import define_simulation_types
from ...ros_wire.topics import Port, Topic
from ...text import listed, nearest
from ...variables.model_description import ModelDescription, Variable
from ...variables.value_types import TYPES, VariableType, zero
from .simulator_section import RosSimulatorConfig, SimulatorTopicConfig

__all__ = ["SimulatorTopics"]

_SECTION = "section"
_SIZED = re.compile(r"(.+)\[([1-9]\d*)\]")
_TYPES: dict[str, VariableType] = {
    **{name.lower(): name for name in TYPES},
    "bool": "Boolean",
    "byte": "UInt8",
    "char": "UInt8",
}


class SimulatorTopics(msgspec.Struct, frozen=True):
    """The topics of an instance, each with its place in the section, and the message types.

    Inputs of the instance are published, so their topics have the direction `out`.
    """

    types: MessageTypes
    topics: tuple[tuple[Topic, SimulatorTopicConfig], ...]

    @classmethod
    def of(cls, section: RosSimulatorConfig) -> SimulatorTopics:
        """The topics of a section.

        Raises:
            LoadFailed: they cannot be what the section says; says why.
        """
        findings = Findings(_SECTION)
        try:
            types = MessageTypes(section.ros_simulator.distribution)
            define_simulation_types(types)
            topics = tuple(_topics(section, types, findings))
        except ConfigurationError as error:  # such as a library that is missing
            raise LoadFailed(error.message, hint=error.hint) from error
        names = [port.variable.name for topic, _ in topics for port in topic.ports]
        if twice := sorted({name for name in names if names.count(name) > 1}):
            findings.add("topics", f"{listed(twice)} more than once", "a name of its own for each variable")
        if findings:
            raise LoadFailed("; ".join(str(found).removeprefix(f"{_SECTION}: ") for found in findings))
        return cls(types, topics)

    def description(self, step_s: float) -> ModelDescription:
        """The variables of all topics of a simulator whose own steps take ``step_s``."""
        newest = [own.topic for _, own in self.topics if own.outputs and own.match == "newest"]
        doubt = f"the newest message on {listed(newest)}: two runs may differ. Use stamp or count where you can"
        return ModelDescription(
            model_name="ros_simulator",
            model_identifier="ros_simulator",
            fmi_version="",
            kind="ros_simulator",
            guid="{ros_simulator}",
            variables=tuple(port.variable for topic, _ in self.topics for port in topic.ports),
            description="simulator in ROS 2",
            generation_tool="simulation_interfaces",
            fixed_step_size=step_s if 0.0 < step_s < math.inf else None,
            not_repeatable=doubt if newest else None,
        )


def _topics(
    section: RosSimulatorConfig, types: MessageTypes, findings: Findings
) -> Iterator[tuple[Topic, SimulatorTopicConfig]]:
    for number, own in enumerate(section.topics):
        path, before = f"topics[{number}]", len(findings)
        topic_name = absolute(own.topic, section.ros_simulator.namespace)
        if (problem := topic_problem(topic_name)) is not None:
            findings.add(f"{path}.topic", f"'{topic_name}': {problem}", "letters, digits, underscores and slashes")
        if bool(own.outputs) == bool(own.inputs):
            found = "both `outputs` and `inputs`" if own.outputs else "neither `outputs` nor `inputs`"
            findings.add(path, found, "one of them: a topic for each direction")
        if own.type not in types:
            near = nearest(own.type, tuple(types.store.fielddefs))
            findings.add(f"{path}.type", f"the unknown message type '{own.type}'", "one of ROS", near)
        elif own.outputs and own.match == "stamp" and not types.has_header(own.type):
            found = f"'{own.type}', which has no header with a stamp"
            findings.add(path, found, "`match: count` or `match: newest`, which say which message belongs to a point")
        if len(findings) > before:
            continue
        fields = own.outputs or own.inputs
        ports = [_port(own, field, name, types, (f"{path}.{field}", findings)) for field, name in fields.items()]
        topic = Topic(
            name=topic_name,
            message=own.type,
            direction="in" if own.outputs else "out",
            ports=tuple(port for port in ports if port is not None),
            profile=section.ros_simulator.profile,
            frame_id=own.frame_id,
            qos=Qos(own.reliability, own.durability, own.depth),
        )
        if len(findings) == before:
            written = RosTopicConfig(topic=topic_name, type=own.type, fields=dict(fields))
            try:
                topic = check_topic(TopicEntry(written, path, path), topic, types, findings, [])
            except CdrError as error:
                findings.add(path, str(error), "messages that can be sent and received")
            yield topic, own


def _port(
    own: SimulatorTopicConfig, field: str, name: str, types: MessageTypes, about: tuple[str, Findings]
) -> Port | None:
    """The variable of a field; ``about`` is its place, and takes a finding, after which there is none."""
    path, findings = about
    try:
        kind = types.field(own.type, field)
    except (UnknownField, UnknownType) as error:
        findings.add(path, str(error), f"one of {listed(error.names)}", nearest(field, error.names))
        return None
    sized = _SIZED.fullmatch(name) if isinstance(kind, Sequence) else None
    name, shape = (sized[1], (int(sized[2]),)) if sized else (name, (kind.length,) if isinstance(kind, Array) else ())
    element = kind if isinstance(kind, Basic | Nested) else kind.element
    if isinstance(element, Nested) or element.kind not in _TYPES or (isinstance(kind, Sequence) and not shape):
        expected = "a number, a text or an array of them; write `name[360]` for an array of any length"
        findings.add(path, f"'{field}' of '{own.type}'", expected)
        return None
    type_, is_input = _TYPES[element.kind], bool(own.inputs)
    start = zero(type_)
    variable = Variable(
        name=name,
        value_reference=0,
        type=type_,
        causality="input" if is_input else "output",
        variability="continuous" if type_.startswith("Float") else "discrete",
        initial=None if is_input else "approx",
        start=([start] * shape[0] if shape else start) if is_input else None,
        description=f"{field} of {own.topic}",
        dependencies=(),  # it is read when the simulator is at the point, and follows inputs in the next step only
        feedthrough=(),
        dimensions=shape,
        shape=shape,
    )
    return Port(field, "", variable, "out" if is_input else "in")
