"""What happens to values on their way from the rows of a source to the steps of a target: in Python and in C."""

from __future__ import annotations

import ctypes
from typing import NamedTuple

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fmu_mesh.rings import native
from fmu_mesh.rings.native import OUT_OF_RANGE, STAGE_BITS, MemberTable, Move, RowBase, Said, Stage, table
from fmu_mesh.rings.ring import Ring
from fmu_mesh.rings.transfer import Transfer
from fmu_mesh.system.coupling_rule import CouplingRule
from fmu_mesh.system.feeds import Feed, FeedColumn
from fmu_mesh.system.layout import Layout
from fmu_mesh.variables.value_types import INTEGERS, Value, VariableType, element_names, is_float, takes

needs_library = pytest.mark.skipif(native.library is None, reason="the library with the burst is not built here")

RATES = [(source, target, delay) for source in range(1, 6) for target in range(1, 6) for delay in (0, 1)]
SOURCE = Layout.of(
    [("a", "Float64"), ("b", "Float64"), ("c", "Float64"), ("n", "Int32"), ("m", "Int32"), ("s", "String")]
)
INPUTS = Layout.of(
    [("x", "Float64"), ("y", "Float64"), ("z", "Float64"), ("i", "Int32"), ("j", "Int32"), ("t", "String")]
)
PLAIN = (("c", "x", 1.0, 0.0), ("a", "z", 1.0, 0.0), ("m", "j", 1.0, 0.0))


def transfer(
    source: Ring,
    inputs: Ring,
    source_points: int = 1,
    target_points: int = 1,
    delay: int = 1,
    columns: tuple[tuple[str, str, float, float], ...] = PLAIN,
    *,
    text: bool | None = None,
) -> Transfer:
    rule = CouplingRule(delay, source_points, target_points)
    feed = Feed("source", rule, tuple(FeedColumn(*column) for column in columns))
    return Transfer(feed, source, inputs, target="target", text=text)


def filled(rows: int) -> Ring:
    ring = Ring(SOURCE, rows)
    ring.part("Float64")[:] = np.arange(rows * 3).reshape(rows, 3) + 0.5
    ring.part("Int32")[:] = np.arange(rows * 2).reshape(rows, 2) - 7
    ring.part("String")[:, 0] = [f"row {row}" for row in range(rows)]
    return ring


def move_in_c(moved: Transfer, row: int) -> int:
    """Move the numbers of a row as the burst does; returns the outcome of a step that goes no further."""
    assert native.library is not None
    moves, said = moved.moves(RowBase.FIRST_GATE), Said(quiet_until=0.0)
    bases = (ctypes.c_void_p * (RowBase.FIRST_GATE + 1))()
    bases[RowBase.FIRST_GATE] = moved.source.address + (row & moved.source.mask) * moved.source.stride
    member = MemberTable(
        loads=table(Move, moves),
        n_loads=len(moves),
        said=ctypes.addressof(said),
        bases=ctypes.cast(bases, ctypes.POINTER(ctypes.c_void_p)),
    )
    return int(native.library.member_step(ctypes.byref(member), 0))


@pytest.mark.parametrize(("source_points", "target_points", "delay"), RATES)
def test_a_step_gets_the_values_of_the_row_that_feeds_it(source_points: int, target_points: int, delay: int) -> None:
    source, inputs = filled(64), Ring(INPUTS, 1)
    moved = transfer(source, inputs, source_points, target_points, delay)

    for step in range(12):
        moved.step(step)

        row = CouplingRule(delay, source_points, target_points).row_for(step)
        reals, integers = source.part("Float64")[row], source.part("Int32")[row]
        assert inputs.part("Float64")[0].tolist() == [reals[2], 0.0, reals[0]]
        assert inputs.part("Int32")[0].tolist() == [0, integers[1]]


def test_rows_go_around_the_end_of_a_ring() -> None:
    source, inputs = filled(8), Ring(INPUTS, 1)

    transfer(source, inputs).step(8 + 3)

    assert inputs.part("Float64")[0, 2] == source.part("Float64")[3, 0]


def test_a_factor_and_an_offset_round_as_python_does() -> None:
    source, inputs = filled(4), Ring(INPUTS, 1)
    columns = (("a", "x", 0.1, 0.7), ("n", "y", 1.5, -0.25), ("b", "z", 1.0, 0.0))

    for row in range(4):
        transfer(source, inputs, columns=columns).step(row)

        a, b, _ = source.part("Float64")[row].tolist()
        number = int(source.part("Int32")[row, 0])
        assert inputs.part("Float64")[0].tolist() == [a * 0.1 + 0.7, number * 1.5 + -0.25, b]


def test_text_is_moved_without_the_numbers() -> None:
    """The burst moves the numbers, and Python the text that lies beside the row."""
    source, inputs = filled(4), Ring(INPUTS, 1)
    moved = transfer(source, inputs, columns=(*PLAIN, ("s", "t", 1.0, 0.0)))

    moved.step_text(2)

    assert moved.has_text
    assert inputs.value(0, "t") == "row 2"
    assert not inputs.part("Float64").any()
    assert [move.count for move in moved.moves(RowBase.FIRST_GATE)] == [1, 1, 1]


@pytest.mark.parametrize(("text", "names"), [(True, ["s"]), (False, ["c", "a", "m"]), (None, ["c", "a", "m", "s"])])
def test_numbers_and_text_can_come_from_different_rings(text: bool | None, names: list[str]) -> None:  # noqa: FBT001 a parameter of a test
    moved = transfer(filled(1), Ring(INPUTS, 1), columns=(*PLAIN, ("s", "t", 1.0, 0.0)), text=text)

    assert [source for source, *_ in moved.columns] == names
    assert moved.has_text == ("s" in names)


# --- the same bits in C


class Drawn(NamedTuple):
    """A connection between two rings: from an array or an element of it, to an array or an element."""

    source: VariableType
    target: VariableType
    shape: tuple[int, ...]
    source_element: int | None
    target_element: int | None
    factor: float
    offset: float


NUMBERS: tuple[VariableType, ...] = tuple(native.NUMBER_TYPES)
PAIRS = [(source, target) for source in NUMBERS for target in NUMBERS if takes(target, source)]
FLOATS = st.floats() | st.sampled_from([0.0, -0.0, float("nan"), float("inf"), -float("inf"), 5e-324, 1e300])


@st.composite
def connections(draw: st.DrawFn) -> Drawn:
    source, target = draw(st.sampled_from(PAIRS))
    shape = draw(st.sampled_from([(), (), (3,), (2, 2)]))
    of_element = bool(shape) and draw(st.booleans())
    scaled = is_float(target) and draw(st.booleans())
    finite = st.floats(allow_nan=False, allow_infinity=False)
    return Drawn(
        source,
        target,
        shape,
        draw(st.integers(0, 2)) if of_element else None,
        draw(st.integers(0, 2)) if of_element else None,
        draw(finite) if scaled else 1.0,
        draw(finite) if scaled else 0.0,
    )


def any_value(draw: st.DataObject, type_: VariableType) -> Value:
    if type_ == "Boolean":
        return draw.draw(st.booleans())
    if is_float(type_):
        return draw.draw(FLOATS)
    numbers = INTEGERS["Int32" if type_ == "Enumeration" else type_]  # an Enumeration has the numbers of its items
    return draw.draw(st.integers(numbers[0], numbers[-1]) | st.sampled_from([numbers[0], numbers[-1]]))


@needs_library
@given(st.lists(connections(), min_size=1, max_size=6), st.data())
def test_c_and_python_move_the_same_bits(drawn: list[Drawn], data: st.DataObject) -> None:
    source = Ring(Layout.of([(f"y{i}", own.source, own.shape) for i, own in enumerate(drawn)]), 2)
    layout = Layout.of([(f"u{i}", own.target, own.shape) for i, own in enumerate(drawn)])
    by_python, by_c = Ring(layout, 1), Ring(layout, 1)
    for column in source.layout.columns:
        for name in column.elements:
            source.put(1, name, any_value(data, column.type))
    columns = tuple(
        (
            f"y{i}" if own.source_element is None else element_names(f"y{i}", own.shape)[own.source_element],
            f"u{i}" if own.target_element is None else element_names(f"u{i}", own.shape)[own.target_element],
            own.factor,
            own.offset,
        )
        for i, own in enumerate(drawn)
    )

    with np.errstate(all="ignore"):
        transfer(source, by_python, columns=columns).step(1)
    outcome = move_in_c(transfer(source, by_c, columns=columns), 1)

    assert outcome == Stage.IN_PYTHON << STAGE_BITS
    assert [part.tobytes() for part in by_c.parts] == [part.tobytes() for part in by_python.parts]


@needs_library
@pytest.mark.parametrize(
    ("source", "target", "value"),
    [("Enumeration", "Int32", 2**31), ("Enumeration", "Int8", -129), ("UInt64", "Int64", 2**63)],
)
def test_a_number_that_the_target_cannot_hold_is_no_value_in_c(
    source: VariableType, target: VariableType, value: int
) -> None:
    rows, inputs = Ring(Layout.of([("y", source)]), 1), Ring(Layout.of([("u", target)]), 1)
    rows.put(0, "y", value)

    outcome = move_in_c(transfer(rows, inputs, columns=(("y", "u", 1.0, 0.0),)), 0)

    assert outcome == Stage.SETTING << STAGE_BITS | OUT_OF_RANGE


def test_a_reader_and_writer_of_column_do_what_value_and_put_do() -> None:
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
