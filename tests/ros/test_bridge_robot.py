"""A robot behind the real bridge, seen with real ROS: who comes late, joints by name in any order, and images."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.helpers import Launched, Place, free_port, wait_until, write_config
from tests.ros.peers import bridge, bridge_binary, need
from tests.ros.ros_peer import Ros, ros_or_skip
from tests.ros.test_images import camera
from tests.ros.test_qos_node import latched

ros_or_skip()
need("sensor_msgs")

URDF = '<robot name="arm"><link name="base"/></robot>\n'
JOINTS = "sensor_msgs/msg/JointState"
WIDTH, HEIGHT = 160, 120  # in fragments, but so few that no buffer of a loaded host loses one


class Robot:
    """A mesh behind a bridge, and ROS to look at it."""

    def __init__(self, place: Place, ros: Ros, port: int) -> None:
        self.place = place
        self.ros = ros
        self.section = {"connect": [f"tcp/127.0.0.1:{port}"], "distribution": "kilted"}

    def configured(self, instances: dict[str, Any], topics: list[Any]) -> Path:
        return write_config(
            self.place.folder,
            name="robot",
            instances=instances,
            connections=(),
            stop_time=3600.0,
            simulation={"step_size": 0.01, "real_time_factor": 1.0},
            ros={**self.section, "topics": topics},
        )

    def stop(self, launched: Launched, mesh: str = "robot") -> None:
        """Stop the mesh, which has warned of nothing."""
        assert self.place.run("stop", mesh).wait() == 0
        assert launched.wait() == 130, launched.errors
        assert "WARNING" not in launched.errors


@pytest.fixture
def robot(place: Place, monkeypatch: pytest.MonkeyPatch) -> Iterator[Robot]:
    """A bridge that runs; without one, the test is skipped with the reason."""
    bridge_binary()
    monkeypatch.setenv("FMU_MESH_RUNTIME_DIR", str(place.folder / "run"))
    port = free_port()
    with bridge(place.folder, port), Ros(place.folder / "log") as ros:
        yield Robot(place, ros, port)


def test_late_node_gets_description_and_last_value_through_bridge(robot: Robot) -> None:
    from std_msgs.msg import Float64, String  # noqa: PLC0415 only where ROS is installed

    place, ros = robot.place, robot.ros
    (place.folder / "arm.urdf").write_text(URDF, encoding="utf-8")
    description = {"type": "std_msgs/msg/String", "constants": {"data": {"file": "arm.urdf"}}}
    topics: list[Any] = [
        {"topic": "/robot_description", **description},
        {"topic": "/state", "variable": "gain.y", "durability": "transient_local", "depth": 1},
        {"topic": "/goal", "variable": "gain.u", "durability": "transient_local", "depth": 1},
    ]
    early = ros.peer("early")
    early.create_publisher(Float64, "/goal", latched()).publish(Float64(data=1.5))
    launched = place.start("launch", robot.configured({"gain": {"fmu": "Gain", "start_values": {"k": 2.0}}}, topics))
    with place.session() as session:

        def goal() -> bool:
            found = [reply.ok for reply in session.get("fmu_mesh/robot/gain/in/u") if reply.ok is not None]
            return [json.loads(sample.payload.to_bytes()) for sample in found] == [1.5]

        wait_until(goal, "the goal from before the start")
    assert place.run("pause", "robot").wait() == 0

    late = ros.peer("late")
    _, descriptions = ros.collect(late, String, "/robot_description", latched())
    _, states = ros.collect(late, Float64, "/state", latched())
    ros.until(lambda: descriptions and states, "what was published before")

    assert [own.data for own in descriptions] == [URDF]
    assert states[-1].data == 3.0
    robot.stop(launched)


def test_joint_commands_reach_their_joints_in_any_order_through_bridge(robot: Robot) -> None:
    from sensor_msgs.msg import JointState  # noqa: PLC0415 only where ROS is installed

    place, ros = robot.place, robot.ros
    fields = {f"position[name={name}]": name for name in ("weak", "bare")}
    topics: list[Any] = [
        {"topic": "/commands", "type": JOINTS, "fields": {path: f"{name}.u" for path, name in fields.items()}},
        {"topic": "/joint_states", "type": JOINTS, "fields": {path: f"{name}.y" for path, name in fields.items()}},
    ]
    peer = ros.peer()
    subscription, states = ros.collect(peer, JointState, "/joint_states")
    commands = peer.create_publisher(JointState, "/commands", 10)
    launched = place.start("launch", robot.configured({"weak": {"fmu": "Gain"}, "bare": {"fmu": "Gain"}}, topics))
    ros.matched(subscription, commands)

    def commanded(names: list[str], position: list[float], *expected: float) -> None:
        """Send it until it is there: the bridge may hear of the gateway later than rclpy of the bridge."""

        def there() -> bool:
            commands.publish(JointState(name=names, position=position))
            ros.turn()
            return bool(states) and list(states[-1].position) == [*expected]

        ros.until(there, f"{expected}")

    commanded(["weak", "bare"], [0.5, -0.5], 0.5, -0.5)
    commanded(["bare", "weak"], [-0.25, 0.25], 0.25, -0.25)
    commanded(["bare"], [1.0], 0.25, 1.0)

    assert {tuple(own.name) for own in states} == {("weak", "bare")}
    stamps = [own.header.stamp.sec * 100 + own.header.stamp.nanosec // 10**7 for own in states]
    assert stamps == [*range(stamps[0], stamps[-1] + 1)]
    robot.stop(launched)


def test_images_flow_both_ways_through_bridge(robot: Robot) -> None:
    from sensor_msgs.msg import Image, PointCloud2  # noqa: PLC0415 only where ROS is installed

    place, ros = robot.place, robot.ros
    peer = ros.peer()
    pictures, images = ros.collect(peer, Image, "/image", 10)
    scans, clouds = ros.collect(peer, PointCloud2, "/points", 10)
    masks = peer.create_publisher(Image, "/mask", 10)
    simulation = {"step_size": 0.1, "real_time_factor": 1.0}
    launched = place.start("launch", camera(place.folder, ros=robot.section, stop_time=3600.0, simulation=simulation))
    ros.matched(pictures, scans, masks)
    data = bytes(number % 251 for number in range(WIDTH * HEIGHT))

    def mirrored() -> bool:
        masks.publish(Image(width=WIDTH, height=HEIGHT, step=WIDTH, data=data))
        ros.turn(0.1)
        return bool(images) and bytes(images[-1].data) == data[::-1]

    ros.until(mirrored, "the image")
    assert (images[-1].width, images[-1].encoding, images[-1].header.frame_id) == (4, "mono8", "lens")
    assert [own.name for own in clouds[-1].fields] == ["x", "y"]
    robot.stop(launched, "camera")
