"""Which values go from node to node: one link for each instance and node that needs values of it."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import msgspec

from .initialization_plan import InitializationPlan
from .layout import Layout
from .memory_map import RECORDER
from .system import ResolvedSystem

__all__ = ["Link", "links_of"]


class Link(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The frames of one instance for one node. Each link has its own columns and is flushed separately.

    Attributes:
        index: number of the link in the mesh; every frame has it.
        levels: initialization level of each column, in the order of `layout.names`; -1: not needed in initialization.
        initial_only: whether it has no frames after Initialization Mode: it has values for parameters, or those of a
            loop. A node that takes part in the iteration of a loop needs the values of all its torn connections, also
            of those between other nodes.
    """

    index: int
    source: str
    source_node: str
    target_node: str
    step_points: int
    layout: Layout
    levels: tuple[int, ...]
    initial_only: bool = False


def links_of(
    system: ResolvedSystem,
    reads: Iterable[tuple[str, str, str]],
    initialization: InitializationPlan,
    kept: Mapping[str, Iterable[str]],
) -> tuple[Link, ...]:
    """One link per instance and other node that needs its outputs: to the recorder last, then the initial ones.

    Steps need what ``reads`` has: source instance, column, target instance. The recorder also needs the columns of
    instances that are ``kept``, to play their rows.
    """
    node_of = {name: own.node for name, own in system.instances.items()}
    needed: dict[tuple[str, str], set[str]] = {}
    for source, column, target in reads:
        if node_of[target] != node_of[source]:
            needed.setdefault((source, node_of[target]), set()).add(system.base_of(source, column))
    for name, variable in system.recorded:
        needed.setdefault((name, RECORDER), set()).add(system.base_of(name, variable))
    for name, columns in kept.items():
        if own := {*columns}:
            needed.setdefault((name, RECORDER), set()).update(own)
    links = []
    ends = sorted(needed, key=lambda end: (end[0], end[1] == RECORDER, end[1]))
    initial = _needed_initially(system, initialization, needed)
    for index, (source, target_node) in enumerate([*ends, *sorted(initial)]):
        names = needed[source, target_node] if index < len(ends) else initial[source, target_node]
        instance = system.instances[source]
        layout = Layout.of(v for v in instance.description.variables if v.name in names)
        levels = initialization.levels
        links.append(
            Link(
                index=index,
                source=source,
                source_node=instance.node,
                target_node=target_node,
                step_points=instance.step_points,
                layout=layout,
                levels=tuple(
                    -1 if target_node == RECORDER else levels.get((source, name), -1) for name in layout.names
                ),
                initial_only=index >= len(ends),
            )
        )
    return tuple(links)


def _needed_initially(
    system: ResolvedSystem, initialization: InitializationPlan, needed: dict[tuple[str, str], set[str]]
) -> dict[tuple[str, str], set[str]]:
    """What a node needs for parameters or to iterate a loop and no other link has, by (instance, node)."""
    node_of = {name: own.node for name, own in system.instances.items()}
    initial: dict[tuple[str, str], set[str]] = {}
    for c in system.connections:
        node = node_of[c.target_instance]
        own = c.source_instance, node
        if c.initial_only and node != node_of[c.source_instance] and c.source.name not in needed.get(own, ()):
            initial.setdefault(own, set()).add(c.source.name)
    for loop in initialization.loops:
        for node in loop.nodes:
            for tear in loop.tears:
                output = system.base_of(tear.source, tear.output)
                if node != node_of[tear.source] and output not in needed.get((tear.source, node), ()):
                    initial.setdefault((tear.source, node), set()).add(output)
    return initial
