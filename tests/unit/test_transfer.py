"""What happens to values on their way from the rows of a source to the steps of a target."""

from __future__ import annotations

import numpy as np
import pytest

from fmu_mesh.rings.ring import Ring
from fmu_mesh.rings.transfer import Transfer
from fmu_mesh.system.coupling_rule import CouplingRule
from fmu_mesh.system.layout import Layout
from fmu_mesh.system.plan import Feed
from fmu_mesh.variables.value_types import Value

RATES = [(source, target, delay) for source in range(1, 6) for target in range(1, 6) for delay in (0, 1)]
SOURCE = Layout.of([("a", "Float64"), ("b", "Float64"), ("c", "Float64"), ("n", "Int32"), ("m", "Int32")])
INPUTS = Layout.of([("x", "Float64"), ("y", "Float64"), ("z", "Float64"), ("i", "Int32"), ("j", "Int32")])
PLAIN = (("c", "x", 1.0, 0.0), ("a", "z", 1.0, 0.0), ("m", "j", 1.0, 0.0))


def transfer(
    inputs: Ring,
    source_points: int = 1,
    target_points: int = 1,
    delay: int = 1,
    columns: tuple[tuple[str, str, float, float], ...] = PLAIN,
) -> Transfer:
    feed = Feed("source", delay, columns)
    return Transfer(feed, SOURCE, inputs, source_points=source_points, target_points=target_points)


def filled(rows: int) -> Ring:
    ring = Ring(SOURCE, rows)
    ring.part("Float64")[:] = np.arange(rows * 3).reshape(rows, 3) + 0.5
    ring.part("Int32")[:] = np.arange(rows * 2).reshape(rows, 2) - 7
    return ring


@pytest.mark.parametrize(("source_points", "target_points", "delay"), RATES)
@pytest.mark.parametrize("frame", [1, 3, 7])
def test_frames_of_any_length_feed_every_step_once(
    source_points: int, target_points: int, delay: int, frame: int
) -> None:
    source, inputs = filled(64), Ring(INPUTS, 256)
    moved = transfer(inputs, source_points, target_points, delay)

    for first in range(0, 42, frame):
        moved.from_rows(first, tuple(part[first : first + frame] for part in source.parts))

    for step in range(moved.ready(42)):
        row = CouplingRule(delay, source_points, target_points).row_for(step)
        assert inputs.part("Float64")[step].tolist() == [
            source.part("Float64")[row, 2],
            0.0,
            source.part("Float64")[row, 0],
        ]
        assert inputs.part("Int32")[step].tolist() == [0, source.part("Int32")[row, 1]]
    assert not inputs.part("Float64")[moved.ready(42) :].any()


@pytest.mark.parametrize(("source_points", "target_points", "delay"), RATES)
def test_a_ring_feeds_as_frames_do(source_points: int, target_points: int, delay: int) -> None:
    source = filled(64)
    by_frame, by_ring, by_step = (Ring(INPUTS, 512) for _ in range(3))
    low, high = 3, 9

    transfer(by_frame, source_points, target_points, delay).from_rows(0, source.parts)
    transfer(by_ring, source_points, target_points, delay).from_ring(source, low, high)
    for step in range(low, high):
        transfer(by_step, source_points, target_points, delay).stepper(source)(step)

    for ring in (by_ring, by_step):
        assert ring.part("Float64")[low:high].tolist() == by_frame.part("Float64")[low:high].tolist()
        assert ring.part("Int32")[low:high].tolist() == by_frame.part("Int32")[low:high].tolist()
        assert not ring.part("Float64")[high:].any()


def test_rows_go_around_the_end_of_a_ring() -> None:
    source, inputs = filled(16), Ring(INPUTS, 8)

    transfer(inputs).from_rows(0, tuple(part[:6] for part in source.parts))
    transfer(inputs).from_rows(6, tuple(part[6:12] for part in source.parts))

    assert inputs.part("Float64")[:, 2].tolist() == source.part("Float64")[[8, 9, 10, 11, 4, 5, 6, 7], 0].tolist()


def test_a_factor_and_an_offset_round_as_python_does() -> None:
    source, inputs = filled(4), Ring(INPUTS, 4)
    columns = (("a", "x", 0.1, 0.7), ("n", "y", 1.5, -0.25), ("b", "z", 1.0, 0.0))

    transfer(inputs, columns=columns).from_rows(0, source.parts)

    for row in range(4):
        a, b, _ = source.part("Float64")[row].tolist()
        assert inputs.part("Float64")[row].tolist() == [
            a * 0.1 + 0.7,
            int(source.part("Int32")[row, 0]) * 1.5 + -0.25,
            b,
        ]


def test_what_is_not_scaled_keeps_its_sign_of_zero_and_its_nan() -> None:
    source, inputs = Ring(SOURCE, 2), Ring(INPUTS, 2)
    source.part("Float64")[0] = -0.0
    source.part("Float64")[1] = np.nan

    transfer(inputs).from_rows(0, source.parts)

    assert inputs.part("Float64")[:, 0].tobytes() == source.part("Float64")[:, 2].tobytes()


def test_a_frame_that_feeds_no_step_changes_nothing() -> None:
    source, inputs = filled(4), Ring(INPUTS, 4)
    moved = transfer(inputs, source_points=1, target_points=5, delay=0)

    moved.from_rows(0, source.parts)

    assert moved.ready(4) == 0
    assert not inputs.part("Float64").any()


@pytest.mark.parametrize("delay", [0, 1])
@pytest.mark.parametrize(
    "columns",
    [
        (("c", "x", 1.0, 0.0),),
        (("b", "z", 0.1, -3.3),),
        (("m", "j", 1.0, 0.0),),
        (("b", "y", 1.0, 0.0), ("n", "i", 1.0, 0.0), ("a", "x", -1.7, 1e-9)),
    ],
)
def test_single_numbers_are_handed_over_bit_by_bit(
    columns: tuple[tuple[str, str, float, float], ...], delay: int
) -> None:
    """Random bits: every kind of NaN, infinities and denormals among them; both rings go around several times."""
    source = Ring(SOURCE, 8)
    by_ring, by_step = Ring(INPUTS, 4), Ring(INPUTS, 4)
    whole, single = (transfer(ring, delay=delay, columns=columns) for ring in (by_ring, by_step))
    step_once = single.stepper(source)
    random = np.random.default_rng(delay)

    for step in range(40):
        for part in source.parts:
            part[(step + 1) & source.mask] = np.frombuffer(random.bytes(part[0].nbytes), part.dtype)
        with np.errstate(all="ignore"):
            whole.from_ring(source, step, step + 1)
        step_once(step)

        assert [part.tobytes() for part in by_step.parts] == [part.tobytes() for part in by_ring.parts]


def test_a_reader_and_a_writer_of_a_column_do_what_value_and_put_do() -> None:
    layout = Layout.of([("a", "Float64"), ("f", "Float64", (2, 2)), ("g", "Float32"), ("n", "Int64"), ("s", "String")])
    written, put = Ring(layout, 4), Ring(layout, 4)
    values: dict[str, Value] = {"a": 0.1, "f[2,1]": 2.5, "g": 0.1, "n": 2**63 - 1, "s": "text"}

    for name, value in values.items():
        written.writer(name)(6, value)
        put.put(6, name, value)

    assert [written.value(6, name) for name in values] == [put.value(6, name) for name in values]
    assert [written.reader(name)(6) for name in values] == [put.value(6, name) for name in values]
    assert [written.reader(name)(7) for name in values] == [0.0, 0.0, 0.0, 0, ""]
    assert [type(written.reader(name)(6)) for name in values] == [float, float, float, int, str]
