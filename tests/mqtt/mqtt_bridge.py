"""The bridge between Zenoh, MQTT and HTTP as a process of a place, and the clients of a reader: mosquitto and curl."""

from __future__ import annotations

import os
import shutil
import signal
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import msgspec
import pytest
import zenoh

from tests.helpers import Launched, Place, wait_until
from tests.ros.peers import free_port

__all__ = ["CONFIG", "PROGRAM", "Bridge", "bridge_or_skip", "ended", "listening", "running_bridge"]

PROGRAM = "fmu-mesh-zenoh-bridge"
CONFIG = Path(__file__).resolve().parents[2] / "bridges" / "zenoh" / "config.json5"
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
        return cls(free_port(), free_port(), free_port())

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
