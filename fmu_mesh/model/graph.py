"""Directed graphs, as far as the plan needs them; everything is deterministic in the order of its arguments."""

from __future__ import annotations

from collections.abc import Hashable, Iterable, Sequence
from typing import TypeVar

__all__ = ["cycle_through", "feedback_edges", "strongly_connected", "topological_order"]

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
    for root in successors:
        if root in index:
            continue
        work = [(root, iter(successors[root]))]
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
                    cut = stack.index(vertex)
                    component = stack[cut:]
                    del stack[cut:]
                    on_stack.difference_update(component)
                    components.append(component)
    components.reverse()
    return components


def topological_order(vertices: Iterable[V], edges: Iterable[tuple[V, V]]) -> list[V]:
    """An order in which every source stands before its targets; otherwise the order of ``vertices`` is kept.

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
    """Indices of edges whose removal leaves no cycle, taken only from those whose flag says that they may be.

    Walks depth first in the order of ``vertices`` and of ``edges`` and takes the edges that lead back to a vertex on the
    current path; where such an edge must stay, the last free one on the path since that vertex is taken instead, if any.
    The choice is deterministic; cycles made of fixed edges only remain.
    """
    order = list(vertices)
    removed: set[int] = set()
    while True:
        cycle = _find_cycle(order, edges, removed)
        if cycle is None:
            return sorted(removed)
        free = [index for index in cycle if edges[index][2]]
        if not free:
            return sorted(removed)
        removed.add(free[-1])


def _find_cycle(order: list[V], edges: Sequence[tuple[V, V, bool]], removed: set[int]) -> list[int] | None:
    """Edge indices of the first cycle found, that has a free edge if any such cycle exists; the closing edge is last."""
    outgoing: dict[V, list[int]] = {vertex: [] for vertex in order}
    for index, (source, _, _) in enumerate(edges):
        if index not in removed:
            outgoing[source].append(index)
    fixed_only: list[int] | None = None
    state: dict[V, int] = {}
    for root in order:
        if root in state:
            continue
        path: list[int] = []
        state[root] = 1
        work = [(root, iter(outgoing[root]))]
        while work:
            vertex, following = work[-1]
            for index in following:
                target = edges[index][1]
                if state.get(target) == 1:
                    start = 0 if target == root else next(i for i, e in enumerate(path) if edges[e][1] == target) + 1
                    cycle = [*path[start:], index]
                    if any(edges[i][2] for i in cycle):
                        return cycle
                    fixed_only = fixed_only or cycle
                elif target not in state:
                    state[target] = 1
                    path.append(index)
                    work.append((target, iter(outgoing[target])))
                    break
            else:
                work.pop()
                state[vertex] = 2
                if path:
                    path.pop()
    return fixed_only


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
