"""Profiles: how topics look to ROS, or to a bridge to ROS; and what those on Zenoh have in common."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

import zenoh

from ...wire.session import undeclare_all
from ..messages.definitions import MessageTypes
from ..messages.topics import Reliability, Topic

__all__ = ["DEPTH", "Profile", "Put", "Take", "ZenohProfile"]

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


class ZenohProfile:
    """Topics on Zenoh: a publisher or a subscriber, and a token that shows it to ROS. The caller closes the session."""

    def __init__(self, session: zenoh.Session, types: MessageTypes) -> None:
        self._session = session
        self._types = types
        self._tokens: list[zenoh.LivelinessToken] = []
        self._publishers: list[zenoh.Publisher] = []
        self._others: list[zenoh.Subscriber[None] | zenoh.Queryable[None]] = []

    def publish(self, topic: Topic) -> Put:
        """Declare a publisher of ``topic``."""
        # Wait for slow subscribers of a reliable topic; only the gateway waits, because its session is its own.
        control = zenoh.CongestionControl
        publisher = self._session.declare_publisher(
            self._key(topic.name, topic.message),
            encoding=zenoh.Encoding.APPLICATION_CDR,
            congestion_control=control.BLOCK if topic.reliability == "reliable" else control.DROP,
        )
        self._publishers.append(publisher)
        attached = self._attached(self._announce("MP", topic.name, topic.message, topic.reliability))
        return lambda data, time: publisher.put(data, attachment=attached(time))

    def subscribe(self, topic: Topic, take: Take) -> None:
        """Declare a subscriber of ``topic``."""
        key = self._key(topic.name, topic.message)
        self._others.append(self._session.declare_subscriber(key, lambda sample: take(sample.payload.to_bytes())))
        self._announce("MS", topic.name, topic.message, topic.reliability)

    def close(self) -> None:
        """Undeclare everything, tokens first."""
        undeclare_all(self._tokens, self._publishers, self._others)

    def _key(self, name: str, message: str) -> str:
        """The key of a topic or a service."""
        raise NotImplementedError

    def _announce(self, kind: str, name: str, message: str, reliability: Reliability) -> str:
        """Declare the token of a publisher (MP), a subscriber (MS) or a server (SS); returns the token."""
        raise NotImplementedError

    def _attached(self, token: str) -> Callable[[float], bytes | None]:
        """What goes with a sample of a publisher with this token at a time in s."""
        raise NotImplementedError
