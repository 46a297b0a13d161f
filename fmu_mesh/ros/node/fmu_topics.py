"""The publishers and subscriptions of one FMU in a ROS node, and the messages that wait for the FMU.

Which topics there are and how messages are filled is the matter of `fmu_mesh.ros.node.node_topics`.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from typing import Any

from ...errors import CallRefused
from ..messages.topics import Topic
from .driving import FmuDriver, FmuThread, Update
from .node_topics import fill, message_time, values_in
from .rclpy_modules import RosNode, message_class, ros_module

__all__ = ["LOG_INTERVAL_S", "FmuTopics"]

LOG_INTERVAL_S = 10.0
"""Time in s between two equal messages in the log."""

_DEPTH = 1000
_MAX_WAITING = 10_000


class FmuTopics:
    """Publishes the outputs of an FMU, and takes its inputs.

    While the node is inactive, only the last message of each topic is kept, for `start`.

    Args:
        node: the node; the caller destroys it.
        driver: the FMU.
        thread: calls the FMU.
        now: returns the time that the FMU follows, in ns.
    """

    def __init__(self, node: RosNode, driver: FmuDriver, thread: FmuThread, now: Callable[[], int]) -> None:
        self._node = node
        self._log = node.get_logger()
        self._driver = driver
        self._thread = thread
        self._now = now
        self._publishers: list[tuple[Topic, Any, Any]] = []
        self._subscriptions: list[Any] = []
        self._held: dict[str, tuple[Topic, Any, int]] = {}
        self._started = False
        self._closed = False
        self._waiting = 0
        self._count = threading.Lock()

    @property
    def outputs(self) -> Sequence[str]:
        """The variables that are published."""
        return [port.variable.name for topic, _, _ in self._publishers for port in topic.ports]

    def open(self, topic: Topic) -> None:
        """Create the publisher or the subscription of a topic.

        Raises:
            ConfigurationError: ROS has no such message type.
        """
        kind = message_class(topic.message)
        overrides = ros_module("rclpy.qos_overriding_options").QoSOverridingOptions.with_default_policies()
        if topic.direction == "out":
            publisher = self._node.create_publisher(kind, topic.name, _DEPTH, qos_overriding_options=overrides)
            self._publishers.append((topic, publisher, kind))
            return

        def arrived(message: Any) -> None:  # noqa: ANN401 a ROS message
            self._arrived(topic, message)

        self._subscriptions.append(
            self._node.create_subscription(kind, topic.name, arrived, _DEPTH, qos_overriding_options=overrides)
        )

    def start(self) -> None:
        """Give the FMU the messages that were kept, and from now on every message."""
        for topic, message, arrived in self._held.values():
            self._thread.call(self._take, topic, message, arrived)
        self._held.clear()
        self._started = True

    def stop(self) -> None:
        """From now on only keep the last message of each topic."""
        self._started = False

    def publish(self, update: Update) -> None:
        """Publish the outputs of an update; called on the thread of the FMU."""
        for topic, publisher, kind in self._publishers:
            message = kind()
            fill(topic, message, update.values, update.time)
            publisher.publish(message)

    def close_inputs(self) -> None:
        """Destroy the subscriptions and drop the messages that wait; before the FMU is closed."""
        self._closed = True
        for subscription in self._subscriptions:
            self._node.destroy_subscription(subscription)

    def close_outputs(self) -> None:
        """Destroy the publishers; after the FMU is closed, because its thread publishes."""
        for _, publisher, _ in self._publishers:
            self._node.destroy_publisher(publisher)

    def _arrived(self, topic: Topic, message: Any) -> None:  # noqa: ANN401 a ROS message
        arrived = self._now()
        if not self._started:
            self._held[topic.name] = (topic, message, arrived)
            return
        with self._count:
            full = self._waiting >= _MAX_WAITING
            self._waiting += not full
        if full:
            self._log.error(
                f"{_MAX_WAITING} messages wait for the FMU; one on '{topic.name}' is lost",
                throttle_duration_sec=LOG_INTERVAL_S,
            )
            return
        self._thread.submit(self._take_waiting, topic, message, arrived)

    # --- on the thread of the FMU

    def _take_waiting(self, topic: Topic, message: Any, arrived: int) -> None:  # noqa: ANN401 a ROS message
        with self._count:
            self._waiting -= 1
        self._take(topic, message, arrived)

    def _take(self, topic: Topic, message: Any, arrived: int) -> None:  # noqa: ANN401 a ROS message
        if self._closed:
            return
        try:
            for variable, value in values_in(topic, message).items():
                self._driver.set_input(variable, message_time(message, arrived), value)
        except (CallRefused, IndexError) as error:
            self._log.error(f"a message on '{topic.name}' was left out: {error}", throttle_duration_sec=LOG_INTERVAL_S)
