"""In which order connected values become known in Initialization Mode.

Each connected output gets a level: 0 if it depends on no connected input there, otherwise one more than the highest
level among the outputs that feed the inputs it depends on (FMI 2.0, 2.2.8, InitialUnknowns). A loop among them is
opened at its delayed connections: those inputs keep their start value until the first step, and `check` shows it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import msgspec

from .description import Variable
from .graph import strongly_connected
from .system import Connection

__all__ = ["InitializationPlan", "plan_initialization"]

Key = tuple[str, str]


class InitializationPlan(msgspec.Struct, frozen=True):
    """Levels of connected outputs, and the inputs that keep their start value.

    Attributes:
        levels: level by (instance, output).
        held: (instance, input, or element of an input) of connections that are not propagated in Initialization Mode.
    """

    levels: dict[Key, int]
    held: tuple[Key, ...]


def plan_initialization(
    connections: Sequence[Connection],
) -> InitializationPlan:
    """Levels of all connected outputs. Every loop must contain a connection with delay 1."""
    outputs: dict[Key, Variable] = {(c.source_instance, c.source.name): c.source for c in connections}
    held: list[Key] = []
    used = list(connections)
    while True:
        edges = _edges(outputs, used)
        loops = [part for part in strongly_connected(outputs, edges) if len(part) > 1 or (part[0], part[0]) in edges]
        if not loops:
            break
        looping = {key: number for number, part in enumerate(loops) for key in part}
        cut = [c for c in used if c.delay == 1 and _inside(c, looping, edges)]
        held += [(c.target_instance, c.target_name) for c in cut]
        used = [c for c in used if c not in cut]
    levels: dict[Key, int] = {}
    predecessors: dict[Key, list[Key]] = {key: [] for key in outputs}
    for source, target in edges:
        predecessors[target].append(source)
    for part in strongly_connected(outputs, edges):
        key = part[0]
        levels[key] = 1 + max((levels[source] for source in predecessors[key]), default=-1)
    return InitializationPlan(levels=levels, held=tuple(held))


def _edges(outputs: Mapping[Key, Variable], connections: Sequence[Connection]) -> list[tuple[Key, Key]]:
    """Edges from an output to the outputs that depend on it through one connection."""
    edges = []
    for c in connections:
        for instance, name in outputs:
            if instance != c.target_instance:
                continue
            known = outputs[(instance, name)].dependencies
            if known is None or c.target.name in known:
                edges.append(((c.source_instance, c.source.name), (instance, name)))
    return edges


def _inside(connection: Connection, looping: Mapping[Key, int], edges: Sequence[tuple[Key, Key]]) -> bool:
    """Whether a connection lies on a loop: its source and an output that depends on its target are in one component."""
    source = (connection.source_instance, connection.source.name)
    if source not in looping:
        return False
    return any(
        first == source and second[0] == connection.target_instance and looping.get(second) == looping[source]
        for first, second in edges
    )
