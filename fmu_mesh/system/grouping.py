"""`group: auto`: the instances of each cycle share one node.

In a cycle, each point needs values of another member from the same point or the point before. Between two nodes this
costs a message in each direction; within one node it is a copy in memory. Outside of cycles data flows one way, and
parallel nodes are faster. So each cycle gets one node, and every other instance its own.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

from ..config.mesh import Config
from ..variables.model_description import ModelDescription
from .graph import strongly_connected

__all__ = ["automatic_nodes"]

_SUFFIX = "-cycle"


def automatic_nodes(
    config: Config, edges: Iterable[tuple[str, str]], descriptions: Mapping[str, ModelDescription]
) -> dict[str, str]:
    """The names of the nodes that several instances of a cycle share, by instance. Other instances are not in it.

    An instance with a ``group`` of its own stays there. Instances with different hosts or interpreters never share a
    node, nor do two of an FMU that allows one instance per process.

    Args:
        config: the configuration, whatever its own ``group`` says.
        edges: (source instance, target instance) of every connection.
        descriptions: model descriptions by instance name.
    """
    position = {name: place for place, name in enumerate(config.instances)}
    taken = {*config.instances, *(instance.group for instance in config.instances.values() if instance.group)}
    nodes: dict[str, str] = {}
    cycles = [sorted(part, key=position.__getitem__) for part in strongly_connected(config.instances, edges)]
    for cycle in sorted(cycles, key=lambda members: position[members[0]]):
        for members in _together(config, [n for n in cycle if config.instances[n].group is None], descriptions):
            if len(members) > 1:
                name = _free_name(members[0], taken)
                taken.add(name)
                nodes.update(dict.fromkeys(members, name))
    return nodes


def _together(
    config: Config, cycle: Sequence[str], descriptions: Mapping[str, ModelDescription]
) -> Iterable[list[str]]:
    """The members of a cycle in as few nodes as hosts and FMUs allow."""
    parts: list[tuple[tuple[str | None, str | None], set[str], list[str]]] = []
    for name in cycle:
        section, description = config.instances[name], descriptions[name]
        where = (section.host, section.interpreter)
        guid = description.guid if description.only_once_per_process else ""
        part = next((part for part in parts if part[0] == where and guid not in part[1]), None)
        if part is None:
            part = (where, set(), [])
            parts.append(part)
        if guid:
            part[1].add(guid)
        part[2].append(name)
    return [members for _, _, members in parts]


def _free_name(first: str, taken: set[str]) -> str:
    name, number = first + _SUFFIX, 2
    while name in taken:
        name, number = f"{first}{_SUFFIX}-{number}", number + 1
    return name
