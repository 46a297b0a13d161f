"""The deadline of a topic: the longest time from message to message, by the wall clock.

It is judged here for all profiles: the bridge and rmw_zenoh judge none, and DDS only tells its own nodes.
"""

from __future__ import annotations

import logging
import time

from ...ros_wire.profile import Put

__all__ = ["Deadline"]

log = logging.getLogger(__name__)


class Deadline:
    """Counts the missed deadlines of one topic, and warns of the first. As in DDS, it begins with the first message.

    Attributes:
        missed: how many; a silence of three periods counts three times.
    """

    def __init__(self, topic: str, period_s: float) -> None:
        self.topic = topic
        self._period_s = period_s
        self._since: float | None = None
        self.missed = 0

    def watched(self, put: Put) -> Put:
        """The same function, whose messages are noted."""

        def publish(data: bytes, simulation_time: float) -> None:
            put(data, simulation_time)
            self.met(time.monotonic())

        return publish

    def met(self, at: float) -> None:
        """Note that a message came, or was published, at a time of `time.monotonic`."""
        self.left(at)
        self._since = at

    def left(self, now: float) -> float:
        """Count what was missed until ``now``; returns the time until the next one in s."""
        if self._since is None:
            return self._period_s
        periods = int((now - self._since) / self._period_s)
        if periods > 0:
            if not self.missed:
                log.warning("'%s': no message for %g s, which is its deadline", self.topic, self._period_s)
            self.missed += periods
            self._since += periods * self._period_s
        return self._period_s - (now - self._since)

    def report(self) -> None:
        """At the end, log how many deadlines were missed, if there are more than the first."""
        if self.missed > 1:
            log.warning("'%s': its deadline of %g s was missed %d times", self.topic, self._period_s, self.missed)
