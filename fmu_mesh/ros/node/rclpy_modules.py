"""What a ROS node of ours needs of ROS itself: fields of its messages, timers on its steady clock, who has `/clock`."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable
from functools import partial
from typing import Any

from ...ros_wire.definitions import Array, Basic, FieldType, FieldTypes, Nested, Sequence
from ...ros_wire.rclpy_profile import RosNode, message_class, ros_module
from ...ros_wire.topics import CLOCK_TOPIC
from ..gateway.link import two_clocks

__all__ = ["RosTypes", "other_clocks", "steady_timer", "time_message", "watch_clock"]

_INTERVAL_S = 1.0
_UNKNOWN = "_NODE_NAME_UNKNOWN_"

_ARRAY = re.compile(r"(?P<sequence>sequence<)?(?P<element>.*?)(, (?P<bound>\d+))?(>|\[(?P<length>\d+)\])")
_KINDS = {"boolean": "bool", "octet": "byte", "float": "float32", "double": "float64"}


class RosTypes(FieldTypes):
    """The message types of the ROS of this Python."""

    def fields(self, message: str) -> tuple[tuple[str, FieldType], ...]:
        """The fields of a message, in order; raises as `message_class` does."""
        kinds: dict[str, str] = message_class(message).get_fields_and_field_types()
        return tuple((name, _field_type(kind)) for name, kind in kinds.items())


def _field_type(text: str) -> FieldType:
    """The field that rclpy describes as `double`, `double[36]`, `geometry_msgs/Pose` or `sequence<octet, 3>`."""
    if (found := _ARRAY.fullmatch(text)) is not None and (found["sequence"] or found["length"]):
        element = _field_type(found["element"])
        assert isinstance(element, Basic | Nested)  # ROS has no arrays of arrays
        return Array(element, int(found["length"])) if found["length"] else Sequence(element, int(found["bound"] or 0))
    package, slash, name = text.partition("/")
    kind = package.partition("<")[0]  # without the length limit of a string
    return Nested(f"{package}/msg/{name}") if slash else Basic(_KINDS.get(kind, kind))


def time_message(time: int) -> Any:  # noqa: ANN401 a message has no types where ROS is not installed
    """``time`` in ns as a `builtin_interfaces/msg/Time`."""
    sec, nanosec = divmod(time, 1_000_000_000)
    return message_class("builtin_interfaces/msg/Time")(sec=sec, nanosec=nanosec)


def steady_timer(node: RosNode, period_s: float, callback: Callable[[], None]) -> Any:  # noqa: ANN401 as above
    """Create a timer of a node that also runs while simulated time stands still."""
    clock = ros_module("rclpy.clock")
    return node.create_timer(period_s, callback, clock=clock.Clock(clock_type=clock.ClockType.STEADY_TIME))


def watch_clock(node: RosNode, setting: str) -> Callable[[], None]:
    """Warn once of every other node that publishes `/clock`, until the function is called that this returns.

    A node with `use_sim_time` takes every message on `/clock`, so with two sources its time jumps back and forth. The
    warning says which ``setting`` keeps this node from publishing it.
    """
    reported: set[str] = set()

    def look() -> None:
        for other in other_clocks(node):
            if other not in reported:
                reported.add(other)
                node.get_logger().warning(two_clocks(other, setting))

    return partial(node.destroy_timer, steady_timer(node, _INTERVAL_S, look))


def other_clocks(node: RosNode) -> tuple[str, ...]:
    """Who else publishes `/clock`, in words, where ``node`` publishes it."""
    infos = node.get_publishers_info_by_topic(CLOCK_TOPIC)
    names = Counter(f"{info.node_namespace.rstrip('/')}/{info.node_name}" for info in infos)
    names[node.get_fully_qualified_name()] -= 1
    return tuple(
        "a program that gives no name" if _UNKNOWN in name else f"the node '{name}'" for name in sorted({*+names})
    )
