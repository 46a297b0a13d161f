"""What the nodes have reached, and what they are granted.

Grants and progress are counters in the memory of the host. The nodes there keep the windows among themselves; a node
that does not share this memory gets grants that contain the windows, and tells its progress by messages.
"""

from __future__ import annotations

import operator
from collections.abc import Collection

from ..errors import ProtocolBroken
from ..rings.host_memory import HostMemory, Wish
from ..system.plan import RECORDER, Plan
from .members import spoken
from .pacing import CLOCK, PAUSE

__all__ = ["Granting"]


class Granting:
    """The grant of a run, and the progress of its nodes.

    Args:
        plan: the plan of the whole mesh.
        memory: has the counters.

    Attributes:
        progress: the last point of which each node knows all outputs, by name; -1: Initialization Mode is not over.
        slowest: the last point that all nodes know.
        grant: the point up to which all may step.
    """

    def __init__(self, plan: Plan, memory: HostMemory) -> None:
        self.progress = dict.fromkeys(plan.nodes, -1)
        self.slowest = -1
        self.grant = 0
        self._plan = plan
        self._memory = memory
        self._windows = [node.window for node in plan.nodes.values()]
        # The progress of a slower instance is the point up to which its outputs hold: its next own point minus one.
        self._most_ahead = 2 * max(item.step_points for item in plan.system.instances.values()) - 2
        self._sharing: list[str] = []
        self._told = 0

    def share(self, nodes: Collection[str]) -> None:
        """From now on, the progress of these nodes is read in the memory."""
        self._sharing = [*nodes]

    @property
    def ahead(self) -> int:
        """The last point that all nodes with instances know."""
        return min(point for node, point in self.progress.items() if node != RECORDER)

    @property
    def laggard(self) -> str:
        """The node that is furthest behind."""
        return min(self.progress, key=self.progress.__getitem__)

    def holder(self, grant: int, *, hold: int | None, paced: int) -> str:
        """What limits steps up to a grant: a pause at ``hold``, the wall clock at ``paced``, or a window (its node)."""
        if grant in (hold, paced):
            return PAUSE if grant == hold else CLOCK
        limits = map(operator.add, self.progress.values(), self._windows)
        return min(zip(limits, self.progress, strict=True))[1]

    def instances_of(self, node: str) -> str | None:
        """The names of the instances of a node, for an error."""
        return ", ".join(item.name for item in self._plan.nodes[node].instances) or None

    def take(self, node: str, point: int, *, ended: bool) -> bool:
        """Store the progress that a message tells; return whether it has increased.

        Args:
            node: its name.
            point: what it knows.
            ended: whether the simulation ends early, so that a node may be at the last point.

        Raises:
            ProtocolBroken: it cannot be there.
        """
        if node in self._sharing or not self._store(node, point, ended=ended):
            return False
        self._memory.progress[node].raise_to(point + 1)
        return True

    def look(self, *, ended: bool) -> bool:
        """Read the progress of the nodes that share the memory; return whether one has increased.

        Raises:
            ProtocolBroken: one cannot be where it says.
        """
        values = [(node, self._memory.progress[node].value - 1) for node in self._sharing]
        moved = [self._store(node, point, ended=ended) for node, point in values if point > self.progress[node]]
        self.slowest = min(self.progress.values())
        return any(moved)

    def may_be_at(self, node: str, point: int, *, ended: bool) -> bool:
        """Whether a node can have reached this point with its grants."""
        last_point = self._plan.grid.last_point
        most = last_point if ended and node != RECORDER else self.grant + self._most_ahead
        return -1 <= point <= most

    def raise_to(self, point: int) -> None:
        """Grant all points up to this one."""
        self.grant = point
        self._memory.grant.raise_to(point)

    def owed(self) -> tuple[int, bool]:
        """The grant for nodes that cannot read it, and whether it has grown since the last call."""
        credit = min(map(operator.add, self.progress.values(), self._windows))
        grown = len(self._sharing) < len(self.progress) and min(self.grant, credit) > self._told
        if grown:
            self._told = min(self.grant, credit)
        return self._told, grown

    def wishes(self, last_point: int) -> list[Wish]:
        """Wake up when the slowest node of this host has come so far that there is something to do."""
        at_end = self.grant >= last_point
        nodes = [node for node in self._sharing if at_end or node != RECORDER] or self._sharing
        if not nodes:
            return []
        slowest = min(nodes, key=self.progress.__getitem__)
        reached = self.progress[slowest]
        if reached >= self.grant and reached >= 0:
            return []
        goal = self.grant if at_end else (reached + self.grant) // 2
        return [(self._memory.progress[slowest], max(goal, reached + 1) + 1)]

    def broken(self, node: str, what: str) -> ProtocolBroken:
        """The error for a node that cannot be where it says."""
        return ProtocolBroken(
            f"{spoken(node)} says that it {what}, and the master has granted point {self.grant}",
            instance=self.instances_of(node),
            hint="Does another process send messages with its name?",
        )

    def _store(self, node: str, point: int, *, ended: bool) -> bool:
        if not self.may_be_at(node, point, ended=ended):
            raise self.broken(node, f"is at point {point}")
        if point <= self.progress[node]:
            return False
        self.progress[node] = point
        return True
