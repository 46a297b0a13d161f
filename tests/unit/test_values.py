"""Values as any Zenoh client sees and sends them."""

from __future__ import annotations

import math

import msgspec
import pytest

from fmu_mesh.errors import MessageRefused
from fmu_mesh.variables.model_description import Value, Variable, VariableType
from fmu_mesh.variables.value_conversion import from_plain
from fmu_mesh.wire.messages import decode_json
from fmu_mesh.wire.values import (
    MAX_VALUE_SIZE,
    Stamp,
    ValueRefused,
    attachment,
    decode_value,
    encode_value,
)


def variable(kind: VariableType, low: float | None = None, high: float | None = None) -> Variable:
    items = (("low", 1), ("high", 5)) if kind == "Enumeration" else ()
    return Variable("v", 0, kind, "input", "discrete", minimum=low, maximum=high, items=items)


@pytest.mark.parametrize(
    ("value", "data"),
    [
        (1.5, b"1.5"),
        (-0.0, b"-0.0"),
        (math.nan, b'"NaN"'),
        (math.inf, b'"INF"'),
        (-math.inf, b'"-INF"'),
        (7, b"7"),
        (True, b"true"),
        ('a"b', b'"a\\"b"'),
    ],
)
def test_values_are_json(value: Value, data: bytes) -> None:
    assert encode_value(value) == data


@pytest.mark.parametrize(
    ("kind", "data", "value"),
    [
        ("Float64", b"1.5", 1.5),
        ("Float64", b" 2 ", 2.0),
        ("Float64", b"1e-3", 0.001),
        ("Float64", b'"INF"', math.inf),
        ("Float64", b'"-INF"', -math.inf),
        ("Int32", b"-2147483648", -(2**31)),
        ("Boolean", b"false", False),
        ("String", b'"text"', "text"),
        ("Enumeration", b'"high"', 5),
        ("Enumeration", b"1", 1),
        ("Int8", b"-128", -128),
        ("UInt8", b"255", 255),
        ("Int64", b"-9223372036854775808", -(2**63)),
        ("UInt64", b"18446744073709551615", 2**64 - 1),
        ("Float32", b"0.1", 0.10000000149011612),
        ("Float32", b"3.4028234663852886e38", 3.4028234663852886e38),
        ("Float32", b'"INF"', math.inf),
        ("Binary", b'""', b""),
        ("Binary", b'"/wA="', b"\xff\0"),
    ],
)
def test_values_of_the_right_type_are_taken(kind: VariableType, data: bytes, value: Value) -> None:
    taken = decode_value(data, variable(kind))

    assert (taken, type(taken)) == (value, type(value))


@pytest.mark.parametrize(
    ("kind", "data"),
    [
        ("Float64", b"true"),
        ("Float64", b"null"),
        ("Float64", b'"1.5"'),
        ("Float64", b"[1.5]"),
        ("Float64", b"1e999"),
        ("Float64", b"1" + b"0" * 400),
        ("Float64", b""),
        ("Float64", b"1.5 2"),
        ("Int32", b"1.5"),
        ("Int32", b"2147483648"),
        ("Int32", b"true"),
        ("Boolean", b"1"),
        ("String", b"1"),
        ("String", b'"\xff"'),
        ("Enumeration", b'"middle"'),
        ("Enumeration", b"3"),
        ("Enumeration", b"true"),
        ("Int8", b"128"),
        ("UInt8", b"-1"),
        ("Int64", b"9223372036854775808"),
        ("UInt64", b"18446744073709551616"),
        ("UInt64", b"1.0"),
        ("Float32", b"3.5e38"),
        ("Binary", b'"/wA"'),
        ("Binary", b'"a b"'),
        ("Binary", b"1"),
        ("String", b'"a\\u0000b"'),
    ],
)
def test_values_of_another_type_are_refused_with_a_reason(kind: VariableType, data: bytes) -> None:
    with pytest.raises(ValueRefused, match=r"\w+ \w+"):
        decode_value(data, variable(kind))


def test_a_value_outside_its_range_is_refused_with_the_range() -> None:
    narrow = variable("Float64", low=-1.0, high=1.0)

    assert decode_value(b"-1.0", narrow) == -1.0
    with pytest.raises(ValueRefused, match=r"1\.5 is out of its range; expected a value >= -1 and <= 1"):
        decode_value(b"1.5", narrow)


def test_a_value_that_is_too_long_is_not_even_looked_at() -> None:
    with pytest.raises(ValueRefused, match="too many"):
        decode_value(b" " * (MAX_VALUE_SIZE + 1), variable("Float64"))


def test_a_nested_value_is_refused() -> None:
    with pytest.raises(ValueRefused):
        decode_value(b"[" * 100_000, variable("Float64"))


def test_an_attachment_holds_point_and_time() -> None:
    assert msgspec.json.decode(attachment(812, 1.624)) == {"point": 812, "time": 1.624}
    assert decode_json(attachment(812, 1.624), Stamp) == Stamp(812, 1.624)


@pytest.mark.parametrize("data", [b"", b"{}", b'{"point":"a","time":0.0}', b'{"point":1}', b"\xff", b"[" * 100_000])
def test_another_attachment_is_refused(data: bytes) -> None:
    with pytest.raises(MessageRefused):
        decode_json(data, Stamp)


def test_what_is_not_finite_is_a_float_in_every_version_of_fmi() -> None:
    assert [from_plain("INF", name) for name in ("Float64", "Float32", "Real")] == [math.inf] * 3
    assert from_plain("INF", "String") == "INF"
