"""In which order instances step within one point, and the delay of every connection (docs/architecture.md)."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from typing import NamedTuple

from msgspec.structs import replace

from ..config.findings import Findings
from .connections import Connection
from .coupling_rule import Consistent
from .feeds import consistent_columns
from .graph import cycle_through, feedback_edges, is_cycle, strongly_connected, topological_order

__all__ = ["ExecutionOrder", "execution_order"]


class ExecutionOrder(NamedTuple):
    """See `Plan` for its fields."""

    connections: tuple[Connection, ...]
    closing: tuple[Connection, ...]
    order: tuple[str, ...]
    cycles: tuple[tuple[str, ...], ...]


def execution_order(
    names: Collection[str],
    connections: Sequence[Connection],
    algorithm: str,
    findings: Findings,
    consistent: Mapping[tuple[str, str], Consistent] | None = None,
) -> ExecutionOrder:
    """The connections between instances with their delays, the order of the instances, and the cycles.

    If outputs are made ``consistent`` (`loops: solved`), all connections of a cycle have a delay of 1.

    Raises:
        ConfigurationError: there is one; has all findings.
    """
    if consistent is not None:
        connections = _delayed_within(names, connections, findings)
    connections, closing = _with_delays(names, connections, algorithm)
    instant = [(c.source_instance, c.target_instance) for c in connections if c.delay == 0]
    loops = [loop for loop in strongly_connected(names, instant) if is_cycle(loop, instant)]
    for loop in loops:
        _add_algebraic_loop(loop, connections, findings)
    if loops:
        findings.raise_any()
    edges = [(c.source_instance, c.target_instance) for c in connections if not c.initial_only]
    for c in connections if consistent else ():
        if c.delay == 0:
            instant += [(source, c.target_instance) for source, _, _ in consistent_columns(c, consistent or {})]
    order = topological_order(names, instant)
    cycles = tuple(tuple(part) for part in strongly_connected(names, edges) if is_cycle(part, edges))
    return ExecutionOrder(connections, closing, tuple(order), cycles)


def _delayed_within(
    names: Collection[str], connections: Sequence[Connection], findings: Findings
) -> tuple[Connection, ...]:
    """The connections with a delay of 1 for those within a cycle; a finding for each of them that has another one."""
    edges = [(c.source_instance, c.target_instance) for c in connections if not c.initial_only]
    parts = [part for part in strongly_connected(names, edges) if is_cycle(part, edges)]
    of = {name: number for number, part in enumerate(parts) for name in part}
    found = []
    for c in connections:
        number = of.get(c.source_instance)
        within = number is not None and number == of.get(c.target_instance) and not c.initial_only
        if within and c.delay == 0:
            findings.add(f"{c.path}.delay", f"0 for {c}, within a cycle whose loops are solved", "1, or no `delay`")
        found.append(replace(c, delay=1) if within else c)
    return tuple(found)


def _with_delays(
    names: Collection[str], given: Sequence[Connection], algorithm: str
) -> tuple[tuple[Connection, ...], tuple[Connection, ...]]:
    """All connections with a delay of 0 or 1, and those that got 1 because they close a cycle.

    A connection to a parameter keeps None: it has no part in the steps.
    """
    if algorithm == "jacobi":
        return tuple(replace(c, delay=1) if c.delay is None and not c.initial_only else c for c in given), ()
    free = [c for c in given if c.delay != 1 and not c.initial_only]
    edges = [(c.source_instance, c.target_instance, c.delay is None) for c in free]
    closing = {id(free[index]) for index in feedback_edges(names, edges)}
    connections = []
    for connection in given:
        delay = connection.delay
        if delay is None and not connection.initial_only:
            delay = 1 if id(connection) in closing else 0
        connections.append(replace(connection, delay=delay))
    chosen = tuple(new for old, new in zip(given, connections, strict=True) if id(old) in closing)
    return tuple(connections), chosen


def _add_algebraic_loop(loop: list[str], connections: tuple[Connection, ...], findings: Findings) -> None:
    """Add a finding for a cycle on which every connection has delay 0."""
    edges = [(c.source_instance, c.target_instance) for c in connections if c.delay == 0]
    walk = cycle_through(loop, edges)
    first = next(
        c for c in connections if c.delay == 0 and (c.source_instance, c.target_instance) == (walk[0], walk[1])
    )
    found = f"an algebraic loop: every connection on the cycle {' -> '.join(walk)} has delay 0"
    expected = "at least one connection with delay 1 (set `delay: 1`, or leave the delays to the algorithm)"
    findings.add(first.path, found, expected)
