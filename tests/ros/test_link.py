"""What a gateway tells of its link to ROS: that nobody is there, that somebody is, and who else publishes `/clock`."""

from __future__ import annotations

import contextlib
import json
import signal
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from fmu_mesh.config.mesh import RosConfig
from fmu_mesh.ros.gateway.link import open_ros
from fmu_mesh.wire.session import Wiring, close_session, open_session
from tests.helpers import Launched, Place, free_port, rows_of, wait_until, write_config
from tests.ros.peers import Peer, bridge, bridge_binary, need

DOMAIN = 7
CLOCK = {"publish": {"/clock": "rosgraph_msgs/msg/Clock"}, "count": 1}


def configured(
    place: Place,
    name: str,
    port: int,
    *,
    seconds: float = 3600.0,
    factor: float = 1.0,
    **more: Any,  # noqa: ANN401 keys of the section
) -> Path:
    return write_config(
        place.folder,
        name=name,
        instances={"gain": {"fmu": "Gain"}},
        connections=(),
        stop_time=seconds,
        simulation={"step_size": 0.01, "real_time_factor": factor},
        ros={
            "connect": [f"tcp/127.0.0.1:{port}"],
            "distribution": "kilted",
            "topics": [{"topic": f"/{name}", "variable": "gain.y"}],
            **more,
        },
    )


@contextlib.contextmanager
def launched(place: Place, *configs: Path) -> Iterator[list[Launched]]:
    """Runs of meshes, which are interrupted at the end."""
    meshes = [place.start("launch", config, "--no-progress") for config in configs]
    yield meshes
    for mesh in meshes:
        mesh.signal(signal.SIGINT)
    for mesh in meshes:
        mesh.wait()


def status_says(place: Place, mesh: str, text: str) -> None:
    """Until `fmu-mesh status` has a line with this."""
    wait_until(lambda: text in place.run("status", mesh).output, f"{text!r} in the status")


def seen(place: Place, mesh: str) -> list[dict[str, Any]]:
    """The gateways as `fmu-mesh status --json` has them."""
    ros: list[dict[str, Any]] = json.loads(place.run("status", mesh, "--json").output)["ros"]
    return ros


def test_nobody_there_is_reported_once_and_a_late_bridge_as_well(place: Place) -> None:
    need("rclpy")
    bridge_binary()
    port = free_port()
    where = f"tcp/127.0.0.1:{port}"
    absent = (
        f"nobody answers at {where}, so ROS gets nothing of mesh 'lab', which runs on. Start the bridge there (zenoh"
    )
    with launched(place, configured(place, "lab", port)) as [mesh]:
        mesh.wait_for_error_line(absent)
        status_says(place, "lab", f"nobody answers at {where}")
        with bridge(place.folder, port):
            mesh.wait_for_error_line(f"connected to the bridge at {where}; ROS gets mesh 'lab' from now on")
            status_says(place, "lab", f"connected to the bridge at {where}")
        mesh.wait_for_error_line(f"the link to {where} was lost, so ROS gets nothing of mesh 'lab'")
        status_says(place, "lab", f"nobody answers at {where}")

    assert mesh.errors.count(absent) == 1


def test_a_run_that_is_over_before_is_told_at_its_end(place: Place) -> None:
    port = free_port()
    mesh = place.run("launch", configured(place, "lab", port, seconds=1.0, factor=0.0), "--no-progress")

    assert mesh.wait() == 0
    assert f"nobody answers at tcp/127.0.0.1:{port}, so ROS got nothing of mesh 'lab'. Start the bridge" in mesh.errors
    assert len(rows_of(place.folder / "lab.csv")) == 101
    place.assert_nothing_left()


def test_a_router_without_a_bridge_is_no_link_to_dds(place: Place) -> None:
    port = free_port()
    router = place.start("router", "--listen", f"tcp/127.0.0.1:{port}")
    wait_until(lambda: router.output, "the router")
    with launched(place, configured(place, "lab", port)) as [mesh]:
        mesh.wait_for_error_line(
            f"connected at tcp/127.0.0.1:{port}, but no bridge to DDS is there, so ROS on DDS gets"
        )
        assert [(own["connected"], own["other_clocks"]) for own in seen(place, "lab")] == [(True, [])]


def test_status_tells_for_each_topic_whether_somebody_is_there(place: Place) -> None:
    port = free_port()
    topics = [{"topic": "/angle", "variable": "gain.y"}, {"topic": "/command", "variable": "gain.u"}]
    router = open_session(Wiring(mode="router", listen=(f"tcp/127.0.0.1:{port}",)))
    token = f"@/{router.zid()}/@ros2_lv/MP/command/std_msgs§msg§Float64/:1:0:0,10"  # as a bridge has it

    def matched(*names: str) -> bool:
        [gateway] = seen(place, "lab")
        return {own["topic"] for own in gateway["topics"] if own["matched"]} == {*names}

    with launched(place, configured(place, "lab", port, topics=topics)):
        status_says(place, "lab", "ROS    nobody subscribes to /angle, /clock")
        subscriber, publisher = router.declare_subscriber("angle"), router.liveliness().declare_token(token)
        wait_until(lambda: matched("/angle", "/command"), "both topics")
        lines = place.run("status", "lab").output.splitlines()
        subscriber.undeclare()
        publisher.undeclare()
        wait_until(matched, "nobody")

    assert [line for line in lines if line.startswith("ROS")][1:] == [
        "ROS    somebody subscribes to /angle",
        "ROS    nobody subscribes to /clock",
        "ROS    somebody publishes /command",
    ]
    close_session(router)


@pytest.mark.parametrize(
    ("section", "as_peer"),
    [
        (RosConfig(), True),
        (RosConfig(connect=["tcp/192.0.2.1:7447"]), False),
        (RosConfig(connect=["tcp/127.0.0.1:7447", "tcp/192.0.2.1:7447"], profile="rmw_zenoh"), False),
        (RosConfig(connect=["tcp/127.0.0.1:7447", "tcp/192.0.2.1:7447"]), True),
        (RosConfig(connect=["tcp/192.0.2.1:7447"], listen=["tcp/127.0.0.1:0"]), True),
    ],
    ids=["here", "elsewhere", "a_second_router", "a_second_bridge", "listening"],
)
def test_a_gateway_is_a_client_of_another_host(tmp_path: Path, section: RosConfig, as_peer: bool) -> None:  # noqa: FBT001  a parameter
    is_peer, session = open_ros(section, tmp_path)

    close_session(session)

    assert is_peer is as_peer
    assert [*tmp_path.iterdir()] == []


def test_two_meshes_behind_one_bridge_name_each_other_and_the_clock(place: Place) -> None:
    need("rclpy", "rosgraph_msgs")
    bridge_binary()
    port = free_port()
    with bridge(place.folder, port):
        configs = [configured(place, name, port) for name in ("one", "two")]
        with launched(place, *configs, configured(place, "quiet", port, clock_rate=None)) as [one, two, quiet]:
            one.wait_for_error_line("mesh 'two' (gateway process ")
            line = two.wait_for_error_line("mesh 'one' (gateway process ")
            assert "publishes /clock, too, so the time of nodes with use_sim_time jumps between the two" in line
            assert "(here: `clock_rate: null` in the section `ros`)" in line
            status_says(place, "two", "mesh 'one' (gateway process ")
            with Peer("rclpy_peer.py", CLOCK):
                one.wait_for_error_line("a ROS node behind the bridge ")
            assert [own["other_clocks"] for own in seen(place, "quiet")] == [[]]

    assert "/clock" not in quiet.errors
    assert one.errors.count("mesh 'two'") == 1


def test_two_meshes_behind_one_router_of_rmw_zenoh_name_each_other(place: Place) -> None:
    need("zenoh_ros2_sdk", "rclpy")
    port = free_port()
    router = place.start("router", "--listen", f"tcp/127.0.0.1:{port}")
    wait_until(lambda: router.output, "the router")
    configs = [configured(place, name, port, profile="rmw_zenoh", domain=DOMAIN) for name in ("one", "two")]
    elsewhere = configured(place, "elsewhere", port, profile="rmw_zenoh", domain=DOMAIN + 1)
    with launched(place, *configs, elsewhere) as [one, two, other]:
        one.wait_for_error_line("mesh 'two' (gateway process ")
        two.wait_for_error_line("mesh 'one' (gateway process ")
        status_says(place, "two", f"connected to the router at tcp/127.0.0.1:{port}")
        orders = {**CLOCK, "port": port, "domain": DOMAIN, "subscribe": {}}
        with Peer("rmw_zenoh_peer.py", "sdk", orders) as node:
            node.answer(0)
            two.wait_for_error_line("the node '/")

    assert "/clock" not in other.errors


def test_a_gateway_that_only_listens_tells_who_has_connected(place: Place) -> None:
    need("rclpy")
    bridge_binary()
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    with launched(place, configured(place, "lab", 0, connect=[], listen=[endpoint])) as [mesh]:
        line = mesh.wait_for_error_line(f"nobody has connected to {endpoint}, so ROS gets nothing of mesh 'lab'")
        assert "Let the bridge (zenoh-bridge-ros2dds) connect there" in line
        with bridge(place.folder, free_port(), connect=[endpoint]), Peer("rclpy_peer.py", CLOCK):
            mesh.wait_for_error_line(f"connected to the bridge at {endpoint}; ROS gets mesh 'lab' from now on")
            mesh.wait_for_error_line("a ROS node behind the bridge ")
