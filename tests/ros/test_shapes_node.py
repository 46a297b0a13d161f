"""Ready shapes with real ROS: what rclpy sees of worlds of MuJoCo, and the frame of messages of a single FMU."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from tests.helpers import FMUS, Place
from tests.ros.peers import need
from tests.ros.ros_peer import Ros, built_types_or_skip, ros_or_skip
from tests.ros.worlds_in_ros import MUJOCO_WORLDS, watch

ros_or_skip()
need("sensor_msgs")
pytest.importorskip("mujoco", reason="MuJoCo is not installed; pip install '.[mujoco]'")


@pytest.fixture
def ros(place: Place, monkeypatch: pytest.MonkeyPatch) -> Iterator[Ros]:
    monkeypatch.setenv("FMU_MESH_RUNTIME_DIR", str(place.folder / "run"))
    with Ros(place.folder / "log") as ros:
        yield ros


def test_joints_and_bodies_are_seen_in_ros_and_a_wrench_pushes(ros: Ros, place: Place) -> None:
    need("nav_msgs")

    watch(ros, place, MUJOCO_WORLDS, frames=False)


def test_frames_of_two_worlds_are_seen_in_ros(ros: Ros, place: Place) -> None:
    need("nav_msgs")
    built_types_or_skip()

    watch(ros, place, MUJOCO_WORLDS, frames=True)


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
