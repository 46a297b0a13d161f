"""The table of actions and roles, cell by cell: plain Zenoh clients over TLS, and what arrives at who listens.

What is allowed works. What is not has no effect: that is looked at where it would have one, and only after a later
message of the same link has come, so nothing is on its way any more.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import Any, Final, Literal

import pytest
import zenoh

from fmu_mesh.cli.main import main
from fmu_mesh.wire.security.identity import Role
from fmu_mesh.wire.security.rules import ACTIONS
from fmu_mesh.wire.session import Wiring, open_session
from tests.helpers import Place, wait_until
from tests.visitors import DIALS, free_endpoint, opened, secured_router

pytest.importorskip("cryptography")
from fmu_mesh.wire.security.authority import Authority
from fmu_mesh.wire.security.certificates import identity_in

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

Way = Literal["direct", "quic", "router"]


@pytest.fixture(scope="module")
def lab(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An authority with all names; the last one has lost its role."""
    authority = Authority.made(tmp_path_factory.mktemp("lab") / "lab")
    for name, role in ROLES.items():
        authority.add(name, role, 2.0)
    kept = authority.add(MALLORY, "operator", 2.0).rename(authority.folder / "kept")
    authority.remove(MALLORY)
    return kept.rename(authority.folder / MALLORY).parent


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
def meeting(place: Place, lab: Path, way: Way, mode: str, name: str) -> Iterator[tuple[Mesh, Visitor]]:
    """A mesh that listens with the rules, or behind our router with them, and a visitor."""
    with ExitStack() as stack:

        def session(whose: str, own_mode: str) -> zenoh.Session:
            own = opened(lab / whose, own_mode, **{"connect/endpoints": [endpoint]})
            stack.callback(own.close)
            return own

        if way != "router":
            endpoint = free_endpoint("quic" if way == "quic" else "tls")
            wiring = Wiring(listen=(endpoint,), identity=identity_in(lab / "lab"), root=ROOT, ends=ENDS)
            own = open_session(wiring)
            stack.callback(own.close)
            mesh = Mesh(own)
        else:
            _, endpoint = secured_router(place, lab / "lab", *ENDS)
            mesh = Mesh(session("lab", "client"))
        visitor = Visitor(session(name, mode), name)
        wait_until(lambda: visitor.answered(f"{ROOT}/mesh/hello"), "the mesh")
        yield mesh, visitor


@pytest.mark.parametrize("name", sorted(ALL))
@pytest.mark.parametrize(
    ("way", "mode"), [("quic", "client"), *((way, mode) for way in ("direct", "router") for mode in DIALS)]
)
def test_each_role_does_what_the_table_says_and_nothing_else(
    place: Place, lab: Path, way: Way, mode: str, name: str
) -> None:
    def below(table: Mapping[str, frozenset[str]]) -> dict[str, bool]:
        return {f"{ROOT}/{key}": name in names for key, names in table.items()}

    def others(table: Mapping[str, frozenset[str]]) -> dict[str, bool]:
        return {key: name in names for key, names in table.items()}

    with meeting(place, lab, way, mode, name) as (mesh, visitor):
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


@pytest.mark.parametrize("options", [(), ("--end", "plant/flow", "--end", "twin/y", "--key-prefix", "plants")])
def test_the_rules_for_another_router_are_those_of_ours(
    lab: Path, options: tuple[str, ...], capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    ours: list[zenoh.Config] = []

    def open_none(config: zenoh.Config) -> zenoh.Session:
        ours.append(config)
        raise zenoh.ZError("not now")

    monkeypatch.setattr(zenoh, "open", open_none)
    assert main(["router", "--listen", free_endpoint(), "--security", str(lab / "lab"), *options]) == 2
    assert "not now" in capsys.readouterr().err
    assert main(["security", "show", str(lab), "--zenohd", *options]) == 0
    theirs, empty = zenoh.Config.from_json5(capsys.readouterr().out), zenoh.Config()

    def values(config: zenoh.Config) -> list[object]:
        return [json.loads(config.get_json(section)) for section in RULING]

    assert values(theirs) == values(ours[0])
    assert all(own != other for own, other in zip(values(theirs), values(empty), strict=True))
    # Beside them ours has one more, for the answers of its own process.
    assert json.loads(theirs.get_json("qos/network")) == json.loads(ours[0].get_json("qos/network"))[1:]
    assert json.loads(theirs.get_json("access_control/default_permission")) == "deny"


RULING: Final = ("access_control", "low_pass_filter", "transport/link/rx/max_message_size")
"""The parts of a configuration of Zenoh that are for messages of others."""


def test_the_printed_table_has_every_action_with_its_roles(lab: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["security", "show", str(lab), "--table"]) == 0

    rows = capsys.readouterr().out.splitlines()
    assert [row.split("  ")[0] for row in rows] == [action.what for action in ACTIONS]
    assert all(row.endswith(", ".join(own.roles) or "certificate") for row, own in zip(rows, ACTIONS, strict=True))
