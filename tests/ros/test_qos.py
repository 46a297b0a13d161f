"""Quality of service of topics on Zenoh: who subscribes late, what tokens say, and deadlines."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import zenoh
import zenoh.ext

from fmu_mesh.ros_wire.cdr import Codec
from fmu_mesh.ros_wire.definitions import MessageTypes
from fmu_mesh.ros_wire.ros_names import dds_type
from tests.helpers import Place, free_port, wait_until, write_config

pytest.importorskip("rosbags", reason="the package rosbags is not installed; pip install '.[test]'")

URDF = '<robot name="arm"><link name="base"/></robot>\n'
TEXT, FLOAT, FRAMES = "std_msgs/msg/String", "std_msgs/msg/Float64", "tf2_msgs/msg/TFMessage"
TYPES = MessageTypes("jazzy")
ROS: list[dict[str, Any]] = [
    {"topic": "/robot_description", "type": TEXT, "constants": {"data": {"file": "arm.urdf"}}},
    {
        "topic": "/tf_static",
        "type": FRAMES,
        "frame_id": "world",
        "constants": {"transforms[child_frame_id=base].transform.rotation.w": 1.0},
    },
    {"topic": "/state", "variable": "gain.y", "durability": "transient_local", "depth": 2, "deadline": 0.25},
    {"topic": "/goal", "variable": "other.u", "durability": "transient_local", "depth": 1},
    {"topic": "/joy", "variable": "gain.u", "deadline": 0.2, "reliability": "best_effort"},
]


class Router:
    """A router of Zenoh, as ROS or a bridge has one."""

    def __init__(self, session: zenoh.Session, port: int) -> None:
        self.session = session
        self.port = port


@pytest.fixture
def router() -> Iterator[Router]:
    port = free_port()
    config = zenoh.Config()
    config.insert_json5("mode", '"router"')
    config.insert_json5("scouting/multicast/enabled", "false")
    config.insert_json5("listen/endpoints", f'["tcp/127.0.0.1:{port}"]')
    with zenoh.open(config) as session:
        yield Router(session, port)


def mesh(place: Place, router: Router, profile: str) -> Path:
    (place.folder / "arm.urdf").write_text(URDF, encoding="utf-8")
    return write_config(
        place.folder,
        name="lab",
        instances={"gain": {"fmu": "Gain", "start_values": {"k": 2.0}}, "other": {"fmu": "Gain"}},
        connections=[],
        stop_time=1e6,
        simulation={"step_size": 0.01, "real_time_factor": 1},
        ros={"profile": profile, "connect": [f"tcp/127.0.0.1:{router.port}"], "topics": ROS},
    )


def key(profile: str, topic: str, kind: str) -> str:
    name = topic.removeprefix("/")
    return name if profile == "ros2dds" else f"0/{name}/{dds_type(kind)}/{TYPES.type_hash(kind)}"


def late(router: Router, at: str, kind: str) -> list[Any]:
    """What an advanced subscriber gets that comes now, as those of rmw_zenoh and of the bridge."""
    codec, found = Codec(TYPES, kind), list[Any]()
    history = zenoh.ext.HistoryConfig(detect_late_publishers=True, max_samples=10)

    def keep(sample: zenoh.Sample) -> None:
        found.append(codec.decode(sample.payload.to_bytes()))

    with zenoh.ext.declare_advanced_subscriber(router.session, at, keep, history=history):
        wait_until(lambda: found, f"a sample of {at} from before")
    return found


@pytest.mark.parametrize("profile", ["ros2dds", "rmw_zenoh"])
def test_late_subscribers_get_constants_and_the_last_values(place: Place, router: Router, profile: str) -> None:
    config = zenoh.Config()
    config.insert_json5("mode", '"client"')
    config.insert_json5("connect/endpoints", f'["tcp/127.0.0.1:{router.port}"]')
    config.insert_json5("timestamping/enabled", "true")
    floats = Codec(TYPES, FLOAT)
    with zenoh.open(config) as node:
        goal = zenoh.ext.declare_advanced_publisher(
            node, key(profile, "/goal", FLOAT), cache=zenoh.ext.CacheConfig(1), publisher_detection=True
        )
        goal.put(floats.encode({"data": 3.5}))
        launched = place.start("launch", mesh(place, router, profile), "--no-progress")
        with place.session() as own:
            wait_until(lambda: value(own, "other/in/u") == 3.5, "the goal from before the start")
            place.run("pause", "lab").wait()

        [description] = late(router, key(profile, "/robot_description", TEXT), TEXT)
        [frames] = late(router, key(profile, "/tf_static", FRAMES), FRAMES)
        states = late(router, key(profile, "/state", FLOAT), FLOAT)

        assert description["data"] == URDF
        [frame] = frames["transforms"]
        assert (frame["child_frame_id"], frame["header"]["frame_id"]) == ("base", "world")
        assert frame["transform"]["rotation"]["w"] == 1.0
        assert 1 <= len(states) <= 2
        place.run("stop", "lab").wait()
        assert launched.wait() == 130, launched.errors  # stopped by a command


def value(session: zenoh.Session, variable: str) -> Any:  # noqa: ANN401  any value
    for reply in session.get(f"fmu_mesh/lab/{variable}"):
        if reply.ok is not None:
            return json.loads(reply.ok.payload.to_bytes())
    return None


@pytest.mark.parametrize(
    ("profile", "expected"),
    [
        ("ros2dds", {"robot_description": ":1:1:0,1", "state": ":1:1:0,2", "joy": ":0:0:0,1000"}),
        (
            "rmw_zenoh",
            {
                "%robot_description": "1:1:1,1:,:,:,,",
                "%state": "1:1:1,2:0,250000000:,:,,",
                "%joy": "2:2:1,1000:0,200000000:,:,,",
            },
        ),
    ],
)
def test_tokens_tell_ros_the_quality_of_service(
    place: Place, router: Router, profile: str, expected: dict[str, str]
) -> None:
    launched = place.start("launch", mesh(place, router, profile), "--no-progress")

    def told() -> dict[str, str]:
        where = "@/*/@ros2_lv/*/*/*/*" if profile == "ros2dds" else "@ros2_lv/0/*/*/*/*/*/*/*/*/*/*/*"
        tokens = [str(reply.ok.key_expr).split("/") for reply in router.session.liveliness().get(where) if reply.ok]
        at = (4, 6) if profile == "ros2dds" else (9, 12)
        return {chunks[at[0]]: chunks[at[1]].partition(":typehash")[0] for chunks in tokens}

    wait_until(lambda: expected.items() <= told().items(), f"the tokens, which are {told()}")
    assert place.run("wait", "lab").wait() == 0  # the tokens are there before it runs
    place.run("stop", "lab").wait()
    assert launched.wait() == 130, launched.errors  # stopped by a command


def test_missed_deadlines_are_told_once_and_counted(place: Place, router: Router) -> None:
    launched = place.start("launch", mesh(place, router, "rmw_zenoh"), "--no-progress")
    joy = router.session.declare_publisher(key("rmw_zenoh", "/joy", FLOAT))
    wait_until(lambda: joy.matching_status.matching, "the gateway")  # type: ignore[attr-defined]  # the stub is wrong

    joy.put(Codec(TYPES, FLOAT).encode({"data": 1.0}))

    launched.wait_for_error_line("'/joy': no message for 0.2 s, which is its deadline")

    def missed() -> int:
        status = place.run("status", "lab", "--json")
        [ros] = json.loads(status.output)["ros"] if status.wait() == 0 else [{}]
        return int(ros.get("missed", {}).get("/joy", 0))

    wait_until(lambda: missed() > 2, "more of them")
    assert "the deadline of /joy was missed" in place.run("status", "lab").output
    place.run("stop", "lab").wait()
    assert launched.wait() == 130, launched.errors  # stopped by a command
    lines = [line for line in launched.errors.splitlines() if "/joy" in line]
    assert len(lines) == 2, launched.errors
    assert "'/joy': its deadline of 0.2 s was missed" in lines[-1]
