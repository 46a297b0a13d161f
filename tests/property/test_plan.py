"""Laws of graphs and of plans."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from itertools import pairwise

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fmu_mesh.instances.registry import decode_section
from fmu_mesh.system.graph import (
    cycle_through,
    feedback_edges,
    fewest_feedback_edges,
    strongly_connected,
    topological_order,
)
from fmu_mesh.system.plan import RECORDER, NodePlan
from tests.property.test_random_systems import Drawn, planned, systems

Edge = tuple[int, int]

COUNT = 8
vertices = st.permutations(range(COUNT))
edges = st.lists(st.tuples(st.integers(0, COUNT - 1), st.integers(0, COUNT - 1)), max_size=20)
free_edges = st.lists(st.tuples(st.integers(0, COUNT - 1), st.integers(0, COUNT - 1), st.booleans()), max_size=20)


def reachable(given_edges: Sequence[Edge]) -> list[list[bool]]:
    """Whether one vertex is reached from another by one edge or more (Warshall)."""
    matrix = [[(a, b) in given_edges for b in range(COUNT)] for a in range(COUNT)]
    for k in range(COUNT):
        for a in range(COUNT):
            for b in range(COUNT):
                matrix[a][b] = matrix[a][b] or (matrix[a][k] and matrix[k][b])
    return matrix


def has_cycle(given_edges: Sequence[Edge]) -> bool:
    matrix = reachable(given_edges)
    return any(matrix[a][a] for a in range(COUNT))


@given(vertices, edges)
def test_an_order_has_every_vertex_once_and_sources_before_targets(names: list[int], given_edges: list[Edge]) -> None:
    if has_cycle(given_edges):
        with pytest.raises(ValueError, match="cycle"):
            topological_order(names, given_edges)
        return

    order = topological_order(names, given_edges)

    assert sorted(order) == sorted(names)
    assert all(order.index(source) < order.index(target) for source, target in given_edges)


@given(vertices, edges)
def test_an_order_that_is_one_already_is_kept(names: list[int], given_edges: list[Edge]) -> None:
    forward = [(a, b) for a, b in given_edges if names.index(a) < names.index(b)]

    assert topological_order(names, forward) == names


@given(vertices, edges)
def test_components_are_the_vertices_that_reach_each_other_sources_first(
    names: list[int], given_edges: list[Edge]
) -> None:
    matrix = reachable(given_edges)

    parts = strongly_connected(names, given_edges)

    assert sorted(vertex for part in parts for vertex in part) == sorted(names)
    number = {vertex: place for place, part in enumerate(parts) for vertex in part}
    for a in names:
        for b in names:
            assert (number[a] == number[b]) == (a == b or (matrix[a][b] and matrix[b][a]))
    assert all(number[a] <= number[b] for a, b in given_edges)


@given(vertices, free_edges)
def test_feedback_edges_leave_no_cycle_and_none_is_taken_without_need(
    names: list[int], given_edges: list[tuple[int, int, bool]]
) -> None:
    fixed = [(a, b) for a, b, free in given_edges if not free]

    taken = feedback_edges(names, given_edges)

    assert taken == sorted(set(taken))
    assert all(given_edges[index][2] for index in taken)
    left = [(a, b) for index, (a, b, _) in enumerate(given_edges) if index not in taken]
    if not has_cycle(fixed):
        assert not has_cycle(left)
        for index in taken:
            assert has_cycle([*left, given_edges[index][:2]])
    assert taken == feedback_edges(names, given_edges)


def fewest(given_edges: Sequence[tuple[int, int, bool]]) -> list[int]:
    """The best choice by trying all of them: as few edges as possible, and of these choices the last ones."""
    free = [index for index, edge in enumerate(given_edges) if edge[2]]
    for count in range(len(free) + 1):
        choices = [
            chosen
            for chosen in itertools.combinations(free, count)
            if not has_cycle([edge[:2] for index, edge in enumerate(given_edges) if index not in chosen])
        ]
        if choices:
            return list(max(choices))
    return []


@given(vertices, st.lists(st.tuples(st.integers(0, 4), st.integers(0, 4), st.booleans()), max_size=8))
def test_as_few_edges_as_possible_are_taken_and_the_last_of_these(
    names: list[int], given_edges: list[tuple[int, int, bool]]
) -> None:
    if not has_cycle([(a, b) for a, b, free in given_edges if not free]):
        assert fewest_feedback_edges(names, given_edges) == fewest(given_edges)


many_edges = st.lists(st.tuples(st.integers(0, 19), st.integers(0, 19), st.just(value=True)), max_size=80)


@given(many_edges)
def test_large_graphs_lose_no_more_edges_than_by_their_order(
    given_edges: list[tuple[int, int, bool]],
) -> None:
    taken = fewest_feedback_edges(range(20), given_edges)

    assert len(taken) <= len(feedback_edges(range(20), given_edges))
    left = [edge[:2] for index, edge in enumerate(given_edges) if index not in taken]
    assert all(len(part) == 1 for part in strongly_connected(range(20), left))
    assert all(a != b for a, b in left)


@given(vertices, edges)
def test_the_cycle_that_an_error_shows_is_one(names: list[int], given_edges: list[Edge]) -> None:
    for part in strongly_connected(names, given_edges):
        if len(part) > 1:
            walk = cycle_through(part, given_edges)
            assert walk[0] == walk[-1] == part[0]
            assert len(set(walk[1:])) == len(walk) - 1
            assert all(step in given_edges for step in pairwise(walk))


# ---- plans


@given(systems())
def test_delays_are_those_of_algorithm_and_leave_no_loop_within_a_point(drawn: Drawn) -> None:
    plan = planned(drawn)

    for pipe, connection in zip(drawn.pipes, plan.connections, strict=True):
        if pipe.delay is not None:
            assert connection.delay == pipe.delay
        elif drawn.algorithm == "jacobi":
            assert connection.delay == 1
        else:
            assert (connection.delay == 1) == (connection in plan.closing)
    for connection in plan.connections:
        if connection.delay == 0:
            assert plan.order.index(connection.source_instance) < plan.order.index(connection.target_instance)


@given(systems())
def test_every_instance_is_stepped_by_one_unit_of_its_node(drawn: Drawn) -> None:
    plan = planned(drawn)

    for name, node in plan.nodes.items():
        members = [instance.name for instance in node.instances]
        assert members == [instance for instance in plan.order if name != RECORDER and plan.node_of(instance) == name]
        assert sorted(instance for unit in node.units for instance in unit) == sorted(members)
        assert all(len(unit) == 1 or set(unit) in [set(cycle) for cycle in plan.cycles] for unit in node.units)


@given(systems())
def test_every_value_that_another_node_needs_has_one_link(drawn: Drawn) -> None:
    plan = planned(drawn)

    links = [link for node in plan.nodes.values() for link in node.links_out]
    assert sorted(link.index for link in links) == list(range(len(links)))
    assert sorted(links, key=lambda link: link.index) == sorted(
        (link for node in plan.nodes.values() for link in node.links_in), key=lambda link: link.index
    )
    needed = {
        (c.source_instance, plan.node_of(c.target_instance), c.source.name)
        for c in plan.connections
        if plan.node_of(c.source_instance) != plan.node_of(c.target_instance)
    } | {(instance, RECORDER, variable) for instance, variable in plan.system.recorded}
    assert {(link.source, link.target_node, name) for link in links for name in link.layout.names} == needed


@given(systems())
def test_a_plan_is_function_of_system_and_survives_way_to_another_process(drawn: Drawn) -> None:
    plan, again = planned(drawn), planned(drawn)

    assert (plan.digest, plan.nodes) == (again.digest, again.nodes)
    assert (plan.order, plan.closing) == (again.order, again.closing)
    for node in plan.nodes.values():
        assert node.digest == plan.digest
        assert msgspec.json.decode(msgspec.json.encode(node), type=NodePlan, dec_hook=decode_section) == node


@given(systems(), st.integers(0, 100))
def test_a_plan_with_another_step_size_has_another_digest(drawn: Drawn, which: int) -> None:
    steps = list(drawn.steps)
    steps[which % len(steps)] += 1

    assert planned(msgspec.structs.replace(drawn, steps=tuple(steps))).digest != planned(drawn).digest


@given(systems())
def test_initial_values_are_known_before_they_are_needed(drawn: Drawn) -> None:
    plan = planned(drawn)
    levels = plan.initialization.levels
    torn = {(tear.target, tear.input): loop for loop in plan.initialization.loops for tear in loop.tears}

    assert {(c.source_instance, c.source.name) for c in plan.connections} == set(levels)
    for connection in plan.connections:
        target = (connection.target_instance, connection.target.name)
        if target in torn:
            assert connection.delay == 1
            assert torn[target].first <= levels[connection.source_instance, connection.source.name] <= torn[target].last
            continue
        for (instance, output), level in levels.items():
            depends = plan.system.instances[instance].description.variable(output)
            if instance == target[0] and depends is not None and depends.dependencies is None:
                assert levels[connection.source_instance, connection.source.name] < level


@given(systems())
def test_every_output_of_a_loop_is_reached_from_every_other_alone(drawn: Drawn) -> None:
    plan = planned(drawn)
    levels = plan.initialization.levels

    for loop in plan.initialization.loops:
        between = {key for key, level in levels.items() if loop.first <= level <= loop.last}
        assert between == set(loop.outputs)
        assert loop.tears
        for node in loop.nodes:
            own = plan.nodes[node]
            assert loop in own.loops
            known = {(link.source, name) for link in own.links_in for name in link.layout.names}
            known |= {(member.name, name) for member in own.instances for name in member.outputs.names}
            assert {(tear.source, tear.output) for tear in loop.tears} <= known
