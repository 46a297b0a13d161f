"""The variants of a sweep: what a text, a grid, a sampler and a program's own list mean, and what is refused."""

from __future__ import annotations

import itertools
import math
import sys
from collections.abc import Mapping
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fmu_mesh.errors import CallRefused, ConfigurationError
from fmu_mesh.sweeps import variants
from fmu_mesh.sweeps.variants import Range, Values, grid, read_values, sampled, variants_of

WRONG: list[Any] = ["x", "lin"]
"""What a program gives where a number and a scale belong."""
FINITE = st.floats(-1e12, 1e12)


@pytest.mark.parametrize(
    ("text", "name", "values"),
    [
        ("pendulum.d=0.05:0.8:16", "pendulum.d", Range(0.05, 0.8, 16)),
        ("pendulum.d = 0.05 : 0.8 : 16 ", "pendulum.d", Range(0.05, 0.8, 16)),
        ("pendulum.d=0.05:0.8", "pendulum.d", Range(0.05, 0.8)),
        ("pendulum.d=0.05:0.8:log", "pendulum.d", Range(0.05, 0.8, None, "log")),
        ("pendulum.d=1e-2:10:5:log", "pendulum.d", Range(0.01, 10, 5, "log")),
        ("pendulum.d=.5:-1.5:3:linear", "pendulum.d", Range(0.5, -1.5, 3)),
        ("a.der(b[1,2],2)=1,2", "a.der(b[1,2],2)", [1, 2]),
        ("a.b=0.1,0.2,x", "a.b", [0.1, 0.2, "x"]),
        ("a.b='1:2:3', \"x, y\", x:y", "a.b", ["1:2:3", "x, y", "x:y"]),
        ("a.b=true,false,'true',1e-3,off", "a.b", [True, False, "true", 0.001, "off"]),
        ("a.b=7", "a.b", [7]),
        ("a.b=[7]", "a.b", [7]),
        ("a.b=[[1,2],[3,4]]", "a.b", [[1, 2], [3, 4]]),
        ("simulation.algorithm=jacobi,gauss_seidel", "simulation.algorithm", ["jacobi", "gauss_seidel"]),
        ("a.b=x=y", "a.b", ["x=y"]),
    ],
)
def test_a_text_is_read_as_a_range_or_as_values(text: str, name: str, values: object) -> None:
    read = read_values(text)

    assert read == (name, values)
    assert repr(read[1]) == repr(values) or isinstance(values, Range)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("pendulum.d", "no values of a parameter; expected NAME=LOW:HIGH:COUNT or NAME=VALUE,VALUE"),
        ("=1", "no values of a parameter"),
        ("pendulum.d=", "no values of a parameter"),
        ("pendulum.d=0.05:0.8:x", "the range '0.05:0.8:x'; expected NAME=LOW:HIGH:COUNT"),
        ("pendulum.d=0.05:0.8:2.5", "the range '0.05:0.8:2.5'"),
        ("pendulum.d=0.05:0.8:16:lgo", "the range '0.05:0.8:16:lgo'"),
        ("pendulum.d=0.05:0.8:16:log:2", "the range"),
        ("pendulum.d=0.05:", "the range '0.05:'"),
        ("pendulum.d=0.05:0.8:1", "1 values from 0.05 to 0.8; expected 2 to 1000000 values, with both ends"),
        ("pendulum.d=0.05:0.8:99999999", "99999999 values from 0.05 to 0.8"),
        ("pendulum.d=0.5:0.5:3", "a range from 0.5 to 0.5; expected two ends; 0.5 alone is a list of one value"),
        ("pendulum.d=0:.inf:3", "a range from 0 to inf; expected finite numbers"),
        ("pendulum.d=0:1:3:log", "a logarithmic range from 0 to 1; expected both ends above 0"),
        ("a.b=1,,2", "a ',' with nothing before it; expected values in YAML, separated by commas"),
        ("a.b=[1,2", "expected values in YAML"),
        ("a.b=1,null", "nothing (null); expected numbers, texts, true or false, or lists"),
        ("a.b={c: 1}", "a mapping; expected numbers"),
    ],
)
def test_a_text_that_is_neither_is_refused_with_what_is_possible(text: str, message: str) -> None:
    with pytest.raises(ConfigurationError) as caught:
        read_values(text)

    assert str(caught.value).startswith(f"--vary {text}: ")
    assert message in str(caught.value)


def test_the_last_name_of_a_grid_varies_fastest() -> None:
    made = grid({"a.x": [1, 2], "a.y": Range(0.0, 1.0, 3), "b.mode": ["p", True]})

    assert [list(variant.values()) for variant in made] == [
        [x, y, mode] for x in (1, 2) for y in (0.0, 0.5, 1.0) for mode in ("p", True)
    ]
    assert all(list(variant) == ["a.x", "a.y", "b.mode"] for variant in made)


@given(FINITE, FINITE, st.integers(2, 50))
def test_a_linear_range_has_its_exact_ends_and_is_monotonic(low: float, high: float, count: int) -> None:
    if low == high:
        return

    values: list[Any] = [variant["a.b"] for variant in grid({"a.b": Range(low, high, count)})]

    assert (values[0], values[-1]) == (low, high)
    assert values == sorted(values, reverse=low > high)
    assert all(type(value) is float for value in values)


@given(st.floats(1e-12, 1e12), st.floats(1e-12, 1e12), st.integers(2, 50))
def test_a_logarithmic_range_has_its_exact_ends_and_stays_between_them(low: float, high: float, count: int) -> None:
    if low == high:
        return

    values: list[Any] = [variant["a.b"] for variant in grid({"a.b": Range(low, high, count, "log")})]

    assert (values[0], values[-1]) == (low, high)
    assert all(min(low, high) <= value <= max(low, high) for value in values)


def test_a_range_of_integers_has_integers_if_all_of_them_are_integers() -> None:
    def values(text: str) -> list[Any]:
        return [variant["a.n"] for variant in grid(dict([read_values(text)]))]

    assert repr(values("a.n=1:10:4")) == "[1, 4, 7, 10]"
    assert repr(values("a.n=0:1:3")) == "[0.0, 0.5, 1.0]"
    assert repr(values("a.n=0.0:10:3")) == "[0.0, 5.0, 10.0]"


@pytest.mark.parametrize(
    ("vary", "message"),
    [
        ({}, "nothing varies."),
        ({"a.b": []}, "'a.b' has no values."),
        ({"a.b": Range(0.0, 1.0)}, "the range of 'a.b' has no count."),
        ({"a.b": Range(0.0, 1.0, 1)}, "'a.b' has 1 values from 0.0 to 1.0"),
        ({"a.b": Range(0.0, math.inf, 2)}, "'a.b' has a range from 0.0 to inf"),
        ({"a.b": Range(0.0, 1.0, 2, "log")}, "'a.b' has a logarithmic range"),
        ({"a.b": Range(0, 1, 1001), "a.c": Range(0, 1, 1000)}, "there are 1001000 combinations; 1000000 are possible."),
    ],
)
def test_a_grid_that_cannot_be_made_is_refused(vary: Mapping[str, Any], message: str) -> None:
    with pytest.raises(ConfigurationError) as caught:
        grid(vary)

    assert message in str(caught.value)


def test_equal_combinations_are_there_once_and_types_count() -> None:
    assert repr(grid({"a.b": [1, 1.0, True, 1, "1", math.nan, math.nan]})) == (
        "[{'a.b': 1}, {'a.b': 1.0}, {'a.b': True}, {'a.b': '1'}, {'a.b': nan}]"
    )


SAMPLERS = ("lhs:64", "sobol:64", "halton:64", "random:64")


@pytest.mark.parametrize("sampler", SAMPLERS)
def test_the_same_seed_samples_the_same_variants(sampler: str) -> None:
    vary: dict[str, Values] = {"a.b": Range(0.0, 1.0), "a.c": ["x", "y"]}

    assert sampled(vary, sampler, 7) == sampled(vary, sampler, 7)
    assert sampled(vary, sampler, 7) != sampled(vary, sampler, 8)
    assert len(sampled(vary, sampler, 7)) == 64


@pytest.mark.parametrize("sampler", SAMPLERS)
def test_a_sampler_stays_in_ranges_and_takes_all_values_of_a_list(sampler: str) -> None:
    vary: dict[str, Values] = {"a.d": Range(0.01, 10.0, None, "log"), "a.l": Range(2, -1)}
    vary |= {"a.n": Range(1, 4, 4), "a.s": ["x", True]}

    made = sampled(vary, sampler)

    columns: dict[str, list[Any]] = {name: [variant[name] for variant in made] for name in vary}
    assert all(0.01 <= value <= 10.0 for value in columns["a.d"])
    assert all(-1.0 <= value <= 2.0 for value in columns["a.l"])
    assert {repr(value) for value in columns["a.n"]} == {"1", "2", "3", "4"}
    assert set(columns["a.s"]) == {"x", True}
    assert all(type(value) is float for value in columns["a.d"] + columns["a.l"])


@pytest.mark.parametrize("sampler", ["lhs:64", "sobol:64"])
def test_a_stratified_sampler_has_one_value_in_each_of_its_64_sections(sampler: str) -> None:
    """This tells them from independent numbers; on a logarithmic scale, the sections are those of the logarithm."""
    made: list[Any] = sampled({"a.x": Range(0.0, 64.0), "a.d": Range(1.0, 2.0**64, None, "log")}, sampler, 3)

    assert sorted(int(variant["a.x"]) for variant in made) == list(range(64))
    assert sorted(int(math.log2(variant["a.d"])) for variant in made) == list(range(64))


def test_lists_sampled_more_often_than_they_have_combinations_have_each_once() -> None:
    made = sampled({"a.b": [1, 2], "a.c": ["x", "y"]}, "random:200")

    pairs = [(variant["a.b"], variant["a.c"]) for variant in made]
    assert sorted(pairs) == sorted(itertools.product([1, 2], ["x", "y"]))


@pytest.mark.parametrize(
    ("sampler", "seed", "message"),
    [
        ("lsh:64", 0, "there is no sampler 'lsh:64'. Did you mean 'lhs:64'?"),
        ("grid", 0, "There are lhs, sobol, halton, random, as in lhs:64."),
        ("lhs", 0, "the sampler 'lhs' has no count from 1 to 1000000, as in lhs:64."),
        ("lhs:0", 0, "has no count"),
        ("lhs:-3", 0, "has no count"),
        ("lhs:9999999", 0, "has no count from 1 to 1000000"),
        ("sobol:100", 0, "Choose 64 or 128, or halton:100."),
        ("random:4", -1, "the seed -1 is no whole number of at least 0."),
        ("random:4", 0.5, "the seed 0.5 is no whole number"),
        ("random:4", None, "the seed nothing (null) is no whole number"),
    ],
)
def test_a_sampler_that_is_not_there_is_refused_with_a_way_out(sampler: str, seed: Any, message: str) -> None:  # noqa: ANN401  as WRONG
    with pytest.raises(ConfigurationError) as caught:
        sampled({"a.b": Range(0.0, 1.0)}, sampler, seed)

    assert message in str(caught.value)


def test_without_scipy_a_sampler_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "scipy.stats", None)

    with pytest.raises(ConfigurationError, match=r"other than random:8 .*-m pip install 'scipy"):
        sampled({"a.b": Range(0.0, 1.0)}, "lhs:8")

    assert len(sampled({"a.b": Range(0.0, 1.0)}, "random:8")) == 8


def test_a_program_gives_arrays_tuples_and_iterators_and_gets_plain_values() -> None:
    made = variants_of(
        {
            "a.b": np.array([0.5, 1.5]),
            "a.n": (np.int32(3),),
            "a.v": np.array([[1.0, 2.0], [3.0, 4.0]]),
            "a.s": iter(["x"]),
            "a.r": range(2),
        }
    )

    assert len(made) == 8
    assert repr(made[-1]) == "{'a.b': 1.5, 'a.n': 3, 'a.v': [3.0, 4.0], 'a.s': 'x', 'a.r': 1}"
    assert [type(value) for value in made[0].values()] == [float, int, list, str, int]


def test_a_range_of_numpy_numbers_is_a_range_of_plain_ones() -> None:
    low, high = np.array([0, 4])

    assert repr(variants_of({"a.b": Range(low, high, 3)})) == "[{'a.b': 0}, {'a.b': 2}, {'a.b': 4}]"
    assert len(variants_of({"a.b": Range(0.0, 1.0)}, "halton:5", 1)) == 5


def test_a_program_may_list_the_variants_itself() -> None:
    made = variants_of({"b.y": np.float64(x), "a.x": x, "a.on": x > 1} for x in (1, 2))

    assert repr(made) == "[{'b.y': 1.0, 'a.x': 1, 'a.on': False}, {'b.y': 2.0, 'a.x': 2, 'a.on': True}]"


@pytest.mark.parametrize(
    ("vary", "message"),
    [
        ("a.b=1:2:3", "a sweep got 'a.b=1:2:3' (str); expected a mapping of names to values, or a list of mappings"),
        (None, "a sweep got nothing (null) (NoneType)"),
        ([], "a sweep has 1 to 1000000 variants"),
        ([{}], "variant 0 got a mapping (dict)"),
        ([("a.b", 1)], "variant 0 got ('a.b', 1) (tuple); expected a mapping of names to values"),
        ([{"a.b": 1}, {"a.c": 1}], "variant 1 and variant 0 have different names: a.b, a.c"),
        ([{"a.b": 1}, {"a.b": 2}, {"a.b": 1}], "variants 0 and 2 are equal"),
        ([{"a.b": None}], "'a.b' got nothing (null) (NoneType); expected a number"),
        ({"a.b": 0.5}, "'a.b' got 0.5 (float); expected a list of values, or a Range"),
        ({"a.b": "xyz"}, "'a.b' got 'xyz' (str); expected a list of values, or a Range"),
        ({"a.b": np.array(1.0)}, "'a.b' got 1.0 (ndarray)"),
        ({"a.b": [object]}, "'a.b' got <class 'object'> (type)"),
        ({"a.b": [1 + 2j]}, "'a.b' got (1+2j) (complex)"),
        ({"a.b": Range(WRONG[0], 1.0, 3)}, "the range of 'a.b' is wrong: Expected `float`, got `str`"),
        ({"a.b": Range(0.0, 1.0, 3, WRONG[1])}, "the range of 'a.b' is wrong: Invalid enum value 'lin'"),
        ({"a.b": itertools.repeat(1)}, "there are 1000001 combinations"),
        (({"a.b": number} for number in itertools.count()), "a sweep has 1 to 1000000 variants"),
    ],
)
def test_what_is_no_variant_is_refused(vary: Any, message: str) -> None:  # noqa: ANN401  whatever a program gives
    with pytest.raises((CallRefused, ConfigurationError)) as caught:
        variants_of(vary)

    assert message in str(caught.value)


def test_a_sampler_does_not_choose_from_listed_variants() -> None:
    with pytest.raises(CallRefused, match="a sampler cannot choose from a list of variants"):
        variants_of([{"a.b": 1}], "lhs:4")


def test_every_sampler_of_the_table_is_one_of_scipy() -> None:
    assert set(SAMPLERS) == {f"{name}:64" for name in variants.SAMPLERS}
