"""What may share a process: the one rule that groups, `group: auto`, `--local`, `open`, `repeated` and sweeps use.

A process has one library of each name, one variable for each symbol that C++ declares unique, and one interpreter of
Python. An instance *claims* what it uses of that kind. Two instances with one claim share a process only if both mean
the same content by it. The kinds say what an instance claims; this module decides, and knows no kind.

With `group: auto`, the instances of each cycle share one node. In a cycle, each point needs values of another member
from the same point or the point before. Between two nodes this costs a message in each direction; within one node it is
a copy in memory. Outside of cycles data flows one way, and parallel nodes are faster: every other instance has its own.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial

from ..config.group_section import group_name
from ..config.mesh import Config
from .graph import strongly_connected

__all__ = ["BOTH_USE_PYTHON", "Claims", "ClaimsOf", "SharedProcess", "automatic_nodes"]

Claims = Mapping[str, str]
"""By the reason why two instances cannot share a process, in words: the content with which they can.

An empty content is equal to no other one, not even to that of the same model.
"""
ClaimsOf = Callable[[str], Claims]
"""What an instance claims, by its name. The files of its model are read for it, so nobody asks without need."""

BOTH_USE_PYTHON = "both use the interpreter of Python, of which a process has one"
"""A claim of FMUs that embed Python, and of components: an FMU changes where Python looks for modules."""

_SUFFIX = "-cycle"


class SharedProcess:
    """The instances that one process runs, at a time or one after another.

    Example:
        >>> process = SharedProcess()
        >>> [process.refusal(name, lambda: {"both load libgain.so": name[0]}) for name in ("a1", "a2", "b")]
        [None, None, "'a1' and 'b' cannot run in one process: both load libgain.so"]
    """

    def __init__(self) -> None:
        self._first: tuple[str, Callable[[], Claims]] | None = None
        self._taken: dict[str, tuple[str, str]] | None = None

    def refusal(self, name: str, claims: Callable[[], Claims]) -> str | None:
        """Why an instance cannot join; None: it has joined. The claims of the first one are read for the second."""
        if self._first is None:
            self._first = name, claims
            return None
        if self._taken is None:
            first, of_first = self._first
            self._taken = {why: (content, first) for why, content in of_first().items()}
        own = claims()
        for why, content in own.items():
            if why in self._taken and (not content or self._taken[why][0] != content):
                return f"'{self._taken[why][1]}' and '{name}' cannot run in one process: {why}"
        self._taken = {why: (content, name) for why, content in own.items()} | self._taken
        return None


def automatic_nodes(config: Config, edges: Iterable[tuple[str, str]], claims: ClaimsOf) -> dict[str, str]:
    """The names of the nodes that several instances of a cycle share, by instance. Other instances are not in it.

    An instance with a ``group`` of its own stays there. Instances with different hosts, interpreters or `process` never
    share a node, nor do two that cannot share a process. The edges are those of all connections between instances.
    """
    position = {name: place for place, name in enumerate(config.instances)}
    groups = (group_name(instance.group) for instance in config.instances.values())
    taken = {*config.instances, *(group for group in groups if group is not None)}
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
    """The members of a cycle in as few nodes as hosts, interpreters, limits and claims allow."""
    parts: list[tuple[object, SharedProcess, list[str]]] = []
    for name in cycle:
        section = config.instances[name]
        where = (section.host, section.interpreter, config.process_of(section).of_node)
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
