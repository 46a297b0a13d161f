"""The topics of a mesh or of a node: plain values.

`fmu_mesh.ros.gateway.mapping` makes them from a configuration, `fmu_mesh.ros.node.node_topics` from the parameters of
a ROS node.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal

import msgspec

from ..config.ros_section import MeshTopic, Qos, RosProfile
from ..variables.model_description import ModelDescription, Variable
from .definitions import CLOCK, MessageTypes

__all__ = [
    "CLOCK_TOPIC",
    "DIAGNOSTICS",
    "DIAGNOSTICS_TOPIC",
    "Descriptions",
    "Direction",
    "Kind",
    "NodeParameter",
    "Port",
    "RosPlan",
    "Topic",
]

CLOCK_TOPIC = "/clock"
DIAGNOSTICS_TOPIC, DIAGNOSTICS = "/diagnostics", "diagnostic_msgs/msg/DiagnosticArray"

Descriptions = Mapping[str, ModelDescription]
Direction = Literal["out", "in"]
Kind = Literal["out", "in", "local"]


class Port(msgspec.Struct, frozen=True):
    """One variable and its field in a message.

    Attributes:
        path: the field, such as `twist.linear.x`; in a plan, published fields have indexes instead of keys.
        instance: name of the instance; empty for a node that runs a single FMU.
        kind: the part of the key space that the variable is in.
        step_points: base points between two values of the variable.
    """

    path: str
    instance: str
    variable: Variable
    kind: Kind
    step_points: int = 1

    @property
    def direction(self) -> Direction:
        """The direction of its topic."""
        return "in" if self.kind == "in" else "out"


class Topic(msgspec.Struct, frozen=True):
    """One topic.

    Attributes:
        name: absolute name; in a node that runs a single FMU it may be relative to the namespace of the node.
        direction: the mesh publishes `out` and subscribes to `in`.
        ports: its variables; without one, it is published once.
        profile: how the topic looks on Zenoh.
        frame_id: of every header in the message.
        constants: (field, value) for fields that have the same value in every message.
    """

    name: str
    message: str
    direction: Direction
    ports: tuple[Port, ...]
    profile: RosProfile = "ros2dds"
    frame_id: str = ""
    qos: Qos = Qos()
    constants: tuple[tuple[str, str | float | bool], ...] = ()


class NodeParameter(msgspec.Struct, frozen=True):
    """A variable of the mesh as a parameter of the ROS node, named `<instance>.<variable>`."""

    name: str
    instance: str
    variable: Variable


class RosPlan(msgspec.Struct, frozen=True):
    """Everything that the gateway needs to know.

    Attributes:
        clock_points: points between two /clock messages; None: no /clock.
        time_source: the variable whose samples show the time if no topic is published; None if there is none.
        may_fail: the instances that may fail without an end of the run: they are in `/diagnostics`.
    """

    types: MessageTypes
    topics: tuple[Topic, ...] = ()
    parameters: tuple[NodeParameter, ...] = ()
    node: str = ""
    namespace: str = "/"
    clock_points: int | None = None
    time_source: Port | None = None
    may_fail: tuple[str, ...] = ()

    @property
    def listed(self) -> tuple[MeshTopic, ...]:
        """What users are shown of the topics."""
        shown = [
            MeshTopic(
                topic=topic.name,
                direction=topic.direction,
                type=topic.message,
                qos=topic.qos,
                sources=tuple(f"{port.instance}.{port.variable.name}" for port in topic.ports) or ("constants",),
            )
            for topic in self.topics
        ]
        clock = MeshTopic(CLOCK_TOPIC, "out", CLOCK, Qos(), ("simulation time",))
        failed = MeshTopic(DIAGNOSTICS_TOPIC, "out", DIAGNOSTICS, Qos(), self.may_fail)
        clocks = (clock,) if self.clock_points is not None else ()
        return (*shown, *clocks, *((failed,) if self.may_fail else ()))
