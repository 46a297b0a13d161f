"""Ready shapes of the section `ros`: the ordinary topics that they become, and all that can be wrong with them."""

from __future__ import annotations

import math
import shlex
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import fmu_mesh
from fmu_mesh.errors import ConfigurationError
from fmu_mesh.ros_wire.topics import Topic
from tests.helpers import write_config
from tests.planning import prepare
from tests.ros.test_bag import messages_of
from tests.ros.test_gateway_topics import WORLDS, plan_of
from tests.ros.worlds_in_ros import GAZEBO_WORLDS, MUJOCO_WORLDS, record

mujoco = pytest.importorskip("mujoco", reason="MuJoCo is not installed; pip install '.[mujoco]'")

QUATERNION = ("x", "y", "z", "w")

# A free body, whose first quaternion has the norm 3.6, and a chain with sensors; two names are hard to write in a path.
ROBOT = """
<mujoco model="robot">
  <option timestep="0.001"/>
  <worldbody>
    <body name="base">
      <freejoint/>
      <geom type="box" size="0.1 0.2 0.3"/>
      <site name="imu"/>
    </body>
    <body name="upper" pos="0 0 3" quat="1 1 0 0">
      <joint name="shoulder" axis="1 2 3"/>
      <geom type="sphere" size="0.1"/>
      <body name="lower]" pos="0 0 1" quat="3 1 2 0">
        <joint name="slide]er" type="slide" axis="0 0 1"/>
        <geom type="sphere" size="0.1"/>
      </body>
    </body>
  </worldbody>
  <sensor>
    <gyro name="gyro" site="imu"/>
    <velocimeter name="velocimeter" site="imu"/>
    <accelerometer name="accelerometer" site="imu"/>
    <framequat name="attitude" objtype="site" objname="imu"/>
  </sensor>
  <keyframe><key name="tilted" qpos="0 0 0 2 0 0 3 0.3 0.1" qvel="0.5 0 0 1 2 3 4 0"/></keyframe>
</mujoco>
"""


def robot(folder: Path, *topics: dict[str, Any], **more: Any) -> Path:  # noqa: ANN401 what a file may hold
    """A configuration with the robot, a world of two cubes and a gain."""
    (folder / "robot.xml").write_text(ROBOT)
    return write_config(
        folder,
        name="robot",
        instances={
            "world": {"mujoco": "robot.xml", "keyframe": "tilted"},
            "cubes": {"mujoco": str(WORLDS / "fluid_body.xml")},
            "gain": {"fmu": "Gain"},
        },
        connections=(),
        simulation={"step_size": 0.01},
        ros={"topics": list(topics)},
        **more,
    )


def topic(folder: Path, **item: Any) -> Topic:  # noqa: ANN401 what a file may hold
    [found] = plan_of(robot(folder, item)).topics
    return found


def fields(found: Topic) -> dict[str, str]:
    return {port.path: f"{port.instance}.{port.variable.name}" for port in found.ports}


def vector(field: str, variable: str) -> dict[str, str]:
    return {f"{field}.{axis}": f"{variable}_{axis}" for axis in "xyz"}


def sensor(field: str, name: str) -> dict[str, str]:
    return {f"{field}.{axis}": f"world.{name}.value[{number}]" for number, axis in enumerate("xyz", 1)}


def quaternion(field: str, variable: str) -> dict[str, str]:
    return {f"{field}.{letter}": f"{variable}_{letter}" for letter in QUATERNION}


def test_joint_states_are_all_joints_of_a_world(tmp_path: Path) -> None:
    found = topic(tmp_path, joint_states="world")

    assert (found.name, found.message, found.direction) == ("/joint_states", "sensor_msgs/msg/JointState", "out")
    assert found.constants == (("name[0]", "shoulder"), ("name[1]", "slide]er"))
    assert fields(found) == {
        "position[0]": "world.shoulder.position",
        "velocity[0]": "world.shoulder.velocity",
        "effort[0]": "world.shoulder.effort_applied",
        "position[1]": "world.slide]er.position",
        "velocity[1]": "world.slide]er.velocity",
        "effort[1]": "world.slide]er.effort_applied",
    }


def test_shapes_are_the_same_as_their_fields_written_out(tmp_path: Path) -> None:
    written = {
        "topic": "/joint_states",
        "type": "sensor_msgs/msg/JointState",
        "fields": {
            "position[name=shoulder]": "world.shoulder.position",
            "velocity[name=shoulder]": "world.shoulder.velocity",
            "effort[name=shoulder]": "world.shoulder.effort_applied",
        },
    }

    assert topic(tmp_path, joint_states="world.shoulder") == topic(tmp_path, **written)


def test_transforms_lead_from_world_to_bodies(tmp_path: Path) -> None:
    found = topic(tmp_path, tf=["world", "cubes.cube"])

    assert (found.name, found.message, found.frame_id) == ("/tf", "tf2_msgs/msg/TFMessage", "world")
    names = ["base", "upper", "lower]", "cube"]
    assert found.constants == tuple((f"transforms[{at}].child_frame_id", name) for at, name in enumerate(names))
    bodies = ["world.base", "world.upper", "world.lower]", "cubes.cube"]
    expected: dict[str, str] = {}
    for at, body in enumerate(bodies):
        expected |= vector(f"transforms[{at}].transform.translation", f"{body}.position")
        expected |= quaternion(f"transforms[{at}].transform.rotation", f"{body}.orientation")
    assert fields(found) == expected


def test_bodies_and_sensors_have_the_vectors_of_other_shapes(tmp_path: Path) -> None:
    twist = topic(tmp_path, twist="world.base")
    assert (twist.name, twist.message, twist.frame_id) == ("/twist", "geometry_msgs/msg/TwistStamped", "world")
    assert fields(twist) == {
        **vector("twist.linear", "world.base.linear_velocity"),
        **vector("twist.angular", "world.base.angular_velocity"),
    }

    wrench = topic(tmp_path, wrench="world.base", topic="/push", type="geometry_msgs/msg/Wrench")
    assert (wrench.name, wrench.direction) == ("/push", "in")
    assert fields(wrench) == {**vector("force", "world.base.force"), **vector("torque", "world.base.moment")}

    imu = topic(
        tmp_path, imu={"angular_velocity": "world.gyro.value", "linear_acceleration": "world.accelerometer.value"}
    )
    assert imu.constants == (("orientation_covariance[0]", -1.0),)
    assert fields(imu) == {
        **sensor("angular_velocity", "gyro"),
        **sensor("linear_acceleration", "accelerometer"),
    }
    assert topic(tmp_path, imu="world.base").frame_id == "base"

    body = topic(tmp_path, odometry="world.base")
    assert (body.frame_id, body.constants) == ("world", (("child_frame_id", "base"),))
    assert fields(body) == {
        **vector("pose.pose.position", "world.base.position"),
        **quaternion("pose.pose.orientation", "world.base.orientation"),
        **vector("twist.twist.linear", "world.base.body_linear_velocity"),
        **vector("twist.twist.angular", "world.base.body_angular_velocity"),
    }
    velocities = {"linear": "world.velocimeter.value", "angular": "world.gyro.value"}
    odometry = topic(tmp_path, odometry={"body": "world.base", **velocities}, frame_id="odom")
    assert (odometry.name, odometry.frame_id, odometry.constants) == ("/odom", "odom", (("child_frame_id", "base"),))
    assert fields(odometry) == {
        **vector("pose.pose.position", "world.base.position"),
        **quaternion("pose.pose.orientation", "world.base.orientation"),
        **sensor("twist.twist.linear", "velocimeter"),
        **sensor("twist.twist.angular", "gyro"),
    }


def test_single_components_are_given_beside_vectors(tmp_path: Path) -> None:
    found = topic(tmp_path, twist={"linear.x": "gain.u"}, type="geometry_msgs/msg/Twist", topic="/cmd_vel")

    assert (found.name, found.direction, fields(found)) == ("/cmd_vel", "in", {"linear.x": "gain.u"})


@pytest.mark.parametrize(
    ("item", "message"),
    [
        (
            {"joint_states": "wrld"},
            "the unknown instance 'wrld'; expected one of the instances world, cubes, gain. Did",
        ),
        (
            {"joint_states": "gain"},
            "'gain', which has no joint; expected an instance with variables `<joint>.position`",
        ),
        ({"joint_states": "world.shouldr"}, "one of shoulder, slide]er. Did you mean 'shoulder'?"),
        ({"joint_states": "world", "tf": "world"}, "both `joint_states` and `tf`; expected one of them"),
        ({"tf": "world", "variable": "gain.y"}, "both `tf` and `variable`; expected one of them"),
        ({"twist": "cubes"}, "the 2 bodies of 'cubes'; expected one of cubes.cube, cubes.free_cube"),
        ({"twist": "world.bas"}, "ros.topics[0].twist: the unknown body 'bas' of instance 'world'"),
        ({"twist": {"liner": "world.base.position"}}, "one of body, linear, angular. Did you mean 'linear'?"),
        ({"twist": {"linear": "world.base.linear_velocit"}}, "Did you mean 'base.linear_velocity'?"),
        ({"twist": {"linear.x": "world.gyro.val"}}, "ros.topics[0].twist: the unknown variable 'gyro.val'"),
        ({"twist": {"linear.k": "gain.y"}}, "ros.topics[0].twist: 'geometry_msgs/msg/TwistStamped' has no field"),
        ({"twist": "world.base", "type": "nav_msgs/msg/Path"}, "expected geometry_msgs/msg/TwistStamped or geometry"),
        # The order of a quaternion by number is not the same everywhere.
        ({"imu": {"orientation": "world.attitude.value"}}, "or each component (`orientation.x: …`)"),
        ({"imu": {}}, "ros.topics[0].imu: nothing; expected `instance.vector` by part: orientation, angular_velocity"),
        (
            {"odometry": {"position": "world.base.position", "orientation": "world.base.orientation"}},
            "no `linear` and no `angular`; expected a vector for each, of velocities in the",
        ),
    ],
)
def test_what_is_wrong_with_shapes_is_told(tmp_path: Path, item: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigurationError) as caught:
        prepare(robot(tmp_path, item))

    assert message in str(caught.value)


def test_bodies_of_two_worlds_with_one_name_are_refused(tmp_path: Path) -> None:
    world = {"mujoco": str(WORLDS / "fluid_body.xml")}
    config = write_config(
        tmp_path, instances={"left": world, "right": world}, connections=(), ros={"topics": [{"tf": ["left", "right"]}]}
    )

    with pytest.raises(ConfigurationError) as caught:
        prepare(config)

    assert "the body 'cube' of 'left' and of 'right'; expected a topic for each instance" in str(caught.value)


def test_recorded_shapes_have_values_of_world_and_unit_quaternions(tmp_path: Path) -> None:
    pytest.importorskip("mcap", reason="the package mcap is not installed; pip install '.[test]'")
    config = robot(tmp_path, {"joint_states": "world"}, {"tf": "world"}, record={"file": "robot.mcap"})

    fmu_mesh.load(config).run(processes=False)
    result = fmu_mesh.load(config).run(processes=False, record="memory")

    messages = messages_of(tmp_path / "robot.mcap")
    states, transforms = messages["/joint_states"], messages["/tf"]
    assert len(states) == len(transforms) == 101
    for point, (_, state) in enumerate(states):
        assert state.name == ["shoulder", "slide]er"]
        assert list(state.position) == [result[f"world.{name}.position"][point] for name in state.name]
    for point, (_, message) in enumerate(transforms):
        assert [own.child_frame_id for own in message.transforms] == ["base", "upper", "lower]"]
        for own in message.transforms:
            rotation = [getattr(own.transform.rotation, letter) for letter in QUATERNION]
            body = f"world.{own.child_frame_id}"
            assert rotation == [result[f"{body}.orientation_{letter}"][point] for letter in QUATERNION]
            # MuJoCo does not normalize again what is nearer to 1 than `mjMINVAL`; one rounding is that of `hypot`.
            assert abs(math.hypot(*rotation) - 1.0) <= mujoco.mjMINVAL + math.ulp(1.0)
            assert own.header.frame_id == "world"


def test_odometry_of_a_body_is_how_its_sensors_move(tmp_path: Path) -> None:
    pytest.importorskip("mcap", reason="the package mcap is not installed; pip install '.[test]'")
    local = [f"world.base.body_{what}_velocity_{axis}" for what in ("linear", "angular") for axis in "xyz"]
    topics: list[dict[str, Any]] = [{"odometry": "world.base"}, {"twist": "world.base"}]
    record = {"file": "robot.mcap", "variables": ["world.*", *local]}
    config = robot(tmp_path, *topics, record=record, stop_time=2.0)

    fmu_mesh.load(config).run(processes=False)
    result = fmu_mesh.load(config).run(processes=False, record="memory")

    messages = messages_of(tmp_path / "robot.mcap")
    assert len(messages["/odom"]) == len(messages["/twist"]) == 201
    for point, ((_, own), (_, world)) in enumerate(zip(messages["/odom"], messages["/twist"], strict=True)):
        rotation = [getattr(own.pose.pose.orientation, letter) for letter in QUATERNION]
        for what, sensor_name in {"linear": "velocimeter", "angular": "gyro"}.items():
            measured = [result[f"world.{sensor_name}.value[{number}]"][point] for number in (1, 2, 3)]
            found = [getattr(getattr(own.twist.twist, what), axis) for axis in "xyz"]
            # The same vector through another path: twice the quaternion, not its matrix.
            of_world = [getattr(getattr(world.twist, what), axis) for axis in "xyz"]
            assert found == pytest.approx(into_axes(rotation, of_world), rel=1e-12, abs=1e-12)
            assert found == pytest.approx(measured, rel=1e-12, abs=1e-12)
    first = messages["/odom"][0][1].twist.twist.angular
    assert (first.x, first.y, first.z) == pytest.approx((1.0, 2.0, 3.0), rel=1e-14), "as in the keyframe"


@pytest.mark.parametrize("worlds", [MUJOCO_WORLDS, GAZEBO_WORLDS], ids=["mujoco", "gazebo"])
def test_recorded_shapes_have_values_of_worlds_of_each_engine(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, worlds: Mapping[str, Any]
) -> None:
    """Gazebo itself is in `tests/physics/test_gazebo_classic.py`; here a program says what it would say."""
    pytest.importorskip("mcap", reason="the package mcap is not installed; pip install '.[test]'")
    double = Path(__file__).parents[1] / "physics" / "gazebo_double.py"
    monkeypatch.setenv("FMU_MESH_GAZEBO", shlex.join([sys.executable, str(double), "nothing"]))

    record(tmp_path, worlds)


def into_axes(quaternion: list[float], vector: list[float]) -> list[float]:
    """A vector in the axes that a unit quaternion (x, y, z, w) turns: v + 2 w (u x v) + 2 u x (u x v), u = -xyz."""
    x, y, z, w = quaternion
    u = np.array([-x, -y, -z])
    turned = np.cross(u, vector)
    found: list[float] = (np.array(vector) + 2 * w * turned + 2 * np.cross(u, turned)).tolist()
    return found
