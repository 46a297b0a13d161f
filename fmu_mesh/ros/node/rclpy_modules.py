"""The modules of ROS itself, which come from the user's own ROS and are imported when they are needed.

They are no dependency of this package: a ROS is installed, and sourced, by its user.
"""

from __future__ import annotations

import importlib
from typing import Any

from ...errors import ConfigurationError

__all__ = ["message_class", "ros_module"]


def ros_module(name: str) -> Any:  # noqa: ANN401 its types are not there where ROS is not
    """A module of ROS, such as `rclpy.lifecycle`.

    Raises:
        ConfigurationError: this Python has no ROS, or not this part of it.
    """
    try:
        return importlib.import_module(name)
    except ImportError as error:
        package = name.partition(".")[0]
        raise ConfigurationError(
            f"the ROS package '{package}' cannot be imported: {error}.",
            hint="Source your ROS first (`source /opt/ros/DISTRO/setup.bash`) and use its Python; the package has to "
            "be installed there.",
        ) from error


def message_class(type_name: str) -> Any:  # noqa: ANN401 as above
    """The class of a message type such as `std_msgs/msg/Float64`.

    Raises:
        ConfigurationError: there is no such type in the user's ROS.
    """
    parts = type_name.split("/")
    if len(parts) != 3 or parts[1] != "msg":
        raise ConfigurationError(f"'{type_name}' is no message type.", hint="Write PACKAGE/msg/TYPE.")
    module = ros_module(f"{parts[0]}.msg")
    found = getattr(module, parts[2], None)
    if found is None:
        raise ConfigurationError(f"the ROS package '{parts[0]}' has no message type '{parts[2]}'.")
    return found
