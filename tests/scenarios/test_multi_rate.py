"""Instances with step sizes of their own: inputs are taken at their own points, and outputs hold between them."""

from __future__ import annotations

import pytest

from tests.scenarios.scenario import Counter, Scenario
from tests.scenarios.simulated import SimulatedMesh


def test_a_slow_target_uses_the_value_at_end_of_its_own_step() -> None:
    system = Scenario(("fast -> slow",), points=7, steps={"slow": 3})

    assert (
        system.in_one_loop()
        == """\
fast: 0 -> 1
fast: 1 -> 2
fast: 2 -> 3
slow: 0 -> 3 uses fast@3
fast: 3 -> 4
fast: 4 -> 5
fast: 5 -> 6
slow: 3 -> 6 uses fast@6
fast: 6 -> 7
"""
    )
    system.assert_the_same_on_any_nodes()


def test_with_jacobi_slow_target_uses_value_at_start_of_its_own_step() -> None:
    system = Scenario(("fast -> slow",), points=7, steps={"slow": 3}, algorithm="jacobi")

    assert (
        system.in_one_loop()
        == """\
fast: 0 -> 1
fast: 1 -> 2
fast: 2 -> 3
slow: 0 -> 3 uses fast@0
fast: 3 -> 4
fast: 4 -> 5
fast: 5 -> 6
slow: 3 -> 6 uses fast@3
fast: 6 -> 7
"""
    )
    system.assert_the_same_on_any_nodes()


def test_a_slow_source_holds_its_value_until_it_has_a_new_one() -> None:
    system = Scenario(("slow -> fast",), points=7, steps={"slow": 3})

    assert (
        system.in_one_loop()
        == """\
fast: 0 -> 1 uses slow@0
fast: 1 -> 2 uses slow@0
slow: 0 -> 3
fast: 2 -> 3 uses slow@3
fast: 3 -> 4 uses slow@3
fast: 4 -> 5 uses slow@3
slow: 3 -> 6
fast: 5 -> 6 uses slow@6
fast: 6 -> 7 uses slow@6
"""
    )
    system.assert_the_same_on_any_nodes()


def test_with_jacobi_new_value_of_slow_source_counts_from_next_point_on() -> None:
    system = Scenario(("slow -> fast",), points=7, steps={"slow": 3}, algorithm="jacobi")

    assert (
        system.in_one_loop()
        == """\
fast: 0 -> 1 uses slow@0
fast: 1 -> 2 uses slow@0
fast: 2 -> 3 uses slow@0
slow: 0 -> 3
fast: 3 -> 4 uses slow@3
fast: 4 -> 5 uses slow@3
fast: 5 -> 6 uses slow@3
slow: 3 -> 6
fast: 6 -> 7 uses slow@6
"""
    )
    system.assert_the_same_on_any_nodes()


def test_two_rates_of_which_none_divides_the_other() -> None:
    system = Scenario(("a -> b",), points=8, steps={"a": 2, "b": 3})

    assert (
        system.in_one_loop()
        == """\
a: 0 -> 2
b: 0 -> 3 uses a@2
a: 2 -> 4
a: 4 -> 6
b: 3 -> 6 uses a@6
a: 6 -> 8
"""
    )
    system.assert_the_same_on_any_nodes()


def test_a_cycle_of_two_rates() -> None:
    cycle = Scenario(("a -> b", "b -> a"), points=7, steps={"a": 3, "b": 2})

    assert (
        cycle.in_one_loop()
        == """\
b: 0 -> 2 uses a@0
a: 0 -> 3 uses b@0
b: 2 -> 4 uses a@3
a: 3 -> 6 uses b@2
b: 4 -> 6 uses a@6
"""
    )
    cycle.assert_the_same_on_any_nodes()


def test_with_jacobi_a_cycle_of_two_rates() -> None:
    cycle = Scenario(("a -> b", "b -> a"), points=7, steps={"a": 3, "b": 2}, algorithm="jacobi")

    assert (
        cycle.in_one_loop()
        == """\
b: 0 -> 2 uses a@0
a: 0 -> 3 uses b@0
b: 2 -> 4 uses a@0
a: 3 -> 6 uses b@2
b: 4 -> 6 uses a@3
"""
    )
    cycle.assert_the_same_on_any_nodes()


def test_a_step_that_does_not_fit_before_last_point_is_not_taken() -> None:
    system = Scenario(("a -> b",), points=2, steps={"a": 3})

    assert (
        system.in_one_loop()
        == """\
b: 0 -> 1 uses a@0
b: 1 -> 2 uses a@0
"""
    )
    system.assert_the_same_on_any_nodes()


def test_a_slow_member_of_a_cycle_stops_others_only_at_its_end() -> None:
    """Otherwise its source, which may run one window ahead of the cycle, never reaches that end."""
    system = Scenario(("source -> slow", "slow -> fast", "fast -> slow"), points=6, steps={"slow": 5})

    assert (
        system.grouped()
        == """\
source: 0 -> 1
fast: 0 -> 1 uses slow@0
source: 1 -> 2
fast: 1 -> 2 uses slow@0
source: 2 -> 3
fast: 2 -> 3 uses slow@0
source: 3 -> 4
fast: 3 -> 4 uses slow@0
source: 4 -> 5
slow: 0 -> 5 uses source@5, fast@0
fast: 4 -> 5 uses slow@5
source: 5 -> 6
fast: 5 -> 6 uses slow@5
"""
    )
    system.assert_the_same_on_any_nodes()


@pytest.mark.parametrize("grouped", [False, True])
def test_a_very_slow_source_does_not_overwrite_inputs_that_wait(grouped: bool) -> None:  # noqa: FBT001 a parameter of a test
    """One of its values feeds more steps of its target than any window has points."""
    system = Scenario(("slow -> fast",), points=2400, steps={"slow": 700}, algorithm="jacobi")
    plan, lines = system.plan(groups={"slow": "g", "fast": "g"} if grouped else None, window=1), list[str]()

    SimulatedMesh(plan, lambda name: Counter(plan, name, steps=lines)).run()

    fast = [line for line in lines if line.startswith("fast")]
    assert fast == [f"fast: {k} -> {k + 1} uses slow@{k // 700 * 700}" for k in range(2400)]
