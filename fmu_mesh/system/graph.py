"""Algorithms on directed graphs. Each result depends only on the arguments and their order."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Collection, Hashable, Iterable, Mapping, Sequence
from graphlib import TopologicalSorter
from typing import Final, TypeVar

__all__ = [
    "cycle_through",
    "feedback_edges",
    "fewest_feedback_edges",
    "reaches",
    "strongly_connected",
    "topological_order",
]

V = TypeVar("V", bound=Hashable)

_EXACT: Final = 10
"""Up to so many vertices the best choice is searched: 2^10 sets of vertices take some 10 ms."""


def strongly_connected(vertices: Iterable[V], edges: Iterable[tuple[V, V]]) -> list[list[V]]:
    """The strongly connected components (Tarjan, without recursion), sources before targets."""
    successors: dict[V, list[V]] = {vertex: [] for vertex in vertices}
    for source, target in edges:
        successors[source].append(target)
    index: dict[V, int] = {}
    low: dict[V, int] = {}
    stack: list[V] = []
    on_stack: set[V] = set()
    components: list[list[V]] = []
    for root, first in successors.items():
        if root in index:
            continue
        work = [(root, iter(first))]
        index[root] = low[root] = len(index)
        stack.append(root)
        on_stack.add(root)
        while work:
            vertex, following = work[-1]
            for target in following:
                if target not in index:
                    index[target] = low[target] = len(index)
                    stack.append(target)
                    on_stack.add(target)
                    work.append((target, iter(successors[target])))
                    break
                if target in on_stack:
                    low[vertex] = min(low[vertex], index[target])
            else:
                work.pop()
                if work:
                    parent = work[-1][0]
                    low[parent] = min(low[parent], low[vertex])
                if low[vertex] == index[vertex]:
                    cut = bisect_left(stack, index[vertex], key=index.__getitem__)  # the stack is sorted by index
                    component = stack[cut:]
                    del stack[cut:]
                    on_stack.difference_update(component)
                    components.append(component)
    components.reverse()
    return components


def topological_order(vertices: Iterable[V], edges: Iterable[tuple[V, V]]) -> list[V]:
    """An order with every source before its targets; where the edges allow, in the order of ``vertices``.

    Raises:
        ValueError: the graph has a cycle.
    """
    position = {vertex: place for place, vertex in enumerate(vertices)}
    sorter = TopologicalSorter[V](dict.fromkeys(position, ()))
    for source, target in edges:
        sorter.add(target, source)
    sorter.prepare()  # raises a CycleError, which is a ValueError
    ready: set[V] = set()
    result: list[V] = []
    while sorter.is_active():
        ready.update(sorter.get_ready())
        result.append(min(ready, key=position.__getitem__))
        ready.remove(result[-1])
        sorter.done(result[-1])
    return result


def feedback_edges(vertices: Iterable[V], edges: Sequence[tuple[V, V, bool]]) -> list[int]:
    """Indices of edges to remove so that no cycle is left.

    Only edges whose flag is true may be removed; a cycle of the others stays. The others are added to an empty graph
    first, then those with the flag in their order. An edge that would close a cycle is not added but returned. So it is
    the connection written last that closes a cycle.
    """
    successors: dict[V, dict[V, None]] = {vertex: {} for vertex in vertices}  # there may be many equal edges
    for source, target, free in edges:
        if not free:
            successors[source][target] = None
    removed = []
    for index, (source, target, free) in enumerate(edges):
        if free and reaches(successors, target, source):
            removed.append(index)
        elif free:
            successors[source][target] = None
    return removed


def fewest_feedback_edges(vertices: Iterable[V], edges: Sequence[tuple[V, V, bool]]) -> list[int]:
    """As `feedback_edges`, but as few as possible, and of these choices the last ones.

    Of two choices with as few edges, it is the one that keeps the first edge of those in which they differ. Where more
    than `_EXACT` vertices reach one another, the choice is that of `feedback_edges`.
    """
    order = list(vertices)
    removed = feedback_edges(order, edges)
    part_of: dict[V, int] = {}
    for number, part in enumerate(strongly_connected(order, [edge[:2] for edge in edges])):
        part_of |= dict.fromkeys(part, number)
    parts: dict[int, list[int]] = {}
    for index, (source, target, _) in enumerate(edges):
        if part_of[source] == part_of[target] and source != target:
            parts.setdefault(part_of[source], []).append(index)
    for number, within in parts.items():
        place = {index: position for position, index in enumerate(within)}
        own = [place[index] for index in removed if index in place]
        members = [vertex for vertex in order if part_of[vertex] == number]
        if len(own) > 1 and len(members) <= _EXACT:
            fewer = _fewest(members, [edges[index] for index in within])
            removed = [index for index in removed if index not in place] + [within[position] for position in fewer]
    return sorted(removed)


def _fewest(vertices: Sequence[V], edges: Sequence[tuple[V, V, bool]]) -> list[int]:
    """The best choice of all: by the best order of each set of vertices (Held and Karp).

    The cost of an order is a number whose digits say which edges go back in it, below the number of these edges.
    """
    place = {vertex: number for number, vertex in enumerate(vertices)}
    one = 1 << len(edges)
    costs = [[0] * len(place) for _ in place]
    for index, (source, target, free) in enumerate(edges):
        costs[place[source]][place[target]] += one + (one >> (index + 1)) if free else one * one
    best = [0]
    for members in range(1, 1 << len(place)):
        own = [vertex for vertex in range(len(place)) if members >> vertex & 1]
        best.append(min(best[members & ~(1 << last)] + sum(costs[last][vertex] for vertex in own) for last in own))
    return [index for index in range(len(edges)) if best[-1] & (one >> (index + 1))]


def reaches(successors: Mapping[V, Iterable[V]], start: V, goal: V) -> bool:
    """Whether there is a path from ``start`` to ``goal``. Every vertex reaches itself."""
    visited = {start}
    stack = [start]
    while stack:
        vertex = stack.pop()
        if vertex == goal:
            return True
        for target in successors[vertex]:
            if target not in visited:
                visited.add(target)
                stack.append(target)
    return False


def is_cycle(component: Sequence[V], edges: Collection[tuple[V, V]]) -> bool:
    """Whether a strongly connected component has a cycle: a single vertex needs an edge to itself."""
    return len(component) > 1 or (component[0], component[0]) in edges


def cycle_through(component: Sequence[V], edges: Iterable[tuple[V, V]]) -> list[V]:
    """The vertices of a shortest cycle that starts and ends at the first vertex of a component."""
    start = component[0]
    members = set(component)
    successors: dict[V, list[V]] = {vertex: [] for vertex in component}
    for source, target in edges:
        if source in members and target in members:
            successors[source].append(target)
    before: dict[V, V] = {}
    found = [start]
    for vertex in found:  # which grows: near vertices come before far ones
        for target in successors[vertex]:
            if target == start:
                walk = [vertex]
                while walk[-1] != start:
                    walk.append(before[walk[-1]])
                return [*reversed(walk), start]
            if target not in before:
                before[target] = vertex
                found.append(target)
    msg = "no cycle leads through the first vertex"
    raise ValueError(msg)
