"""a -> b and c -> d: two ways from one source to one target."""

from __future__ import annotations

from tests.scenarios.scenario import Scenario

DIAMOND = ("a -> b", "a -> c", "b -> d", "c -> d")


def test_both_ways_bring_values_of_the_same_point() -> None:
    diamond = Scenario(DIAMOND)

    assert (
        diamond.in_one_loop()
        == """\
a: 0 -> 1
b: 0 -> 1 uses a@1
c: 0 -> 1 uses a@1
d: 0 -> 1 uses b@1, c@1
a: 1 -> 2
b: 1 -> 2 uses a@2
c: 1 -> 2 uses a@2
d: 1 -> 2 uses b@2, c@2
"""
    )
    diamond.assert_the_same_on_any_nodes()


def test_with_jacobi_the_sides_and_the_target_are_one_point_behind() -> None:
    diamond = Scenario(DIAMOND, points=1, algorithm="jacobi")

    assert (
        diamond.in_one_loop()
        == """\
a: 0 -> 1
b: 0 -> 1 uses a@0
c: 0 -> 1 uses a@0
d: 0 -> 1 uses b@0, c@0
"""
    )
    diamond.assert_the_same_on_any_nodes()


def test_a_delayed_side_brings_an_older_value_than_the_other() -> None:
    diamond = Scenario(("a -> b", "a -> c", "b -> d", "c -> d (delay 1)"), points=1)

    assert (
        diamond.in_one_loop()
        == """\
a: 0 -> 1
b: 0 -> 1 uses a@1
c: 0 -> 1 uses a@1
d: 0 -> 1 uses b@1, c@0
"""
    )
    diamond.assert_the_same_on_any_nodes()


def test_an_output_that_depends_on_nothing_is_known_at_once() -> None:
    diamond = Scenario(DIAMOND, points=0, feedthrough="bd")

    assert (
        diamond.initialization()
        == """\
a: enter
b: enter
c: enter
d: enter
c: get point
a: get point
b: set a
b: get point
b: set a
c: set a
d: set b, c
a: exit
b: exit
c: exit
d: exit
"""
    )
