"""The interface of a profile: how topics look to ROS, or to a bridge to ROS."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

import zenoh

from ..messages.topics import Topic

__all__ = ["DEPTH", "Profile", "Put", "Take", "congestion_control"]

Put = Callable[[bytes, float], None]
"""Publishes one message (CDR) that belongs to a simulation time in s."""

Take = Callable[[bytes], None]
"""Called with every message (CDR) that arrives, on a thread of Zenoh or ROS."""

DEPTH = 1000
"""History depth: how many samples a DDS writer keeps at most for a reader that has not acknowledged them."""


class Profile(Protocol):
    """Declares publishers and subscribers of topics. Call `publish` and `subscribe` in any order, and `close` last."""

    def publish(self, topic: Topic) -> Put:
        """Declare a publisher of ``topic``."""

    def subscribe(self, topic: Topic, take: Take) -> None:
        """Declare a subscriber of ``topic``."""

    def close(self) -> None:
        """Undeclare everything."""


def congestion_control(topic: Topic) -> zenoh.CongestionControl:
    """Wait for slow subscribers of a reliable topic; only the gateway waits, because its session is its own."""
    return zenoh.CongestionControl.BLOCK if topic.reliability == "reliable" else zenoh.CongestionControl.DROP
