"""Two sources of `/clock` in one ROS domain: a node of rclpy that is one of them looks for others, and warns.

Whoever runs with `use_sim_time` takes every message on `/clock`: with two sources its time jumps back and forth.
"""

from __future__ import annotations

from collections import Counter

from .node_parameters import RosNode
from .rclpy_modules import ros_module

__all__ = ["CLOCK_TOPIC", "ClockWatch", "two_clocks"]

CLOCK_TOPIC = "/clock"

_LOOK_S = 1.0
_UNKNOWN = "_NODE_NAME_UNKNOWN_"


def two_clocks(other: str, way_out: str) -> str:
    """The warning that ``other`` publishes `/clock`, too; ``way_out`` is the setting by which this side stops."""
    return (
        f"{other} publishes /clock, too, so the time of nodes with use_sim_time jumps between the two. "
        f"Let only one of them publish it (here: {way_out}), or keep them in different ROS domains."
    )


class ClockWatch:
    """Warns of every other node that publishes `/clock`, once.

    Args:
        node: a node that publishes `/clock` itself; stays the caller's.
        way_out: the setting by which it does not.
    """

    def __init__(self, node: RosNode, way_out: str) -> None:
        self._node = node
        self._way_out = way_out
        self._told: set[str] = set()
        clock = ros_module("rclpy.clock")
        steady = clock.Clock(clock_type=clock.ClockType.STEADY_TIME)
        self._timer = node.create_timer(_LOOK_S, self._look, clock=steady)

    def close(self) -> None:
        """Look no more."""
        self._node.destroy_timer(self._timer)

    def _look(self) -> None:
        names = Counter(
            f"{info.node_namespace.rstrip('/')}/{info.node_name}"
            for info in self._node.get_publishers_info_by_topic(CLOCK_TOPIC)
        )
        names[self._node.get_fully_qualified_name()] -= 1
        for name in sorted(+names):
            if name not in self._told:
                self._told.add(name)
                other = "a program that gives no name" if _UNKNOWN in name else f"the node '{name}'"
                self._node.get_logger().warning(two_clocks(other, self._way_out))
