"""What the process of the gateway to ROS does from its start to its end."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path

from ..config.loading import LoadedConfig
from ..errors import ConfigurationError, Interrupted
from ..instances.configuration import load
from ..ros.gateway.gateway import Gateway, open_profiles
from ..ros.gateway.link import RosLink
from ..ros.gateway.mapping import resolve
from ..ros.messages.topics import RosPlan
from ..system.plan import Plan
from ..wire.keys import MASTER, Keys
from ..wire.runtime import leave_run_folder, run_folder, socket_endpoint
from ..wire.session import Wiring, close_session, open_session
from .events import Event, Ready
from .options import Options
from .preparing import prepare
from .process import die_with_parent, ended_by_signals

__all__ = ["run_gateway"]

_BY_HAND = "hand"


def run_gateway(config_file: Path, options: Options, emit: Callable[[Event], None], *, run: str = _BY_HAND) -> None:
    """Be the gateway of a mesh, from before its first point until it ends.

    Args:
        config_file: the configuration file.
        options: what the command line changes.
        emit: called once, when everything is declared and no sample is missed any more.
        run: name of the run; the launcher's process id when it started this process.

    Raises:
        FmuMeshError: the gateway could not start, or was interrupted.
    """
    child = run != _BY_HAND
    if child:
        die_with_parent()
    plan = prepare(config_file, options)
    loaded = load(config_file)
    section = loaded.config.ros
    if section is None:
        raise ConfigurationError(f"{config_file}: there is no section `ros`", hint="It says which topics there are.")
    if section.profile == "rclpy":
        raise ConfigurationError(
            f"{config_file}: with the profile rclpy a ROS node is the gateway",
            hint=f"Start it: python -m fmu_mesh.ros.node --ros-args -p config:={config_file}",
        )
    ros_plan = _ros_plan(loaded, plan)
    folder = run_folder(loaded.config.mesh, run)
    interrupted: list[str] = []
    gateway: Gateway | None = None

    def interrupt(reason: str) -> None:
        interrupted.append(reason)
        if gateway is not None:
            gateway.end()

    with ended_by_signals(interrupt, lambda: leave_run_folder(folder), watch_stdin=child), ExitStack() as stack:
        stack.callback(leave_run_folder, folder)
        if child or not (connect := options.connect or _client_endpoints(loaded)):
            connect = (socket_endpoint(folder, MASTER),)
        mesh = open_session(Wiring(mode="client", connect=connect, patience_s=loaded.config.timeouts.start))
        stack.callback(close_session, mesh)
        # A peer that gossips, as the nodes of ROS are: a router passes nothing on between peers, it makes them meet.
        # They have ports, to which this process connects; one of its own would be open to every user of the host.
        wiring = Wiring(mode="peer", listen=tuple(section.listen), connect=tuple(section.connect), gossip=True)
        ros = open_session(wiring)
        stack.callback(close_session, ros)
        keys = Keys(loaded.config.zenoh.key_prefix, loaded.config.mesh)
        profiles = stack.enter_context(open_profiles(section, ros, ros_plan, mesh, keys))
        link = RosLink(section, ros, mesh, keys, clock=ros_plan.clock_points is not None)
        stack.callback(link.close)
        link.open()
        gateway = Gateway(ros_plan, mesh, keys, plan.grid, profiles)
        stack.callback(gateway.close)
        gateway.open(loaded.config.timeouts.start)
        emit(Ready((*section.connect, *section.listen)))
        if not interrupted:
            gateway.run()
        if interrupted:
            raise Interrupted(interrupted[0])


def _ros_plan(loaded: LoadedConfig, plan: Plan) -> RosPlan:
    """The topics of a configuration that was checked before."""
    findings = loaded.findings()
    ros_plan = resolve(loaded, {name: own.description for name, own in plan.system.instances.items()}, findings)
    findings.raise_any()
    assert ros_plan is not None
    return ros_plan


def _client_endpoints(loaded: LoadedConfig) -> tuple[str, ...]:
    """The router, where all processes of the mesh are clients of one."""
    section = loaded.config.zenoh
    return tuple(section.connect) if section.mode == "client" else ()
