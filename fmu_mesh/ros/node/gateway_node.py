"""The gateway of a mesh as a ROS lifecycle node: its topics are those of the node, on whatever middleware ROS has.

What flows is the matter of `fmu_mesh.ros.gateway.gateway`; here is the profile that lets rclpy carry it, and the mesh's
parameters as those of the node.
"""

from __future__ import annotations

import threading
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import msgspec
from msgspec.structs import replace

from ...config.mesh import RosConfig
from ...errors import ConfigurationError, FmuMeshError, MeshLost
from ...instances.configuration import load
from ...wire.client.mesh_client import MeshClient
from ...wire.client.reaching import Meshes
from ...wire.client.readings import Target
from ...wire.session import tokens
from ..bags.playing import grid_of
from ..gateway.gateway import Gateway
from ..gateway.mapping import message_types, resolve
from ..gateway.profile import DEPTH, Profile, Put, Take
from ..gateway.seen import descriptions_of
from ..gateway.topics import RosPlan, Topic
from ..messages.definitions import MessageTypes
from .clock_watch import ClockWatch
from .node_parameters import RosNode
from .rclpy_modules import message_class, ros_module

__all__ = ["GatewayNode", "RclpyProfile"]

_TIMEOUT_S = 10.0
_LOOK_S = 0.25


class RclpyProfile:
    """A profile whose topics are those of a node of rclpy. Messages pass as the CDR bytes that they are.

    Args:
        node: the node; stays the caller's.
    """

    def __init__(self, node: RosNode) -> None:
        self._node = node
        self._publishers: list[Any] = []
        self._subscriptions: list[Any] = []

    def publish(self, topic: Topic) -> Put:
        """Be a publisher of ``topic``."""
        publisher = self._node.create_publisher(message_class(topic.message), topic.name, _quality(topic))
        self._publishers.append(publisher)

        def put(data: bytes, _time: float) -> None:
            try:
                publisher.publish(data)
            except Exception:
                # Ctrl-C shuts ROS down while samples still come; nobody is there any more to take them.
                if self._node.context.ok():
                    raise

        return put

    def subscribe(self, topic: Topic, take: Take) -> None:
        """Be a subscriber of ``topic``."""
        kind = message_class(topic.message)
        self._subscriptions.append(self._node.create_subscription(kind, topic.name, take, _quality(topic), raw=True))

    def close(self) -> None:
        """Destroy everything."""
        for subscription in self._subscriptions:
            self._node.destroy_subscription(subscription)
        for publisher in self._publishers:
            self._node.destroy_publisher(publisher)
        self._subscriptions, self._publishers = [], []


class GatewayNode:
    """What a lifecycle node does that is the gateway of a running mesh.

    Args:
        node: the lifecycle node, with the parameters `config` and `connect` declared.

    Attributes:
        failure: None; a mesh that ends is no failure of its gateway.
    """

    failure: FmuMeshError | None = None

    def __init__(self, node: RosNode) -> None:
        self._node = node
        self._log = node.get_logger()
        self._stack = ExitStack()
        self._client: MeshClient | None = None
        self._plan: RosPlan | None = None
        self._types: MessageTypes | None = None
        self._targets: dict[str, Target] = {}
        self._run = ""
        self._active = ExitStack()

    def configure(self) -> None:
        """Find the mesh, resolve its topics, and declare its parameters.

        Raises:
            FmuMeshError: something is wrong; nothing is left of this attempt.
        """
        try:
            self._configure()
        except BaseException:
            self.cleanup()
            raise

    def activate(self) -> None:
        """Let topics flow.

        Raises:
            FmuMeshError: a topic cannot be opened, or the mesh has ended; nothing is left of this attempt.
        """
        try:
            self._activate()
        except BaseException:
            self.deactivate()
            raise

    def deactivate(self) -> None:
        """Let nothing flow any more; what has come from the mesh is published before."""
        self._active.close()

    def cleanup(self) -> None:
        """Leave the mesh, and take its parameters back. Never raises."""
        self.deactivate()
        self._stack.close()
        self._client, self._plan, self._types, self._targets = None, None, None, {}

    def close(self) -> bool:
        """`cleanup`; returns that nothing is left running."""
        self.cleanup()
        return True

    def _configure(self) -> None:
        loaded = load(Path(self._node.get_parameter("config").value))
        if loaded.config.ros is None:
            loaded = replace(loaded, config=replace(loaded.config, ros=RosConfig()))
        endpoints = [endpoint for endpoint in self._node.get_parameter("connect").value if endpoint]
        meshes = self._stack.enter_context(Meshes(endpoints, _TIMEOUT_S))
        client = self._client = meshes.named(loaded.config.mesh)
        info = client.info()
        self._run = info.run
        infos = {name: client.instance_info(name) for name in info.instances}
        findings = loaded.findings()
        self._types = message_types(loaded, findings)
        plan = self._plan = resolve(loaded, descriptions_of(infos), findings)
        findings.raise_any()
        if plan is not None:
            self._declare_parameters(client, plan)
        self._log.info(f"gateway of mesh '{loaded.config.mesh}' with {len(plan.topics) if plan else 0} topics")

    def _activate(self) -> None:
        client, plan, types = self._client, self._plan, self._types
        if client is None or plan is None or types is None:
            raise ConfigurationError("the gateway has no mesh yet.", hint="Configure it first.")
        if not tokens(client.session, client.keys.master) or (info := client.info()).run != self._run:
            raise MeshLost(
                f"the run of mesh '{client.keys.mesh}' for which this node was configured has ended",
                hint="Clean the node up, and configure it again when the mesh runs.",
            )
        profile = RclpyProfile(self._node)
        self._active.callback(profile.close)
        names = {topic.profile for topic in plan.topics} or {"ros2dds"}
        profiles: dict[str, Profile] = dict.fromkeys(map(str, sorted(names)), profile)
        gateway = Gateway(plan, types, client.session, client.keys, grid_of(info), profiles, _TIMEOUT_S)
        self._active.callback(gateway.close)
        gateway.open()
        thread = threading.Thread(target=gateway.run, name="gateway", daemon=True)
        thread.start()
        self._active.callback(thread.join, _TIMEOUT_S)
        self._active.callback(gateway.end)
        clock = ros_module("rclpy.clock")
        steady = clock.Clock(clock_type=clock.ClockType.STEADY_TIME)
        timer = self._node.create_timer(_LOOK_S, lambda: self._look(thread), clock=steady)
        self._active.callback(self._node.destroy_timer, timer)
        if plan.clock_points is not None:
            self._active.callback(ClockWatch(self._node, "`clock_rate: null` in the section `ros`").close)

    def _declare_parameters(self, client: MeshClient, plan: RosPlan) -> None:
        """The parameters of the mesh as those of the node, with their current values."""
        references = {
            parameter.name: f"{parameter.instance}.{parameter.variable.name}" for parameter in plan.parameters
        }
        self._targets = {name: client.target(reference) for name, reference in references.items()}
        values = {reading.key: reading.value for reading in client.get(list(self._targets.values()))}
        descriptor = ros_module("rcl_interfaces.msg").ParameterDescriptor
        for name, target in self._targets.items():
            view = target.variable
            about = f"{target.instance}.{view.name}: {view.description or view.causality}"
            about += f" ({view.variability} {view.type}{f' in {view.unit}' if view.unit else ''})"
            # ROS never lets go of a read-only parameter, and the next run has others: the mesh refuses what is fixed.
            self._node.declare_parameter(
                name, values.get(target.key), descriptor(description=about, dynamic_typing=True)
            )
            self._stack.callback(self._node.undeclare_parameter, name)
        self._node.add_on_set_parameters_callback(self._set_parameters)
        self._stack.callback(self._node.remove_on_set_parameters_callback, self._set_parameters)

    def _set_parameters(self, parameters: Sequence[Any]) -> Any:  # noqa: ANN401 types of rclpy
        """Set tunable parameters of the mesh; what the mesh refuses is refused with its reason."""
        result = ros_module("rcl_interfaces.msg").SetParametersResult
        for parameter in parameters:
            target = self._targets.get(parameter.name)
            if target is None or self._client is None:
                continue
            try:
                self._client.set(target, msgspec.json.encode(parameter.value).decode())
            except FmuMeshError as error:
                return result(successful=False, reason=str(error))
        return result(successful=True)

    def _look(self, carrying: threading.Thread) -> None:
        if not carrying.is_alive():
            self._log.info("the mesh has ended")
            self._node.trigger_deactivate()


def _quality(topic: Topic) -> Any:  # noqa: ANN401 a type of rclpy
    qos = ros_module("rclpy.qos")
    reliability = {"reliable": qos.ReliabilityPolicy.RELIABLE, "best_effort": qos.ReliabilityPolicy.BEST_EFFORT}
    return qos.QoSProfile(depth=DEPTH, reliability=reliability[topic.reliability])
