"""`examples/ros/path_filter/turn.yaml`: a bag with frames, markers and ways that three readers accept, as figure 16."""

from __future__ import annotations

import dataclasses
import math
import re
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as ET

import numpy as np
import pytest

import fmu_mesh
from tests.helpers import FMUS
from tests.ros.peers import need
from tests.ros.ros_peer import built_types_or_skip, ros_or_skip
from tests.ros.test_bag import messages_of

pytest.importorskip("mcap", reason="the package mcap is not installed; pip install '.[test]'")

ROOT = FMUS.parent
EXAMPLE = ROOT / "examples" / "ros" / "path_filter"
CASTERS = ("front_left", "front_right", "rear_left", "rear_right")
VEHICLES = {"filtered": "", "bare": "bare/"}
"""The prefix of the frames of each vehicle."""
TOPICS = {
    "/clock": "rosgraph_msgs/msg/Clock",
    "/driven": "visualization_msgs/msg/Marker",
    "/driven_without_filter": "visualization_msgs/msg/Marker",
    "/planned": "nav_msgs/msg/Path",
    "/robot_description": "std_msgs/msg/String",
    "/tf": "tf2_msgs/msg/TFMessage",
}
"""What is in the bag; the 3D panel of Foxglove and RViz know these types by their names."""


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The result of the example, in a clone."""
    clone = tmp_path_factory.mktemp("clone")
    (clone / "fmus").symlink_to(ROOT / "fmus")
    own = clone / "examples" / "ros" / "path_filter"
    own.mkdir(parents=True)
    for file in ("scene.py", "shuttle.urdf", "turn.yaml"):
        (own / file).write_bytes((EXAMPLE / file).read_bytes())
    fmu_mesh.load(own / "turn.yaml").run(processes=False)
    return clone / "results" / "turn.mcap"


@pytest.fixture(scope="module")
def decoded(bag: Path) -> dict[str, list[tuple[int, Any]]]:
    return messages_of(bag)


@pytest.fixture(scope="module")
def figure_18() -> fmu_mesh.Result:
    """The same drive in the mesh of figure 18, without the scene."""
    mesh = fmu_mesh.load(ROOT / "configs" / "path_filter.yaml")
    mesh.configure(record={"file": "drive.csv", "variables": ["profile.*", "filtered.*", "bare.*"]})
    return mesh.run(processes=False, record="memory")


def test_frames_are_poses_of_vehicles_and_their_casters(
    decoded: dict[str, list[tuple[int, Any]]], figure_18: fmu_mesh.Result
) -> None:
    assert len(decoded["/tf"]) == 1001
    for row, (at, message) in enumerate(decoded["/tf"]):
        point = row * 10
        assert at == round(figure_18.times[point] * 1e9)
        frames = {own.child_frame_id: own for own in message.transforms}
        for vehicle, prefix in VEHICLES.items():
            base = frames[f"{prefix}base_link"]
            place = (base.transform.translation.x, base.transform.translation.y)
            assert base.header.frame_id == "odom"
            assert place == (figure_18[f"{vehicle}.x"][point], figure_18[f"{vehicle}.y"][point])
            turned = {base.child_frame_id: figure_18[f"{vehicle}.heading"][point]}
            for number, name in enumerate(CASTERS, start=1):
                angle = figure_18[f"{vehicle}.casterAngle[{number}]"][point]
                turned[f"{prefix}caster_{name}"] = angle
                assert frames[f"{prefix}caster_{name}"].header.frame_id == f"{prefix}base_link"
            for name, angle in turned.items():
                rotation = frames[name].transform.rotation
                assert (rotation.x, rotation.y) == (0.0, 0.0)
                assert (rotation.z, rotation.w) == (math.sin(angle / 2), math.cos(angle / 2))


def test_frames_stand_where_robot_description_has_its_links(decoded: dict[str, list[tuple[int, Any]]]) -> None:
    [(_, description)] = decoded["/robot_description"]
    robot = ET.fromstring(description.data)  # noqa: S314 our own file
    _, message = decoded["/tf"][-1]
    frames = {own.child_frame_id: own for own in message.transforms}

    links = {link.attrib["name"] for link in robot.iter("link")}
    assert {name for name in frames if not name.startswith("bare/")} == links
    assert {name.removeprefix("bare/") for name in frames if name.startswith("bare/")} == links
    for joint in robot.iter("joint"):
        parent, child, origin = (joint.find(name) for name in ("parent", "child", "origin"))
        assert parent is not None
        assert child is not None
        assert origin is not None
        for prefix in VEHICLES.values():
            own = frames[prefix + child.attrib["link"]]
            moved = own.transform.translation
            assert own.header.frame_id == prefix + parent.attrib["link"]
            assert [moved.x, moved.y, moved.z] == [float(text) for text in origin.attrib["xyz"].split()]


@pytest.mark.parametrize(("topic", "vehicle"), [("/driven", "filtered"), ("/driven_without_filter", "bare")])
def test_markers_are_pieces_of_way_that_join(
    topic: str, vehicle: str, decoded: dict[str, list[tuple[int, Any]]], figure_18: fmu_mesh.Result
) -> None:
    markers = [message for _, message in decoded[topic]]

    # A marker replaces one of the same namespace and number, so each piece has a number of its own.
    assert [own.id for own in markers] == list(range(201))
    line_strip, add = 4, 0  # this reader has no constants of a type
    assert {(own.ns, own.type, own.action, own.header.frame_id) for own in markers} == {
        (vehicle, line_strip, add, "odom")
    }
    pieces = [[(point.x, point.y) for point in own.points] for own in markers]
    ends = list(zip(figure_18[f"{vehicle}.x"][::50], figure_18[f"{vehicle}.y"][::50], strict=True))
    assert [end for _, end in pieces] == ends
    assert [start for start, _ in pieces[1:]] == ends[:-1]
    # RViz draws no marker without a size, a colour or a direction.
    assert all(own.scale.x > 0 and own.color.a == 1 and own.pose.orientation.w == 1 for own in markers)


def test_planned_way_is_what_commands_add_up_to(
    decoded: dict[str, list[tuple[int, Any]]], figure_18: fmu_mesh.Result
) -> None:
    """Velocities change linearly between points, so the trapezoidal rule has no error but rounding."""
    [(_, path)] = decoded["/planned"]
    poses = [own.pose for own in path.poses]
    speed, rate = figure_18["profile.linearVelocity"], figure_18["profile.angularVelocity"]
    heading = np.concatenate([[0.0], np.cumsum((rate[1:] + rate[:-1]) * 0.001)])
    x, y = (
        np.concatenate([[0.0], np.cumsum((part[1:] + part[:-1]) * 0.001)])
        for part in (speed * np.cos(heading), speed * np.sin(heading))
    )

    for pose, time in zip(poses, (0.0, 4.5, 14.5, 20.0), strict=True):  # at rest
        point = round(time / 0.002)
        assert [pose.position.x, pose.position.y] == pytest.approx([x[point], y[point]], abs=1e-9)
        half = heading[point] / 2
        assert [pose.orientation.z, pose.orientation.w] == pytest.approx([math.sin(half), math.cos(half)], abs=1e-9)


def test_three_readers_find_complete_types_and_equal_messages(
    bag: Path, decoded: dict[str, list[tuple[int, Any]]]
) -> None:
    from mcap.reader import make_reader  # noqa: PLC0415 an optional dependency
    from rosbags.highlevel import AnyReader  # noqa: PLC0415 as above

    with bag.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        summary = reader.get_summary()
        times = [(channel.topic, message.log_time) for _, channel, message in reader.iter_messages()]
    assert summary is not None
    schemas = {channel.topic: summary.schemas[channel.schema_id] for channel in summary.channels.values()}
    assert {topic: own.name for topic, own in schemas.items()} == TOPICS
    for schema in schemas.values():
        assert schema.encoding == "ros2msg"
        assert unknown_types(schema.name, schema.data.decode()) == set()
    assert sorted(times) == sorted((topic, at) for topic, own in decoded.items() for at, _ in own)

    with AnyReader([bag]) as other:
        found: dict[str, list[Any]] = {}
        for connection, _, data in other.messages():
            found.setdefault(connection.topic, []).append(other.deserialize(data, connection.msgtype))
    assert found.keys() == decoded.keys()
    for topic, messages in found.items():
        assert [plain(own) for own in messages] == [plain(own) for _, own in decoded[topic]], topic


def test_ros_itself_reads_every_message(bag: Path, decoded: dict[str, list[tuple[int, Any]]]) -> None:
    ros_or_skip()
    need("nav_msgs", "visualization_msgs")
    built_types_or_skip()
    from mcap.reader import make_reader  # noqa: PLC0415 an optional dependency
    from rclpy.serialization import deserialize_message  # noqa: PLC0415 only where ROS is installed

    from fmu_mesh.ros_wire.rclpy_profile import message_class  # noqa: PLC0415 beside it

    found: dict[str, list[Any]] = {}
    with bag.open("rb") as file:
        for schema, channel, message in make_reader(file).iter_messages():
            assert schema is not None
            read = deserialize_message(message.data, message_class(schema.name))
            found.setdefault(channel.topic, []).append(plain(read))

    assert found == {topic: [plain(own) for _, own in messages] for topic, messages in decoded.items()}


def unknown_types(name: str, text: str) -> set[str]:
    """The types of fields in a definition that neither ROS has built in nor the text defines."""
    basic = r"bool|byte|char|u?int(8|16|32|64)|float(32|64)|w?string(<=\d+)?"
    sections = re.split(r"^=+\nMSG: (\S+)\n", text, flags=re.MULTILINE)
    defined = {name.replace("/msg/", "/"), *(own.replace("/msg/", "/") for own in sections[1::2])}
    used = set()
    for owner, section in zip([name, *sections[1::2]], sections[::2], strict=True):
        for line in section.splitlines():
            words = line.partition("#")[0].split()
            kind = re.sub(r"\[.*\]$", "", words[0]).replace("/msg/", "/") if words else "bool"
            if not re.fullmatch(basic, kind):
                used.add(kind if "/" in kind else f"{owner.partition('/')[0]}/{kind}")
    return used - defined


def plain(value: Any) -> Any:  # noqa: ANN401 a message, or a field of one
    """A message of any reader as lists and numbers."""
    if isinstance(value, str | int | float | bool):
        return value
    if dataclasses.is_dataclass(value):
        names = (own.name for own in dataclasses.fields(value))
        return {name: plain(getattr(value, name)) for name in names if re.match("[a-z]", name)}  # no constants
    if hasattr(value, "get_fields_and_field_types"):  # of rclpy
        return {name: plain(getattr(value, name)) for name in value.get_fields_and_field_types()}
    if hasattr(value, "__slots__"):
        return {name: plain(getattr(value, name)) for name in value.__slots__}
    return [plain(own) for own in value]
