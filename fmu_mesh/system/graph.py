"""Algorithms on directed graphs. Each result depends only on the arguments and their order."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Collection, Hashable, Iterable, Mapping, Sequence
from typing import TypeVar

__all__ = ["cycle_through", "feedback_edges", "reaches", "strongly_connected", "topological_order"]

V = TypeVar("V", bound=Hashable)


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
    order = list(vertices)
    position = {vertex: place for place, vertex in enumerate(order)}
    missing = {vertex: set[V]() for vertex in order}
    for source, target in edges:
        missing[target].add(source)
    done: set[V] = set()
    result: list[V] = []
    while len(result) < len(order):
        ready = [vertex for vertex in order if vertex not in done and missing[vertex] <= done]
        if not ready:
            msg = "the graph has a cycle"
            raise ValueError(msg)
        first = min(ready, key=position.__getitem__)
        done.add(first)
        result.append(first)
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
    frontier = [start]
    while frontier:
        following = []
        for vertex in frontier:
            for target in successors[vertex]:
                if target == start:
                    walk = [vertex]
                    while walk[-1] != start:
                        walk.append(before[walk[-1]])
                    return [*reversed(walk), start]
                if target not in before:
                    before[target] = vertex
                    following.append(target)
        frontier = following
    msg = "no cycle leads through the first vertex"
    raise ValueError(msg)
