"""Elements of messages by their keys: whatever their order is, a value goes to its own variable."""

from __future__ import annotations

import math
from operator import getitem
from typing import Any, Literal

import pytest

from fmu_mesh.ros_wire.assembling import Assembler, Disassembler
from fmu_mesh.ros_wire.cdr import CdrError, Codec
from fmu_mesh.ros_wire.definitions import Key, MessageTypes, UnknownField, path_parts
from fmu_mesh.ros_wire.keyed_rows import FieldReader, by_index
from fmu_mesh.ros_wire.topics import Port, Topic
from fmu_mesh.variables.model_description import Variable, VariableType

TYPES = MessageTypes("kilted")
JOINTS = "sensor_msgs/msg/JointState"
TRAJECTORY = "trajectory_msgs/msg/JointTrajectory"
TF = "tf2_msgs/msg/TFMessage"
DIAGNOSTICS = "diagnostic_msgs/msg/DiagnosticArray"
BODIES = "sensor_msgs/msg/MultiDOFJointState"


def topic(
    message: str,
    *paths: str,
    direction: Literal["out", "in"] = "in",
    kind: VariableType = "Float64",
    constants: tuple[tuple[str, str], ...] = (),
) -> Topic:
    ports = [
        Port(path, "one", Variable(path, 0, type=kind, causality="output", variability="continuous"), direction)
        for path in paths
    ]
    return Topic("/t", message, direction, tuple(ports), constants=constants)


def reader(message: str, *paths: str) -> FieldReader:
    return FieldReader(topic(message, *paths), TYPES, getitem)


def joints(names: list[str], **columns: list[float]) -> dict[str, Any]:
    return {"name": names, "position": [], "velocity": [], "effort": []} | columns


def published(message: str, *paths: str, constants: tuple[tuple[str, str], ...] = ()) -> dict[str, Any]:
    """The message in which each path has the number of its place, from 1 on."""
    made = by_index(topic(message, *paths, direction="out", constants=constants), TYPES)
    numbers: list[Any] = [float(number) for number in range(1, len(paths) + 1)]
    return Codec(TYPES, message).decode(Assembler(made, TYPES).make(numbers, 0.0))


@pytest.mark.parametrize(
    ("path", "parts"),
    [
        ("position[name=elbow]", ("position", Key("name", "elbow"))),
        ("points[0].positions[joint_names=arm.elbow]", ("points", 0, "positions", Key("joint_names", "arm.elbow"))),
        ('position[name="a]b"]', ("position", Key("name", "a]b"))),
        ("position[name='say \"x\"']", ("position", Key("name", 'say "x"'))),
        ("position[name=a=b]", ("position", Key("name", "a=b"))),
        ("position[name=left arm/1]", ("position", Key("name", "left arm/1"))),
        ("position[name=a]b]", ()),
        ("position[name=elbow", ()),
        ("position.[0]", ()),
    ],
)
def test_path_has_names_indexes_and_keys(path: str, parts: tuple[object, ...]) -> None:
    assert path_parts(path) == parts


@pytest.mark.parametrize(
    ("message", "path", "reason", "names"),
    [
        (JOINTS, "position[nam=a]", "'nam' is no text that tells its elements apart", ("position[name=a]",)),
        (JOINTS, "position[velocity=a]", "'velocity' is no text that tells", ("position[name=a]",)),
        (JOINTS, "position[name=]", "an index is a whole number", None),
        (JOINTS, "header[name=a]", "it is no array", None),
        (TF, "transforms[header=a].transform", "'header' is no text", ("transforms[child_frame_id=a].transform",)),
        (TRAJECTORY, "points[0].positions[name=a]", "is no text", ("points[0].positions[joint_names=a]",)),
        (
            DIAGNOSTICS,
            "status[0].values[x=a].value",
            "is no text",
            ("status[0].values[key=a].value", "status[0].values[value=a].value"),
        ),
        ("std_msgs/msg/Float64MultiArray", "data[x=1]", "'x' is no text", None),
    ],
)
def test_key_that_is_none_is_told_with_those_that_are(
    message: str, path: str, reason: str, names: tuple[str, ...] | None
) -> None:
    with pytest.raises(UnknownField, match=reason) as caught:
        TYPES.field(message, path)

    assert caught.value.names == (tuple(TYPES.paths(message)) if names is None else names)


@pytest.mark.parametrize(
    ("message", "path", "by_key"),
    [
        (JOINTS, "position[0]", "position[name=…]"),
        (JOINTS, "name[0]", "name[0]"),
        (TRAJECTORY, "points[0].positions[1]", "points[0].positions[joint_names=…]"),
        (TF, "transforms[1].transform.rotation.w", "transforms[child_frame_id=…].transform.rotation.w"),
        (DIAGNOSTICS, "status[name=a].values[0].value", "status[name=a].values[key=…].value"),
        ("geometry_msgs/msg/PoseArray", "poses[0].position.x", "poses[0].position.x"),
        ("std_msgs/msg/Float64MultiArray", "data[3]", "data[3]"),
    ],
)
def test_spelling_by_key_is_known_where_texts_tell_elements_apart(message: str, path: str, by_key: str) -> None:
    assert TYPES.resolved(message, path).by_key == by_key


@pytest.mark.parametrize(
    ("names", "position", "found"),
    [
        (["bare", "weak"], [1.0, 2.0], [1.0, 2.0]),
        (["weak", "bare"], [2.0, 1.0], [1.0, 2.0]),
        (["weak"], [2.0], [None, 2.0]),
        (["other", "bare"], [9.0, 1.0], [1.0, None]),
        (["bare", "weak", "bare"], [9.0, 2.0, 1.0], [1.0, 2.0]),
        (["bare", "weak"], [], [None, None]),
        (["bare", "weak"], [math.nan, 2.0], [None, 2.0]),
        ([], [], [None, None]),
    ],
    ids=["in order", "reversed", "missing", "other", "twice", "no column", "nan", "empty"],
)
def test_value_goes_to_its_own_key_in_any_order(
    names: list[str], position: list[float], found: list[float | None]
) -> None:
    fields = reader(JOINTS, "position[name=bare]", "position[name=weak]")

    assert fields.read(joints(names, position=position)) == found


def test_column_of_another_length_than_its_keys_is_refused() -> None:
    fields = reader(JOINTS, "position[name=bare]", "velocity[name=bare]")

    assert fields.read(joints(["bare", "weak"], position=[1.0, 2.0])) == [1.0, None]
    with pytest.raises(CdrError, match=r"'velocity\[name=bare\]' is one of 1 elements for 2 texts in 'name'"):
        fields.read(joints(["bare", "weak"], position=[1.0, 2.0], velocity=[3.0]))
    with pytest.raises(CdrError, match="is one of 3 elements for 0 texts"):
        fields.read(joints([], position=[1.0, 2.0, 3.0]))


def test_keys_that_no_path_has_are_counted_and_told_once() -> None:
    fields = reader(JOINTS, "position[name=bare]", "velocity[name=bare]")
    said = []
    for names in (["bare", "b", "a"], ["a", "b"], ["c", "bare", "a"], ["bare"]):
        fields.read(joints(names, position=[0.0] * len(names)))
        said.append(fields.warning)

    assert said == [
        "elements that no variable has are ignored: a, b; variables have bare",
        "",
        "elements that no variable has are ignored: c; variables have bare",
        "",
    ]
    assert fields.ignored == 6


def test_keys_of_stranger_do_not_fill_memory_or_terminal() -> None:
    fields = reader(JOINTS, "position[name=bare]")
    fields.read(joints(["\x1b[31m" + "x" * 100_000], position=[0.0]))
    assert "ignored: \\x1b[31mxxx" in fields.warning
    assert len(fields.warning) < 200
    for number in range(1000):
        fields.read(joints([f"{number}"], position=[0.0]))

    assert fields.ignored == 1001
    assert len(fields._known) == 100


def test_elements_of_an_outer_array_of_texts_are_found() -> None:
    fields = reader(TRAJECTORY, "points[1].positions[joint_names=b]", "points[0].velocities[joint_names=a]")
    point: dict[str, Any] = {"positions": [1.0, 2.0], "velocities": [3.0, 4.0]}

    assert fields.read({"joint_names": ["a", "b"], "points": [point, point]}) == [2.0, 3.0]
    assert fields.read({"joint_names": ["b", "a"], "points": [point, point]}) == [1.0, 4.0]
    with pytest.raises(CdrError, match=r"it has no 'points\[1\]"):
        fields.read({"joint_names": ["b", "a"], "points": [point]})


def test_keys_of_tables_in_tables_belong_to_their_own_element() -> None:
    fields = reader(
        DIAGNOSTICS, "status[name=left].values[key=amps].value", "status[name=right].values[key=amps].value"
    )

    def status(name: str, **values: str) -> dict[str, Any]:
        return {"name": name, "values": [{"key": key, "value": value} for key, value in values.items()]}

    both = [status("right", amps="2", volts="9"), status("left", volts="8", amps="1")]
    assert fields.read({"status": both}) == ["1", "2"]
    assert fields.read({"status": [status("right", volts="9"), status("left", amps="3")]}) == ["3", None]
    assert fields.ignored == 3


def test_array_of_messages_is_found_by_a_parallel_array_of_texts() -> None:
    fields = reader(BODIES, "transforms[joint_names=b].translation.x")
    rows = [{"translation": {"x": value}} for value in (1.0, 2.0)]

    assert fields.read({"joint_names": ["b", "a"], "transforms": rows}) == [1.0]
    assert fields.read({"joint_names": ["a", "b"], "transforms": rows}) == [2.0]


def test_disassembler_leaves_out_what_a_message_lacks() -> None:
    codec = Codec(TYPES, JOINTS)
    own = Disassembler(topic(JOINTS, "position[name=weak]", "position[name=bare]"), TYPES)
    message = codec.empty() | joints(["bare"], position=[0.5])

    assert own.values(codec.encode(message)) == ([None, 0.5], None)


def test_published_keys_have_order_of_first_mention_and_columns_their_length() -> None:
    message = published(JOINTS, "position[name=weak]", "position[name=bare]", "velocity[name=bare]")

    assert message["name"] == ["weak", "bare"]
    assert message["position"].tolist() == [1.0, 2.0]
    velocity = message["velocity"].tolist()
    assert math.isnan(velocity[0])
    assert velocity[1:] == [3.0]
    assert message["effort"].tolist() == []


def test_constants_place_the_keys_that_they_give() -> None:
    message = published(JOINTS, "position[name=weak]", "position[name=bare]", constants=(("name[0]", "bare"),))

    assert message["name"] == ["bare", "weak"]
    assert message["position"].tolist() == [2.0, 1.0]


def test_transforms_and_tables_in_tables_are_published_by_key() -> None:
    transforms = published(
        TF,
        "transforms[child_frame_id=tool].transform.translation.x",
        "transforms[child_frame_id=cube].transform.translation.y",
        "transforms[child_frame_id=tool].transform.rotation.w",
        constants=(("transforms[child_frame_id=cube].header.frame_id", "tool"),),
    )["transforms"]
    points = published(TRAJECTORY, "points[0].positions[joint_names=b]", "points[1].positions[joint_names=a]")

    assert [own["child_frame_id"] for own in transforms] == ["tool", "cube"]
    assert [own["header"]["frame_id"] for own in transforms] == ["", "tool"]
    assert [own["transform"]["translation"]["x"] for own in transforms] == [1.0, 0.0]
    assert [own["transform"]["translation"]["y"] for own in transforms] == [0.0, 2.0]
    assert [own["transform"]["rotation"]["w"] for own in transforms] == [3.0, 0.0]
    assert points["joint_names"] == ["b", "a"]
    assert [str(own["positions"].tolist()) for own in points["points"]] == ["[1.0, nan]", "[nan, 2.0]"]


def test_what_is_published_by_key_is_read_by_key_in_another_order() -> None:
    made = by_index(topic(JOINTS, 'effort[name="a]b"]', "effort[name=c.d]", direction="out"), TYPES)
    data = Assembler(made, TYPES).make([1.0, 2.0], 0.0)

    own = Disassembler(topic(JOINTS, "effort[name=c.d]", "effort[name='a]b']", "velocity[name=c.d]"), TYPES)

    assert own.values(data) == ([2.0, 1.0, None], None)
