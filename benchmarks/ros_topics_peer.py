"""A ROS node of the benchmark `ros_topics`: with rclpy, or on Zenoh with the keys and attachments of rmw_zenoh.

One argument, JSON: `middleware` (`rclpy` or `rmw_zenoh`), `role`, `port` and `domain` of the router, `count`,
`rate_hz`. An `echo` publishes what it receives, until its standard input ends. A `ping` sends numbered values and
prints one JSON line: how long each took to come back in ms, and how many did not. With `ahead_s` it then sends as many
with stamps of simulation time, and prints another line: how many of them the mesh has never used.
"""

from __future__ import annotations

import itertools
import json
import struct
import sys
import threading
import time
from collections.abc import Callable
from typing import Any, Final, Protocol

FLOAT: Final = "std_msgs/msg/Float64"
TWIST: Final = "geometry_msgs/msg/TwistStamped"
CLOCK: Final = "rosgraph_msgs/msg/Clock"

_DEADLINE_S: Final = 60.0
_LAST_S: Final = 5.0
"""How long a value that has not come back may still be on its way."""

Take = Callable[[float, int], None]
"""Gets the value of a message and its stamp in ns."""


class Node(Protocol):
    """A node of one middleware."""

    def publish(self, topic: str, kind: str) -> Take:
        """Declare a publisher; the result sends a value with a stamp in ns."""

    def subscribe(self, topic: str, kind: str, take: Take) -> None:
        """Declare a subscriber."""


class ZenohNode:
    """A peer, as nodes of rmw_zenoh are: a router introduces it to others, and they connect directly."""

    def __init__(self, port: int, domain: int) -> None:
        import zenoh  # noqa: PLC0415  only one of the two middlewares is used

        from fmu_mesh.ros_wire.definitions import MessageTypes  # noqa: PLC0415  as above

        config = zenoh.Config()
        config.insert_json5("mode", '"peer"')
        config.insert_json5("scouting/multicast/enabled", "false")
        config.insert_json5("listen/endpoints", '["tcp/127.0.0.1:0"]')
        config.insert_json5("connect/endpoints", f'["tcp/127.0.0.1:{port}"]')
        self._session = zenoh.open(config)
        self._block = zenoh.CongestionControl.BLOCK
        self._types = MessageTypes("kilted")
        self._domain = domain

    def publish(self, topic: str, kind: str) -> Take:
        """See `Node`."""
        from fmu_mesh.ros_wire.cdr import Codec  # noqa: PLC0415  only one of the two middlewares is used

        codec, numbers = Codec(self._types, kind), itertools.count(1)
        publisher = self._session.declare_publisher(self._key(topic, kind), congestion_control=self._block)
        vector = {"y": 0.0, "z": 0.0}

        def put(value: float, stamp: int) -> None:
            message: dict[str, Any] = {"data": value}
            if kind == TWIST:
                header = {"stamp": {"sec": stamp // 10**9, "nanosec": stamp % 10**9}, "frame_id": ""}
                twist = {"linear": {"x": value, **vector}, "angular": {"x": 0.0, **vector}}
                message = {"header": header, "twist": twist}
            attachment = struct.pack("<qqB16s", next(numbers), stamp, 16, bytes(16))
            publisher.put(codec.encode(message), attachment=attachment)

        return put

    def subscribe(self, topic: str, kind: str, take: Take) -> None:
        """See `Node`."""
        from fmu_mesh.ros_wire.cdr import Codec  # noqa: PLC0415  only one of the two middlewares is used

        codec = Codec(self._types, kind)

        def arrived(sample: Any) -> None:  # noqa: ANN401  a sample of Zenoh
            message = codec.decode(sample.payload.to_bytes())
            if kind == FLOAT:
                take(message["data"], 0)
                return
            stamp = message["clock"] if kind == CLOCK else message["header"]["stamp"]
            value = message["twist"]["linear"]["x"] if kind == TWIST else 0.0
            take(value, stamp["sec"] * 10**9 + stamp["nanosec"])

        self._session.declare_subscriber(self._key(topic, kind), arrived)

    def _key(self, topic: str, kind: str) -> str:
        typed = f"{kind.replace('/msg/', '::msg::dds_::')}_/{self._types.type_hash(kind)}"
        return f"{self._domain}{topic}/{typed}"


class RclpyNode:
    """A node of rclpy, whose callbacks run on a thread of its own."""

    def __init__(self, role: str) -> None:
        import rclpy  # noqa: PLC0415  only one of the two middlewares is used
        from rclpy.qos import QoSProfile  # noqa: PLC0415  as above

        rclpy.init()
        self._node = rclpy.create_node(role)
        self._qos = QoSProfile(depth=10_000)
        threading.Thread(target=rclpy.spin, args=(self._node,), daemon=True).start()

    def publish(self, topic: str, kind: str) -> Take:
        """See `Node`."""
        made = _class_of(kind)
        publisher = self._node.create_publisher(made, topic, self._qos)

        def put(value: float, stamp: int) -> None:
            message = made()
            if kind == TWIST:
                message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp, 10**9)
                message.twist.linear.x = value
            else:
                message.data = value
            publisher.publish(message)

        return put

    def subscribe(self, topic: str, kind: str, take: Take) -> None:
        """See `Node`."""

        def arrived(message: Any) -> None:  # noqa: ANN401  a message of ROS
            if kind == FLOAT:
                take(message.data, 0)
                return
            stamp = message.clock if kind == CLOCK else message.header.stamp
            take(message.twist.linear.x if kind == TWIST else 0.0, stamp.sec * 10**9 + stamp.nanosec)

        self._node.create_subscription(_class_of(kind), topic, arrived, self._qos)


def _class_of(kind: str) -> Any:  # noqa: ANN401  a class that ROS generates
    package, _, name = kind.split("/")
    return getattr(__import__(f"{package}.msg", fromlist=[name]), name)


class Returned:
    """When each value has come back first, and when it was sent, in s."""

    def __init__(self) -> None:
        self.at: dict[float, float] = {}
        self.sent: dict[float, float] = {}
        self.stamp = 0
        self._changed = threading.Condition()

    def take(self, value: float, stamp: int) -> None:
        """A value, or a tick of the clock, has arrived."""
        now = time.monotonic()
        with self._changed:
            self.at.setdefault(value, now)
            self.stamp = max(self.stamp, stamp)
            self._changed.notify()

    def wait(self, is_enough: Callable[[], bool], seconds: float) -> bool:
        """Wait until something is so, at most for some seconds."""
        with self._changed:
            return self._changed.wait_for(is_enough, seconds)

    def send(self, put: Take, count: int, rate_hz: float, first_ns: int) -> None:
        """Send the values 1, 2, ... at this rate, with a stamp for each; then wait until the last ones are back."""
        began, pause = time.monotonic(), threading.Event()
        for number in range(count):
            if (left := began + number / rate_hz - time.monotonic()) > 0:
                pause.wait(left)
            self.sent[number + 1.0] = time.monotonic()
            put(number + 1.0, first_ns + round(number * 1e9 / rate_hz))
        self.wait(lambda: self.sent.keys() <= self.at.keys(), _LAST_S)

    @property
    def missing(self) -> int:
        """How many values have not come back."""
        return len(self.sent.keys() - self.at.keys())

    @property
    def round_trips_ms(self) -> list[float]:
        """How long those that have come back took."""
        return [1e3 * (self.at[value] - sent) for value, sent in self.sent.items() if value in self.at]


def ping(node: Node, orders: dict[str, Any]) -> None:
    """Measure, and print what was measured."""
    returned, put = Returned(), node.publish("/u", FLOAT)
    node.subscribe("/y", FLOAT, returned.take)
    for number in itertools.count(1):  # until both ways are there
        put(-float(number), 0)
        if returned.wait(lambda: any(value < 0.0 for value in returned.at), 0.05):
            break
        if number > _DEADLINE_S / 0.05:
            sys.exit("nothing comes back")
    count, rate = orders["count"], orders["rate_hz"]
    returned.send(put, count, rate, 0)
    _say(round_trips_ms=returned.round_trips_ms, missing=returned.missing)
    if "ahead_s" not in orders:
        return
    clock, timed, put_timed = Returned(), Returned(), node.publish("/timed", TWIST)
    node.subscribe("/clock", CLOCK, clock.take)
    node.subscribe("/timed_y", TWIST, timed.take)
    if not clock.wait(lambda: clock.stamp > 0, _DEADLINE_S):
        sys.exit("there is no /clock")
    ahead_ns = round(1e9 * orders["ahead_s"])
    for number in itertools.count(1):  # without a stamp, until both ways are there
        put_timed(-float(number), 0)
        if timed.wait(lambda: any(value < 0.0 for value in timed.at), 0.05):
            break
        if number > _DEADLINE_S / 0.05:
            sys.exit("nothing with a stamp comes back")
    period_ns = round(1e9 / rate)
    timed.send(put_timed, count, rate, (clock.stamp + ahead_ns) // period_ns * period_ns)
    _say(missing=timed.missing)


def echo(node: Node) -> None:
    """Send back what arrives."""
    put = node.publish("/y", FLOAT)
    node.subscribe("/u", FLOAT, put)
    _say(ready=True)


def _say(**what: object) -> None:
    print(json.dumps(what), flush=True)


def main() -> None:
    """Be the node that the argument says."""
    orders = json.loads(sys.argv[1])
    is_zenoh = orders["middleware"] == "rmw_zenoh"
    node: Node = ZenohNode(orders["port"], orders["domain"]) if is_zenoh else RclpyNode(orders["role"])
    if orders["role"] == "echo":
        echo(node)
    else:
        ping(node, orders)
    sys.stdin.read()


if __name__ == "__main__":
    main()
