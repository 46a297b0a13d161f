"""What the nodes have reached, and what they are granted.

The nodes of this host keep the windows among themselves, and what nobody has claimed can be taken back. Still the grant
leads the slowest instance by no more than it steps in half a second: fast ones that are ahead of it cannot go back, and
a pause has to wait until it is where they are. A node that does not share this memory gets grants by a row stream or by
messages, and tells its progress so, too: these grants reach about 50 ms ahead, and stay; those by messages contain the
windows.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence

from ..errors import DeadlineExceeded, ProtocolBroken
from ..system.placement import placed
from ..system.plan import MASTER, RECORDER, Plan
from ..wire.host_processes import STOPPED
from ..wire.ways import Ways
from .pacing import CLOCK, PAUSE, Reach
from .registrations import spoken

__all__ = ["Granting"]

_LEAD_S = 0.5


class Granting:
    """The grant of a run, and the progress of its nodes.

    Attributes:
        progress: the last point of which each node knows all outputs, by name; the one before the first: Initialization
            Mode is not over.
        slowest: the last point that all nodes know.
        grant: the point up to which all may step.
        last_point: the last point of the run, which may end early.
        ways: how rows go, from `go` on.
        sharing: the nodes that share the memory of the master's host.
        seen: the nodes whose progress is in that memory: these, and those that have a row stream.
        messages: whether some nodes get their grant by Zenoh.
    """

    def __init__(self, plan: Plan) -> None:
        first = plan.grid.first_point
        self.progress = dict.fromkeys(plan.nodes, first - 1)
        self.slowest = first - 1
        self.grant = first
        self.last_point = plan.grid.last_point
        self.ways = Ways()
        self.sharing: tuple[str, ...] = ()
        self.seen: tuple[str, ...] = ()
        self.messages = True
        self._keep_windows = True
        self._plan = plan
        # The progress of a slower instance is the point up to which its outputs hold: its next own point minus one.
        self._most_ahead = 2 * max(item.step_points for item in plan.system.instances.values()) - 2
        self._sent = first
        self._reach = Reach(first=first - 1)
        self._lead = Reach(_LEAD_S, first - 1)
        self._round_trip_s: float | None = None

    def go(self, ways: Ways) -> None:
        """From now on, the nodes read the grant and tell their progress in these ways."""
        nodes = self._plan.nodes
        self.ways, self.sharing = ways, ways.shared
        self.seen = tuple(name for name in nodes if ways.way(name, MASTER) != "zenoh")
        self.messages = len(self.seen) < len(nodes)
        links = {
            (own.source_node, own.target_node)
            for node in nodes.values()
            for own in node.links_in
            if not own.initial_only
        }
        self._keep_windows = self.messages or not ways.all_but_zenoh(links)

    def measured(self, round_trip_s: float) -> None:
        """The longest round trip to a node by a row stream takes so long, in s."""
        self._round_trip_s = round_trip_s if not self.messages else None  # that of messages is not known

    @property
    def first_point(self) -> int:
        """The first point of the run."""
        return self._plan.grid.first_point

    @property
    def has_begun(self) -> bool:
        """Whether all nodes have reached the first point."""
        return self.slowest >= self.first_point

    def end_at(self, point: int) -> None:
        """End the run at a point before its last one."""
        self.last_point = min(point, self.last_point)

    @property
    def reached(self) -> int:
        """The last point that all instances know; the recorder may be far behind."""
        return min(point for node, point in self.progress.items() if node != RECORDER)

    @property
    def reaches_all(self) -> int:
        """The point up to which all nodes have a grant, also those that get it by messages."""
        return self.grant if self._all_share else self._sent

    @property
    def _all_share(self) -> bool:
        return len(self.sharing) == len(self.progress)

    @property
    def _limits(self) -> Iterator[tuple[int, str]]:
        """How far the window of each node lets the others go, and its name."""
        return ((self.progress[name] + node.window, name) for name, node in self._plan.nodes.items())

    def holder(self, *, hold: int | None, paced: int) -> str | None:
        """What limits steps: a pause at ``hold``, the wall clock at ``paced``, or the window of a node; or nothing."""
        grant = self.reaches_all
        if grant == self.last_point:
            return None
        if grant in (hold, paced):
            return PAUSE if grant == hold else CLOCK
        return min(self._limits)[1]

    def instances_of(self, node: str) -> str | None:
        """The names of the instances of a node, for an error."""
        return ", ".join(item.name for item in self._plan.nodes[node].instances) or None

    def take(self, reported: Iterable[tuple[str, int]]) -> list[tuple[str, int]]:
        """Store the progress that nodes report as (name, point); return those that have increased.

        Raises:
            ProtocolBroken: a node cannot be where it says.
        """
        news = []
        for node, point in reported:
            if point == self.progress[node]:
                continue
            if not self.may_be_at(node, point):
                raise self.broken(node, f"is at point {point}")
            if point > self.progress[node]:
                self.progress[node] = point
                news.append((node, point))
        if news:
            self.slowest = min(self.progress.values())
        return news

    def may_be_at(self, node: str, point: int) -> bool:
        """Whether a node can have reached this point with its grants; after an early end, some are at the last one."""
        planned = self._plan.grid.last_point
        most = planned if self.last_point < planned and node != RECORDER else self.grant + self._most_ahead
        return -1 <= point <= most

    @property
    def is_led(self) -> bool:
        """Whether the slowest instance limits the grant, and not the wall clock or a pause."""
        return self.grant == self._lead.granted

    def led(self, wanted: int, now: float) -> int:
        """The point up to which all may be granted now, at most the ``wanted`` one; ``now`` is monotonic, in s."""
        self._lead.points(self.reached, now)
        return min(wanted, self._lead.granted)

    def raise_to(self, point: int) -> None:
        """Grant all points up to this one."""
        self.grant = point

    def halt(self, claimed: int) -> int:
        """Take back what nobody has ``claimed`` in the memory; return the point at which all will pause."""
        self.grant = min(self.grant, max(claimed, self._sent))
        return self.grant

    def owed(self, now: float) -> tuple[int, bool]:
        """The grant for nodes that cannot read it, and whether it has grown since the last call; ``now`` is in s."""
        if self._all_share:
            return 0, False
        credit = min(self._limits)[0] if self._keep_windows else self.grant
        reached = self.reached
        owed = min(self.grant, credit, reached + self._reach.points(reached, now, self._round_trip_s))
        grown = owed > self._sent
        self._sent = max(self._sent, owed)
        return self._sent, grown

    def wake_at(self, wanted: int) -> tuple[str, int] | None:
        """The slowest node of this host, and its point from which on there is something to do for the master.

        Nothing if the grant is below the ``wanted`` point and all have it: only the wall clock lets it grow.
        """
        if not self.seen or (self.has_begun and self.reaches_all == self.grant < wanted and not self.is_led):
            return None
        nodes = [node for node in self.seen if node != RECORDER]
        if self._keep_windows or min(map(self.progress.__getitem__, nodes), default=self.grant) >= self.reaches_all:
            nodes = [*self.seen]  # the recorder may be far behind: what is granted next does not depend on it
        slowest = min(nodes, key=self.progress.__getitem__)
        reached = self.progress[slowest]
        if reached >= self.reaches_all and reached >= self.first_point:
            return None
        goal = self.grant if self.reaches_all == self.grant and not self.is_led else (reached + self.reaches_all) // 2
        return slowest, max(goal, reached + 1)

    def no_progress(self, silent_s: float, stopped: Sequence[str]) -> DeadlineExceeded:
        """The error for ``silent_s`` seconds without progress; names the nodes whose processes are ``stopped``."""
        slowest = min(self.progress, key=self.progress.__getitem__)
        state = f": its process {STOPPED}" if stopped else ""
        nodes = stopped or [slowest]
        error = DeadlineExceeded(f"no progress for {silent_s:.1f} s{state}", instance=spoken(*nodes))
        return placed(self._plan, error, nodes).at(self.slowest, self._plan.grid.time(self.slowest))

    def broken(self, node: str, what: str) -> ProtocolBroken:
        """The error for a node that cannot be where it says."""
        return ProtocolBroken(
            f"{spoken(node)} says that it {what}, and the master has granted point {self.grant}",
            instance=self.instances_of(node),
            hint="Does another process send messages with its name?",
        )
