"""The parameter `autostart`: the node configures and activates itself, and waits for a mesh that starts later."""

from __future__ import annotations

import threading
import time
from pathlib import Path

from ...errors import FmuMeshError
from ...wire.client.reaching import Meshes
from ..bags.playing import running_configuration
from .rclpy_modules import RosNode, ros_module

__all__ = ["Autostart"]

_ATTEMPT_S = 2.0
_INTERVAL_S = 0.25
# Longer than one attempt, which it may be in the middle of.
_ATTEMPT_END_S = 5.0


class Autostart:
    """Configures and activates a node if its parameter `autostart` is true.

    The gateway of a mesh waits for the mesh on another thread, so services answer meanwhile and Ctrl-C ends the wait.
    Use it as a context manager around the spinning of the node.

    Args:
        node: the lifecycle node.
        executor: the executor of rclpy that spins the node; the transitions run there.
    """

    def __init__(self, node: RosNode, executor: object) -> None:
        self._node = node
        self._executor = executor
        self._log = node.get_logger()
        self._over = threading.Event()
        self._thread: threading.Thread | None = None

    def __enter__(self) -> None:
        """Start the node, or begin to wait for the mesh."""
        if not self._node.get_parameter("autostart").value:
            return
        if self._node.get_parameter("config").value and not self._node.get_parameter("fmu_path").value:
            self._thread = threading.Thread(target=self._wait_and_start, name="autostart", daemon=True)
            self._thread.start()
        else:
            self._start()

    def __exit__(self, *_: object) -> None:
        """Stop waiting."""
        self._over.set()
        if self._thread is not None:
            self._thread.join(_ATTEMPT_END_S)

    def _start(self) -> None:
        done = ros_module("rclpy.lifecycle").TransitionCallbackReturn.SUCCESS
        if self._node.trigger_configure() == done:
            self._node.trigger_activate()

    def _wait_and_start(self) -> None:
        if self._mesh_is_there():
            self._executor.create_task(self._start)  # type: ignore[attr-defined]  # a class of rclpy

    def _mesh_is_there(self) -> bool:
        """Wait until all instances of the mesh answer; False after the timeout, which is logged."""
        config = self._node.get_parameter("config").value
        timeout_s = self._node.get_parameter("autostart_timeout").value
        try:
            mesh = running_configuration(Path(config)).config.mesh
        except FmuMeshError:
            return True  # `configure` reports what is wrong with the file
        deadline = time.monotonic() + timeout_s
        reported = False
        while not self._over.is_set():
            reason = self._absence(mesh)
            if reason is None:
                return True
            if time.monotonic() >= deadline:
                self._log.error(
                    f"mesh '{mesh}' did not come within {timeout_s:g} s (autostart_timeout): {reason} "
                    f"Once it runs, configure and activate this node: {self._manual_start()}"
                )
                return False
            if not reported:
                reported = True
                self._log.info(f"waiting up to {timeout_s:g} s (autostart_timeout) for mesh '{mesh}': {reason}")
            self._over.wait(_INTERVAL_S)
        return False

    def _absence(self, mesh: str) -> str | None:
        """Why the gateway cannot start yet; None if it can."""
        endpoints = [endpoint for endpoint in self._node.get_parameter("connect").value if endpoint]
        try:
            with Meshes(endpoints, _ATTEMPT_S) as meshes:
                client = meshes.named(mesh)
                for name in client.info().instances:
                    client.instance_info(name)
        except FmuMeshError as error:
            return str(error)
        return None

    def _manual_start(self) -> str:
        name = self._node.get_fully_qualified_name()
        return f"`ros2 lifecycle set {name} configure`, then `ros2 lifecycle set {name} activate`."
