"""The functions with which a program begins: `load`, `attach`, `meshes` and `inspect`."""

from __future__ import annotations

from pathlib import Path

import msgspec

from ..config.instance_sections import KIND
from ..errors import CallRefused
from ..instances.registry import KINDS, describe
from ..text import listed
from ..variables.model_description import ModelDescription
from ..wire.client.mesh_client import MeshClient
from ..wire.client.reaching import Meshes
from ..wire.views import MeshStatus
from .mesh_builder import Mesh
from .run_handle import TIMEOUT_S, Run

__all__ = ["attach", "inspect", "load", "meshes"]


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


def inspect(path: str | Path, *, kind: str | None = None) -> ModelDescription:
    """Read what a model declares: its variables, capabilities and default experiment. Nothing of it is run.

    Example:
        >>> import fmu_mesh
        >>> pendulum = fmu_mesh.inspect("fmus/DampedPendulum.fmu")
        >>> pendulum.fmi_version, pendulum.default_experiment.step_size
        ('2.0', 0.002)
        >>> [variable.name for variable in pendulum.with_causality("output")]
        ['a', 'der(a)', 'der(a,2)']
        >>> pendulum.variable("l").unit
        'm'

    Args:
        path: the file of the model.
        kind: the kind of instance, as its key in a configuration; default: the kind with the ending of the file,
            otherwise an FMU.

    Raises:
        LoadFailed: it is no such model; says why.
        CallRefused: no installed package offers this kind.
    """
    names = KINDS.names()
    chosen = kind if kind is not None else Path(path).suffix.removeprefix(".")
    if kind is not None and kind not in names:
        raise CallRefused(f"no installed package offers the kind of instance '{kind}'; there are {listed(names)}")
    key = chosen if chosen in names else names[0]
    section = msgspec.convert({KIND: key, key: str(path)}, KINDS.section(key))
    return describe(Path(path).absolute(), section)
