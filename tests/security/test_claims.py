"""Who it was: nothing arrives under another name, and the audit says who came, set and commanded.

Alice is an operator, as carol is. She claims to be carol in all ways that Zenoh and our messages have; carol is there.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from typing import Any, Final

import msgspec
import pytest
import zenoh

from fmu_mesh import Result
from fmu_mesh.wire.messages import SET, SetValue, encode_json
from fmu_mesh.wire.values import encode_origin
from fmu_mesh.wire.views import AuditEntry
from tests.helpers import DEADLINE_S, Place, wait_until
from tests.security.test_attacks import ROOT, Scene, Way, scene
from tests.visitors import DIALS, free_endpoint, opened

CAROL: Final = encode_origin(None, "carol")
STEP: Final = b'{"command":"step","points":3}'
OWN: Final = f"{ROOT}/free/set/@by/alice/u"

OTHER_KEYS: Final = (
    "free/set/@by/carol/u",
    "free/set/@by/carol",
    "free/set/@by/local/u",
    "free/set/@by/rig/u",
    "free/set/@by/CAROL/u",
    "free/set/@by/*/u",
    "free/set/@by/car$*/u",
    "free/set/@by/**/u",
    "*/set/@by/carol/*",
    "**/@by/carol/u",
    "free/set/@by/alice/@by/carol/u",
    "free/set/@by/carol/@by/alice/u",
    "free/set/u",
    "mesh/command/@by/carol",
    "mesh/command/@by/local",
    "mesh/command/@by/*",
    "mesh/command/@by/alice/@by/carol",
    "mesh/command",
)
"""Below the mesh: keys that are not alice's."""


def content_for(key: str) -> bytes:
    """What would have an effect there."""
    return STEP if "command" in key else b"5.0" if key.endswith("u") else b'{"u":5.0}'


class Claimant:
    """Alice, who claims to be carol.

    Attributes:
        hers: a session of carol, which alice knows all about.
        run: the id of the run, which she cannot see, and knows all the same.
    """

    def __init__(self, session: zenoh.Session, hers: zenoh.Session, scene_: Scene) -> None:
        self.session, self.hers, self.keys = session, hers, scene_.witness.keys

    def ask(self, key: str, payload: bytes, **more: Any) -> None:  # noqa: ANN401  arguments of Zenoh
        """Send a query, and wait for its end."""
        list(self.session.get(key, payload=payload, **{"timeout": DEADLINE_S, **more}))

    def other_keys(self) -> None:
        for key in OTHER_KEYS:
            self.session.put(f"{ROOT}/{key}", content_for(key), attachment=CAROL)
            self.ask(f"{ROOT}/{key}", content_for(key), attachment=CAROL)
            self.session.delete(f"{ROOT}/{key}")

    def declared_keys(self) -> None:
        """A link knows such a key by a number from then on."""
        for key in OTHER_KEYS:
            with self.session.declare_publisher(f"{ROOT}/{key}") as publisher:
                publisher.put(content_for(key))
            with self.session.declare_querier(f"{ROOT}/{key}") as querier:
                list(querier.get(payload=content_for(key)))
            declared = self.session.declare_keyexpr(f"{ROOT}/{key}")
            self.session.put(declared, content_for(key))

    def attachment(self) -> None:
        self.session.put(OWN, b"1.0", attachment=CAROL)
        self.ask(OWN, b"1.1", attachment=CAROL)

    def wrong_attachment(self) -> None:
        for text in (b'{"by":"carol"}', b'{"who":"carol","by":"carol"}', b"carol"):
            self.session.put(OWN, b"1.2", attachment=text)
            self.ask(OWN, b"1.3", attachment=text)

    def source(self) -> None:
        source = zenoh.SourceInfo(self.hers.declare_publisher(f"{ROOT}/free/set/@by/carol/u").id, 1)
        self.session.put(OWN, b"1.4", source_info=source)
        self.ask(OWN, b"1.5", source_info=source)

    def timestamp(self) -> None:
        self.session.put(OWN, b"1.6", timestamp=self.hers.new_timestamp())

    def parameters(self) -> None:
        self.ask(f"{OWN}?by=carol;who=carol", b"1.7")

    def content(self) -> None:
        self.ask(f"{ROOT}/free/set/@by/alice", b'{"u":1.8,"@by":"carol"}')
        self.ask(f"{ROOT}/free/set/@by/alice", b'{"@by/carol/u":1.8}')
        self.ask(f"{ROOT}/mesh/command/@by/alice", b'{"command":"resume","by":"carol"}')

    def sync(self) -> None:
        """What a node tells of a value that was set."""
        value = SetValue("free", "u", 6.0, 0, None, f"{ROOT}/free/set/@by/carol/u", "carol", "carol")
        for key in (self.keys.settings("free"), self.keys.settings("free").replace(self.keys.run, "*")):
            self.session.put(key, encode_json(SET, value))

    def audit(self) -> None:
        entry = AuditEntry("set", "carol", "2026-11-30T00:00:00.000+00:00", 0, "", "free.u")
        self.session.put(f"{ROOT}/mesh/audit", msgspec.json.encode(entry))
        self.ask(f"{ROOT}/mesh/audit", msgspec.json.encode(entry), timeout=0.2)  # nobody answers

    def answers(self) -> None:
        """Play who is set and commanded, to hear what carol sends."""
        for key in (f"{ROOT}/*/set/@by/carol/**", f"{ROOT}/mesh/command/@by/carol", f"{ROOT}/mesh/role/*"):
            self.session.declare_queryable(key, lambda query: query.reply(query.key_expr, b"taken"), complete=True)
            self.session.declare_subscriber(key, print)


CLAIMS: Final[tuple[Callable[[Claimant], None], ...]] = (
    Claimant.other_keys,
    Claimant.declared_keys,
    Claimant.attachment,
    Claimant.wrong_attachment,
    Claimant.source,
    Claimant.timestamp,
    Claimant.parameters,
    Claimant.content,
    Claimant.sync,
    Claimant.audit,
    Claimant.answers,
)


def entries(own: Scene) -> list[AuditEntry]:
    [reply] = own.witness.session.get(f"{ROOT}/mesh/audit", timeout=DEADLINE_S)
    assert reply.ok is not None
    return msgspec.json.decode(
        msgspec.json.encode(json.loads(reply.ok.payload.to_bytes())["entries"]), type=list[AuditEntry]
    )


def names_of(own: Scene, *what: str) -> set[str]:
    return {entry.who for entry in entries(own) if entry.what in what}


def pauses(session: zenoh.Session, name: str) -> bool:
    """Command what is so already; whatever the link has sent before has arrived then."""
    key, pause = f"{ROOT}/mesh/command/@by/{name}", b'{"command":"pause"}'
    return any(reply.ok is not None for reply in session.get(key, payload=pause, timeout=DEADLINE_S))


@contextmanager
def dialled(own: Scene, name: str, mode: str) -> Iterator[zenoh.Session]:
    """A session with the certificate of a name; as a relay it is behind a router that dials with it, and has none."""
    there: dict[str, object] = {"connect/endpoints": [own.endpoint]}
    with ExitStack() as stack:
        if mode == "relay":
            plain = free_endpoint("tcp")
            stack.enter_context(opened(own.folder / name, "router", **there, **{"listen/endpoints": [plain]}))
            there, mode = {"connect/endpoints": [plain]}, "client"
        yield stack.enter_context(opened(own.folder / name, mode, **there))


@pytest.mark.parametrize("way", ["direct", "router"])
@pytest.mark.parametrize("mode", [*DIALS, "relay"])
def test_no_claim_arrives_under_another_name(place: Place, way: Way, mode: str) -> None:
    with scene(place, way) as own, dialled(own, "alice", mode) as session, dialled(own, "carol", "client") as hers:
        wait_until(lambda: pauses(session, "alice"), "alice, who may command")
        claimant = Claimant(session, hers, own)
        for claim in CLAIMS:
            claim(claimant)
            assert pauses(session, "alice")
            assert names_of(own, "set", "commanded") == {"alice"}, claim.__name__
            assert own.state()[:2] == ["paused", 0], claim.__name__
        assert not [key for key, _ in own.heard if "@by/" in key and "/@by/alice" not in key]
        # A mesh hands on to its nodes what clients send, and not what other peers and routers do; a router does.
        assert names_of(own, "set") == ({"alice"} if mode == "client" or way == "router" else set())
        assert pauses(hers, "carol")
        wait_until(lambda: names_of(own, "commanded") == {"alice", "carol"}, "what carol has commanded")
        assert own.launched.running, own.launched.story()


@pytest.mark.parametrize("way", ["direct", "router"])
def test_joins_and_acts_of_names_are_in_the_audit_of_the_result(place: Place, way: Way) -> None:
    with scene(place, way) as own, dialled(own, "alice", "client") as alice, dialled(own, "bob", "client") as bob:
        wait_until(lambda: pauses(alice, "alice"), "alice, who may command")
        [reply] = alice.get(f"{ROOT}/free/set/@by/alice/u", payload=b"0.5", attachment=CAROL, timeout=DEADLINE_S)
        assert reply.ok is not None
        [seen] = bob.get(f"{ROOT}/mesh/audit", timeout=DEADLINE_S)
        assert seen.ok is not None
        wait_until(lambda: names_of(own, "set"), "what alice has set")
        told = entries(own)
        addresses = {
            str(link.src): name for name, session in (("alice", alice), ("bob", bob)) for link in session.info.links()
        }
        assert place.run("resume", "pair").wait() == 0
        assert own.launched.wait() == 0, own.launched.story()

    joined = {entry.text: entry.who for entry in told if entry.what == "joined"}
    acted = [(entry.what, entry.who, entry.key, entry.point) for entry in told if entry.what != "joined"]
    # Behind a router there is no link with those who come to it; the name in the key is what stays.
    assert set(joined.values()) == ({"alice", "bob", "rig"} if way == "direct" else {"gate"})
    assert way == "router" or addresses.items() <= joined.items()
    assert acted == [
        ("commanded", "alice", f"{ROOT}/mesh/command/@by/alice", 0),
        ("set", "alice", f"{ROOT}/free/set/@by/alice/u", 0),
    ]
    kept = Result.read(own.config.with_suffix(".csv")).metadata["audit"]["entries"]
    assert msgspec.convert(kept, list[AuditEntry])[: len(told)] == told


def test_who_joins_again_and_again_is_one_entry_and_one_line(place: Place) -> None:
    with scene(place, "direct") as own:
        for _ in range(20):
            with dialled(own, "bob", "client") as bob:
                [seen] = bob.get(f"{ROOT}/mesh/audit", timeout=DEADLINE_S)
                assert seen.ok is not None

        def of_bob() -> list[int]:
            return [entry.number for entry in entries(own) if (entry.what, entry.who) == ("joined", "bob")]

        wait_until(lambda: of_bob() == [20], "20 joins in one entry")
        lines = [payload for key, payload in own.heard if key == f"{ROOT}/mesh/log" and b"bob joined" in payload]
        assert len(lines) == 1
