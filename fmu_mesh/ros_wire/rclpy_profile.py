"""Topics through rclpy, and the modules and message classes of ROS itself.

The user installs and sources ROS; it is not a dependency of this package. So its modules are imported when they are
needed.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable
from contextlib import ExitStack
from functools import partial
from typing import Any, Literal

from ..errors import ConfigurationError
from ..wire.views import RosTopicView
from .profile import Put, Take
from .topics import Topic

__all__ = ["HOW_TO_GET_ROS", "RclpyProfile", "RosNode", "message_class", "ros_module"]

HOW_TO_GET_ROS = (
    "Source your ROS first (`source /opt/ros/DISTRO/setup.bash`) and use its Python; the package has to be installed "
    "there."
)

RosNode = Any
"""`rclpy.node.Node`, which has no types where ROS is not installed."""


def ros_module(name: str) -> Any:  # noqa: ANN401 a module of ROS has no types where ROS is not installed
    """Import a module of ROS, such as `rclpy.lifecycle`.

    Raises:
        ConfigurationError: this Python has no ROS, or ROS has no such module.
    """
    try:
        return importlib.import_module(name)
    except ImportError as error:
        package = name.partition(".")[0]
        raise ConfigurationError(
            f"the ROS package '{package}' cannot be imported: {error}.",
            hint=HOW_TO_GET_ROS,
        ) from error


def message_class(type_name: str) -> Any:  # noqa: ANN401 as above
    """The class of a message type such as `std_msgs/msg/Float64`.

    Raises:
        ConfigurationError: ROS has no such type.
    """
    parts = type_name.split("/")
    if len(parts) != 3 or parts[1] != "msg":
        raise ConfigurationError(f"'{type_name}' is no message type.", hint="Write PACKAGE/msg/TYPE.")
    module = ros_module(f"{parts[0]}.msg")
    found = getattr(module, parts[2], None)
    if found is None:
        raise ConfigurationError(f"the ROS package '{parts[0]}' has no message type '{parts[2]}'.")
    return found


class RclpyProfile:
    """A profile whose topics are those of a node of rclpy, which takes and returns messages as CDR bytes."""

    def __init__(self, node: RosNode) -> None:
        self._node = node
        self._entities = ExitStack()
        self._partners: list[tuple[str, Literal["in", "out"], Callable[[], int]]] = []

    def publish(self, topic: Topic) -> Put:
        """Create a publisher of ``topic``."""
        publisher = self._node.create_publisher(message_class(topic.message), topic.name, _quality(topic))
        self._entities.callback(self._node.destroy_publisher, publisher)
        self._partners.append((topic.name, "out", publisher.get_subscription_count))

        def put(data: bytes, _time: float) -> None:
            try:
                publisher.publish(data)
            except Exception:
                # Ctrl-C shuts ROS down while samples still arrive; nothing can be published any more.
                if self._node.context.ok():
                    raise

        return put

    def subscribe(self, topic: Topic, take: Take) -> None:
        """Create a subscription of ``topic``."""
        kind = message_class(topic.message)
        subscription = self._node.create_subscription(kind, topic.name, take, _quality(topic), raw=True)
        self._entities.callback(self._node.destroy_subscription, subscription)
        # Older rclpy also counts those that offer less than this topic asks for.
        counted = getattr(subscription, "get_publisher_count", None) or partial(self._node.count_publishers, topic.name)
        self._partners.append((topic.name, "in", counted))

    def topics(self) -> tuple[RosTopicView, ...]:
        """All topics, and which of them have a partner."""
        return tuple(RosTopicView(name, direction, counted() > 0) for name, direction, counted in [*self._partners])

    def unheard(self) -> list[str]:
        """The published topics that nobody subscribes to."""
        return [own.topic for own in self.topics() if own.direction == "out" and not own.matched]

    def close(self) -> None:
        """Destroy everything."""
        self._entities.close()


def _quality(topic: Topic) -> Any:  # noqa: ANN401 a type of rclpy
    qos, own = ros_module("rclpy.qos"), topic.qos
    duration = ros_module("rclpy.duration").Duration
    return qos.QoSProfile(
        depth=own.depth,
        reliability=qos.ReliabilityPolicy[own.reliability.upper()],
        durability=qos.DurabilityPolicy[own.durability.upper()],
        deadline=duration(seconds=own.deadline or 0.0),  # 0 is none
    )
