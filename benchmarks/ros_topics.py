"""Values of ROS through a mesh at 1 kHz: how long one takes there and back, and how many are lost, in each profile.

Run it with `python -m benchmarks.ros_topics`. A node sends numbered values to a topic; an instance passes them on to
another topic. Beside it are two nodes of the same middleware without a mesh, of which one sends back what it receives.
"""

from __future__ import annotations

import argparse
import contextlib
import statistics
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np
import pytest

from benchmarks.publishing import Figures, add_write_docs, markdown_table, publish
from benchmarks.ros_topics_peer import TWIST
from tests.helpers import Place, free_port, wait_until, write_config
from tests.ros.peers import Peer, bridge, bridge_binary, domain, need, ros_settings

__all__ = ["PROFILES", "Ways", "main"]

PROFILES: Final = {
    "rmw_zenoh": "rmw_zenoh",
    "rclpy": "rclpy: a gateway in a ROS node",
    "ros2dds": "ros2dds: zenoh-bridge-ros2dds",
}
_RATE_HZ: Final = 1000.0
_AHEAD_S: Final = 2.0
"""How far the stamps are ahead of `/clock`: no value may come late, and be replaced at its point."""

_PEER: Final = Path(__file__).with_name("ros_topics_peer.py")
_MOST_S: Final = 60.0
_HEADER: Final = (
    "profile",
    "two nodes: median, ms",
    "p99, ms",
    "lost",
    "through the mesh: median, ms",
    "p99, ms",
    "times as long",
    "replaced",
    "lost",
)


@dataclass
class Ways:
    """What was measured of one way of values, of all rounds.

    Attributes:
        missing: values that never came back; in a mesh, another one has replaced them at the same point.
        lost: values with stamps that never came back.
    """

    round_trips_ms: list[list[float]] = field(default_factory=list)
    missing: int = 0
    lost: int = 0

    def add(self, answer: dict[str, Any]) -> None:
        """Another round."""
        self.round_trips_ms.append(answer["round_trips_ms"])
        self.missing += answer["missing"]

    def at(self, percent: float) -> float:
        """The median over the rounds of a percentile, in ms."""
        return statistics.median(float(np.percentile(own, percent)) for own in self.round_trips_ms)


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure and print; 1 if it is to be written and cannot."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.ros_topics", description=__doc__)
    parser.add_argument("--profiles", nargs="+", choices=PROFILES, default=[*PROFILES], metavar="PROFILE")
    parser.add_argument("--count", type=int, default=5000, metavar="N", help="values of each round (5000)")
    parser.add_argument("--repeat", type=int, default=3, metavar="N", help="interleaved rounds (3)")
    add_write_docs(parser)
    options = parser.parse_args(arguments)
    if options.write_docs and options.profiles != [*PROFILES]:
        parser.error("--write-docs needs all profiles")
    return publish("ros topics", lambda: _all(options), write=options.write_docs)


def _all(options: argparse.Namespace) -> Figures:
    """The table of all profiles; those that are not there have the reason in their row."""
    absent = {name: reason for name in options.profiles if (reason := _why_not(name))}
    present = [name for name in options.profiles if name not in absent]
    bare, mesh = {name: Ways() for name in present}, {name: Ways() for name in present}
    for number in range(options.repeat):
        for name in present:
            print(f"round {number + 1}: {name}", file=sys.stderr)
            with Place() as place, _network(name, place) as orders:
                orders |= {"count": options.count, "rate_hz": _RATE_HZ}
                _measure_nodes(orders, bare[name])
                _measure_mesh(name, place, orders, mesh[name])
    rows = [
        [PROFILES[name], f"not measured: {absent[name]}", *[""] * (len(_HEADER) - 2)]
        if name in absent
        else _row(PROFILES[name], bare[name], mesh[name])
        for name in options.profiles
    ]
    about = f"Medians of {options.repeat} interleaved rounds, each of {options.count:,} values at {_RATE_HZ:g} Hz"
    return Figures(about, markdown_table(_HEADER, rows))


def _row(label: str, bare: Ways, mesh: Ways) -> list[str]:
    times = mesh.at(50) / bare.at(50)
    shown = [f"{ways.at(percent):.2f}" for ways in (bare, mesh) for percent in (50, 99)]
    return [label, *shown[:2], str(bare.missing), *shown[2:], f"{times:.1f}", str(mesh.missing), str(mesh.lost)]


def _why_not(profile: str) -> str:
    """Why a profile cannot be measured here; empty if it can."""
    try:
        need(*(("rosbags", "xxhash") if profile == "rmw_zenoh" else ("rosbags", "rclpy")))
        if profile == "ros2dds":
            bridge_binary()
    except pytest.skip.Exception as skipped:
        return str(skipped.msg)
    return ""


@contextlib.contextmanager
def _network(profile: str, place: Place) -> Iterator[dict[str, Any]]:
    """The router or the bridge of a profile; yields what nodes have to know."""
    port = free_port()
    orders = {"middleware": "rmw_zenoh" if profile == "rmw_zenoh" else "rclpy", "port": port, "domain": domain()}
    with contextlib.ExitStack() as stack:
        if profile == "rmw_zenoh":
            router = place.start("router", "--listen", f"tcp/127.0.0.1:{port}")
            wait_until(lambda: router.output, "the router")
        elif profile == "ros2dds":
            stack.enter_context(bridge(place.folder, port))
        yield orders


def _measure_nodes(orders: dict[str, Any], ways: Ways) -> None:
    with _peer(orders, "echo") as other:
        other.answer(0, _MOST_S)
        with _peer(orders, "ping") as node:
            ways.add(node.answer(0, _MOST_S))


def _measure_mesh(profile: str, place: Place, orders: dict[str, Any], ways: Ways) -> None:
    section: dict[str, Any] = {
        "profile": profile,
        "distribution": "kilted",
        "topics": [
            {"topic": "/u", "variable": "plain.u"},
            {"topic": "/y", "variable": "plain.y"},
            {"topic": "/timed", "type": TWIST, "fields": {"twist.linear.x": "timed.u"}},
            {"topic": "/timed_y", "type": TWIST, "fields": {"twist.linear.x": "timed.y"}},
        ],
    }
    if profile != "rclpy":
        section["connect"] = [f"tcp/127.0.0.1:{orders['port']}"]
    if profile == "rmw_zenoh":
        section["domain"] = orders["domain"]
    config = write_config(
        place.folder,
        name="passing",
        instances={"plain": {"fmu": "Gain"}, "timed": {"fmu": "Gain"}},
        connections=[],
        stop_time=3600.0,
        simulation={"step_size": 1 / _RATE_HZ, "real_time_factor": 1},
        record={"file": None},
        ros=section,
    )
    mesh = place.start("launch", config, "--no-progress")
    place.note()
    if profile == "rclpy":
        settings = [f"{name}={value}" for name, value in ros_settings().items()]
        node = [sys.executable, "-m", "fmu_mesh.ros.node", "--ros-args", "-p", f"config:={config}"]
        place.start_command(["env", *settings, *node, "-p", "autostart:=true"])
    with _peer({**orders, "ahead_s": _AHEAD_S}, "ping") as peer:
        ways.add(peer.answer(0, 2 * _MOST_S))
        ways.lost += peer.answer(1, 2 * _MOST_S)["missing"]
    place.run("stop", "passing")
    mesh.wait()


def _peer(orders: dict[str, Any], role: str) -> Peer:
    return Peer(Path(sys.executable), str(_PEER), {**orders, "role": role})


if __name__ == "__main__":
    sys.exit(main())
