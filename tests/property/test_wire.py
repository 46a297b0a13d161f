"""What goes over the wire or into a result file comes back bit by bit; nothing that arrives breaks a decoder."""

from __future__ import annotations

import math
import struct
import tempfile
import tracemalloc
from pathlib import Path

import msgspec
import numpy as np
import pytest
import zenoh
from hypothesis import example, given
from hypothesis import strategies as st
from numpy.typing import NDArray

from fmu_mesh.errors import ErrorReport, FmuMeshError, FrameGap
from fmu_mesh.model.description import Value, Variable, VariableType
from fmu_mesh.model.plan import Link
from fmu_mesh.model.ring import Layout
from fmu_mesh.record.csv_file import CsvFile
from fmu_mesh.wire.frames import FrameReceiver
from fmu_mesh.wire.keys import Keys, escape, unescape
from fmu_mesh.wire.messages import FRAME, HEADER, decode_abort, decode_rows, encode_abort, encode_rows
from fmu_mesh.wire.values import ValueRefused, attachment, decode_stamp, decode_value, encode_value

Rows = tuple[NDArray[np.float64], NDArray[np.int32]]

layouts = st.builds(
    lambda reals, integers: Layout(
        tuple(f"r{i}" for i in range(reals)), tuple(f"i{i}" for i in range(integers)), ("Integer",) * integers
    ),
    st.integers(0, 5),
    st.integers(0, 5),
)
names = st.text(min_size=1, max_size=30)
any_float = st.integers(0, 2**64 - 1).map(lambda bits: struct.unpack("<d", struct.pack("<Q", bits))[0])
"""Every float with the same probability per exponent, signalling NaNs and denormals included."""


def rows_of(layout: Layout, count: int, seed: int) -> Rows:
    """Rows of random bits."""
    random = np.random.default_rng(seed)
    reals = np.frombuffer(random.bytes(8 * count * len(layout.reals)), np.float64)
    integers = np.frombuffer(random.bytes(4 * count * len(layout.integers)), np.int32)
    return reals.reshape(count, len(layout.reals)), integers.reshape(count, len(layout.integers))


@given(layouts, st.integers(0, 40), st.integers(0, 2**32), st.integers(0, 2**16 - 1), st.integers(0, 2**62))
def test_rows_come_back_bit_by_bit(layout: Layout, count: int, seed: int, link: int, first: int) -> None:
    reals, integers = rows_of(layout, count, seed)

    message = encode_rows(FRAME, link, first, reals, integers)
    back = decode_rows(message, count, layout)

    assert HEADER.unpack_from(message) == (FRAME, link, count, first)
    assert back[0].tobytes() == reals.tobytes()
    assert back[1].tobytes() == integers.tobytes()


@given(st.binary(max_size=400), st.integers(0, 2**32 - 1), layouts)
@example(b"", 0, Layout())
@example(bytes(16), 0, Layout(("r",)))
@example(bytes(16), 2**32 - 1, Layout())
@example(bytes(16), 2**32 - 1, Layout(("r",), ("i",), ("Integer",)))
def test_bytes_that_are_no_rows_are_refused(data: bytes, count: int, layout: Layout) -> None:
    try:
        reals, integers = decode_rows(data, count, layout)
    except FmuMeshError:
        return
    assert reals.nbytes + integers.nbytes == len(data) - HEADER.size


def test_a_header_that_promises_more_than_there_is_costs_no_memory() -> None:
    layout = Layout(tuple(f"r{i}" for i in range(1000)))
    data = HEADER.pack(FRAME, 0, 2**32 - 1, 0)
    tracemalloc.start()
    try:
        with pytest.raises(FmuMeshError, match="4294967295 points has 16 bytes"):
            decode_rows(data, 2**32 - 1, layout)
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
    assert decode_abort(encode_abort(report)) == report


nested = st.integers(1, 3_000).flatmap(lambda depth: st.sampled_from([b"[" * depth, b'{"a":' * depth]))
wild = st.binary(max_size=300) | nested | st.text(max_size=100).map(lambda text: b'"' + text.encode() + b'"')


@given(wild)
@example(b'{"kind":"x","message":"y","exit_code":1,"hint":' + b"[" * 3_000)
@example(b'{"kind":"x","message":"y","exit_code":1' + b"0" * 5000 + b"}")
@example(b'{"kind":"x","message":"\xff","exit_code":1}')
def test_bytes_that_are_no_report_are_refused(data: bytes) -> None:
    with pytest.raises(msgspec.DecodeError):
        decode_abort(HEADER.pack(6, 0, 0, 0) + data)


@given(wild)
@example(b"")
@example(b"[" * 3_000)
@example(b'{"point":' + b"[" * 3_000)
@example(b'{"point":1' + b"0" * 5000 + b',"time":0.0}')
def test_bytes_that_are_no_stamp_are_refused(data: bytes) -> None:
    with pytest.raises(msgspec.DecodeError):
        decode_stamp(data)


@given(st.integers(0, 2**53), st.floats(allow_nan=False, allow_infinity=False))
def test_a_stamp_comes_back(point: int, time: float) -> None:
    stamp = decode_stamp(attachment(point, time))

    assert (stamp.point, bits(stamp.time)) == (point, bits(time))


def variable(kind: VariableType) -> Variable:
    return Variable("v", 0, kind, "input", "discrete", items=(("low", 1), ("high", 2)) if kind == "Enumeration" else ())


kinds = st.sampled_from(["Real", "Integer", "Boolean", "String", "Enumeration"])


@given(wild | st.integers().map(lambda number: str(number).encode()), kinds)
@example(b"[" * 3_000, "Real")
@example(b'{"a":' * 3_000, "String")
@example(b"1" + b"0" * 400, "Real")
@example(b"-1" + b"0" * 400, "Real")
@example(b"1" + b"0" * 5000, "Real")
@example(b"1" + b"0" * 5000, "Integer")
@example(b"1e999", "Real")
@example(b"1" * 2_000_000, "Real")
@example(b'"\xff"', "String")
@example(b'"\\ud800"', "String")
def test_bytes_that_are_no_value_are_refused_with_a_reason(data: bytes, kind: VariableType) -> None:
    try:
        value = decode_value(data, variable(kind))
    except ValueRefused:
        return
    expected = {"Real": float, "Boolean": bool, "String": str}.get(kind, int)
    assert type(value) is expected


@given(any_float)
def test_a_real_comes_back(value: float) -> None:
    back = decode_value(encode_value(value), variable("Real"))

    assert bits(back) == bits(value) or (math.isnan(value) and isinstance(back, float) and math.isnan(back))


@given(
    st.sampled_from(["Integer", "Boolean", "String"]).flatmap(lambda kind: st.tuples(st.just(kind), values_of(kind)))
)
def test_every_other_value_comes_back(typed: tuple[VariableType, Value]) -> None:
    kind, value = typed

    assert decode_value(encode_value(value), variable(kind)) == value


def values_of(kind: str) -> st.SearchStrategy[Value]:
    if kind == "Integer":
        return st.integers(-(2**31), 2**31 - 1)
    return st.booleans() if kind == "Boolean" else st.text()


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
    keys = Keys("fmu_mesh", "mesh")
    inbox = zenoh.KeyExpr(keys.inbox(name))

    assert inbox.intersects(zenoh.KeyExpr(keys.frames("source", name)))
    assert any(inbox.intersects(zenoh.KeyExpr(key)) for key in keys.grants(["first", name, "last"]))
    assert inbox.intersects(zenoh.KeyExpr(keys.wake(name)))
    assert not inbox.intersects(zenoh.KeyExpr(keys.frames("source", f"{name}x")))
    assert not inbox.intersects(zenoh.KeyExpr(keys.variable(name, "out", "y")))
    assert not zenoh.KeyExpr("**").intersects(zenoh.KeyExpr(keys.frames("source", name)))


# ---- frames: nothing missing, nothing twice


def link_of(layout: Layout, step_points: int = 1) -> Link:
    return Link(0, "source", "source", "target", step_points, layout, (-1,) * len(layout.names))


@given(layouts, st.lists(st.tuples(st.integers(0, 20), st.integers(1, 16)), max_size=20), st.integers(0, 2**32))
def test_frames_that_overlap_give_every_row_once(layout: Layout, pieces: list[tuple[int, int]], seed: int) -> None:
    """Each frame starts some rows before the end of what was sent, and is up to 16 rows long."""
    reals, integers = rows_of(layout, 400, seed)
    receiver = FrameReceiver(link_of(layout), "the target", 16)
    sent, taken_reals, taken_integers = 0, [reals[:0]], [integers[:0]]

    for back, count in pieces:
        first = max(0, sent - back)
        part = slice(first, first + count)
        new = receiver.take(first, count, encode_rows(FRAME, 0, first, reals[part], integers[part]))
        assert (new is None) == (first + count <= sent)
        if new is not None:
            start, rows = new
            assert start == sent
            taken_reals.append(rows[0])
            taken_integers.append(rows[1] if layout.integers else integers[:0])
            sent = first + count
        assert receiver.received == sent

    assert np.concatenate(taken_reals).tobytes() == reals[:sent].tobytes()
    assert np.concatenate(taken_integers).tobytes() == integers[:sent].tobytes()


@given(layouts, st.integers(0, 16), st.integers(1, 1000), st.integers(1, 4))
def test_a_gap_is_an_error_that_names_both_ends(layout: Layout, before: int, missing: int, step_points: int) -> None:
    receiver = FrameReceiver(link_of(layout, step_points), "the target", 16)
    receiver.take(0, before, encode_rows(FRAME, 0, 0, *rows_of(layout, before, 1)))

    with pytest.raises(FrameGap) as caught:
        receiver.take(before + missing, 1, encode_rows(FRAME, 0, before + missing, *rows_of(layout, 1, 1)))

    assert (caught.value.instance, caught.value.point) == ("source", before * step_points)
    last = (before + missing) * step_points - 1
    assert f"points {before * step_points} to {last} of 'source' never reached the target" in str(caught.value)


@given(layouts.filter(lambda layout: bool(layout.names)), st.integers(0, 9), st.integers(0, 7), st.data())
def test_a_row_that_comes_twice_with_one_other_bit_is_an_error(
    layout: Layout, row: int, bit: int, data: st.DataObject
) -> None:
    reals, integers = rows_of(layout, 10, 3)
    message = encode_rows(FRAME, 0, 0, reals, integers)
    receiver = FrameReceiver(link_of(layout), "the target", 16)
    receiver.take(0, 10, message)
    assert receiver.take(0, 10, message) is None
    changed = bytearray(message)
    if layout.reals:
        place = HEADER.size + row * 8 * len(layout.reals) + data.draw(st.integers(0, 8 * len(layout.reals) - 1))
    else:
        place = HEADER.size + row * 4 * len(layout.integers) + data.draw(st.integers(0, 4 * len(layout.integers) - 1))
    changed[place] ^= 1 << bit

    with pytest.raises(FrameGap, match="came twice and differ") as caught:
        receiver.take(0, 10, bytes(changed))

    assert (caught.value.instance, caught.value.point) == ("source", row)


@given(st.binary(max_size=200), st.integers(-(2**63), 2**63 - 1), st.integers(0, 2**32 - 1), st.integers(0, 20))
@example(bytes(16 + 8 * 17), 0, 17, 0)
@example(bytes(16 + 8 * 40), 0, 40, 0)
def test_no_frame_breaks_a_receiver(data: bytes, first: int, count: int, before: int) -> None:
    layout = Layout(("r",))
    receiver = FrameReceiver(link_of(layout), "the target", 16)
    for step in range(before):
        receiver.take(step, 1, encode_rows(FRAME, 0, step, *rows_of(layout, 1, step)))

    try:
        new = receiver.take(first, count, data)
    except FmuMeshError:
        assert receiver.received == before
    else:
        assert new is None or receiver.received == first + count >= before


# ---- the result file


@given(st.lists(st.tuples(any_float, any_float, st.integers(-(2**31), 2**31 - 1), st.booleans()), max_size=30))
@example([(-0.0, 5e-324, 0, True), (math.nan, math.inf, 1, False), (0.0, -math.inf, -1, True)])
@example([(1.7976931348623157e308, 2.2250738585072014e-308, 0, True), (0.1, 1e23, 1, False)])
def test_floats_of_a_result_file_read_back_to_the_same_bits(rows: list[tuple[float, float, int, bool]]) -> None:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "result.csv"
        with CsvFile(path, [("a", "Real"), ("n", "Integer"), ("b", "Boolean")]) as file:
            times, reals = (np.array([row[place] for row in rows], dtype=np.float64) for place in (0, 1))
            integers, booleans = (np.array([row[place] for row in rows], dtype=np.int32) for place in (2, 3))
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
