"""Ready shapes with real ROS: what rclpy sees of a world of MuJoCo, and the frame of messages of a single FMU."""

from __future__ import annotations

import math
from collections.abc import Iterator

import pytest

from tests.helpers import FMUS, Place, write_config
from tests.ros.peers import need
from tests.ros.ros_peer import Ros, ros_or_skip
from tests.ros.test_gateway_topics import WORLDS

ros_or_skip()
need("sensor_msgs")
mujoco = pytest.importorskip("mujoco", reason="MuJoCo is not installed; pip install '.[mujoco]'")


@pytest.fixture
def ros(place: Place, monkeypatch: pytest.MonkeyPatch) -> Iterator[Ros]:
    monkeypatch.setenv("FMU_MESH_RUNTIME_DIR", str(place.folder / "run"))
    with Ros(place.folder / "log") as ros:
        yield ros


def test_joints_and_frames_of_a_world_are_seen_in_ros(ros: Ros, place: Place) -> None:
    need("tf2_msgs")
    from geometry_msgs.msg import TwistStamped  # noqa: PLC0415 only where ROS is installed
    from sensor_msgs.msg import JointState  # noqa: PLC0415 as above
    from tf2_msgs.msg import TFMessage  # noqa: PLC0415 as above

    peer = ros.peer()
    joints, states = ros.collect(peer, JointState, "/joint_states")
    frames, transforms = ros.collect(peer, TFMessage, "/tf")
    speeds, twists = ros.collect(peer, TwistStamped, "/twist")
    config = write_config(
        place.folder,
        name="world",
        instances={"world": {"mujoco": str(WORLDS / "damped_pendulum.xml")}},
        connections=(),
        stop_time=3600.0,
        simulation={"step_size": 0.01, "real_time_factor": 1.0},
        ros={
            "profile": "rclpy",
            "topics": [{"joint_states": "world"}, {"tf": "world"}, {"twist": "world.damped_by_fmu"}],
        },
    )
    place.start("launch", config)
    place.note()
    node = ros.fmu(config=str(config))
    ros.until(lambda: str(node.trigger_configure()).endswith("SUCCESS"), "the mesh")
    node.trigger_activate()
    ros.matched(joints, frames, speeds)
    ros.until(lambda: states and transforms and twists, "messages of each shape")

    assert list(states[-1].name) == ["engine", "fmu"]
    assert len(states[-1].position) == len(states[-1].velocity) == len(states[-1].effort) == 2
    assert states[-1].header.stamp.sec + states[-1].header.stamp.nanosec > 0
    for own in transforms[-1].transforms:
        rotation = own.transform.rotation
        assert own.header.frame_id == "world"
        norm = math.hypot(rotation.x, rotation.y, rotation.z, rotation.w)
        assert abs(norm - 1.0) <= mujoco.mjMINVAL + math.ulp(1.0)
    assert [own.child_frame_id for own in transforms[-1].transforms] == ["damped_by_engine", "damped_by_fmu"]
    assert twists[-1].header.frame_id == "world"


def test_messages_of_a_single_fmu_have_their_frame(ros: Ros) -> None:
    from geometry_msgs.msg import TwistStamped  # noqa: PLC0415 only where ROS is installed

    peer = ros.peer()
    subscription, messages = ros.collect(peer, TwistStamped, "/velocity")
    node = ros.fmu(
        fmu_path=str(FMUS / "Gain.fmu"),
        messages=[
            "/velocity: {type: geometry_msgs/msg/TwistStamped, fields: {twist.linear.x: y}, frame_id: base_link}",
        ],
    )
    node.trigger_configure()
    node.trigger_activate()
    ros.matched(subscription)
    ros.until(lambda: messages, "a message")

    assert messages[-1].header.frame_id == "base_link"
