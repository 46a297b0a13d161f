"""The functions with which a program begins: `load`, `attach` and `meshes`."""

from __future__ import annotations

from pathlib import Path

from ..wire.client.mesh_client import MeshClient
from ..wire.client.reaching import Meshes
from ..wire.views import MeshStatus
from .mesh_builder import Mesh
from .run_handle import TIMEOUT_S, Run

__all__ = ["attach", "load", "meshes"]


def load(path: str | Path) -> Mesh:
    """Read a configuration file.

    Example:
        >>> import fmu_mesh
        >>> fmu_mesh.load("configs/pendulum_delay.yaml").instances
        ['pendulum', 'delay']

    Raises:
        ConfigurationError: the file cannot be read, or is no YAML. What it means is checked by `Mesh.check`, and before
            a run.
    """
    return Mesh.from_file(path)


def attach(name: str | None = None, *, connect: str | tuple[str, ...] = (), timeout: float = TIMEOUT_S) -> Run:
    """Find a running mesh that somebody else has started, such as `fmu-mesh launch` in another terminal.

    Example:
        >>> import fmu_mesh
        >>> mesh = fmu_mesh.load("configs/pendulum_delay.yaml")
        >>> with mesh.start(real_time_factor=1.0, record="memory") as started_elsewhere:
        ...     state = started_elsewhere.status.state
        ...     with fmu_mesh.attach("pendulum_delay") as run:
        ...         for sample in run.watch("delay.y"):
        ...             break
        >>> sample.name, sample.value
        ('delay.y', 1.3)

    Args:
        name: name or key of the mesh; None for the only one that runs.
        connect: Zenoh endpoints of the mesh or of a router; default: the meshes of this user on this host.
        timeout: deadline of every question in s.

    Raises:
        ConfigurationError: no such mesh is running, or there are several.
        DeadlineExceeded: it does not answer.
    """
    endpoints = (connect,) if isinstance(connect, str) else tuple(connect)
    meshes = Meshes(endpoints, timeout)
    meshes.__enter__()
    try:
        client = meshes.one(None) if name is None else meshes.named(name)
        return Run(client.keys.mesh, meshes=meshes)
    except BaseException:
        meshes.__exit__(None, None, None)
        raise


def meshes(*, connect: str | tuple[str, ...] = (), timeout: float = TIMEOUT_S) -> list[MeshStatus]:
    """The status of every mesh that runs; none where no mesh runs or answers.

    Example:
        >>> import fmu_mesh
        >>> mesh = fmu_mesh.load("configs/pendulum_delay.yaml")
        >>> with mesh.start(paused=True, record="memory") as run:
        ...     point = run.status.point
        ...     [status.mesh for status in fmu_mesh.meshes()]
        ['pendulum_delay']

    Args:
        connect: as in `attach`.
        timeout: as in `attach`.

    Raises:
        DeadlineExceeded: an endpoint of ``connect`` does not answer.
    """
    with Meshes((connect,) if isinstance(connect, str) else connect, timeout) as found:
        if found.absence is not None:
            return []
        return [status for _, status in found.answers(found.all(), MeshClient.status)]
