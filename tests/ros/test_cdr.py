"""CDR: the same bytes as another implementation writes, and any bytes at all without harm."""

from __future__ import annotations

import math
import tracemalloc
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from fmu_mesh.ros_wire.cdr import MAX_MESSAGE_SIZE, CdrError, Codec
from fmu_mesh.ros_wire.definitions import MAX_ELEMENTS, Array, Basic, FieldType, MessageTypes, Nested, Sequence

CUSTOM = {
    "lab_msgs/msg/Part": "string<=8 name\nint8 small\nfloat32[3] xyz\nbool[] flags\n",
    "lab_msgs/msg/Whole": "bool ok\nPart[] parts\nPart[2] pair\nstring[<=3] words\nint64 last\nuint16[<=4] few\n",
}
TYPES = MessageTypes("kilted", CUSTOM)
MESSAGES = (
    "std_msgs/msg/Bool",
    "std_msgs/msg/Float64",
    "std_msgs/msg/Int8",
    "std_msgs/msg/UInt64",
    "std_msgs/msg/String",
    "std_msgs/msg/Empty",
    "std_msgs/msg/Float64MultiArray",
    "geometry_msgs/msg/TwistStamped",
    "geometry_msgs/msg/PoseWithCovarianceStamped",
    "rosgraph_msgs/msg/Clock",
    "sensor_msgs/msg/JointState",
    "rcl_interfaces/msg/ParameterValue",
    "lab_msgs/msg/Whole",
)
CODECS = {name: Codec(TYPES, name) for name in MESSAGES}

_TEXT = st.text(st.characters(exclude_characters="\0", exclude_categories=["Cs"]), max_size=8)


def _values(kind: FieldType) -> st.SearchStrategy[Any]:
    match kind:
        case Basic(basic):
            return _basic_values(basic)
        case Nested(message):
            return st.fixed_dictionaries({name: _values(own) for name, own in TYPES.fields(message)})
        case Array(element, length):
            return st.lists(_values(element), min_size=length, max_size=length)
        case Sequence(element, bound):
            return st.lists(_values(element), max_size=min(bound or 4, 4))


def _basic_values(kind: str) -> st.SearchStrategy[Any]:
    match kind:
        case "string":
            return _TEXT
        case "bool":
            return st.booleans()
        case "float64" | "float32":
            return st.floats(allow_nan=False, width=64 if kind == "float64" else 32)
    limits = np.iinfo("uint8" if kind in ("byte", "char") else kind)
    return st.integers(int(limits.min), int(limits.max))


def _plain(value: Any) -> Any:  # noqa: ANN401 a value of any message
    if isinstance(value, np.ndarray):
        return value.tolist()
    if isinstance(value, dict):
        return {name: _plain(own) for name, own in value.items()}
    return [_plain(own) for own in value] if isinstance(value, list) else value


@pytest.mark.parametrize("name", MESSAGES)
def test_a_message_comes_back_as_it_was_sent(name: str) -> None:
    codec = CODECS[name]

    @settings(max_examples=30, suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large])
    @given(_values(Nested(name)))
    def comes_back(message: dict[str, Any]) -> None:
        assert _plain(codec.decode(codec.encode(message))) == message

    comes_back()


def test_every_message_of_ros_has_the_bytes_that_rosbags_gives_it() -> None:
    types = MessageTypes("kilted")
    for name in types.store.types:
        data = Codec(types, name).encode(Codec(types, name).empty())

        message = types.store.deserialize_cdr(data, name)

        assert bytes(types.store.serialize_cdr(message, name)) == data, name


def test_message_with_values_has_bytes_that_rosbags_gives_it_in_both_orders() -> None:
    name = "geometry_msgs/msg/TwistStamped"
    message = CODECS[name].empty()
    message["header"] = {"stamp": {"sec": 7, "nanosec": 250_000_000}, "frame_id": "base"}
    message["twist"]["linear"]["x"], message["twist"]["angular"]["z"] = 0.1, -math.pi
    theirs = TYPES.store.deserialize_cdr(CODECS[name].encode(message), name)

    big = bytes(TYPES.store.serialize_cdr(theirs, name, little_endian=False))

    assert bytes(TYPES.store.serialize_cdr(theirs, name)) == CODECS[name].encode(message)
    assert CODECS[name].decode(big) == message


def test_the_bytes_that_fill_a_message_up_mean_nothing() -> None:
    codec = CODECS["std_msgs/msg/Int8"]

    assert codec.decode(bytes.fromhex("00 01 00 03 fe aa bb cc")) == {"data": -2}


@pytest.mark.parametrize(
    ("name", "data", "reason"),
    [
        ("std_msgs/msg/Float64", "", "it does not start as CDR does"),
        ("std_msgs/msg/Float64", "00 07 00 00 00 00 00 00 00 00 00 00", "it does not start as CDR does"),
        ("std_msgs/msg/Float64", "00 01 00 00 00 00", "the message ends in 'data'"),
        ("std_msgs/msg/Int8", "00 01 00 00 01 00 00 00 00", "4 bytes are left behind the message"),
        ("std_msgs/msg/String", "00 01 00 00 ff ff ff ff 61", "the message ends in 'data'"),
        ("std_msgs/msg/String", "00 01 00 00 02 00 00 00 ff 00", "'data' is no UTF-8"),
        (
            "std_msgs/msg/Float64MultiArray",
            "00 01 00 00 ff ff ff ff",
            f"'layout.dim': more than {MAX_ELEMENTS} elements",
        ),
        (
            "std_msgs/msg/Float64MultiArray",
            "00 01 00 00 00 00 00 00 00 00 00 00 ff ff ff 7f",
            "the message ends in 'data'",
        ),
    ],
)
def test_bytes_that_are_no_message_are_refused_with_the_field(name: str, data: str, reason: str) -> None:
    with pytest.raises(CdrError, match=reason.replace("(", r"\(")):
        CODECS[name].decode(bytes.fromhex(data))


@pytest.mark.parametrize(
    ("name", "message", "reason"),
    [
        ("std_msgs/msg/Int8", {"data": 128}, "'data' cannot be 128"),
        ("std_msgs/msg/Int8", {"data": 1.5}, "'data' cannot be 1.5"),
        ("std_msgs/msg/Int8", {}, "is no complete std_msgs/msg/Int8"),
        ("std_msgs/msg/String", {"data": "a\0b"}, "cannot hold a NUL character"),
        ("std_msgs/msg/String", {"data": 3}, "'data' takes text, not 3"),
        ("lab_msgs/msg/Part", {"name": "123456789"}, "'name' takes at most 8 characters"),
    ],
)
def test_a_value_that_does_not_fit_is_refused_with_its_field(name: str, message: dict[str, Any], reason: str) -> None:
    codec = Codec(TYPES, name)
    whole = codec.empty() | message if message else message

    with pytest.raises(CdrError, match=reason):
        codec.encode(whole)


@settings(max_examples=400)
@given(st.sampled_from(MESSAGES), st.sampled_from(["00010000", "00000000"]), st.binary(max_size=300))
def test_any_bytes_are_a_message_or_refused(name: str, start: str, body: bytes) -> None:
    try:
        message = CODECS[name].decode(bytes.fromhex(start) + body)
    except CdrError:
        return
    CODECS[name].encode(message)


def test_a_message_that_promises_millions_of_elements_costs_only_its_bytes() -> None:
    codec = CODECS["lab_msgs/msg/Whole"]
    data = bytes.fromhex("00010000 01000000") + (MAX_ELEMENTS - 1).to_bytes(4, "little") + bytes(64)
    codec.decode(codec.encode(codec.empty()))
    tracemalloc.start()

    with pytest.raises(CdrError, match="ends in"):
        codec.decode(data)

    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 100_000


def test_a_message_beyond_the_limit_is_not_looked_at() -> None:
    with pytest.raises(CdrError, match="are too many for a message"):
        CODECS["std_msgs/msg/String"].decode(bytes(MAX_MESSAGE_SIZE + 1))
