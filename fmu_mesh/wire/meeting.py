"""How two processes meet for a row stream: each has a door, and one of the two goes to that of the other.

A door is a socket that listens, and a secret for each other process, which comes by Zenoh: with the registration, and
with `hello`. Both have to say the secret of the other's door. It keeps out strangers, not who can read the network.
"""

from __future__ import annotations

import hmac
import secrets
import socket
import struct
import threading
import time
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Final, Protocol

import msgspec

from ..config.access_sections import host_of
from ..errors import ConfigurationError
from ..rings import native
from .runtime import rows_socket
from .session import Wiring

__all__ = ["Door", "Meeting", "Returns", "address_towards", "meeting_of"]

# Who meets here: two processes, over a socket, and the threads of each. `door` accepts, and gives each connection a
# thread that has a second to hear who it is; at most `_STRANGERS` of them. A thread of Zenoh notes the doors of others
# (`knows`); the thread that joins the mesh calls `settle`, which starts a thread for each peer, as one that cannot be
# reached takes a second. All of them meet at one condition, which nobody holds while it waits for the network. ADR 74.
#
# What may go wrong:
# * Both dial at once: there would be two sockets. So the later name dials; the other one waits, and dials when nobody
#   has come for a while; who dials answers others that it is busy.
# * A stranger connects, first or often: he does not know the secret, has a second, and takes one place of eight. The
#   place of a peer is free until it has said the secret.
# * One cannot reach the other at all (a firewall, an address that is not routed): after `_PATIENCE_S` their rows go by
#   Zenoh, and that is told.
#
# Considered and given up: to send all secrets with the welcome of the master, which would be one message less, but then
# nobody could say before the start which rows go which way.

_PATIENCE_S: Final = 1.0
"""How long two processes try to meet, and how long a connection has to say who it is."""
_LOOK_S: Final = 0.25
_STRANGERS: Final = 8
_ANY: Final = ("0.0.0.0", "::")  # noqa: S104  only where the user lets Zenoh listen there, too
_NETWORKS: Final = ("tcp", "tls", "quic", "udp", "ws")
_LENGTH: Final = struct.Struct("<I")
_MOST_BYTES: Final = 1 << 20


class Door(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Where a process waits for another one, in the order of preference, and what that one has to say.

    An address is `unix:PATH` or `tcp:HOST:PORT`; with the host `*` it is where the other one already has a connection.
    """

    addresses: tuple[str, ...]
    secret: str


class _Greeting(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The first message of each side: who it is, what it was told to say, and how many rows of each link it has."""

    name: str
    secret: str
    received: dict[int, int] = {}
    busy: bool = False


class Returns(Protocol):
    """Takes what comes after a cut; from any thread."""

    def received(self, peer: str) -> dict[int, int]:
        """How many rows of each link from a peer are here."""
        ...

    def take(self, peer: str, own: socket.socket, received: Mapping[int, int]) -> None:
        """Take a new socket to a peer that has so many rows of each link."""
        ...


class Meeting:
    """The door of one process, and the sockets to those that it has met.

    Args:
        name: of this participant.
        listen: where the door is: paths of sockets, and hosts; a place where it cannot be is left out.
        connected: the hosts to which it has connected.
        folder: of the run here: ssh has the doors of other hosts there, under the names that they have on these.

    Attributes:
        sockets: by the names of the peers.
    """

    def __init__(
        self,
        name: str,
        listen: Iterable[Path | str],
        connected: Iterable[str] = (),
        folder: Path | None = None,
    ) -> None:
        self.sockets: dict[str, socket.socket] = {}
        self._returns: Returns | None = None
        self.name = name
        self._key = secrets.token_bytes()
        self._connected = tuple(connected)
        self._folder = folder
        self._doors: dict[str, Door | None] = {}
        self._dialing: set[str] = set()
        self._changed = threading.Condition()
        self._strangers = threading.BoundedSemaphore(_STRANGERS)
        self._listening: list[socket.socket] = []
        self._addresses: list[str] = []
        for place in listen:
            with suppress(OSError):
                self._listen(place)
        for own in self._listening:
            threading.Thread(target=self._accept, args=(own,), name="door", daemon=True).start()

    def _listen(self, place: Path | str) -> None:
        if isinstance(place, Path):
            own = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
            own.bind(str(place))
            address = f"unix:{place}"
        else:
            own = socket.create_server((place, 0), family=_family(place))
            address = f"tcp:{'*' if place in _ANY else place}:{own.getsockname()[1]}"
        own.listen(_STRANGERS)
        self._listening.append(own)
        self._addresses.append(address)

    def door_for(self, peer: str) -> Door:
        """What another process needs to come here."""
        return Door(tuple(self._addresses), hmac.digest(self._key, peer.encode(), "sha256").hex())

    def knows(self, peer: str, door: Door | None) -> None:
        """From any thread: where the door of a peer is; None: it has none, or needs none."""
        with self._changed:
            self._doors[peer] = door
            self._changed.notify_all()

    def settle(self, peers: Collection[str], timeout_s: float, over: Callable[[], bool] = lambda: False) -> None:
        """Meet all peers, each within a second after its door is known; afterwards `sockets` has those that were met.

        ``over`` is asked now and then; if it is true, this ends.
        """
        end = time.monotonic() + timeout_s
        waiting, meeting = set(peers), []
        while waiting:
            with self._changed:
                self._changed.wait_for(lambda: not waiting.isdisjoint(self._doors), _LOOK_S)  # noqa: B023 used here
                known = waiting.intersection(self._doors)
            if not known and (over() or time.monotonic() > end):
                break
            waiting -= known
            for peer in known:
                if self._doors[peer] is not None:
                    meeting.append(threading.Thread(target=self._meet, args=(peer,), name=f"meet {peer}", daemon=True))
                    meeting[-1].start()
        for thread in meeting:
            thread.join()

    def _meet(self, peer: str) -> None:
        """Let a peer whose name is later come first, then dial."""
        with self._changed:
            patience = _PATIENCE_S / 2 if self.name < peer else 0.0
            if self._changed.wait_for(lambda: peer in self.sockets, patience):
                return
        self.dial(peer)

    def wait_for_returns(self, returns: Returns) -> None:
        """From now on, a peer that was met may come again."""
        self._returns = returns

    def dial(self, peer: str, *, again: bool = False) -> bool:
        """Go to the door of a peer, or go there ``again`` because the connection was cut; whether it was met."""
        with self._changed:
            door = self._doors.get(peer)
            if (peer in self.sockets and not again) or door is None:
                return peer in self.sockets
            self._dialing.add(peer)
        every = [
            address.replace("tcp:*:", f"tcp:{host}:", 1)
            for address in door.addresses
            for host in (self._connected if address.startswith("tcp:*:") else ("",))
        ]
        found = next(filter(None, (self._greet(peer, address, door) for address in every)), None)
        with self._changed:
            self._dialing.discard(peer)
            if found is not None:
                self._keep(peer, *found)
            elif not again and self._changed.wait_for(lambda: peer in self.sockets, _PATIENCE_S):  # it dials late
                return True
        return found is not None

    def close(self) -> None:
        """Close the door; the sockets belong to who uses them. May be called twice."""
        doors, self._listening = self._listening, []
        for own, address in zip(doors, self._addresses, strict=False):
            with suppress(OSError):
                own.shutdown(socket.SHUT_RDWR)
            own.close()
            if address.startswith("unix:"):
                Path(address.removeprefix("unix:")).unlink(missing_ok=True)

    def _keep(self, peer: str, made: socket.socket, received: Mapping[int, int]) -> bool:
        """Keep the first socket to a peer, and hand on each later one; whether somebody takes it."""
        if peer not in self.sockets:
            self.sockets[peer] = made
            self._changed.notify_all()
            return True
        if self._returns is None:
            return False
        self._returns.take(peer, made, received)
        return True

    def _received(self, peer: str) -> dict[int, int]:
        return self._returns.received(peer) if self._returns is not None else {}

    # --- the two sides

    def _greet(self, peer: str, address: str, door: Door) -> tuple[socket.socket, Mapping[int, int]] | None:
        """Dial one address, and hear whether the peer is there."""
        made: socket.socket | None = None
        try:
            made = self._dialed(address)
            _say(made, _Greeting(self.name, door.secret, self._received(peer)))
            answer = _heard(made)
            if answer.busy or not self._is(peer, answer):
                made.close()
                return None
        except (OSError, ValueError):
            if made is not None:
                made.close()
            return None
        return made, answer.received

    def _dialed(self, address: str) -> socket.socket:
        kind, _, place = address.partition(":")
        if kind == "unix":
            here = self._folder / Path(place).name if self._folder is not None else Path(place)
            made = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
            made.settimeout(_PATIENCE_S / 2)
            try:
                made.connect(str(here) if here.exists() else place)
            except OSError:
                made.close()
                raise
            return made
        host, _, port = place.rpartition(":")
        made = socket.create_connection((host, int(port)), _PATIENCE_S / 2)
        made.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        return made

    def _accept(self, own: socket.socket) -> None:
        while True:
            try:
                made, _ = own.accept()
            except OSError:  # it is closed
                return
            if not self._strangers.acquire(blocking=False):
                made.close()
                continue
            threading.Thread(target=self._receive, args=(made,), name="stranger", daemon=True).start()

    def _receive(self, made: socket.socket) -> None:
        """Hear who has come; close the connection if nobody waits for him."""
        kept = False
        try:
            made.settimeout(_PATIENCE_S)
            with suppress(OSError):
                made.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            greeting = _heard(made)
            peer = greeting.name
            if not self._is(peer, greeting):
                return
            with self._changed:
                if not self._changed.wait_for(lambda: peer in self._doors, _PATIENCE_S / 2):
                    return
                if (door := self._doors[peer]) is None:
                    return
                busy = peer in self._dialing and self.name > peer
                _say(made, _Greeting(self.name, door.secret, self._received(peer), busy))
                if not busy:
                    kept = self._keep(peer, made, greeting.received)
        except (OSError, ValueError):
            return
        finally:
            self._strangers.release()
            if not kept:
                made.close()

    def _is(self, peer: str, greeting: _Greeting) -> bool:
        return greeting.name == peer and hmac.compare_digest(greeting.secret, self.door_for(peer).secret)


def _say(to: socket.socket, greeting: _Greeting) -> None:
    data = msgspec.json.encode(greeting)
    to.sendall(_LENGTH.pack(len(data)) + data)


def _heard(of: socket.socket) -> _Greeting:
    """A greeting, within `_PATIENCE_S`.

    Raises:
        OSError: it did not come in time, or the connection has ended.
        ValueError: it is none.
    """
    end = time.monotonic() + _PATIENCE_S

    def read(size: int) -> bytes:
        data = b""
        while len(data) < size:
            if (left := end - time.monotonic()) <= 0:
                raise TimeoutError
            of.settimeout(left)
            if not (more := of.recv(size - len(data))):
                raise ConnectionResetError
            data += more
        return data

    (size,) = _LENGTH.unpack(read(_LENGTH.size))
    if size > _MOST_BYTES:
        msg = "no greeting is so long"
        raise ValueError(msg)
    return msgspec.json.decode(read(size), type=_Greeting)


def meeting_of(name: str, folder: Path, wiring: Wiring, address: str | None = None) -> Meeting | None:
    """The meeting of a participant whose session has this wiring; None where there is no library for row streams.

    Its door is at this ``address``, if one is given, besides its Unix socket.

    Raises:
        ConfigurationError: this host does not have the address.
    """
    if native.library is None:
        return None
    connected = _hosts(wiring.connect)
    if address is not None:
        try:
            socket.create_server((address, 0), family=_family(address)).close()
        except OSError as error:
            text = f"cannot listen for row streams at '{address}': {error.strerror or error}"
            raise ConfigurationError(text, hint="`zenoh.rows_address` is an address of this host.") from error
        return Meeting(name, [rows_socket(folder, name), address], dict.fromkeys(connected), folder)
    listening = _hosts(wiring.listen)
    hosts = dict.fromkeys([*listening, *filter(None, map(address_towards, connected))])
    return Meeting(name, [rows_socket(folder, name), *hosts], dict.fromkeys(connected), folder)


def _family(host: str) -> socket.AddressFamily:
    return socket.AF_INET6 if ":" in host else socket.AF_INET


def _hosts(endpoints: Sequence[str]) -> list[str]:
    """The hosts in those of a network; a Unix socket and a serial line have none."""
    return [host_of(endpoint) for endpoint in endpoints if endpoint.partition("/")[0] in _NETWORKS]


def address_towards(host: str) -> str | None:
    """The address of this host on the way to another one; the system chooses it, and nothing is sent. None: no way."""
    with suppress(OSError):
        kind, _, _, _, place = socket.getaddrinfo(host, 1, type=socket.SOCK_DGRAM)[0]
        with socket.socket(kind, socket.SOCK_DGRAM) as own:
            own.connect(place)
            return str(own.getsockname()[0])
    return None
