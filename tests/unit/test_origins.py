"""Where values of a configuration come from: other files, options, and what a file leaves to options."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

import fmu_mesh
from fmu_mesh.cli.main import main
from fmu_mesh.config.findings import Findings, ValueOrigin
from fmu_mesh.config.loading import PlainConfig
from fmu_mesh.errors import ConfigurationError, Finding
from fmu_mesh.run.options import PlanOptions
from fmu_mesh.run.overriding import with_options
from tests.helpers import FMUS

NEEDED = {
    "simulation.step_size": "`step_size`",
    "simulation.stop_time": "`stop_time`",
    "simulation.algorithm": "`algorithm`",
}
TIMES = {"step_size": 0.1, "stop_time": 1.0}


def package(**parts: Any) -> PlainConfig:  # noqa: ANN401  parts of a configuration
    """What a package gives: a gain with a start value that another file has written."""
    values = parts.pop("start_values", {"k": 2.0})
    data = {
        "mesh": "m",
        "simulation": parts.pop("simulation", TIMES),
        "instances": {"gain": {"fmu": str(FMUS / "Gain.fmu"), "start_values": values}},
        "record": {"file": None},
    }
    origins = {
        f"instances.gain.start_values.{name}": ValueOrigin("m.ssp/a.ssv", line, f"Parameter '{name}'")
        for line, name in enumerate(values, 7)
    }
    lines = {"": 1, "simulation": 2, "instances.gain": 30}
    return PlainConfig(data, Path("m.ssp/SystemStructure.ssd"), lines, origins=origins, **parts)


def mesh(**parts: Any) -> fmu_mesh.Mesh:  # noqa: ANN401  as above
    return fmu_mesh.Mesh.from_configuration(package(**parts))


def test_a_finding_about_a_start_value_has_its_file_and_line() -> None:
    check = mesh(start_values={"k": "two", "kk": 1.0}).check()

    assert [(one.file, one.line, one.path) for one in check.findings] == [
        ("m.ssp/a.ssv", 7, "instances.gain.start_values.k"),
        ("m.ssp/a.ssv", 8, "instances.gain.start_values.kk"),
    ]
    assert str(check.findings[1]).startswith("m.ssp/a.ssv:8: instances.gain.start_values.kk: the unknown variable 'kk'")


def test_findings_of_several_files_are_in_the_order_of_files_and_lines() -> None:
    findings = Findings("a.ssd", {"x": 9, "y": 2}, None, (), {"z": ValueOrigin("b.ssv", 1)})
    for path in ("z", "x", "y"):
        findings.add(path, "wrong", "")

    with pytest.raises(ConfigurationError) as caught:
        findings.raise_any()

    assert [str(one) for one in caught.value.findings] == [
        "a.ssd:2: y: wrong",
        "a.ssd:9: x: wrong",
        "b.ssv:1: z: wrong",
    ]


def test_the_innermost_place_counts_whichever_file_has_it() -> None:
    origins = {"instances.a": ValueOrigin("inner.ssd", 4)}
    findings = Findings("a.ssd", {"instances": 1, "instances.a.fmu": 9}, None, (), origins)
    for path in ("instances.a.fmu", "instances.a.kind", "instances.b"):
        findings.add(path, "wrong", "")

    assert [(one.file, one.line) for one in findings] == [("a.ssd", 9), ("inner.ssd", 4), ("a.ssd", 1)]


def test_check_shows_where_each_start_value_was_written() -> None:
    made = mesh(start_values={"k": 2.0, "u": 3.0})

    check = made.check(start_values={"gain.u": 4.0})

    page = str(check).splitlines()
    start = page.index("Start values")
    assert page[start + 1 : start + 3] == [
        "  gain.k  = 2.0  Parameter 'k' (m.ssp/a.ssv:7)",
        "  gain.u  = 4.0  `start_values={'gain.u': 4.0}`",
    ]
    assert check.plan is not None
    origins = check.plan.instances[0].origins
    assert (origins["k"].file, origins["k"].line, origins["k"].text) == ("m.ssp/a.ssv", 7, "Parameter 'k'")
    assert (origins["u"].file, origins["u"].line, origins["u"].text) == (None, None, "`start_values={'gain.u': 4.0}`")


def test_a_value_that_the_scenario_prescribes_from_start_is_that_of_scenario() -> None:
    made = mesh(start_values={"u": 1.0})
    made.scenario({"gain.k": 5.0, "gain.u": {"times": [0.5, 1.0], "values": [1.0, 2.0]}})

    plan = made.check().plan

    assert plan is not None
    assert plan.instances[0].start_values["k"] == 5.0
    assert plan.instances[0].origins["k"].file == "m.ssp/SystemStructure.ssd"
    assert plan.instances[0].origins["u"].file == "m.ssp/a.ssv"


def test_warnings_of_the_file_are_warnings_of_the_mesh() -> None:
    warning = Finding("m.ssp/SystemStructure.ssd", "Component 'gain'", "geometry, which has no effect", "", line=5)

    check = mesh(warnings=(warning,)).check()

    assert check.warnings == ("m.ssp/SystemStructure.ssd:5: Component 'gain': geometry, which has no effect",)
    assert check.warnings[0] in str(check)


# --- what options give


@pytest.mark.parametrize("given", [{}, {"start_time": 1.0}], ids=["no key", "another key"])
def test_what_package_does_not_say_is_asked_for_by_name_and_once(given: dict[str, Any]) -> None:
    check = mesh(simulation=given, needed=NEEDED).check()

    assert [str(one) for one in check.findings] == [
        f"m.ssp/SystemStructure.ssd:2: {key}: the package gives none; expected {option}"
        for key, option in NEEDED.items()
    ]


def test_options_give_what_the_package_does_not_say() -> None:
    made = mesh(simulation={}, needed=NEEDED)

    check = made.check(step_size=0.1, algorithm="jacobi")
    plan = made.plan(step_size=0.1, algorithm="jacobi", stop_time=1.0, config_values={})
    result = made.run(step_size=0.1, algorithm="jacobi", stop_time=1.0, processes=False, record="memory")

    assert [one.path for one in check.findings] == ["simulation.stop_time"]
    assert plan.loaded.config.simulation.algorithm == "jacobi"
    assert plan.plan.grid.last_point == 10
    assert len(result.times) == 11


def test_a_key_that_is_set_by_its_path_is_there_as_well() -> None:
    plain = package(simulation={}, needed=NEEDED)._replace(data={"mesh": "m", "simulation": {"step_size": 0.1}})

    assert [one.path for one in with_options(plain, PlanOptions()).findings] == [
        "simulation.stop_time",
        "simulation.algorithm",
    ]


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ({"algorithm": "jacob", "step_size": 0.1}, "`algorithm='jacob'`: 'jacob'; expected "),
        ({"algorithm": "jacobi", "step_size": -0.1}, "`step_size=-0.1`: -0.1; expected a step size > 0 in s"),
        ({"algorithm": "jacobi", "step_size": 0.3}, "`stop_time=1.0`: 1 s between start_time and stop_time"),
    ],
)
def test_a_wrong_value_of_such_option_is_one_finding_that_names_option(options: dict[str, Any], says: str) -> None:
    check = mesh(simulation={}, needed=NEEDED).check(stop_time=1.0, **options)

    assert len(check.findings) == 1
    assert says in str(check.findings[0])


YAML = f"""\
mesh: bare
simulation: {{}}
instances: {{gain: {{fmu: {FMUS / "Gain.fmu"}, start_values: {{k: 2.0}}}}}}
record: {{file: null}}
"""


def test_a_yaml_file_may_leave_them_out_too(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "bare.yaml"
    path.write_text(YAML, encoding="utf-8")

    assert main(["check", str(path)]) == 2
    missing = capsys.readouterr().err
    assert main(["check", str(path), "--step-size", "0.1", "--stop-time", "1", "--json"]) == 0
    plan = json.loads(capsys.readouterr().out)["plan"]

    assert "simulation.stop_time: missing" in missing
    assert "simulation.step_size: missing" in missing
    assert (plan["simulation"]["step_size"], plan["last_point"]) == (0.1, 10)
    assert plan["instances"][0]["origins"] == {"k": {"file": str(path), "line": 3, "text": ""}}


def test_a_yaml_file_without_the_section_may_get_it_from_options(tmp_path: Path) -> None:
    path = tmp_path / "bare.yaml"
    path.write_text(YAML.replace("simulation: {}\n", ""), encoding="utf-8")

    assert fmu_mesh.load(path).plan(step_size=0.1, stop_time=1.0).plan.grid.last_point == 10


def test_a_section_that_is_no_mapping_stays_the_error_that_it_is(tmp_path: Path) -> None:
    path = tmp_path / "bare.yaml"
    path.write_text(YAML.replace("simulation: {}", "simulation: 3"), encoding="utf-8")

    findings = fmu_mesh.load(path).check(step_size=0.1, stop_time=1.0).findings

    assert [(one.path, one.found) for one in findings] == [("simulation", "3")]


def test_an_option_and_another_one_for_same_key_do_not_go_together(tmp_path: Path) -> None:
    path = tmp_path / "bare.yaml"
    path.write_text(YAML, encoding="utf-8")
    options = {"step_size": 0.1, "stop_time": 1.0, "config_values": {"simulation.step_size": 0.2}}

    findings = fmu_mesh.load(path).check(**options).findings  # type: ignore[arg-type]  # options by name

    assert [one.found for one in findings] == ["replaced by `step_size=...` as well"]
