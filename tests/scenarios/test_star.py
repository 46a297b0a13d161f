"""A hub with several instances around it."""

from __future__ import annotations

from tests.scenarios.scenario import Scenario


def test_a_hub_that_feeds_many_is_stepped_once() -> None:
    star = Scenario(("hub -> a", "hub -> b", "hub -> c"), points=1)

    assert (
        star.in_one_loop()
        == """\
hub: 0 -> 1
a: 0 -> 1 uses hub@1
b: 0 -> 1 uses hub@1
c: 0 -> 1 uses hub@1
"""
    )
    star.assert_the_same_on_any_nodes()


def test_a_hub_that_is_fed_by_many_waits_for_all_of_them() -> None:
    star = Scenario(("a -> hub", "b -> hub", "c -> hub"))

    assert (
        star.in_one_loop()
        == """\
a: 0 -> 1
b: 0 -> 1
c: 0 -> 1
hub: 0 -> 1 uses a@1, b@1, c@1
a: 1 -> 2
b: 1 -> 2
c: 1 -> 2
hub: 1 -> 2 uses a@2, b@2, c@2
"""
    )
    star.assert_the_same_on_any_nodes()


def test_a_hub_that_hears_from_all_that_it_feeds() -> None:
    star = Scenario(("hub -> a", "hub -> b", "a -> hub", "b -> hub"))

    assert (
        star.in_one_loop()
        == """\
hub: 0 -> 1 uses a@0, b@0
a: 0 -> 1 uses hub@1
b: 0 -> 1 uses hub@1
hub: 1 -> 2 uses a@1, b@1
a: 1 -> 2 uses hub@2
b: 1 -> 2 uses hub@2
"""
    )
    star.assert_the_same_on_any_nodes()
