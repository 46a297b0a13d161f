"""What is recorded into which file: names and patterns, points, and what is said about those that do not fit."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fmu_mesh.config.findings import Findings
from fmu_mesh.config.loading import LoadedConfig, read_text
from fmu_mesh.errors import ConfigurationError
from fmu_mesh.instances.configuration import examine_data
from fmu_mesh.results.formats import result_endings
from fmu_mesh.run.options import PlanOptions
from fmu_mesh.run.overriding import with_options
from fmu_mesh.system.records import RecordPlan
from fmu_mesh.variables.model_description import ModelDescription, Variable
from tests.planning import parse
from tests.unit.test_system import ARRAYS, DESCRIPTIONS, FILE, built, checked, findings_of, text

ENDINGS = " or ".join(result_endings())
OUTPUTS = ["pendulum.a", "pendulum.der(a,2)", "pendulum.count", "pendulum.flag", "pendulum.mode", "delay.y"]


def columns(variables: str) -> list[str]:
    """What a section `record` with these variables records."""
    return [".".join(column) for column in built(text(rest=f"record: {{variables: {variables}}}")).recorded]


@pytest.mark.parametrize(
    ("variables", "expected"),
    [
        ("['*']", OUTPUTS),
        ("['out:*']", OUTPUTS),
        ("['pendulum.*']", OUTPUTS[:-1]),
        ("['*.a', '*.y']", ["pendulum.a", "delay.y"]),
        ("['?elay.?']", ["delay.y"]),
        ("['*(a,2)']", ["pendulum.der(a,2)"]),
        ("['in:*']", ["delay.x", "delay.body[1].u", "delay.i", "delay.b", "delay.e"]),
        ("['in:delay.x']", ["delay.x"]),
        ("['in:*[1]*']", ["delay.body[1].u"]),
        ("['local:*']", ["pendulum.body[1].x"]),
        ("['param:pendulum.?']", ["pendulum.l", "pendulum.n"]),
        ("['re:.*[ay]']", ["pendulum.a", "delay.y"]),
        (r"['in:re:delay\.[a-f]']", ["delay.b", "delay.e"]),
        ("['re:(?i)DELAY.*']", ["delay.y"]),
    ],
)
def test_a_pattern_matches_whole_names_of_one_causality(variables: str, expected: list[str]) -> None:
    assert columns(variables) == expected


def test_a_variable_of_any_causality_and_type_is_recorded_by_its_name() -> None:
    names = ["delay.x", "pendulum.l", "pendulum.body[1].x", "pendulum.pi", "pendulum.name", "delay.s"]

    assert columns(str(names)) == names


def test_what_several_patterns_match_is_recorded_once_at_its_first_place() -> None:
    assert columns("[delay.y, '*.a', 'p*.a', 'delay.*', pendulum.a, pendulum.l]") == [
        "delay.y",
        "pendulum.a",
        "pendulum.l",
    ]


def test_a_pattern_matches_arrays_as_a_whole() -> None:
    loaded = parse(text(rest="record: {variables: ['delay.y*', delay.data]}"), FILE)

    recorded = checked(loaded, ARRAYS).recorded

    assert [name for _, name in recorded] == [*(f"y[{i},{j}]" for i in (1, 2) for j in (1, 2, 3)), "data"]


@pytest.mark.parametrize(
    ("variables", "expected"),
    [
        ("['delai.*']", ("'delai.*', which matches no output; expected a pattern for one of "
         f"{', '.join(OUTPUTS)}. Did you mean 'delay.y'?")),
        ("['pendulum.cuont*']", ("'pendulum.cuont*', which matches no output; expected a pattern for one of "
         f"{', '.join(OUTPUTS)}. Did you mean 'pendulum.count'?")),
        ("['*.x']", ("'*.x', which matches no output; expected a pattern for inputs, as it matches some. "
         "Did you mean 'in:*.x'?")),
        ("['in:*.l']", ("'in:*.l', which matches no input; expected a pattern for parameters, as it matches some. "
         "Did you mean 'param:*.l'?")),
        ("['*.nam?']", ("'*.nam?', which matches no output; expected each String and Binary by its whole name. "
         "Did you mean 'pendulum.name'?")),
        ("['re:(']", ("'re:(' (missing ), unterminated subpattern at position 0); expected a regular expression of "
         "Python after `re:`")),
        ("[pendulum.time]", ("'pendulum.time', the independent variable; expected another variable: its values are in "
         "the column time")),
        ("[pendulum.lable]", ("the unknown variable 'lable' of instance 'pendulum'; expected one of the 14 variables "
         "of 'pendulum'. Did you mean 'label'?")),
    ],
)  # fmt: skip
def test_what_matches_nothing_is_a_finding_with_what_is_near(variables: str, expected: str) -> None:
    assert findings_of(text(rest=f"record: {{variables: {variables}}}")) == [f"7: record.variables[0]: {expected}"]


def test_a_mesh_without_such_variables_is_told_as_such() -> None:
    loaded = parse(text(rest="record: {variables: ['local:*']}"), FILE)

    with pytest.raises(ConfigurationError, match="this mesh has no local variables with numbers"):
        checked(loaded, dict.fromkeys(DESCRIPTIONS, DESCRIPTIONS["delay"]))


def test_a_pattern_is_no_finding_where_a_model_is_not_known() -> None:
    loaded = parse(text(rest="record: {variables: ['*.zzz', delay.zzz]}"), FILE)
    broken = loaded.finding("instances.pendulum.fmu", "a broken file", "an FMU")

    with pytest.raises(ConfigurationError) as caught:
        checked(loaded, {"delay": DESCRIPTIONS["delay"]}, [broken])

    assert [finding.path for finding in caught.value.findings] == ["instances.pendulum.fmu", "record.variables[1]"]


def test_each_section_is_a_file_with_its_own_variables_and_points() -> None:
    system = built(
        text(
            rest="record: [{}, {file: a.mcap, variables: [delay.y], every: 3}, {file: null}, {file: no.csv, "
            "variables: []}, {file: /b.csv, from: 0.25, every: 2, variables: [delay.x, delay.y]}]"
        )
    )

    assert system.records == (
        RecordPlan("/models/configs/results/pair.csv", system.records[0].variables),
        RecordPlan("/models/configs/a.mcap", (("delay", "y"),), every=3),
        RecordPlan("/b.csv", (("delay", "x"), ("delay", "y")), first=3, every=2),
    )
    assert [".".join(column) for column in system.recorded] == [*OUTPUTS, "delay.x"]
    assert system.result_file == "/models/configs/results/pair.csv"


def test_an_empty_list_records_nothing() -> None:
    system = built(text(rest="record: []"))

    assert (system.records, system.recorded, system.result_file) == ((), (), None)


@pytest.mark.parametrize(
    ("start", "first"), [(-1.0, 0), (0.0, 0), (0.05, 1), (0.1, 1), (0.3, 3), (0.30000001, 4), (1.0, 10)]
)
def test_the_first_row_is_at_the_first_point_from_its_time_on(start: float, first: int) -> None:
    assert built(text(rest=f"record: {{from: {start}}}")).records[0].first == first


SECTIONS = [
    ("{every: 0}", "record.every: 0; expected a whole number >= 1"),
    ("{every: 1.5}", "record.every: 1.5; expected a whole number >= 1"),
    ("{from: 1.01}", "record.from: 1.01 s, after the last communication point; expected a time up to 1"),
    ("{from: soon}", "record.from: 'soon'; expected a finite number or null"),
    ("[{}, {file: results/pair.csv}]",
     "record[1].file: 'results/pair.csv', which is also the file of record[0]; expected a file of its own"),
    ("[{}, {file: a.csv}, {file: ../configs/a.csv}]",
     "record[2].file: '../configs/a.csv', which is also the file of record[1]; expected a file of its own"),
    ("[{}, {file: a.xlsx}]",
     f"record[1].file: 'a.xlsx', a format that is not written; expected a name ending in {ENDINGS}"),
    ("[{file: a.csv}, {evry: 2}]", ("record[1].evry: an unknown key; expected one of file, variables, every, from. "
     "Did you mean 'every'?")),
    ("a.csv", "record: 'a.csv'; expected a mapping with file, variables, every, from"),
    ("[a.csv]", "record[0]: 'a.csv'; expected a mapping with file, variables, every, from"),
]  # fmt: skip


@pytest.mark.parametrize(("section", "expected"), SECTIONS)
def test_a_wrong_section_is_a_finding(section: str, expected: str) -> None:
    loaded, findings = examined(f"record: {section}")

    with pytest.raises(ConfigurationError) as caught:
        checked(loaded, DESCRIPTIONS, findings)

    assert [str(finding).removeprefix(f"{FILE}:") for finding in caught.value.findings] == [f"7: {expected}"]


def test_what_is_right_in_a_list_is_checked_beside_what_is_wrong() -> None:
    loaded, findings = examined("record: [3, {file: a.csv, evry: 2}, {file: a.csv, variables: [delay.z]}]")

    with pytest.raises(ConfigurationError) as caught:
        checked(loaded, DESCRIPTIONS, findings)

    assert [finding.path for finding in caught.value.findings] == [
        "record[0]",
        "record[1].evry",
        "record[2].variables[0]",
        "record[2].file",
    ]


def test_an_unknown_ending_in_a_list_is_warned_of() -> None:
    (warning,) = built(text(rest="record: [{}, {file: a.xyz}]")).warnings

    assert warning.path == "record[1].file"
    assert "'a.xyz', an ending of no installed format" in warning.found


@given(st.integers(0, 30), st.integers(1, 12), st.integers(0, 60), st.integers(0, 60))
def test_the_rows_of_some_points_are_those_whose_points_are_selected(
    first: int, every: int, start: int, count: int
) -> None:
    plan = RecordPlan("", (), first, every)
    selected = [point for point in range(200) if point >= first and (point - first) % every == 0]

    rows = np.arange(start, start + count)[plan.rows_within(start, start + count)].tolist()

    assert rows == [point for point in selected if start <= point < start + count]
    assert plan.rows_before(start) == len([point for point in selected if point < start])
    assert [plan.point_of(row) for row in range(5)] == selected[:5]


@pytest.mark.parametrize(
    ("record", "files"),
    [
        ("{file: a.csv}", ["/out.csv"]),
        ("{file: null}", ["/out.csv"]),
        ("[{file: a.csv, every: 2}, {file: b.csv}]", ["/out.csv", "/models/configs/b.csv"]),
        ("[]", ["/out.csv"]),
    ],
)
def test_an_output_replaces_the_first_file(record: str, files: list[str]) -> None:
    loaded, findings = examined(f"record: {record}", PlanOptions(output=Path("/out.csv")))

    system = checked(loaded, DESCRIPTIONS, findings)

    assert [own.file for own in system.records] == files
    assert system.records[0].every == (2 if "every" in record else 1)


def test_a_wrong_output_is_a_finding_about_the_option() -> None:
    loaded, findings = examined("record: [{file: a.csv}, {file: b.csv}]", PlanOptions(output=Path("/out.xlsx")))

    with pytest.raises(ConfigurationError, match=r"`output='/out\.xlsx'`: '/out.xlsx', a format that is not written"):
        checked(loaded, DESCRIPTIONS, findings)


def test_of_what_stays_in_memory_there_is_one() -> None:
    loaded, findings = examined(
        "record: [{file: a.csv, variables: [delay.y]}, {file: b.csv}]", PlanOptions(output="/run/rows.arrays")
    )

    assert [own.variables for own in checked(loaded, DESCRIPTIONS, findings).records] == [(("delay", "y"),)]


def without_outputs(count: int, *, states: tuple[str, ...] = ()) -> ModelDescription:
    """A model with so many locals that change, a constant before them, and a name and an input that are no result."""
    variables = (
        Variable("one", 0, "Float64", "local", "constant", start=1.0),
        *(Variable(f"x{number}", number, "Float64", "local", "continuous") for number in range(count)),
        Variable("word", 0, "String", "local", "discrete"),
        Variable("u", 999, "Float64", "input", "continuous", start=0.0),
    )
    return ModelDescription("m", "m", "2.0", "co_simulation", "{1}", variables, states=states)


def recorded_of(model: ModelDescription, rest: str = "") -> tuple[list[str], list[str]]:
    """The columns and the warnings of a mesh whose `delay` is this model."""
    system = checked(parse(text(rest=rest), FILE), {"pendulum": DESCRIPTIONS["pendulum"], "delay": model})
    columns = [".".join(column) for column in system.recorded if column[0] == "delay"]
    return columns, [str(warning).removeprefix(f"{FILE}:") for warning in system.warnings]


def test_the_continuous_states_are_recorded_of_an_instance_without_outputs() -> None:
    columns, warnings = recorded_of(without_outputs(3, states=("x2", "x0")), "record: {file: a.csv}")

    assert columns == ["delay.x0", "delay.x2"]
    (warning,) = warnings
    assert warning == (
        "7: record.variables: no outputs with numbers, so others are recorded: of delay its continuous states (2); "
        "expected `local:delay.*` in this list for all locals"
    )


def test_without_states_the_first_hundred_locals_that_change_are_recorded() -> None:
    columns, warnings = recorded_of(without_outputs(120))
    few, _ = recorded_of(without_outputs(2))

    assert columns == [f"delay.x{number}" for number in range(100)]
    assert "of delay the first 100 of its locals that change (120)" in warnings[0]
    assert few == ["delay.x0", "delay.x1"]


def test_a_chosen_list_is_recorded_as_it_is() -> None:
    columns, warnings = recorded_of(without_outputs(3), "record: {variables: [delay.x1]}")

    assert (columns, warnings) == (["delay.x1"], [])


@pytest.mark.parametrize("output", [None, Path("/out.csv")])
def test_a_named_file_without_columns_is_a_finding(output: Path | None) -> None:
    loaded, findings = examined(
        "record: {file: a.csv}" if output is None else "record: {variables: []}", PlanOptions(output=output)
    )
    nothing = without_outputs(0)

    with pytest.raises(ConfigurationError, match="into which nothing is recorded; expected variables in"):
        checked(loaded, {"pendulum": nothing, "delay": nothing}, findings)


@pytest.mark.parametrize("record", ["", "record: {every: 2}"])
def test_a_file_that_nobody_named_and_that_gets_nothing_is_a_warning(record: str) -> None:
    nothing = without_outputs(0)

    system = checked(parse(text(rest=record), FILE), {"pendulum": nothing, "delay": nothing})

    assert system.records == ()
    assert [warning.found for warning in system.warnings] == [
        "nothing is recorded: there are no outputs, states or locals with numbers"
    ]


def test_what_stays_in_memory_may_be_nothing() -> None:
    loaded, findings = examined("record: {variables: []}", PlanOptions(output="/run/rows.arrays"))

    assert checked(loaded, DESCRIPTIONS, findings).records == ()


def examined(rest: str, options: PlanOptions | None = None) -> tuple[LoadedConfig, Findings]:
    return examine_data(with_options(read_text(text(rest=rest), FILE), options or PlanOptions()))
