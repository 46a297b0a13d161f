"""Start values that FMI forbids and that some FMUs take: they are handed over, with a warning, or refused where strict.

The pendulum that `fmi_adapter` brings declares its angle as an output with initial 'calculated', and takes one before
the start. So does the ball here, whose description says so of its height.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any

import fmpy
import pytest
import yaml

import fmu_mesh
from fmu_mesh import FMIAdapter
from fmu_mesh.cli.main import main
from fmu_mesh.errors import CallRefused, InitializationFailed
from fmu_mesh.instances.fmi.archive.reading import read_description
from fmu_mesh.instances.fmi.archive.sources import extract
from fmu_mesh.variables.model_description import Kind
from tests.fmus.event_fmus import Version, event_source_fmu
from tests.fmus.helpers import FMUS, NO_COMPILER, find_fmu
from tests.fmus.packing import repacked

needs_compiler = pytest.mark.skipif(NO_COMPILER is not None, reason=str(NO_COMPILER))

STEP, STOP = 0.125, 2.0
HEIGHT = 2.5

_NOT_ALLOWED = "does not allow setting it; whether it takes effect is up to the FMU"
ROLES = {
    1: f"'h', an output: FMI 1.0 (ME 3.3) {_NOT_ALLOWED}",
    2: f"'h', an output with initial 'calculated': FMI 2.0 (2.2.7) {_NOT_ALLOWED}",
    3: f"'h', an output with initial 'calculated': FMI 3.0 (2.4.7) {_NOT_ALLOWED}",
}


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A cache of the test's own."""
    monkeypatch.setenv("FMU_MESH_CACHE_DIR", str(tmp_path / "cache"))


def without_start(text: str) -> str:
    """A description of the ball in which the height has no start value, and its initial is 'calculated'."""

    def change(match: re.Match[str]) -> str:
        element = re.sub(r' (start|fixed)="[^"]*"', "", match[0])
        return element.replace('initial="exact"', 'initial="calculated"')

    changed, count = re.subn(r'<ScalarVariable name="h".*?</ScalarVariable>|<Float64 name="h"[^>]*/>', change, text)
    assert count == 1
    assert changed != text
    return changed


def ball(version: Version, folder: Path, *, calculated: bool) -> Path:
    """A ball without a binary; what its height is, its description says in one of two ways."""
    target = folder / f"ball{version}{'_calculated' if calculated else ''}.fmu"
    return event_source_fmu("Ball", version, target, without_start if calculated else lambda text: text)


def config_with(fmu: Path, start_values: dict[str, Any], record: Sequence[str] = (), **more: object) -> Path:
    file = fmu.with_suffix(".yaml")
    content = {
        "mesh": "one",
        "simulation": {"stop_time": STOP, "step_size": STEP},
        "instances": {"ball": {"fmu": str(fmu), "start_values": start_values, **more}},
        "record": {"file": f"{file.stem}.csv", **({"variables": list(record)} if record else {})},
    }
    file.write_text(yaml.safe_dump(content), encoding="utf-8")
    return file


ALL_KINDS = [
    pytest.param(1, "model_exchange", id="FMI 1 ME"),
    pytest.param(2, "co_simulation", id="FMI 2 CS"),
    pytest.param(2, "model_exchange", id="FMI 2 ME"),
    pytest.param(3, "co_simulation", id="FMI 3 CS"),
    pytest.param(3, "model_exchange", id="FMI 3 ME"),
]


@needs_compiler
@pytest.mark.parametrize("options", [(), ("--local",)], ids=["distributed", "local"])
@pytest.mark.parametrize(("version", "kind"), ALL_KINDS)
def test_an_output_with_initial_calculated_takes_a_start_value_as_with_exact(
    version: Version, kind: Kind, options: tuple[str, ...], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    allowed = config_with(ball(version, tmp_path, calculated=False), {"h": HEIGHT}, kind=kind)
    odd = config_with(ball(version, tmp_path, calculated=True), {"h": HEIGHT}, kind=kind)
    assert main(["launch", "--no-progress", *options, str(allowed)]) == 0
    assert "warning" not in capsys.readouterr().err

    assert main(["launch", "--no-progress", *options, str(odd)]) == 0

    assert f"fmu-mesh: warning: {odd}:" in (said := capsys.readouterr().err)
    assert f"instances.ball.start_values.h: 2.5 for {ROLES[version]}\n" in said
    result = odd.with_suffix(".csv").read_text()
    assert result == allowed.with_suffix(".csv").read_text()
    assert result.splitlines()[1].startswith("0.0,2.5,")


def simulated_by_fmpy(folder: Path, start_values: dict[str, float], output: list[str]) -> list[tuple[float, ...]]:
    """The rows of FMPy, which is asked to set variables before Initialization Mode that it would not set by itself."""
    model = fmpy.read_model_description(str(folder), validate=False)
    fmu = fmpy.instantiate_fmu(str(folder), model, "CoSimulation")
    references = {variable.name: variable.valueReference for variable in model.modelVariables}
    if model.fmiVersion == "2.0":
        fmu.setupExperiment(startTime=0.0, stopTime=STOP)
    set_values = fmu.setFloat64 if model.fmiVersion == "3.0" else fmu.setReal
    for name, value in start_values.items():
        set_values([references[name]], [value])
    match model.fmiVersion:
        case "1.0":
            fmu.initialize(tStart=0.0, stopTime=STOP)
        case "2.0":
            fmu.enterInitializationMode()
            fmu.exitInitializationMode()
        case _:
            fmu.enterInitializationMode(startTime=0.0, stopTime=STOP)
            fmu.exitInitializationMode()
    rows = fmpy.simulate_fmu(
        str(folder),
        model_description=model,
        fmu_instance=fmu,
        initialize=False,
        fmi_type="CoSimulation",
        stop_time=STOP,
        output_interval=STEP,
        output=output,
    )
    return [tuple(row) for row in rows.tolist()]


@needs_compiler
@pytest.mark.parametrize("version", [2, 3])
def test_the_values_are_those_of_fmpy(version: Version, tmp_path: Path) -> None:
    fmu = ball(version, tmp_path, calculated=True)
    folder = extract(fmu, tmp_path / "extracted", model=read_description(fmu))

    expected = simulated_by_fmpy(folder, {"h": HEIGHT}, ["h", "v"])

    config = config_with(fmu, {"h": HEIGHT}, ["ball.h", "ball.v"])
    assert main(["launch", "--local", "--no-progress", str(config)]) == 0
    rows = [tuple(map(float, line.split(","))) for line in config.with_suffix(".csv").read_text().splitlines()[1:]]
    assert rows == expected
    assert rows[0] == (0.0, HEIGHT, 0.0)
    with FMIAdapter(fmu, STEP) as adapter:
        adapter.set_initial_value("h", HEIGHT)
        adapter.exit_initialization_mode(0.0)
        for _, height, velocity in rows[1:]:
            adapter.do_step()
            assert (adapter.get_output_value("h"), adapter.get_output_value("v")) == (height, velocity)


@needs_compiler
def test_variable_without_start_value_takes_one_in_co_simulation_of_fmi_1(tmp_path: Path) -> None:
    plain = find_fmu("AllTypes1", tmp_path)
    fmu = repacked(tmp_path / "odd.fmu", source=plain, description=lambda text: text.replace(' start="2.5"', ""))
    variable = read_description(fmu).variable("real_parameter")
    assert variable is not None
    assert not variable.settable_before_start
    folder = extract(fmu, tmp_path / "extracted", model=read_description(fmu))

    expected = simulated_by_fmpy(folder, {"real_parameter": 0.5, "real_in": 3.0}, ["real_out", "real_parameter"])

    with FMIAdapter(fmu, STEP) as adapter:
        adapter.set_initial_value("real_parameter", 0.5)
        adapter.set_initial_value("real_in", 3.0)
        adapter.exit_initialization_mode(0.0)
        for _, output, parameter in expected[1:]:
            adapter.do_step()
            values = adapter.get_value("real_parameter"), adapter.get_output_value("real_out")
            assert values == (parameter, output) == (0.5, 3.0)


@needs_compiler
@pytest.mark.parametrize("version", [2, 3])
def test_the_adapter_warns_in_its_log(version: Version, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    with FMIAdapter(ball(version, tmp_path, calculated=True), STEP) as adapter:
        adapter.set_initial_value("v", 1.0)
        assert caplog.records == []

        adapter.set_initial_value("h", HEIGHT)

        (record,) = caplog.records
        assert record.levelno == logging.WARNING
        assert ROLES[version] in record.getMessage()
        adapter.exit_initialization_mode(0.0)
        assert adapter.get_output_value("h") == HEIGHT


@needs_compiler
def test_start_value_of_command_line_is_taken_as_one_of_file_is(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    fmu = ball(2, tmp_path, calculated=True)
    config = config_with(fmu, {})

    assert main(["launch", "--local", "--no-progress", "--set", "ball.h=2.5", str(config)]) == 0

    assert f"--set ball.h=2.5: 2.5 for {ROLES[2]}" in capsys.readouterr().err
    assert config.with_suffix(".csv").read_text().splitlines()[1].startswith("0.0,2.5,")


@needs_compiler
@pytest.mark.parametrize("where", ["instance", "mesh"])
def test_where_the_configuration_is_strict_it_is_refused(
    where: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    config = config_with(
        ball(2, tmp_path, calculated=True), {"h": HEIGHT, "v": 0.5}, strict=True if where == "instance" else None
    )
    if where == "mesh":
        config.write_text(f"{config.read_text()}strict: true\n")

    assert main(["launch", str(config)]) == 2

    said = capsys.readouterr().err
    assert "  - " not in said
    assert f"instances.ball.start_values.h: 2.5 for {ROLES[2]}; expected one of h, " not in said
    assert f"instances.ball.start_values.h: 2.5 for {ROLES[2]}; expected one of v, " in said
    assert "`strict: false` leaves it to the FMU" in said


def test_check_shows_warning_and_a_refusal_of_fmu_is_told_as_such(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    fmu = repacked(tmp_path / "gain.fmu")
    config = config_with(fmu, {"y": 1.0, "k": 2.0})

    assert main(["check", str(config)]) == 0
    assert (
        "start_values.y: 1.0 for 'y', an output with initial 'calculated': FMI 2.0 (2.2.7)"
        in (capsys.readouterr().out.partition("Warnings")[2])
    )
    assert main(["launch", "--local", "--no-progress", str(config)]) == 3

    said = capsys.readouterr().err.splitlines()[-1]
    assert said.startswith("fmu-mesh: instance ball")
    assert "fmi2SetReal of y, k returned error; the FMU says: " in said or "of k, y returned error" in said
    assert "FMI does not allow setting 'y', an output with initial 'calculated': leave its start value out." in said


@needs_compiler
def test_adapter_refuses_what_no_fmu_can_take_and_what_comes_too_late(tmp_path: Path) -> None:
    with FMIAdapter(ball(3, tmp_path, calculated=True), STEP) as adapter:
        with pytest.raises(CallRefused, match="time: this continuous independent is not settable before the start"):
            adapter.set_initial_value("time", 1.0)
        adapter.get_output_value("h")
        with pytest.raises(CallRefused, match="h: it can only be set before the first value is read"):
            adapter.set_initial_value("h", HEIGHT)


def test_the_adapter_tells_a_refusal_of_the_fmu() -> None:
    with FMIAdapter(FMUS / "Gain.fmu", 0.1) as adapter:
        adapter.set_initial_value("y", 1.0)

        with pytest.raises(InitializationFailed, match="fmi2SetReal of y returned error; the FMU says: ") as caught:
            adapter.exit_initialization_mode(0.0)

    assert "leave its start value out" in str(caught.value)


ARRAYS = """
import fmu_mesh

class Grid(fmu_mesh.Component):
    p = fmu_mesh.Input([[1.0, 2.0], [3.0, 4.0]], shape=(2, 2))
    q = fmu_mesh.Parameter(1.0)
    y = fmu_mesh.Output(shape=(2, 2))

    def step(self, time, step_size):
        self.y = self.p * 1.0
"""


def grid_mesh(folder: Path, start_values: Mapping[str, object] = MappingProxyType({})) -> fmu_mesh.Mesh:
    """One step of a component with an array, from a file."""
    (folder / "grid.py").write_text(ARRAYS)
    grid = {"python": "grid.py:Grid", "start_values": {**start_values}}
    simulation = {"stop_time": 0.1, "step_size": 0.1}
    (folder / "mesh.yaml").write_text(
        yaml.safe_dump({"mesh": "grids", "simulation": simulation, "instances": {"grid": grid}})
    )
    return fmu_mesh.load(folder / "mesh.yaml")


@pytest.mark.parametrize(
    ("start_values", "expected"),
    [
        ({"p[2,1]": 5}, [1.0, 2.0, 5.0, 4.0]),
        ({"p[1, 2]": 7, "p[2,2]": -0.5}, [1.0, 7.0, 3.0, -0.5]),
        ({"p[1,1]": 9, "p": [[0, 0], [0, 0]]}, [9.0, 0.0, 0.0, 0.0]),
        ({"p": [[0, 0], [0, 0]], "p[1,1]": 9}, [9.0, 0.0, 0.0, 0.0]),
    ],
)
def test_an_element_replaces_that_of_the_start_value(
    start_values: dict[str, Any], expected: list[float], tmp_path: Path
) -> None:
    given = {f"grid.{name}": value for name, value in start_values.items()}

    results = [
        grid_mesh(tmp_path, start_values).run(processes=False, record="memory"),
        grid_mesh(tmp_path).run(processes=False, record="memory", start_values=given),
        fmu_mesh.sweep(grid_mesh(tmp_path), [given], folder=tmp_path / "sweep").wait().curves(0),
    ]

    for result in results:
        assert [float(result[f"grid.y[{i},{j}]"][-1]) for i in (1, 2) for j in (1, 2)] == expected


def test_a_wrong_element_of_a_start_value_is_told(tmp_path: Path) -> None:
    wrong = {"p[1]": 1, "p[2,2]": "x", "p[3,1]": 1, "q[1]": 1, "y[1,1]": 1}

    findings = grid_mesh(tmp_path, wrong).check().findings

    assert [f"{one.path.rpartition('.')[2]}: {one.expected}" for one in findings] == [
        "p[1]: an index from [1,1] to [2,2]",
        "p[2,2]: a number",
        "p[3,1]: an index from [1,1] to [2,2]",
        "q[1]: an element of an array only: this variable is a scalar",
        "y[1,1]: one of p, q",
    ]
