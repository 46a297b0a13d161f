"""Which meshes a tool can reach, and which of them a key means.

Owns the way from the notes in the runtime folder, or from endpoints, to a `MeshClient` for each running mesh. Tools
open sessions in client mode: the master, which is their way in, passes everything on to the nodes.
"""

from __future__ import annotations

import threading
from collections.abc import Sequence
from contextlib import ExitStack
from types import TracebackType
from typing import Self

import zenoh

from ..errors import ConfigurationError, DeadlineExceeded, FmuMeshError
from ..model.findings import listed, nearest
from .client import MeshClient, key_expression
from .keys import Keys
from .runtime import MeshNote, meshes
from .session import Wiring, open_session

__all__ = ["Meshes"]


class Meshes:
    """The meshes that can be reached, as long as the `with` block lasts.

    Args:
        endpoints: Zenoh endpoints to connect to; without any, the notes of this user's meshes on this host tell.
        timeout_s: the deadline of every wait in s.

    Attributes:
        clients: one client per mesh, in the order of their names.
    """

    def __init__(self, endpoints: Sequence[str], timeout_s: float) -> None:
        self.clients: list[MeshClient] = []
        self._endpoints = tuple(endpoints)
        self._timeout_s = timeout_s
        self._stack = ExitStack()

    def __enter__(self) -> Self:
        """Connect.

        Raises:
            DeadlineExceeded: an endpoint does not answer.
        """
        with ExitStack() as stack:
            if self._endpoints:
                self._connect(stack)
            else:
                for note in meshes():
                    self._open_note(stack, note)
            self._stack = stack.pop_all()
        self.clients.sort(key=lambda client: client.keys.mesh)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stack.close()

    def all(self) -> list[MeshClient]:
        """All meshes, at least one.

        Raises:
            ConfigurationError: there is none.
        """
        if self.clients:
            return self.clients
        if self._endpoints:
            raise ConfigurationError(f"no mesh can be reached at {', '.join(self._endpoints)}.")
        raise ConfigurationError(
            "no mesh is running here.", hint="Start one with `fmu-mesh launch CONFIG`, or reach another with --connect."
        )

    def one(self, reference: str | None) -> MeshClient:
        """The mesh that a reference (a key, a name, or nothing) means.

        Raises:
            ConfigurationError: there is none, or more than one.
        """
        clients = self.all()
        names = [client.keys.mesh for client in clients]
        if reference is not None:
            named = [client for client in clients if _means(client, reference)]
            if len(named) == 1:
                return named[0]
            if not named and any(client.is_key(reference) for client in clients):
                raise _not_running(reference, clients)
        if len(clients) == 1:
            return clients[0]
        if len({client.keys.root for client in clients}) < len(clients):
            raise _same_name(clients, listed(names))
        raise ConfigurationError(
            f"{len(clients)} meshes are running: {listed(names)}.",
            hint=f"Say which one by a full key, such as '{clients[0].keys.root}/INSTANCE/out/VARIABLE'.",
        )

    def named(self, mesh: str) -> MeshClient:
        """The mesh with this name, or with this key.

        Raises:
            ConfigurationError: there is none, or more than one.
        """
        found = [client for client in self.all() if mesh in (client.keys.mesh, client.keys.root)]
        if len(found) == 1:
            return found[0]
        if found:
            roots = listed([client.keys.root for client in found])
            if len({client.keys.root for client in found}) < len(found):
                raise _same_name(found, roots)
            raise ConfigurationError(f"{len(found)} meshes are named '{mesh}': {roots}.", hint="Give the key.")
        raise _not_running(mesh, self.clients)

    def _connect(self, stack: ExitStack) -> None:
        """Every mesh whose master shows at the endpoints."""
        session = _open(stack, self._endpoints, self._timeout_s)
        for reply in session.liveliness().get("**/mesh", timeout=self._timeout_s):
            if reply.ok is not None:
                prefix, mesh, _ = str(reply.ok.key_expr).rsplit("/", 2)
                self.clients.append(MeshClient(session, Keys(prefix, mesh), self._endpoints, self._timeout_s))

    def _open_note(self, stack: ExitStack, note: MeshNote) -> None:
        session = _open(stack, note.endpoints, self._timeout_s)
        keys = Keys(note.key_prefix, note.mesh)
        self.clients.append(MeshClient(session, keys, note.endpoints, self._timeout_s))


def _open(stack: ExitStack, endpoints: Sequence[str], timeout_s: float) -> zenoh.Session:
    """A session in client mode.

    Opened on a thread: `open_session` is patient with endpoints that start late, a person at a terminal is not.
    """
    sessions: list[zenoh.Session] = []
    errors: list[FmuMeshError] = []

    def open_it() -> None:
        try:
            sessions.append(open_session(Wiring(mode="client", connect=tuple(endpoints))))
        except FmuMeshError as error:
            errors.append(error)

    thread = threading.Thread(target=open_it, name="open", daemon=True)
    thread.start()
    thread.join(timeout_s)
    if errors:
        raise errors[0]
    if not sessions:
        raise DeadlineExceeded(
            f"nobody answered at {', '.join(endpoints)} within {timeout_s:g} s.",
            hint="`launch` and `ls` show where a mesh can be reached, on the host where it runs.",
        )
    stack.callback(sessions[0].close)
    return sessions[0]


def _means(client: MeshClient, reference: str) -> bool:
    """Whether a reference says that it is about this mesh."""
    if reference in (client.keys.mesh, client.keys.root):
        return True
    return client.is_key(reference) and key_expression(reference).intersects(zenoh.KeyExpr(f"{client.keys.root}/**"))


def _same_name(clients: Sequence[MeshClient], names: str) -> ConfigurationError:
    """Meshes that no name and no key tells apart, such as one that was launched twice."""
    where = ", ".join(endpoint for client in clients for endpoint in client.endpoints[:1])
    return ConfigurationError(
        f"{len(clients)} meshes are running: {names}.", hint=f"Say which one by --connect and its endpoint: {where}."
    )


def _not_running(reference: str, clients: Sequence[MeshClient]) -> ConfigurationError:
    names = [name for client in clients for name in (client.keys.mesh, client.keys.root)]
    suggestion = nearest(reference, names)
    running = listed([client.keys.mesh for client in clients])
    hint = f"Did you mean '{suggestion}'?" if suggestion is not None else f"Running: {running}."
    return ConfigurationError(f"no mesh '{reference}' is running.", hint=hint)
