"""What a model description and the connections make doubtful: it can run, and is a warning with names."""

from __future__ import annotations

import logging
import zipfile
from collections.abc import Mapping
from pathlib import Path

import pytest

import fmu_mesh
from fmu_mesh.adapter.argument_checks import Arguments
from fmu_mesh.cli.main import main
from fmu_mesh.errors import CallRefused, ConfigurationError, UnknownName
from fmu_mesh.instances.fmi.archive.reading import read_description
from fmu_mesh.instances.position_pid import describe_pid
from fmu_mesh.instances.python.importing import description_of
from fmu_mesh.ros.gateway.mapping import resolve as resolve_ros
from fmu_mesh.sweeps.planned_sweep import planned_sweep
from fmu_mesh.system.plan import make_plan
from fmu_mesh.system.point_loops import warn_of_point_loops
from fmu_mesh.system.system import build
from fmu_mesh.variables.model_description import ModelDescription
from tests.fmus.helpers import FMUS
from tests.fmus.packing import repacked
from tests.planning import parse

FMI_1 = """\
<fmiModelDescription fmiVersion="1.0" modelName="m" modelIdentifier="m" guid="1" numberOfContinuousStates="0"
  numberOfEventIndicators="0">
<DefaultExperiment stepSize="0.01"/>
<ModelVariables>
<ScalarVariable name="u" valueReference="0" causality="input"><Real start="0"/></ScalarVariable>
<ScalarVariable name="y" valueReference="1" causality="output"><Real/>{declared}</ScalarVariable>
</ModelVariables>
<Implementation><CoSimulation_StandAlone><Capabilities {attributes}/></CoSimulation_StandAlone></Implementation>
</fmiModelDescription>"""
FMI_2 = """\
<fmiModelDescription fmiVersion="2.0" modelName="m" guid="1">
<CoSimulation modelIdentifier="m" {attributes}/>
<DefaultExperiment stepSize="0.01"/>
<ModelVariables>
<ScalarVariable name="u" valueReference="0" causality="input"><Real start="0"/></ScalarVariable>
<ScalarVariable name="y" valueReference="1" causality="output"><Real/></ScalarVariable>
<ScalarVariable name="x" valueReference="2" causality="output"><Real/></ScalarVariable>
<ScalarVariable name="der(x)" valueReference="3"><Real derivative="3"/></ScalarVariable>
</ModelVariables>
<ModelStructure><Outputs><Unknown index="2" {declared}/><Unknown index="3"/></Outputs>
<Derivatives><Unknown index="4" dependencies="1"/></Derivatives></ModelStructure>
</fmiModelDescription>"""
FMI_3 = """\
<fmiModelDescription fmiVersion="3.0" modelName="m" instantiationToken="1">
<CoSimulation modelIdentifier="m" {attributes}/>
<DefaultExperiment stepSize="0.01"/>
<ModelVariables>
<Float64 name="time" valueReference="9" causality="independent"/>
<Float64 name="u" valueReference="1" causality="input" start="0"/>
<Float64 name="y" valueReference="2" causality="output"><Alias name="also_y"/></Float64>
<Float64 name="x" valueReference="3" causality="output"/>
<Float64 name="der(x)" valueReference="4" derivative="3"/>
<Clock name="called" valueReference="5" causality="input" intervalVariability="triggered"/>
<Clock name="tick" valueReference="6" causality="input" intervalVariability="constant" intervalDecimal="0.1"/>
</ModelVariables>
<ModelStructure><Output valueReference="2" {declared}/><Output valueReference="3"/>
<ContinuousStateDerivative valueReference="4" dependencies="1"/></ModelStructure>
</fmiModelDescription>"""

TEXTS = {1: FMI_1, 2: FMI_2, 3: FMI_3}
ON_U = {1: "<DirectDependency><Name>u</Name></DirectDependency>", 2: 'dependencies="1"', 3: 'dependencies="1 9"'}
ON_NOTHING = {1: "<DirectDependency/>", 2: 'dependencies=""', 3: 'dependencies=""'}


def described(folder: Path, version: int, declared: str = "", attributes: str = "") -> ModelDescription:
    """The description of an FMU with an input u, an output y, and from FMI 2.0 on a state x that is an output."""
    path = folder / "m.fmu"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("modelDescription.xml", TEXTS[version].format(declared=declared, attributes=attributes))
    return read_description(path, to_run=False)


def warnings(
    of: Mapping[str, ModelDescription],
    *connections: str,
    algorithm: str = "jacobi",
    step: float = 0.01,
    own: str = "null",
) -> list[str]:
    """The warnings about instances with these descriptions and connections, as `check` lists them."""
    lines = [f"  {name}: {{fmu: m.fmu, step_size: {own}}}" for name in of]
    text = f"mesh: m\nsimulation: {{stop_time: {30 * step}, step_size: {step}, algorithm: {algorithm}}}\n" + "\n".join(
        ["instances:", *lines, f"connections: [{', '.join(connections)}]", "record: {file: null}", ""]
    )
    loaded = parse(text, Path("mesh.yaml"))
    plan = make_plan(build(loaded, of))
    findings = loaded.findings()
    warn_of_point_loops(plan, findings)
    return [str(warning).partition(": ")[2] for warning in (*plan.system.warnings, *findings)]


# --- loops at every point


@pytest.mark.parametrize("version", [1, 2, 3])
def test_an_output_depends_directly_on_what_its_model_structure_says(version: int, tmp_path: Path) -> None:
    found = [described(tmp_path, version, declared) for declared in (ON_U[version], ON_NOTHING[version], "")]

    on_inputs = [[n for n in y.feedthrough if n == "u"] if y and y.feedthrough is not None else None
                 for y in (one.variable("y") for one in found)]  # fmt: skip

    assert on_inputs == [["u"], [], None]


@pytest.mark.parametrize("version", [2, 3])
def test_a_continuous_state_depends_directly_on_nothing(version: int, tmp_path: Path) -> None:
    description = described(tmp_path, version)

    feedthrough = {variable.name: variable.feedthrough for variable in description.variables}

    assert feedthrough["x"] == ()
    assert feedthrough["der(x)"] == ("u",)


def test_an_alias_of_an_output_depends_on_the_same(tmp_path: Path) -> None:
    alias = described(tmp_path, 3, ON_U[3]).variable("also_y")

    assert alias is not None
    assert alias.feedthrough == ("u", "time")


@pytest.mark.parametrize("version", [1, 2, 3])
@pytest.mark.parametrize(
    ("algorithm", "delayed"), [("jacobi", "a.y -> b.u, b.y -> a.u"), ("gauss_seidel", "b.y -> a.u")]
)
def test_a_loop_at_every_point_is_a_warning_with_its_delays(
    algorithm: str, delayed: str, version: int, tmp_path: Path
) -> None:
    model = described(tmp_path, version, ON_U[version], 'canHandleVariableCommunicationStepSize="true"')

    (warning,) = (
        one
        for one in warnings({"a": model, "b": model}, "a.y -> b.u", "b.y -> a.u", algorithm=algorithm)
        if "clock" not in one
    )

    assert warning == (
        "connections[0]: a loop at every point: a.y -> b.u, b.y -> a.u. Each of these outputs depends directly on the "
        f"input before it. The delay of 1 at {delayed} makes this a fixed-point iteration in time, one sweep per "
        "point, which may be unstable: compare with a smaller step size, or solve it by `loops: solved` in `simulation`"
    )


def test_a_state_in_a_cycle_leaves_no_loop_at_every_point(tmp_path: Path) -> None:
    model = described(tmp_path, 2, ON_U[2])

    assert warnings({"a": model, "b": model}, "a.y -> b.u", "b.x -> a.u") == []


def test_outputs_without_a_cycle_are_no_loop(tmp_path: Path) -> None:
    model = described(tmp_path, 2)

    assert warnings({"a": model, "b": model, "c": model}, "a.y -> b.u", "b.y -> c.u") == []


def test_outputs_that_declare_nothing_are_named_in_one_warning(tmp_path: Path) -> None:
    silent, direct = described(tmp_path, 2), described(tmp_path, 2, ON_U[2])

    (one,) = warnings({"a": silent, "b": direct}, "a.y -> b.u", "b.y -> a.u")
    (more,) = warnings(
        {"a": silent, "b": direct, "c": silent, "d": silent}, "a.y -> b.u", "b.y -> a.u", "c.y -> d.u", "d.y -> c.u"
    )

    assert one.startswith("connections[0]: a.y declares nothing, so it may close a loop at every point, such as ")
    assert more.startswith(
        "connections[0]: a.y, c.y, d.y: each declares nothing, so it may close a loop at every point, "
    )


def test_a_loop_through_many_outputs_is_one_warning(tmp_path: Path) -> None:
    model = described(tmp_path, 2, ON_U[2])
    many = [f"i{number}" for number in range(12)]
    connections = [f"{one}.y -> {other}.u" for one, other in zip(many, [*many[1:], many[0]], strict=True)]

    (warning,) = warnings(dict.fromkeys(many, model), *connections)

    assert "i7.y -> i8.u and 4 more. Each" in warning


def test_controllers_and_components_say_what_they_depend_on_directly() -> None:
    class Both(fmu_mesh.Component):
        u = fmu_mesh.Input()
        y = fmu_mesh.Output(depends_on=("u",))
        z = fmu_mesh.Output()

        def step(self, time: float, step_size: float) -> None:
            """Do nothing."""

    component, pid = description_of(Both, ""), describe_pid()

    assert [one.feedthrough for one in component.with_causality("output")] == [("u",), None]
    assert {one.feedthrough for one in pid.with_causality("output")} == {
        tuple(one.name for one in pid.with_causality("input"))
    }


LOOP = f"""\
mesh: loop
simulation: {{stop_time: 0.1, step_size: 0.01}}
instances:
  a: {{fmu: {FMUS}/Gain.fmu, start_values: {{k: -2.0, u: 1.0}}}}
  b: {{fmu: {FMUS}/Gain.fmu}}
connections: [a.y -> b.u, b.y -> a.u]
initialization: {{relaxation: 0.3}}
record: {{file: loop.csv}}
"""


def test_check_and_launch_tell_of_a_loop_at_every_point(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "loop.yaml").write_text(LOOP, encoding="utf-8")
    monkeypatch.chdir(tmp_path)

    codes = [main([*words, "loop.yaml"]) for words in (["check"], ["check", "--json"], ["launch", "--local"])]

    out, err = capsys.readouterr()
    assert codes == [0, 0, 0]
    assert out.count("loop at every point: a.y -> b.u, b.y -> a.u.") == 2
    assert err.startswith("fmu-mesh: warning: loop.yaml:6: connections[0]: a loop at every point: a.y -> b.u")


def test_a_sweep_tells_of_a_loop_at_every_point_before_it_starts(tmp_path: Path) -> None:
    (tmp_path / "loop.yaml").write_text(LOOP, encoding="utf-8")
    told: list[str] = []

    planned_sweep(
        fmu_mesh.load(tmp_path / "loop.yaml"), {"a.k": [-0.5, -2.0]}, folder=tmp_path / "sweep", on_notice=told.append
    )

    (warning,) = told
    assert "a loop at every point: a.y -> b.u, b.y -> a.u." in warning


# --- step sizes that an FMU cannot do


@pytest.mark.parametrize("version", [1, 2, 3])
def test_another_step_than_the_only_one_of_an_fmu_is_a_warning(version: int, tmp_path: Path) -> None:
    model = described(tmp_path, version, attributes='canHandleVariableCommunicationStepSize="false"')

    (warning,) = (one for one in warnings({"i": model}, step=0.015) if "clock" not in one)

    assert warning == (
        "instances.i.step_size: steps of 0.015 s, not the 0.01 s (stepSize, without "
        "canHandleVariableCommunicationStepSize) that the FMU is made for; 'i' may compute wrong values; expected "
        "`step_size: 0.01`, in `simulation` or for 'i' alone"
    )


@pytest.mark.parametrize("version", [1, 2, 3])
def test_an_fmu_with_any_step_or_its_own_gives_no_warning(version: int, tmp_path: Path) -> None:
    free = described(tmp_path, version, attributes='canHandleVariableCommunicationStepSize="true"')
    bound = described(tmp_path, version)

    found = [
        *warnings({"i": free}, step=0.015),
        *warnings({"i": bound}, step=0.01),
        *warnings({"i": bound}, step=0.002, own="0.01"),
    ]

    assert [one for one in found if "clock" not in one] == []


@pytest.mark.parametrize(("step", "fits"), [(0.012, False), (0.0025, False), (0.005, True), (0.02, True), (0.3, True)])
def test_a_step_is_a_whole_multiple_of_the_internal_step(step: float, fits: bool, tmp_path: Path) -> None:  # noqa: FBT001 a parameter of the test
    model = described(tmp_path, 3, attributes='fixedInternalStepSize="0.005"')

    found = [one for one in warnings({"i": model}, step=step) if "clock" not in one]

    assert [f"{step} s, no whole multiple of the 0.005 s (fixedInternalStepSize)" in one for one in found] == [True] * (
        not fits
    )


def test_new_takes_the_internal_step_of_an_fmu_without_a_default(tmp_path: Path) -> None:
    repacked(
        tmp_path / "Fixed.fmu",
        source=FMUS / "Gain.fmu",
        description=lambda text: text.replace('stepSize="0.01"', "").replace(
            "<CoSimulation ", '<CoSimulation fixedInternalStepSize="0.004" '
        ),
    )

    code = main(["new", str(tmp_path), "--output", str(tmp_path / "made.yaml")])

    assert code == 0
    assert "step_size: 0.004" in (tmp_path / "made.yaml").read_text(encoding="utf-8")


def test_an_adapter_logs_a_step_that_its_fmu_is_not_made_for(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    bound = repacked(
        tmp_path / "Bound.fmu",
        description=lambda text: text.replace('canHandleVariableCommunicationStepSize="true"', ""),
    )
    with caplog.at_level(logging.WARNING), fmu_mesh.FMIAdapter(str(bound), step_size=0.015):
        pass

    assert "steps of 0.015 s, not the 0.01 s" in caplog.text


# --- clocks


def test_triggered_input_clocks_are_a_warning_and_others_are_none(tmp_path: Path) -> None:
    found = warnings({"i": described(tmp_path, 3)})

    assert found == [
        "instances.i.fmu: triggered input clocks of 'i' never tick, because clocks cannot be connected yet: called"
    ]


@pytest.mark.parametrize(
    "more",
    [
        "connections: [b.y -> a.called]",
        "connections: [a.called -> b.u]",
        "record: {variables: [a.called]}",
        "instances: {a: {fmu: m.fmu, start_values: {called: 1}}, b: {fmu: m.fmu}}",
    ],
)
def test_the_name_of_a_clock_is_refused_as_that(more: str, tmp_path: Path) -> None:
    model = described(tmp_path, 3)
    instances = "" if more.startswith("instances") else "instances: {a: {fmu: m.fmu}, b: {fmu: m.fmu}}\n"
    text = f"mesh: m\nsimulation: {{stop_time: 1, step_size: 0.01}}\n{instances}{more}\n"

    with pytest.raises(ConfigurationError) as caught:
        build(parse(text, Path("mesh.yaml")), {"a": model, "b": model})

    (finding,) = caught.value.findings
    assert str(finding).endswith("'called' is a clock, and clocks cannot be connected yet, nor set or recorded")


def test_an_adapter_refuses_the_name_of_a_clock_as_that(tmp_path: Path) -> None:
    arguments = Arguments("m", described(tmp_path, 3))

    with pytest.raises(CallRefused, match="'called' is a clock, and clocks cannot be connected yet"):
        arguments.settable("called")


def test_inspect_refuses_the_name_of_a_clock_as_that(tmp_path: Path) -> None:
    described(tmp_path, 3)

    with pytest.raises(UnknownName, match="'called' is a clock, and clocks cannot be connected yet"):
        fmu_mesh.inspect(tmp_path / "m.fmu").page(variables=["called"])


def test_a_topic_of_a_clock_is_refused_as_that(tmp_path: Path) -> None:
    head = "mesh: m\nsimulation: {stop_time: 1, step_size: 0.01}\ninstances: {a: {fmu: m.fmu}}\n"
    loaded = parse(f"{head}ros: {{topics: [a.called]}}\n", Path("mesh.yaml"))
    findings = loaded.findings()

    resolve_ros(loaded, {"a": described(tmp_path, 3)}, findings, loaded.findings())

    assert [finding.found for finding in findings] == [
        "'called' is a clock, and clocks cannot be connected yet, nor set or recorded"
    ]
