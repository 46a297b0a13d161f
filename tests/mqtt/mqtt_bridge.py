"""The bridge between Zenoh, MQTT and HTTP as a process of a place, and the clients of a reader: mosquitto and curl."""

from __future__ import annotations

import os
import shutil
import signal
import socket
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import msgspec
import pytest
import zenoh

from tests.helpers import Launched, Place, wait_until

__all__ = ["CONFIG", "PROGRAM", "Bridge", "bridge_or_skip", "ended", "listening", "running_bridge"]

PROGRAM = "fmu-mesh-zenoh-bridge"
CONFIG = Path(__file__).resolve().parents[2] / "bridges" / "zenoh" / "config.json5"
_claims: list[socket.socket] = []
_PORTS = {"zenoh": ":7447", "mqtt": ":1883", "http": ":8000"}


def bridge_or_skip() -> Path:
    """The bridge as `bridges/zenoh/build` leaves it; without it or its clients the test is skipped, with the reason."""
    missing = [program for program in ("mosquitto_pub", "mosquitto_sub", "curl") if shutil.which(program) is None]
    if missing:
        pytest.skip(f"there is no {', '.join(missing)}: apt install mosquitto-clients curl")
    if found := os.environ.get("FMU_MESH_ZENOH_BRIDGE") or shutil.which(PROGRAM):
        return Path(found)
    cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    built = cache / "fmu_mesh/zenoh_bridge/release" / PROGRAM
    if not built.is_file():
        pytest.skip("the bridge is not built: bridges/zenoh/build (needs cargo and a C compiler; 10 minutes)")
    return built


class Bridge(msgspec.Struct, frozen=True):
    """Where a bridge is, and the commands of a reader for these ports."""

    zenoh: int
    mqtt: int
    http: int

    @classmethod
    def on_free_ports(cls) -> Bridge:
        """On ports that stay free while a bridge is not there, or not there any more."""
        return cls(_own_port(), _own_port(), _own_port())

    def translated(self, text: str) -> str:
        """A text of the repository with these ports in the place of its own."""
        for name, port in _PORTS.items():
            text = text.replace(port, f":{getattr(self, name)}")
        return text

    def publish(self, topic: str, *arguments: str) -> list[str]:
        return ["mosquitto_pub", "-p", str(self.mqtt), "-t", topic, *arguments]

    def subscribe(self, *arguments: str) -> list[str]:
        return ["mosquitto_sub", "-p", str(self.mqtt), *arguments]

    def curl(self, key: str, *arguments: str) -> list[str]:
        url = f"http://127.0.0.1:{self.http}/{key}"
        return ["curl", "--silent", "--show-error", "--globoff", "--max-time", "60", *arguments, url]


def ended(place: Place, command: Sequence[str]) -> Launched:
    """A command that has ended with code 0."""
    launched = place.start_command(command)
    assert launched.wait() == 0, launched.story()
    return launched


def _own_port() -> int:
    """A port that no other test has, and that the kernel gives to no connection: it is below those."""
    for port in range(20_000 + os.getpid() % 8000, 32_000):
        claim, probe = socket.socket(socket.AF_UNIX), socket.socket()
        try:
            claim.bind(f"\0fmu_mesh_tests_port_{port}")  # no file, and gone with the process
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind(("127.0.0.1", port))
        except OSError:
            claim.close()
            continue
        finally:
            probe.close()
        _claims.append(claim)
        return port
    raise AssertionError("all ports of tests are in use")


@contextmanager
def running_bridge(place: Place, ports: Bridge, text: str | None = None) -> Iterator[Launched]:
    """The bridge with the configuration of the repository, or another one, on other ports; it accepts clients."""
    file = place.folder / "bridge.json5"
    file.write_text(ports.translated(CONFIG.read_text(encoding="utf-8") if text is None else text), encoding="utf-8")
    bridge = place.start_command([str(bridge_or_skip()), str(file)])
    wait_until(lambda: "rest listens" in bridge.output or not bridge.running, "the ports of the bridge")
    assert bridge.running, bridge.story()
    yield bridge
    if bridge.running:
        bridge.signal(signal.SIGTERM)
        assert bridge.wait() == 0, bridge.story()


@contextmanager
def listening(port: int) -> Iterator[zenoh.Session]:
    """A session that listens where the bridge expects a mesh."""
    config = zenoh.Config()
    config.insert_json5("listen/endpoints", f'["tcp/127.0.0.1:{port}"]')
    config.insert_json5("scouting/multicast/enabled", "false")
    with zenoh.open(config) as session:
        yield session
