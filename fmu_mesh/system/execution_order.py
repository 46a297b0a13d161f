"""In which order instances step within one point, and the delay of every connection (docs/architecture.md).

And which slow instances take their steps ahead of those that read them (ADR 96).
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from typing import NamedTuple

from msgspec.structs import replace

from ..config.findings import Findings
from .connections import Connection
from .coupling_rule import Consistent
from .feeds import consistent_columns
from .graph import cycle_through, feedback_edges, is_cycle, strongly_connected, topological_order
from .solved_groups import Blocks, within_block

__all__ = ["ExecutionOrder", "execution_order", "steps_ahead"]


class ExecutionOrder(NamedTuple):
    """See `Plan` for its fields."""

    connections: tuple[Connection, ...]
    closing: tuple[Connection, ...]
    order: tuple[str, ...]
    cycles: tuple[tuple[str, ...], ...]


def execution_order(  # noqa: PLR0913, PLR0917  what the order follows from
    names: Collection[str],
    connections: Sequence[Connection],
    algorithm: str,
    findings: Findings,
    blocks: Blocks,
    consistent: Mapping[tuple[str, str], Consistent] | None = None,
) -> ExecutionOrder:
    """The connections between instances with their delays, the order of the instances, and the cycles.

    If outputs are made ``consistent`` (`loops: solved`), all connections of a cycle have a delay of 1. So have those
    within a solved group, whose members follow one another; to all others such a group is one instance.

    Raises:
        ConfigurationError: there is one; has all findings.
    """
    vertices = [name for name in names if blocks.get(name, name) == name]
    connections = [replace(c, delay=1) if within_block(c, blocks) else c for c in connections]
    if consistent is not None:
        connections = _delayed_within(vertices, connections, blocks, findings)
    connections, closing = _with_delays(vertices, connections, algorithm, blocks)
    instant = _edges((c for c in connections if c.delay == 0), blocks)
    loops = [loop for loop in strongly_connected(vertices, instant) if is_cycle(loop, instant)]
    for loop in loops:
        _add_algebraic_loop(loop, connections, blocks, findings)
    if loops:
        findings.raise_any()
    edges = _edges((c for c in connections if not c.initial_only and not within_block(c, blocks)), blocks)
    for c in connections if consistent else ():
        if c.delay == 0:
            columns = consistent_columns(c, consistent or {})
            target = blocks.get(c.target_instance, c.target_instance)
            instant += [(blocks.get(source, source), target) for source, _ in columns]
    of = {vertex: [name for name in names if blocks.get(name, name) == vertex] for vertex in vertices}
    order = tuple(name for vertex in topological_order(vertices, instant) for name in of[vertex])
    parts = [part for part in strongly_connected(vertices, edges) if is_cycle(part, edges)]
    cycles = tuple(tuple(name for vertex in part for name in of[vertex]) for part in parts)
    return ExecutionOrder(tuple(connections), closing, order, cycles)


def steps_ahead(
    made: ExecutionOrder,
    step_points: Mapping[str, int],
    blocks: Blocks,
    consistent: Mapping[tuple[str, str], Consistent],
) -> tuple[tuple[Connection, ...], tuple[str, ...]]:
    """The connections, with those that read the end of a step of a slower source, and the instances that go ahead.

    Who goes ahead takes a step as soon as all are at its first point. So it needs no value of a later point: its inputs
    have a delay of 1, or come from others that go ahead, whose steps end with one of its own.
    """
    reads: dict[str, list[tuple[str, int | None]]] = {blocks.get(name, name): [] for name in made.order}
    sources: list[set[str]] = []
    for c in made.connections:
        columns = () if c.initial_only else consistent_columns(c, consistent)
        sources.append({blocks.get(source, source) for source, _ in columns})
        reads[blocks.get(c.target_instance, c.target_instance)] += [(source, c.delay) for source in sources[-1]]
    able, ahead = set[str](), set[str]()
    for name, own in reads.items():
        if all(delay or (source in able and step_points[source] % step_points[name] == 0) for source, delay in own):
            able.add(name)
    connections = []
    for c, own_sources in zip(made.connections, sources, strict=True):
        is_line = c.extrapolation in {"linear", "midpoint"} and c.delay == 0
        is_slower = step_points[c.source_instance] > step_points[c.target_instance]
        connections.append(replace(c, ahead=is_line and is_slower and own_sources <= able))
        ahead |= own_sources if connections[-1].ahead else set()
    for name in reversed(reads):
        if name in ahead:
            ahead |= {source for source, delay in reads[name] if not delay}
    return tuple(connections), tuple(name for name in made.order if blocks.get(name, name) in ahead)


def _edges(connections: Iterable[Connection], blocks: Blocks) -> list[tuple[str, str]]:
    ends = ((c.source_instance, c.target_instance) for c in connections)
    return [(blocks.get(source, source), blocks.get(target, target)) for source, target in ends]


def _delayed_within(
    vertices: Collection[str], connections: Sequence[Connection], blocks: Blocks, findings: Findings
) -> tuple[Connection, ...]:
    """The connections with a delay of 1 for those within a cycle; a finding for each of them that has another one."""
    edges = _edges((c for c in connections if not c.initial_only and not within_block(c, blocks)), blocks)
    parts = [part for part in strongly_connected(vertices, edges) if is_cycle(part, edges)]
    of = {name: number for number, part in enumerate(parts) for name in part}
    found = []
    for c in connections:
        source, target = _edges([c], blocks)[0]
        number = of.get(source)
        within = number is not None and number == of.get(target) and not c.initial_only
        if within and c.delay == 0:
            findings.add(f"{c.path}.delay", f"0 for {c}, within a cycle whose loops are solved", "1, or no `delay`")
        found.append(replace(c, delay=1) if within else c)
    return tuple(found)


def _with_delays(
    vertices: Collection[str], given: Sequence[Connection], algorithm: str, blocks: Blocks
) -> tuple[tuple[Connection, ...], tuple[Connection, ...]]:
    """All connections with a delay of 0 or 1, and those that got 1 because they close a cycle.

    A connection to a parameter keeps None: it has no part in the steps.
    """
    if algorithm == "jacobi":
        return tuple(replace(c, delay=1) if c.delay is None and not c.initial_only else c for c in given), ()
    free = [c for c in given if c.delay != 1 and not c.initial_only]
    edges = [(*ends, c.delay is None) for ends, c in zip(_edges(free, blocks), free, strict=True)]
    closing = {id(free[index]) for index in feedback_edges(vertices, edges)}
    connections = []
    for connection in given:
        delay = connection.delay
        if delay is None and not connection.initial_only:
            delay = 1 if id(connection) in closing else 0
        connections.append(replace(connection, delay=delay))
    chosen = tuple(new for old, new in zip(given, connections, strict=True) if id(old) in closing)
    return tuple(connections), chosen


def _add_algebraic_loop(loop: list[str], connections: Sequence[Connection], blocks: Blocks, findings: Findings) -> None:
    """Add a finding for a cycle on which every connection has delay 0."""
    instant = [c for c in connections if c.delay == 0]
    edges = _edges(instant, blocks)
    walk = cycle_through(loop, edges)
    first = instant[edges.index((walk[0], walk[1]))]
    found = f"an algebraic loop: every connection on the cycle {' -> '.join(walk)} has delay 0"
    expected = "at least one connection with delay 1 (set `delay: 1`, or leave the delays to the algorithm)"
    findings.add(first.path, found, expected)
