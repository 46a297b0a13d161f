"""What the topics of a mesh are: plain values.

How the configuration becomes them is `fmu_mesh.ros.gateway.resolver`, how they look on the wire is the matter of a
profile, and how values get there that of the gateway.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal

import msgspec

from ...config.mesh import RosProfile
from ...variables.model_description import ModelDescription, Variable

__all__ = ["Descriptions", "Direction", "Kind", "Parameter", "Port", "RosPlan", "Topic"]

Descriptions = Mapping[str, ModelDescription]
Direction = Literal["out", "in"]
Kind = Literal["out", "in", "local"]


class Port(msgspec.Struct, frozen=True):
    """One variable of the mesh in a message.

    Attributes:
        path: the field, such as `twist.linear.x`.
        kind: the part of the key space that the variable is in.
        step_points: base points between two of its values.
    """

    path: str
    instance: str
    variable: Variable
    kind: Kind
    step_points: int


class Topic(msgspec.Struct, frozen=True):
    """One topic.

    Attributes:
        name: absolute name.
        message: full name of the message type.
        direction: `out` is published by the mesh, `in` is subscribed.
        stamped: whether the message has a header.
        constants: (field, value) of what every message has besides, such as the name of a frame.
    """

    name: str
    message: str
    direction: Direction
    ports: tuple[Port, ...]
    profile: RosProfile
    stamped: bool
    frame_id: str
    reliability: Literal["reliable", "best_effort"]
    constants: tuple[tuple[str, str | float | bool], ...] = ()


class Parameter(msgspec.Struct, frozen=True):
    """A parameter of the node in ROS: `<instance>.<variable>`."""

    name: str
    instance: str
    variable: Variable


class RosPlan(msgspec.Struct, frozen=True):
    """Everything that the gateway must know.

    Attributes:
        clock_points: points between two /clock messages; None for no clock.
        time_source: what tells the time where nothing is published.
    """

    topics: tuple[Topic, ...]
    parameters: tuple[Parameter, ...]
    node: str
    namespace: str
    clock_points: int | None
    time_source: Port | None
