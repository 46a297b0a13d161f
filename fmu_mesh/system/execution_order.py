"""In which order instances step within one point, and the delay of every connection (docs/architecture.md)."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import NamedTuple

from msgspec.structs import replace

from ..config.findings import Findings
from .connections import Connection
from .graph import cycle_through, feedback_edges, is_cycle, strongly_connected, topological_order

__all__ = ["ExecutionOrder", "execution_order"]


class ExecutionOrder(NamedTuple):
    """See `Plan` for its fields."""

    connections: tuple[Connection, ...]
    closing: tuple[Connection, ...]
    order: tuple[str, ...]
    cycles: tuple[tuple[str, ...], ...]


def execution_order(
    names: Collection[str], connections: Sequence[Connection], algorithm: str, findings: Findings
) -> ExecutionOrder:
    """The connections between instances with their delays, the order of the instances, and the cycles.

    Raises:
        ConfigurationError: there is one; has all findings.
    """
    connections, closing = _with_delays(names, connections, algorithm)
    instant = [(c.source_instance, c.target_instance) for c in connections if c.delay == 0]
    loops = [loop for loop in strongly_connected(names, instant) if is_cycle(loop, instant)]
    for loop in loops:
        _add_algebraic_loop(loop, connections, findings)
    if loops:
        findings.raise_any()
    edges = [(c.source_instance, c.target_instance) for c in connections if not c.initial_only]
    order = topological_order(names, instant)
    cycles = tuple(tuple(part) for part in strongly_connected(names, edges) if is_cycle(part, edges))
    return ExecutionOrder(connections, closing, tuple(order), cycles)


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
