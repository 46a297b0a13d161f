"""Instances that share a node: the same steps, in an order that one thread can take."""

from __future__ import annotations

from tests.scenarios.scenario import Scenario


def test_a_chain_in_one_node_is_stepped_from_source_to_target() -> None:
    chain = Scenario(("a -> b", "b -> c"))

    assert chain.grouped() == chain.in_one_loop()


def test_a_cycle_in_one_node_is_stepped_point_by_point() -> None:
    cycle = Scenario(("a -> b", "b -> c", "c -> a"))

    assert cycle.plan(groups=dict.fromkeys("abc", "g")).nodes["g"].units == (("a", "b", "c"),)
    assert cycle.grouped() == cycle.in_one_loop()
    assert cycle.on_nodes(groups=dict.fromkeys("abc", "g"), window=64) == cycle.in_one_loop().splitlines()


def test_a_cycle_of_two_rates_is_stepped_as_in_one_loop() -> None:
    cycle = Scenario(("a -> b", "b -> a"), points=12, steps={"a": 3, "b": 2})

    assert cycle.grouped() == cycle.in_one_loop()


def test_a_cycle_that_leaves_its_node_is_stepped_member_by_member() -> None:
    cycle = Scenario(("a -> b", "b -> c", "c -> a"), points=1)
    groups = {"a": "g", "b": "g"}

    assert cycle.plan(groups=groups).nodes["g"].units == (("a",), ("b",))
    assert cycle.on_nodes(groups=groups) == [
        "a: 0 -> 1 uses c@0",
        "b: 0 -> 1 uses a@1",
        "c: 0 -> 1 uses b@1",
    ]


def test_two_nodes_whose_members_alternate_in_one_chain() -> None:
    chain = Scenario(("a -> b", "b -> c", "c -> d"), points=1)
    groups = {"a": "odd", "b": "even", "c": "odd", "d": "even"}

    assert chain.on_nodes(groups=groups, window=1) == chain.in_one_loop().splitlines()


def test_a_cycle_and_its_surroundings_in_one_node() -> None:
    system = Scenario(("source -> a", "a -> b", "b -> a", "b -> target"))
    names = ("source", "a", "b", "target")

    node = system.plan(groups=dict.fromkeys(names, "g")).nodes["g"]

    assert node.units == (("source",), ("a", "b"), ("target",))
    assert (node.links_in, node.links_out) == ((), ())
    assert system.grouped() == system.in_one_loop()


def test_an_instance_between_two_members_of_a_cycle_does_not_stop_it() -> None:
    """`x` stands between `a` and `b` in the order of the plan, and hangs on one of them only."""
    for connections in (("a -> x", "a -> b", "b -> a", "x -> y"), ("y -> x", "x -> b", "a -> b", "b -> a")):
        Scenario(connections, points=6).assert_the_same_on_any_nodes()
