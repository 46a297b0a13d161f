"""The section `ros` of a configuration file: which topics a mesh has in ROS 2, and how ROS is reached."""

from __future__ import annotations

from typing import Annotated, Literal

import msgspec
from msgspec import Meta

from fmu_mesh.config.base import POSITIVE, Base, Endpoint
from fmu_mesh.text import listed

__all__ = [
    "ConstantFile",
    "MeshTopic",
    "Qos",
    "RosConfig",
    "RosProfile",
    "RosTopicConfig",
    "RosTopicProfile",
    "SimulationInterfacesConfig",
]

RosTopicProfile = Literal["ros2dds", "rmw_zenoh"]
RosProfile = Literal["ros2dds", "rmw_zenoh", "rclpy"]
_Names = str | list[str] | None
_Parts = str | dict[str, str] | None
Reliability = Literal["reliable", "best_effort"]
Durability = Literal["volatile", "transient_local"]


class Qos(msgspec.Struct, frozen=True):
    """Quality of service of a topic in ROS, as words `str`; ``deadline`` is in s of the wall clock."""

    reliability: Reliability = "reliable"
    durability: Durability = "volatile"
    # How many samples a DDS writer keeps at most for a reader that has not acknowledged them.
    depth: int = 1000
    deadline: float | None = None

    def __str__(self) -> str:
        deadline = f", deadline {self.deadline:g} s" if self.deadline is not None else ""
        return f"{self.reliability}, {self.durability}, depth {self.depth}{deadline}"


class MeshTopic(msgspec.Struct, frozen=True):
    """A topic in ROS that a mesh publishes (out) or subscribes to (in), and its variables as `instance.variable`."""

    topic: str
    direction: Literal["in", "out"]
    type: str
    qos: Qos
    sources: tuple[str, ...]

    @property
    def cells(self) -> list[str]:
        """A row of a table of topics."""
        way = "publishes" if self.direction == "out" else "subscribes to"
        return [f"{way} {self.topic}", self.type, str(self.qos), listed(self.sources)]


class ConstantFile(Base, frozen=True, kw_only=True):
    """A constant text that a file contains."""

    file: Annotated[str, Meta(description="Path of the file, relative to this file.", examples=["arm.urdf"])]


class RosTopicConfig(Base, frozen=True, kw_only=True):
    """A ROS topic: outputs are published, unconnected inputs are subscribed. The short form is `instance.variable`."""

    topic: Annotated[
        str | None,
        Meta(description="Name of the topic; default: <instance>/<variable>, with _ for what ROS does not allow."),
    ] = None
    variable: Annotated[
        str | None,
        Meta(description="`instance.variable`, or `instance` for all of its outputs and unconnected inputs."),
    ] = None
    type: Annotated[
        str | None,
        Meta(
            description="Message type; default: the one of std_msgs for the type of the variable.",
            examples=["std_msgs/msg/Float64"],
        ),
    ] = None
    fields: Annotated[
        dict[str, str],
        Meta(
            description="Several variables in one message: `instance.variable` by field, such as `position[name=hip]`.",
            examples=[{"twist.linear.x": "path_filter.v"}],
        ),
    ] = {}
    joint_states: Annotated[
        _Names,
        Meta(description="JointState on /joint_states: an instance with joints, or `instance.joint`, or a list."),
    ] = None
    tf: Annotated[
        _Names,
        Meta(description="TFMessage on /tf, world to body: an instance with bodies, `instance.body`, or a list."),
    ] = None
    odometry: Annotated[
        _Parts, Meta(description="Odometry on /odom: `instance.vector` by part, or body: `instance.body` for the pose.")
    ] = None
    imu: Annotated[
        _Parts,
        Meta(description="Imu on /imu: `instance.vector` by part, or body: `instance.body` for the orientation."),
    ] = None
    wrench: Annotated[
        _Parts,
        Meta(description="WrenchStamped on /wrench: `instance.vector` by part, or the `instance.body` it acts on."),
    ] = None
    twist: Annotated[
        _Parts,
        Meta(description="TwistStamped on /twist: `instance.vector` by part, or the `instance.body` that moves."),
    ] = None
    constants: Annotated[
        dict[str, str | float | int | bool | ConstantFile],
        Meta(
            description="Values that are the same in every published message, by field, such as the name of a frame. A "
            "topic without variables is published once, at the start.",
            examples=[{"transforms[0].child_frame_id": "base_link"}],
        ),
    ] = {}
    profile: Annotated[RosTopicProfile | None, Meta(description="Profile of this topic; default: that of `ros`.")] = (
        None
    )
    frame_id: Annotated[str, Meta(description="frame_id of every header in the message.")] = ""
    reliability: Annotated[
        Reliability,
        Meta(description="Reliability in ROS; a best-effort publisher needs a best-effort subscription here."),
    ] = "reliable"
    durability: Annotated[
        Durability | None,
        Meta(
            description="transient_local: who subscribes later gets the last samples if it asks for them; default: "
            "volatile, but transient_local for a topic without variables."
        ),
    ] = None
    depth: Annotated[
        Annotated[int, Meta(ge=1, le=100_000)] | None,
        Meta(description="History depth; default: 1000, but 1 for a topic without variables."),
    ] = None
    deadline: Annotated[
        float | None,
        Meta(
            description="Longest time from message to message, by the wall clock: offered if the topic is published, "
            "requested if it is subscribed. Missed ones are counted, and a warning names the first.",
            extra_json_schema=POSITIVE,
        ),
    ] = None


class SimulationInterfacesConfig(Base, frozen=True, kw_only=True):
    """The services of `simulation_interfaces`."""

    paced: Annotated[
        bool,
        Meta(description="Whether steps follow `real_time_factor`; otherwise they are made as fast as possible."),
    ] = True


class RosConfig(Base, frozen=True, kw_only=True):
    """The gateway to ROS 2, which needs no ROS on this host."""

    profile: Annotated[
        RosProfile,
        Meta(
            description="ros2dds: through zenoh-bridge-ros2dds, for ROS on DDS; rmw_zenoh: directly, for ROS on "
            "rmw_zenoh; rclpy: through a ROS node, `python -m fmu_mesh.ros.node` with this file."
        ),
    ] = "ros2dds"
    topics: Annotated[
        list[str | RosTopicConfig] | None,
        Meta(description="The topics; default: all outputs and all unconnected inputs of all instances."),
    ] = None
    connect: Annotated[list[Endpoint], Meta(description="Endpoints of the bridge, or of the router of rmw_zenoh.")] = (
        msgspec.field(default_factory=lambda: ["tcp/127.0.0.1:7447"])
    )
    listen: Annotated[
        list[Endpoint], Meta(description="Endpoints that a bridge can connect to, instead of `connect` or in addition.")
    ] = []
    node: Annotated[str | None, Meta(description="Name of the ROS node; default: the name of the mesh.")] = None
    namespace: Annotated[str, Meta(description="Namespace of the node and of its topics.")] = "/"
    domain: Annotated[int, Meta(ge=0, le=232, description="ROS_DOMAIN_ID; used with rmw_zenoh only.")] = 0
    distribution: Annotated[
        Literal["humble", "jazzy", "kilted", "lyrical"],
        Meta(description="The ROS 2 distribution whose message definitions and type hashes are used."),
    ] = "jazzy"
    clock_rate: Annotated[
        float | None,
        Meta(
            description="/clock messages per second of simulation time, at most one per point; null: no /clock.",
            extra_json_schema=POSITIVE,
        ),
    ] = 100.0
    simulation_interfaces: Annotated[
        bool | SimulationInterfacesConfig,
        Meta(
            description="Whether programs of ROS can pause, step and stop the mesh; not with ros2dds. True or options."
        ),
    ] = False
    messages: Annotated[
        dict[str, str],
        Meta(
            description="Custom message types: the path of each .msg file, relative to this file, by the full name.",
            examples=[{"lab_msgs/msg/Wheel": "msg/Wheel.msg"}],
        ),
    ] = {}

    @property
    def interfaces(self) -> SimulationInterfacesConfig | None:
        """The options of `simulation_interfaces`; None if they are off."""
        if isinstance(self.simulation_interfaces, SimulationInterfacesConfig):
            return self.simulation_interfaces
        return SimulationInterfacesConfig() if self.simulation_interfaces else None
