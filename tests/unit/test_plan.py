"""What a plan says about small systems."""

from __future__ import annotations

from itertools import pairwise

import pytest

from fmu_mesh.errors import ConfigurationError
from fmu_mesh.system.feeds import FeedColumn
from fmu_mesh.system.plan import RECORDER, Plan, make_plan
from fmu_mesh.system.window import recorder_window, rows_for
from tests.scenarios.scenario import Scenario


def delays(plan: Plan) -> dict[str, int | None]:
    return {f"{c.source_instance} -> {c.target_instance}": c.delay for c in plan.connections}


def test_jacobi_delays_every_connection_that_says_nothing_else() -> None:
    plan = Scenario(("a -> b", "b -> c (delay 0)", "c -> a"), algorithm="jacobi").plan()

    assert delays(plan) == {"a -> b": 1, "b -> c": 0, "c -> a": 1}
    assert plan.closing == ()
    assert plan.order == ("a", "b", "c")


def test_gauss_seidel_delays_the_connections_that_close_a_cycle_and_says_which() -> None:
    plan = Scenario(("a -> b", "b -> c", "c -> a", "b -> d")).plan()

    assert delays(plan) == {"a -> b": 0, "b -> c": 0, "c -> a": 1, "b -> d": 0}
    assert [str(connection) for connection in plan.closing] == ["c.point -> a.c"]
    assert [set(cycle) for cycle in plan.cycles] == [{"a", "b", "c"}]


def test_a_delay_that_is_set_closes_the_cycle_alone() -> None:
    plan = Scenario(("a -> b (delay 1)", "b -> c", "c -> a")).plan()

    assert delays(plan) == {"a -> b": 1, "b -> c": 0, "c -> a": 0}
    assert plan.closing == ()
    assert plan.order == ("b", "c", "a")


def test_an_algebraic_loop_is_refused_with_instances_on_it_and_its_place() -> None:
    connections = ("x -> a", "a -> b (delay 0)", "b -> c (delay 0)", "c -> a (delay 0)")

    with pytest.raises(ConfigurationError) as caught:
        Scenario(connections).plan()

    [finding] = caught.value.findings
    assert finding.path.startswith("connections[")
    assert "delay 0" in finding.found
    assert all(f"{name} -> " in finding.found for name in "abc")
    assert "delay: 1" in finding.expected


def test_every_algebraic_loop_is_shown() -> None:
    with pytest.raises(ConfigurationError) as caught:
        Scenario(("a -> b (delay 0)", "b -> a (delay 0)", "c -> d (delay 0)", "d -> c (delay 0)")).plan()

    assert len(caught.value.findings) == 2


def test_a_link_carries_what_its_target_needs_and_nothing_else() -> None:
    plan = Scenario(("a -> b", "a -> c"), steps={"a": 3}).plan(groups={"b": "g", "c": "g"}, record=True)

    to_group, to_recorder = plan.nodes["a"].links_out
    assert (to_group.source, to_group.target_node, to_group.step_points) == ("a", "g", 3)
    assert to_group.layout.names == ("point",)
    assert to_group.levels == (0,)
    assert to_recorder.target_node == RECORDER
    assert to_recorder.levels == (-1,)
    assert plan.nodes["g"].links_in == (to_group,)


def test_instances_of_one_node_have_no_link() -> None:
    plan = Scenario(("a -> b", "b -> a")).plan(groups={"a": "g", "b": "g"})

    assert list(plan.nodes) == ["g"]
    assert plan.nodes["g"].links_in == plan.nodes["g"].links_out == ()
    assert [feed.source for instance in plan.nodes["g"].instances for feed in instance.feeds] == ["b", "a"]


def test_there_is_no_recorder_without_a_result_file() -> None:
    assert RECORDER not in Scenario(("a -> b",)).plan().nodes
    assert Scenario(("a -> b",)).plan(record=True).system.recorded == (("a", "point"), ("b", "point"))


def test_connections_with_other_delays_are_other_feeds() -> None:
    plan = Scenario(("a -> b", "c -> b (delay 1)")).plan()

    [target] = plan.nodes["b"].instances
    assert [(feed.source, feed.rule.delay, feed.columns) for feed in target.feeds] == [
        ("a", 0, (FeedColumn("point", "a"),)),
        ("c", 1, (FeedColumn("point", "c"),)),
    ]


@pytest.mark.parametrize(("window", "slowest"), [(1, 1), (64, 4), (1015, 5), (1024, 600), (1, 5000)])
def test_rings_hold_what_can_be_under_way(window: int, slowest: int) -> None:
    """From the start of a step that was not told to the end of the value that a source holds beyond the grant."""
    plan = Scenario(("a -> b",), steps={"a": slowest}).plan(window=window)

    for node in plan.nodes.values():
        for ring in node.rings:
            assert ring.rows & (ring.rows - 1) == 0
            assert ring.rows * ring.step_points > window + 3 * slowest


def test_an_automatic_window_is_large_and_one_that_is_given_counts() -> None:
    system = Scenario(("a -> b",)).plan().system

    assert make_plan(system).window == 262144
    assert make_plan(system, window=3).window == 3


@pytest.mark.parametrize(
    ("window", "row_sizes", "expected"),
    [
        (16, [8, 24], 262144),
        (400_000, [8], 400_000),
        (16, [80_000], 2**24 // 80_000),
        (16, [10**6], 16),
        (16, [16] * 40, 2**24 // (40 * 16)),
    ],
)
def test_the_recorder_may_be_further_behind_where_its_rows_are_narrow(
    window: int, row_sizes: list[int], expected: int
) -> None:
    assert recorder_window(window, row_sizes) == expected


def test_the_automatic_window_of_many_instances_is_smaller() -> None:
    names = [f"i{number}" for number in range(50)]
    system = Scenario(tuple(f"{a} -> {b}" for a, b in pairwise(names))).plan().system

    assert make_plan(system).window == 2**20 // 50


@pytest.mark.parametrize("window", [1, 4, 5, 12, 13, 100, 1024])
def test_a_ring_has_power_of_two_of_rows_and_some_to_spare(window: int) -> None:
    rows = rows_for(window)

    assert rows & (rows - 1) == 0
    assert window + 3 < rows <= 2 * (window + 3)
