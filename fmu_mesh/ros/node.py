"""`python -m fmu_mesh.ros.node`: an FMU as a ROS 2 lifecycle node, a drop-in for `fmi_adapter_node`.

rclpy comes from the user's own ROS; importing this module does not need it. A program of its own can put the node into
its executor: `create_node`.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Sequence
from typing import Any

from ..errors import ConfigurationError, FmuMeshError
from .fmu_node import PARAMETERS, FmuNode
from .node_parameters import RosNode
from .peer import ros_module

__all__ = ["create_node", "main"]

NODE_NAME = "fmi_adapter_node"


def create_node(name: str = NODE_NAME, **options: Any) -> RosNode:  # noqa: ANN401 those of rclpy
    """A lifecycle node that runs an FMU; `rclpy.init` comes before it.

    Its attribute `fmu_node` is the `FmuNode` behind it. Call `fmu_node.close()` before `destroy_node()`.

    Args:
        name: of the node.
        options: more arguments of `rclpy.lifecycle.LifecycleNode`, such as ``namespace`` or ``parameter_overrides``.

    Raises:
        ConfigurationError: there is no ROS in this Python.
    """
    lifecycle = ros_module("rclpy.lifecycle")
    # The base class is not there to derive from before this moment, so the class is made here.
    transitions = {
        "on_configure": _transition(FmuNode.configure),
        "on_activate": _transition(FmuNode.activate),
        "on_deactivate": _transition(FmuNode.deactivate),
        "on_cleanup": _transition(FmuNode.cleanup),
        "on_shutdown": _transition(FmuNode.cleanup),
        "on_error": _transition(FmuNode.cleanup),
    }
    node = type("FmuLifecycleNode", (lifecycle.LifecycleNode,), transitions)(name, **options)
    descriptor = ros_module("rcl_interfaces.msg").ParameterDescriptor
    for parameter, (default, description) in PARAMETERS.items():
        node.declare_parameter(parameter, default, descriptor(description=description))
    autostart = descriptor(description="Whether the node configures and activates itself.")
    node.declare_parameter("autostart", False, autostart)  # noqa: FBT003 the default value
    node.fmu_node = FmuNode(node)
    return node


def _transition(act: Callable[[FmuNode], None]) -> Callable[[Any, Any], Any]:
    """A transition of the lifecycle: an error that is nobody's fault leaves the state as it is, with the reason."""

    def on_transition(node: Any, _state: Any) -> Any:  # noqa: ANN401 types of rclpy
        answer = ros_module("rclpy.lifecycle").TransitionCallbackReturn
        fmu_node: FmuNode = node.fmu_node
        try:
            act(fmu_node)
        except FmuMeshError as error:
            if fmu_node.failure is not None:
                return answer.ERROR  # told already; `on_error` cleans up, and the node can be configured again
            node.get_logger().error(str(error))
            return answer.FAILURE
        except Exception as error:  # noqa: BLE001 rclpy would swallow it
            node.get_logger().fatal(f"internal error: {error!r}")
            return answer.ERROR
        return answer.SUCCESS

    return on_transition


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the node until ROS is shut down; returns the exit code."""
    try:
        rclpy = ros_module("rclpy")
        executors = ros_module("rclpy.executors")
    except ConfigurationError as error:
        print(f"fmu_mesh.ros.node: {error}", file=sys.stderr)  # noqa: T201 nobody else is there to tell
        return error.exit_code
    rclpy.init(args=None if arguments is None else [sys.argv[0], *arguments])
    node = create_node()
    fmu_node: FmuNode = node.fmu_node
    try:
        if node.get_parameter("autostart").value:
            node.trigger_configure()
            node.trigger_activate()
        rclpy.spin(node)
    except (KeyboardInterrupt, executors.ExternalShutdownException):
        pass
    finally:
        returned = fmu_node.close()
        node.destroy_node()
        rclpy.try_shutdown()
    exit_code = fmu_node.failure.exit_code if fmu_node.failure is not None else 0
    if not returned:
        # A thread that is inside the FMU for ever would keep this process alive for ever.
        os._exit(exit_code or 3)
    return exit_code


if __name__ == "__main__":
    sys.exit(main())
