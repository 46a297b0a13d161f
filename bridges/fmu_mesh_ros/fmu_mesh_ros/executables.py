"""The executables of the package: each becomes a program of fmu_mesh, in the Python that it was started with."""

import os
import sys
from importlib.util import find_spec
from typing import NoReturn

__all__ = ["gateway", "mesh", "node", "wait"]


def node() -> NoReturn:
    """One FMU as a ROS node, or the gateway of a mesh: the parameters say which."""
    _become("fmu_mesh.ros.node", *sys.argv[1:])


def mesh() -> NoReturn:
    """`fmu-mesh launch`, with its arguments."""
    _become("fmu_mesh", "launch", *sys.argv[1:])


def gateway() -> NoReturn:
    """The ROS node that is the gateway of the mesh in a file: it waits for that mesh and activates itself."""
    config, *arguments = _configuration_and_more("gateway CONFIG [--ros-args ...]")
    # Of two values of a parameter the last holds, of two names of a node the first.
    own = ("--ros-args", "-p", f"config:={config}", "-p", "autostart:=true", "--")
    _become("fmu_mesh.ros.node", *own, *arguments, "--ros-args", "-r", "__node:=fmu_mesh_gateway")


def wait() -> NoReturn:
    """`fmu-mesh wait`, with its options, for the mesh in a file."""
    config, *arguments = _configuration_and_more("wait CONFIG [--timeout S] [--state STATE]")
    _find_fmu_mesh()
    import fmu_mesh  # noqa: PLC0415 it may be missing

    try:
        name = fmu_mesh.load(config).name
    except fmu_mesh.FmuMeshError as error:
        print(f"fmu_mesh_ros: {error}", file=sys.stderr)
        sys.exit(error.exit_code)
    _become("fmu_mesh", "wait", name, *arguments)


def _configuration_and_more(usage: str) -> list[str]:
    if len(sys.argv) < 2 or sys.argv[1].startswith("-"):
        print(f"usage: ros2 run fmu_mesh_ros {usage}", file=sys.stderr)
        sys.exit(2)
    return sys.argv[1:]


def _find_fmu_mesh() -> None:
    if find_spec("fmu_mesh") is None:
        print(
            f"fmu_mesh_ros: {sys.executable} has no fmu_mesh. Activate the environment that has it, or install it for "
            "this Python; docs/ros-package.md says how.",
            file=sys.stderr,
        )
        sys.exit(2)


def _become(module: str, *arguments: str) -> NoReturn:
    _find_fmu_mesh()
    os.execv(sys.executable, [sys.executable, "-Pm", module, *arguments])
