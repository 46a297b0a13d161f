"""Two results side by side: which values are equal, which rows belong together, and what is told of a difference."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fmu_mesh.api.compared_rows import Side, compared
from fmu_mesh.api.mesh_builder import Mesh, load
from fmu_mesh.api.result import Result
from fmu_mesh.cli.main import main
from fmu_mesh.errors import CallRefused, ConfigurationError
from fmu_mesh.instances.python.unit_names import base_unit_of
from fmu_mesh.results.recording import Columns

ROOT = Path(__file__).parents[2]
NAN, INF = math.nan, math.inf

Values = Mapping[str, Sequence[Any]]


def result(columns: Values, *, step: float = 0.5, start: float = 0.0) -> Result:
    """A result whose rows are ``step`` s apart."""
    arrays = {
        name: np.array(values, object if isinstance(values[0], str | bytes) else None) if len(values) else np.zeros(0)
        for name, values in columns.items()
    }
    count = len(next(iter(arrays.values())))
    return Result("made", columns=Columns(start + step * np.arange(count, dtype=np.float64), arrays))


def side(values: Sequence[float], unit: str | None, title: str) -> Side:
    """A result with one variable `a.u`."""
    columns = Columns(np.arange(len(values), dtype=np.float64), {"a.u": np.array(values)})
    return Side(
        title,
        ["a.u"],
        lambda: iter([columns]),
        lambda: columns,
        lambda _: unit,
        lambda _: base_unit_of(unit) if unit else None,
        lambda row, _: row,
    )


@pytest.mark.parametrize(
    ("here", "there", "rows"),
    [
        ([1.0, NAN], [1.0, NAN], 0),
        ([1.0, NAN], [1.0, 2.0], 1),
        ([0.0, -0.0], [-0.0, 0.0], 0),
        ([INF, -INF], [INF, INF], 1),
        ([1.0], [1.0 + 2.0**-52], 1),
        ([True, False], [True, True], 1),
        ([1, 2], [1.0, 2.0], 0),
        ([1, 2], [1.0, 2.5], 1),
        ([2**62, 2**62], [2**62, 2**62 + 1], 1),
        (["x", ""], ["x", "y"], 1),
        ([b"\0", b"a"], [b"\0", b"a"], 0),
        (["x", "y"], [1.0, 2.0], 2),
        ([0, 1], [False, True], 0),
    ],
    ids=str,
)
def test_by_default_values_are_equal_if_they_are_the_same(here: list[Any], there: list[Any], rows: int) -> None:
    comparison = result({"a.y": here}).compare(result({"a.y": there}))

    assert comparison.equal == (rows == 0)
    assert bool(comparison) == comparison.equal
    assert sum(difference.rows for difference in comparison.differences.values()) == rows


def test_the_first_difference_has_time_point_variable_and_both_values() -> None:
    here = result({"a.x": [1.0, 2.0, 3.0], "a.y": [1, 2, 3], "a.s": ["p", "q", "r"]})
    there = result({"a.x": [1.0, 2.0, 4.0], "a.y": [1, 5, 3], "a.s": ["p", "q", "s"]})

    comparison = here.compare(there)

    first = comparison.first
    assert first is not None
    assert (first.time, first.point, first.variable, first.here, first.there, first.difference) == (
        0.5, 1, "a.y", 2, 5, -3.0,
    )  # fmt: skip
    assert "first at t = 0.5 s, point 1: a.y: 2 in this result, 5 in the other one" in comparison.text


def test_of_each_variable_the_largest_differences_and_their_times_are_told() -> None:
    here = result({"a.y": [1.0, 100.0, 3.0, 4.0], "a.z": [1.0] * 4})
    there = result({"a.y": [1.5, 90.0, 3.0, 4.0], "a.z": [1.0] * 4})

    comparison = here.compare(there)

    assert [*comparison.differences] == ["a.y"]
    own = comparison.differences["a.y"]
    assert (own.rows, own.largest, own.at, own.relative, own.relative_at) == (2, 10.0, 0.5, 0.5 / 1.5, 0.0)
    assert "differ: 1 of 2 variables" in comparison.text


def test_a_tolerance_is_absolute_plus_relative_to_the_larger_value() -> None:
    here, there = result({"a.y": [100.0, 0.0]}), result({"a.y": [110.0, 0.001]})

    assert not here.compare(there, rtol=0.09)
    assert not here.compare(there, rtol=0.1)
    assert here.compare(there, rtol=0.1, atol=0.001)
    assert there.compare(here, rtol=0.1, atol=0.001)
    within = here.compare(there, rtol=0.1, atol=0.001)
    assert (within.differences["a.y"].rows, within.differences["a.y"].largest, within.first) == (0, 10.0, None)
    assert within.text.startswith("this result and the other one are equal within rtol 0.1, atol 0.001")


@pytest.mark.parametrize("there", [[NAN, 1.0], [INF, 1.0], [-INF, 1.0]])
def test_no_tolerance_covers_what_is_no_number(there: list[float]) -> None:
    comparison = result({"a.y": [1.0, 1.0]}).compare(result({"a.y": there}), rtol=1.0, atol=1e300)

    assert comparison.differences["a.y"].rows == 1
    assert comparison.differences["a.y"].note == "infinite or NaN in one"


def test_truth_values_have_no_tolerance() -> None:
    assert not result({"a.on": [True]}).compare(result({"a.on": [False]}), atol=5.0)


@pytest.mark.parametrize("name", ["rtol", "atol"])
@pytest.mark.parametrize("value", [-1.0, NAN])
def test_a_tolerance_that_is_none_is_refused(name: str, value: float) -> None:
    tolerances = {"rtol": 0.0, "atol": 0.0, name: value}
    with pytest.raises(CallRefused, match=f"{name} is .*, and a tolerance is a number of 0 or more"):
        result({"a.y": [1.0]}).compare(result({"a.y": [1.0]}), rtol=tolerances["rtol"], atol=tolerances["atol"])


def test_variables_that_only_one_has_are_a_difference() -> None:
    comparison = result({"a.x": [1.0], "a.y": [1.0]}).compare(result({"a.y": [1.0], "a.z": [1.0]}))

    assert not comparison.equal
    assert (comparison.only_here, comparison.only_there, comparison.compared) == (("a.x",), ("a.z",), ("a.y",))
    assert "2 variables only in one" in comparison.text
    assert "only in this result: a.x" in comparison.text


def test_only_the_chosen_variables_are_compared() -> None:
    here = result({"a.x": [1.0], "b.y[1]": [1.0], "b.y[2]": [2.0], "c.z": [3.0]})
    there = result({"a.x": [9.0], "b.y[1]": [1.0], "b.y[2]": [2.0], "c.z": [3.0]})

    for chosen in (["b.y"], ["b.*", "c.?"], ["re:[bc]\\..*"]):
        assert here.compare(there, variables=chosen).equal
    assert here.compare(there, variables=["?.x"]).compared == ("a.x",)
    with pytest.raises(ConfigurationError, match=r"has no variable 'b\.z\*'"):
        here.compare(there, variables=["b.z*"])
    with pytest.raises(ConfigurationError, match=r"is no regular expression"):
        here.compare(there, variables=["re:("])


# --- rows


def test_one_row_more_is_a_difference_in_the_span_of_time() -> None:
    short, long_ = result({"a.y": [1.0, 2.0]}), result({"a.y": [1.0, 2.0, 3.0]})

    comparison = short.compare(long_)

    assert (comparison.equal, comparison.rows, comparison.matching) == (False, 2, "same")
    assert (comparison.rows_only_here, comparison.rows_only_there, comparison.first) == (0, 1, None)
    assert "differ: the span of time" in comparison.text
    assert long_.compare(short).rows_only_here == 1


def test_rows_before_the_first_one_of_the_other_are_a_difference() -> None:
    comparison = result({"a.y": [1.0, 2.0, 3.0]}).compare(result({"a.y": [2.0, 3.0]}, start=0.5))

    assert (comparison.rows, comparison.rows_only_here, comparison.first) == (2, 1, None)


def test_of_a_finer_grid_the_rows_at_the_same_times_are_compared() -> None:
    coarse = result({"a.y": [0.0, 0.25, 0.5, 1.0]}, step=0.3)
    fine = result({"a.y": [0.0, 9.0, 9.0, 0.25, 9.0, 9.0, 0.5, 9.0, 9.0, 2.0]}, step=0.1)

    for comparison in (coarse.compare(fine), fine.compare(coarse)):
        assert (comparison.matching, comparison.rows) == ("common", 4)
        assert comparison.differences["a.y"].rows == 1
        assert comparison.first is not None
        assert comparison.first.time == pytest.approx(0.9)
        assert "compared at the 4 times that both have" in comparison.text
        assert comparison.rows_only_here == comparison.rows_only_there == 0


def test_times_that_differ_by_rounding_are_the_same() -> None:
    summed = Columns(np.cumsum([0.1] * 50) - 0.1, {"a.y": np.arange(50.0)})
    multiplied = result({"a.y": range(50)}, step=0.1)

    assert not np.array_equal(summed.times, multiplied.times)
    assert multiplied.compare(Result("summed", columns=summed)).matching == "same"


def test_without_common_times_floats_are_interpolated_and_others_hold() -> None:
    here = Result("here", columns=Columns(np.array([0.5, 1.5]), {"a.y": np.array([1.0, 3.0]), "a.n": np.array([1, 2])}))
    there = result({"a.y": [0.0, 2.0, 4.0], "a.n": [1, 2, 3]}, step=1.0)

    comparison = here.compare(there)

    assert (comparison.matching, comparison.equal, comparison.rows) == ("interpolated", True, 2)
    assert "made is interpolated: floats linearly, others held" in comparison.text


def test_grids_that_only_overlap_are_interpolated_but_exact_at_common_times() -> None:
    here = result({"a.y": [0.1, 1.7, 0.3, 1.1]}, step=0.3)
    there = result({"a.y": [0.1, 7.0, 7.0, 0.3, 7.0]}, step=0.2)

    comparison = here.compare(there)

    assert (comparison.matching, comparison.rows) == ("interpolated", 3)
    assert comparison.differences["a.y"].rows == 1


def test_results_without_rows_are_equal_and_differ_from_one_with_rows() -> None:
    empty, one = result({"a.y": []}), result({"a.y": [1.0]})

    assert empty.compare(empty).equal
    assert empty.compare(one).rows_only_there == 1
    assert one.compare(empty).rows_only_here == 1
    assert one.compare(one).equal


@given(
    st.lists(st.integers(0, 60), min_size=1, max_size=30, unique=True),
    st.lists(st.integers(0, 60), min_size=1, max_size=30, unique=True),
)
def test_parts_of_one_curve_are_equal_wherever_their_rows_lie(first: list[int], second: list[int]) -> None:
    """A straight line is the same at any times, interpolated or not."""
    sides = [
        Result(
            f"part {n}", columns=Columns(np.array(sorted(ticks), float), {"a.y": 3.0 * np.array(sorted(ticks), float)})
        )
        for n, ticks in enumerate((first, second))
    ]

    comparison = sides[0].compare(sides[1], rtol=1e-12)

    assert comparison.first is None
    assert comparison.rows + comparison.rows_only_here <= len(first)


# --- units


def test_values_in_another_unit_are_converted() -> None:
    comparison = compared(side([1.0, 2.0], "m", "a"), side([1000.0, 2500.0], "mm", "b"), ["a.u"])

    own = comparison.differences["a.u"]
    assert (own.rows, own.largest, own.unit, own.note) == (1, 0.5, "m", "converted from mm")
    assert comparison.first is not None
    assert (comparison.first.there, comparison.first.difference) == (2.5, -0.5)


def test_temperatures_are_converted_with_their_offset() -> None:
    assert compared(side([273.15], "K", "a"), side([0.0], "degC", "b"), ["a.u"]).equal


def test_units_of_different_dimensions_are_never_equal() -> None:
    comparison = compared(side([1.0], "m", "a"), side([1.0], "rad", "b"), ["a.u"], atol=10.0)

    assert comparison.differences["a.u"].rows == 1
    assert comparison.differences["a.u"].note == "m in a, rad in b"
    assert comparison.first is not None
    assert comparison.first.difference is None


@pytest.mark.parametrize(("unit", "other"), [("m", None), (None, "rad"), (None, None), ("N.m", "kg.m2/s2")])
def test_values_are_taken_as_they_are_where_unit_is_missing_or_same(unit: str | None, other: str | None) -> None:
    assert compared(side([1.0], unit, "a"), side([1.0], other, "b"), ["a.u"]).equal


def test_a_unit_without_a_definition_is_told_and_not_converted() -> None:
    comparison = compared(side([1.0], "furlong", "a"), side([2.0], "m", "b"), ["a.u"])
    assert comparison.differences["a.u"].note == "not converted: m in b"


# --- runs and files


def pendulum(**options: Any) -> Result:  # noqa: ANN401  as `Mesh.run` has them
    mesh: Mesh = load(ROOT / "configs" / "pendulum_delay.yaml")
    return mesh.run(**{"stop_time": 1.0, "record": "memory", "processes": False, **options})


def test_run_is_equal_to_itself_and_its_first_difference_has_its_point() -> None:
    one = pendulum()
    other = pendulum(start_values={"delay.d": 0.5})

    assert one.compare(pendulum()).equal
    first = one.compare(other).first
    assert first is not None
    assert (first.variable, first.point, first.time) == ("delay.y", 251, one.times[251])


def test_a_run_with_half_the_step_is_compared_at_common_times() -> None:
    comparison = pendulum().compare(pendulum(step_size=0.001), atol=1e-9)

    assert (comparison.matching, comparison.rows) == ("common", 501)


def test_the_picture_has_both_results_and_their_difference() -> None:
    figure = pendulum().compare(pendulum(start_values={"delay.d": 0.5})).plot()

    assert [axes.get_ylabel() for axes in figure.axes] == ["y in rad", "difference in rad"]
    legends = [axes.get_legend() for axes in figure.axes]
    assert [[text.get_text() for text in legend.get_texts()] for legend in legends if legend is not None] == [
        ["delay.y (no unit)", "pendulum_delay (1)", "pendulum_delay (2)"],
        ["delay.y (no unit)", "pendulum_delay (1) - pendulum_delay (2)"],
    ]


@pytest.fixture
def files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with three results, of which the first two are equal; it is the current folder."""
    (tmp_path / "a.csv").write_text('time,p.a,p.n,p.on,p.s\n0.0,1.0,1,true,"x"\n0.1,2.0,2,false,"y"\n')
    (tmp_path / "same.csv").write_text('time,p.a,p.n,p.on,p.s\n0.0,1e0,1,true,"x"\n0.1,2.000,2,false,"y"\n')
    (tmp_path / "b.csv").write_text('time,p.a,p.n,p.on,p.s\n0.0,1.0,1,true,"x"\n0.1,2.5,2,true,"z"\n')
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.usefixtures("files")
def test_the_command_ends_with_0_for_equal_results(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["compare", "a.csv", "same.csv"]) == 0
    assert capsys.readouterr().out == "a.csv and same.csv are equal: 4 variables, 2 rows\n"


@pytest.mark.usefixtures("files")
def test_the_command_ends_with_1_for_different_results_and_shows_where(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["compare", "a.csv", "b.csv"]) == 1
    assert capsys.readouterr().out == (
        "a.csv and b.csv differ: 3 of 4 variables\n"
        "first at t = 0.1 s, point 1: p.a: 2.0 in a.csv, 2.5 in b.csv\n"
        "\n"
        "variable  rows    largest difference  at     relative  at\n"
        "p.a       1 of 2  0.5                 0.1 s  0.2       0.1 s\n"
        "p.on      1 of 2  1                   0.1 s  1         0.1 s\n"
        "p.s       1 of 2\n"
    )


@pytest.mark.usefixtures("files")
@pytest.mark.parametrize(
    ("arguments", "code", "says"),
    [
        (["--variables", "p.a", "--atol", "0.5"], 0, "equal within atol 0.5"),
        (["--variables", "p.a", "--rtol", "0.19"], 1, "differ beyond rtol 0.19"),
        (["--variables", "p.*"], 1, "3 of 4 variables"),
        (["--variables", "p.b"], 2, "has no variable 'p.b'"),
        (["--atol", "-1"], 2, "--atol: -1 is not a number of 0 or more"),
        (["--rtol", "nan"], 2, "--rtol: nan is not a number of 0 or more"),
    ],
)
def test_the_command_takes_tolerances_and_variables(
    arguments: list[str], code: int, says: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["compare", "a.csv", "b.csv", *arguments]) == code
    printed = capsys.readouterr()
    assert says in (printed.err if code == 2 else printed.out)


@pytest.mark.usefixtures("files")
def test_a_missing_file_is_wrong_usage_and_no_difference(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["compare", "a.csv", "c.csv"]) == 2
    assert "the result file 'c.csv' cannot be read" in capsys.readouterr().err


@pytest.mark.usefixtures("files")
@pytest.mark.parametrize(("other", "code"), [("same.csv", 0), ("b.csv", 1)])
def test_the_command_answers_programs_in_json(other: str, code: int, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["compare", "a.csv", other, "--json"]) == code

    answer = json.loads(capsys.readouterr().out)
    assert (answer["equal"], answer["exit_code"], answer["rows"]) == (code == 0, code, 2)
    assert sorted(answer["differences"]) == (["p.a", "p.on", "p.s"] if code else [])
    if code:
        assert answer["first"] == {
            "time": 0.1, "point": 1, "variable": "p.a", "here": 2.0, "there": 2.5, "difference": -0.5,
        }  # fmt: skip
        assert answer["differences"]["p.a"]["largest"] == 0.5


def test_the_command_draws_what_differs_most(files: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for other in ("b.csv", "same.csv"):
        assert main(["compare", "a.csv", other, "--plot", f"{other}.svg"]) == (other == "b.csv")
        assert f"plot: {other}.svg" in capsys.readouterr().out

    assert "difference" in (files / "b.csv.svg").read_text()


@pytest.mark.usefixtures("files")
def test_quiet_only_has_the_exit_code(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["compare", "a.csv", "b.csv", "-q"]) == 1
    assert capsys.readouterr().out == ""
