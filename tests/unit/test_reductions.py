"""Reductions: how they are written, what each of them is, and what is refused."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fmu_mesh.api.result import Result
from fmu_mesh.errors import CallRefused, ConfigurationError, UnknownName
from fmu_mesh.results.recording import Columns
from fmu_mesh.sweeps.reductions import Reduction, check_reductions, read_reduction, reduced_value
from fmu_mesh.variables.value_types import VariableType

TIMES = [0.0, 0.5, 1.0, 2.0]


def result(values: Any, times: list[float] = TIMES) -> Result:  # noqa: ANN401  of any type
    return Result("run", columns=Columns(np.array(times), {"a.y": np.asarray(values)}))


def value(text: str, values: Any, times: list[float] = TIMES) -> Any:  # noqa: ANN401  of any type
    return reduced_value(read_reduction(text), result(values, times))


@pytest.mark.parametrize(
    ("text", "function", "variable", "time"),
    [
        ("max(pendulum.a)", "max", "pendulum.a", None),
        (" time_of_min ( pendulum.der(a,2) ) ", "time_of_min", "pendulum.der(a,2)", None),
        ("mean(a.y[1,2])", "mean", "a.y[1,2]", None),
        ("last(a.max(b), c))", "last", "a.max(b), c)", None),
        ("at(pendulum.a, 2.5)", "at", "pendulum.a", 2.5),
        ("at(a.der(y[1,2],2),1e-3)", "at", "a.der(y[1,2],2)", 0.001),
        ("at(a.y, -1)", "at", "a.y", -1.0),
    ],
)
def test_a_reduction_is_read_from_the_outside(text: str, function: str, variable: str, time: float | None) -> None:
    assert read_reduction(text) == Reduction(text.strip(), function, variable, time)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("maxi(pendulum.a)", "'maxi(pendulum.a)' is no reduction. Did you mean 'max(pendulum.a)'?"),
        ("pendulum.a", "Did you mean 'last(pendulum.a)'?"),
        ("max pendulum.a", "'max pendulum.a' is no reduction."),
        ("max(pendulum.a", "Did you mean 'max(pendulum.a)'?"),
        ("foo(x.y)", "There are: first, last, min, max, mean, std, rms, span, integral, time_of_min, time_of_max, at."),
        ("", "is no reduction"),
        ("max()", "'max()' names no variable. Name one, as in max(pendulum.a)."),
        ("at(pendulum.a)", "'at(pendulum.a)' has no time. Give it one in s, as in at(pendulum.a, 2.5)."),
        ("at(a.y[1,2])", "has no time"),
        ("at(, 2.5)", "names no variable"),
        ("at(a.y, nan)", "has no time"),
        ("__import__(a.y)", "is no reduction"),
    ],
)
def test_what_is_no_reduction_is_refused_with_the_nearest_one(text: str, message: str) -> None:
    with pytest.raises(ConfigurationError) as caught:
        read_reduction(text)

    assert message in str(caught.value)


@pytest.mark.parametrize(
    ("function", "expected"),
    [
        ("first", 1.0),
        ("last", 2.0),
        ("min", -3.0),
        ("max", 2.0),
        ("mean", 0.5),
        ("std", math.sqrt((0.25 + 2.25 + 12.25 + 2.25) / 4)),
        ("rms", math.sqrt((1 + 4 + 9 + 4) / 4)),
        ("span", 5.0),
        ("integral", 0.5 * 1.5 + 0.5 * -0.5 + 1.0 * -0.5),
        ("time_of_min", 1.0),
        ("time_of_max", 0.5),
    ],
)
def test_each_function_is_what_its_name_says(function: str, expected: float) -> None:
    made = value(f"{function}(a.y)", [1.0, 2.0, -3.0, 2.0])

    assert made == expected
    assert type(made) is float


@pytest.mark.parametrize(
    ("time", "expected"), [(-0.1, None), (0.0, 1.0), (0.49, 1.0), (0.5, 2.0), (1.99, 3.0), (2.0, 4.0), (9.0, 4.0)]
)
def test_at_is_the_value_of_the_last_row_that_is_not_later(time: float, expected: float | None) -> None:
    assert value(f"at(a.y, {time})", [1.0, 2.0, 3.0, 4.0]) == expected


@given(st.integers(0, 100_000), st.sampled_from([1e-3, 0.002, 0.01, 0.1, 0.3, 1 / 3]))
def test_at_finds_the_row_of_a_decimal_time_although_products_are_rounded(point: int, step_size: float) -> None:
    """For example 3 * 0.1 is above 0.3."""
    first = max(point - 2, 0)
    times = [k * step_size for k in range(first, point + 3)]

    written = float(f"{point * step_size:.12g}")
    shown = value(f"at(a.y, {written!r})", [float(k) for k in range(first, point + 3)], times)

    assert shown == point or abs(written - point * step_size) > 4 * math.ulp(written)


def test_values_keep_their_types() -> None:
    flags, numbers = np.array([False, True, False, True]), np.array([2, -(2**63), 2**63 - 1, 5])

    assert [value(f"{name}(a.y)", flags) for name in ("first", "min", "max", "span")] == [False, False, True, 1]
    assert value("max(a.y)", flags) is True
    assert value("mean(a.y)", flags) == 0.5
    assert value("time_of_max(a.y)", flags) == 0.5
    assert value("span(a.y)", numbers) == 2**64 - 1
    assert value("at(a.y, 1)", numbers) == 2**63 - 1
    assert type(value("last(a.y)", np.array([1, 2, 3, 4], np.uint8))) is int
    assert value("span(a.y)", np.array([1, 255, 3, 4], np.uint8)) == 254
    assert type(value("max(a.y)", np.array([1, 2, 3, 4], np.float32))) is float


def test_texts_and_bytes_have_a_first_a_last_and_value_at_time() -> None:
    texts, data = np.array(["p", "q", "r", "s"], object), np.array([b"\0", b"\1", b"\2", b"\xff"], object)

    assert [value(text, texts) for text in ("first(a.y)", "last(a.y)", "at(a.y, 0.5)")] == ["p", "s", "q"]
    assert value("last(a.y)", data) == "/w=="
    with pytest.raises(CallRefused, match=r"max\(a.y\): 'a.y' is a text. Texts have first, last and at."):
        value("max(a.y)", texts)


@pytest.mark.parametrize(
    "function", ["min", "max", "mean", "std", "rms", "span", "integral", "time_of_min", "time_of_max"]
)
def test_nan_in_a_row_that_counts_is_kept(function: str) -> None:
    assert math.isnan(value(f"{function}(a.y)", [1.0, math.nan, 2.0, 3.0]))
    assert value("last(a.y)", [1.0, math.nan, 2.0, 3.0]) == 3.0


def test_infinite_and_huge_values_need_no_warning() -> None:
    assert value("max(a.y)", [1.0, math.inf, 2.0, 3.0]) == math.inf
    assert value("rms(a.y)", [1e200, 1e200, 1e200, 1e200]) == math.inf
    assert math.isnan(value("mean(a.y)", [math.inf, -math.inf, 0.0, 0.0]))


@pytest.mark.parametrize(
    "text", ["last(a.y)", "max(a.y)", "mean(a.y)", "integral(a.y)", "at(a.y, 1)", "time_of_min(a.y)"]
)
def test_no_rows_have_no_value(text: str) -> None:
    assert value(text, np.zeros(0), []) is None


def test_the_sum_does_not_depend_on_where_the_values_lie() -> None:
    """Columns of a file that was read are strided; those of another format are not."""
    table = np.random.default_rng(1).normal(size=(20_001, 3))
    times = list(np.arange(20_001) * 0.002)

    for text in ("mean(a.y)", "std(a.y)", "rms(a.y)", "integral(a.y)"):
        assert value(text, table[:, 1], times) == value(text, table[:, 1].copy(), times)


def test_one_row_has_all_values() -> None:
    functions = ("first", "min", "max", "mean", "std", "rms", "span", "integral", "time_of_max")
    made = [value(f"{name}(a.y)", [3.0], [0.5]) for name in functions]
    assert made == [3.0, 3.0, 3.0, 3.0, 0.0, 3.0, 0.0, 0.0, 0.5]


def test_a_variable_that_was_not_recorded_is_an_unknown_name() -> None:
    with pytest.raises(UnknownName, match=r"Did you mean 'a.y'\?"):
        value("max(a.z)", [1.0, 2.0, 3.0, 4.0])


def test_all_findings_about_reductions_come_at_once() -> None:
    texts = ["max(pendulum.b)", "mean(log.message)", "last(log.message)", "max(pendulum.a)", "max(pendulum.a)"]
    types: dict[str, VariableType] = {"pendulum.a": "Float64", "log.message": "String"}

    with pytest.raises(ConfigurationError) as caught:
        check_reductions([read_reduction(text) for text in texts], types)

    unknown, *others = map(str, caught.value.findings)
    assert unknown.startswith("reductions: max(pendulum.b): 'pendulum.b', which is not recorded; expected one of ")
    assert unknown.endswith("pendulum.a, log.message. Did you mean 'pendulum.a'?")
    assert others == [
        "reductions: mean(log.message): 'log.message', which is a text; expected first, last or at",
        "reductions: max(pendulum.a): the same reduction a second time; expected each once",
    ]


def test_reductions_that_can_be_made_are_accepted() -> None:
    check_reductions([read_reduction("max(pendulum.a)"), read_reduction("min(pendulum.a)")], {"pendulum.a": "Float64"})


def test_a_reduction_of_a_file_is_that_of_the_run(tmp_path: Path) -> None:
    path = tmp_path / "run.csv"
    path.write_text('time,a.y,a.n\n0.0,1.5,"x"\n0.5,-2.5,"y"\n', encoding="utf-8")

    assert reduced_value(read_reduction("min(a.y)"), Result.read(path)) == -2.5
    assert reduced_value(read_reduction("last(a.n)"), Result.read(path)) == "y"
