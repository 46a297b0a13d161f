"""Row streams: two ends in one process, over a socket pair; what one writes into its rings, the other one finds."""

from __future__ import annotations

import os
import socket
import struct
import time
from collections.abc import Callable, Iterator
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from fmu_mesh.rings import native
from fmu_mesh.rings.host_memory import Counter, HostMemory
from fmu_mesh.rings.native import StreamState
from fmu_mesh.rings.ring import Ring
from fmu_mesh.rings.row_streams import CounterEnd, RowsEnd, RowStreams, StreamEnd
from fmu_mesh.system.layout import Layout
from fmu_mesh.system.memory_map import map_memory
from fmu_mesh.wire.messages import ALIVE, FRAME, GRANT, HEADER, LAST, PROGRESS

pytestmark = pytest.mark.skipif(native.library is None, reason="there is no library of C")

LAST_POINT = 1_000_000
LINK = 7
SENT = Layout.of([("flag", "Boolean"), ("x", "Float64"), ("n", "Int32"), ("y", "Float64"), ("z", "Float64")])
COLUMNS = ("flag", "n", "x", "z")


class End(NamedTuple):
    """One process: its memory, the ring of the rows, and its stream."""

    memory: HostMemory
    ring: Ring
    counter: Counter
    streams: RowStreams
    socket: socket.socket

    def write(self, first: int, end: int) -> None:
        for row in range(first, end):
            self.ring.put(row, "flag", row % 3 == 0)
            self.ring.put(row, "n", -row)
            self.ring.put(row, "x", row / 3)
            self.ring.put(row, "y", float("nan"))
            self.ring.put(row, "z", row * 1e300)
            self.ring.stamp(row)
        self.counter.raise_to(end)

    def values(self, row: int) -> list[object]:
        assert self.ring.has_row(row)
        return [self.ring.value(row, name) for name in COLUMNS]


def layout_of(names: tuple[str, ...]) -> Layout:
    return Layout(tuple(column for column in SENT.columns if column.name in names))


def ends(rows: int = 64, wide: int = 0) -> tuple[End, End]:
    """The source of the rows, and their target; with ``wide``, a row has an array of so many bytes."""
    sent = SENT if not wide else Layout.of([("wide", "UInt8", (wide,))])
    got = layout_of(COLUMNS) if not wide else sent
    map_, places = map_memory(["source", "target"], {"i": ("source", 1, sent, rows)})
    both = socket.socketpair()
    made = []
    for name, layout, own in zip(("source", "target"), (sent, got), both, strict=True):
        memory = HostMemory.private(map_, name)
        ring, counter = Ring(layout, rows), memory.counter(places["i"].counter)
        here = [RowsEnd(LINK, ring, counter, got, LAST_POINT + 1)]
        progress = [
            CounterEnd(PROGRESS, number, memory.progress[other]) for number, other in enumerate(("source", "target"))
        ]
        told, heard = (progress[0], progress[1]) if name == "source" else (progress[1], progress[0])
        end = StreamEnd(
            "target" if name == "source" else "source",
            own,
            outgoing=here if name == "source" else (),
            incoming=here if name == "target" else (),
            told=[told],
            heard=[heard],
        )
        made.append(End(memory, ring, counter, RowStreams(memory, [end], LAST_POINT), own))
    return made[0], made[1]


@pytest.fixture
def both() -> Iterator[tuple[End, End]]:
    source, target = ends()
    yield source, target
    for end in (source, target):
        end.streams.close(0.0)


def turn(*every: End, until: Callable[[], bool], limit_s: float = 10.0) -> None:
    deadline = time.monotonic() + limit_s
    while not until():
        assert time.monotonic() < deadline
        for end in every:
            end.streams.serve(0.001)


def state_of(end: End) -> StreamState:
    [(_, state, *_)] = end.streams.states()
    return state


def test_rows_arrive_with_their_columns_and_bits(both: tuple[End, End]) -> None:
    source, target = both

    source.write(0, 40)
    turn(*both, until=lambda: target.counter.value == 40)
    source.write(40, 100)
    turn(*both, until=lambda: target.counter.value == 100)

    assert [target.values(row) for row in range(60, 100)] == [source.values(row) for row in range(60, 100)]


def test_counters_go_both_ways_and_only_grow(both: tuple[End, End]) -> None:
    source, target = both

    source.memory.progress["source"].raise_to(5)
    target.memory.progress["target"].raise_to(3)
    turn(
        *both, until=lambda: target.memory.progress["source"].value == 5 and source.memory.progress["target"].value == 3
    )
    target.socket.send(HEADER.pack(PROGRESS, 1, 0, 2))
    target.memory.progress["target"].raise_to(9)

    turn(*both, until=lambda: source.memory.progress["target"].value == 9)


def ends_with_large_rows(size: int) -> tuple[End, End, NDArray[np.uint8]]:
    """Two ends; the source has four rows of so many bytes, all with these values."""
    source, target = ends(rows=8, wide=size)
    values = np.frombuffer(os.urandom(size), np.uint8)
    for row in range(4):
        source.ring.put(row, "wide", values)
        source.ring.stamp(row)
    source.counter.raise_to(4)
    return source, target, values


def test_rows_larger_than_the_kernel_takes_are_sent_while_nobody_looks() -> None:
    source, target, values = ends_with_large_rows(8_000_000)

    source.streams.serve(0.0)
    turn(target, until=lambda: target.counter.value == 4)

    assert all((target.ring.array("wide")[row] == values).all() for row in range(4))
    source.streams.close(0.0)
    target.streams.close(0.0)


def test_the_last_rows_come_before_that_no_more_come(both: tuple[End, End]) -> None:
    source, target = both
    source.write(0, 30)

    source.streams.say_last(LINK)
    turn(target, until=lambda: [*target.streams.ended_links()] == [LINK])

    assert target.counter.value == 30
    assert [*target.streams.ended_links()] == []


def test_a_closed_end_has_sent_everything_and_the_other_one_knows() -> None:
    source, target = ends()
    source.write(0, 50)

    source.streams.close(0.1)
    turn(target, until=lambda: state_of(target) == StreamState.CUT if target.counter.value == 50 else False)

    target.streams.close(0.0)


@given(cuts=st.lists(st.tuples(st.integers(1, 9), st.integers(0, 2000)), min_size=1, max_size=8))
@settings(max_examples=60, deadline=None)
def test_after_each_cut_rows_go_on_where_the_reader_is(cuts: list[tuple[int, int]]) -> None:
    """The window is 16 rows: the writer keeps what the reader lacks. A cut may be at any byte."""
    source, target = ends(rows=64)
    written = 0
    for count, taken in cuts:
        source.write(written, written := written + count)
        source.streams.serve(0.0)
        pair = socket.socketpair()
        rest = target.socket.recv(taken, socket.MSG_DONTWAIT | socket.MSG_PEEK) if taken else b""
        pair[0].send(rest)
        target.streams.resume("source", pair[1], {})
        target.streams.serve(0.0)  # it gets this much of what was sent
        here, there = socket.socketpair()
        received = target.streams.received("source")
        source.streams.resume("target", here, received)
        target.streams.resume("source", there, {})
        pair[0].close()
        source = source._replace(socket=here)
        target = target._replace(socket=there)

        turn(source, target, until=lambda: target.counter.value == written)  # noqa: B023  used here

    assert [target.values(row) for row in range(max(0, written - 64), written)] == [
        source.values(row) for row in range(max(0, written - 64), written)
    ]
    source.streams.close(0.0)
    target.streams.close(0.0)


def test_rows_that_came_by_the_old_connection_meanwhile_need_not_come_again() -> None:
    """The reader says how many rows it has; until the writer hears that, the old connection may heal for a moment."""
    source, target = ends(rows=16)
    source.write(0, 5)
    turn(source, target, until=lambda: target.counter.value == 5)
    received = target.streams.received("source")
    for first in range(5, 45, 10):
        source.write(first, first + 10)
        turn(source, target, until=lambda: target.counter.value == first + 10)  # noqa: B023  used here
    here, there = socket.socketpair()

    source.streams.resume("target", here, received)
    target.streams.resume("source", there, {})
    source.write(45, 55)

    turn(source, target, until=lambda: target.counter.value == 55)
    assert [*source.streams.states(), *target.streams.states()] == []
    assert [target.values(row) for row in range(39, 55)] == [source.values(row) for row in range(39, 55)]
    source.streams.close(0.0)
    target.streams.close(0.0)


@pytest.mark.parametrize("received", [-5, 6, 2**40])
def test_a_wrong_number_of_rows_gets_those_in_the_ring(both: tuple[End, End], received: int) -> None:
    source, target = both
    source.write(0, 5)
    here, there = socket.socketpair()

    source.streams.resume("target", here, {LINK: received})
    target.streams.resume("source", there, {})

    turn(*both, until=lambda: target.counter.value == 5 or [*target.streams.states()] != [])
    assert [*source.streams.states()] == []


def test_a_cut_at_each_byte_loses_no_row_counter_or_end() -> None:
    """The bytes of some rows, a counter and the end of a link; the reader gets so many of them, and no more."""
    length, cut = 1, 0
    while cut < length:
        source, target = ends(rows=16)
        source.write(0, 5)
        source.memory.progress["source"].raise_to(3)
        source.streams.say_last(LINK)
        data = target.socket.recv(100_000)
        assert data.count(HEADER.pack(LAST, LINK, 0, 5)) == 1
        length = len(data)
        torn, reader = socket.socketpair()
        torn.sendall(data[:cut])
        torn.close()
        target.streams.resume("source", reader, {})
        turn(target, until=lambda: [state for _, state, *_ in target.streams.states()] == [StreamState.CUT])  # noqa: B023  used here
        here, there = socket.socketpair()

        source.streams.resume("target", here, target.streams.received("source"))
        target.streams.resume("source", there, {})

        turn(source, target, until=lambda: [*target.streams.ended_links()] == [LINK])  # noqa: B023  used here
        turn(source, target, until=lambda: target.memory.progress["source"].value == 3)  # noqa: B023  used here
        assert [target.values(row) for row in range(5)] == [source.values(row) for row in range(5)]
        assert [*target.streams.states()] == []
        for end in (source, target):
            end.streams.close(0.0)
        cut += 1


@given(order=st.permutations(range(5)), sizes=st.lists(st.integers(1, 8), min_size=5, max_size=5))
@settings(max_examples=60, deadline=None)
def test_frames_in_another_order_are_refused_and_no_row_is_wrong(order: list[int], sizes: list[int]) -> None:
    source, target = ends()
    firsts = [sum(sizes[:number]) for number in range(6)]

    source.socket.send(b"".join(frame(firsts[number], sizes[number]) for number in order))
    target.streams.serve(0.0)

    in_order = next((place for place, number in enumerate(order) if place != number), 5)
    assert target.counter.value == firsts[in_order]
    assert [target.values(row) for row in range(firsts[in_order])] == [
        [True, -row, row / 3, row * 1e300] for row in range(firsts[in_order])
    ]
    assert [state for _, state, *_ in target.streams.states()] == ([] if in_order == 5 else [StreamState.GAP])
    source.streams.close(0.0)
    target.streams.close(0.0)


@given(place=st.integers(0, 10_000), value=st.integers(0, 255))
@settings(max_examples=200, deadline=None)
def test_a_forged_byte_changes_nothing_that_came_before_it(place: int, value: int) -> None:
    """What comes after it may be other rows or other counters, of this run, or is refused."""
    source, target = ends()
    frames = [frame(row, 1) for row in range(8)]
    data = bytearray(b"".join(frames) + HEADER.pack(PROGRESS, 0, 0, 3) + HEADER.pack(LAST, LINK, 0, 0))
    place %= len(data)
    data[place] = value

    source.socket.send(bytes(data))
    target.streams.serve(0.0)

    right = min(place // len(frames[0]), 8)
    assert right <= target.counter.value <= LAST_POINT + 1
    assert [target.values(row) for row in range(right)] == [[True, -row, row / 3, row * 1e300] for row in range(right)]
    assert 0 <= target.memory.progress["source"].value <= LAST_POINT + 1
    assert {state for _, state, *_ in target.streams.states()} <= {
        StreamState.REFUSED,
        StreamState.GAP,
        StreamState.TWICE,
    }
    source.streams.close(0.0)
    target.streams.close(0.0)


@pytest.mark.parametrize("reads", [0, 1, 2, 8, 20])
def test_a_cut_while_a_thread_sends_large_rows_costs_no_byte(reads: int) -> None:
    """The kernel takes a tenth of a row at once, so each read ends within one."""
    source, target, values = ends_with_large_rows(2_000_000)
    source.streams.serve(0.0)
    for _ in range(reads):
        target.streams.serve(0.0)
    here, there = socket.socketpair()

    source.streams.resume("target", here, target.streams.received("source"))
    target.streams.resume("source", there, {})

    turn(source, target, until=lambda: target.counter.value == 4)
    assert all((target.ring.array("wide")[row] == values).all() for row in range(4))
    source.streams.close(0.0)
    target.streams.close(0.0)


def test_a_peer_that_reads_nothing_does_not_hold_the_end_up() -> None:
    source, target = ends(rows=8, wide=8_000_000)
    source.ring.put(0, "wide", np.zeros(8_000_000, np.uint8))
    source.ring.stamp(0)
    source.counter.raise_to(1)
    source.streams.serve(0.0)
    begun = time.monotonic()

    source.streams.close(0.3)

    assert 0.3 <= time.monotonic() - begun < 5.0
    target.streams.close(0.0)


def test_a_silent_peer_is_noticed_and_unread_bytes_are_life(both: tuple[End, End]) -> None:
    source, target = both
    assert target.streams.silent_s("source") < 0.5

    end = time.monotonic() + 0.6
    turn(target, until=lambda: time.monotonic() > end)
    assert target.streams.silent_s("source") > 0.5
    source.streams.beat()

    assert target.streams.silent_s("source") == 0.0
    turn(target, until=lambda: 0.0 < target.streams.silent_s("source") < 0.5)


ROW = struct.Struct("<ddi?")


def frame(first: int, count: int, *, flag: int = 1, shift: float = 0.0) -> bytes:
    rows = (ROW.pack(row / 3 + shift, row * 1e300, -row, flag == 1) for row in range(first, first + count))
    return HEADER.pack(FRAME, LINK, count, first) + b"".join(row[:-1] + bytes([flag]) for row in rows)


FORGED = {
    "a gap": (frame(3, 1), StreamState.GAP),
    "a Boolean of 2": (frame(0, 1, flag=2), StreamState.REFUSED),
    "no rows": (HEADER.pack(FRAME, LINK, 0, 0), StreamState.REFUSED),
    "too many rows": (HEADER.pack(FRAME, LINK, 2**32 - 1, 0), StreamState.REFUSED),
    "a negative row": (HEADER.pack(FRAME, LINK, 1, -1), StreamState.REFUSED),
    "another link": (HEADER.pack(FRAME, LINK + 1, 1, 0), StreamState.REFUSED),
    "another kind": (HEADER.pack(77, LINK, 1, 0), StreamState.REFUSED),
    "a grant that nobody expects": (HEADER.pack(GRANT, 0, 0, 5), StreamState.REFUSED),
    "progress of another node": (HEADER.pack(PROGRESS, 5, 0, 5), StreamState.REFUSED),
    "progress beyond the run": (HEADER.pack(PROGRESS, 0, 0, LAST_POINT + 2), StreamState.REFUSED),
    "negative progress": (HEADER.pack(PROGRESS, 0, 0, -5), StreamState.REFUSED),
    "other values": (frame(0, 2) + frame(1, 1, shift=1.0), StreamState.TWICE),
    "the end of a link of another": (HEADER.pack(LAST, LINK + 1, 0, 0), StreamState.REFUSED),
}


@pytest.mark.parametrize("name", FORGED)
def test_what_is_no_part_of_the_run_ends_the_stream(both: tuple[End, End], name: str) -> None:
    source, target = both
    data, state = FORGED[name]
    before = target.counter.value

    source.socket.send(data)
    turn(target, until=lambda: [own[1] for own in target.streams.states()] == [state])

    assert target.counter.value in (before, 2)  # of "other values", the first two are right


@given(cuts=st.lists(st.integers(0, 2000), max_size=30), repeated=st.integers(0, 20))
@settings(max_examples=60, deadline=None)
def test_rows_may_come_in_any_pieces_and_twice(cuts: list[int], repeated: int) -> None:
    source, target = ends()
    data = frame(0, 20) + HEADER.pack(ALIVE, 0, 0, 0) + frame(20 - repeated, 30) + HEADER.pack(PROGRESS, 0, 0, 11)
    places = sorted({0, len(data), *(cut % len(data) for cut in cuts)})

    for first, end in pairwise(places):
        source.socket.send(data[first:end])
        target.streams.serve(0.0)

    assert target.counter.value == 50 - repeated
    assert target.memory.progress["source"].value == 11
    assert [target.values(row)[2] for row in range(50 - repeated)] == [row / 3 for row in range(50 - repeated)]
    source.streams.close(0.0)
    target.streams.close(0.0)


@given(data=st.binary(max_size=400), cut=st.integers(0, 400))
@settings(max_examples=200, deadline=None)
def test_any_bytes_are_refused_or_wait_for_more(data: bytes, cut: int) -> None:
    source, target = ends()

    source.socket.send(data[:cut])
    target.streams.serve(0.0)
    source.socket.send(data[cut:])
    target.streams.serve(0.0)

    states = [state for _, state, _, _ in target.streams.states()]
    assert states in ([], [StreamState.REFUSED], [StreamState.GAP])
    source.streams.close(0.0)
    target.streams.close(0.0)
