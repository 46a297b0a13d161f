"""Message types: their fields, their hashes, and which of them carries a variable."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import pytest

from fmu_mesh.errors import ConfigurationError
from fmu_mesh.ros_wire.definitions import Basic, MessageTypes, UnknownField, UnknownType
from fmu_mesh.ros_wire.fitting import carries, default_type
from fmu_mesh.variables.value_types import TYPES as FMI_TYPES

SHARE = Path(sys.prefix) / "share"
"""Where the packages of ROS from PyPI put what the generators of ROS have computed."""

TYPES = MessageTypes("kilted")


def test_every_hash_equals_the_one_of_ros_itself() -> None:
    files = sorted(SHARE.glob("*_msgs/msg/*.json")) + sorted(SHARE.glob("*_interfaces/msg/*.json"))
    if not files:
        pytest.skip("ROS is not installed: pip install '.[test-ros]'")
    theirs = {entry["type_name"]: entry["hash_string"] for file in files for entry in _hashes(file)}

    ours = {name: TYPES.type_hash(name) for name in theirs if name in TYPES}

    assert "geometry_msgs/msg/TwistStamped" in ours
    assert ours == {name: theirs[name] for name in ours}


def test_the_hash_of_a_service_equals_the_one_of_ros_itself() -> None:
    file = SHARE / "rcl_interfaces/srv/GetParameters.json"
    if not file.exists():
        pytest.skip("ROS is not installed: pip install '.[test-ros]'")
    types, name = MessageTypes("kilted"), "rcl_interfaces/srv/GetParameters"

    types.define_service(name, "string[] names\n", "rcl_interfaces/ParameterValue[] values\n")

    assert {entry["type_name"]: entry["hash_string"] for entry in _hashes(file)}[name] == types.type_hash(name)


def test_message_without_fields_has_the_byte_that_ros_gives_it() -> None:
    types = MessageTypes("jazzy", {"lab_msgs/msg/Nothing": "# nothing"})

    assert types.fields("lab_msgs/msg/Nothing") == types.fields("std_msgs/msg/Empty") != ()


def test_a_field_is_found_by_its_path() -> None:
    message = "geometry_msgs/msg/PoseWithCovarianceStamped"

    assert TYPES.field(message, "pose.covariance[35]") == Basic("float64")
    assert TYPES.field(message, "header.stamp.sec") == Basic("int32")
    assert TYPES.has_header(message)
    assert not TYPES.has_header("std_msgs/msg/Float64")


@pytest.mark.parametrize("path", ["pose.covariance[36]", "pose.x", "pose.pose.position.x.y", "", "header[0]"])
def test_a_field_that_is_not_there_is_told_with_those_that_are(path: str) -> None:
    with pytest.raises(UnknownField, match="has no field") as caught:
        TYPES.field("geometry_msgs/msg/PoseWithCovarianceStamped", path)

    assert "pose.pose.position.x" in caught.value.names


@pytest.mark.parametrize(
    ("message", "path", "reason"),
    [
        (
            "tf2_msgs/msg/TFMessage",
            "transforms.transform",
            "an array, write an index, such as transforms[0].transform",
        ),
        ("tf2_msgs/msg/TFMessage", "transforms[65536].child_frame_id", "an index is a whole number from 0 to 65535"),
        ("tf2_msgs/msg/TFMessage", "transforms[-1].child_frame_id", "an index is a whole number from 0 to 65535"),
        ("sensor_msgs/msg/JointState", "position[" + "9" * 5000 + "]", "an index is a whole number from 0 to 65535"),
        ("sensor_msgs/msg/JointState", "position[two]", "an index is a whole number from 0 to 65535"),
        ("sensor_msgs/msg/JointState", "position[]", "an index is a whole number from 0 to 65535"),
        ("geometry_msgs/msg/PoseWithCovariance", "covariance[36]", "an index is a whole number from 0 to 35"),
        ("shape_msgs/msg/SolidPrimitive", "dimensions[3]", "an index is a whole number from 0 to 2"),
        ("geometry_msgs/msg/PoseArray", "header[0].frame_id", "it is no array"),
        ("std_msgs/msg/Float64", "data[0]", "it is no array"),
    ],
)
def test_index_that_is_none_of_array_is_told_with_those_that_are(message: str, path: str, reason: str) -> None:
    with pytest.raises(UnknownField) as caught:
        TYPES.field(message, path)

    assert str(caught.value).endswith(reason)


def test_an_element_of_an_array_of_messages_has_fields_as_any_message() -> None:
    assert TYPES.field("tf2_msgs/msg/TFMessage", "transforms[7].transform.rotation.w") == Basic("float64")
    assert TYPES.field("sensor_msgs/msg/JointState", "name[65535]") == Basic("string")
    assert TYPES.field("shape_msgs/msg/SolidPrimitive", "dimensions[2]") == Basic("float64")
    assert "transforms[0].child_frame_id" in TYPES.paths("tf2_msgs/msg/TFMessage")


def test_an_unknown_type_is_told() -> None:
    with pytest.raises(UnknownType, match="'std_msgs/msg/Flot64'"):
        TYPES.fields("std_msgs/msg/Flot64")


def test_a_custom_definition_is_as_good_as_one_of_ros() -> None:
    types = MessageTypes("jazzy", {"lab_msgs/msg/Wheel": "std_msgs/Header header\nfloat64 speed\n"})

    assert types.field("lab_msgs/msg/Wheel", "speed") == Basic("float64")
    assert "MSG: std_msgs/Header" in types.definition("lab_msgs/msg/Wheel")


@pytest.mark.parametrize(
    ("name", "text", "reason"),
    [
        ("Wheel", "float64 x", "is no name of a message type"),
        ("lab_msgs/msg/Wheel", "float64", "is not understood"),
        ("lab_msgs/msg/Wheel", "Rim rim", "there is no message type 'lab_msgs/msg/Rim'"),
        ("lab_msgs/msg/Wheel", "Rim[] rims", "there is no message type 'lab_msgs/msg/Rim'"),
        ("std_msgs/msg/Float64", "float32 data", "is defined already"),
    ],
)
def test_a_wrong_custom_definition_is_refused(name: str, text: str, reason: str) -> None:
    with pytest.raises(ConfigurationError, match=reason):
        MessageTypes("jazzy", {name: text})


def test_every_fmi_type_has_a_message_that_carries_it() -> None:
    for kind in set(FMI_TYPES) - {"Binary"}:
        message = default_type(kind)
        assert message is not None
        leaf = TYPES.field(message, "data")
        assert isinstance(leaf, Basic)
        assert carries(leaf.kind, kind)
        assert carries(kind, leaf.kind)
    assert default_type("Float64", array=True) == "std_msgs/msg/Float64MultiArray"
    assert default_type("Binary") is None


@pytest.mark.parametrize(
    ("target", "source", "fits"),
    [
        ("float64", "Int32", True),
        ("float32", "Int32", False),
        ("float32", "Float64", True),
        ("float64", "int64", False),
        ("int32", "Float64", False),
        ("int16", "Int32", False),
        ("int64", "uint32", True),
        ("int32", "uint32", False),
        ("uint8", "int8", False),
        ("int8", "Boolean", True),
        ("bool", "Int32", False),
        ("string", "Float64", False),
        ("Int32", "int64", False),
        ("Float64", "int32", True),
    ],
)
def test_only_what_loses_no_whole_number_is_carried(target: str, source: str, *, fits: bool) -> None:
    assert carries(target, source) is fits


def _hashes(file: Path) -> list[dict[str, str]]:
    found: list[dict[str, str]] = json.loads(file.read_text())["type_hashes"]
    return found
