"""A second source of `/clock` in one ROS domain: a node that publishes it looks for others and warns.

A node with `use_sim_time` takes every message on `/clock`, so with two sources its time jumps back and forth.
"""

from __future__ import annotations

from collections import Counter

from ..gateway.link import two_clocks
from ..messages.topics import CLOCK_TOPIC
from .rclpy_modules import RosNode, steady_timer

__all__ = ["ClockWatch"]

_INTERVAL_S = 1.0
_UNKNOWN = "_NODE_NAME_UNKNOWN_"


class ClockWatch:
    """Warns once of every other node that publishes `/clock`, and says which setting stops this node from it."""

    def __init__(self, node: RosNode, setting: str) -> None:
        self._node = node
        self._setting = setting
        self._reported: set[str] = set()
        self._timer = steady_timer(node, _INTERVAL_S, self._look)

    def close(self) -> None:
        """Stop looking."""
        self._node.destroy_timer(self._timer)

    def _look(self) -> None:
        names = Counter(
            f"{info.node_namespace.rstrip('/')}/{info.node_name}"
            for info in self._node.get_publishers_info_by_topic(CLOCK_TOPIC)
        )
        names[self._node.get_fully_qualified_name()] -= 1
        for name in sorted(+names):
            if name not in self._reported:
                self._reported.add(name)
                other = "a program that gives no name" if _UNKNOWN in name else f"the node '{name}'"
                self._node.get_logger().warning(two_clocks(other, self._setting))
