"""A mesh in Foxglove for as long as the user wants: it may start later, end, and start again."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Final

import msgspec

from ..errors import DeadlineExceeded, FmuMeshError, Interrupted, from_report
from ..wire.client.mesh_client import MeshClient
from ..wire.client.reaching import Meshes
from ..wire.client.waiting import appearance
from .foxglove_server import PORT, FoxgloveServer
from .relay import is_loopback
from .shown_mesh import ShownMesh

__all__ = ["Serving", "serve"]

# While no mesh is there, one attempt a second costs nothing; whoever starts a mesh sees it a second later.
_NEXT_ATTEMPT_S: Final = 1.0


class Serving(msgspec.Struct, frozen=True):
    """What is served, and where.

    Attributes:
        mesh: name or key of the mesh; None for the only one.
        connect: Zenoh endpoints of the mesh or of a router; none: the meshes of this user on this host.
        timeout_s: deadline of every question in s.
        variables: what is offered, as names with `*`; none: all outputs.
        host: the address to listen at.
        port: 0 for a free one.
        read_only: whether clients cannot set anything.
        origins: further origins whose pages may connect.
    """

    mesh: str | None = None
    connect: tuple[str, ...] = ()
    timeout_s: float = 5.0
    variables: tuple[str, ...] = ()
    host: str = "127.0.0.1"
    port: int = PORT
    read_only: bool = True
    origins: tuple[str, ...] = ()

    @property
    def leaves_host(self) -> bool:
        """Whether other hosts can connect."""
        return not is_loopback(self.host)


def serve(serving: Serving, say: Callable[[str], None], stop: threading.Event | None = None) -> None:
    """Serve a mesh, and again when it starts again.

    Args:
        serving: what is served, and where.
        say: told in sentences what happens.
        stop: ends it when it is set, within a second if no mesh runs; None: only an exception ends it.

    Raises:
        ConfigurationError: the port cannot be used, there are several meshes, or no variable fits a pattern.
    """
    mesh, stop = serving.mesh, stop or threading.Event()
    name = f"fmu_mesh: {mesh}" if mesh is not None else "fmu_mesh"
    with FoxgloveServer(name, serving.host, serving.port, serving.origins) as server:
        say(f"Foxglove can connect to {server.url}, or open {server.link}")
        while not stop.is_set():
            mesh = _once(serving, mesh, server, say, stop)


def _once(
    serving: Serving, mesh: str | None, server: FoxgloveServer, say: Callable[[str], None], stop: threading.Event
) -> str | None:
    """Wait for the mesh and serve it until it ends; returns the mesh to wait for now."""
    which = f"mesh '{mesh.rpartition('/')[2]}'" if mesh is not None else "a mesh"
    server.tell(f"waiting for {which} to start", about="mesh")
    say(f"waiting for {which} to start")
    while not stop.is_set():
        try:
            with Meshes(serving.connect, serving.timeout_s) as meshes:
                client = appearance(meshes, mesh, _NEXT_ATTEMPT_S)
                with _unless_ended(client):
                    _show(serving, client, server, say)
                return client.keys.root
        except DeadlineExceeded:
            stop.wait(_NEXT_ATTEMPT_S)
    return mesh


def _show(serving: Serving, client: MeshClient, server: FoxgloveServer, say: Callable[[str], None]) -> None:
    """Serve a mesh that runs until it ends."""
    mesh = client.keys.mesh
    shown = ShownMesh(client, server, serving.variables, read_only=serving.read_only)
    server.withdraw("mesh", "end", "lost", "refused", "shift")
    say(f"mesh '{mesh}' is shown")
    if shown.shift_s:
        text = f"mesh '{mesh}' starts before 0 s, which Foxglove does not have: its times are {shown.shift_s:g} s later"
        server.tell(text, about="shift")
        say(text)
    last = shown.show()
    error = from_report(last.error) if last is not None and last.error is not None else None
    text = f"mesh '{mesh}' has ended" + (f": {error}" if error is not None else "")
    server.tell(text, about="end", severe=error is not None and not isinstance(error, Interrupted))
    say(text)


@contextmanager
def _unless_ended(client: MeshClient) -> Iterator[None]:
    """In the block, a question that nobody answers because the mesh has just ended is no error."""
    try:
        yield
    except FmuMeshError:
        if client.info_if_running() is not None:
            raise
