"""Which meshes a tool can reach, and which of them a key means.

Makes a `MeshClient` for each running mesh, from the notes in the runtime folder or from endpoints. Tools open sessions
in client mode: they connect to the master, which routes their messages to and from the nodes.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future
from contextlib import ExitStack, suppress
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple, Self, TypeVar, cast, get_args

import zenoh
from msgspec.structs import replace

from ...config.access_sections import Role, given_folder, has_tls, is_socket
from ...errors import ConfigurationError, DeadlineExceeded, FmuMeshError
from ...text import did_you_mean, listed
from ..keys import LOCAL, Keys
from ..messages import decode_json
from ..runtime import MeshNote, meshes
from ..session import Wiring, close_session, open_session, tokens
from ..views import MeshHello
from .mesh_client import MeshClient, is_key, key_expression

if TYPE_CHECKING:  # as above
    from ..security.identity import Identity

__all__ = ["Meshes"]

log = logging.getLogger(__name__)

# Threads: a session is opened on a thread of its own (`_Opening`), so that one mesh that does not answer does not
# hold the others, and no wait is longer than its deadline; the thread is a daemon, because what it waits for cannot
# be cancelled. All else is on the caller's thread. Notes are files that other processes write and remove at any time,
# so each look reads them anew, and a note is no proof: its mesh may be killed, or be stopped (ADR 4 says who can
# reach which socket).

Asked = TypeVar("Asked")
Answer = TypeVar("Answer")

_GRACE_S = 1.0
# A new note in the runtime folder makes no event, and a look at the folder costs less than a millisecond.
_NOTE_CHECK_S = 0.05
_AGAIN_S = 1.0
_TOKENS = "**/mesh"
_HELLO = f"{_TOKENS}/hello"
_NOBODY = "nobody answered"
_HELLO_S = 1.0
"""How long in s a mesh may need to say which role a certificate has."""


class Meshes:
    """The meshes that can be reached, as long as the `with` block lasts.

    If there are notes of several meshes, only the requested one is opened: a mesh that does not answer must not prevent
    access to another one.

    Args:
        connect: Zenoh endpoints to connect to; if empty, the notes of this user's meshes on this host are used.
        timeout: deadline of every question, in s.
        security: the folder of a certificate, for endpoints with TLS; None: that of this host, or of a note.
        insecure: whether endpoints at a network may have no TLS.

    Attributes:
        silent: for meshes with a note that are not in `all`, the reason.

    Raises:
        ConfigurationError: (every method) there is no such mesh, or there are several.
        DeadlineExceeded: (every method) the mesh, or an endpoint, does not answer.
    """

    def __init__(
        self, connect: Sequence[str], timeout: float, security: str | Path | None = None, *, insecure: bool = False
    ) -> None:
        if insecure and security is not None:
            raise ConfigurationError("`security=...` and `insecure=True` exclude each other", hint="Leave one out.")
        self.silent: list[FmuMeshError] = []
        self._endpoints = tuple(connect)
        self._timeout_s = timeout
        self._security, self._insecure = security, insecure
        self._found: list[_Found] = []
        self._openings: dict[tuple[str, ...], _Opening] = {}

    def __enter__(self) -> Self:
        """Connect, as `look` does."""
        try:
            self.look()
        except BaseException:
            self._close()
            raise
        return self

    def __exit__(self, *_error: object) -> None:
        self._close()

    def look(self) -> None:
        """Find the meshes that run now."""
        self._found = [*(self._shown() if self._endpoints else self._noted())]
        self._found.sort(key=lambda found: found.keys.mesh)

    @property
    def roots(self) -> list[str]:
        """The keys of the meshes that were found by the last look, whether they answer or not."""
        return [found.keys.root for found in self._found]

    def appearance(self, mesh: str | None, timeout_s: float) -> MeshClient:
        """Wait until a mesh is there: the one with this name or key, or the only one."""
        end, changed = time.monotonic() + timeout_s, threading.Event()
        with ExitStack() as stack:
            if self._endpoints:
                liveliness = self._open(self._endpoints, _NOBODY).session().liveliness()
                watcher = liveliness.declare_subscriber(_TOKENS, lambda _token: changed.set(), history=True)
                stack.callback(watcher.undeclare)
            while (left_s := end - time.monotonic()) > 0:
                self.look()
                if any(mesh is None or mesh in found.names for found in self._found):
                    return self.named(mesh)
                # There is no event for a new note. There is one for a token, but a query for it may still be empty.
                changed.wait(min(left_s, _AGAIN_S if self._endpoints else _NOTE_CHECK_S))
                changed.clear()
        who = f"mesh '{mesh}'" if mesh is not None else "mesh"
        raise DeadlineExceeded(f"there is no {who} after {timeout_s:g} s.", hint="A larger `timeout=...` waits longer.")

    def all(self) -> list[MeshClient]:
        """All meshes that answer, at least one."""
        self.silent = []
        running = self._running()
        for found in running:
            found.opening.start()
        return [client for _, client in self.answers(running, self._client)]

    def answers(self, asked: Sequence[Asked], question: Callable[[Asked], Answer]) -> list[tuple[Asked, Answer]]:
        """The answers of the meshes that answer, at least one; the others are added to `silent`."""
        answers: list[tuple[Asked, Answer]] = []
        for one in asked:
            try:
                answers.append((one, question(one)))
            except FmuMeshError as error:
                self.silent.append(error)
        if not answers:
            raise self.silent[-len(asked)]
        return answers

    def one(self, reference: str | None) -> MeshClient:
        """The mesh that a reference (a key, a name, or nothing) means."""
        running = self._running()
        if reference is not None:
            named = [found for found in running if _means(found.keys, reference)]
            if len(named) == 1:
                return self._client(named[0])
            if not named and any(is_key(reference, found.keys) for found in running):
                raise _not_running(reference, running)
        if len(running) == 1:
            return self._client(running[0])
        raise _several(running, f"Say which one, as in '{running[0].keys.mesh}/INSTANCE.VARIABLE'.")

    def named(self, mesh: str | None) -> MeshClient:
        """The mesh with this name, or with this key; None for the only one."""
        running = self._running()
        named = [found for found in running if mesh is None or mesh in found.names]
        if len(named) == 1:
            return self._client(named[0])
        if mesh is None:
            raise _several(named, "Give the name of one.")
        raise _several(named, "Give the key.", mesh) if named else _not_running(mesh, running)

    def _running(self) -> list[_Found]:
        """The meshes that were found, at least one, or `absence` as an error."""
        if (absence := self.absence) is not None:
            raise absence
        return self._found

    @property
    def absence(self) -> ConfigurationError | None:
        """The error if no mesh was found; None if one was."""
        if self._found:
            return None
        if self._endpoints:
            return ConfigurationError(f"no mesh can be reached at {', '.join(self._endpoints)}.")
        return ConfigurationError(
            "no mesh is running here.",
            hint="Start one with `fmu-mesh launch CONFIG`, or reach another with `connect=...`.",
        )

    def _noted(self) -> Iterator[_Found]:
        """Every mesh of this user on this host."""
        for note in meshes():
            ends = tuple(filter(is_socket, note.endpoints)) or note.endpoints
            nobody = f"mesh '{note.mesh}' did not answer"
            opening = self._open(ends, nobody, note.security or None, insecure=note.insecure)
            yield _Found(Keys(note.key_prefix, note.mesh, _by(note)), note.endpoints, opening)

    def _shown(self) -> Iterator[_Found]:
        """Every mesh whose master can be reached at the endpoints."""
        opening = self._open(self._endpoints, _NOBODY)
        by = next((_by(note) for note in meshes() if {*note.endpoints} & {*self._endpoints}), None)
        session, own = opening.session(), opening.identity
        found = tokens(session, _TOKENS, self._timeout_s)
        if not found and own is not None and (hello := _greeted(session, _HELLO, _HELLO_S)) is not None:
            *prefix, mesh, _, _ = hello[0].split("/")
            _role(session, Keys("/".join(prefix), mesh), own, self._timeout_s)  # or only the tokens were late
        for key in found:
            *prefix, mesh, _ = key.split("/")
            if prefix:  # otherwise it is not a token of a mesh
                yield _Found(Keys("/".join(prefix), mesh, by), self._endpoints, opening)

    def _open(
        self, endpoints: tuple[str, ...], else_: str, security: str | None = None, *, insecure: bool = False
    ) -> _Opening:
        """The session with these endpoints; later calls return the same one."""
        opening = self._openings.get(endpoints)
        if opening is None:
            wiring = Wiring(
                mode="client",
                connect=endpoints,
                patience_s=self._timeout_s,
                waits=False,
                insecure=self._insecure or insecure,
            )
            opening = _Opening(wiring, else_, self._security or security)
            self._openings[endpoints] = opening
        return opening

    def _client(self, found: _Found) -> MeshClient:
        session = found.opening.session()
        own, reached = found.opening.identity, (found.endpoints, self._timeout_s)
        if own is None:
            keys = found.keys
            # It was reached by a socket that no note of this user names, such as one for a group.
            if keys.by is None and self._endpoints and _greeted(session, keys.mesh_key("hello"), _HELLO_S) is not None:
                keys = replace(keys, by=LOCAL)
            return MeshClient(session, keys, *reached)
        role = _role(session, found.keys, own, self._timeout_s)
        return MeshClient(session, replace(found.keys, by=own.name), *reached, role=role)

    def _close(self) -> None:
        for opening in self._openings.values():
            opening.close()


class _Opening:
    """A session in client mode that is opened when it is needed; ``else_`` is the message if it is not open in time."""

    # It is opened on its own thread, so several can be opened at the same time. `session` waits for that thread shortly
    # beyond the deadline, because a process that ends while the thread is inside Zenoh may abort.

    def __init__(self, wiring: Wiring, else_: str, security: str | Path | None) -> None:
        self.identity: Identity | None = None
        self._wiring = wiring
        self._else = else_
        self._security = security
        self._timeout_s = wiring.patience_s
        self._end = 0.0
        self._opened: Future[zenoh.Session] | None = None

    def start(self) -> Future[zenoh.Session]:
        """Begin to open the session, unless that has begun already."""
        if self._opened is None:
            self._opened = Future()
            self._end = time.monotonic() + self._timeout_s
            threading.Thread(target=self._run, args=[self._opened], name="open", daemon=True).start()
        return self._opened

    def session(self) -> zenoh.Session:
        """Wait until the session is open; an error if it cannot be opened, or not in time."""
        opened = self.start()
        try:
            return opened.result(max(0.0, self._end + _GRACE_S - time.monotonic()))
        except TimeoutError:
            raise self._silence() from None

    def close(self) -> None:
        """Close the session if it is open."""
        if self._opened is not None:
            with suppress(FmuMeshError):
                close_session(self.session())

    def _run(self, opened: Future[zenoh.Session]) -> None:
        try:
            ends = self._wiring.connect
            if any(map(has_tls, ends)) or (self._security is not None and not all(map(is_socket, ends))):
                self.identity = self._identity()
            opened.set_result(open_session(replace(self._wiring, identity=self.identity)))
        except FmuMeshError as error:
            opened.set_exception(error if time.monotonic() < self._end else self._silence())

    def _identity(self) -> Identity | None:
        """The certificate with which this process comes."""
        from ..security.certificates import identity_in  # noqa: PLC0415  most meshes need no certificate
        from ..security.identity import warnings_about  # noqa: PLC0415  as above

        folder = given_folder(self._security)
        if folder is None or self._wiring.insecure:
            return None
        own = identity_in(folder)
        for text in warnings_about(own):
            _tell(text)
        return own

    def _silence(self) -> DeadlineExceeded:
        where = ", ".join(self._wiring.connect)
        return DeadlineExceeded(
            f"{self._else} at {where} within {self._timeout_s:g} s.",
            hint="`launch` and `ls` show where a mesh can be reached, on the host where it runs.",
        )


@cache
def _tell(text: str) -> None:
    """Once in a process, which may look for meshes again and again."""
    log.warning("%s", text)


class _Found(NamedTuple):
    """A mesh, and how to reach it."""

    keys: Keys
    endpoints: tuple[str, ...]
    opening: _Opening

    @property
    def names(self) -> tuple[str, str]:
        """What the mesh may be called: its name and its key."""
        return self.keys.mesh, self.keys.root


def _by(note: MeshNote) -> str | None:
    """In whose name a tool comes to the socket of a mesh; None: it needs none."""
    return LOCAL if note.security else None


def _greeted(session: zenoh.Session, key: str, timeout_s: float) -> tuple[str, MeshHello] | None:
    """What a master answers to a certificate at once, and under which key; None if it does not, or may not."""
    for reply in session.get(key, timeout=timeout_s):
        if reply.ok is not None:
            return str(reply.ok.key_expr), decode_json(reply.ok.payload.to_bytes(), MeshHello)
    return None


def _role(session: zenoh.Session, keys: Keys, own: Identity, timeout_s: float) -> Role:
    """The role that a mesh knows of a certificate, which may have another one in it.

    Raises:
        ConfigurationError: it has none there.
        DeadlineExceeded: the mesh does not answer.
    """
    end, never = time.monotonic() + min(timeout_s, _HELLO_S), threading.Event()
    while True:
        for role in sorted(get_args(Role), key=lambda one: one != own.role):
            if _greeted(session, keys.role(role), _HELLO_S) is not None:
                return cast("Role", role)
        # A query that comes before its queryable is known has no answer.
        if (left_s := end - time.monotonic()) <= 0:
            break
        never.wait(min(left_s, _NOTE_CHECK_S))
    if (hello := _greeted(session, keys.mesh_key("hello"), _HELLO_S)) is not None:
        table = f"table {hello[1].table} of roles" if hello[1].table else "its roles"
        hint = f"The mesh has {table}. Whoever has the authority can add the name; the next start of the mesh knows it."
        raise ConfigurationError(f"'{own.name}' has no role in mesh '{keys.mesh}'.", hint=hint)
    raise DeadlineExceeded(f"mesh '{keys.mesh}' does not say which role '{own.name}' has", hint="Has it `security`?")


def _means(keys: Keys, reference: str) -> bool:
    is_within = reference.startswith(f"{keys.mesh}/") and not reference.startswith(f"{keys.prefix}/")
    if is_within or reference in (keys.mesh, keys.root):
        return True
    return is_key(reference, keys) and key_expression(reference).intersects(zenoh.KeyExpr(f"{keys.root}/**"))


def _several(found: Sequence[_Found], hint: str, name: str | None = None) -> ConfigurationError:
    """The error for more than one mesh, all of them with this name if there is one."""
    roots = [one.keys.root for one in found]
    if len({*roots}) < len(found):  # such as a mesh that was launched twice: only an endpoint distinguishes the two
        where = ", ".join(endpoint for one in found for endpoint in one.endpoints[:1])
        hint = f"Say which one by `connect=...` and its endpoint: {where}."
    elif name is not None:
        return ConfigurationError(f"{len(found)} meshes are named '{name}': {listed(roots)}.", hint=hint)
    names = listed(roots if name is not None else [one.keys.mesh for one in found])
    return ConfigurationError(f"{len(found)} meshes are running: {names}.", hint=hint)


def _not_running(reference: str, running: Sequence[_Found]) -> ConfigurationError:
    names = [name for found in running for name in found.names]
    first = reference.partition("/")[0]
    if "/" in reference and not any(reference.startswith(f"{found.keys.prefix}/") for found in running):
        names = [found.keys.mesh + reference.removeprefix(first) for found in running]
    there = f"Running: {listed([found.keys.mesh for found in running])}."
    return ConfigurationError(f"no mesh '{reference}' is running.", hint=did_you_mean(reference, names, there))
