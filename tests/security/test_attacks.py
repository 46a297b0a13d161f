"""The attacks of `tests/strangers.py` on a mesh behind TLS, direct and through a router: no effect beyond the role.

The values of the mesh go by Zenoh, where strangers could meet them. A witness hears all that arrives.
"""

from __future__ import annotations

import json
import os
import socket
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Final, Literal, NamedTuple

import pytest
import zenoh

from fmu_mesh.config.access_sections import host_of, port_of
from fmu_mesh.wire.security.identity import CA, CA_KEY, Role
from tests.faults.test_doors import ports
from tests.helpers import DEADLINE_S, Launched, Place, wait_until
from tests.strangers import ATTACKS, Stranger, config_of, local_result
from tests.visitors import opened, secured_router

pytest.importorskip("cryptography")
from cryptography.hazmat.primitives.asymmetric.ec import EllipticCurvePrivateKey
from cryptography.hazmat.primitives.serialization import load_pem_private_key
from cryptography.x509 import load_pem_x509_certificate

from fmu_mesh.wire.security.authority import Authority
from tests.certificates import Signer, write_folder

ROLES: Final[dict[str, Role]] = {
    "lab": "node",
    "gate": "node",
    "rig": "node",
    "alice": "operator",
    "carol": "operator",
    "bob": "observer",
}
ROOT: Final = "fmu_mesh/pair"
_CONNECT_MS: Final = 500
_SILENCE_S: Final = 0.2
"""Zenoh ends a question that the rules forbid at once, and one with a payload that may have none only in time."""

_MOST_LINES: Final = 10
"""So many lines the log may have more, whatever strangers send."""

Way = Literal["direct", "router"]


class Scene(NamedTuple):
    """A mesh at rest behind TLS.

    Attributes:
        listener: who has the door, and so the log: the mesh, or the router before it.
        witness: a session of a node, which may hear everything.
        heard: what has come to it: keys and payloads.
    """

    folder: Path
    endpoint: str
    config: Path
    launched: Launched
    listener: Launched
    witness: Stranger
    heard: list[tuple[str, bytes]]

    def state(self) -> list[object]:
        """What nobody without the role may change."""
        answers = {}
        for key in ("mesh/status", "free/in/u", "free/param/k", "mesh/audit"):
            [reply] = self.witness.session.get(f"{ROOT}/{key}", timeout=DEADLINE_S)
            assert reply.ok is not None
            answers[key] = json.loads(reply.ok.payload.to_bytes())
        status = answers.pop("mesh/status")
        acted = [own for own in answers.pop("mesh/audit")["entries"] if own["what"] in {"set", "commanded"}]
        return [status["state"], status["point"], status["refused"], answers, acted]


@contextmanager
def scene(place: Place, way: Way) -> Iterator[Scene]:
    folder = place.folder / "lab"
    authority = Authority.made(folder)
    for name, role in ROLES.items():
        authority.add(name, role, 60.0)
    (mallory,) = [authority.add("mallory", "operator", 60.0).rename(folder / "kept")]
    authority.remove("mallory")
    mallory.rename(folder / "mallory")
    eve = Authority.made(place.folder / "other").add("eve", "operator", 60.0).rename(folder / "eve")
    (folder / "nobody").mkdir()
    for visitor in (eve, folder / "nobody"):  # they take the mesh for what it is
        (visitor / CA).write_bytes((folder / CA).read_bytes())

    ca = load_pem_x509_certificate((folder / CA).read_bytes())
    ca_key = load_pem_private_key((folder / CA_KEY).read_bytes(), None)
    assert isinstance(ca_key, EllipticCurvePrivateKey)
    write_folder(folder / "nameless", Signer(ca, ca_key), [])

    with ExitStack() as stack:
        door: dict[str, object] = {"listen": ["tls/127.0.0.1:0"]}
        router, endpoint = secured_router(place, folder / "gate") if way == "router" else (None, "")
        if router is not None:
            door = {"mode": "client", "connect": [endpoint]}
        config = config_of(
            place, shared_memory=False, more={"zenoh": door, "security": {"folder": str(folder / "lab")}}
        )
        launched = place.start("launch", config, "--paused", "--no-progress")
        if router is None:
            endpoint = launched.wait_for_error_line("mesh 'pair' at").rpartition(" at ")[2].strip()
        session = stack.enter_context(opened(folder / "rig", "client", **{"connect/endpoints": [endpoint]}))

        def at_rest() -> bool:
            replies = session.get(f"{ROOT}/mesh/status", timeout=DEADLINE_S)
            return any(reply.ok and b'"state":"paused"' in reply.ok.payload.to_bytes() for reply in replies)

        wait_until(at_rest, "a mesh at rest")
        heard: list[tuple[str, bytes]] = []
        for key in (f"{ROOT}/**", f"{ROOT}/@sync/**", f"{ROOT}/*/set/@by/**", f"{ROOT}/mesh/command/@by/**"):
            session.declare_subscriber(
                key, lambda sample: heard.append((str(sample.key_expr), sample.payload.to_bytes()))
            )
        yield Scene(folder, endpoint, config, launched, router or launched, Stranger(session, "pair"), heard)


def acts(stranger: Stranger, *names: str) -> None:
    """Set and command in all ways: as before there was security, and under names."""
    root = stranger.public.root
    keys = {"u": [f"{root}/free/in/u", f"{root}/free/set/u"], "k": [f"{root}/free/param/k", f"{root}/free/set/k"]}
    commands = [f"{root}/mesh/command"]
    for name in names:
        keys["u"] += [f"{root}/free/set/@by/{name}/u", f"{root}/*/set/@by/{name}/u", f"{root}/**/@by/{name}/u"]
        keys["k"] += [f"{root}/free/set/@by/{name}/k"]
        commands += [f"{root}/mesh/command/@by/{name}", f"{root}/*/command/@by/{name}"]
    for key in (*keys["u"], *keys["k"]):
        stranger.put(key, b"7.5")
        stranger.ask(key, b"7.5")
    for command in (b'{"command":"step","points":5}', b'{"command":"resume"}', b'{"command":"stop"}'):
        for key in commands:
            stranger.put(key, command)
            stranger.ask(key, command)


def answers_instead(stranger: Stranger) -> None:
    """Answer what the mesh is asked, and what its processes ask one another."""
    for key in (f"{ROOT}/**", f"{ROOT}/@sync/**", "**"):
        stranger.session.declare_queryable(key, lambda query: query.reply(query.key_expr, b"forged"), complete=True)


@pytest.mark.parametrize("way", ["direct", "router"])
@pytest.mark.parametrize(
    ("who", "mode", "names"),
    [
        ("bob", "client", ("bob", "alice", "local")),
        ("bob", "router", ("bob", "alice", "local")),
        ("alice", "peer", ("bob", "rig", "local")),
        ("mallory", "client", ("mallory", "alice", "local")),
        ("nameless", "client", ("*", "alice", "local")),
    ],
)
def test_no_attack_has_an_effect_beyond_the_role(
    place: Place, way: Way, who: str, mode: str, names: tuple[str, ...]
) -> None:
    with scene(place, way) as own, opened(own.folder / who, mode, **{"connect/endpoints": [own.endpoint]}) as session:
        wait_until(lambda: answered(session, f"{ROOT}/mesh/hello"), "a link")
        before, lines = own.state(), own.listener.errors.count("\n")
        assert before == ["paused", 0, 0, {"free/in/u": 0.0, "free/param/k": 1.0}, []]
        visitor = Stranger(session, "pair", own.witness.keys.run, _SILENCE_S)
        harmless(own, visitor, names)
        assert own.listener.errors.count("\n") - lines <= _MOST_LINES, own.listener.errors
        runs_to_its_end(place, own)


def harmless(own: Scene, visitor: Stranger, names: tuple[str, ...]) -> None:
    """Try all attacks; none is answered, none arrives, and nothing is another than before."""
    before = own.state()
    for attack in (*ATTACKS, lambda stranger: acts(stranger, *names), answers_instead):
        attack(visitor)
        assert own.state() == before, attack.__name__
        assert own.launched.running, own.launched.story()
    assert not [asked for asked in visitor.asked if asked.answered or asked.refusals]
    assert own.heard
    assert not {(key, payload) for key, payload in own.heard if payload == b"" or (key, payload) in visitor.sent}


def runs_to_its_end(place: Place, own: Scene) -> None:
    """With what was declared by visitors still there, the result is that of a single process."""
    assert "is running" in place.run("resume", "pair").output
    assert own.launched.wait() == 0, own.launched.story()
    assert "Traceback" not in own.launched.errors + own.listener.errors
    assert own.config.with_suffix(".csv").read_bytes() == local_result(place, own.config)


def answered(session: zenoh.Session, key: str) -> bool:
    return any(reply.ok is not None for reply in session.get(key, timeout=DEADLINE_S))


@pytest.mark.parametrize("way", ["direct", "router"])
def test_strangers_without_certificate_of_the_authority_reach_nothing(place: Place, way: Way) -> None:
    with scene(place, way) as own, ExitStack() as stack:
        before, lines = own.state(), own.listener.errors.count("\n")
        assert ports(place) == [own.endpoint.removeprefix("tls/")]
        plain = own.endpoint.replace("tls/", "tcp/")
        for name, endpoint in (("nobody", own.endpoint), ("eve", own.endpoint), ("nobody", plain)):
            settings = {"connect/endpoints": [endpoint], "connect/timeout_ms": _CONNECT_MS}
            with pytest.raises(zenoh.ZError):
                opened(own.folder / name, "client", **settings)
            session = stack.enter_context(opened(own.folder / name, "peer", **settings))
            harmless(own, Stranger(session, "pair", own.witness.keys.run, _SILENCE_S), ("alice", "rig", "local"))
            assert not list(session.info.links())
        for first in (b"", b"GET / HTTP/1.1\r\n\r\n", os.urandom(4096), bytes(65536), b"\x16\x03\x01\x02\x00\x01"):
            for _ in range(10):
                knock(own.endpoint, first)
        assert own.state() == before
        # Each failed handshake makes the port slow to answer others; who has a role comes in all the same.
        bob = "stop", "--connect", own.endpoint, "--security", own.folder / "bob"
        wait_until(lambda: "observer 'bob'" in place.run(*bob).errors, "an answer to bob")
        assert own.listener.errors.count("\n") - lines <= _MOST_LINES, own.listener.errors
        runs_to_its_end(place, own)


def knock(endpoint: str, first: bytes) -> None:
    """Send something that is no TLS to a port, or less than a whole handshake, and hang up."""
    with suppress(OSError), socket.create_connection((host_of(endpoint), port_of(endpoint))) as connection:
        connection.sendall(first)
