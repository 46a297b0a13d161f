"""The receiving end of a link."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from fmu_mesh.errors import FmuMeshError, FrameGap, MessageRefused, ProtocolBroken
from fmu_mesh.node.links import OutLink
from fmu_mesh.node.stepping import Runner
from fmu_mesh.rings.host_memory import HostMemory
from fmu_mesh.rings.native import MemberTable
from fmu_mesh.simtime import TimeGrid
from fmu_mesh.system.layout import Layout
from fmu_mesh.system.memory_map import MASTER, map_memory
from fmu_mesh.system.plan import RECORDER, Link
from fmu_mesh.wire.frames import FrameReceiver, encode_rows, initial_values, rows_of
from fmu_mesh.wire.messages import FRAME, HEADER, INITIAL

LAYOUT = Layout.of([("a", "Float64"), ("n", "Int32"), ("b", "Float64")])
LINK = Link(3, "source", "left", "right", 2, LAYOUT, (0, 2, -1))


def frame(first: int, *rows: tuple[float, float, int]) -> tuple[int, int, bytes]:
    """The arguments of `take`: first own step, count, message."""
    reals = np.array([row[:2] for row in rows], dtype=np.float64).reshape(len(rows), 2)
    integers = np.array([row[2:] for row in rows], dtype=np.int32).reshape(len(rows), 1)
    return first, len(rows), encode_rows(FRAME, LINK.index, first, (reals, integers))


class Receiver:
    """A `FrameReceiver` with a mirror of four rows; ``kept`` is the first row that a step still needs."""

    def __init__(self) -> None:
        map_, places = map_memory(["right", MASTER], {"source": ("left", 2, LAYOUT, 4)})
        memory = HostMemory.private(map_, "right")
        self.mirror = memory.ring(places["source"])
        counter = memory.counter(places["source"].counter)
        self.kept = 0
        self._receiver = FrameReceiver(LINK, self.mirror, counter, self._fits)

    def take(self, first: int, count: int, message: bytes) -> list[tuple[float, float, int]]:
        """The rows that are new after a frame."""
        before = self._receiver.received
        self._receiver.take(first, count, message)
        return [self.row(number) for number in range(before, self._receiver.received)]

    def row(self, number: int) -> tuple[float, float, int]:
        assert self.mirror.has_row(number)
        (a, b), [n] = (part[number & self.mirror.mask].tolist() for part in self.mirror.parts)
        return a, b, n

    @property
    def received(self) -> int:
        return self._receiver.received

    def _fits(self, end: int) -> bool:
        return end - self.kept <= self.mirror.rows


@pytest.fixture
def receiver() -> Receiver:
    return Receiver()


def test_a_frame_says_which_rows_of_which_link_it_holds() -> None:
    _, _, message = frame(5, (1.0, 2.0, 3), (4.0, 5.0, 6))

    assert HEADER.unpack_from(message) == (FRAME, 3, 2, 5)
    assert len(message) == HEADER.size + 2 * (8 + 8 + 4)


def test_rows_are_taken_in_order(receiver: Receiver) -> None:
    first = receiver.take(*frame(0, (1.0, 2.0, 3), (4.0, 5.0, 6)))
    second = receiver.take(*frame(2, (7.0, 8.0, 9)))

    assert first == [(1.0, 2.0, 3), (4.0, 5.0, 6)]
    assert second == [(7.0, 8.0, 9)]
    assert receiver.received == 3


def test_rows_go_around_the_end_of_the_mirror(receiver: Receiver) -> None:
    receiver.take(*frame(0, (0.0, 0.5, 0), (1.0, 1.5, 1), (2.0, 2.5, 2)))
    receiver.kept = 3

    assert receiver.take(*frame(3, (3.0, 3.5, 3), (4.0, 4.5, 4), (5.0, 5.5, 5))) == [
        (3.0, 3.5, 3),
        (4.0, 4.5, 4),
        (5.0, 5.5, 5),
    ]
    assert not receiver.mirror.has_row(1)
    assert receiver.row(2) == (2.0, 2.5, 2)


def test_a_frame_that_would_overwrite_a_row_in_use_ends_the_run(receiver: Receiver) -> None:
    """A row is counted only when it is there, so none is lost: its sender has stepped further than it was granted."""
    receiver.take(*frame(0, (0.0, 0.5, 0), (1.0, 1.5, 1), (2.0, 2.5, 2)))
    receiver.kept = 1

    receiver.take(*frame(3, (3.0, 3.5, 3), (4.0, 4.5, 4)))
    with pytest.raises(ProtocolBroken, match=r"up to point 10 to node 'right', more than was granted"):
        receiver.take(*frame(5, (5.0, 5.5, 5)))

    assert receiver.received == 5
    assert receiver.row(1) == (1.0, 1.5, 1)


def test_where_a_ring_is_shared_only_its_text_comes_in_frames() -> None:
    layout = Layout.of([("a", "Float64"), ("s", "String")])
    map_, places = map_memory(["right", MASTER], {"source": ("left", 2, layout, 4)})
    shared, own = HostMemory.private(map_, "right"), HostMemory.private(map_, "right")
    place, link = places["source"], Link(3, "source", "left", "right", 2, layout, (0, -1))

    rows, receiver = rows_of(link, place, "ring", shared, own, lambda _end: True)
    assert receiver is not None
    receiver.take(0, 1, encode_rows(FRAME, link.index, 0, (np.array([["one"]], dtype=np.object_),)))

    assert [(part.ring.layout.names, part.counter.value, part.text) for part in rows] == [
        (("a", "s"), 0, False),
        (("s",), 1, True),
    ]
    assert rows[1].ring.value(0, "s") == "one"
    assert rows_of(LINK, place, "ring", shared, own, lambda _end: True)[1] is None
    assert [part.text for part in rows_of(link, place, "zenoh", shared, own, lambda _end: True)[0]] == [None]
    streamed, _ = rows_of(link, place, "stream", shared, own, lambda _end: True)
    assert [(part.ring.layout.names, part.text) for part in streamed] == [(("a",), False), (("s",), True)]


def test_a_frame_that_came_before_is_dropped(receiver: Receiver) -> None:
    receiver.take(*frame(0, (1.0, 2.0, 3), (4.0, 5.0, 6)))

    assert receiver.take(*frame(0, (1.0, 2.0, 3))) == []
    assert receiver.received == 2


def test_of_a_frame_that_overlaps_only_the_new_rows_are_taken(receiver: Receiver) -> None:
    receiver.take(*frame(0, (1.0, 2.0, 3), (4.0, 5.0, 6)))

    new = receiver.take(*frame(1, (4.0, 5.0, 6), (7.0, 8.0, 9)))

    assert new == [(7.0, 8.0, 9)]


def test_a_missing_row_is_an_error_with_the_points_that_are_missing(receiver: Receiver) -> None:
    receiver.take(*frame(0, (1.0, 2.0, 3)))

    with pytest.raises(FrameGap, match=r"points 2 to 5 of 'source' never reached node 'right'") as caught:
        receiver.take(*frame(3, (7.0, 8.0, 9)))

    assert (caught.value.instance, caught.value.point, caught.value.exit_code) == ("source", 2, 4)


@pytest.mark.parametrize("other", [(1.0, 2.5, 3), (1.0, 2.0, 4), (-0.0, 2.0, 3), (float("nan"), 2.0, 3)])
def test_a_row_that_comes_again_must_have_the_same_bits(receiver: Receiver, other: tuple[float, float, int]) -> None:
    receiver.take(*frame(0, (1.0, 2.0, 3) if other[0] != 0 else (0.0, 2.0, 3)))

    with pytest.raises(FrameGap, match="came twice and differ") as caught:
        receiver.take(*frame(0, other))

    assert (caught.value.instance, caught.value.point) == ("source", 0)


def test_a_nan_that_comes_again_is_the_same(receiver: Receiver) -> None:
    receiver.take(*frame(0, (float("nan"), -0.0, 3)))

    assert receiver.take(*frame(0, (float("nan"), -0.0, 3))) == []


def test_rows_that_are_no_longer_kept_cannot_be_compared(receiver: Receiver) -> None:
    for step in range(6):
        receiver.kept = step
        receiver.take(*frame(step, (float(step), 0.0, 0)))

    assert receiver.take(*frame(1, (9.0, 9.0, 9))) == []
    with pytest.raises(FrameGap):
        receiver.take(*frame(2, (9.0, 9.0, 9)))


def test_a_frame_before_the_first_point_is_refused(receiver: Receiver) -> None:
    with pytest.raises(MessageRefused, match="a frame from point -1 on has no point of this run"):
        receiver.take(*frame(-1, (0.0, 0.0, 0)))


def test_a_frame_larger_than_any_window_is_refused(receiver: Receiver) -> None:
    with pytest.raises(
        FmuMeshError, match="'source' sends its values up to point 8 to node 'right', more than was granted"
    ):
        receiver.take(*frame(0, *[(0.0, 0.0, 0)] * 5))


def test_a_frame_of_another_size_is_refused(receiver: Receiver) -> None:
    first, count, message = frame(0, (1.0, 2.0, 3))

    for wrong in (message[:-1], message + b"\0", message[: HEADER.size]):
        with pytest.raises(
            FmuMeshError, match=rf"a frame of 1 points has {len(wrong)} bytes where .*\b(44|40) are expected"
        ):
            receiver.take(first, count, wrong)


def test_an_initial_message_gives_the_values_of_its_level() -> None:
    message = encode_rows(INITIAL, 3, 2, (np.array([[1.5, 2.5]]), np.array([[7]], dtype=np.int32)))

    assert initial_values(LINK, 0, message) == {"a": 1.5}
    assert initial_values(LINK, 2, message) == {"b": 2.5}
    assert initial_values(LINK, 1, message) == {}


@pytest.mark.parametrize(("step", "sent"), [(9, 0), (10, 11)], ids=["before", "at the end"])
def test_rows_for_recorder_wait_for_more_rows_unless_no_more_will_come(step: int, sent: int) -> None:
    """Nothing wakes up a node that is done, so rows that wait there would delay the end of the run."""
    map_, places = map_memory(["left", MASTER], {"source": ("left", 1, LAYOUT, 16)})
    memory, place = HostMemory.private(map_, "left"), places["source"]
    ring, messages = memory.ring(place), list[bytes]()
    plan = SimpleNamespace(name="source", step_points=1, inputs=Layout(), input_row=Layout(), finite=())
    runner = Runner(cast("Any", plan), cast("Any", None), TimeGrid(0.0, 0.1, 10), ring, memory.counter(place.counter))
    position = MemberTable()
    runner.follow(position)
    for _ in range(step):
        position.step += 1
    runner.out_links.append(OutLink(Link(3, "source", "left", RECORDER, 1, LAYOUT, ()), LAYOUT, ring, messages.append))

    runner.flush(lazy=False)

    assert [HEADER.unpack_from(message) for message in messages] == ([(FRAME, 3, sent, 0)] if sent else [])
