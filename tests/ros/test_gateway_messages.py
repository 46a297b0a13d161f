"""Messages of values and values of messages: what belongs to one point, and nothing else, is in one message."""

from __future__ import annotations

import math
import struct
from random import Random
from typing import Any, Literal

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fmu_mesh.ros_wire.assembling import Assembler, Disassembler
from fmu_mesh.ros_wire.cdr import CdrError, Codec
from fmu_mesh.ros_wire.definitions import MessageTypes, Nested
from fmu_mesh.ros_wire.topics import Port, Topic
from fmu_mesh.variables.model_description import Variable, VariableType
from fmu_mesh.variables.value_types import DTYPES

TYPES = MessageTypes("kilted")
TWIST = "geometry_msgs/msg/TwistStamped"
TF = "tf2_msgs/msg/TFMessage"


def port(path: str, *, kind: VariableType = "Float64", steps: int = 1, shape: tuple[int, ...] = ()) -> Port:
    variable = Variable(
        name=path, value_reference=0, type=kind, causality="output", variability="continuous", shape=shape
    )
    return Port(path, "one", variable, "out", steps)


def topic(
    message: str, *ports: Port, direction: Literal["out", "in"] = "out", constants: tuple[tuple[str, str], ...] = ()
) -> Topic:
    return Topic("/t", message, direction, ports, frame_id="base", constants=constants)


def decoded(message: str, data: bytes) -> dict[str, Any]:
    return Codec(TYPES, message).decode(data)


def test_message_of_two_variables_holds_values_of_one_point_whatever_comes_first() -> None:
    assembler = Assembler(topic(TWIST, port("twist.linear.x"), port("twist.angular.z")), TYPES)

    made = [
        message
        for index, point, value in [(0, 0, 1.0), (0, 1, 2.0), (1, 0, -1.0), (0, 2, 3.0), (1, 1, -2.0), (1, 2, -3.0)]
        for message in assembler.add(index, point, point * 0.25, value)
    ]

    messages = [decoded(TWIST, data) for data, _ in made]
    assert [time for _, time in made] == [0.0, 0.25, 0.5]
    assert [(own["twist"]["linear"]["x"], own["twist"]["angular"]["z"]) for own in messages] == [
        (1.0, -1.0),
        (2.0, -2.0),
        (3.0, -3.0),
    ]
    assert messages[1]["header"] == {"stamp": {"sec": 0, "nanosec": 250_000_000}, "frame_id": "base"}


SPECIAL = [1.5, -0.0, math.inf, -math.inf, math.nan, 5e-324]


@pytest.mark.parametrize(
    ("message", "type_", "elements", "packed"),
    [
        ("Float64MultiArray", "Float64", SPECIAL, "6d"),
        ("Float32MultiArray", "Float32", SPECIAL, "6f"),
        ("Int8MultiArray", "Int8", [-128, 127, 0, 1, 2, 3], "6b"),
        ("UInt64MultiArray", "UInt64", [2**64 - 1, 0, 1, 2, 3, 4], "6Q"),
    ],
)
def test_a_block_of_numpy_has_the_bytes_of_its_elements(
    message: str, type_: VariableType, elements: list[Any], packed: str
) -> None:
    array = port("data", kind=type_, shape=(2, 3))
    assembler = Assembler(topic(f"std_msgs/msg/{message}", array), TYPES)

    block = assembler.make([np.array(elements, DTYPES[type_])], 0.0)
    lists = assembler.make([[elements[:3], elements[3:]]], 0.0)

    expected = np.array(elements, DTYPES[type_]).tolist()
    assert block == lists
    assert block.endswith(struct.pack(f"<{packed}", *expected))
    assert [own["size"] for own in decoded(f"std_msgs/msg/{message}", block)["layout"]["dim"]] == [2, 3]


def test_the_value_of_a_slower_instance_holds_until_its_next() -> None:
    assembler = Assembler(topic(TWIST, port("twist.linear.x"), port("twist.angular.z", steps=3)), TYPES)

    made = [
        decoded(TWIST, data)["twist"]
        for index, point in [(0, 0), (0, 1), (1, 0), (0, 2), (0, 3), (1, 3), (0, 4)]
        for data, _ in assembler.add(index, point, float(point), float(point))
    ]

    assert [(own["linear"]["x"], own["angular"]["z"]) for own in made] == [(0, 0), (1, 0), (2, 0), (3, 3), (4, 3)]


def test_a_sample_that_is_lost_costs_its_own_message_only() -> None:
    assembler = Assembler(topic(TWIST, port("twist.linear.x"), port("twist.angular.z")), TYPES)

    made = [
        time
        for index, point in [(0, 0), (1, 0), (0, 1), (0, 2), (1, 2), (0, 3), (1, 3)]
        for _, time in assembler.add(index, point, float(point), 0.0)
    ]

    assert made == [0.0, 2.0, 3.0]


@given(st.integers(1, 4), st.integers(1, 4), st.randoms(use_true_random=False))
def test_any_order_of_arrival_gives_the_same_messages(fast: int, slow: int, random: Random) -> None:
    last = 12
    arrivals = [list(range(0, last + 1, steps)) for steps in (fast, slow)]
    assembler = Assembler(topic(TWIST, port("twist.linear.x", steps=fast), port("twist.angular.z", steps=slow)), TYPES)
    made = []
    while any(arrivals):
        index = random.choice([number for number, waiting in enumerate(arrivals) if waiting])
        point = arrivals[index].pop(0)
        made += [
            (time, own["twist"]["linear"]["x"], own["twist"]["angular"]["z"])
            for data, time in assembler.add(index, point, float(point), float(point))
            for own in [decoded(TWIST, data)]
        ]

    points = sorted({*range(0, last + 1, fast), *range(0, last + 1, slow)})
    assert made == [(point, point // fast * fast, point // slow * slow) for point in points]


def test_what_json_does_not_have_arrives_as_what_it_is() -> None:
    assembler = Assembler(topic("std_msgs/msg/Float64", port("data")), TYPES)

    [(nothing, _)] = assembler.add(0, 0, 0.0, "NaN")
    [(below, _)] = assembler.add(0, 1, 1.0, "-INF")

    assert math.isnan(decoded("std_msgs/msg/Float64", nothing)["data"])
    assert decoded("std_msgs/msg/Float64", below)["data"] == -math.inf


def test_an_array_goes_and_comes_with_its_shape() -> None:
    name = "std_msgs/msg/Float64MultiArray"
    matrix = [[1.0, 2.0, 3.0], [4.0, 5.0, "INF"]]
    own = port("data", shape=(2, 3))

    [(data, _)] = Assembler(topic(name, own), TYPES).add(0, 0, 0.0, matrix)
    values, _ = Disassembler(topic(name, own, direction="in"), TYPES).values(data)

    assert decoded(name, data)["layout"]["dim"] == [
        {"label": "dim0", "size": 2, "stride": 6},
        {"label": "dim1", "size": 3, "stride": 3},
    ]
    assert values == [[[1.0, 2.0, 3.0], [4.0, 5.0, math.inf]]]


def test_single_variables_fill_the_elements_of_an_array() -> None:
    name = "std_msgs/msg/Int16MultiArray"
    ports = (port("data[0]", kind="Int16"), port("data[2]", kind="Int16"))
    assembler = Assembler(topic(name, *ports), TYPES)

    made = [data for index in (0, 1) for data, _ in assembler.add(index, 0, 0.0, index + 7)]

    assert decoded(name, made[0])["data"].tolist() == [7, 0, 8]
    assert Disassembler(topic(name, *ports, direction="in"), TYPES).values(made[0]) == ([7, 8], None)


def test_a_message_without_the_element_that_a_variable_needs_is_refused() -> None:
    name = "std_msgs/msg/Float64MultiArray"
    empty = Codec(TYPES, name).encode(Codec(TYPES, name).empty())

    with pytest.raises(CdrError, match=r"has no 'data\[3\]'"):
        Disassembler(topic(name, port("data[3]"), direction="in"), TYPES).values(empty)
    with pytest.raises(CdrError, match="needs 2 elements"):
        Disassembler(topic(name, port("data", shape=(2,)), direction="in"), TYPES).values(empty)


def test_elements_of_array_of_messages_are_made_up_to_last_mapped() -> None:
    ports = (port("transforms[2].transform.translation.x"), port("transforms[0].transform.rotation.w"))
    constants = (("transforms[2].child_frame_id", "tool"), ("transforms[2].header.frame_id", "arm"))
    assembler = Assembler(topic(TF, *ports, constants=constants), TYPES)

    first, second = (assembler.make([0.5, 0.25], 1.5) for _ in range(2))
    message = decoded(TF, second)

    assert first == second  # nothing of a message grows with the next
    transforms = message["transforms"]
    assert [own["transform"]["translation"]["x"] for own in transforms] == [0.0, 0.0, 0.5]
    assert [own["transform"]["rotation"]["w"] for own in transforms] == [0.25, 0.0, 0.0]
    assert [own["child_frame_id"] for own in transforms] == ["", "", "tool"]
    assert [own["header"]["frame_id"] for own in transforms] == ["base", "base", "arm"]
    assert [own["header"]["stamp"] for own in transforms] == [{"sec": 1, "nanosec": 500_000_000}] * 3


def test_an_element_of_an_array_is_read_or_the_message_is_refused() -> None:
    disassembler = Disassembler(topic(TF, port("transforms[1].transform.rotation.w"), direction="in"), TYPES)
    codec = Codec(TYPES, TF)
    message = codec.empty()
    short = [codec.empty_field(Nested("geometry_msgs/msg/TransformStamped"))]

    for elements in ([], short):
        with pytest.raises(CdrError, match=r"has no 'transforms\[1\]"):
            disassembler.values(codec.encode(message | {"transforms": elements}))
    there = decoded(TF, Assembler(topic(TF, port("transforms[1].transform.rotation.w")), TYPES).make([0.5], 0.0))

    assert disassembler.values(codec.encode(there)) == ([0.5], None)


def test_texts_and_numbers_fill_the_sequences_of_one_message() -> None:
    name = "sensor_msgs/msg/JointState"
    ports = (port("position[1]"), port("effort[0]"), port("name[0]", kind="String"))
    assembler = Assembler(topic(name, *ports, constants=(("name[1]", "wrist"),)), TYPES)

    message = decoded(name, assembler.make(["INF", 2.0, "elbow"], 0.0))

    assert message["name"] == ["elbow", "wrist"]
    assert message["position"].tolist() == [0.0, math.inf]
    assert (message["velocity"].tolist(), message["effort"].tolist()) == ([], [2.0])


def test_the_stamp_of_message_comes_with_its_values_and_zero_is_none() -> None:
    own = topic(TWIST, port("twist.linear.x"), direction="in")
    codec = Codec(TYPES, TWIST)
    message = codec.empty()
    message["twist"]["linear"]["x"] = 0.1

    without = Disassembler(own, TYPES).values(codec.encode(message))
    message["header"]["stamp"] = {"sec": 3, "nanosec": 500_000_000}

    assert without == ([0.1], None)
    assert Disassembler(own, TYPES).values(codec.encode(message)) == ([0.1], 3_500_000_000)
