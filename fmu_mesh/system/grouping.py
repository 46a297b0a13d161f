"""`group: auto`: the instances of each cycle share one node.

In a cycle, each point needs values of another member from the same point or the point before. Between two nodes this
costs a message in each direction; within one node it is a copy in memory. Outside of cycles data flows one way, and
parallel nodes are faster. So each cycle gets one node, and every other instance its own.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from functools import partial

from ..config.mesh import Config
from .graph import strongly_connected
from .process_sharing import ClaimsOf, SharedProcess

__all__ = ["automatic_nodes"]

_SUFFIX = "-cycle"


def automatic_nodes(config: Config, edges: Iterable[tuple[str, str]], claims: ClaimsOf) -> dict[str, str]:
    """The names of the nodes that several instances of a cycle share, by instance. Other instances are not in it.

    An instance with a ``group`` of its own stays there. Instances with different hosts or interpreters never share a
    node, nor do two that cannot share a process (`fmu_mesh.system.process_sharing`). The edges are those of all
    connections between instances.
    """
    position = {name: place for place, name in enumerate(config.instances)}
    taken = {*config.instances, *(instance.group for instance in config.instances.values() if instance.group)}
    nodes: dict[str, str] = {}
    cycles = [sorted(part, key=position.__getitem__) for part in strongly_connected(config.instances, edges)]
    for cycle in sorted(cycles, key=lambda members: position[members[0]]):
        for members in _together(config, [n for n in cycle if config.instances[n].group is None], claims):
            if len(members) > 1:
                name = _free_name(members[0], taken)
                taken.add(name)
                nodes.update(dict.fromkeys(members, name))
    return nodes


def _together(config: Config, cycle: Sequence[str], claims: ClaimsOf) -> Iterable[list[str]]:
    """The members of a cycle in as few nodes as hosts, interpreters and claims allow."""
    parts: list[tuple[tuple[str | None, str | None], SharedProcess, list[str]]] = []
    for name in cycle:
        where = (config.instances[name].host, config.instances[name].interpreter)
        own = partial(claims, name)
        part = next((part for part in parts if part[0] == where and part[1].refusal(name, own) is None), None)
        if part is None:
            part = (where, SharedProcess(), [])
            part[1].refusal(name, own)
            parts.append(part)
        part[2].append(name)
    return [members for _, _, members in parts]


def _free_name(first: str, taken: set[str]) -> str:
    name, number = first + _SUFFIX, 2
    while name in taken:
        name, number = f"{first}{_SUFFIX}-{number}", number + 1
    return name
