"""a -> b -> c: values run through within one point, or one point per instance."""

from __future__ import annotations

import pytest

from tests.scenarios.scenario import Counter, Scenario
from tests.scenarios.simulated import SimulatedMesh

CHAIN = ("a -> b", "b -> c")


def test_gauss_seidel_steps_from_source_to_target_with_the_newest_values() -> None:
    chain = Scenario(CHAIN)

    assert (
        chain.in_one_loop()
        == """\
a: 0 -> 1
b: 0 -> 1 uses a@1
c: 0 -> 1 uses b@1
a: 1 -> 2
b: 1 -> 2 uses a@2
c: 1 -> 2 uses b@2
"""
    )
    chain.assert_the_same_on_any_nodes()


def test_jacobi_steps_with_the_values_at_the_start_of_the_step() -> None:
    chain = Scenario(CHAIN, algorithm="jacobi")

    assert (
        chain.in_one_loop()
        == """\
a: 0 -> 1
b: 0 -> 1 uses a@0
c: 0 -> 1 uses b@0
a: 1 -> 2
b: 1 -> 2 uses a@1
c: 1 -> 2 uses b@1
"""
    )
    chain.assert_the_same_on_any_nodes()


def test_a_delay_can_be_set_on_one_connection() -> None:
    chain = Scenario(("a -> b (delay 1)", "b -> c"))

    assert (
        chain.in_one_loop()
        == """\
a: 0 -> 1
b: 0 -> 1 uses a@0
c: 0 -> 1 uses b@1
a: 1 -> 2
b: 1 -> 2 uses a@1
c: 1 -> 2 uses b@2
"""
    )
    chain.assert_the_same_on_any_nodes()


def test_the_order_of_the_file_plays_no_part() -> None:
    backwards = Scenario(("b -> a", "c -> b"), points=1)

    assert (
        backwards.in_one_loop()
        == """\
c: 0 -> 1
b: 0 -> 1 uses c@1
a: 0 -> 1 uses b@1
"""
    )
    backwards.assert_the_same_on_any_nodes()


def test_initial_values_run_down_the_chain() -> None:
    chain = Scenario(CHAIN, points=0, feedthrough="bc")

    assert (
        chain.initialization()
        == """\
a: enter
b: enter
c: enter
a: get point
b: set a
b: get point
b: set a
c: set b
a: exit
b: exit
c: exit
"""
    )


@pytest.mark.parametrize("seed", range(3))
def test_initial_values_run_down_the_chain_from_node_to_node(seed: int) -> None:
    calls = Scenario(CHAIN, points=0, feedthrough="bc").initialization_on_nodes(seed=seed)

    assert calls["b"] == ["enter", "set a", "get point", "set a", "exit"]
    assert calls["c"] == ["enter", "set b", "exit"]


@pytest.mark.parametrize("window", [1, 16, 300])
def test_a_node_that_waits_has_sent_all_of_its_rows(window: int) -> None:
    """The grant may depend on them: a recorder that lacks rows holds it."""
    plan = Scenario(("a -> b",), points=300).plan(window=window, record=True)
    mesh = SimulatedMesh(plan, lambda name: Counter(plan, name), seed=window)

    mesh.run()

    assert mesh.waits_before_sending == 0
    assert [row[0] for row in mesh.recorded["b"]] == list(range(301))
