"""The role of a process that is the gateway to ROS."""

from __future__ import annotations

from collections.abc import Callable

from msgspec.structs import replace

from ..errors import ConfigurationError, Interrupted
from ..ros.gateway.gateway import Gateway
from ..ros.gateway.link import RosLink, open_profiles, open_ros
from ..ros.gateway.mapping import resolve
from ..ros_wire.topics import RosPlan
from ..system.plan import MASTER
from ..wire.keys import Keys
from ..wire.runtime import socket_endpoint
from ..wire.session import Wiring, close_session, open_session
from .events import Event, Reachable
from .process import RunProcess
from .run_plan import RunPlan
from .wiring import certified, name_of

__all__ = ["run_gateway"]


def run_gateway(run: RunPlan, emit: Callable[[Event], None]) -> None:
    """Be the gateway of a mesh, from before its first point until it ends.

    Args:
        run: the plan of the run.
        emit: called once, when everything is declared and no sample can be missed any more.

    Raises:
        FmuMeshError: the gateway could not start, or was interrupted.
    """
    config, file = run.loaded.config, run.loaded.file
    section, patience_s = config.ros, config.timeouts.start
    if section is None:
        raise ConfigurationError(f"{file}: there is no section `ros`", hint="It says which topics there are.")
    if section.profile == "rclpy":
        raise ConfigurationError(
            f"{file}: with the profile rclpy a ROS node is the gateway",
            hint=f"Start it: python -m fmu_mesh.ros.node --ros-args -p config:={file}",
        )
    ros_plan = _ros_plan(run)
    with RunProcess(config.mesh, run.run) as process:
        stack = process.stack
        at, lease_s = _master_at(run, process), config.timeouts.link
        keys, insecure = Keys(config.zenoh.key_prefix, config.mesh), config.zenoh.insecure
        client = Wiring("client", connect=at, patience_s=patience_s, lease_s=lease_s, insecure=insecure)
        client = certified(client, config.security, keys.root)
        keys = replace(keys, by=name_of(client, config.security))
        # Two, because answers would queue behind the samples of a fast mesh.
        mesh, asking = open_session(client), open_session(client)
        stack.callback(close_session, mesh)
        stack.callback(close_session, asking)
        as_peer, ros = open_ros(section, process.folder)
        stack.callback(close_session, ros)
        gateway = Gateway(ros_plan, mesh, keys, run.plan.grid)
        profiles = stack.enter_context(open_profiles(section, ros, ros_plan, asking, keys, gateway.settle))
        link = RosLink(section, ros, asking, keys, profiles, clock=ros_plan.clock_points is not None, as_peer=as_peer)
        stack.callback(link.close)
        link.open(gateway.ignored, gateway.deadlines)
        stack.callback(gateway.close)
        process.interruption.goes_to(lambda _reason: gateway.end())
        gateway.open(profiles, patience_s)
        emit(Reachable((*section.connect, *section.listen)))
        if process.interruption.reason is None:
            gateway.run()
        if process.interruption.reason is not None:
            raise Interrupted(process.interruption.reason)


def _ros_plan(run: RunPlan) -> RosPlan:
    """The topics of a configuration that was checked before."""
    findings = run.loaded.findings()
    descriptions = {name: own.description for name, own in run.plan.system.instances.items()}
    ros_plan = resolve(run.loaded, descriptions, findings, run.loaded.findings())
    findings.raise_any()
    assert ros_plan is not None
    return ros_plan


def _master_at(run: RunPlan, process: RunProcess) -> tuple[str, ...]:
    """Where the master can be reached: `--connect`, or the router that all processes use, or its socket."""
    section = run.zenoh(run.loaded.config.zenoh.listen)
    connect = run.connect or (tuple(section.connect) if section.mode == "client" else ())
    if process.is_child or not connect:
        return (socket_endpoint(process.folder, MASTER),)
    return connect
