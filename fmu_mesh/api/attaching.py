"""Meshes that run already: `attach` to one of them, or list all `meshes`."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path

from ..config.call_options import checked
from ..wire.client.mesh_client import MeshClient
from ..wire.client.reaching import Meshes
from ..wire.views import MeshStatus
from .run_handle import TIMEOUT_S, Run

__all__ = ["attach", "meshes"]


@checked
def attach(  # noqa: PLR0913  how it is reached, and how long that takes
    name: str | None = None,
    *,
    connect: str | Sequence[str] = (),
    timeout: float = TIMEOUT_S,
    wait: float | None = None,
    security: str | Path | None = None,
    insecure: bool = False,
) -> Run:
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
        wait: how long to wait in s if it does not run yet; None: it runs already.
        security: folder with your certificate; None: that of FMU_MESH_SECURITY, or none.
        insecure: True: also connect to a network without TLS, where everybody can set values and end runs.

    Raises:
        ConfigurationError: no such mesh is running, or there are several.
        DeadlineExceeded: it does not answer, or has not started in time.
    """
    with ExitStack() as stack:
        found = stack.enter_context(Meshes(_endpoints(connect), timeout, security, insecure=insecure))
        client = found.named(name) if wait is None else found.appearance(name, wait)
        stack.enter_context(client.noticing())
        return Run(client.keys.mesh, attached=(client, stack.pop_all()))


@checked
def meshes(
    *,
    connect: str | Sequence[str] = (),
    timeout: float = TIMEOUT_S,
    security: str | Path | None = None,
    insecure: bool = False,
) -> list[MeshStatus]:
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
        security: as in `attach`.
        insecure: as in `attach`.

    Raises:
        DeadlineExceeded: an endpoint of ``connect`` does not answer.
    """
    with Meshes(_endpoints(connect), timeout, security, insecure=insecure) as found:
        if found.absence is not None:
            return []
        return [status for _, status in found.answers(found.all(), MeshClient.status)]


def _endpoints(connect: str | Sequence[str]) -> tuple[str, ...]:
    return (connect,) if isinstance(connect, str) else tuple(connect)
