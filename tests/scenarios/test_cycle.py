"""Cycles: somebody has to begin with an old value."""

from __future__ import annotations

import pytest

from fmu_mesh.errors import ConfigurationError
from tests.scenarios.scenario import Scenario


def test_with_jacobi_everybody_begins_with_old_values() -> None:
    cycle = Scenario(("a -> b", "b -> a"), algorithm="jacobi")

    assert (
        cycle.in_one_loop()
        == """\
a: 0 -> 1 uses b@0
b: 0 -> 1 uses a@0
a: 1 -> 2 uses b@1
b: 1 -> 2 uses a@1
"""
    )
    cycle.assert_the_same_on_any_nodes()


def test_with_gauss_seidel_only_connection_that_closes_cycle_brings_an_old_value() -> None:
    cycle = Scenario(("a -> b", "b -> c", "c -> a"))

    assert (
        cycle.in_one_loop()
        == """\
a: 0 -> 1 uses c@0
b: 0 -> 1 uses a@1
c: 0 -> 1 uses b@1
a: 1 -> 2 uses c@1
b: 1 -> 2 uses a@2
c: 1 -> 2 uses b@2
"""
    )
    cycle.assert_the_same_on_any_nodes()


def test_a_delay_that_is_set_decides_where_the_cycle_begins() -> None:
    cycle = Scenario(("a -> b (delay 1)", "b -> c", "c -> a"), points=1)

    assert (
        cycle.in_one_loop()
        == """\
b: 0 -> 1 uses a@0
c: 0 -> 1 uses b@1
a: 0 -> 1 uses c@1
"""
    )
    cycle.assert_the_same_on_any_nodes()


def test_an_instance_that_feeds_itself_uses_its_last_value() -> None:
    loop = Scenario(("a -> a", "a -> b"))

    assert (
        loop.in_one_loop()
        == """\
a: 0 -> 1 uses a@0
b: 0 -> 1 uses a@1
a: 1 -> 2 uses a@1
b: 1 -> 2 uses a@2
"""
    )
    loop.assert_the_same_on_any_nodes()


def test_what_feeds_cycle_and_what_it_feeds_stay_in_step_with_it() -> None:
    system = Scenario(("source -> a", "a -> b", "b -> a", "b -> target"), points=2)

    assert (
        system.in_one_loop()
        == """\
source: 0 -> 1
a: 0 -> 1 uses source@1, b@0
b: 0 -> 1 uses a@1
target: 0 -> 1 uses b@1
source: 1 -> 2
a: 1 -> 2 uses source@2, b@1
b: 1 -> 2 uses a@2
target: 1 -> 2 uses b@2
"""
    )
    system.assert_the_same_on_any_nodes()


def test_two_cycles_with_one_instance_in_common() -> None:
    system = Scenario(("a -> b", "b -> a", "b -> c", "c -> b"), points=1)

    assert (
        system.in_one_loop()
        == """\
a: 0 -> 1 uses b@0
b: 0 -> 1 uses a@1, c@0
c: 0 -> 1 uses b@1
"""
    )
    system.assert_the_same_on_any_nodes()


def test_a_cycle_without_any_delay_is_refused_with_the_names_on_it() -> None:
    with pytest.raises(ConfigurationError, match="a -> b -> a"):
        Scenario(("a -> b (delay 0)", "b -> a (delay 0)")).plan()


def test_a_loop_in_initialization_mode_is_torn_at_the_delayed_connection() -> None:
    cycle = Scenario(("a -> b", "b -> a"), points=0, feedthrough="ab")

    [loop] = cycle.plan().initialization.loops
    assert [str(tear) for tear in loop.tears] == ["b.point -> a.b"]
    assert (
        cycle.initialization()
        == """\
a: enter
b: enter
a: set b
a: get point
b: set a
b: get point
b: set a
a: exit
b: exit
"""
    )


@pytest.mark.parametrize("seed", range(3))
def test_every_node_of_a_loop_learns_what_the_torn_connection_brings(seed: int) -> None:
    cycle = Scenario(("a -> b", "b -> c", "c -> a"), points=0, feedthrough="abc")

    links = [link for node in cycle.plan().nodes.values() for link in node.links_in if link.initial_only]
    calls = cycle.initialization_on_nodes(seed=seed)

    assert [(link.source, link.target_node) for link in links] == [("c", "b")]
    assert calls["a"] == ["enter", "set c", "get point", "exit"]
    for name, source in (("b", "a"), ("c", "b")):
        assert calls[name] == ["enter", f"set {source}", "get point", f"set {source}", "exit"]


def test_jacobi_tears_a_loop_no_more_often_than_gauss_seidel() -> None:
    cycle = Scenario(("a -> b", "b -> c", "c -> a", "c -> b"), points=0, feedthrough="abc", algorithm="jacobi")

    [loop] = cycle.plan().initialization.loops

    assert [str(tear) for tear in loop.tears] == ["c.point -> a.c", "c.point -> b.c"]
    assert (loop.first, loop.last) == (0, 2)


def test_what_comes_before_and_after_a_loop_is_read_once() -> None:
    system = Scenario(("s -> a", "a -> b", "b -> a", "b -> t", "t -> e"), points=0, feedthrough="sabte")

    plan = system.plan().initialization

    [loop] = plan.loops
    assert loop.outputs == (("a", "point"), ("b", "point"))
    assert plan.levels == {("s", "point"): 0, ("a", "point"): 1, ("b", "point"): 2, ("t", "point"): 3}


def test_a_cycle_that_is_none_in_initialization_mode_gets_all_its_values() -> None:
    cycle = Scenario(("a -> b", "b -> a"), points=0, feedthrough="b")

    assert cycle.plan().initialization.loops == ()
    assert (
        cycle.initialization()
        == """\
a: enter
b: enter
a: get point
b: set a
b: get point
a: set b
b: set a
a: exit
b: exit
"""
    )
