"""A ROS 2 node of its own (rclpy, Fast DDS) that listens and talks as its arguments say.

One argument, JSON: `subscribe` and `publish` (message type by topic), `count` (samples of every kind), `rate_hz`,
`sim_time` (publish with stamps of /clock, this much ahead in s). It prints one JSON line when all of its topics have a
partner, and one with everything that it has received when every topic has had `count` samples and all are sent.
"""

from __future__ import annotations

import importlib
import json
import sys
from typing import Any

import rclpy
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile

DEPTH = QoSProfile(depth=5000)


def message_class(name: str) -> Any:  # noqa: ANN401 a class that ROS generates
    package, _, kind = name.split("/")
    return getattr(importlib.import_module(f"{package}.msg"), kind)


def plain(message: Any) -> Any:  # noqa: ANN401 any message
    if hasattr(message, "get_fields_and_field_types"):
        return {name: plain(getattr(message, name)) for name in message.get_fields_and_field_types()}
    return list(message) if hasattr(message, "typecode") else message


def say(**what: object) -> None:
    print(json.dumps(what), flush=True)  # noqa: T201 (it is the answer)


class Peer(Node):  # type: ignore[misc]  # rclpy is not always there, so mypy leaves it out
    """The node."""

    def __init__(self, orders: dict[str, Any]) -> None:
        ahead = orders.get("sim_time")
        overrides = [Parameter("use_sim_time", value=ahead is not None)]
        super().__init__("peer", parameter_overrides=overrides)
        self.count: int = orders["count"]
        self.ahead_s: float = ahead or 0.0
        self.received: dict[str, list[Any]] = {topic: [] for topic in orders.get("subscribe", {})}
        self.types: dict[str, str] = orders.get("publish", {})
        self.sent = 0
        self.stamps: list[int] = []
        for topic, kind in orders.get("subscribe", {}).items():
            self.create_subscription(message_class(kind), topic, self._keeper(topic), DEPTH)
        self.outgoing = {
            topic: self.create_publisher(message_class(kind), topic, DEPTH) for topic, kind in self.types.items()
        }
        self.period_s = 1.0 / orders.get("rate_hz", 100.0)

    def _keeper(self, topic: str) -> Any:  # noqa: ANN401 a callback
        return lambda message: self.received[topic].append(plain(message))

    def matched(self) -> bool:
        heard = all(self.count_publishers(topic) for topic in self.received)
        told = all(publisher.get_subscription_count() for publisher in self.outgoing.values())
        return heard and told and (not self.ahead_s or self.get_clock().now().nanoseconds > 0)

    def start(self) -> None:
        """Send one message of each kind per period, by the wall clock."""
        clock = Clock(clock_type=ClockType.STEADY_TIME)
        self.first_ns = self.get_clock().now().nanoseconds + int(self.ahead_s * 1e9)
        self.timer = self.create_timer(self.period_s, self.send, clock=clock)

    def send(self) -> None:
        if self.sent == self.count:
            self.timer.cancel()
            return
        self.sent += 1
        stamp = self.first_ns + round(self.sent * self.period_s * 1e9)
        for topic, publisher in self.outgoing.items():
            message = message_class(self.types[topic])()
            if hasattr(message, "header"):
                message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp, 10**9)
                message.twist.linear.x, message.twist.angular.z = 0.5 * self.sent, -0.1 * self.sent
            elif self.types[topic].endswith("String"):
                message.data = f"text {self.sent}"
            else:
                message.data = 0.1 * self.sent
            publisher.publish(message)
        self.stamps.append(stamp)

    def done(self) -> bool:
        heard = all(len(samples) >= self.count for samples in self.received.values())
        return heard and (not self.outgoing or self.sent == self.count)


def main() -> None:
    rclpy.init()
    peer = Peer(json.loads(sys.argv[1]))
    while not peer.matched():
        rclpy.spin_once(peer, timeout_sec=0.1)
    say(matched=True)
    if peer.outgoing:
        peer.start()
    while not peer.done():
        rclpy.spin_once(peer, timeout_sec=0.1)
    topics = [*peer.received, *peer.outgoing]
    ends = {
        topic: [*peer.get_publishers_info_by_topic(topic), *peer.get_subscriptions_info_by_topic(topic)]
        for topic in topics
    }
    say(
        received=peer.received,
        stamps=peer.stamps,
        graph=dict(peer.get_topic_names_and_types()),
        hashes={topic: sorted({str(end.topic_type_hash) for end in own}) for topic, own in ends.items()},
    )
    sys.stdin.read()
    peer.destroy_node()
    rclpy.shutdown()


if __name__ == "__main__":
    main()
