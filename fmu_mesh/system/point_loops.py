"""Loops at every point: cycles of connections on which every output depends directly on the input before it.

Owns the warnings about them: a delay makes such a loop a fixed-point iteration in time, with one sweep per point. In
Initialization Mode loops are iterated to the end (`fmu_mesh.system.initialization_plan`).
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Literal

from ..config.findings import Findings
from ..text import listed
from .graph import cycle_through, strongly_connected
from .plan import Plan
from .solved_groups import blocks_of, is_solved
from .system import Connection

__all__ = ["warn_of_point_loops"]

Vertex = tuple[str, Literal["output", "input", "any input"], str]
"""Instance, what it is, and name. `any input` is what outputs depend on that declare nothing."""

Edges = dict[tuple[Vertex, Vertex], Connection | None]
"""The connections, and None for the edges within instances."""


def warn_of_point_loops(plan: Plan, findings: Findings) -> None:
    """Add a warning for each loop at every point, and one for outputs that may close one; none if they are solved."""
    blocks = blocks_of(plan.system.config.members)
    is_delayed = plan.system.config.simulation.loops == "delayed"
    delayed = [c for c in plan.connections if not is_solved(c, blocks)]
    declared, assumed = _edges(delayed) if plan.cycles and is_delayed else ({}, {})
    for loop, inside in _loops(declared):
        walk, more = _walk(loop, inside)
        found = (
            f"a loop at every point: {listed([*map(str, walk)])}{more}. Each of these outputs depends directly on the "
            f"input before it. The delay of 1 at {listed([str(c) for c in walk if c.delay])} makes this a fixed-point "
            "iteration in time, one sweep per point, which may be unstable: compare with a smaller step size, or solve "
            "it by `loops: solved` in `simulation`"
        )
        findings.add(walk[0].path, found, "")
    both = declared | assumed
    members = {one for loop, _ in _loops(both) for one in loop}
    silent = [end for start, end in assumed if start[1] == "any input" and end in members]
    if silent:
        walk, _ = _walk([silent[0], *members], both)
        names = listed([f"{instance}.{name}" for instance, _, name in silent])
        each = " declares nothing, so it" if len(silent) == 1 else ": each declares nothing, so it"
        found = (
            f"{names}{each} may close a loop at every point, such as {listed([*map(str, walk)])}. An FMU declares what "
            "an output depends on by `dependencies` in its ModelStructure, a component by `depends_on`"
        )
        findings.add(walk[0].path, found, "")


def _edges(connections: Sequence[Connection]) -> tuple[Edges, Edges]:
    """What is connected or declared to depend on each other, and what may do so, since nothing is declared."""
    declared: Edges = {}
    assumed: Edges = {}
    changing = [c for c in connections if not c.initial_only and c.source.changes]
    inputs: dict[str, dict[Vertex, None]] = {}
    for c in changing:
        target: Vertex = c.target_instance, "input", c.target.name
        inputs.setdefault(c.target_instance, {})[target] = None
        declared.setdefault(((c.source_instance, "output", c.source.name), target), c)
    for instance, own in {(c.source_instance, c.source.name): (c.source_instance, c.source) for c in changing}.values():
        source: Vertex = instance, "output", own.name
        if own.feedthrough is None:
            assumed[_any_input(instance), source] = None
        else:
            known: list[Vertex] = [(instance, "input", name) for name in own.feedthrough]
            declared |= {(one, source): None for one in known if one in inputs.get(instance, ())}
    for instance in {source[0]: None for _, source in assumed}:
        assumed |= {(one, _any_input(instance)): None for one in inputs.get(instance, ())}
    return declared, assumed


def _any_input(instance: str) -> Vertex:
    return instance, "any input", ""


def _loops(edges: Edges) -> list[tuple[list[Vertex], Edges]]:
    """The strongly connected components with a cycle, and their edges: no vertex has an edge to itself."""
    vertices = dict.fromkeys(vertex for ends in edges for vertex in ends)
    loops: list[tuple[list[Vertex], Edges]] = [(p, {}) for p in strongly_connected(vertices, edges) if len(p) > 1]
    of = {vertex: inside for loop, inside in loops for vertex in loop}
    for (start, end), connection in edges.items():
        if start in of and of[start] is of.get(end):
            of[start][start, end] = connection
    return loops


def _walk(loop: Sequence[Vertex], edges: Edges) -> tuple[list[Connection], str]:
    """The connections of a shortest cycle through the first vertex, a delayed one last, and how many more there are."""
    vertices = cycle_through(loop, edges)
    walk = [c for ends in pairwise(vertices) if (c := edges[ends]) is not None]
    last = max(place for place, c in enumerate(walk, 1) if c.delay)
    more = sum(c is not None for c in edges.values()) - len(walk)
    return walk[last:] + walk[:last], f" and {more} more connections between them" if more else ""
