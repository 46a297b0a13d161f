"""The delay of every connection, and the cycles that have none (docs/architecture.md)."""

from __future__ import annotations

from msgspec.structs import replace

from ..errors import Finding
from .graph import cycle_through, feedback_edges
from .system import Connection, ResolvedSystem

__all__ = ["algebraic_loop", "with_delays"]


def with_delays(system: ResolvedSystem) -> tuple[tuple[Connection, ...], tuple[Connection, ...]]:
    """All connections with a delay of 0 or 1, and those that got 1 because they close a cycle.

    A connection to a parameter keeps None: it has no part in the steps.
    """
    if system.config.simulation.algorithm == "jacobi":
        return tuple(
            replace(c, delay=1) if c.delay is None and not c.initial_only else c for c in system.connections
        ), ()
    free = [c for c in system.connections if c.delay != 1 and not c.initial_only]
    edges = [(c.source_instance, c.target_instance, c.delay is None) for c in free]
    closing = {id(free[index]) for index in feedback_edges(system.instances, edges)}
    connections = []
    for connection in system.connections:
        delay = connection.delay
        if delay is None and not connection.initial_only:
            delay = 1 if id(connection) in closing else 0
        connections.append(replace(connection, delay=delay))
    chosen = tuple(new for old, new in zip(system.connections, connections, strict=True) if id(old) in closing)
    return tuple(connections), chosen


def algebraic_loop(loop: list[str], connections: tuple[Connection, ...], file: str) -> Finding:
    """The finding for a cycle on which every connection has delay 0."""
    edges = [(c.source_instance, c.target_instance) for c in connections if c.delay == 0]
    walk = cycle_through(loop, edges)
    first = next(
        c for c in connections if c.delay == 0 and (c.source_instance, c.target_instance) == (walk[0], walk[1])
    )
    return Finding(
        file=file,
        path=first.path,
        found=f"an algebraic loop: every connection on the cycle {' -> '.join(walk)} has delay 0",
        expected="at least one connection with delay 1 (set `delay: 1`, or leave the delays to the algorithm)",
    )
