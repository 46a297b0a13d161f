"""Where the nodes of a plan run: on which host an error happened, and which values go over more than one host.

A plan knows its hosts by their names in `deploy.hosts`; nothing here knows how a host is reached.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeVar

from ..errors import FmuMeshError
from .plan import Plan

__all__ = ["manual_hosts", "placed", "two_trips"]

E = TypeVar("E", bound=FmuMeshError)


def placed(plan: Plan, error: E, nodes: Sequence[str] = ()) -> E:
    """Note in an error on which host its instance runs, if it is not the one of `launch`; returns the error.

    Args:
        plan: the plan of the run.
        error: an error whose instance is one of the plan, or several as `a, b`.
        nodes: the nodes that it is about, if its instance is none.
    """
    names = (error.instance or "").split(", ")
    of = {*nodes, *(plan.node_of(name) for name in names if name in plan.system.instances)}
    hosts = {plan.nodes[node].host for node in of}
    if len(hosts) == 1 and (host := hosts.pop()) is not None:
        error.on(host)
    return error


def two_trips(plan: Plan) -> list[str]:
    """The connections whose values go through the host of `launch` because no ssh joins their two hosts, in words."""
    hosts = {name: own for name, own in plan.hosts.items() if own.ssh is not None}
    sentences = dict[tuple[str, str | None], str]()
    for c in plan.connections:
        source, target = (plan.nodes[plan.node_of(end)].host for end in (c.source_instance, c.target_instance))
        if c.initial_only or source == target or source not in hosts or target not in hosts:
            continue
        if hosts[source].rows == hosts[target].rows == "sockets":
            text = f"{c}: from '{source}' to '{target}' through the host of `launch`, which is two trips"
            sentences[c.source_instance, target] = sentences.get((c.source_instance, target), text)
    return [*sentences.values()]


def manual_hosts(plan: Plan) -> dict[str, list[str]]:
    """The nodes that a person starts on each host without `ssh`, by host."""
    return {
        name: [node for node, own in plan.nodes.items() if own.host == name]
        for name, host in plan.hosts.items()
        if host.ssh is None
    }
