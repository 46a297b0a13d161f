"""The table of actions and roles, cell by cell: plain Zenoh clients over TLS, and what arrives at who listens.

What is allowed works. What is not has no effect: that is looked at where it would have one, and only after a later
message of the same link has come, so nothing is on its way any more.
"""

from __future__ import annotations

import json
import socket
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import Any, Final, Literal

import pytest
import zenoh

from fmu_mesh.cli.main import main
from fmu_mesh.wire.security.identity import CA, CERTIFICATE, KEY, Role
from fmu_mesh.wire.security.rules import ACTIONS, access_control
from tests.helpers import wait_until

pytest.importorskip("cryptography")
from fmu_mesh.wire.security.authority import Authority

ROOT: Final = "fmu_mesh/pair"
ROLES: Final[dict[str, Role]] = {
    "lab": "node",
    "rig": "node",
    "alice": "operator",
    "carol": "operator",
    "bob": "observer",
}
MALLORY: Final = "mallory"
"""Has a certificate of the authority, and no role any more."""

ENDS: Final = ("plant/flow", "twin/y")
_SILENCE_S: Final = 0.5

SEES: Final = frozenset(("bob", "alice", "rig"))
ACTS: Final = frozenset(("alice", "rig"))
PART: Final = frozenset(("rig",))
ALL: Final = frozenset((*SEES, MALLORY))
NOBODY: Final = frozenset[str]()

ASKED: Final = {
    "mesh/hello": ALL,
    "pump/out/y": SEES,
    "pump/out/*": SEES,
    "*/out/*": SEES,
    "pump/in/u": SEES,
    "pump/param/k": SEES,
    "pump/local/x": SEES,
    "pump/info": SEES,
    "pump/status": SEES,
    "*/status": SEES,
    "mesh/info": SEES,
    "mesh/status": SEES,
    "mesh/plan": SEES,
    "mesh/log": SEES,
    "mesh/audit": SEES,
    "mesh/ros/*": SEES,
    "mesh/role/OWN": SEES,
    "mesh/role/operator": frozenset(("alice", "rig")),
    "mesh/role/node": PART,
    "pump/set/@by/NAME/u": ACTS,
    "pump/set/@by/NAME": ACTS,
    "mesh/command/@by/NAME": ACTS,
    "pump/set/@by/carol/u": PART,
    "pump/set/@by/local/u": PART,
    "*/set/@by/*/*": PART,
    "mesh/command/@by/carol": PART,
    "mesh/command/@by/*": PART,
    "pump/set/u": PART,
    "mesh/command": PART,
    "pump/**": PART,
    "**": PART,
    "@sync/0/report/of=pump": PART,
    "@sync/**": PART,
}
"""Queries below the mesh, and by whom they are answered."""

PUT: Final = {
    "pump/set/@by/NAME/u": ACTS,
    "pump/set/@by/NAME": ACTS,
    "mesh/command/@by/NAME": ACTS,
    "pump/set/@by/carol/u": PART,
    "pump/set/@by/local/u": PART,
    "mesh/command/@by/carol": PART,
    "pump/set/u": PART,
    "pump/in/u": PART,
    "pump/out/y": PART,
    "pump/log": PART,
    "mesh/status": PART,
    "mesh/log": PART,
    "mesh/audit": PART,
    "@sync/0/frame/pump/to=tank": PART,
    "@sync/0/grant/to=pump": PART,
}
SUBSCRIBED: Final = {
    "pump/out/y": SEES,
    "pump/status": SEES,
    "pump/log": SEES,
    "mesh/status": SEES,
    "mesh/log": SEES,
    "mesh/audit": SEES,
    "pump/set/@by/carol/u": PART,
    "mesh/command/@by/carol": PART,
    "@sync/0/frame/pump/to=tank": PART,
}
DECLARED: Final = {"pump/out/forged": PART, "mesh/role/forged": PART, "@sync/forged": PART}
"""Queryables and tokens of the visitor, and of whom the mesh sees them."""

TOKENS: Final = {"**/mesh": SEES, f"{ROOT}/*": SEES, f"{ROOT}/mesh": SEES, f"{ROOT}/@sync/**": PART}
FOREIGN: Final = {"plant/flow": ACTS, "twin/y": ACTS, "plant/other": NOBODY, "other/pair/pump/set/u": NOBODY}
FOREIGN_READ: Final = {"plant/flow": SEES, "twin/y": SEES, "plant/other": NOBODY, "**": NOBODY, "@/**": NOBODY}

Way = Literal["direct", "router"]
Opened = Callable[..., zenoh.Session]


@pytest.fixture(scope="module")
def lab(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An authority with all names; the last one has lost its role."""
    authority = Authority.made(tmp_path_factory.mktemp("lab") / "lab")
    for name, role in ROLES.items():
        authority.add(name, role, 2.0)
    authority.add(MALLORY, "operator", 2.0)
    return authority.folder


def opened(folder: Path, mode: str, **settings: object) -> zenoh.Session:
    """A plain session with the certificate of a folder."""
    config, own = zenoh.Config(), {name: str(folder / name) for name in (CA, CERTIFICATE, KEY)}
    tls = {
        "root_ca_certificate": own[CA],
        "enable_mtls": True,
        "verify_name_on_connect": True,
        **{f"{end}_certificate": own[CERTIFICATE] for end in ("listen", "connect")},
        **{f"{end}_private_key": own[KEY] for end in ("listen", "connect")},
    }
    scouting = {f"scouting/{kind}/enabled": False for kind in ("multicast", "gossip")}
    ends: dict[str, list[str]] = {"listen/endpoints": [], "connect/endpoints": []}
    for key, value in {"mode": mode, **ends, "transport/link/tls": tls, **scouting, **settings}.items():
        config.insert_json5(key, json.dumps(value))
    return zenoh.open(config)


def free_endpoint() -> str:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tls/127.0.0.1:{probe.getsockname()[1]}"


class Mesh:
    """Who listens: answers every query, and notes all that arrives."""

    def __init__(self, session: zenoh.Session) -> None:
        self.session = session
        self.arrived: list[str] = []
        self._entities: list[Any] = []
        every = f"{ROOT}/**", f"{ROOT}/@sync/**", f"{ROOT}/*/set/@by/**", f"{ROOT}/mesh/command/@by/**"
        for key in (*every, f"{ROOT}/mesh/hello", *FOREIGN):
            self._entities.append(session.declare_queryable(key, self._answer))
            self._entities.append(session.declare_subscriber(key, self._note))
        for key in (f"{ROOT}/pump", f"{ROOT}/mesh", f"{ROOT}/@sync/0/master"):
            self._entities.append(session.liveliness().declare_token(key))

    def _answer(self, query: zenoh.Query) -> None:
        self._note(query)
        query.reply(str(query.key_expr).replace("*", "x"), b"1")

    def _note(self, message: zenoh.Query | zenoh.Sample) -> None:
        self.arrived.append(str(message.key_expr))

    def has(self, key: str) -> bool:
        return key in self.arrived


class Visitor:
    """Somebody with a certificate."""

    def __init__(self, session: zenoh.Session, name: str) -> None:
        self.session = session
        self.name = name

    def key(self, text: str) -> str:
        role = {**ROLES, MALLORY: "operator"}[self.name]
        return text.replace("NAME", self.name).replace("OWN", role)

    def answered(self, key: str) -> bool:
        own = f"@/{self.session.zid()}/"  # each session answers for itself what it is
        replies = [reply.ok for reply in self.session.get(key, timeout=_SILENCE_S) if reply.ok is not None]
        return any(not str(reply.key_expr).startswith(own) for reply in replies)

    def fence(self) -> None:
        """Wait until all that was sent before has arrived, and all that was sent to it."""
        assert self.answered(f"{ROOT}/mesh/hello")


@contextmanager
def meeting(lab: Path, way: Way, mode: str, name: str) -> Iterator[tuple[Mesh, Visitor]]:
    """A mesh that listens with the rules, or behind a router with them, and a visitor."""
    endpoint = free_endpoint()
    with ExitStack() as stack:

        def session(whose: str, own_mode: str, **settings: object) -> zenoh.Session:
            own = opened(lab / whose, own_mode, **settings)
            stack.callback(own.close)
            return own

        listens = {"listen/endpoints": [endpoint]}
        if way == "direct":
            rules = access_control(ROOT, ROLES, ENDS)
            mesh = Mesh(session("lab", "peer", **listens, access_control=rules))
        else:
            session("lab", "router", **listens, access_control=access_control("fmu_mesh/*", ROLES, ENDS))
            mesh = Mesh(session("lab", "client", **{"connect/endpoints": [endpoint]}))
        visitor = Visitor(session(name, mode, **{"connect/endpoints": [endpoint]}), name)
        wait_until(lambda: visitor.answered(f"{ROOT}/mesh/hello"), "the mesh")
        yield mesh, visitor


@pytest.mark.parametrize("name", sorted(ALL))
@pytest.mark.parametrize("mode", ["client", "peer", "router"])
@pytest.mark.parametrize("way", ["direct", "router"])
def test_each_role_does_what_the_table_says_and_nothing_else(lab: Path, way: Way, mode: str, name: str) -> None:
    def below(table: Mapping[str, frozenset[str]]) -> dict[str, bool]:
        return {f"{ROOT}/{key}": name in names for key, names in table.items()}

    def others(table: Mapping[str, frozenset[str]]) -> dict[str, bool]:
        return {key: name in names for key, names in table.items()}

    with meeting(lab, way, mode, name) as (mesh, visitor):
        cells = Cells(mesh, visitor)
        wrong = [
            f"{attempt.__name__} {key}: {'does not work' if allowed else 'works'}"
            for attempt, table in (
                (cells.asks, {**below(ASKED), **others(FOREIGN_READ)}),
                (cells.puts, {**below(PUT), **others(FOREIGN)}),
                (cells.publishes, below(PUT)),
                (cells.subscribes, {**below(SUBSCRIBED), **others(FOREIGN_READ)}),
                (cells.sees_tokens, others(TOKENS)),
                (cells.answers, below(DECLARED)),
                (cells.declares_token, below(DECLARED)),
            )
            for key, allowed in table.items()
            if not works(partial(attempt, visitor.key(key)), allowed)
        ]
        # A peer is told what there is, and answers such a question by itself.
        known = {str(reply.ok.key_expr) for reply in visitor.session.liveliness().get("**") if reply.ok is not None}

    assert not wrong
    assert name in PART or known <= ({f"{ROOT}/mesh", f"{ROOT}/pump"} if name in SEES else set())


def works(attempt: Callable[[], bool], allowed: object) -> bool:
    """Whether an attempt has the effect that it should; one that is allowed may have to wait for a declaration."""
    if not allowed:
        return not attempt()
    with suppress(AssertionError):
        return wait_until(attempt, "an effect", 10.0)
    return False


class Cells:
    """What a visitor tries, each with one key; returns whether it had an effect."""

    def __init__(self, mesh: Mesh, visitor: Visitor) -> None:
        self._mesh = mesh
        self._visitor = visitor

    def asks(self, key: str) -> bool:
        """A payload makes no difference to the rules."""
        self._mesh.arrived.clear()
        answered = self._visitor.answered(key)
        self._visitor.fence()
        assert answered or not self._mesh.has(key), f"'{key}' arrived"
        return answered

    def puts(self, key: str) -> bool:
        self._mesh.arrived.clear()
        self._visitor.session.put(key, b"1")
        self._visitor.fence()
        return self._mesh.has(key)

    def publishes(self, key: str) -> bool:
        self._mesh.arrived.clear()
        with self._visitor.session.declare_publisher(key) as publisher:
            self._visitor.fence()
            publisher.put(b"1")
            self._visitor.fence()
        return self._mesh.has(key)

    def subscribes(self, key: str) -> bool:
        got: list[str] = []
        with self._visitor.session.declare_subscriber(key, lambda sample: got.append(str(sample.key_expr))):
            self._visitor.fence()
            self._mesh.session.put(key.replace("*", "x"), b"1")
            self._visitor.fence()
        return bool(got)

    def sees_tokens(self, key: str) -> bool:
        replies = self._visitor.session.liveliness().get(key, timeout=_SILENCE_S)
        return any(reply.ok is not None for reply in replies)

    def answers(self, key: str) -> bool:
        def answer(query: zenoh.Query) -> None:
            query.reply(query.key_expr, b"forged")

        with self._visitor.session.declare_queryable(key, answer):
            self._visitor.fence()
            replies = self._mesh.session.get(key, timeout=_SILENCE_S)
            return any(reply.ok is not None and reply.ok.payload.to_bytes() == b"forged" for reply in replies)

    def declares_token(self, key: str) -> bool:
        with self._visitor.session.liveliness().declare_token(key):
            self._visitor.fence()
            replies = self._mesh.session.liveliness().get(key, timeout=_SILENCE_S)
            return any(reply.ok is not None for reply in replies)


def test_the_rules_for_another_router_are_those_of_ours(lab: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["security", "show", str(lab), "--zenohd"]) == 0
    printed = capsys.readouterr().out
    other = zenoh.Config.from_json5(printed)

    ours = zenoh.Config()
    ours.insert_json5("access_control", json.dumps(access_control("fmu_mesh/*", {**ROLES, MALLORY: "operator"})))
    assert json.loads(other.get_json("access_control")) == json.loads(ours.get_json("access_control"))
    assert json.loads(other.get_json("access_control/default_permission")) == "deny"


def test_the_printed_table_has_every_action_with_its_roles(lab: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["security", "show", str(lab), "--table"]) == 0

    rows = capsys.readouterr().out.splitlines()
    assert [row.split("  ")[0] for row in rows] == [action.what for action in ACTIONS]
    assert all(row.endswith(", ".join(own.roles) or "certificate") for row, own in zip(rows, ACTIONS, strict=True))
