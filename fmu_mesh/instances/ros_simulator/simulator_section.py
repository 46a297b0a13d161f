"""The section of a ROS simulator in a configuration."""

from __future__ import annotations

import math
from typing import Annotated, Literal

import msgspec
from msgspec import Meta

from ...config.base import POSITIVE, Base, Endpoint
from ...config.findings import Findings
from ...config.instance_sections import (
    KIND,
    ExtrapolationOfInputs,
    Feedthrough,
    Group,
    Host,
    Inputs,
    InstanceSection,
    NotFinitePolicy,
    OnFailure,
    StartValues,
    StepSize,
)
from ...config.ros_section import Durability, Reliability
from ...variables.model_description import ModelDescription

__all__ = ["RosSimulatorConfig", "SimulatorConfig", "SimulatorTopicConfig"]


class SimulatorConfig(Base, frozen=True, kw_only=True):
    """Where a simulator is in ROS, and how it is stepped."""

    namespace: Annotated[str, Meta(description="Namespace of its services, and of topics with a relative name.")] = "/"
    step: Annotated[
        float,
        Meta(description="Length in s of one step of StepSimulation; it is set there.", extra_json_schema=POSITIVE),
    ]
    profile: Annotated[
        Literal["rmw_zenoh", "rclpy"],
        Meta(description="rmw_zenoh: without ROS on this side; rclpy: through the ROS of the Python that runs it."),
    ] = "rmw_zenoh"
    connect: Annotated[list[Endpoint], Meta(description="Endpoints of the router of rmw_zenoh.")] = msgspec.field(
        default_factory=lambda: ["tcp/127.0.0.1:7447"]
    )
    domain: Annotated[
        Annotated[int, Meta(ge=0, le=232)] | None,
        Meta(description="ROS_DOMAIN_ID; default: 0 with rmw_zenoh, and that of the environment with rclpy."),
    ] = None
    distribution: Annotated[
        Literal["humble", "jazzy", "kilted", "lyrical"],
        Meta(description="The ROS 2 distribution whose message definitions and type hashes are used."),
    ] = "jazzy"
    start_time: Annotated[
        float | None,
        Meta(description="Time in the simulator at point 0, in s; default: 0 after a reset, or that of a message."),
    ] = None
    timeout: Annotated[
        float,
        Meta(description="Longest wait for an answer or a message of the simulator, in s.", extra_json_schema=POSITIVE),
    ] = 20.0

    def __str__(self) -> str:
        return f"the ROS simulator in the namespace {self.namespace}"


class SimulatorTopicConfig(Base, frozen=True, kw_only=True):
    """A topic of the simulator: its fields are outputs or inputs of the instance."""

    topic: Annotated[str, Meta(description="Name of the topic; a relative one is in the namespace.")]
    type: Annotated[str, Meta(description="Message type.", examples=["sensor_msgs/msg/JointState"])]
    outputs: Annotated[
        dict[str, str],
        Meta(
            description="Names of outputs by field; `ranges[360]` is an array of that size.",
            examples=[{"position[name=hip]": "hip_angle"}],
        ),
    ] = {}
    inputs: Annotated[dict[str, str], Meta(description="Names of inputs by field.", examples=[{"data": "torque"}])] = {}
    match: Annotated[
        Literal["stamp", "count", "newest"],
        Meta(
            description="Which message of outputs belongs to a point: stamp: the one with its time in `header.stamp`; "
            "count: the one with its number; newest: the newest when the simulator has stepped."
        ),
    ] = "stamp"
    every: Annotated[
        int, Meta(ge=1, description="Steps of the simulator between two messages of outputs, for stamp and count.")
    ] = 1
    frame_id: Annotated[str, Meta(description="frame_id of every header in the messages of inputs.")] = ""
    reliability: Annotated[Reliability, Meta(description="Reliability in ROS.")] = "reliable"
    durability: Annotated[Durability, Meta(description="Durability in ROS.")] = "volatile"
    depth: Annotated[int, Meta(ge=1, le=100_000, description="History depth: messages that wait at most.")] = 1000


class RosSimulatorConfig(Base, InstanceSection, frozen=True, kw_only=True, tag_field=KIND, tag="ros_simulator"):
    """A simulator in ROS 2 that runs already; it is stepped through the services of simulation_interfaces."""

    ros_simulator: Annotated[SimulatorConfig, Meta(description="Where it is, and how it is stepped.")]
    topics: Annotated[list[SimulatorTopicConfig], Meta(min_length=1, description="Its topics as variables.")]
    interpreter: Annotated[
        str | None,
        Meta(description="The Python that has rclpy, with fmu-mesh installed; default: the one that runs fmu-mesh."),
    ] = None
    start_values: StartValues = {}
    inputs: Inputs = {}
    step_size: StepSize = None
    group: Group = None
    host: Host = None
    not_finite: NotFinitePolicy = None
    on_failure: OnFailure = "stop"
    extrapolation: ExtrapolationOfInputs = None
    feedthrough: Feedthrough = None

    @property
    def path(self) -> str:
        """Empty: the simulator runs already."""
        return ""

    def check(self, place: str, description: ModelDescription, findings: Findings) -> None:
        """Add a finding for each number that is out of its range, and for an interpreter that nothing needs."""
        own = self.ros_simulator
        for key, value in (("step", own.step), ("timeout", own.timeout)):
            if not (math.isfinite(value) and value > 0.0):
                findings.add(f"{place}.ros_simulator.{key}", f"{value:g}", "a time > 0 in s")
        if own.start_time is not None and not 0.0 <= own.start_time < math.inf:
            findings.add(f"{place}.ros_simulator.start_time", f"{own.start_time:g}", "a time >= 0 in s")
        if self.interpreter is not None and own.profile != "rclpy":
            findings.add(f"{place}.interpreter", f"with the profile {own.profile}", "the profile rclpy")

    def summary(self, description: ModelDescription) -> str:
        """Where the simulator is."""
        return str(self.ros_simulator)
