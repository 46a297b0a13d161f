"""Who belongs to a run: which processes have registered as nodes, which were refused, and which are ready.

Decides only, from what has arrived. How nodes are answered is in `fmu_mesh.master.members`.
"""

from __future__ import annotations

from collections.abc import Collection

from ..errors import DeadlineExceeded, MessageRefused
from ..system.digest import difference
from ..system.plan import MASTER, RECORDER, Plan
from ..wire.membership import NodeReady, Registration
from ..wire.messages import sealed
from ..wire.ways import Ways, pair

__all__ = ["Registrations", "spoken"]


def spoken(*nodes: str) -> str:
    """The names of participants as text for a message."""
    others = {RECORDER: "the recorder", MASTER: "the master"}
    return ", ".join(others.get(node, f"node '{node}'") for node in nodes)


class Registrations:
    """What each admitted node of one run has said of itself, and each ready one when its links worked."""

    def __init__(self, plan: Plan) -> None:
        self.plan = plan
        self.admitted: dict[str, Registration] = {}
        self.ready: dict[str, NodeReady] = {}
        self._refused: list[str] = []
        self._met: Collection[str] = ()

    def register(self, registration: Registration) -> str | None:
        """Admit a process as a node of this run; if it is not part of the run, return why."""
        node, where, plan = registration.node, f"process {registration.pid} on {registration.host}", self.plan
        if node not in plan.nodes:
            reason = f"this mesh has no node '{node}'"
        elif registration.digest != plan.digest:
            what = difference(plan.digest, registration.digest, plan.system.instances)
            reason = f"node '{node}' ({where}) has {what}, not that of the master"
        elif self.admitted.setdefault(node, registration) != registration:
            reason = f"node '{node}' is there already; two processes run it"
        else:  # the same process may ask again if it got no answer
            return None
        self._refused.append(reason)
        return reason

    def is_of(self, node: str, opened: str) -> bool:
        """Whether the sender of a message has registered as this node: it knows what the seal was made from."""
        return node in self.admitted and sealed(opened) == self.admitted[node].seal

    def take_ready(self, node: str, ready: NodeReady) -> None:
        """A node is ready.

        Raises:
            MessageRefused: the sender is not the process that has registered, or has said so before.
        """
        if not self.is_of(node, ready.opened) or node in self.ready:
            raise MessageRefused("its sender is not the process that has registered")
        self.ready[node] = ready

    def meet(self, nodes: Collection[str]) -> None:
        """The master has met these nodes for row streams."""
        self._met = nodes

    def ways(self) -> Ways:
        """How rows go between the ready nodes."""
        ready = {node: self.ready[node] for node in self.plan.nodes if node in self.ready}
        shared = tuple(node for node, own in ready.items() if own.shared)
        met = {MASTER: set(self._met)} | {node: set(own.streams) for node, own in ready.items()}
        pairs = {pair(one, other) for one, others in met.items() for other in others if one in met.get(other, ())}
        return Ways(shared, tuple(sorted(pairs)))

    def unmet(self, ways: Ways) -> list[tuple[str, str]]:
        """The pairs that exchange rows by Zenoh although both have a door for a row stream."""
        doors = {MASTER, *(node for node, own in self.admitted.items() if own.door is not None)}
        links = [link for node in self.plan.nodes.values() for link in node.links_in if not link.initial_only]
        ends = [(link.source_node, link.target_node) for link in links]
        pairs = {pair(*(MASTER if name == RECORDER else name for name in both)) for both in ends}
        return sorted(both for both in pairs if ways.way(*both) == "zenoh" and doors.issuperset(both))

    def named(self, *nodes: str) -> str:
        """The names of participants, with the hosts of those that do not run where `launch` does."""
        hosts = {node: self.plan.nodes[node].host for node in nodes}
        return ", ".join(spoken(node) + (f" on {host}" if host is not None else "") for node, host in hosts.items())

    @property
    def missing(self) -> list[str]:
        """The nodes that are not ready."""
        return [node for node in self.plan.nodes if node not in self.ready]

    def absence(self, waited_s: float) -> DeadlineExceeded:
        """The error that names the nodes that are not ready after ``waited_s`` seconds."""
        missing = self.missing
        if len(missing) > 1:  # the recorder only waits for the nodes
            missing = [node for node in missing if node != RECORDER]
        there = [node for node in missing if node in self.admitted]
        hint = f"Started, but not ready: {', '.join(there)}." if there else "None of them was started."
        if self._refused:
            hint += f" Refused: {self._refused[-1]}."
        return DeadlineExceeded(f"not ready within {waited_s:g} s: {self.named(*missing)}", hint=hint)
