"""Nodes of two independent implementations of rmw_zenoh see the mesh as a ROS node, through a router and no bridge."""

from __future__ import annotations

import itertools
import signal
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.fmus.helpers import find_fmu
from tests.helpers import Launched, Place, free_port, row_count, rows_of, wait_until, write_config
from tests.ros.peers import Peer, need

DOMAIN = 7
COUNT = 100
FLOAT = "std_msgs/msg/Float64"
TEXT = "std_msgs/msg/String"
TWIST = "geometry_msgs/msg/TwistStamped"


class Met:
    """A mesh that ROS nodes meet through a router."""

    def __init__(self, place: Place, mesh: Launched, port: int) -> None:
        self.place = place
        self.mesh = mesh
        self.port = port

    def orders(self, **more: object) -> dict[str, Any]:
        return {"port": self.port, "domain": DOMAIN, **more}


@pytest.fixture
def met(place: Place, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Met]:
    need("zenoh_ros2_sdk", "pyzeros", "rclpy")
    echo: Path = find_fmu("AllTypes", tmp_path_factory.mktemp("all"))
    port = free_port()
    config = write_config(
        place.folder,
        name="lab",
        instances={
            "pendulum": {"fmu": "DampedPendulum", "start_values": {"a": 1.3}},
            "echo": {"fmu": str(echo)},
            "gain": {"fmu": "Gain"},
        },
        connections=[],
        stop_time=60.0,
        simulation={"step_size": 0.01, "real_time_factor": 1},
        record={"file": "lab.csv", "variables": ["pendulum.a", "pendulum.der(a)", "gain.y"]},
        ros={
            "profile": "rmw_zenoh",
            "domain": DOMAIN,
            "distribution": "kilted",
            "connect": [f"tcp/127.0.0.1:{port}"],
            "topics": [
                {"topic": "/value", "variable": "echo.real_out"},
                {"topic": "/text", "variable": "echo.string_out"},
                {
                    "topic": "/state",
                    "type": TWIST,
                    "fields": {"twist.linear.x": "pendulum.a", "twist.angular.z": "pendulum.der(a)"},
                    "frame_id": "base",
                },
                {"topic": "/command", "variable": "echo.real_in"},
                {"topic": "/words", "variable": "echo.string_in"},
                {"topic": "/speed", "type": TWIST, "fields": {"twist.linear.x": "gain.u"}},
            ],
        },
    )
    router = place.start("router", "--listen", f"tcp/127.0.0.1:{port}")
    wait_until(lambda: router.output, "the router")
    mesh = place.start("launch", config, "--no-progress")
    yield Met(place, mesh, port)
    mesh.signal(signal.SIGINT)
    mesh.wait()
    router.signal(signal.SIGTERM)
    router.wait()


@pytest.mark.parametrize("implementation", ["sdk", "pyzeros"])
def test_numbers_text_and_stamped_messages_flow_both_ways(met: Met, implementation: str) -> None:
    orders = met.orders(
        subscribe={"/value": FLOAT, "/text": TEXT, "/state": TWIST},
        publish={"/command": FLOAT, "/words": TEXT, "/speed": TWIST},
        count=COUNT,
    )
    met.place.note()

    with Peer("rmw_zenoh_peer.py", implementation, orders) as peer:
        assert peer.answer(0) == {"declared": 6}
        sent = itertools.count()

        def answered() -> bool:
            peer.say(number=next(sent))
            return peer.count() > 1

        wait_until(answered, "enough samples in both directions", 60.0)
        received = peer.answer(1)["received"]
    met.mesh.signal(signal.SIGINT)
    met.mesh.wait()
    rows = rows_of(met.place.folder / "lab.csv")

    values, texts, states = received["/value"], received["/text"], received["/state"][:COUNT]
    assert set(values) <= {0.1 * number for number in range(next(sent) + 1)}
    assert values == sorted(values)
    assert len(set(values)) > COUNT // 10
    assert set(texts) <= {"", *(f"text {number}" for number in range(next(sent)))}
    assert len(set(texts)) > COUNT // 10
    first = round((states[0][2] + states[0][3] * 1e-9) / 0.01)
    assert [(own[0], own[1], f"{own[2]}.{own[3]:09d}", own[4]) for own in states] == [
        (row[1], row[2], f"{row[0]:.9f}", "base") for row in rows[first : first + COUNT]
    ]
    assert rows[-1][3] > 0.0, "the stamped message did not reach the input"


def test_parameters_are_got_and_set_by_the_services_of_ros(met: Met) -> None:
    wait_until(lambda: row_count(met.place.folder / "lab.csv"), "the first points")
    orders = met.orders(node="/lab")

    with Peer("rmw_zenoh_peer.py", "parameters", orders) as peer:
        peer.answer(0)
        answers = []
        for number, order in enumerate(
            [
                {"get": ["gain.k", "nobody.k"]},
                {"set": ["gain.k", 2.5]},
                {"get": ["gain.k"]},
                {"set": ["pendulum.l", 2.0]},
                {"set": ["nobody.k", 1.0]},
            ],
            start=1,
        ):
            peer.say(order=order)
            answers.append(peer.answer(number)["answer"])

    assert answers[0] == [[3, 1.0], [0, 0.0]]
    assert answers[1] == [True, ""]
    assert answers[2] == [[3, 2.5]]
    assert answers[3] == [False, "'pendulum.l' is a fixed parameter; only tunable ones can be set while it runs"]
    assert answers[4] == [False, "there is no parameter 'nobody.k'"]
