"""How keys are spelt: other programs, in any language, rely on it."""

from __future__ import annotations

import pytest
import zenoh

from fmu_mesh.wire.keys import Keys, RunKeys, escape, unescape

KEYS = Keys("fmu_mesh", "pair")
RUN = KEYS.run("0123456789abcdef")


@pytest.mark.parametrize(
    ("name", "chunk"),
    [
        ("a", "a"),
        ("der(a,2)", "der(a,2)"),
        ("body[1].x", "body[1].x"),
        ("a/b", "a%2Fb"),
        ("a*b$c?d#e%f", "a%2Ab%24c%3Fd%23e%25f"),
        ("@a@b", "%40a@b"),
        ("a b", "a%20b"),
        ("%2F", "%252F"),
        ("Größe", "Größe"),
        ("*", "%2A"),
        ("**", "%2A%2A"),
    ],
)
def test_a_variable_name_is_one_chunk(name: str, chunk: str) -> None:
    assert escape(name) == chunk
    assert unescape(chunk) == name


def test_public_keys_are_those_of_the_key_space() -> None:
    assert KEYS.instance("pendulum") == "fmu_mesh/pair/pendulum"
    assert KEYS.variable("pendulum", "out", "der(a)") == "fmu_mesh/pair/pendulum/out/der(a)"
    assert KEYS.variable("pendulum", "param", "l") == "fmu_mesh/pair/pendulum/param/l"
    assert KEYS.mesh_key("status") == "fmu_mesh/pair/mesh/status"
    assert KEYS.master == "fmu_mesh/pair/mesh"


def test_one_subscription_gets_what_is_for_a_node_and_nothing_else() -> None:
    inbox = zenoh.KeyExpr(RUN.inbox("delay"))

    def gets(key: str) -> bool:
        return inbox.intersects(zenoh.KeyExpr(key))

    assert gets(RUN.frames("pendulum", "delay"))
    assert not gets(RUN.frames("pendulum", "delay2"))
    assert not gets(RUN.frames("delay", "pendulum"))
    assert not gets(RUN.progress("delay"))
    assert not gets(Keys("fmu_mesh", "other").run(RUN.run).frames("pendulum", "delay"))


def test_nothing_of_one_run_reaches_another_one_of_the_same_mesh() -> None:
    first, second = RunKeys.new(KEYS), RunKeys.new(KEYS)

    assert first.run != second.run
    assert not zenoh.KeyExpr(first.inbox("delay")).intersects(zenoh.KeyExpr(second.frames("pendulum", "delay")))
    assert not zenoh.KeyExpr(first.report("*")).intersects(zenoh.KeyExpr(second.report("delay")))
    assert not zenoh.KeyExpr(first.node("*")).intersects(zenoh.KeyExpr(second.node("delay")))
    assert not zenoh.KeyExpr(f"{first.base}/**").intersects(zenoh.KeyExpr(KEYS.register))


@pytest.mark.parametrize("node", ["delay", "@record"])
def test_the_master_is_asked_by_every_node_and_by_the_recorder(node: str) -> None:
    for key in (RUN.node, RUN.ready, RUN.report):
        assert zenoh.KeyExpr(key("*")).intersects(zenoh.KeyExpr(key(node)))
        assert RunKeys.node_in(key(node)) == node
    assert zenoh.KeyExpr(RUN.inbox("@mesh")).intersects(zenoh.KeyExpr(RUN.progress(node)))


@pytest.mark.parametrize(("nodes", "keys"), [(1, 1), (16, 1), (17, 2), (100, 7)])
def test_every_node_gets_each_grant_once(nodes: int, keys: int) -> None:
    names = [f"n{number}" for number in range(nodes)]

    grants = RUN.grants(names)

    assert list(grants) == names
    assert len({*grants.values()}) == keys
    for name in names:
        inbox = zenoh.KeyExpr(RUN.inbox(name))
        assert sum(inbox.intersects(zenoh.KeyExpr(key)) for key in {*grants.values()}) == 1


def test_a_subscriber_of_everything_does_not_get_what_is_internal() -> None:
    everything = zenoh.KeyExpr("fmu_mesh/**")

    internal = (RUN.frames("a", "b"), RUN.progress("a"), RUN.report("a"), RUN.master, *RUN.grants(["a"]).values())
    for key in (KEYS.register, *internal):
        assert not everything.intersects(zenoh.KeyExpr(key))
    assert everything.intersects(zenoh.KeyExpr(KEYS.variable("a", "out", "@y/**")))
