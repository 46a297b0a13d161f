"""Which nodes go on from a checkpoint although another node cannot: they play the rows that they had (ADR 92).

An instance without a state is calculated again from the first point. A node with none of these copies its rows from a
file meanwhile, and at the point of the checkpoint loads its states. Owns the choice; the file is
`fmu_mesh.results.played_rows`.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

from ..config.mesh import RecoveryConfig
from ..text import listed
from ..variables.value_types import is_text
from .layout import Layout, row_bytes
from .system import ResolvedSystem

__all__ = ["PlayedNodes", "keeps_states", "played_nodes", "stateless"]


def stateless(system: ResolvedSystem, *, keys: bool = True) -> dict[str, str]:
    """The instances whose state cannot outlive their process, and why, as the end of a sentence.

    With ``keys``, inputs get the values of their Zenoh keys, as in processes.
    """
    found = {}
    for name, own in system.instances.items():
        why = system.config.instances[name].stateless(own.description)
        if why is None and keys and own.keys_in:
            why = (
                f"keys of Zenoh give values to {listed([key.variable for key in own.keys_in])}, and these have no past"
            )
        if why is not None:
            found[name] = why
    return found


class PlayedNodes(NamedTuple):
    """How a mesh in which an instance has no state comes back after a loss.

    Attributes:
        names: the nodes that play their rows; empty: none does.
        again: the instances that are calculated again from the first point, and why, as the end of a sentence.
        refused: why there are no checkpoints at all, as a sentence; empty: there are.
        point_bytes: what the rows of the nodes that play take, in bytes for each point.
    """

    names: tuple[str, ...] = ()
    again: Mapping[str, str] = {}
    refused: str = ""
    point_bytes: float = 0.0


def keeps_states(recovery: RecoveryConfig) -> bool:
    """Whether checkpoints for a restart are wanted."""
    return recovery.checkpoint_s is not None and (recovery.mode == "restart" or recovery.directory is not None)


def played_nodes(system: ResolvedSystem, outputs: Mapping[str, Layout]) -> PlayedNodes:
    """Choose the nodes that play; ``outputs`` has the columns of the rows of each instance.

    Where all instances have a state, no node plays, and nothing is refused.
    """
    instances, deploy, again = system.instances, system.config.deploy, stateless(system)
    if not again:
        return PlayedNodes()
    named = f"'{(name := next(iter(again)))}' has no state that can be written: {again[name]}"
    if any(own.keys_in for own in instances.values()):
        return PlayedNodes(refused=f"{named}; with values of keys, all is calculated again")
    if any(deploy.known(system.config.instances[own].host) is not None for own in instances):
        return PlayedNodes(refused=f"{named}; on several hosts, all is calculated again")
    for name in instances:
        if any(is_text(column.type) for column in outputs[name].columns):
            again.setdefault(name, "its rows have texts, which have no fixed size")
    alone = {instances[name].node: name for name in again}
    for name, own in instances.items():
        if own.node in alone:
            again.setdefault(name, f"it shares a process with '{alone[own.node]}'")
    playing = [own for name, own in instances.items() if name not in again]
    if not playing:
        return PlayedNodes(refused=f"{named}; no other instance could go on without it")
    size = sum(row_bytes(outputs[own.name]) / own.step_points for own in playing if outputs[own.name].columns)
    return PlayedNodes(tuple(dict.fromkeys(own.node for own in playing)), again, "", size)
