"""Payloads under the keys of connections: what is written comes back, and nothing that comes breaks its reader."""

from __future__ import annotations

import json
import math
import struct
import sys
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from ctypes import c_float
from random import Random
from typing import Any

import pytest
import zenoh
from hypothesis import given, settings
from hypothesis import strategies as st

from fmu_mesh.node.key_payloads import KeyReader, TimedValue, key_writer
from fmu_mesh.system.live_keys import KeyInput, KeyOutput
from fmu_mesh.variables.model_description import Value, Variable, VariableType
from fmu_mesh.variables.value_conversion import ValueRefused, is_finite, to_plain, to_value
from fmu_mesh.variables.value_types import INTEGERS, TYPES, nested
from tests.helpers import examples

ITEMS = (("low", 1), ("high", 9223372036854775807))
MESSAGES = {
    "Float64": "std_msgs/msg/Float64",
    "Float32": "std_msgs/msg/Float32",
    "Int8": "std_msgs/msg/Int8",
    "UInt64": "std_msgs/msg/UInt64",
    "Int64": "std_msgs/msg/Int64",
    "Boolean": "std_msgs/msg/Bool",
    "String": "std_msgs/msg/String",
}
ZENOH_ENCODINGS = (
    "application/json",
    "application/json;charset=utf-8",
    "text/json",
    "text/plain",
    "application/cdr",
    "application/octet-stream",
    "zenoh/bytes",
    "zenoh/string",
    "video/raw",
)
PARTS = 5
EACH = 20_000


def variable(type_: VariableType, shape: tuple[int, ...] = ()) -> Variable:
    return Variable(
        name="u",
        value_reference=1,
        type=type_,
        causality="input",
        variability="continuous" if type_.startswith("Float") else "discrete",
        shape=shape,
        items=ITEMS if type_ == "Enumeration" else (),
    )


@pytest.fixture(scope="module")
def sent() -> Iterator[Callable[..., zenoh.Sample]]:
    """Sends a payload, or deletes the key, and gives what a subscriber in the same process gets."""
    config = zenoh.Config()
    for name, value in (("mode", '"peer"'), ("scouting/multicast/enabled", "false"), ("listen/endpoints", "[]")):
        config.insert_json5(name, value)
    with zenoh.open(config) as session, session.declare_subscriber("plant/u", zenoh.handlers.FifoChannel(1)) as own:

        def send(
            data: bytes | None, encoding: zenoh.Encoding | str = "zenoh/bytes", *, stamped: bool = True
        ) -> zenoh.Sample:
            stamp = session.new_timestamp() if stamped else None
            if data is None:
                session.delete("plant/u", timestamp=stamp)
            else:
                session.put("plant/u", data, encoding=encoding, timestamp=stamp)
            return own.recv()

        yield send


# --- what is written comes back

FLOATS = st.integers(0, 2**64 - 1).map(lambda bits: float(struct.unpack("<d", struct.pack("<Q", bits))[0]))
"""Every float with the same probability per exponent, denormal and infinite ones and NaN included."""

ELEMENTS: Mapping[str, st.SearchStrategy[Any]] = {
    "Float64": FLOATS,
    "Float32": st.floats(width=32).map(lambda number: c_float(number).value),
    "Boolean": st.booleans(),
    "String": st.text(st.characters(exclude_characters="\0", exclude_categories=["Cs"]), max_size=20),
    "Binary": st.binary(max_size=20),
    "Enumeration": st.sampled_from([number for _, number in ITEMS]),
}


def elements(type_: VariableType) -> st.SearchStrategy[Any]:
    if type_ in ELEMENTS:
        return ELEMENTS[type_]
    whole = INTEGERS[type_]
    return st.one_of(st.sampled_from([whole[0], whole[-1]]), st.integers(whole[0], whole[-1]))


def bits(value: Value) -> object:
    """What two values must have alike to be the same in every bit; all NaN are one."""
    if isinstance(value, list):
        return [bits(element) for element in value]
    return "NaN" if value != value else struct.pack("<d", value) if isinstance(value, float) else (type(value), value)  # noqa: PLR0124  NaN alone differs from itself


def assert_comes_back(one: Variable, out: KeyOutput, into: KeyInput, sent: Callable[..., zenoh.Sample]) -> None:
    write, encoding = key_writer(out, one)
    reader = KeyReader(into, one, finite=False)
    size = math.prod(one.shape)

    @settings(max_examples=examples(40))
    @given(st.lists(elements(one.type), min_size=size, max_size=size))
    def comes_back(flat: list[Any]) -> None:
        value = nested(flat, one.shape)
        assert bits(reader.read(sent(write(value, 7, 0.07), encoding)).value) == bits(value), one.type

    comes_back()


@pytest.mark.parametrize(
    ("written", "read"),
    [("json", "json"), ("json", "auto"), ("text", "text"), ("text", "auto"), ("float64", "float64"), ("cdr", "cdr")],
)
@pytest.mark.parametrize("shape", [(), (3,), (2, 2)], ids=str)
def test_every_value_that_is_written_comes_back(
    written: Any,  # noqa: ANN401  one of the encodings
    read: Any,  # noqa: ANN401  as the file has it
    shape: tuple[int, ...],
    sent: Callable[..., zenoh.Sample],
) -> None:
    arrays = {"Float64": "std_msgs/msg/Float64MultiArray", "Int64": "std_msgs/msg/Int64MultiArray"}
    for type_ in TYPES:
        message = (arrays if shape else MESSAGES).get(type_) if written == "cdr" else None
        if (written == "float64" and type_ != "Float64") or (written == "cdr" and message is None):
            continue
        out, into = KeyOutput("u", "u", encoding=written, type=message), KeyInput("u", "u", encoding=read, type=message)
        assert_comes_back(variable(type_, shape), out, into, sent)


# --- anything at all


def some_json(random: Random, depth: int = 0) -> object:
    """Any JSON, more often what is nearly right."""
    kind = random.randrange(13 if depth < 3 else 8)
    names = ("value", "t", "a", "b", "name", "")
    texts = ("NaN", "INF", "", "a", "1.5", "true", "\0", "\ud800", "2026-01-01T00:00:00Z", "AP8=", "low", "x" * 999)
    times = ("0001-01-01T00:00:00+23:59", "9999-12-31T23:59:59.999999-23:59")
    numbers = (0, 1, -1, 2**63, 2**64, -(2**63), 10**30, 10**400, -(10**4000), 1e308, 5e-324, 1e39, math.nan, math.inf)
    usual = random.random(), random.randrange(-5, 300), random.randrange(-(2**70), 2**70), random.uniform(-1e300, 1e300)
    match kind:
        case 0 | 1 | 2:
            return random.choice((numbers, (*texts, *times), (True, False, None))[kind])
        case 3 | 4 | 5 | 6 | 7:
            return random.choice(usual)
        case 8 | 9:
            return [some_json(random, depth + 1) for _ in range(random.choice((0, 1, 2, 2, 3, 3, 6)))]
        case _:
            return {random.choice(names): some_json(random, depth + 1) for _ in range(random.randrange(4))}


def some_payload(random: Random) -> bytes:
    """Any bytes, more often what is nearly right."""
    match random.randrange(12):
        case 0 | 1 | 2 | 3 | 4:
            data = bytearray(json.dumps(some_json(random)).encode())
            if random.random() < 0.15:
                data[random.randrange(len(data))] = random.randrange(256)
            return bytes(data[: random.randrange(len(data) + 1)] if random.random() < 0.1 else data)
        case 5 | 6 | 7:
            header = random.choice((b"", b"\0\1\0\0"))
            return header + bytes(random.choice((0, 0, 1, 255, 7)) for _ in range(random.choice((0, 1, 4, 8, 16, 40))))
        case 8:
            return struct.pack("<d", random.choice((math.nan, 1.0, math.inf, -0.0))) * random.choice((1, 1, 6))
        case 9:
            texts = (
                "1.5",
                "on",
                "nan",
                "NaN",
                "Infinity",
                "1e400",
                "0x10",
                "1_000",
                " 3\n",
                "[1,2]",
                "TRUE",
                "1" * 5000,
            )
            return random.choice(texts).encode()
        case 10:
            return b"[" * random.choice((10, 3000)) + b"]" * random.choice((0, 10, 3000))
        case _:
            time = random.choice((0, 1.5, "2026-01-01", "x", None, math.inf, -1e299, 2**70, 10**400))
            value = random.choice((1, 2.5, "low", True, "text", [[1, 2, 3], [4, 5, 6]]))
            return json.dumps({"value": value, "t": time}).encode()


def all_readers() -> Iterator[tuple[KeyReader, Variable, KeyInput]]:
    """Each encoding for each type, with fields, times, factors and maps."""
    ways: tuple[dict[str, Any], ...] = (
        {},
        {"field": "value"},
        {"field": "a[0].b", "time": "t"},
        {"field": "[name=a].value"},
        {"time": "t", "simulated": True},
        {"time": "timestamp"},
        {"factor": 2.5, "offset": 1.0},
        {"map": {"on": 1, "true": 2, "1": 1}},
    )
    ones = [variable(type_) for type_ in TYPES]
    ones += [
        variable("Float64", (2, 3)),
        variable("Int64", (2,)),
        variable("String", (2,)),
        variable("Boolean", (2, 3)),
    ]
    for one in ones:
        for encoding in ("auto", "json", "text", "float64", "cdr"):
            for way in ways:
                own: dict[str, Any] = {"encoding": encoding, **way}
                unfit = ("factor" in way and not one.type.startswith("Float")) or ("map" in way and one.shape)
                if encoding == "float64":
                    unfit = unfit or one.type != "Float64" or "field" in way or way.get("time") == "t"
                if encoding == "cdr":
                    stamped = {"type": "geometry_msgs/msg/PointStamped", "field": "point.x", "time": "header.stamp"}
                    wants_stamp = way.get("time") == "t" and one.type == "Float64" and not one.shape
                    own |= stamped if wants_stamp else {"type": MESSAGES.get(one.type)}
                    unfit = unfit or one.shape or own["type"] is None or ("field" in way and not wants_stamp)
                    unfit = unfit or own.get("time") == "t"
                if not unfit:
                    keyed = KeyInput("u", "plant/u", **own)
                    yield KeyReader(keyed, one, finite=True), one, keyed


def assert_is_a_value(read: TimedValue, one: Variable, own: KeyInput) -> None:
    """What was read is within the type of its variable, finite, and has the time that the key says."""
    plain = to_plain(read.value)
    assert to_value(plain, one, finite=True) == read.value, (own, plain)
    assert is_finite(read.value)
    assert (read.time is not None) == (own.time != "arrival"), (own, plain)
    assert read.time is None or math.isfinite(read.time)


@pytest.mark.parametrize("part", range(PARTS))
def test_any_payload_is_a_value_or_refused(part: int, sent: Callable[..., zenoh.Sample]) -> None:
    random = Random(part)  # noqa: S311 payloads, and no secret
    readers: dict[str, list[tuple[KeyReader, Variable, KeyInput]]] = {}
    for known in all_readers():
        readers.setdefault(known[2].encoding, []).append(known)
    digits = sys.get_int_max_str_digits()
    outcomes: Counter[tuple[str, bool]] = Counter()

    for _ in range(EACH):
        reader, one, own = random.choice(readers[random.choice(list(readers))])
        sys.set_int_max_str_digits(0)  # only for who writes them
        data = some_payload(random) if random.random() < 0.98 else None
        sys.set_int_max_str_digits(digits)
        sample = sent(data, random.choice(ZENOH_ENCODINGS), stamped=random.random() < 0.7)
        try:
            read = reader.read(sample)
        except ValueRefused:
            outcomes[own.encoding, False] += 1
        else:
            assert_is_a_value(read, one, own)
            outcomes[own.encoding, True] += 1

    assert sum(outcomes.values()) == EACH
    assert min(outcomes.values()) > 10, outcomes
    assert len(outcomes) == 10
