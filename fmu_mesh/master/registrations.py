"""Who belongs to a run: which processes have registered as nodes, which were refused, and which are ready.

Decides only, from what has arrived. How nodes are answered is in `fmu_mesh.master.members`.
"""

from __future__ import annotations

from ..errors import DeadlineExceeded, MessageRefused
from ..system.digest import difference
from ..system.plan import RECORDER, Plan
from ..wire.membership import NodeReady, Registration
from ..wire.messages import sealed

__all__ = ["Registrations", "spoken"]


def spoken(*nodes: str) -> str:
    """The names of nodes as text for a message."""
    return ", ".join("the recorder" if node == RECORDER else f"node '{node}'" for node in nodes)


class Registrations:
    """What each admitted node of one run has said of itself, and each ready one when its links worked."""

    def __init__(self, plan: Plan) -> None:
        self.plan = plan
        self.admitted: dict[str, Registration] = {}
        self.ready: dict[str, NodeReady] = {}
        self._refused: list[str] = []

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

    @property
    def shared(self) -> tuple[str, ...]:
        """The ready nodes that use the memory of the master's host, and the recorder."""
        return tuple(node for node in self.plan.nodes if node in self.ready and self.ready[node].shared)

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
        return DeadlineExceeded(f"not ready within {waited_s:g} s: {spoken(*missing)}", hint=hint)
