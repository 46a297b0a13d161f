"""`autostart` of a ROS node: it configures and activates itself, and waits for a mesh that is a moment late."""

from __future__ import annotations

import threading
import time
from pathlib import Path

from ...errors import FmuMeshError
from ...instances.configuration import load
from ...wire.client.reaching import Meshes
from .node_parameters import RosNode
from .rclpy_modules import ros_module

__all__ = ["Autostart"]

_ATTEMPT_S = 2.0
_LOOK_S = 0.25
_CLOSE_S = 5.0


class Autostart:
    """Configures and activates a node, if its parameter `autostart` says so.

    The gateway of a mesh waits for that on a thread of its own: services answer meanwhile, and Ctrl-C ends it.

    Args:
        node: the lifecycle node.
        executor: the executor of rclpy that spins the node; the transitions run there.

    Use it as a context manager around the spinning.
    """

    def __init__(self, node: RosNode, executor: object) -> None:
        self._node = node
        self._executor = executor
        self._log = node.get_logger()
        self._over = threading.Event()
        self._thread: threading.Thread | None = None

    def __enter__(self) -> None:
        """Start, or begin to wait."""
        if not self._node.get_parameter("autostart").value:
            return
        if self._node.get_parameter("config").value and not self._node.get_parameter("fmu_path").value:
            self._thread = threading.Thread(target=self._wait_and_start, name="autostart", daemon=True)
            self._thread.start()
        else:
            self._start()

    def __exit__(self, *_: object) -> None:
        """Wait no more."""
        self._over.set()
        if self._thread is not None:
            self._thread.join(_CLOSE_S)

    def _start(self) -> None:
        done = ros_module("rclpy.lifecycle").TransitionCallbackReturn.SUCCESS
        if self._node.trigger_configure() == done:
            self._node.trigger_activate()

    def _wait_and_start(self) -> None:
        if self._mesh_is_there():
            self._executor.create_task(self._start)  # type: ignore[attr-defined]  # a class of rclpy

    def _mesh_is_there(self) -> bool:
        """Wait until the mesh answers for all its instances; False where it did not in time, which is told."""
        config = self._node.get_parameter("config").value
        timeout_s = self._node.get_parameter("autostart_timeout").value
        try:
            mesh = load(Path(config)).config.mesh
        except FmuMeshError:
            return True  # configuring tells what is wrong with the file
        deadline = time.monotonic() + timeout_s
        told = False
        while not self._over.is_set():
            reason = self._absence(mesh)
            if reason is None:
                return True
            if time.monotonic() >= deadline:
                self._log.error(
                    f"mesh '{mesh}' did not come within {timeout_s:g} s (autostart_timeout): {reason} "
                    f"Once it runs, configure and activate this node: {self._by_hand()}"
                )
                return False
            if not told:
                told = True
                self._log.info(f"waiting up to {timeout_s:g} s (autostart_timeout) for mesh '{mesh}': {reason}")
            self._over.wait(_LOOK_S)
        return False

    def _absence(self, mesh: str) -> str | None:
        """Why the mesh cannot be carried yet; None where it can."""
        endpoints = [endpoint for endpoint in self._node.get_parameter("connect").value if endpoint]
        try:
            with Meshes(endpoints, _ATTEMPT_S) as meshes:
                client = meshes.named(mesh)
                for name in client.info().instances:
                    client.instance_info(name)
        except FmuMeshError as error:
            return str(error)
        return None

    def _by_hand(self) -> str:
        name = self._node.get_fully_qualified_name()
        return f"`ros2 lifecycle set {name} configure`, then `ros2 lifecycle set {name} activate`."
