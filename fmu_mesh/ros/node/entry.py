"""An FMU, or the gateway of a mesh, as a ROS 2 lifecycle node; a drop-in for `fmi_adapter_node`.

With the parameter `fmu_path` the node runs an FMU; with `config` it is the gateway of the mesh in that file.
"""

# Threads: the main thread spins the executor and makes the transitions. `autostart` waits for a mesh, so that services
# answer and Ctrl-C works meanwhile; it only creates a task for the executor. A timer ends the process if an FMU or the
# middleware does not return at the end. rclpy has a thread for SIGINT, which shuts ROS down while callbacks still use
# it; from the end on, SIGINT is ours and ends the process at once (ADR 0031).

from __future__ import annotations

import faulthandler
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from ...config.loading import LoadedConfig
from ...errors import ConfigurationError, FmuError, FmuMeshError, Interrupted
from ...ros_wire.rclpy_profile import RosNode, ros_module
from ..bags.playing import running_configuration
from .fmu_node import PARAMETERS, FmuNode
from .gateway_node import GatewayNode, meshes_of

__all__ = ["create_node", "main"]

NODE_NAME = "fmi_adapter_node"

_END_S = 20.0
"""How long the end of the node, and that of ROS, may take."""
_ATTEMPT_S = 2.0
"""Deadline of one question to the mesh that autostart waits for."""
_INTERVAL_S = 0.25
"""Time between two such questions."""
_ATTEMPT_END_S = 5.0
"""How long the end of the process waits for a question on its way."""


def create_node(name: str = NODE_NAME, **options: Any) -> RosNode:  # noqa: ANN401 those of rclpy
    """Create a lifecycle node that runs an FMU or is the gateway of a mesh.

    Call `rclpy.init` before it. The attribute `managed` of the node does what its transitions ask for; call
    `managed.close()` before `destroy_node()`.

    Args:
        name: of the node.
        options: more arguments of `rclpy.lifecycle.LifecycleNode`, such as ``namespace`` or ``parameter_overrides``.

    Raises:
        ConfigurationError: this Python has no ROS.

    Example:
        >>> node = create_node("pendulum", namespace="/lab")  # doctest: +SKIP
        >>> executor.add_node(node)  # doctest: +SKIP
    """
    return _node_class()(name, **options)


def _node_class() -> Any:  # noqa: ANN401, C901 a type of rclpy; a class, not one function
    """The class of the node; it is defined in a function because its base class exists only where ROS is."""
    lifecycle: Any = ros_module("rclpy.lifecycle")
    answer = lifecycle.TransitionCallbackReturn

    class FmuLifecycleNode(lifecycle.LifecycleNode):  # type: ignore[misc]  # rclpy has no types where ROS is missing
        """A lifecycle node whose transitions are those of `managed`."""

        def __init__(self, name: str, **options: object) -> None:
            super().__init__(name, **options)
            descriptor = ros_module("rcl_interfaces.msg").ParameterDescriptor
            for parameter, (default, description) in PARAMETERS.items():
                self.declare_parameter(parameter, default, descriptor(description=description))
            self.managed: FmuNode | GatewayNode = FmuNode(self)

        def on_configure(self, _state: object) -> object:
            return self._answer(self._configure)

        def on_activate(self, _state: object) -> object:
            return self._answer(self.managed.activate)

        def on_deactivate(self, _state: object) -> object:
            return self._answer(self.managed.deactivate)

        def on_cleanup(self, _state: object) -> object:
            return self._answer(self.managed.cleanup)

        on_shutdown = on_cleanup
        on_error = on_cleanup

        def _configure(self) -> None:
            """Choose the behaviour that the parameters ask for, and configure it."""
            config, fmu_path = (self.get_parameter(own).value for own in ("config", "fmu_path"))
            if config and fmu_path:
                raise ConfigurationError(
                    "the parameters 'config' and 'fmu_path' are both set.", hint="Set one of them."
                )
            kind = GatewayNode if config else FmuNode
            if not isinstance(self.managed, kind):
                self.managed.close()
                self.managed = kind(self)
            self.managed.configure()

        def _answer(self, transition: Callable[[], None]) -> object:
            """Make a transition. An `FmuMeshError` is logged and keeps the state, unless the FMU has failed."""
            try:
                transition()
            except FmuMeshError as error:
                if self.managed.failure is not None:
                    return answer.ERROR  # logged already; `on_error` cleans up, and the node can be configured again
                self.get_logger().error(str(error))
                return answer.FAILURE
            except Exception as error:  # noqa: BLE001 rclpy would ignore it
                self.get_logger().fatal(f"internal error: {error!r}")
                return answer.ERROR
            return answer.SUCCESS

    return FmuLifecycleNode


def _wrong_arguments(error: Exception) -> str:
    """What is wrong with the command line of a node, in one line."""
    text = str(error).splitlines()[0] if str(error) else repr(error)
    if "'INTEGER'" in text and "'DOUBLE'" in text:
        return f"{text.rstrip('.')}. Write it with a point, such as 1.0."
    return text


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the node until ROS is shut down.

    Args:
        arguments: of the command line, without the name of the program; None takes those of this process.

    Returns:
        The exit code.

    Example:
        >>> main(["--ros-args", "-p", "fmu_path:=fmus/DampedPendulum.fmu", "-p", "autostart:=true"])  # doctest: +SKIP
        0
    """
    try:
        rclpy = ros_module("rclpy")
        executors = ros_module("rclpy.executors")
    except ConfigurationError as error:
        print(f"fmu_mesh.ros.node: {error}", file=sys.stderr)  # noqa: T201 no logger of ROS is there
        return error.exit_code
    try:
        rclpy.init(args=None if arguments is None else [sys.argv[0], *arguments])
        node, executor = create_node(), executors.SingleThreadedExecutor()
    except Exception as error:  # noqa: BLE001 rclpy raises many types for wrong arguments, and each says which
        print(f"fmu_mesh.ros.node: {_wrong_arguments(error)}", file=sys.stderr)  # noqa: T201 as above
        with _deadline(f"ROS was not shut down within {_END_S:g} s", ConfigurationError.exit_code):
            rclpy.try_shutdown()
        return ConfigurationError.exit_code
    try:
        with _autostart(node, executor), _ctrl_c_is_never_told():
            rclpy.spin(node, executor)
    except (KeyboardInterrupt, executors.ExternalShutdownException):
        pass
    except Exception:
        # rclpy has a thread for Ctrl-C, which shuts ROS down while the executor, or a callback, is about to use it.
        if node.context.ok():
            raise
    finally:
        # A second Ctrl-C ends the process at once, without a traceback.
        signal.signal(signal.SIGINT, lambda *_: os._exit(Interrupted.exit_code))
        managed: FmuNode | GatewayNode = node.managed
        with _deadline(f"the node was not closed within {_END_S:g} s", FmuError.exit_code):
            returned = managed.close()
        exit_code = managed.failure.exit_code if managed.failure is not None else 0 if returned else FmuError.exit_code
        # All that is the node's own is closed: nothing is lost if the middleware does not end.
        with _deadline(f"ROS was not shut down within {_END_S:g} s", exit_code):
            executor.shutdown(0.0)  # otherwise the garbage collector destroys its parts in any order, with a message
            node.destroy_node()
            rclpy.try_shutdown()
    if not returned:
        # Python waits at its end for the thread that is still inside the FMU.
        os._exit(exit_code)
    return exit_code


@contextmanager
def _deadline(what: str, exit_code: int) -> Iterator[None]:
    """Ends the process if what is inside takes longer than `_END_S`; says so, and what every thread does."""

    def end() -> None:
        print(f"fmu_mesh.ros.node: {what}; the process ends without it", file=sys.stderr)  # noqa: T201 as above
        faulthandler.dump_traceback()
        os._exit(exit_code)

    timer = threading.Timer(_END_S, end)
    timer.daemon = True
    timer.start()
    try:
        yield
    finally:
        timer.cancel()


@contextmanager
def _ctrl_c_is_never_told() -> Iterator[None]:
    """Says nothing of a Ctrl-C in a callback of the garbage collector, where Python drops it; rclpy ends ROS then."""
    told = sys.unraisablehook

    def tell(dropped: Any) -> None:  # noqa: ANN401 its type is private to Python
        if not isinstance(dropped.exc_value, KeyboardInterrupt):
            told(dropped)

    sys.unraisablehook = tell
    try:
        yield
    finally:
        sys.unraisablehook = told


@contextmanager
def _autostart(node: RosNode, executor: Any) -> Iterator[None]:  # noqa: ANN401 a class of rclpy
    """Configures and activates a node if its parameter `autostart` is true; goes around the spinning of the node.

    The gateway of a mesh waits for the mesh on another thread, so services answer meanwhile and Ctrl-C ends the wait.
    """

    def start() -> None:
        done = ros_module("rclpy.lifecycle").TransitionCallbackReturn.SUCCESS
        if node.trigger_configure() == done:
            node.trigger_activate()

    autostart, config, fmu_path = (node.get_parameter(name).value for name in ("autostart", "config", "fmu_path"))
    if not autostart or not config or fmu_path:
        if autostart:
            start()
        yield
        return
    over = threading.Event()

    def wait_and_start() -> None:
        if _mesh_came(node, over):
            executor.create_task(start)

    thread = threading.Thread(target=wait_and_start, name="autostart", daemon=True)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join(_ATTEMPT_END_S)


def _mesh_came(node: RosNode, over: threading.Event) -> bool:
    """Wait until all instances of the mesh answer; after the timeout only say so."""
    timeout_s, ros_log = node.get_parameter("autostart_timeout").value, node.get_logger()
    try:
        loaded = running_configuration(Path(node.get_parameter("config").value))
    except FmuMeshError:
        return True  # `configure` reports what is wrong with the file
    deadline, mesh = time.monotonic() + timeout_s, loaded.config.mesh
    reported = False
    while not over.is_set():
        reason = _absence(node, loaded)
        if reason is None:
            return True
        if time.monotonic() >= deadline:
            name = node.get_fully_qualified_name()
            ros_log.error(
                f"mesh '{mesh}' did not come within {timeout_s:g} s (autostart_timeout): {reason} "
                "Once it runs, configure and activate this node: "
                f"`ros2 lifecycle set {name} configure`, then `ros2 lifecycle set {name} activate`."
            )
            return False
        if not reported:
            reported = True
            ros_log.info(f"waiting up to {timeout_s:g} s (autostart_timeout) for mesh '{mesh}': {reason}")
        over.wait(_INTERVAL_S)
    return False


def _absence(node: RosNode, loaded: LoadedConfig) -> str | None:
    """Why the gateway cannot start yet; None if it can."""
    try:
        with meshes_of(node, loaded, _ATTEMPT_S) as meshes:
            client = meshes.named(loaded.config.mesh)
            for name in client.info().instances:
                client.instance_info(name)
    except FmuMeshError as error:
        return str(error)
    return None
