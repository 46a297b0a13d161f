"""`python -m fmu_mesh.ros.node`: an FMU, or a mesh, as a ROS 2 lifecycle node; a drop-in for `fmi_adapter_node`.

With the parameter `fmu_path` it runs an FMU; with `config` it is the gateway of the mesh that this file describes.
rclpy comes from the user's own ROS; importing this module does not need it. A program of its own can put the node into
its executor: `create_node`.
"""

from __future__ import annotations

import os
import signal
import sys
import threading
from collections.abc import Callable, Sequence
from typing import Any, Protocol

from ...errors import ConfigurationError, FmuMeshError, Interrupted
from .autostart import Autostart
from .fmu_node import FmuNode
from .gateway_node import GatewayNode
from .node_parameters import RosNode
from .node_settings import PARAMETERS
from .rclpy_modules import ros_module

__all__ = ["create_node", "main"]

_END_S = 20.0

NODE_NAME = "fmi_adapter_node"


_MORE_PARAMETERS: dict[str, tuple[Any, str]] = {
    "config": ("", "Configuration of a running mesh, instead of an FMU: the node is its gateway."),
    "connect": ([""], "With config: Zenoh endpoints of the mesh; default: the meshes of this user on this host."),
    "autostart": (False, "Whether the node configures and activates itself."),
    "autostart_timeout": (60.0, "With autostart and config: how long to wait for the mesh, in s; 0.0: not at all."),
}


class Managed(Protocol):
    """What a lifecycle node is about; the methods are its transitions, and raise `FmuMeshError`.

    Attributes:
        failure: why it failed while it was active, until it is configured again.
    """

    failure: FmuMeshError | None

    def configure(self) -> None: ...

    def activate(self) -> None: ...

    def deactivate(self) -> None: ...

    def cleanup(self) -> None: ...

    def close(self) -> bool: ...


def create_node(name: str = NODE_NAME, **options: Any) -> RosNode:  # noqa: ANN401 those of rclpy
    """A lifecycle node that runs an FMU, or is the gateway of a mesh; `rclpy.init` comes before it.

    Its attribute `managed` is the `Managed` behind it. Call `managed.close()` before `destroy_node()`.

    Args:
        name: of the node.
        options: more arguments of `rclpy.lifecycle.LifecycleNode`, such as ``namespace`` or ``parameter_overrides``.

    Raises:
        ConfigurationError: there is no ROS in this Python.
    """
    lifecycle = ros_module("rclpy.lifecycle")
    # The base class is not there to derive from before this moment, so the class is made here.
    transitions = {
        "on_configure": _transition(_configure),
        "on_activate": _transition(lambda node: node.managed.activate()),
        "on_deactivate": _transition(lambda node: node.managed.deactivate()),
        "on_cleanup": _transition(lambda node: node.managed.cleanup()),
        "on_shutdown": _transition(lambda node: node.managed.cleanup()),
        "on_error": _transition(lambda node: node.managed.cleanup()),
    }
    node = type("FmuLifecycleNode", (lifecycle.LifecycleNode,), transitions)(name, **options)
    descriptor = ros_module("rcl_interfaces.msg").ParameterDescriptor
    for parameter, (default, description) in {**PARAMETERS, **_MORE_PARAMETERS}.items():
        node.declare_parameter(parameter, default, descriptor(description=description))
    node.managed = FmuNode(node)
    return node


def _configure(node: RosNode) -> None:
    """Become what the parameters say, and configure that."""
    config, fmu_path = (node.get_parameter(name).value for name in ("config", "fmu_path"))
    if config and fmu_path:
        raise ConfigurationError("the parameters 'config' and 'fmu_path' are both set.", hint="Set one of them.")
    kind = GatewayNode if config else FmuNode
    if not isinstance(node.managed, kind):
        node.managed.close()
        node.managed = kind(node)
    managed: Managed = node.managed
    managed.configure()


def _transition(act: Callable[[RosNode], None]) -> Callable[[Any, Any], Any]:
    """A transition of the lifecycle: an error that is nobody's fault leaves the state as it is, with the reason."""

    def on_transition(node: Any, _state: Any) -> Any:  # noqa: ANN401 types of rclpy
        answer = ros_module("rclpy.lifecycle").TransitionCallbackReturn
        try:
            act(node)
        except FmuMeshError as error:
            if node.managed.failure is not None:
                return answer.ERROR  # told already; `on_error` cleans up, and the node can be configured again
            node.get_logger().error(str(error))
            return answer.FAILURE
        except Exception as error:  # noqa: BLE001 rclpy would swallow it
            node.get_logger().fatal(f"internal error: {error!r}")
            return answer.ERROR
        return answer.SUCCESS

    return on_transition


def _wrong_arguments(error: Exception) -> str:
    """What is wrong with the command line of a node, in one line."""
    text = str(error).splitlines()[0] if str(error) else repr(error)
    if "'INTEGER'" in text and "'DOUBLE'" in text:
        return f"{text.rstrip('.')}. Write it with a point, such as 1.0."
    return text


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the node until ROS is shut down; returns the exit code."""
    try:
        rclpy = ros_module("rclpy")
        executors = ros_module("rclpy.executors")
    except ConfigurationError as error:
        print(f"fmu_mesh.ros.node: {error}", file=sys.stderr)  # noqa: T201 nobody else is there to tell
        return error.exit_code
    try:
        rclpy.init(args=None if arguments is None else [sys.argv[0], *arguments])
        node = create_node()
    except Exception as error:  # noqa: BLE001 whatever rclpy raises: the arguments are wrong, and it says which
        print(f"fmu_mesh.ros.node: {_wrong_arguments(error)}", file=sys.stderr)  # noqa: T201 as above
        rclpy.try_shutdown()
        return ConfigurationError.exit_code
    try:
        executor = executors.SingleThreadedExecutor()
        with Autostart(node, executor):
            rclpy.spin(node, executor)
    except (KeyboardInterrupt, executors.ExternalShutdownException):
        pass
    finally:
        # Whoever presses Ctrl-C again does not wait for the rest, and is shown no traceback either.
        signal.signal(signal.SIGINT, lambda *_: os._exit(Interrupted.exit_code))
        managed: Managed = node.managed
        # Neither an FMU that hangs nor the middleware's own shutdown may keep this process for ever.
        end = threading.Timer(_END_S, os._exit, (3,))
        end.daemon = True
        end.start()
        returned = managed.close()
        node.destroy_node()
        rclpy.try_shutdown()
    exit_code = managed.failure.exit_code if managed.failure is not None else 0
    if not returned:
        # A thread that is inside the FMU for ever would keep this process alive for ever.
        os._exit(exit_code or 3)
    end.cancel()
    return exit_code


if __name__ == "__main__":
    sys.exit(main())
