"""What the nodes have reached, and what they are granted.

Grants and progress are counters in the memory of the host. The nodes there keep the windows among themselves, and the
last point can be granted at once, because a grant can be taken back. A node that does not share this memory gets grants
by messages: they contain the windows, reach about 50 ms ahead, and stay. It tells its progress by messages, too.
"""

from __future__ import annotations

import operator
import time
from collections.abc import Collection

from ..errors import DeadlineExceeded, ProtocolBroken
from ..rings.host_memory import HostMemory, Wish
from ..system.plan import RECORDER, Plan
from ..wire.runtime import STOPPED
from .members import Members, spoken
from .pacing import CLOCK, PAUSE, Reach

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
        self._reach = Reach(plan.window)

    def share(self, nodes: Collection[str]) -> None:
        """From now on, the progress of these nodes is read in the memory."""
        self._sharing = [*nodes]

    @property
    def told(self) -> int:
        """The point up to which all nodes have a grant, also those that get it by messages."""
        return self.grant if self._all_share else self._told

    @property
    def _all_share(self) -> bool:
        """Whether no node needs a message with its grant."""
        return len(self._sharing) == len(self.progress)

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

    def check_progress(self, silent_s: float, members: Members) -> None:
        """There was no progress for ``silent_s`` seconds.

        Raises:
            DeadlineExceeded: there should have been some. The instances of a node step one after the other, each with a
                deadline of its own; a node that is stopped has only one.
        """
        step_s = self._plan.system.config.timeouts.step
        if silent_s <= step_s or self.slowest >= self.grant:
            return
        most_instances = max(len(node.instances) for node in self._plan.nodes.values())
        if (stopped := members.stopped) or silent_s > 3 * step_s * most_instances:
            state = f": its process {STOPPED}" if stopped else ""
            who = spoken(*(stopped or [self.laggard]))
            error = DeadlineExceeded(f"no progress for {silent_s:.1f} s{state}", instance=who)
            raise error.at(self.slowest, self._plan.grid.time(self.slowest))

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

    def halt(self) -> int:
        """Take back what nodes have not claimed yet; return the point at which all will pause."""
        claimed = self._memory.withdraw_grant() if self._sharing else 0
        self.raise_to(min(self.grant, max(claimed, self._told)))
        return self.grant

    def owed(self) -> tuple[int, bool]:
        """The grant for nodes that cannot read it, and whether it has grown since the last call."""
        if self._all_share:
            return 0, False
        credit = min(map(operator.add, self.progress.values(), self._windows))
        ahead = min(point for node, point in self.progress.items() if node != RECORDER)
        owed = min(self.grant, credit, ahead + self._reach.points(ahead, time.monotonic()))
        grown = owed > self._told
        self._told = max(self._told, owed)
        return self._told, grown

    def wishes(self) -> list[Wish]:
        """Wake up when the slowest node of this host has come so far that there is something to do."""
        if not self._sharing:
            return []
        slowest = min(self._sharing, key=self.progress.__getitem__)
        reached = self.progress[slowest]
        if reached >= self.told and reached >= 0:
            return []
        goal = self.grant if self.told == self.grant else (reached + self.told) // 2
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
