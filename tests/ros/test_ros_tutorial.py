"""`docs/ros-tutorial.md` with real ROS: its commands bring all that RViz needs, and the arm moves as the page says.

RViz cannot be installed here. What it needs of a mesh is known: the description for who comes late, a frame for each
link, and `/clock`. `examples/ros/arm.rviz` says where it looks for them.
"""

from __future__ import annotations

import math
import os
import shlex
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as ET

import numpy as np
import pytest
import yaml

from tests.helpers import Place
from tests.pages.blocks import ROOT, Block, blocks_of
from tests.ros.peers import need
from tests.ros.ros_peer import Ros, built_types_or_skip, ros_or_skip

ros_or_skip()
need("sensor_msgs")
BUILT = built_types_or_skip()
pytest.importorskip("mujoco", reason="MuJoCo is not installed; pip install '.[physics]'")

PAGE = blocks_of(ROOT / "docs" / "ros-tutorial.md")
ROBOT = ET.parse(ROOT / "examples" / "ros" / "arm.urdf").getroot()  # noqa: S314 our own file
JOINTS = {own.attrib["name"]: own for own in ROBOT.iter("joint")}
VIEW = yaml.safe_load((ROOT / "examples" / "ros" / "arm.rviz").read_text(encoding="utf-8"))["Visualization Manager"]
NEAR = 0.02
"""How near a joint has to come to its target in rad; the targets are 0.5 rad and more from where it was."""


def block(beginning: str) -> Block:
    [found] = [own for own in PAGE if own.text.startswith(beginning)]
    return found


@pytest.fixture
def ros(place: Place) -> Iterator[Ros]:
    """The mesh and its ROS node, as the page starts them in a clone, and ROS to look at them."""
    for name in ("examples", "fmus"):
        (place.folder / name).symlink_to(ROOT / name)
    config = block("mesh: arm")
    (place.folder / config.detail).write_text(config.text, encoding="utf-8")
    with Ros(place.folder / "log") as ros:
        path = f"{Path(sys.executable).parent}:{os.environ['PATH']}"
        place.environment = {**place.environment, **ros.environment, **BUILT, "PATH": path}
        for beginning in ("fmu-mesh launch arm.yaml --no-progress", "python3 -m fmu_mesh.ros.node"):
            place.start_command(shlex.split(block(beginning).text.rstrip("&\n ")))
        yield ros


def test_late_viewer_finds_description_joints_and_frame_of_each_link(ros: Ros) -> None:
    from rosgraph_msgs.msg import Clock  # noqa: PLC0415 only where ROS is installed
    from sensor_msgs.msg import JointState  # noqa: PLC0415 as above
    from std_msgs.msg import String  # noqa: PLC0415 as above
    from tf2_msgs.msg import TFMessage  # noqa: PLC0415 as above

    _, states = ros.collect(ros.peer("early"), JointState, "/joint_states")
    ros.until(lambda: states, "a state of the joints")  # the node is active, so a description was published before
    viewer = ros.peer("viewer")
    [model] = [own for own in VIEW["Displays"] if own["Class"].endswith("/RobotModel")]
    source = model["Description Topic"]
    _, descriptions = ros.collect(viewer, String, source["Value"], quality(source))
    _, transforms = ros.collect(viewer, TFMessage, "/tf")
    _, clocks = ros.collect(viewer, Clock, "/clock")
    ros.until(lambda: descriptions and transforms and clocks, "what a viewer needs")

    assert descriptions[-1].data == (ROOT / "examples" / "ros" / "arm.urdf").read_text(encoding="utf-8")
    assert list(states[-1].name) == [name for name, own in JOINTS.items() if own.attrib["type"] != "fixed"]
    parents = {own.child_frame_id: own.header.frame_id for own in transforms[-1].transforms}
    fixed = VIEW["Global Options"]["Fixed Frame"]
    assert {own.attrib["name"] for own in ROBOT.iter("link")} == {fixed, *parents}
    for frame in parents:
        way = [frame]
        while way[-1] in parents and len(way) <= len(parents):
            way.append(parents[way[-1]])
        assert way[-1] == fixed, way


def test_arm_goes_where_page_sends_it_and_links_follow_joints(ros: Ros, place: Place) -> None:
    from sensor_msgs.msg import JointState  # noqa: PLC0415 only where ROS is installed
    from tf2_msgs.msg import TFMessage  # noqa: PLC0415 as above

    peer = ros.peer()
    reader, states = ros.collect(peer, JointState, "/joint_states")
    frames, transforms = ros.collect(peer, TFMessage, "/tf")
    commands = peer.create_publisher(JointState, "/joint_commands", 1)
    ros.matched(reader, frames, commands)
    ros.known_to("/fmi_adapter_node", peer)
    ros.until(lambda: states, "a state of the joints")

    first = place.start_command(shlex.split(block("fmu-mesh set controller1.target").text.splitlines()[0]))
    assert first.wait() == 0, first.story()
    *_, typed = shlex.split(block("ros2 topic pub").text)
    commands.publish(JointState(**yaml.safe_load(typed)))
    ros.until(lambda: states[-1].position[0] > 0.8 - NEAR and states[-1].position[1] < -0.5 + NEAR, "the arm")

    found = {stamp(own.header): dict(zip(own.name, own.position, strict=True)) for own in states}
    compared = 0
    for message in transforms:
        joints = found.get(stamp(message.transforms[0].header))
        if joints is None:
            continue  # one of the topics was matched before the other
        compared += 1
        expected = links_at(joints)
        for own in message.transforms:
            at, turn = own.transform.translation, own.transform.rotation
            place_of_link, heading = expected[own.child_frame_id]
            assert [at.x, at.y, at.z] == pytest.approx(place_of_link, abs=1e-12)
            assert (turn.x, turn.y) == (0.0, 0.0)
            assert [turn.z, turn.w] == pytest.approx([math.sin(heading / 2), math.cos(heading / 2)], abs=1e-12)
    assert compared > 100


def quality(topic: dict[str, Any]) -> Any:  # noqa: ANN401 types of rclpy
    """The quality of service that a file of RViz asks for."""
    from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy  # noqa: PLC0415 only where ROS is installed

    return QoSProfile(
        depth=topic["Depth"],
        durability=DurabilityPolicy[topic["Durability Policy"].upper().replace(" ", "_")],
        reliability=ReliabilityPolicy[topic["Reliability Policy"].upper()],
    )


def stamp(header: Any) -> tuple[int, int]:  # noqa: ANN401 types of rclpy
    return header.stamp.sec, header.stamp.nanosec


def links_at(joints: dict[str, float]) -> dict[str, tuple[list[float], float]]:
    """Where the description has each link, and its angle about the vertical axis; all axes are vertical."""
    found: dict[str, tuple[list[float], float]] = {"world": ([0.0, 0.0, 0.0], 0.0)}
    for name, joint in JOINTS.items():
        parent, child, origin, axis = (joint.find(own) for own in ("parent", "child", "origin", "axis"))
        assert parent is not None
        assert child is not None
        assert origin is not None
        assert axis is not None
        assert axis.attrib["xyz"] == "0 0 1"
        place, heading = found[parent.attrib["link"]]
        x, y, z = (float(text) for text in origin.attrib["xyz"].split())
        cosine, sine = np.cos(heading), np.sin(heading)
        moved = [place[0] + cosine * x - sine * y, place[1] + sine * x + cosine * y, place[2] + z]
        found[child.attrib["link"]] = moved, heading + joints[name]
    return found
