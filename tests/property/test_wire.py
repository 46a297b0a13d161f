"""What goes over the wire or into a result file comes back bit by bit; nothing that arrives breaks a decoder."""

from __future__ import annotations

import math
import struct
import tempfile
import tracemalloc
from contextlib import closing
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
import zenoh
from hypothesis import example, given
from hypothesis import strategies as st
from numpy.typing import NDArray

from fmu_mesh.errors import ErrorReport, FmuMeshError, FrameGap, MessageRefused
from fmu_mesh.results.csv_file import CsvFile
from fmu_mesh.rings.host_memory import HostMemory
from fmu_mesh.rings.ring import Ring, Rows
from fmu_mesh.system.layout import Layout
from fmu_mesh.system.memory_map import MASTER, map_memory
from fmu_mesh.system.plan import Link
from fmu_mesh.variables.model_description import Value, Variable, VariableType
from fmu_mesh.variables.value_types import DTYPES, INTEGERS, TYPES, is_text, nested
from fmu_mesh.wire.frames import FrameReceiver, decode_rows, encode_frames, encode_rows
from fmu_mesh.wire.keys import Keys, escape, unescape
from fmu_mesh.wire.messages import ABORT, FRAME, HEADER, decode_json, encode_json
from fmu_mesh.wire.values import Stamp, ValueRefused, attachment, decode_value, encode_value

columns = st.tuples(st.sampled_from(TYPES), st.lists(st.integers(1, 3), max_size=2).map(tuple))
layouts = st.lists(columns, min_size=1, max_size=6).map(
    lambda drawn: Layout.of([(f"v{number}", type_, shape) for number, (type_, shape) in enumerate(drawn)])
)
"""Rows of any types and shapes."""
names = st.text(min_size=1, max_size=30)
any_float = st.integers(0, 2**64 - 1).map(lambda bits: struct.unpack("<d", struct.pack("<Q", bits))[0])
"""Every float with the same probability per exponent, signalling NaNs and denormals included."""


def rows_of(layout: Layout, count: int, seed: int) -> Rows:
    """Rows of random bits, and of random text."""
    random = np.random.default_rng(seed)

    def element(type_: VariableType) -> str | bytes:
        data = random.bytes(int(random.integers(0, 9)))
        return data if type_ == "Binary" else data.decode("latin-1")

    rows: list[NDArray[Any]] = []
    for part in layout.parts:
        shape = count, part.width
        if is_text(part.type):
            array = np.empty(shape, dtype=np.object_)
            for place in np.ndindex(shape):
                array[place] = element(part.type)
        elif part.type == "Boolean":
            array = random.integers(0, 2, shape).astype(np.bool_)
        else:
            dtype = np.dtype(DTYPES[part.type])
            array = np.frombuffer(random.bytes(dtype.itemsize * math.prod(shape)), dtype).reshape(shape)
        rows.append(array)
    return tuple(rows)


def all_bits(rows: Rows) -> list[object]:
    """What two rows must have alike to be the same in every bit."""
    return [part.tolist() if part.dtype == np.object_ else part.tobytes() for part in rows]


@given(layouts, st.integers(0, 40), st.integers(0, 2**32), st.integers(0, 2**32 - 1), st.integers(0, 2**62))
def test_rows_come_back_bit_by_bit(layout: Layout, count: int, seed: int, link: int, first: int) -> None:
    rows = rows_of(layout, count, seed)

    message = encode_rows(FRAME, link, first, rows)
    back = decode_rows(message, count, layout.parts)

    assert HEADER.unpack_from(message) == (FRAME, link, count, first)
    assert all_bits(back) == all_bits(rows)
    assert [part.dtype for part in back] == [part.dtype for part in rows]


@given(st.sampled_from(list(INTEGERS)), st.data())
def test_whole_numbers_at_both_ends_of_their_range_come_back(type_: VariableType, data: st.DataObject) -> None:
    whole = INTEGERS[type_]
    ends = data.draw(st.lists(st.sampled_from([whole[0], whole[0] + 1, -1 % whole[-1], whole[-1] - 1, whole[-1]])))
    ring = Ring(Layout.of([("v", type_, (len(ends) + 1,))]), 1)
    ring.put(0, "v", [*ends, whole[-1]])

    back = Ring(ring.layout, 1)
    back.parts[0][:] = decode_rows(encode_rows(FRAME, 0, 0, ring.parts), 1, ring.layout.parts)[0]

    assert back.value(0, "v") == [*ends, whole[-1]]


@given(st.binary(max_size=400), st.integers(0, 2**32 - 1), layouts)
@example(bytes(HEADER.size), 0, Layout.of([("r", "Float64")]))
@example(bytes(HEADER.size), 2**32 - 1, Layout.of([("r", "Float64"), ("i", "Int32")]))
@example(bytes(HEADER.size) + b"\xff" * 8, 1, Layout.of([("s", "String"), ("b", "Binary")]))
@example(bytes(HEADER.size) + b"\x01\0\0\0\xff", 1, Layout.of([("s", "String")]))
@example(bytes(HEADER.size) + b"\x02", 1, Layout.of([("b", "Boolean")]))
def test_bytes_that_are_no_rows_are_refused(data: bytes, count: int, layout: Layout) -> None:
    try:
        rows = decode_rows(data, count, layout.parts)
    except MessageRefused:
        return
    assert encode_rows(FRAME, 0, 0, rows)[HEADER.size :] == data[HEADER.size :]


@given(layouts, st.integers(1, 5), st.integers(0, 2**32), st.data())
def test_a_frame_that_is_cut_off_or_too_long_is_refused(
    layout: Layout, count: int, seed: int, data: st.DataObject
) -> None:
    message = encode_rows(FRAME, 0, 0, rows_of(layout, count, seed))
    cut = data.draw(st.integers(HEADER.size, len(message) - 1))

    for wrong in (message[:cut], message + b"\0"):
        with pytest.raises(MessageRefused, match=f"a frame of {count} points has {len(wrong)} bytes where"):
            decode_rows(wrong, count, layout.parts)


def test_rows_too_large_for_one_message_go_in_several(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("fmu_mesh.wire.frames.MAX_MESSAGE_SIZE", 100)
    layout = Layout.of([("b", "Binary"), ("n", "UInt8")])
    rows = (np.arange(7, dtype=np.uint8)[:, None], np.array([[b"x" * 30]] * 7, dtype=np.object_))

    messages = list(encode_frames(FRAME, 3, 10, rows))

    heads = [HEADER.unpack_from(message) for message in messages]
    assert [first for _, _, _, first in heads] == [10, 11, 13, 15]
    back = [decode_rows(message, head[2], layout.parts) for message, head in zip(messages, heads, strict=True)]
    assert all_bits(tuple(np.concatenate(parts) for parts in zip(*back, strict=True))) == all_bits(rows)
    with pytest.raises(FmuMeshError, match="the values of one point take 129 bytes; the limit is 100"):
        list(encode_frames(FRAME, 3, 0, (rows[0][:1], np.array([[b"x" * 100]], dtype=np.object_))))


def test_a_header_that_promises_more_than_there_is_costs_no_memory() -> None:
    layout = Layout.of([("r", "Float64", (1000,)), ("s", "String")])
    data = HEADER.pack(FRAME, 0, 2**32 - 1, 0)
    tracemalloc.start()
    try:
        with pytest.raises(MessageRefused, match="4294967295 points has 24 bytes"):
            decode_rows(data, 2**32 - 1, layout.parts)
        assert tracemalloc.get_traced_memory()[1] < 1_000_000
    finally:
        tracemalloc.stop()


texts = st.none() | st.text(max_size=20)


@given(
    st.builds(
        ErrorReport,
        kind=st.text(),
        message=st.text(),
        exit_code=st.integers(0, 255),
        instance=texts,
        variable=texts,
        point=st.none() | st.integers(0, 2**53),
        time=st.none() | st.floats(allow_nan=False, allow_infinity=False),
        hint=texts,
    )
)
def test_an_error_report_comes_back(report: ErrorReport) -> None:
    assert decode_json(encode_json(ABORT, report)[HEADER.size :], ErrorReport) == report


deep = st.integers(1, 3_000).flatmap(lambda depth: st.sampled_from([b"[" * depth, b'{"a":' * depth]))
wild = st.binary(max_size=300) | deep | st.text(max_size=100).map(lambda text: b'"' + text.encode() + b'"')


@given(wild)
@example(b'{"kind":"x","message":"y","exit_code":1,"hint":' + b"[" * 3_000)
@example(b'{"kind":"x","message":"y","exit_code":1' + b"0" * 5000 + b"}")
@example(b'{"kind":"x","message":"\xff","exit_code":1}')
def test_bytes_that_are_no_report_are_refused(data: bytes) -> None:
    with pytest.raises(MessageRefused):
        decode_json(data, ErrorReport)


def test_json_that_is_too_large_is_refused_with_the_limit() -> None:
    with pytest.raises(MessageRefused, match="it has 5 bytes; the limit is 4"):
        decode_json(b"[1,2]", list[int], 4)


@given(wild)
@example(b"")
@example(b"[" * 3_000)
@example(b'{"point":' + b"[" * 3_000)
@example(b'{"point":1' + b"0" * 5000 + b',"time":0.0}')
def test_bytes_that_are_no_stamp_are_refused(data: bytes) -> None:
    with pytest.raises(MessageRefused):
        decode_json(data, Stamp)


@given(st.integers(0, 2**53), st.floats(allow_nan=False, allow_infinity=False))
def test_a_stamp_comes_back(point: int, time: float) -> None:
    stamp = decode_json(attachment(point, time), Stamp)

    assert (stamp.point, bits(stamp.time)) == (point, bits(time))


def variable(kind: VariableType) -> Variable:
    return Variable("v", 0, kind, "input", "discrete", items=(("low", 1), ("high", 2)) if kind == "Enumeration" else ())


kinds = st.sampled_from(TYPES)


@given(wild | st.integers().map(lambda number: str(number).encode()), kinds)
@example(b"[" * 3_000, "Float64")
@example(b'{"a":' * 3_000, "String")
@example(b"1" + b"0" * 400, "Float64")
@example(b"-1" + b"0" * 400, "Float64")
@example(b"1" + b"0" * 5000, "Float64")
@example(b"1" + b"0" * 5000, "Int32")
@example(b"1e999", "Float64")
@example(b"1" * 2_000_000, "Float64")
@example(b'"\xff"', "String")
@example(b'"\\ud800"', "String")
def test_bytes_that_are_no_value_are_refused_with_a_reason(data: bytes, kind: VariableType) -> None:
    try:
        value = decode_value(data, variable(kind))
    except ValueRefused:
        return
    expected = {"Float64": float, "Float32": float, "Boolean": bool, "String": str, "Binary": bytes}.get(kind, int)
    assert type(value) is expected


@given(any_float)
def test_a_real_comes_back(value: float) -> None:
    back = decode_value(encode_value(value), variable("Float64"))

    assert bits(back) == bits(value) or (math.isnan(value) and isinstance(back, float) and math.isnan(back))


@given(
    st.sampled_from([type_ for type_ in TYPES if type_ not in ("Float64", "Enumeration")]).flatmap(
        lambda kind: st.tuples(st.just(kind), values_of(kind))
    )
)
def test_every_other_value_comes_back(typed: tuple[VariableType, Value]) -> None:
    kind, value = typed

    assert decode_value(encode_value(value), variable(kind)) == value


def values_of(kind: VariableType) -> st.SearchStrategy[Value]:
    match kind:
        case "Float32":
            return st.floats(allow_nan=False, width=32)
        case "Boolean":
            return st.booleans()
        case "String":
            return st.text(st.characters(exclude_categories=["Cs"], exclude_characters="\0"))
        case "Binary":
            return st.binary()
        case _:
            return st.integers(INTEGERS[kind][0], INTEGERS[kind][-1])


@given(
    st.lists(st.integers(1, 3), min_size=1, max_size=3).flatmap(
        lambda shape: st.tuples(st.just(tuple(shape)), st.lists(any_float, min_size=27, max_size=27))
    )
)
def test_an_array_comes_back_with_its_shape(drawn: tuple[tuple[int, ...], list[float]]) -> None:
    shape, elements = drawn
    value = nested(elements[: math.prod(shape)], shape)
    array = msgspec.structs.replace(variable("Float64"), shape=shape)

    back = decode_value(encode_value(value), array)

    assert repr(back) == repr(value)


# ---- keys


@given(names)
def test_every_variable_name_is_one_chunk_of_a_key_and_comes_back(name: str) -> None:
    chunk = escape(name)
    key = zenoh.KeyExpr(f"fmu_mesh/mesh/instance/out/{chunk}")

    assert unescape(chunk) == name
    assert "/" not in chunk
    assert str(key).rsplit("/", 1)[1] == chunk


@given(names, names)
def test_different_variables_have_keys_that_do_not_meet(first: str, second: str) -> None:
    keys = Keys("fmu_mesh", "mesh")

    one, other = (zenoh.KeyExpr(keys.variable("instance", "out", name)) for name in (first, second))

    assert one.intersects(other) == (first == second)
    assert one.intersects(zenoh.KeyExpr("fmu_mesh/mesh/instance/out/*"))
    assert one.intersects(zenoh.KeyExpr("fmu_mesh/mesh/**"))


@given(st.from_regex(r"\A[A-Za-z_][A-Za-z0-9_-]*\Z"))
def test_no_key_that_others_look_at_meets_the_internal_ones(name: str) -> None:
    keys = Keys("fmu_mesh", "mesh").run("0123456789abcdef")
    inbox = zenoh.KeyExpr(keys.inbox(name))

    assert inbox.intersects(zenoh.KeyExpr(keys.frames("source", name)))
    assert any(inbox.intersects(zenoh.KeyExpr(key)) for key in keys.grants(["first", name, "last"]).values())
    assert not inbox.intersects(zenoh.KeyExpr(keys.frames("source", f"{name}x")))
    assert not inbox.intersects(zenoh.KeyExpr(Keys("fmu_mesh", "mesh").variable(name, "out", "y")))
    assert not zenoh.KeyExpr("**").intersects(zenoh.KeyExpr(keys.frames("source", name)))


# ---- frames: nothing missing, nothing twice


def link_of(layout: Layout, step_points: int = 1) -> Link:
    return Link(0, "source", "source", "target", step_points, layout, (-1,) * len(layout.names))


def mirrored(layout: Layout, step_points: int = 1) -> tuple[FrameReceiver, Ring]:
    """A receiver, and the mirror of 16 rows that it fills."""
    map_, places = map_memory(["target", MASTER], {"source": ("source", step_points, layout, 16)})
    memory, place = HostMemory.private(map_, "target"), places["source"]
    mirror = memory.ring(place)
    return FrameReceiver(link_of(layout, step_points), mirror, memory.counter(place.counter)), mirror


@given(layouts, st.lists(st.tuples(st.integers(0, 20), st.integers(1, 16)), max_size=20), st.integers(0, 2**32))
def test_frames_that_overlap_give_every_row_once(layout: Layout, pieces: list[tuple[int, int]], seed: int) -> None:
    """Each frame starts some rows before the end of what was sent, and is up to 16 rows long."""
    rows = rows_of(layout, 400, seed)
    receiver, mirror = mirrored(layout)
    sent = 0

    for back, count in pieces:
        first = max(0, sent - back)
        frame = tuple(part[first : first + count] for part in rows)
        receiver.take(first, count, encode_rows(FRAME, 0, first, frame))
        new = np.arange(sent, max(sent, first + count))
        sent = max(sent, first + count)
        assert receiver.received == sent
        assert (mirror.stamps[new & mirror.mask] == new + 1).all()
        kept = tuple(part[new & mirror.mask] for part in mirror.parts)
        assert all_bits(kept) == all_bits(tuple(part[new] for part in rows))


@given(layouts, st.integers(0, 16), st.integers(1, 1000), st.integers(1, 4))
def test_a_gap_is_an_error_that_names_both_ends(layout: Layout, before: int, missing: int, step_points: int) -> None:
    receiver, _ = mirrored(layout, step_points)
    receiver.take(0, before, encode_rows(FRAME, 0, 0, rows_of(layout, before, 1)))

    with pytest.raises(FrameGap) as caught:
        receiver.take(before + missing, 1, encode_rows(FRAME, 0, before + missing, rows_of(layout, 1, 1)))

    assert (caught.value.instance, caught.value.point) == ("source", before * step_points)
    last = (before + missing) * step_points - 1
    assert f"points {before * step_points} to {last} of 'source' never reached node 'target'" in str(caught.value)


numbers = layouts.filter(lambda layout: not any(is_text(c.type) or c.type == "Boolean" for c in layout.columns))


@given(numbers, st.integers(0, 9), st.integers(0, 7), st.data())
def test_a_row_that_comes_twice_with_one_other_bit_is_an_error(
    layout: Layout, row: int, bit: int, data: st.DataObject
) -> None:
    message = encode_rows(FRAME, 0, 0, rows_of(layout, 10, 3))
    receiver, mirror = mirrored(layout)
    receiver.take(0, 10, message)
    receiver.take(0, 10, message)
    before = all_bits(mirror.parts)
    changed = bytearray(message)
    size = layout.parts[0].width * np.dtype(DTYPES[layout.parts[0].type]).itemsize
    changed[HEADER.size + row * size + data.draw(st.integers(0, size - 1))] ^= 1 << bit

    with pytest.raises(FrameGap, match="came twice and differ") as caught:
        receiver.take(0, 10, bytes(changed))

    assert (caught.value.instance, caught.value.point) == ("source", row)
    assert all_bits(mirror.parts) == before


@given(st.lists(st.text(st.characters(exclude_categories=["Cs"])), min_size=2, max_size=2, unique=True))
def test_text_that_comes_twice_and_differs_is_an_error(texts: list[str]) -> None:
    layout = Layout.of([("s", "String")])
    receiver, _ = mirrored(layout)
    first, other = (encode_rows(FRAME, 0, 0, (np.array([[text]], dtype=np.object_),)) for text in texts)
    receiver.take(0, 1, first)
    receiver.take(0, 1, first)
    assert receiver.received == 1

    with pytest.raises(FrameGap, match="came twice and differ"):
        receiver.take(0, 1, other)


@given(st.binary(max_size=200), st.integers(-(2**63), 2**63 - 1), st.integers(0, 2**32 - 1), st.integers(0, 20))
@example(bytes(16 + 8 * 17), 0, 17, 0)
@example(bytes(16 + 8 * 40), 0, 40, 0)
def test_no_frame_breaks_a_receiver(data: bytes, first: int, count: int, before: int) -> None:
    layout = Layout.of([("r", "Float64")])
    receiver, _ = mirrored(layout)
    for step in range(before):
        receiver.take(step, 1, encode_rows(FRAME, 0, step, rows_of(layout, 1, step)))

    try:
        receiver.take(first, count, data)
    except FmuMeshError:
        assert receiver.received == before
    else:
        assert receiver.received == max(before, first + count)


# ---- the result file


recorded_rows = st.tuples(any_float, any_float, st.integers(-(2**31), 2**31 - 1), st.booleans())


@given(st.lists(recorded_rows, min_size=1, max_size=30))  # a file is there from its first row on
@example([(-0.0, 5e-324, 0, True), (math.nan, math.inf, 1, False), (0.0, -math.inf, -1, True)])
@example([(1.7976931348623157e308, 2.2250738585072014e-308, 0, True), (0.1, 1e23, 1, False)])
def test_floats_of_a_result_file_read_back_to_the_same_bits(rows: list[tuple[float, float, int, bool]]) -> None:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "result.csv"
        with closing(CsvFile(path, [("a", "Float64"), ("n", "Int32"), ("b", "Boolean")])) as file:
            times, reals = (np.array([row[place] for row in rows], dtype=np.float64) for place in (0, 1))
            integers = np.array([row[2] for row in rows], dtype=np.int32)
            booleans = np.array([row[3] for row in rows], dtype=np.bool_)
            file.write(times, [reals, integers, booleans])
        header, *lines = path.read_text().splitlines()

    assert header == "time,a,n,b"
    assert len(lines) == len(rows)
    for line, (time, real, integer, boolean) in zip(lines, rows, strict=True):
        cells = line.split(",")
        for cell, value in zip(cells[:2], (time, real), strict=True):
            assert bits(float(cell)) == bits(value) or (math.isnan(float(cell)) and math.isnan(value))
        assert cells[2:] == [str(integer), "true" if boolean else "false"]


def bits(value: Value) -> bytes:
    assert isinstance(value, float)
    return struct.pack("<d", value)
