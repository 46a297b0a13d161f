"""The gateway of a mesh as a ROS lifecycle node: rclpy carries its topics, so every middleware of ROS works.

`fmu_mesh.ros.gateway.gateway` carries the samples. Here are the profile for rclpy, what `fmu-mesh status` says of it,
and the parameters of the mesh as parameters of the node.
"""

# Threads: `gateway` runs the gateway and publishes; Zenoh calls its callbacks, and `_answer`, which reads what the last
# look has found. The executor of rclpy makes the transitions, looks four times a second whether the gateway has ended
# and who else is in ROS, takes messages, and sets parameters, for which it waits for the mesh. The exit stacks
# undo what a transition did in the order in which the threads need it: first no more looks and answers, then the end
# of the thread, then the subscribers and the publishers that it used (ADR 0030, 0031).

from __future__ import annotations

import threading
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import msgspec
import zenoh
from msgspec.structs import replace

from ...config.access_sections import given_folder
from ...config.loading import LoadedConfig
from ...config.mesh import RosConfig
from ...config.ros_section import SimulationInterfacesConfig
from ...errors import ConfigurationError, FmuMeshError, MeshLost
from ...ros_wire.profile import Profile
from ...ros_wire.rclpy_profile import RclpyProfile, RosNode, ros_module
from ...ros_wire.topics import RosPlan
from ...wire.client.mesh_client import MeshClient
from ...wire.client.reaching import Meshes
from ...wire.client.readings import Target
from ...wire.session import undeclare_all
from ...wire.values import json_encoding
from ...wire.views import RosView
from ..bags.playing import grid_of, running_configuration
from ..gateway.gateway import Gateway
from ..gateway.mapping import descriptions_of, resolve
from ..gateway.simulation_services import SimulationServices
from .rclpy_modules import other_clocks, steady_timer, watch_clock
from .simulation_server import SimulationServer

__all__ = ["GatewayNode", "meshes_of"]

_TIMEOUT_S = 10.0
_INTERVAL_S = 0.25


def meshes_of(node: RosNode, loaded: LoadedConfig, timeout_s: float) -> Meshes:
    """The meshes that a gateway reaches, as its parameters say, and its configuration where it needs a certificate."""
    endpoints = [endpoint for endpoint in node.get_parameter("connect").value if endpoint]
    security, insecure = loaded.config.security, loaded.config.zenoh.insecure
    folder = given_folder(None) or (loaded.resolve(security.folder) if security is not None else None)
    return Meshes(endpoints, timeout_s, None if insecure else folder, insecure=insecure)


class GatewayNode:
    """The behaviour of a lifecycle node that is the gateway of a running mesh.

    Attributes:
        failure: always None; the end of a mesh is not a failure of its gateway.
    """

    failure: FmuMeshError | None = None

    def __init__(self, node: RosNode) -> None:
        self._node = node
        self._log = node.get_logger()
        self._configured = ExitStack()
        self._client: MeshClient | None = None
        self._plan: RosPlan | None = None
        self._interfaces: SimulationInterfacesConfig | None = None
        self._targets: dict[str, Target] = {}
        self._run = ""
        self._view: RosView | None = None
        self._active = ExitStack()

    def configure(self) -> None:
        """Find the mesh, resolve its topics, and declare its parameters.

        Raises:
            FmuMeshError: something is wrong; everything that was done is undone.
        """
        loaded = running_configuration(Path(self._node.get_parameter("config").value))
        section = loaded.config.ros or RosConfig()
        if (namespace := self._node.get_namespace()) != "/":  # such as that of `__ns`
            section = replace(section, namespace=namespace)
        loaded = replace(loaded, config=replace(loaded.config, ros=section))
        with ExitStack() as stack:
            client = stack.enter_context(meshes_of(self._node, loaded, _TIMEOUT_S)).named(loaded.config.mesh)
            client.check_may("a gateway to ROS", needs="node")
            info = client.info()
            infos = {name: client.instance_info(name) for name in info.instances}
            findings = loaded.findings()
            plan = resolve(loaded, descriptions_of(infos), findings, loaded.findings())
            findings.raise_any()
            assert plan is not None  # there is a section, or a finding
            self._declare_parameters(client, plan, stack)
            self._client, self._plan, self._run = client, plan, info.run
            self._interfaces = loaded.config.ros.interfaces if loaded.config.ros is not None else None
            self._configured = stack.pop_all()
        self._log.info(f"gateway of mesh '{loaded.config.mesh}' with {len(plan.topics)} topics")

    def activate(self) -> None:
        """Open the topics and carry their samples.

        Raises:
            FmuMeshError: a topic cannot be opened, or the mesh has ended; everything that was done is undone.
        """
        client, plan = self._client, self._plan
        if client is None or plan is None:
            raise ConfigurationError("the gateway has no mesh yet.", hint="Configure it first.")
        info = client.info_if_running()
        if info is None or info.run != self._run:
            raise MeshLost(
                f"the run of mesh '{client.keys.mesh}' for which this node was configured has ended",
                hint="Clean the node up, and configure it again when the mesh runs.",
            )
        with ExitStack() as stack:
            profile = RclpyProfile(self._node)
            stack.callback(profile.close)
            names = {topic.profile for topic in plan.topics} or {"ros2dds"}
            profiles: dict[str, Profile] = dict.fromkeys(map(str, sorted(names)), profile)
            # A session of its own: answers to the other one would queue behind the samples of a mesh that is fast.
            loaded = running_configuration(Path(self._node.get_parameter("config").value))
            own = stack.enter_context(meshes_of(self._node, loaded, _TIMEOUT_S)).named(client.keys.mesh)
            gateway = Gateway(plan, own.session, client.keys, grid_of(info))
            stack.callback(gateway.close)
            gateway.open(profiles, _TIMEOUT_S)
            if self._interfaces is not None:
                mesh = client.session, client.keys, gateway.settle
                services = SimulationServices(self._interfaces, plan.types, *mesh, action=True)
                server = SimulationServer(self._node, services, plan.namespace)
                stack.callback(server.close)
                server.open()
            thread = threading.Thread(target=gateway.run, name="gateway", daemon=True)
            thread.start()
            stack.callback(thread.join, _TIMEOUT_S)
            stack.callback(gateway.end)
            clock = plan.clock_points is not None
            self._view = self._seen(profile, clock=clock)
            key = f"{client.keys.mesh_key('ros')}/{client.session.zid()}"
            answers = client.session.declare_queryable(key, lambda query: self._answer(key, query, gateway))
            stack.callback(undeclare_all, [answers])
            timer = steady_timer(self._node, _INTERVAL_S, lambda: self._look(thread, profile, clock=clock))
            stack.callback(self._node.destroy_timer, timer)
            if clock:
                stack.callback(watch_clock(self._node, "`clock_rate: null` in the section `ros`"))
            self._active = stack.pop_all()

    def deactivate(self) -> None:
        """Close the topics; samples that have arrived from the mesh are published before."""
        self._active.close()

    def cleanup(self) -> None:
        """Disconnect from the mesh and undeclare its parameters. Never raises."""
        self.deactivate()
        self._configured.close()
        self._client, self._plan, self._targets = None, None, {}

    def close(self) -> bool:
        """Clean up; returns True, because nothing is left running."""
        self.cleanup()
        return True

    def _declare_parameters(self, client: MeshClient, plan: RosPlan, stack: ExitStack) -> None:
        """Declare the parameters of the mesh as parameters of the node, with their current values."""
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
            # Not read-only: ROS cannot undeclare those, and the next run has others. The mesh refuses fixed ones.
            self._node.declare_parameter(
                name, values.get(target.key), descriptor(description=about, dynamic_typing=True)
            )
            stack.callback(self._node.undeclare_parameter, name)
        self._node.add_on_set_parameters_callback(self._set_parameters)
        stack.callback(self._node.remove_on_set_parameters_callback, self._set_parameters)

    def _set_parameters(self, parameters: Sequence[Any]) -> Any:  # noqa: ANN401 types of rclpy
        """Set tunable parameters of the mesh; if the mesh refuses a value, answer with its reason."""
        result = ros_module("rcl_interfaces.msg").SetParametersResult
        for parameter in parameters:
            target = self._targets.get(parameter.name)
            if target is None or self._client is None:
                continue
            try:
                self._client.set(target, parameter.value)
            except FmuMeshError as error:
                return result(successful=False, reason=str(error))
        return result(successful=True)

    def _look(self, carrying: threading.Thread, profile: RclpyProfile, *, clock: bool) -> None:
        self._view = self._seen(profile, clock=clock)
        if not carrying.is_alive():
            self._log.info("the mesh has ended")
            self._node.trigger_deactivate()

    def _seen(self, profile: RclpyProfile, *, clock: bool) -> RosView:
        who = f"the node '{self._node.get_fully_qualified_name()}' is the gateway"
        clocks = other_clocks(self._node) if clock else ()
        return RosView("rclpy", (), connected=True, activity=who, other_clocks=clocks, topics=profile.topics())

    def _answer(self, key: str, query: zenoh.Query, gateway: Gateway) -> None:
        """On a thread of Zenoh: what `fmu-mesh status` says of this gateway."""
        missed = {own.topic: own.missed for own in gateway.deadlines if own.missed}
        assert self._view is not None  # there is one before the first query
        view = replace(self._view, ignored=dict(gateway.ignored), missed=missed)
        query.reply(key, msgspec.json.encode(view), encoding=json_encoding)
        query.drop()
