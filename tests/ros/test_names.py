"""Names and stamps in ROS: the rule of `fmi_adapter`, and what it cannot do."""

from __future__ import annotations

import importlib
import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

import fmu_mesh.ros.node
from fmu_mesh.ros_wire.ros_names import absolute, dds_type, name_problems, ros_name, topic_problem
from fmu_mesh.ros_wire.stamp import in_nanoseconds, nanoseconds, to_stamp


@pytest.mark.parametrize(
    ("variable", "name"),
    [("a", "a"), ("der(a,2)", "der_a_2_"), ("_x", "x"), ("body[1].x", "body_1__x"), ("__", ""), ("1st", "1st")],
)
def test_a_variable_gets_the_name_that_fmi_adapter_gives_it(variable: str, name: str) -> None:
    assert ros_name(variable) == name


def test_names_that_ros_cannot_use_are_told_with_their_variables() -> None:
    problems = [str(problem) for problem in name_problems(["a.b", "a_b", "1st", "_", "fine"])]

    assert problems == [
        "the variables 'a.b', 'a_b' all become 'a_b'",
        "the variable '1st' becomes '1st', which starts with a digit",
        "nothing is left of the name of the variable '_'",
    ]


@pytest.mark.parametrize(
    ("topic", "problem"),
    [
        ("/a/b_1", None),
        ("a", None),
        ("/", "nothing"),
        ("/a//b", "an empty part between two slashes"),
        ("/1a", "the part '1a' starts with a digit"),
        ("/a-b", "the part 'a-b' has characters other than letters, digits and underscores"),
    ],
)
def test_a_topic_set_by_hand_has_to_be_a_ros_name(topic: str, problem: str | None) -> None:
    assert topic_problem(topic) == problem


def test_a_relative_topic_is_in_its_namespace() -> None:
    assert [absolute("a"), absolute("a", "/robot"), absolute("/a", "/robot")] == ["/a", "/robot/a", "/a"]


def test_the_type_of_a_message_has_its_name_in_dds() -> None:
    assert dds_type("std_msgs/msg/Float64") == "std_msgs::msg::dds_::Float64_"


@given(st.integers(-(2**31), 2**31 - 1), st.integers(0, 999_999_999))
def test_stamp_becomes_nearest_float_and_comes_back_while_floats_are_that_fine(sec: int, nanosec: int) -> None:
    time = in_nanoseconds(sec, nanosec) / 10**9

    assert abs(nanoseconds(time) - (sec * 10**9 + nanosec)) <= math.ceil(math.ulp(time) / 2 * 1e9)
    if abs(sec) < 2**22:
        assert to_stamp(time) == {"sec": sec, "nanosec": nanosec}


@pytest.mark.parametrize(
    ("old", "name"),
    [
        ("fmu_mesh.ros.node_parameters", "initialize_from_parameters"),
        ("fmu_mesh.ros.node_parameters", "declare_parameters"),
        ("fmu_mesh.ros.names", "ros_name"),
    ],
)
def test_an_old_import_path_works_and_shows_the_new_spelling(old: str, name: str) -> None:
    with pytest.warns(DeprecationWarning, match=f"{old} is deprecated: write `from fmu_mesh.ros.node import {name}`"):
        found = getattr(importlib.import_module(old), name)

    assert found is getattr(fmu_mesh.ros.node, name)
