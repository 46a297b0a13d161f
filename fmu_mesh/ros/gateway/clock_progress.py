"""How far the samples of a mesh have been published in ROS, and `/clock`, which follows them.

A variable of a slower instance holds its value between two of its points. So everything up to a point has been
published once every watched variable has a value that holds there.
"""

from __future__ import annotations

import logging

from ...simtime import TimeGrid
from ..messages.assembling import Assembler
from ..messages.cdr import Codec
from ..messages.definitions import CLOCK
from ..messages.stamp import to_stamp
from ..messages.topics import RosPlan, Topic
from .profile import Put

__all__ = ["ClockPublisher", "Progress", "WarnOnce", "WatchedVariable", "clock_topic"]

log = logging.getLogger(__name__)

_MAX_WARNINGS = 10


class WarnOnce:
    """Logs each warning about one name once, and at most ten of them.

    Args:
        name: of the topic or variable that the warnings are about.
    """

    def __init__(self, name: str) -> None:
        self._name = name
        self._logged: set[str] = set()

    def warn(self, text: str) -> None:
        """Log the warning, unless it was logged before."""
        if text not in self._logged and len(self._logged) < _MAX_WARNINGS:
            self._logged.add(text)
            log.warning("'%s': %s", self._name, text)


class WatchedVariable(WarnOnce):
    """A variable whose samples the gateway takes.

    Args:
        name: `instance.variable`.
        step_points: base points between two of its samples.

    Attributes:
        outputs: (assembler of a topic, index of the variable's port there, publishes its messages).
    """

    def __init__(self, name: str, step_points: int) -> None:
        super().__init__(name)
        self.outputs: list[tuple[Assembler, int, Put]] = []
        self._step_points = step_points
        self._point = -1

    @property
    def holds_until(self) -> int:
        """The last point at which the newest sample holds; -1 before the first sample."""
        return self._point + self._step_points - 1 if self._point >= 0 else -1

    def advance(self, point: int) -> None:
        """Note that the sample of ``point`` has been published."""
        self._point = point


class ClockPublisher:
    """`/clock`: the time of every n-th point, once everything up to that point has been published.

    Args:
        put: publishes a message on the topic.
        plan: has the message types and n.
        grid: the communication points of the run.
    """

    def __init__(self, put: Put, plan: RosPlan, grid: TimeGrid) -> None:
        self._put = put
        self._codec = Codec(plan.types, CLOCK)
        self._stride = plan.clock_points or 1
        self._grid = grid
        self._next: int | None = None
        self._last: int | None = None
        self._moved = False

    def begin(self, point: int) -> None:
        """Start at the first sample, which is of ``point``; earlier points were not published here."""
        if self._last is None:
            first = -(-point // self._stride) * self._stride
            self._next = first if self._next is None else min(first, self._next)

    def advance(self, point: int) -> None:
        """Publish every n-th point up to ``point``, up to which everything else has been published."""
        while self._next is not None and self._next <= point:
            self._publish(self._next)
            self._last = self._next
            self._next += self._stride
            self._moved = True

    def repeat(self) -> None:
        """Publish the last time again if it has not changed since the last call, for new subscribers."""
        if self._last is not None and not self._moved:
            self._publish(self._last)
        self._moved = False

    def _publish(self, point: int) -> None:
        time_s = self._grid.time(point)
        self._put(self._codec.encode({"clock": to_stamp(time_s)}), time_s)


class Progress:
    """The watched variables of one gateway, and the point up to which all of their samples have been published.

    Attributes:
        watched: the variables by their keys.
        complete: the last point at which the newest samples of all variables hold; -1 at first.
    """

    def __init__(self) -> None:
        self.watched: dict[str, WatchedVariable] = {}
        self.complete = -1
        self._newest = -1
        self._now = -1
        self._clock: ClockPublisher | None = None

    def start_clock(self, clock: ClockPublisher) -> None:
        """Let ``clock`` follow."""
        self._clock = clock

    def watch(self, key: str, name: str, step_points: int) -> WatchedVariable:
        """The variable with this key; several topics share it."""
        return self.watched.setdefault(key, WatchedVariable(name, step_points))

    def published(self, variable: WatchedVariable, point: int) -> None:
        """Note that the sample of ``variable`` at ``point`` has been published, and move `/clock`."""
        is_first, was_last = variable.holds_until < 0, variable.holds_until <= self.complete
        if is_first and self._clock is not None:
            self._clock.begin(point)
        variable.advance(point)
        self._newest = max(self._newest, point)
        if was_last:
            self.complete = min(other.holds_until for other in self.watched.values())
        now = min(self._newest, self.complete)
        if now > self._now:
            self._now = now
            if self._clock is not None:
                self._clock.advance(now)

    def repeat_clock(self) -> None:
        """Publish the time again if it stands still."""
        if self._clock is not None:
            self._clock.repeat()


def clock_topic(plan: RosPlan) -> Topic:
    """The topic `/clock`, with the profile of the first topic."""
    return Topic("/clock", CLOCK, "out", (), plan.topics[0].profile if plan.topics else "ros2dds")
