"""Who a mesh meets in ROS: the bridge, nodes of rclpy, and independent implementations of rmw_zenoh, as processes."""

from __future__ import annotations

import contextlib
import importlib.util
import json
import os
import shutil
import socket
import subprocess
import sys
import threading
from collections.abc import Iterator, Mapping, Sequence
from functools import cache
from pathlib import Path
from types import TracebackType
from typing import IO, Any, Self

import pytest

from tests.helpers import DEADLINE_S, wait_until

__all__ = ["Peer", "bridge", "bridge_binary", "domain", "need", "ros_settings"]

FOLDER = Path(__file__).parent
BRIDGE = "fmu-mesh-ros2dds"
_DOMAINS = 101  # with a higher number, the ports of DDS reach those that the kernel gives to others

_held: list[socket.socket] = []


def need(*modules: str) -> None:
    """Skip the test, with the reason, where one of these is not installed."""
    missing = [module for module in modules if importlib.util.find_spec(module) is None]
    if missing:
        pytest.skip(f"{', '.join(missing)} not installed: pip install '.[test-ros]'")


def bridge_binary() -> Path:
    """The bridge as `bridges/ros2dds/build` leaves it; without it the test is skipped, with the reason."""
    if found := os.environ.get("FMU_MESH_ROS2DDS") or shutil.which(BRIDGE):
        return Path(found)
    cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    built = cache / "fmu_mesh/ros2dds/release" / BRIDGE
    if not built.is_file():
        pytest.skip("the bridge is not built: bridges/ros2dds/build (needs cargo, cmake and libclang; 10 minutes)")
    return built


@cache
def domain() -> int:
    """A ROS domain that no other process of tests in this network namespace has, as long as this process lives."""
    for number in range(1, _DOMAINS):
        holder = socket.socket(socket.AF_UNIX)
        try:
            holder.bind(f"\0fmu_mesh_tests_ros_domain_{number}")  # no file, and gone with the process
        except OSError:
            holder.close()
            continue
        _held.append(holder)
        return number
    raise AssertionError(f"all {_DOMAINS - 1} ROS domains are in use by other tests")


def ros_settings() -> dict[str, str]:
    """The variables that keep ROS nodes on this host, and apart from other tests."""
    return {
        "ROS_DOMAIN_ID": str(domain()),
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
        "RMW_IMPLEMENTATION": "rmw_fastrtps_cpp",
    }


class Peer:
    """A process that prints JSON lines and ends when its standard input does.

    Args:
        script: the file in this folder, or a program.
        arguments: what follows; a mapping becomes JSON.
    """

    def __init__(
        self, script: str | Path, *arguments: str | Mapping[str, Any], environment: Mapping[str, str] | None = None
    ) -> None:
        command = [sys.executable, str(FOLDER / script)] if isinstance(script, str) else [str(script)]
        texts = [own if isinstance(own, str) else json.dumps(own) for own in arguments]
        variables = dict(environment if environment is not None else os.environ | ros_settings())
        # Without a buffer, Python loses the rest of a long line if the process is stopped while it writes it.
        variables.pop("PYTHONUNBUFFERED", None)
        self._popen = subprocess.Popen(
            [*command, *texts],
            env=variables,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        assert self._popen.stdout is not None
        assert self._popen.stderr is not None
        self._lines: list[str] = []
        self._errors: list[str] = []
        self._readers = [
            threading.Thread(target=_read, args=(pipe, lines), daemon=True)
            for pipe, lines in ((self._popen.stdout, self._lines), (self._popen.stderr, self._errors))
        ]
        for reader in self._readers:
            reader.start()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        assert self._popen.stdin is not None
        with contextlib.suppress(BrokenPipeError):
            self._popen.stdin.close()
        try:
            self._popen.wait(5.0)
        except subprocess.TimeoutExpired:
            self._popen.kill()
            self._popen.wait(DEADLINE_S)
        for reader in self._readers:
            reader.join(DEADLINE_S)
        for pipe in (self._popen.stdout, self._popen.stderr):
            if pipe is not None:
                pipe.close()

    def line(self, number: int, deadline_s: float = DEADLINE_S) -> str:
        """The line with this number, as soon as it is there; fails at once if the process ends without it."""

        def look() -> str | None:
            if len(self._lines) > number:
                return self._lines[number]
            assert self._popen.poll() is None, f"it has ended: {''.join(self._errors)}"
            return None

        try:
            return wait_until(look, f"line {number} of {self._popen.args!r}", deadline_s)
        except AssertionError as error:
            raise AssertionError(f"{error}; it wrote {''.join(self._errors)}") from error

    def answer(self, number: int, deadline_s: float = DEADLINE_S) -> dict[str, Any]:
        """As `line`, read as JSON."""
        found: dict[str, Any] = json.loads(self.line(number, deadline_s))
        return found

    def count(self) -> int:
        """How many lines it has written."""
        return len(self._lines)

    def say(self, **what: object) -> None:
        """Send it a JSON line."""
        assert self._popen.stdin is not None
        self._popen.stdin.write(json.dumps(what) + "\n")
        self._popen.stdin.flush()


@contextlib.contextmanager
def bridge(folder: Path, port: int, connect: Sequence[str] = ()) -> Iterator[None]:
    """The real bridge, listening on a loopback port, with a DDS that stays on this host."""
    config = folder / "bridge.json5"
    settings = {
        "mode": "router",
        "listen": {"endpoints": [f"tcp/127.0.0.1:{port}"]},
        "connect": {"endpoints": list(connect)},
        "scouting": {"multicast": {"enabled": False}, "gossip": {"enabled": False}},
        "plugins": {"ros2dds": {"domain": domain(), "ros_automatic_discovery_range": "LOCALHOST"}},
    }
    config.write_text(json.dumps(settings), encoding="utf-8")
    cyclone = (
        "<CycloneDDS><Domain><General><Interfaces><NetworkInterface address='127.0.0.1'/></Interfaces>"
        "<AllowMulticast>false</AllowMulticast></General><Discovery><ParticipantIndex>auto</ParticipantIndex>"
        "<MaxAutoParticipantIndex>60</MaxAutoParticipantIndex><Peers><Peer address='127.0.0.1'/></Peers>"
        "</Discovery></Domain></CycloneDDS>"
    )
    environment = os.environ | ros_settings() | {"CYCLONEDDS_URI": cyclone, "ROS_DISTRO": "kilted"}
    with Peer(bridge_binary(), str(config), environment=environment) as process:
        assert process.line(0) == "ready\n"
        yield


def _read(pipe: IO[str], lines: list[str]) -> None:
    lines.extend(pipe)
