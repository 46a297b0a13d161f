"""What may be connected loses nothing: every value of the source comes back from the type of the target."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from fmu_mesh.variables.value_types import DTYPES, INTEGERS, TYPES, VariableType, flattened, is_text, nested, takes

NUMBERS = [type_ for type_ in TYPES if not is_text(type_)]


def values_of(type_: VariableType) -> st.SearchStrategy[float]:
    match type_:
        case "Float64" | "Float32":
            return st.floats(width=32 if type_ == "Float32" else 64, allow_nan=False)
        case "Boolean":
            return st.booleans()
        case "Enumeration":
            return st.integers(-(2**31), 2**31 - 1)
        case _:
            whole = INTEGERS[type_]
            return st.integers(whole[0], whole[-1]) | st.sampled_from([whole[0], whole[-1]])


pairs = st.sampled_from([(s, t) for s in NUMBERS for t in NUMBERS if takes(t, s)])


@given(pairs, st.data())
def test_a_conversion_that_is_allowed_loses_nothing(
    pair: tuple[VariableType, VariableType], data: st.DataObject
) -> None:
    source, target = pair
    value = data.draw(values_of(source))
    given_, taken = np.zeros(1, DTYPES[source]), np.zeros(1, DTYPES[target])
    given_[0] = value

    taken[:] = given_

    assert taken.tolist() == given_.tolist() == [value]


@given(st.sampled_from(TYPES), st.sampled_from(TYPES))
def test_text_and_enumerations_are_taken_by_their_own_type_only(source: VariableType, target: VariableType) -> None:
    if source != target and ({source, target} & {"String", "Binary"} or target in ("Enumeration", "Boolean")):
        assert not takes(target, source)


@given(st.integers(-(2**63), 2**63 - 1), st.sampled_from(list(INTEGERS)))
def test_an_enumeration_is_taken_where_its_items_fit(item: int, target: VariableType) -> None:
    assert takes(target, "Enumeration", (item,)) == (target == "Enumeration" or item in INTEGERS[target])


@given(st.lists(st.integers(1, 4), max_size=4).map(tuple))
def test_elements_keep_their_order_in_every_shape(shape: tuple[int, ...]) -> None:
    elements = list(range(int(np.prod(shape))))

    value = nested(elements, shape)

    assert flattened(value, len(shape)) == elements
    assert np.array(value).shape == shape
    assert np.array(value).ravel().tolist() == elements
