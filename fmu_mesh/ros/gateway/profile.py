"""What a profile is: how topics look on Zenoh to those who bridge them to ROS, or are ROS."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

import zenoh

from .topics import Topic

__all__ = ["DEPTH", "Profile", "Put", "Take", "congestion_control"]

Put = Callable[[bytes, float], None]
"""Publishes one message (CDR) that belongs to a simulation time in s."""

Take = Callable[[bytes], None]
"""Called on a foreign thread with every message (CDR) that arrives."""

DEPTH = 1000
"""History depth that others see: how many samples a DDS writer may keep until a slow reader has acknowledged them."""


class Profile(Protocol):
    """Declares topics on a session; everything declared is undeclared by `close`."""

    def publish(self, topic: Topic) -> Put:
        """Be a publisher of ``topic``."""

    def subscribe(self, topic: Topic, take: Take) -> None:
        """Be a subscriber of ``topic``."""

    def close(self) -> None:
        """Undeclare everything."""


def congestion_control(topic: Topic) -> zenoh.CongestionControl:
    """A reliable topic waits for its subscribers; the gateway has a session of its own, so nobody else waits."""
    return zenoh.CongestionControl.BLOCK if topic.reliability == "reliable" else zenoh.CongestionControl.DROP
