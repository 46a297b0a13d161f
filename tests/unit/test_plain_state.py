"""What of a component can be in a file: it comes back as it was, and anything else is refused."""

from __future__ import annotations

import random
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as of_numpy

from fmu_mesh.instances.python.plain_state import NotPlain, check_memory, encoded, plain
from tests.helpers import examples

scalars = st.one_of(st.none(), st.booleans(), st.integers(), st.floats(), st.text(), st.binary())
dtypes = st.one_of(
    of_numpy.floating_dtypes(), of_numpy.integer_dtypes(), of_numpy.boolean_dtypes(), of_numpy.complex_number_dtypes()
)
arrays = of_numpy.arrays(dtypes, of_numpy.array_shapes(min_dims=0, min_side=0)).flatmap(
    lambda array: st.permutations(range(array.ndim)).map(array.transpose)
)
keys = st.one_of(st.text(), st.integers(), st.tuples(st.booleans(), st.text()))
values = st.recursive(
    st.one_of(scalars, arrays),
    lambda inner: st.one_of(st.lists(inner), st.lists(inner).map(tuple), st.dictionaries(keys, inner)),
    max_leaves=20,
)


@given(values)
@settings(max_examples=examples(300), deadline=None)
def test_plain_values_come_back_with_their_types_and_bits(value: object) -> None:
    assert form(plain(encoded(value))) == form(value)


def form(value: object) -> object:
    """What two values have in common that cannot be told apart."""
    match value:
        case np.ndarray():
            order = sorted(range(value.ndim), key=lambda axis: -abs(value.strides[axis])) if value.size else []
            return "array", value.dtype.str, value.shape, order, value.tobytes()
        case list() | tuple():
            return type(value), [form(one) for one in value]
        case dict():
            return dict, [(form(key), form(one)) for key, one in value.items()]
    return type(value), repr(value)


def test_a_list_of_two_attributes_stays_one_list() -> None:
    shared: list[Any] = [1]
    shared.append(shared)

    back = plain(encoded({"a": shared, "b": (shared,)}))

    assert back["a"] is back["b"][0] is back["a"][1]


@pytest.mark.parametrize("name", ["MT19937", "PCG64", "PCG64DXSM", "Philox", "SFC64"])
def test_random_numbers_go_on(name: str) -> None:
    drawn, dice = np.random.Generator(getattr(np.random, name)(5)), random.Random(3)  # noqa: S311  a test
    drawn.normal(), drawn.spawn(2), dice.gauss(0.0, 1.0)

    (other, other_dice) = plain(encoded((drawn, dice)))

    assert other.normal(size=9).tolist() == drawn.normal(size=9).tolist()
    assert other.spawn(1)[0].random() == drawn.spawn(1)[0].random()
    assert [other_dice.gauss(0.0, 1.0) for _ in range(3)] == [dice.gauss(0.0, 1.0) for _ in range(3)]


class Text(str):
    __slots__ = ()


@pytest.mark.parametrize(
    ("value", "told"),
    [
        ({"model": Path("a")}, "in attribute 'model'"),
        ({"known": {"x": [1, {2}]}}, r"a set in attribute 'known'\['x'\]\[1\]"),
        ({"name": Text("a")}, "in attribute 'name'"),
        ({"all": np.array([object()])}, "numpy.ndarray of object in attribute 'all'"),
        ({"pairs": np.zeros(2, [("a", "f8")])}, "in attribute 'pairs'"),
        ({"word": "\ud800"}, "cannot be written"),
        (lambda: 1, "a function"),
    ],
)
def test_anything_else_is_refused_by_the_name_of_its_attribute(value: object, told: str) -> None:
    with pytest.raises(NotPlain, match=told):
        encoded(value)


def test_a_value_that_is_too_deep_is_refused() -> None:
    deep: list[Any] = []
    for _ in range(10_000):
        deep = [deep]

    with pytest.raises(NotPlain, match="cannot be written"):
        encoded(deep)


@given(st.one_of(st.binary(), st.binary().map(lambda rest: encoded([1, {"a": np.zeros(3)}])[:-1] + rest)))
@settings(max_examples=examples(300), deadline=None)
def test_other_bytes_are_refused_or_are_plain(data: bytes) -> None:
    try:
        value = plain(data)
    except ValueError:
        return
    encoded(value)


def test_arrays_that_share_memory_are_refused() -> None:
    whole, other = np.zeros(6), np.zeros(6)

    check_memory({"whole": whole, "again": whole, "first": other[:3], "last": other[3:]})
    with pytest.raises(NotPlain, match="has arrays in 'whole' and 'part' that share memory"):
        check_memory({"whole": whole, "other": other, "part": whole[2:]})
