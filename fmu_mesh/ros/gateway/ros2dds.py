"""The profile of zenoh-bridge-ros2dds: keys are topic names, payloads are CDR, tokens announce topics as a bridge does.

A token is `@/<zid>/@ros2_lv/MP/<key>/<type>/<qos>` (MS for a subscriber), with `§` for every slash within a part. Its
QoS is `<keyless>:<reliability>:<durability>:<history>,<depth>:<user data>` in the numbers of Cyclone DDS; the user data
contain the type hash, as in ROS since Iron.
"""

from __future__ import annotations

import zenoh

from ...wire.session import undeclare_all
from ..messages.definitions import MessageTypes
from ..messages.topics import Topic
from .profile import DEPTH, Put, Take, congestion_control

__all__ = ["Ros2Dds"]

_RELIABLE, _BEST_EFFORT = 1, 0
_VOLATILE, _KEEP_LAST = 0, 0


class Ros2Dds:
    """Topics as a bridge between Zenoh and DDS expects them.

    Args:
        session: towards ROS; the caller closes it.
        types: message types, for their hashes.
    """

    def __init__(self, session: zenoh.Session, types: MessageTypes) -> None:
        self._session = session
        self._types = types
        self._publishers: list[zenoh.Publisher] = []
        self._subscribers: list[zenoh.Subscriber[None]] = []
        self._tokens: list[zenoh.LivelinessToken] = []

    def publish(self, topic: Topic) -> Put:
        """Declare a publisher of ``topic``."""
        publisher = self._session.declare_publisher(
            _key(topic), encoding=zenoh.Encoding.APPLICATION_CDR, congestion_control=congestion_control(topic)
        )
        self._publishers.append(publisher)
        self._announce("MP", topic)
        return lambda data, _time: publisher.put(data)

    def subscribe(self, topic: Topic, take: Take) -> None:
        """Declare a subscriber of ``topic``."""
        self._subscribers.append(
            self._session.declare_subscriber(_key(topic), lambda sample: take(sample.payload.to_bytes()))
        )
        self._announce("MS", topic)

    def close(self) -> None:
        """Undeclare everything, tokens first."""
        undeclare_all(self._tokens, self._publishers, self._subscribers)

    def _announce(self, kind: str, topic: Topic) -> None:
        reliability = _RELIABLE if topic.reliability == "reliable" else _BEST_EFFORT
        qos = f":{reliability}:{_VOLATILE}:{_KEEP_LAST},{DEPTH}"
        if self._types.distribution != "humble":
            qos += f":typehash={self._types.type_hash(topic.message)};"
        parts = (_key(topic).replace("/", "§"), topic.message.replace("/", "§"), qos)
        token = f"@/{self._session.zid()}/@ros2_lv/{kind}/{'/'.join(parts)}"
        self._tokens.append(self._session.liveliness().declare_token(token))


def _key(topic: Topic) -> str:
    return topic.name.removeprefix("/")
