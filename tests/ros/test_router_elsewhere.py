"""A gateway whose ROS is on another host, behind a router that forwards nothing between peers, as that of rmw_zenoh."""

from __future__ import annotations

import itertools
import json
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from tests.helpers import Launched, rows_of, wait_until, write_config
from tests.network_hosts import NEEDS_HOSTS, NetworkHost, started_hosts
from tests.ros.peers import FOLDER, Peer, need

pytestmark = NEEDS_HOSTS

DOMAIN = 7
WHERE = "tcp/router:7447"
FLOAT = "std_msgs/msg/Float64"
COUNT = 100


@pytest.fixture
def hosts(tmp_path: Path) -> Iterator[list[NetworkHost]]:
    """Where ROS is, and where the mesh is."""
    need("zenoh_ros2_sdk", "rclpy")
    with started_hosts(tmp_path, ("robot", "desk")) as both:
        yield both


def entered(host: NetworkHost, *arguments: str | dict[str, Any]) -> Peer:
    """A process in the network of a host; not among the processes of it, so that it can be killed from here."""
    return Peer(Path("/usr/bin/nsenter"), f"--target={host.pid}", "--net", "--mount", sys.executable, *arguments)


@contextmanager
def router(robot: NetworkHost) -> Iterator[None]:
    with entered(robot, str(FOLDER / "rmw_zenoh_router.py"), "tcp/0.0.0.0:7447") as process:
        assert process.line(0) == "listening\n"
        yield


@contextmanager
def node(robot: NetworkHost, count: int = COUNT) -> Iterator[Peer]:
    """A node of ROS as a peer of the router."""
    orders = {"subscribe": {"/angle": FLOAT}, "publish": {"/command": FLOAT}, "count": count}
    orders |= {"port": 7447, "domain": DOMAIN}
    with entered(robot, str(FOLDER / "rmw_zenoh_peer.py"), "sdk", orders) as process:
        assert process.answer(0) == {"declared": 2}
        yield process


def mesh(desk: NetworkHost, **section: Any) -> Launched:  # noqa: ANN401  keys of the section
    topics = [{"topic": "/angle", "variable": "pendulum.a"}, {"topic": "/command", "variable": "gain.u"}]
    ros = {"profile": "rmw_zenoh", "domain": DOMAIN, "distribution": "kilted", "connect": [WHERE], "topics": topics}
    write_config(
        desk.folder / "own-clone",
        name="lab",
        instances={"pendulum": {"fmu": "DampedPendulum", "start_values": {"a": 1.3}}, "gain": {"fmu": "Gain"}},
        connections=[],
        stop_time=1e6,
        simulation={"step_size": 0.01, "real_time_factor": 1},
        record={"file": "lab.csv", "variables": ["pendulum.a", "gain.y"]},
        ros=ros | section,
    )
    return desk.start("fmu-mesh", "launch", "lab.yaml", "--no-progress")


def seen(desk: NetworkHost) -> dict[str, Any]:
    """The gateway as `fmu-mesh status --json` has it; nothing before the mesh runs."""
    status = desk.start("fmu-mesh", "status", "lab", "--json")
    if status.wait() != 0:
        return {}
    [ros] = json.loads(status.output)["ros"]
    return dict(ros)


def talks(desk: NetworkHost, peer: Peer) -> None:
    """Every sample of the mesh arrives from the first one on, and those of the node arrive in the mesh."""
    sent = itertools.count()

    def answered() -> bool:
        peer.say(number=next(sent))
        return peer.count() > 1

    wait_until(answered, "enough samples", 30.0)
    values = peer.answer(1)["received"]["/angle"]
    recorded = desk.folder / "own-clone" / "lab.csv"
    wait_until(lambda: values[-1] in [row[1] for row in rows_of(recorded)], "the rows of these samples")
    angles = [row[1] for row in rows_of(recorded)]
    first = angles.index(values[0])
    assert values == angles[first : first + len(values)]
    wait_until(lambda: rows_of(recorded)[-1][2] > 0.0, "a value of the node in the mesh")


def test_a_node_behind_a_router_of_another_host_talks_with_the_mesh(hosts: list[NetworkHost]) -> None:
    robot, desk = hosts
    with router(robot), node(robot) as peer:
        mesh(desk)

        talks(desk, peer)

        assert {topic["topic"]: topic["matched"] for topic in seen(desk)["topics"]} == {
            "/angle": True,
            "/command": True,
            "/clock": False,
        }
    wait_until(lambda: not any(topic["matched"] for topic in seen(desk)["topics"]), "nobody is there any more")


def test_a_router_that_comes_later_and_again_is_reached(hosts: list[NetworkHost]) -> None:
    robot, desk = hosts
    launched = mesh(desk)
    launched.wait_for_error_line(f"nobody answers at {WHERE}, so ROS gets nothing of mesh 'lab'")
    for _ in range(2):
        with router(robot), node(robot) as peer:
            launched.wait_for_error_line(f"connected to the router at {WHERE}; ROS gets mesh 'lab' from now on")
            talks(desk, peer)
        launched.wait_for_error_line(f"the link to {WHERE} was lost, so ROS gets nothing of mesh 'lab'")
