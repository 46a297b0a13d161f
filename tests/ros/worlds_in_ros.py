"""Ready shapes of two worlds as rclpy sees them: every message is the row of its point, and a wrench moves its body.

The worlds are those of `configs/worlds`, of any engine that has them: two cubes in weightlessness, and two pendulums.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import fmu_mesh
from tests.helpers import Place, write_config
from tests.ros.ros_peer import Ros
from tests.ros.test_bag import messages_of

__all__ = ["GAZEBO_WORLDS", "MUJOCO_WORLDS", "record", "watch"]

_FOLDER = Path(__file__).parents[2] / "configs" / "worlds"
MUJOCO_WORLDS: Mapping[str, Any] = {
    "cubes": {"mujoco": str(_FOLDER / "fluid_body.xml"), "keyframe": "moving"},
    "arms": {"mujoco": str(_FOLDER / "damped_pendulum.xml")},
}
GAZEBO_WORLDS: Mapping[str, Any] = {
    "cubes": {"gazebo_classic": str(_FOLDER / "fluid_body.sdf")},
    "arms": {"gazebo_classic": str(_FOLDER / "damped_pendulum.sdf")},
}

STEP_SIZE = 0.01
BODY = "cubes.free_cube"
BODIES = ("cube", "free_cube", "damped_by_engine", "damped_by_fmu")
JOINTS = ("engine", "fmu")
SHAPES: list[dict[str, Any]] = [
    {"joint_states": "arms"},
    {"tf": ["cubes", "arms"]},
    {"odometry": BODY},
    {"imu": BODY},
    {"twist": BODY},
    {"wrench": BODY},
]
FORCE, TORQUE = 2.0, 0.1
"""Along z, in N and N m."""
MASS, INERTIA = 1.0, 0.166666666


def configured(
    folder: Path,
    worlds: Mapping[str, Any],
    file: str,
    topics: list[dict[str, Any]],
    **more: Any,  # noqa: ANN401 sections of a configuration
) -> Path:
    """A mesh of both worlds, which are `cubes` and `arms`, that records all that shapes have."""
    local = [f"{BODY}.body_{what}_velocity_{axis}" for what in ("linear", "angular") for axis in "xyz"]
    return write_config(
        folder,
        name="seen",
        instances=worlds,
        connections=(),
        record={"file": file, "variables": ["cubes.*", "arms.*", *local, f"in:{BODY}.*"]},
        ros={"topics": topics, **more.pop("ros", {})},
        **{**more, "simulation": {"step_size": STEP_SIZE, **more.get("simulation", {})}},
    )


def watch(ros: Ros, place: Place, worlds: Mapping[str, Any], *, frames: bool) -> None:
    """Look at a mesh of both worlds with rclpy while it runs, and push a cube; ``frames`` need the types of tf2."""
    from geometry_msgs.msg import TwistStamped, WrenchStamped  # noqa: PLC0415 only where ROS is installed
    from nav_msgs.msg import Odometry  # noqa: PLC0415 as above
    from sensor_msgs.msg import Imu, JointState  # noqa: PLC0415 as above

    kinds = {"/joint_states": JointState, "/odom": Odometry, "/imu": Imu, "/twist": TwistStamped}
    if frames:
        from tf2_msgs.msg import TFMessage  # noqa: PLC0415 only where it is built

        kinds["/tf"] = TFMessage
    peer = ros.peer()
    collected = {topic: ros.collect(peer, kind, topic) for topic, kind in kinds.items()}
    pushing = peer.create_publisher(WrenchStamped, "/wrench", 10)
    topics = [own for own in SHAPES if frames or "tf" not in own]
    config = configured(
        place.folder,
        worlds,
        "seen.csv",
        topics,
        ros={"profile": "rclpy"},
        stop_time=3600.0,
        simulation={"real_time_factor": 1.0},
    )
    launched = place.start("launch", config, "--no-progress")
    place.note()
    node = ros.fmu(config=str(config))
    ros.until(lambda: str(node.trigger_configure()).endswith("SUCCESS"), "the mesh")
    node.trigger_activate()
    ros.matched(pushing, *(own for own, _ in collected.values()))
    push = WrenchStamped()
    push.wrench.force.z, push.wrench.torque.z = FORCE, TORQUE
    pushing.publish(push)
    _, twists = collected["/twist"]
    ros.until(lambda: twists and twists[-1].twist.linear.z > 20 * STEP_SIZE * FORCE / MASS, "a cube that was pushed")
    assert place.run("pause", "seen").wait() == 0
    point = json.loads(place.run("status", "seen", "--json").output)["point"]
    for topic, (_, messages) in collected.items():
        ros.until(lambda: messages and point_of(messages[-1]) == point, f"the message of the last point on {topic}")  # noqa: B023  it waits here
    place.run("stop", "seen").wait()
    assert launched.wait() == 130, launched.errors

    result = fmu_mesh.Result.read(place.folder / "seen.csv")
    for topic, (_, messages) in collected.items():
        assert len(messages) > 20, topic
        assert_rows(topic, messages, result)
    assert_pushed(result)


def record(folder: Path, worlds: Mapping[str, Any]) -> None:
    """Record both worlds as a bag, without ROS: every message has the values that a result without ROS has."""
    config = configured(folder, worlds, "seen.mcap", SHAPES, stop_time=0.5)

    fmu_mesh.load(config).run(processes=False)
    result = fmu_mesh.load(config).run(processes=False, record="memory")

    messages = messages_of(folder / "seen.mcap")
    for topic in ("/joint_states", "/tf", "/odom", "/imu", "/twist", "/wrench"):
        assert len(messages[topic]) == 51, topic
        assert_rows(topic, [message for _, message in messages[topic]], result)


def assert_rows(topic: str, messages: Iterable[Any], result: fmu_mesh.Result) -> None:
    """Every message has the values of the row of its stamp, and no point is missing between the first and the last."""
    points, columns = [], {name: result[name] for name in result}
    for message in messages:
        points.append(point_of(message))
        row = {name: float(values[points[-1]]) for name, values in columns.items()}
        match topic:
            case "/joint_states":
                assert list(message.name) == [*JOINTS]
                for field, end in {"position": "position", "velocity": "velocity", "effort": "effort_applied"}.items():
                    assert list(getattr(message, field)) == [row[f"arms.{joint}.{end}"] for joint in JOINTS]
            case "/tf":
                assert [own.child_frame_id for own in message.transforms] == [*BODIES]
                for own in message.transforms:
                    body = f"{'cubes' if 'cube' in own.child_frame_id else 'arms'}.{own.child_frame_id}"
                    assert own.header.frame_id == "world"
                    assert _numbers(own.transform.translation) == _columns(row, f"{body}.position")
                    assert _numbers(own.transform.rotation) == _columns(row, f"{body}.orientation")
                    assert np.linalg.norm(_numbers(own.transform.rotation)) == pytest.approx(1.0, abs=1e-9)
            case "/odom":
                assert (message.header.frame_id, message.child_frame_id) == ("world", "free_cube")
                assert _numbers(message.pose.pose.position) == _columns(row, f"{BODY}.position")
                assert _numbers(message.pose.pose.orientation) == _columns(row, f"{BODY}.orientation")
                assert _numbers(message.twist.twist.linear) == _columns(row, f"{BODY}.body_linear_velocity")
                assert _numbers(message.twist.twist.angular) == _columns(row, f"{BODY}.body_angular_velocity")
            case "/imu":
                assert message.header.frame_id == "free_cube"
                assert _numbers(message.orientation) == _columns(row, f"{BODY}.orientation")
                unknown = (message.angular_velocity_covariance[0], message.linear_acceleration_covariance[0])
                assert unknown == (-1.0, -1.0)
            case "/twist":
                assert message.header.frame_id == "world"
                assert _numbers(message.twist.linear) == _columns(row, f"{BODY}.linear_velocity")
                assert _numbers(message.twist.angular) == _columns(row, f"{BODY}.angular_velocity")
            case "/wrench":
                assert _numbers(message.wrench.force) == _columns(row, f"{BODY}.force")
                assert _numbers(message.wrench.torque) == _columns(row, f"{BODY}.moment")
    assert points == [*range(points[0], points[-1] + 1)], topic


def point_of(message: Any) -> int:  # noqa: ANN401 a message
    """The point of the stamp of a message."""
    header = message.header if hasattr(message, "header") else message.transforms[0].header
    time: float = header.stamp.sec + header.stamp.nanosec * 1e-9
    return round(time / STEP_SIZE)


def assert_pushed(result: fmu_mesh.Result) -> None:
    """The cube has got the force and the torque at one point and kept them, and moves as Newton says."""
    force, torque = (result[f"{BODY}.{what}_z"] for what in ("force", "moment"))
    assert ({*force}, {*torque}) == ({0.0, FORCE}, {0.0, TORQUE})
    assert np.all(np.diff(force) >= 0.0)
    assert np.array_equal(force * TORQUE, torque * FORCE)
    for given, speed in ((force / MASS, "linear_velocity_z"), (torque / INERTIA, "angular_velocity_z")):
        assert np.diff(result[f"{BODY}.{speed}"]) == pytest.approx(given[1:] * STEP_SIZE, rel=1e-6, abs=1e-12)


def _numbers(vector: Any) -> list[float]:  # noqa: ANN401 a message
    """The components of a vector or a quaternion."""
    return [getattr(vector, letter) for letter in "xyzw" if hasattr(vector, letter)]


def _columns(row: Mapping[str, float], name: str) -> list[float]:
    return [row[f"{name}_{letter}"] for letter in "xyzw" if f"{name}_{letter}" in row]
