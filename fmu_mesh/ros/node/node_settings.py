"""The parameters of the node itself, and the simulated time that the node can generate."""

from __future__ import annotations

import math
import time
from pathlib import Path
from typing import Any

from ...errors import ConfigurationError
from .driving import DriveSettings
from .node_topics import own_names
from .rclpy_modules import RosNode

__all__ = ["PARAMETERS", "RESERVED", "NodeSettings", "PacedTime", "read_settings"]

PARAMETERS: dict[str, tuple[Any, str]] = {
    "fmu_path": ("", "Path of the FMU."),
    "step_size": (0.0, "Communication step size in s; 0.0: that of the FMU's default experiment."),
    "update_period": (0.01, "How often the FMU catches up with time and publishes its outputs, in s of wall clock."),
    "stop_time": (0.0, "Simulated time in s after which the node deactivates itself; 0.0: never."),
    "max_steps": (1000, "How many steps one update may take to catch up."),
    "stamped": (False, "Whether every number has a second topic NAME_stamped (geometry_msgs/msg/PointStamped)."),
    "names": ([""], "Other ROS names of variables, each as 'VARIABLE: NAME'."),
    "messages": ([""], "Fields of messages, each as 'TOPIC: {type: TYPE, fields: {PATH: VARIABLE}}'."),
    "publish_clock": (False, "Whether this node is the source of simulated time: it starts at 0 and goes to /clock."),
    "real_time_factor": (1.0, "With publish_clock: simulated over wall-clock time."),
    "config": ("", "Configuration of a running mesh, instead of an FMU: the node is its gateway."),
    "connect": ([""], "With config: Zenoh endpoints of the mesh; default: the meshes of this user on this host."),
    "autostart": (False, "Whether the node configures and activates itself."),
    "autostart_timeout": (60.0, "With autostart and config: how long to wait for the mesh, in s; 0.0: not at all."),
}
"""The parameters of the node itself, which it declares before it has an FMU: default and description."""

RESERVED = frozenset({*PARAMETERS, "use_sim_time", "start_type_description_service"})
"""Names of the parameters that every node has, which a variable of an FMU cannot have."""


class NodeSettings(DriveSettings, frozen=True, kw_only=True):
    """The checked parameters of a node that runs an FMU.

    Attributes:
        update_period: period of the timer in s.
        stamped: whether numeric variables have a second topic with a header.
        names: ROS names by variable, for variables whose usual name cannot be used.
        messages: entries of the parameter `messages`.
        publish_clock: whether the node is the source of simulated time.
        real_time_factor: simulated over wall-clock time.
    """

    update_period: float
    stamped: bool
    names: dict[str, str]
    messages: tuple[str, ...]
    publish_clock: bool
    real_time_factor: float


def read_settings(node: RosNode) -> NodeSettings:
    """Read the parameters of a node that runs an FMU.

    Raises:
        ConfigurationError: a value is missing or out of range.
    """
    value = {name: node.get_parameter(name).value for name in (*PARAMETERS, "use_sim_time")}
    if not value["fmu_path"]:
        raise ConfigurationError("the parameter 'fmu_path' is not set.", hint="It is the path of the FMU.")
    for name in ("step_size", "stop_time"):
        if not (math.isfinite(value[name]) and value[name] >= 0.0):
            raise ConfigurationError(f"the parameter '{name}' is {value[name]!r}; expected a time of 0.0 s or more.")
    for name in ("update_period", "real_time_factor", "max_steps"):
        if not (math.isfinite(value[name]) and value[name] > 0):
            raise ConfigurationError(f"the parameter '{name}' is {value[name]!r}; expected a number above 0.")
    if value["publish_clock"] and value["use_sim_time"]:
        raise ConfigurationError(
            "this node cannot publish /clock and run by it.", hint="Set either publish_clock or use_sim_time."
        )
    return NodeSettings(
        fmu_path=Path(value["fmu_path"]),
        step_size=value["step_size"] or None,
        stop_time=value["stop_time"] or None,
        max_steps=value["max_steps"],
        update_period=value["update_period"],
        stamped=value["stamped"],
        names=own_names(filter(None, value["names"])),
        messages=tuple(filter(None, value["messages"])),
        publish_clock=value["publish_clock"],
        real_time_factor=value["real_time_factor"],
    )


class PacedTime:
    """Simulated time that starts at 0 and runs at a multiple of wall-clock time; it starts paused."""

    def __init__(self, factor: float) -> None:
        self._factor = factor
        self._before = 0
        self._since: int | None = None

    def now(self) -> int:
        """The time in ns."""
        running = 0 if self._since is None else time.monotonic_ns() - self._since
        return self._before + round(running * self._factor)

    def resume(self) -> None:
        """Start, or continue after a pause."""
        if self._since is None:
            self._since = time.monotonic_ns()

    def pause(self) -> None:
        """Stop the time until `resume`."""
        self._before, self._since = self.now(), None
