"""Every type of every FMI version through the calls of an instance, with the values at the ends of its range."""

from __future__ import annotations

import math
import re
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fmu_mesh import FMIAdapter
from fmu_mesh.errors import CallRefused, InitializationFailed, LoadFailed, StepFailed, TerminationRequested
from fmu_mesh.instances.fmi.archive.reading import read_description
from fmu_mesh.instances.fmi.fmu_instance import FmuInstance
from fmu_mesh.instances.fmi.opening import open_instance
from fmu_mesh.rings.ring import Ring
from fmu_mesh.simtime import TimeGrid
from fmu_mesh.system.layout import Layout
from fmu_mesh.variables.value_types import INTEGERS, VariableType
from tests.fmus.helpers import NO_COMPILER, build_test_fmu
from tests.fmus.packing import repacked

pytestmark = pytest.mark.skipif(NO_COMPILER is not None, reason=str(NO_COMPILER))

GRID = TimeGrid(0.0, 0.25, 8)
INT32 = INTEGERS["Int32"]
ENDS: dict[VariableType, list[Any]] = {
    "Float64": [5e-324, -1.7976931348623157e308, math.inf, -math.inf, -0.0, 0.1],
    "Float32": [1.401298464324817e-45, -3.4028234663852886e38, math.inf, -0.0, 0.10000000149011612],
    "Boolean": [True, False, True],
    "String": ["", "text", "ü\N{GRINNING FACE}\n\", ']["],
    "Binary": [b"", b"\0", bytes(range(256)), b"x" * 100_000],
    **{type_: [whole[0], whole[-1], 0] for type_, whole in INTEGERS.items()},
    "Enumeration": [INTEGERS["Int64"][0], 1, INTEGERS["Int64"][-1]],
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("types")


@pytest.fixture
def opened(request: pytest.FixtureRequest, folder: Path, tmp_path: Path) -> Iterator[FmuInstance]:
    path = build_test_fmu(request.param, folder)
    instance = open_instance(path, "it", read_description(path), tmp_path)
    yield instance
    instance.close()
    assert not list(tmp_path.iterdir())


def of(name: str) -> pytest.MarkDecorator:
    return pytest.mark.parametrize("opened", [name], indirect=True)


def through(instance: FmuInstance, pairs: dict[str, str], rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Bind rings with these (input, output) variables, and step once per row of inputs; returns the rows of outputs."""
    variables = {variable.name: variable for variable in instance.description.variables}
    inputs = Ring(Layout.of(variables[name] for name in pairs), 1)
    outputs = Ring(Layout.of(variables[name] for name in dict.fromkeys(pairs.values())), 4)
    instance.bind(inputs, [outputs], GRID, 1)
    got = []
    for step, row in enumerate(rows):
        for name, value in row.items():
            inputs.put(step, name, value)
        instance.do_step(step)
        got.append({name: outputs.value(step + 1, name) for name in pairs.values()})
    return got


def exactly(value: object) -> str:
    """A text that tells -0.0 from 0.0 and True from 1."""
    return repr(value)


@of("AllTypes3")
@pytest.mark.parametrize("type_", ENDS)
def test_every_type_of_fmi_3_goes_through_in_all_values(opened: FmuInstance, type_: VariableType) -> None:
    base = type_.lower()
    opened.enter_initialization(0.0, 2.0, {})
    opened.set_values({f"{base}_in": ENDS[type_][-1]})
    assert exactly(opened.get_values([f"{base}_out"])) == exactly([ENDS[type_][-1]])
    opened.exit_initialization()

    got = through(opened, {f"{base}_in": f"{base}_out"}, [{f"{base}_in": value} for value in ENDS[type_]])

    assert exactly([row[f"{base}_out"] for row in got]) == exactly(ENDS[type_])


@of("AllTypes3")
@pytest.mark.parametrize("type_", ENDS)
def test_arrays_have_the_size_of_their_structural_parameter(opened: FmuInstance, type_: VariableType) -> None:
    base = type_.lower()
    ends = (ENDS[type_] * 4)[:8]
    array = [ends[:4], ends[4:]]
    start: dict[str, Any] = {"columns": 4, f"{base}_array_in": array}
    if type_ == "Enumeration":
        start[f"{base}_in"] = "high"
    opened.enter_initialization(0.0, 2.0, start)
    variable = opened.description.variable(f"{base}_array_out")
    assert variable is not None
    assert variable.shape == (2, 4)
    assert exactly(opened.get_values([f"{base}_array_out", f"{base}_array_in"])) == exactly([array, array])
    opened.exit_initialization()
    turned = [array[1], array[0]]

    (got,) = through(
        opened,
        {f"{base}_in": f"{base}_out", f"{base}_array_in": f"{base}_array_out"},
        [{f"{base}_in": ends[1], f"{base}_array_in": turned}],
    )

    assert exactly(got) == exactly({f"{base}_out": ends[1], f"{base}_array_out": turned})


@of("AllTypes3")
def test_all_types_of_fmi_3_go_through_at_once(opened: FmuInstance) -> None:
    opened.enter_initialization(0.0, None, {})
    opened.exit_initialization()
    pairs = {f"{type_.lower()}_in": f"{type_.lower()}_out" for type_ in ENDS}
    rows = [{f"{type_.lower()}_in": ends[step] for type_, ends in ENDS.items()} for step in range(3)]

    got = through(opened, pairs, rows)

    expected = [{name.replace("_in", "_out"): value for name, value in row.items()} for row in rows]
    assert exactly(got) == exactly(expected)
    assert opened.get_values(["steps"]) == [3]


@of("AllTypes3")
def test_a_structural_parameter_changes_in_configuration_mode_only(opened: FmuInstance) -> None:
    opened.enter_initialization(0.0, None, {"columns": 8})

    with pytest.raises(InitializationFailed, match=r"fmi3SetUInt64 of columns returned error; the FMU says: value ref"):
        opened.set_values({"columns": 3})


@of("AllTypes1")
def test_every_type_of_fmi_1_goes_through_in_all_values(opened: FmuInstance) -> None:
    opened.enter_initialization(0.0, 2.0, {"real_parameter": 7.5, "string_parameter": "other", "integer_in": INT32[0]})
    opened.set_values({"real_in": 1.5})
    assert opened.get_values(["real_out", "integer_out", "string_parameter"]) == [1.5, INT32[0], "other"]
    opened.exit_initialization()
    rows = [
        {"real_in": -0.0, "integer_in": INT32[0], "boolean_in": True, "string_in": "ü\n"},
        {"real_in": 5e-324, "integer_in": INT32[-1], "boolean_in": False, "string_in": ""},
    ]

    got = through(opened, {name: name.replace("_in", "_out") for name in rows[0]}, rows)

    assert exactly(got) == exactly([{name.replace("_in", "_out"): v for name, v in row.items()} for row in rows])
    assert opened.get_values(["steps", "real_parameter"]) == [2, 7.5]


@of("AllTypes1")
def test_an_alias_of_fmi_1_has_value_and_negated_one_its_opposite(opened: FmuInstance) -> None:
    opened.enter_initialization(0.0, 2.0, {"boolean_in": True, "integer_in": 5})
    opened.exit_initialization()
    names = ["real_same", "real_opposite", "integer_same", "integer_opposite", "boolean_same", "boolean_opposite"]

    inputs = {"real_in_opposite": "real_out", "integer_in_opposite": "integer_opposite"}
    got = through(opened, inputs, [{"real_in_opposite": 2.5, "integer_in_opposite": 7}])

    assert exactly(got) == exactly([{"real_out": -2.5, "integer_opposite": 7}])
    assert exactly(opened.get_values(names)) == exactly([-2.5, 2.5, -7, 7, True, False])
    opened.set_values({"boolean_in_opposite": True})
    opened.advance(0.25, 0.25)
    assert opened.get_values(["boolean_same", "boolean_opposite"]) == [False, True]


@of("AllTypes1")
def test_the_opposite_of_the_smallest_integer_is_an_error(opened: FmuInstance) -> None:
    opened.enter_initialization(0.0, 2.0, {"integer_in": INT32[0]})
    opened.exit_initialization()

    with pytest.raises(StepFailed, match="integer_opposite cannot be read: -2147483648 has no opposite in its type"):
        opened.get_values(["integer_opposite"])


@of("AllTypes1")
def test_what_an_fmi_1_fmu_refuses_is_an_error_with_its_words(opened: FmuInstance) -> None:
    opened.enter_initialization(0.0, 2.0, {})
    opened.exit_initialization()

    with pytest.raises(StepFailed, match="fmiSetReal of real_parameter returned error; the FMU says: this value ref"):
        opened.set_values({"real_parameter": 1.0})


@of("AllTypes1")
def test_an_fmi_1_description_says_what_the_xml_says(opened: FmuInstance) -> None:
    by_name = {variable.name: variable for variable in opened.description.variables}

    assert opened.description.can_handle_variable_step_size
    assert {v.value_reference for v in by_name.values() if v.name.endswith("_in")} == {0}
    assert by_name["real_out"].dependencies == ("real_in",)
    assert (by_name["real_opposite"].negated, by_name["real_same"].negated) == (True, False)
    assert by_name["real_parameter"].settable_before_start
    assert not by_name["steps"].settable_before_start
    assert (by_name["real_in"].type, by_name["real_in"].type_name) == ("Float64", "Real")


@of("Events3")
def test_a_step_that_returns_early_is_finished_with_its_events(opened: FmuInstance) -> None:
    opened.enter_initialization(0.0, 2.0, {"interval": 0.0625})
    opened.exit_initialization()
    inputs = Ring(Layout.of([("u", "Float64")]), 4)
    outputs = Ring(Layout.of([("x", "Float64"), ("y", "Float64"), ("v", "Float64")]), 4)
    opened.bind(inputs, [outputs], GRID, 1)

    rows = []
    for step in range(3):
        inputs.put(step, "u", 10.0 + step)
        opened.do_step(step)
        rows.append(outputs.part("Float64")[(step + 1) & 3].tolist())

    assert rows == [[0.25, 4.0, 10.0], [0.5, 8.0, 11.0], [0.75, 12.0, 12.0]]
    opened.set_values({"u": -1.0, "interval": 1.0})
    opened.advance(0.75, 0.5)
    assert opened.get_values(["x", "y", "v"]) == [1.25, 12.0, -1.0]


@of("Events3")
def test_a_step_ends_at_an_event_that_was_announced(opened: FmuInstance) -> None:
    opened.enter_initialization(0.0, 2.0, {"interval": 0.1, "announced": 1.0})
    opened.exit_initialization()

    opened.advance(0.0, 0.25)
    opened.advance(0.25, 0.25)

    assert opened.get_values(["x", "y"]) == [0.5, 5.0]


@of("Events3")
def test_an_fmu_that_wants_to_end_simulation_is_heard_before_next_step(opened: FmuInstance) -> None:
    opened.enter_initialization(0.0, 2.0, {"last": 0.5})
    opened.exit_initialization()
    opened.advance(0.0, 0.25)
    opened.advance(0.25, 0.25)

    with pytest.raises(TerminationRequested, match="the FMU asked to end the simulation"):
        opened.advance(0.5, 0.25)


def test_a_beta_version_of_fmi_3_is_refused(folder: Path, tmp_path: Path) -> None:
    path = tmp_path / "beta.fmu"
    with zipfile.ZipFile(build_test_fmu("Events3", folder)) as source, zipfile.ZipFile(path, "w") as target:
        for name in source.namelist():
            target.writestr(name, source.read(name).replace(b'fmiVersion="3.0"', b'fmiVersion="3.0-beta.4"'))

    with pytest.raises(LoadFailed, match=r"is for FMI 3\.0-beta\.4, a preliminary version of the standard"):
        read_description(path)


def test_the_library_steps_fmus_of_fmi_3_with_arrays(folder: Path) -> None:
    with FMIAdapter(build_test_fmu("AllTypes3", folder), step_size=0.5) as adapter:
        adapter.set_initial_value("columns", 2)
        matrix: Any = np.array([[1, 2], [3, 4]])
        adapter.set_initial_value("int16_array_in", matrix)
        adapter.exit_initialization_mode(0.0)
        adapter.set_input_value("float64_array_in", 1.0, [[1.0, 2.0], [3.0, 4.0]])
        adapter.do_step()
        adapter.do_step()

        assert adapter.get_output_value("int16_array_out") == [[1, 2], [3, 4]]
        assert adapter.get_output_value("float64_array_out") == [[0.5, 1.0], [1.5, 2.0]]
        with pytest.raises(CallRefused, match="a list of 2 x 2 values"):
            adapter.set_input_value("float64_array_in", 2.0, [1.0, 2.0])


def test_an_alias_of_fmi_3_is_a_variable_with_the_same_value(folder: Path, tmp_path: Path) -> None:
    path = repacked(
        tmp_path / "alias.fmu",
        source=build_test_fmu("AllTypes3", folder),
        description=lambda text: re.sub(
            r'(<Float64 name="float64_out"[^>]*)/>', r'\1><Alias name="again" description="the same"/></Float64>', text
        ),
    )
    description = read_description(path)
    instance = open_instance(path, "it", description, tmp_path)

    alias = description.variable("again")
    instance.enter_initialization(0.0, None, {"float64_in": 0.1})
    values = instance.get_values(["float64_out", "again"])
    instance.close()

    assert alias is not None
    assert (alias.causality, alias.description) == ("output", "the same")
    assert values == [0.1, 0.1]
