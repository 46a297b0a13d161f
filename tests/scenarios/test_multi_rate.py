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


def traced(*connections: str, points: int, **steps: int) -> str:
    """The steps of a system whose inputs follow lines, which are the same on any nodes."""
    system = Scenario(connections, points=points, steps=steps, extrapolation="midpoint")
    system.assert_the_same_on_any_nodes()
    return system.in_one_loop()


def test_a_line_of_a_slow_source_ends_with_its_step() -> None:
    """The source goes ahead; behind its last step, the line goes on."""
    assert (
        traced("slow -> fast", points=7, slow=3)
        == """\
slow: 0 -> 3
fast: 0 -> 1 uses slow@3
fast: 1 -> 2 uses slow@3
fast: 2 -> 3 uses slow@3
slow: 3 -> 6
fast: 3 -> 4 uses slow@6
fast: 4 -> 5 uses slow@6
fast: 5 -> 6 uses slow@6
fast: 6 -> 7 uses slow@6
"""
    )


def test_lines_of_slow_sources_in_a_chain_and_a_cycle() -> None:
    assert (
        traced("a -> b", "b -> c", "c -> b (delay 1)", points=9, a=4, b=2)
        == """\
a: 0 -> 4
b: 0 -> 2 uses a@4, c@0
c: 0 -> 1 uses b@2
c: 1 -> 2 uses b@2
b: 2 -> 4 uses a@4, c@2
c: 2 -> 3 uses b@4
c: 3 -> 4 uses b@4
a: 4 -> 8
b: 4 -> 6 uses a@8, c@4
c: 4 -> 5 uses b@6
c: 5 -> 6 uses b@6
b: 6 -> 8 uses a@8, c@6
c: 6 -> 7 uses b@8
c: 7 -> 8 uses b@8
c: 8 -> 9 uses b@8
"""
    )


def test_lines_between_rates_of_which_none_divides_the_other() -> None:
    assert (
        traced("a -> b", points=8, a=3, b=2)
        == """\
a: 0 -> 3
b: 0 -> 2 uses a@3
a: 3 -> 6
b: 2 -> 4 uses a@6
b: 4 -> 6 uses a@6
b: 6 -> 8 uses a@6
"""
    )


def test_a_slow_source_behind_a_fast_one_does_not_go_ahead() -> None:
    """It waits for values from the end of its own step, and its targets extrapolate."""
    assert "b: 0 -> 1 uses slow@0" in traced("a -> slow", "slow -> b", points=6, slow=3)
    assert "b: 0 -> 1 uses slow@0" in traced("a -> slow", "slow -> b", points=12, a=3, slow=2)
    assert "b: 0 -> 1 uses slow@2" in traced("a -> slow", "slow -> b", points=12, a=4, slow=2)


def test_sources_of_a_source_that_goes_ahead_do_so_too() -> None:
    """Otherwise, in one process, they would step when it has stepped already."""
    assert "b: 0 -> 1 uses slow@4, a@4" in traced("a -> slow", "slow -> b", "a -> b", points=8, a=4, slow=4)
    assert "slow: 0 -> 2 uses a@0" in traced("a -> slow (delay 1)", "slow -> b", points=8, a=4, slow=2)


@pytest.mark.parametrize("grouped", [False, True])
def test_a_very_slow_source_does_not_overwrite_inputs_that_wait(grouped: bool) -> None:  # noqa: FBT001 a parameter of a test
    """One of its values feeds more steps of its target than any window has points."""
    system = Scenario(("slow -> fast",), points=2400, steps={"slow": 700}, algorithm="jacobi")
    plan, lines = system.plan(groups={"slow": "g", "fast": "g"} if grouped else None, window=1), list[str]()

    SimulatedMesh(plan, lambda name: Counter(plan, name, steps=lines)).run()

    fast = [line for line in lines if line.startswith("fast")]
    assert fast == [f"fast: {k} -> {k + 1} uses slow@{k // 700 * 700}" for k in range(2400)]
