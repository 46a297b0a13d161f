"""Profiles: how topics look to ROS, or to a bridge to ROS; what those on Zenoh have in common, and that of a bridge.

Keys of zenoh-bridge-ros2dds are topic names, payloads are CDR, and tokens announce topics as a bridge does. A token is
`@/<zid>/@ros2_lv/MP/<key>/<type>/<qos>` (MS for a subscriber), with `§` for every slash within a part. Its QoS is
`<keyless>:<reliability>:<durability>:<history>,<depth>:<user data>` in the numbers of Cyclone DDS; the user data
contain the type hash, as in ROS since Iron.
"""

# Threads: `take` of a plain subscriber is called on the thread that reads the link, so samples and requests of one
# sender come in its order. It must return at once: it puts what comes into a queue (ADR 78).

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from typing import Protocol

import zenoh
import zenoh.ext
from zenoh.handlers import Callback

from ..config.mesh import Qos
from ..wire.session import matches, undeclare_all
from ..wire.views import RosTopicView
from .definitions import MessageTypes
from .topics import Topic

__all__ = ["Profile", "Put", "Ros2Dds", "Take", "ZenohProfile", "topic_in"]

Put = Callable[[bytes, float], None]
"""Publishes one message (CDR) that belongs to a simulation time in s."""

Take = Callable[[bytes], None]
"""Called with every message (CDR) that arrives, on a thread of Zenoh or ROS; it must not wait."""

_RELIABILITY, _DURABILITY, _KEEP_LAST = {"reliable": 1, "best_effort": 0}, {"volatile": 0, "transient_local": 1}, 0


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
        self._publishers: list[tuple[str, zenoh.Publisher]] = []
        self._subscribed: list[tuple[str, str]] = []
        self._others: list[
            zenoh.Subscriber[None]
            | zenoh.Queryable[None]
            | zenoh.ext.AdvancedPublisher
            | zenoh.ext.AdvancedSubscriber[None]
        ] = []

    def publish(self, topic: Topic) -> Put:
        """Declare a publisher of ``topic``."""
        # Wait for slow subscribers of a reliable topic; only the gateway waits, because its session is its own.
        control, cdr = zenoh.CongestionControl, zenoh.Encoding.APPLICATION_CDR
        blocks = control.BLOCK if topic.qos.reliability == "reliable" else control.DROP
        key = self._key(topic.name, topic.message)
        publisher = self._session.declare_publisher(key, encoding=cdr, congestion_control=blocks)
        self._publishers.append((topic.name, publisher))
        put: Callable[..., None] = publisher.put
        if topic.qos.durability == "transient_local":
            # It cannot say whether somebody subscribes, so `publisher` stays for that.
            cache = zenoh.ext.CacheConfig(topic.qos.depth)
            keeper = zenoh.ext.declare_advanced_publisher(
                self._session, key, encoding=cdr, congestion_control=blocks, cache=cache, publisher_detection=True
            )
            self._others.append(keeper)
            put = keeper.put
        attached = self._attached(self._announce("MP", topic.name, topic.message, topic.qos))
        return lambda data, time: put(data, attachment=attached(time))

    def subscribe(self, topic: Topic, take: Take) -> None:
        """Declare a subscriber of ``topic``."""
        key = self._key(topic.name, topic.message)

        def arrived(sample: zenoh.Sample) -> None:
            take(sample.payload.to_bytes())

        if topic.qos.durability == "transient_local":
            history = zenoh.ext.HistoryConfig(detect_late_publishers=True, max_samples=topic.qos.depth)
            self._others.append(zenoh.ext.declare_advanced_subscriber(self._session, key, arrived, history=history))
        else:
            self._others.append(self._session.declare_subscriber(key, Callback(arrived, indirect=False)))
        self._subscribed.append((topic.name, self._announce("MS", topic.name, topic.message, topic.qos)))

    def close(self) -> None:
        """Undeclare everything, tokens first."""
        undeclare_all(self._tokens, (own for _, own in self._publishers), self._others)

    def topics(self, tokens: Iterable[str]) -> Iterator[RosTopicView]:
        """All topics; ``tokens`` are those of publishers of others."""
        published = {topic_in(token) for token in tokens}
        for name, publisher in self._publishers:
            yield RosTopicView(name, "out", matches(publisher))
        for name, token in self._subscribed:
            yield RosTopicView(name, "in", topic_in(token) in published)

    def unheard(self) -> list[str]:
        """The published topics that nobody subscribes to."""
        return [name for name, publisher in self._publishers if not matches(publisher)]

    def _key(self, name: str, message: str) -> str:
        """The key of a topic or a service."""
        raise NotImplementedError

    def _announce(self, kind: str, name: str, message: str, qos: Qos) -> str:
        """Declare the token of a publisher (MP), a subscriber (MS) or a server (SS), and return it."""
        token = self._token(kind, name, message, qos)
        self._tokens.append(self._session.liveliness().declare_token(token))
        return token

    def _token(self, kind: str, name: str, message: str, qos: Qos) -> str:
        """The token of a topic or a service."""
        raise NotImplementedError

    def _attached(self, token: str) -> Callable[[float], bytes | None]:  # noqa: ARG002  another profile needs it
        """What goes with a sample of a publisher with this token at a time in s."""
        return lambda _time: None


def topic_in(token: str) -> tuple[str, ...]:
    """Name, type and hash in the token of a publisher or a subscriber; in that of a bridge, name and type."""
    chunks = token.split("/")
    return tuple(chunks[4:6] if chunks[0] == "@" else chunks[9:12])


class Ros2Dds(ZenohProfile):
    """Topics as a bridge between Zenoh and DDS expects them."""

    def _key(self, name: str, message: str) -> str:  # noqa: ARG002  the name says all
        return name.removeprefix("/")

    def _token(self, kind: str, name: str, message: str, qos: Qos) -> str:
        words = f":{_RELIABILITY[qos.reliability]}:{_DURABILITY[qos.durability]}:{_KEEP_LAST},{qos.depth}"
        if self._types.distribution != "humble":
            words += f":typehash={self._types.type_hash(message)};"
        parts = (self._key(name, message).replace("/", "§"), message.replace("/", "§"), words)
        return f"@/{self._session.zid()}/@ros2_lv/{kind}/{'/'.join(parts)}"
