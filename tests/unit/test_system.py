"""What `build` makes of a configuration, and what it says about names and values that do not fit."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from msgspec.structs import replace

from fmu_mesh.config.loading import LoadedConfig, read_file
from fmu_mesh.config.yaml_text import resolve
from fmu_mesh.errors import ConfigurationError, Finding
from fmu_mesh.instances.configuration import examine_data
from fmu_mesh.results.formats import check_record, warn_of_endings
from fmu_mesh.simtime import TimeGrid
from fmu_mesh.system.system import ResolvedSystem, build
from fmu_mesh.variables.model_description import Causality, ModelDescription, Value, Variable, VariableType
from tests.planning import parse

FILE = Path("/models/configs/mesh.yaml")


def variable(name: str, kind: str, causality: Causality, **more: object) -> Variable:
    """A variable of an FMI 2.0 FMU."""
    types: dict[str, VariableType] = {"Real": "Float64", "Integer": "Int32"}
    fields: dict[str, object] = {
        "declared_type": kind,
        "variability": "discrete" if causality in ("input", "output") else "fixed",
        "initial": {"parameter": "exact", "output": "calculated", "local": "calculated"}.get(causality),
        **more,
    }
    type_: VariableType = types.get(kind, kind)  # type: ignore[arg-type] # the others have one name
    return Variable(name, 0, type_, causality, **fields)  # type: ignore[arg-type] # checked by the tests themselves


def description(*variables: Variable, only_once: bool = False) -> ModelDescription:
    return ModelDescription(
        model_name="model",
        model_identifier="model",
        fmi_version="2.0",
        kind="co_simulation",
        guid="{1}",
        variables=variables,
        only_once_per_process=only_once,
    )


SOURCE = description(
    variable("a", "Real", "output", initial="exact", unit="rad"),
    variable("der(a,2)", "Real", "output"),
    variable("count", "Integer", "output"),
    variable("flag", "Boolean", "output"),
    variable("mode", "Enumeration", "output"),
    variable("name", "String", "output"),
    variable("body[1].x", "Real", "local"),
    variable("l", "Real", "parameter", minimum=0.0, maximum=10.0),
    variable("n", "Integer", "parameter", minimum=1.0),
    variable("on", "Boolean", "parameter"),
    variable("label", "String", "parameter"),
    variable("kind", "Enumeration", "parameter", items=(("stiff", 1), ("soft", 2))),
    variable("pi", "Real", "parameter", variability="constant"),
    variable("time", "Real", "independent"),
)
TARGET = description(
    variable("x", "Real", "input", unit="m"),
    variable("body[1].u", "Real", "input"),
    variable("i", "Integer", "input"),
    variable("b", "Boolean", "input"),
    variable("e", "Enumeration", "input"),
    variable("s", "String", "input"),
    variable("y", "Real", "output"),
)
DESCRIPTIONS = {"pendulum": SOURCE, "delay": TARGET}


def text(
    simulation: str = "stop_time: 1, step_size: 0.1",
    pendulum: str = "fmu: p.fmu",
    delay: str = "fmu: d.fmu",
    connections: str = "",
    rest: str = "",
) -> str:
    return f"""\
mesh: pair
simulation: {{{simulation}}}
instances:
  pendulum: {{{pendulum}}}
  delay: {{{delay}}}
connections: [{connections}]
{rest}
"""


def built(config: str, **start_values: Any) -> ResolvedSystem:  # noqa: ANN401 as a file has them
    return checked(parse(config, FILE, start_values), DESCRIPTIONS)


def checked(
    loaded: LoadedConfig, descriptions: Mapping[str, ModelDescription], findings: Iterable[Finding] = ()
) -> ResolvedSystem:
    """The system of a configuration, with what the formats of its result files say."""
    system = build(loaded, descriptions, findings, check_record=partial(check_record, loaded))
    warnings = loaded.findings()
    warn_of_endings(loaded, system.records, warnings)
    return replace(system, warnings=(*system.warnings, *warnings))


def findings_of(config: str, **start_values: Any) -> list[str]:  # noqa: ANN401 as a file has them
    with pytest.raises(ConfigurationError) as caught:
        built(config, **start_values)
    return [str(finding).removeprefix(f"{FILE}:") for finding in caught.value.findings]


def test_a_good_configuration_becomes_a_system() -> None:
    system = built(
        text(
            simulation="start_time: 1, stop_time: 41, step_size: 0.002",
            pendulum="fmu: ../fmus/p.fmu, start_values: {a: 1, l: 2}, group: fast",
            delay="fmu: d.fmu, step_size: 0.004",
            connections='{from: "pendulum.der(a,2)", to: "delay.body[1].u", factor: 2, offset: 1, delay: 1}',
        )
    )
    assert system.grid == TimeGrid(1.0, 0.002, 20_000)
    pendulum, delay = system.instances.values()
    assert (pendulum.fmu, pendulum.node, pendulum.step_points) == ("/models/fmus/p.fmu", "fast", 1)
    assert pendulum.start_values == {"a": 1.0, "l": 2.0}
    assert type(pendulum.start_values["a"]) is float
    assert (delay.name, delay.node, delay.step_points) == ("delay", "delay", 2)
    (connection,) = system.connections
    assert str(connection) == "pendulum.der(a,2) -> delay.body[1].u"
    assert (connection.factor, connection.offset, connection.delay) == (2.0, 1.0, 1)
    assert connection.path == "connections[0]"
    assert system.result_file == "/models/configs/results/pair.csv"
    assert system.warnings == ()


def test_by_default_all_outputs_but_strings_are_recorded() -> None:
    assert built(text()).recorded == (
        ("pendulum", "a"),
        ("pendulum", "der(a,2)"),
        ("pendulum", "count"),
        ("pendulum", "flag"),
        ("pendulum", "mode"),
        ("delay", "y"),
    )


def test_recorded_variables_keep_the_order_of_the_file() -> None:
    system = built(text(rest="record: {file: /results/a.csv, variables: [delay.y, 'pendulum.der(a,2)']}"))
    assert system.recorded == (("delay", "y"), ("pendulum", "der(a,2)"))
    assert system.result_file == "/results/a.csv"


def test_nothing_is_recorded_without_a_file() -> None:
    assert built(text(rest="record: {file: null}")).result_file is None


def test_a_run_may_have_no_step() -> None:
    assert built(text(simulation="stop_time: 0, step_size: 1")).grid.last_point == 0


SIMULATION = [
    ("stop_time: 1, step_size: 0", "2: simulation.step_size: 0; expected a step size > 0 in s"),
    ("stop_time: 1, step_size: -0.1", "2: simulation.step_size: -0.1; expected a step size > 0 in s"),
    (
        "start_time: 2, stop_time: 1, step_size: 0.1",
        "2: simulation.stop_time: 1, before start_time 2; expected a time >= 2",
    ),
    (
        "stop_time: 1, step_size: 0.3",
        (
            "2: simulation.stop_time: 1 s between start_time and stop_time, no whole multiple of step_size 0.3 s; "
            "expected a whole multiple of it, as with stop_time 0.9 or 1.2"
        ),
    ),
    (
        "stop_time: 1e300, step_size: 1e-300",
        (
            "2: simulation.step_size: more than 9007199254740992 points from 0 s to 1e+300 s in steps of 1e-300 s; "
            "expected a larger step size or an earlier stop time"
        ),
    ),
    (
        "stop_time: 1, step_size: 1, real_time_factor: -1",
        "2: simulation.real_time_factor: -1; expected 0 (as fast as possible) or a positive factor",
    ),
]


@pytest.mark.parametrize(("simulation", "expected"), SIMULATION)
def test_a_simulation_that_cannot_run_is_refused(simulation: str, expected: str) -> None:
    assert findings_of(text(simulation=simulation)) == [expected]


@pytest.mark.parametrize(
    ("step", "expected"),
    [
        ("0", "0; expected a step size > 0 in s"),
        ("-1", "-1; expected a step size > 0 in s"),
        ("0.15", "0.15 s; expected a whole multiple of the base step size 0.1 s, such as 0.1 or 0.2"),
        ("0.01", "0.01 s; expected a whole multiple of the base step size 0.1 s, such as 0.1"),
    ],
)
def test_an_own_step_size_is_a_multiple_of_the_base_step_size(step: str, expected: str) -> None:
    found = findings_of(text(delay=f"fmu: d.fmu, step_size: {step}"))
    assert found == [f"5: instances.delay.step_size: {expected}"]


@pytest.mark.parametrize(
    ("name", "value", "converted"),
    [
        ("a", "1", 1.0),
        ("a", "-0.5", -0.5),
        ("n", "2147483647", 2**31 - 1),
        ("on", "true", True),
        ("label", "off", "off"),
        ("kind", "soft", 2),
        ("kind", "1", 1),
        ("l", "0", 0.0),
    ],
)
def test_a_start_value_takes_the_type_of_its_variable(name: str, value: str, converted: Value) -> None:
    start_values = built(text(), **{f"pendulum.{name}": resolve(value)}).instances["pendulum"].start_values
    assert start_values == {name: converted}
    assert type(start_values[name]) is type(converted)


START_VALUES = [
    ("q: 1", "q: the unknown variable 'q' of instance 'pendulum'; expected one of a, l, n, on, label, kind"),
    ("LABEL: x",
     ("LABEL: the unknown variable 'LABEL' of instance 'pendulum'; expected one of a, l, n, on, label, kind. "
                 "Did you mean 'label'?")),
    ("pi: 3", "pi: 'pi', a constant that cannot be set before the start; expected one of a, l, n, on, label, kind"),
    ("time: 3", ("time: 'time', an independent that cannot be set before the start; "
                "expected one of a, l, n, on, label, kind")),
    ("a: '1'", "a: '1' for the Real 'a'; expected a number"),
    ("a: true", "a: true for the Real 'a'; expected a number"),
    ("n: 1.5", "n: 1.5 for the Integer 'n'; expected a whole number from -2147483648 to 2147483647"),
    ("n: true", "n: true for the Integer 'n'; expected a whole number from -2147483648 to 2147483647"),
    ("n: 2147483648", "n: 2147483648 for the Integer 'n'; expected a whole number from -2147483648 to 2147483647"),
    ("on: 1", "on: 1 for the Boolean 'on'; expected true or false"),
    ("label: 1", "label: 1 for the String 'label'; expected text without the character 0, 16777216 characters at most"),
    ("kind: sofd",
     "kind: 'sofd' for the Enumeration 'kind'; expected one of stiff (1), soft (2). Did you mean 'soft'?"),
    ("kind: 3", "kind: 3 for the Enumeration 'kind'; expected one of stiff (1), soft (2)"),
    ("kind: true", "kind: true for the Enumeration 'kind'; expected one of stiff (1), soft (2)"),
    ("l: -1", "l: -1 for 'l', which is out of its range; expected a value >= 0 and <= 10"),
    ("l: 11.5", "l: 11.5 for 'l', which is out of its range; expected a value >= 0 and <= 10"),
    ("n: 0", "n: 0 for 'n', which is out of its range; expected a value >= 1"),
]  # fmt: skip


@pytest.mark.parametrize(("values", "expected"), START_VALUES)
def test_a_wrong_start_value_is_told_with_its_place(values: str, expected: str) -> None:
    found = findings_of(text(pendulum=f"fmu: p.fmu, start_values: {{{values}}}"))
    assert found == [f"4: instances.pendulum.start_values.{expected}"]


def test_a_wrong_start_value_of_an_option_is_told_by_the_option() -> None:
    found = findings_of(text(pendulum="fmu: p.fmu, start_values: {l: 1}"), **{"pendulum.l": "long", "delay.z": 1})
    assert found == [
        " `start_values={'pendulum.l': 'long'}`: 'long' for the Real 'l'; expected a number",
        (
            " `start_values={'delay.z': 1}`: the unknown variable 'z' of instance 'delay'; "
            "expected one of x, body[1].u, i, b, e, s"
        ),
    ]


CONNECTIONS = [
    ("pendulum -> delay.x", "[0].from: 'pendulum'; expected instance.variable"),
    ("{from: '', to: ''}", "[0]: no ends; expected instance.output -> instance.input"),
    ("pendulum.a -> .x", "[0].to: '.x'; expected instance.variable"),
    ("pendulam.a -> delay.x", ("[0].from: the unknown instance 'pendulam'; "
     "expected one of the instances pendulum, delay. Did you mean 'pendulum'?")),
    ("pendulum.a -> dely.x", ("[0].to: the unknown instance 'dely'; "
     "expected one of the instances pendulum, delay. Did you mean 'delay'?")),
    ("pendulum.moda -> delay.x", ("[0].from: the unknown variable 'moda' of instance 'pendulum'; "
     "expected one of the outputs of 'pendulum': mode, a, der(a,2), count, flag, name. Did you mean 'mode'?")),
    ("pendulum.a -> delay.y", "[0].to: 'delay.y' is an output; expected an input of 'delay': x, body[1].u, i, b, e, s"),
    ("pendulum.l -> delay.x", ("[0].from: 'pendulum.l' is a parameter; "
     "expected an output of 'pendulum': a, der(a,2), count, flag, mode, name")),
    ("delay.x -> pendulum.a", ("[0]: the wrong way round: 'delay.x' is an input and 'pendulum.a' an output; "
     "expected output -> input. Did you mean 'pendulum.a -> delay.x'?")),
    ("pendulum.a -> delay.i", ("[0]: pendulum.a -> delay.i connects a Real to an Integer; "
     "expected a source of type Integer or Boolean or Enumeration")),
    ("pendulum.flag -> delay.x", ("[0]: pendulum.flag -> delay.x connects a Boolean to a Real; "
     "expected a source of type Real or Integer")),
    ("pendulum.mode -> delay.x", ("[0]: pendulum.mode -> delay.x connects an Enumeration to a Real; "
     "expected a source of type Real or Integer")),
    ("pendulum.count -> delay.b", ("[0]: pendulum.count -> delay.b connects an Integer to a Boolean; "
     "expected a source of type Boolean")),
    ("pendulum.flag -> delay.e", ("[0]: pendulum.flag -> delay.e connects a Boolean to an Enumeration; "
     "expected a source of type Enumeration or Integer")),
    ("pendulum.name -> delay.x", ("[0]: pendulum.name -> delay.x connects a String to a Real; "
     "expected a source of type Real or Integer")),
    ("{from: pendulum.count, to: delay.i, factor: 2}", ("[0]: factor 2 and offset 0 for the Integer 'i'; "
     "expected factor and offset on Real inputs only")),
    ("{from: delay.y, to: delay.x, delay: 0}", ("[0].delay: delay 0 on delay.y -> delay.x, "
     "from an instance to itself; expected delay 1")),
    ("pendulum.a -> delay.x, pendulum.count -> delay.x", ("[1]: a second source for the input 'delay.x': "
     "pendulum.count -> delay.x, after pendulum.a -> delay.x (connections[0] in line 6); "
     "expected one source for an input")),
    ("pendulum.a -> delay.x, {from: pendulum.a, to: delay.x}", ("[1]: pendulum.a -> delay.x a second time "
     "(first: connections[0] in line 6); expected one source for an input")),
]  # fmt: skip


@pytest.mark.parametrize(("connections", "expected"), CONNECTIONS)
def test_a_wrong_connection_is_told_with_its_place(connections: str, expected: str) -> None:
    assert findings_of(text(connections=connections)) == [f"6: connections{expected}"]


@pytest.mark.parametrize(
    "connection",
    [
        "pendulum.count -> delay.x",
        "pendulum.flag -> delay.i",
        "pendulum.mode -> delay.i",
        "pendulum.mode -> delay.e",
        "pendulum.flag -> delay.b",
        "pendulum.name -> delay.s",
        "delay.y -> delay.x",
        "{from: pendulum.count, to: delay.x, factor: 0.5}",
    ],
)
def test_lossless_types_and_loops_may_be_connected(connection: str) -> None:
    assert len(built(text(connections=connection)).connections) == 1


MATRIX = description(
    variable("y", "Float64", "output", declared_type=None, shape=(2, 3)),
    variable("x", "Float32", "output", declared_type=None, shape=(3,)),
    variable("z[2]", "Float64", "output", declared_type=None),
    variable("z", "Float64", "output", declared_type=None, shape=(2,)),
    variable("big", "UInt64", "output", declared_type=None),
    variable("mode", "Enumeration", "output", declared_type=None, items=(("a", 0), ("b", 200))),
    variable("data", "Binary", "output", declared_type=None),
    variable("u", "Float64", "input", declared_type=None, shape=(2, 3)),
    variable("v", "Float64", "input", declared_type=None),
    variable("n", "Int8", "input", declared_type=None),
    variable("byte", "UInt8", "input", declared_type=None),
    variable("w", "Float32", "input", declared_type=None),
)
ARRAYS = {"pendulum": SOURCE, "delay": MATRIX}


def array_findings(connections: str) -> list[str]:
    with pytest.raises(ConfigurationError) as caught:
        build(parse(text(connections=connections), FILE), ARRAYS)
    return [f"{finding.path}: {finding.found}; expected {finding.expected}" for finding in caught.value.findings]


@pytest.mark.parametrize(
    ("connection", "ends"),
    [
        ("delay.y -> delay.u", ("y", "u")),
        ("delay.y[2,3] -> delay.v", ("y[2,3]", "v")),
        ("pendulum.a -> delay.u[ 1 , 3 ]", ("a", "u[1,3]")),
        ("delay.x[3] -> delay.u[1,1]", ("x[3]", "u[1,1]")),
        ("delay.z[2] -> delay.v", ("z[2]", "v")),
        ("delay.mode -> delay.byte", ("mode", "byte")),
        ("{from: delay.x[1], to: delay.w, factor: 2}", ("x[1]", "w")),
    ],
)
def test_arrays_are_connected_as_a_whole_or_by_element(connection: str, ends: tuple[str, str]) -> None:
    quoted = connection if connection[0] == "{" else f"'{connection}'"
    quoted = quoted.replace("delay.x[1]", "'delay.x[1]'")
    (made,) = build(parse(text(connections=quoted), FILE), ARRAYS).connections
    assert (made.source_name, made.target_name) == ends


def test_a_variable_that_is_called_like_an_element_wins() -> None:
    loaded = parse(text(connections="'delay.z[2] -> delay.v', 'delay.z[1] -> delay.u[1,1]'"), FILE)
    first, second = build(loaded, ARRAYS).connections
    assert (first.source.name, first.source_index) == ("z[2]", ())
    assert (second.source.name, second.source_index) == ("z", (0,))


@pytest.mark.parametrize(
    ("connection", "expected"),
    [
        ("delay.y -> delay.v", ("connections[0]: delay.y -> delay.v connects a Float64[2,3] to a Float64; "
         "expected ends of the same shape: two arrays of the same dimensions, or one element as in y[1]")),
        ("delay.y[3,1] -> delay.v", ("connections[0].from: 'delay.y[3,1]' of the Float64[2,3] 'y'; "
         "expected an index from [1,1] to [2,3]")),
        ("delay.y[0,1] -> delay.v", ("connections[0].from: 'delay.y[0,1]' of the Float64[2,3] 'y'; "
         "expected an index from [1,1] to [2,3]")),
        ("delay.y[1] -> delay.v", ("connections[0].from: 'delay.y[1]' of the Float64[2,3] 'y'; "
         "expected an index from [1,1] to [2,3]")),
        ("pendulum.a[1] -> delay.v", ("connections[0].from: 'pendulum.a[1]' of the Real 'a'; "
         "expected an element of an array only: this variable is a scalar")),
        ("delay.big -> delay.v", ("connections[0]: delay.big -> delay.v connects an UInt64 to a Float64; expected a "
         "source of type Float64 or Float32 or Int32 or UInt32 or Int16 or UInt16 or Int8 or UInt8")),
        ("delay.mode -> delay.n", ("connections[0]: delay.mode -> delay.n connects an Enumeration to an Int8; "
         "expected a source of type Int8 or Boolean")),
        ("delay.data -> delay.v", ("connections[0]: delay.data -> delay.v connects a Binary to a Float64; expected a "
         "source of type Float64 or Float32 or Int32 or UInt32 or Int16 or UInt16 or Int8 or UInt8")),
        ("delay.z -> delay.z", ("connections[0].to: 'delay.z' is an output; "
         "expected an input of 'delay': u, v, n, byte, w")),
    ],
)  # fmt: skip
def test_arrays_and_types_that_do_not_fit_are_refused(connection: str, expected: str) -> None:
    assert array_findings(f"'{connection}'") == [expected]


def test_an_input_array_has_one_source_for_each_element() -> None:
    found = array_findings("'delay.y -> delay.u', 'delay.y[1,1] -> delay.u[1,1]', 'delay.y[1,2] -> delay.u[ 1,1]'")
    assert [line.partition(";")[0] for line in found] == [
        f"connections[{index}]: a second source for the input 'delay.u[1,1]': {connection}, "
        "after delay.y -> delay.u (connections[0] in line 6)"
        for index, connection in enumerate(["delay.y[1,1] -> delay.u[1,1]", "delay.y[1,2] -> delay.u[ 1,1]"], 1)
    ]


def test_every_element_of_a_recorded_array_is_a_column() -> None:
    loaded = parse(text(rest="record: {variables: ['delay.y[2,1]', delay.x, 'delay.z[2]', delay.data]}"), FILE)
    assert [name for _, name in build(loaded, ARRAYS).recorded] == ["y[2,1]", "x[1]", "x[2]", "x[3]", "z[2]", "data"]
    assert ("delay", "data") not in build(parse(text(), FILE), ARRAYS).recorded
    assert ("delay", "y[1,1]") in build(parse(text(), FILE), ARRAYS).recorded


def test_structural_parameters_give_arrays_their_shapes() -> None:
    sized = description(
        variable("n", "UInt64", "structuralParameter", declared_type=None, start=2, initial="exact", minimum=1.0),
        variable("u", "Float64", "input", declared_type=None, shape=(2,), dimensions=("n",), start=[0.5, 0.5]),
    )
    loaded = parse(text(pendulum="fmu: p.fmu, start_values: {n: 3, u: [1, 2, 3]}"), FILE)
    instance = build(loaded, {"pendulum": sized, "delay": TARGET}).instances["pendulum"]
    assert instance.start_values == {"n": 3, "u": [1.0, 2.0, 3.0]}
    described = instance.description.variable("u")
    assert described is not None
    assert (described.shape, described.start) == ((3,), [0.5, 0.5, 0.5])


def test_an_array_that_is_too_large_is_refused_before_it_takes_memory() -> None:
    sized = description(
        variable("n", "UInt64", "structuralParameter", declared_type=None, start=2, initial="exact"),
        variable("u", "Float64", "input", declared_type=None, shape=(2,), dimensions=("n",)),
    )
    loaded = parse(text(pendulum="fmu: p.fmu, start_values: {n: 18446744073709551615}"), FILE)
    with pytest.raises(
        ConfigurationError, match=r"start_values: 'u' would have 18446744073709551615 elements; expected "
    ):
        build(loaded, {"pendulum": sized, "delay": TARGET})


def test_different_units_without_a_factor_are_a_warning() -> None:
    (warning,) = built(text(connections="pendulum.a -> delay.x")).warnings
    assert warning == Finding(
        str(FILE),
        "connections[0]",
        "pendulum.a -> delay.x connects the unit 'rad' to the unit 'm' and converts nothing, because there are no base "
        "units of pendulum.a: its model does not define 'rad'",
        "the same unit, a factor that converts it, or `ignore_units: true` if both are the same",
        None,
        6,
    )
    assert built(text(connections="{from: pendulum.a, to: delay.x, factor: 2}")).warnings == ()


NODES = [
    ("fmu: p.fmu, group: delay", "fmu: d.fmu", ("4: instances.pendulum.group: the group 'delay', "
     "which is the name of an instance outside the group; expected a name of its own")),
    ("fmu: p.fmu, group: mesh", "fmu: d.fmu", ("4: instances.pendulum.group: the group 'mesh'; "
     "expected another name: it is reserved for the mesh itself")),
    ("fmu: p.fmu, group: g, host: one", "fmu: d.fmu, group: g", ("5: instances.delay.host: nothing (null), "
     "while 'pendulum' has 'one'; expected one host for all instances of the group 'g'")),
]  # fmt: skip


@pytest.mark.parametrize(("pendulum", "delay", "expected"), NODES)
def test_a_group_that_cannot_be_one_node_is_refused(pendulum: str, delay: str, expected: str) -> None:
    assert findings_of(text(pendulum=pendulum, delay=delay)) == [expected]


def test_a_group_may_have_the_name_of_an_instance_inside_it() -> None:
    system = built(text(pendulum="fmu: p.fmu, group: delay", delay="fmu: d.fmu, group: delay, host: null"))
    assert {instance.node for instance in system.instances.values()} == {"delay"}


@pytest.mark.parametrize("group", ["g", "h"])
def test_instances_that_cannot_share_a_process_cannot_share_a_group(group: str) -> None:
    loaded = parse(text(pendulum="fmu: a.fmu, group: g", delay=f"fmu: a.fmu, group: {group}"), FILE)
    models = dict.fromkeys(("pendulum", "delay"), description())
    if group == "h":
        assert len(build(loaded, models, claims=lambda _name: {"why": ""}).instances) == 2
        return
    with pytest.raises(ConfigurationError, match=r"group: 'pendulum' and 'delay' cannot run in one process: why"):
        build(loaded, models, claims=lambda _name: {"why": ""})


def test_mesh_is_no_instance_name() -> None:
    loaded = parse("mesh: m\nsimulation: {stop_time: 1, step_size: 1}\ninstances: {mesh: {fmu: a.fmu}}\n", FILE)
    with pytest.raises(ConfigurationError, match=r"instances\.mesh: the name 'mesh'; expected another name"):
        build(loaded, {"mesh": SOURCE})


RECORD = [
    ("[pendulum.b]", ("[0]: the unknown variable 'b' of instance 'pendulum'; expected one of the outputs of "
     "'pendulum': a, der(a,2), count, flag, mode, name")),
    ("[delai.y]", ("[0]: the unknown instance 'delai'; expected one of the instances pendulum, delay. "
     "Did you mean 'delay'?")),
    ("[delay.y, delay.y]", ("[1]: 'delay.y' a second time (first: record.variables[0]); "
     "expected every variable at most once")),
]  # fmt: skip


@pytest.mark.parametrize(("variables", "expected"), RECORD)
def test_what_cannot_be_recorded_is_refused(variables: str, expected: str) -> None:
    assert findings_of(text(rest=f"record: {{variables: {variables}}}")) == [f"7: record.variables{expected}"]


def test_a_folder_is_no_result_file(tmp_path: Path) -> None:
    (found,) = findings_of(text(rest=f"record: {{file: {tmp_path}}}"))
    assert found == f"7: record.file: the folder '{tmp_path}'; expected a file, or null to record nothing"


@pytest.mark.parametrize("name", ["result.xlsx", "result.H5", "result.json"])
def test_a_format_that_is_not_written_is_refused(name: str) -> None:
    assert findings_of(text(rest=f"record: {{file: {name}}}")) == [
        f"7: record.file: '{name}', a format that is not written; expected a name ending in .csv or .mcap or .parquet"
    ]


@pytest.mark.parametrize("name", ["result.csv", "result.txt", "result", "result.mcap", "result.2"])
def test_other_names_of_result_files_are_taken(name: str) -> None:
    system = built(text(rest=f"record: {{file: {name}}}"))
    assert system.result_file == f"/models/configs/{name}"
    assert system.warnings == ()


def test_an_ending_that_nobody_offers_is_still_a_csv_with_a_warning() -> None:
    (warning,) = built(text(rest="record: {file: result.dat}")).warnings
    assert "'result.dat', an ending of no installed format, so the file becomes a CSV" in str(warning)
    assert "a name ending in .csv or .mcap or .parquet; from version 0.4 on this is an error" in str(warning)


def test_a_client_needs_a_router() -> None:
    assert findings_of(text(rest="zenoh: {mode: client}")) == [
        "7: zenoh.mode: client without a router; expected an endpoint in zenoh.connect"
    ]


def test_a_zenoh_configuration_exists(tmp_path: Path) -> None:
    (tmp_path / "zenoh.json5").touch()
    assert findings_of(text(rest=f"zenoh: {{config: {tmp_path}/zenoh.json}}")) == [
        (
            f"7: zenoh.config: no such file '{tmp_path}/zenoh.json'; expected an existing Zenoh configuration. "
            f"Did you mean '{tmp_path}/zenoh.json5'?"
        )
    ]


def test_all_findings_are_shown_together_with_earlier_ones_and_those_without_description() -> None:
    loaded = parse(
        text(
            simulation="stop_time: 1, step_size: 0",
            pendulum="fmu: p.fmu, start_values: {q: 1}, step_size: 0.1",
            delay="fmu: d.fmu, start_values: {q: 1}, step_size: -1",
            connections="pendulum.q -> delay.q, pendulum.a -> delays.x",
            rest="record: {variables: [pendulum.q, delay.q, x.y]}",
        ),
        FILE,
    )
    earlier = loaded.finding("instances.delay.fmu", "no such file", "an FMU")
    with pytest.raises(ConfigurationError, match="8 problems") as caught:
        build(loaded, {"pendulum": SOURCE}, [earlier])
    assert [(finding.line, finding.path) for finding in caught.value.findings] == [
        (2, "simulation.step_size"),
        (4, "instances.pendulum.start_values.q"),
        (5, "instances.delay.fmu"),
        (5, "instances.delay.step_size"),
        (6, "connections[0].from"),
        (6, "connections[1].to"),
        (7, "record.variables[0]"),
        (7, "record.variables[2]"),
    ]


def test_what_wrong_structure_leaves_is_checked_too_without_findings_that_only_follow(tmp_path: Path) -> None:
    file = tmp_path / "mesh.yaml"
    file.write_text(
        """\
mesh: a pair
simulation: {stop_time: 1, step_sise: 0.3, real_time_factor: -1}
instances:
  pendulum: {fmu: p.fmu, start_values: {a: , l: -1}, step_size: no}
  delay: {fmuu: d.fmu, step_size: -1, start_values: {d: 1}}
connections:
  - pendulum.a => delay.x
  - 3
  - {from: pendulum.a, too: delay.x, factor: x}
  - {from: pendulum.q, to: delai.x, factor: x}
record: {variables: [3, pendulum.a]}
"""
    )
    loaded, findings = examine_data(read_file(file), {"pendulum.n": 1.5, "delay.q": {}})
    with pytest.raises(ConfigurationError) as caught:
        build(loaded, {"pendulum": SOURCE}, findings)
    assert [(finding.line, finding.path) for finding in caught.value.findings] == [
        (1, "mesh"),
        (2, "simulation.step_sise"),
        (2, "simulation.real_time_factor"),
        (4, "instances.pendulum.start_values.a"),
        (4, "instances.pendulum.step_size"),
        (4, "instances.pendulum.start_values.l"),
        (5, "instances.delay.fmuu"),
        (5, "instances.delay.step_size"),
        (7, "connections[0]"),
        (8, "connections[1]"),
        (9, "connections[2].too"),
        (9, "connections[2].factor"),
        (10, "connections[3].factor"),
        (10, "connections[3].from"),
        (10, "connections[3].to"),
        (11, "record.variables[0]"),
        (None, "`start_values={'delay.q': {}}`"),
        (None, "`start_values={'pendulum.n': 1.5}`"),
    ]


def test_a_description_that_is_missing_without_a_finding_is_error_of_caller() -> None:
    with pytest.raises(ValueError, match=r"no model description and no finding for \['delay'\]"):
        build(parse(text(), FILE), {"pendulum": SOURCE})
