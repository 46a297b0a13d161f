"""Real ROS 2 for tests: rclpy and Fast DDS on the loopback, in a domain of its own; without them a test is skipped.

Nodes of one test share an executor that the test itself turns, until what it waits for is there or a deadline is met.
"""

from __future__ import annotations

import ctypes
import gc
import importlib.util
import os
import subprocess
import sys
import time
import warnings
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, Self, TypeVar

import pytest

from tests.helpers import DEADLINE_S
from tests.ros.peers import ros_settings

__all__ = ["Ros", "built_types_or_skip", "environment", "ros_or_skip"]

_SPIN_S = 0.02
_REPEAT_S = 5.0

Found = TypeVar("Found")


def environment(log_folder: Path) -> dict[str, str]:
    """What keeps ROS on this machine, apart from other tests, and its log in a folder."""
    return {**ros_settings(), "ROS_LOG_DIR": str(log_folder)}


def ros_or_skip() -> None:
    """Skip a test, or a whole module, where ROS is not installed."""
    needed = ("rclpy", "std_msgs", "geometry_msgs", "rosgraph_msgs", "rmw_fastrtps_cpp")
    # The last one has a library and no Python module.
    missing = [name for name in needed[:4] if importlib.util.find_spec(name) is None]
    if missing:
        pytest.skip(
            f"ROS 2 is not installed ({', '.join(missing)}); pip install '.[test-ros]'", allow_module_level=True
        )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # a parser that ROS imports is older than this Python
        importlib.import_module("rosidl_generator_py")


def built_types_or_skip() -> dict[str, str]:
    """Make the packages of `interfaces.txt` importable; skip a test, or a module, where `build_interfaces` has not run.

    Call it after `ros_or_skip` and before an import of such a package.

    Returns:
        The environment in which another process can import them, too.
    """
    script = Path(__file__).with_name("build_interfaces")
    asked = {**os.environ, "PYTHON": sys.executable}
    if subprocess.run([str(script), "--check"], check=False, env=asked, timeout=DEADLINE_S).returncode:
        pytest.skip(
            "ROS's generator has not built simulation_interfaces; tests/ros/build_interfaces", allow_module_level=True
        )
    cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    libraries = cache / "fmu_mesh/ros_interfaces/install/lib"
    packages = str(libraries / f"python{sys.version_info.major}.{sys.version_info.minor}" / "site-packages")
    if packages not in sys.path:
        sys.path.append(packages)
        # ROS opens these by their bare names, and LD_LIBRARY_PATH counts at the start of a process only. A library that
        # is there already is found by its name.
        for pattern in ("*typesupport_fastrtps_c.so", "*typesupport_introspection_c.so"):
            for library in libraries.glob(pattern):
                ctypes.CDLL(str(library))
    return {
        "LD_LIBRARY_PATH": os.pathsep.join(filter(None, [str(libraries), os.environ.get("LD_LIBRARY_PATH")])),
        "PYTHONPATH": os.pathsep.join(filter(None, [packages, os.environ.get("PYTHONPATH")])),
    }


class Ros:
    """One ROS context with an executor; use it as a context manager."""

    def __init__(self, log_folder: Path) -> None:
        import rclpy  # noqa: PLC0415 only where it is installed
        from rclpy.executors import SingleThreadedExecutor  # noqa: PLC0415 as above

        self._rclpy = rclpy
        self.environment = environment(log_folder)
        os.environ.update(self.environment)
        self.context = rclpy.Context()
        rclpy.init(context=self.context)
        self._executor = SingleThreadedExecutor(context=self.context)
        self._nodes: list[Any] = []

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        node = None
        for node in self._nodes:
            if hasattr(node, "managed"):
                node.managed.close()
            self._executor.remove_node(node)
            node.destroy_node()
        # A lifecycle node keeps its ROS node, which others would still see, until the last reference is gone.
        del node
        self._nodes.clear()
        gc.collect()
        self._executor.shutdown()
        self._rclpy.shutdown(context=self.context)

    def add(self, node: Any) -> Any:  # noqa: ANN401 types of rclpy
        """Let this executor turn ``node``, and destroy it at the end."""
        self._nodes.append(node)
        self._executor.add_node(node)
        return node

    def peer(self, name: str = "peer", **options: Any) -> Any:  # noqa: ANN401 types of rclpy
        """A plain node."""
        return self.add(self._rclpy.create_node(name, context=self.context, **options))

    def fmu(self, **parameters: Any) -> Any:  # noqa: ANN401 types of rclpy
        """A node that runs an FMU, with these parameters."""
        from fmu_mesh.ros.node import create_node  # noqa: PLC0415 needs ROS when it is called only

        overrides = [self._rclpy.Parameter(name, value=value) for name, value in parameters.items()]
        return self.add(create_node(context=self.context, parameter_overrides=overrides))

    def turn(self, seconds: float = 0.0) -> None:
        """Let callbacks run, at least one round of them, for so long."""
        end = time.monotonic() + seconds
        self._executor.spin_once(timeout_sec=0.0)
        while time.monotonic() < end:
            self._executor.spin_once(timeout_sec=min(_SPIN_S, max(0.0, end - time.monotonic())))

    def until(self, condition: Callable[[], Found | None], what: str, deadline_s: float = DEADLINE_S) -> Found:
        """Let callbacks run until ``condition`` is true; fail after ``deadline_s``, saying ``what`` did not come."""
        end = time.monotonic() + deadline_s
        while not (found := condition()):
            assert time.monotonic() < end, f"not within {deadline_s:g} s: {what}"
            self._executor.spin_once(timeout_sec=_SPIN_S)
        return found

    def matched(self, *ends: Any) -> None:  # noqa: ANN401 types of rclpy
        """Wait until every publisher and subscription has somebody at the other end."""
        for end in ends:
            self.until(partial(_matches, end), f"somebody else on '{end.topic_name}'")

    def known_to(self, node: str, peer: Any) -> None:  # noqa: ANN401 types of rclpy
        """Wait until the node of another process knows the subscriptions of ``peer``: from then on they miss nothing.

        `matched` cannot tell: it sees that this side has heard of the other one, and a subscription that the publisher
        has not heard of is sent nothing. DDS announces what a process reads in the order of its making, so a node that
        answers a client has heard of all that was made before, such as other clients.
        """
        from rcl_interfaces.srv import GetParameters  # noqa: PLC0415 only where ROS is installed

        client = peer.create_client(GetParameters, f"{node}/get_parameters")
        self.called(client, GetParameters.Request())
        peer.destroy_client(client)

    def called(self, client: Any, request: Any, *, once: bool = False) -> Any:  # noqa: ANN401 types of rclpy
        """The answer of a service.

        A service is ready when this side has heard of it. It may not have heard of this side by then, and what it
        answers is lost; so a request is repeated, unless it may be made only ``once``: then call `known_to` before.
        """
        self.until(client.service_is_ready, f"the service {client.srv_name}")
        end, asked = time.monotonic() + DEADLINE_S, []
        while True:
            asked.append(client.call_async(request))
            asked_s = DEADLINE_S if once else _REPEAT_S
            until = min(time.monotonic() + asked_s, end)
            while time.monotonic() < until:
                if (answered := next((future for future in asked if future.done()), None)) is not None:
                    return answered.result()
                self._executor.spin_once(timeout_sec=_SPIN_S)
            assert time.monotonic() < end, f"not within {DEADLINE_S:g} s: an answer of {client.srv_name}"

    def collect(
        self,
        node: Any,  # noqa: ANN401 types of rclpy
        kind: Any,  # noqa: ANN401 as above
        topic: str,
        quality: Any = 5000,  # noqa: ANN401 as above
    ) -> tuple[Any, list[Any]]:
        """A subscription, and a list that fills with what comes; ``quality`` is a profile or a depth."""
        messages: list[Any] = []
        return node.create_subscription(kind, topic, messages.append, quality), messages


def _matches(end: Any) -> bool:  # noqa: ANN401 types of rclpy
    count = getattr(end, "get_subscription_count", None) or end.get_publisher_count
    return bool(count())
