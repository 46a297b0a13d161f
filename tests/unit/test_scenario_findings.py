"""What is wrong with a scenario is told with its file, its line and the way out."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest

import fmu_mesh
from tests.helpers import FMUS

BASE = f"""
mesh: told
simulation: {{stop_time: 1.0, step_size: 0.1}}
instances:
  gain: {{fmu: {FMUS}/Gain.fmu, start_values: {{k: 2.0}}}}
  pendulum: {{fmu: {FMUS}/DampedPendulum.fmu}}
  delay: {{fmu: {FMUS}/TransportDelay.fmu}}
connections: [pendulum.a -> delay.x]
record: {{file: null}}
"""


def findings_of(folder: Path, scenario: str) -> list[str]:
    """The findings for a scenario in the configuration, from its line 11 on."""
    path = folder / "mesh.yaml"
    path.write_text(f"{BASE}scenario:\n{scenario}", encoding="utf-8")
    return [str(finding).replace(f"{folder}/", "") for finding in fmu_mesh.load(path).check().findings]


@pytest.mark.parametrize(
    ("scenario", "expected"),
    [
        ("  values: {gain.uu: 1.0}", "values.gain.uu: the unknown variable 'uu' of instance 'gain'.*Did you mean 'u'?"),
        ("  values: {gian.u: 1.0}", "the unknown instance 'gian'.*Did you mean 'gain'"),
        ("  values: {delay.x: 1.0}", "'delay.x', which is connected to 'pendulum'"),
        ("  values: {pendulum.a: 1.0}", "'pendulum.a', which is no input and no parameter"),
        ("  values: {gain.u: on}", "'on' for the Real 'u'; expected a number"),
        ("  values: {gain.u: {times: [0, 2, 1], values: [1, 2, 3]}}", r"times\[2\]: 1 s after 2 s"),
        ("  values: {gain.u: {times: [0, 1], values: [1]}}", "1 values for 2 times"),
        ("  values: {gain.u: {times: [0, 1]}}", "values.gain.u.values: missing"),
        ("  values: {gain.u: {times: [0], values: [a]}}", r"values\[0\]: 'a' for the Real 'u'"),
        ("  values: {gain.u: {file: no.csv}}", "no.csv', which cannot be read"),
        ("  values: {gain.u: {column: x}}", "'column' without a file"),
        ("  values: {gain.u: {file: t.csv, topic: /x}}", "missing|cannot be read|does not exist|rosbags"),
        (
            "  values: {gain.k: {times: [1, 2], values: [1, 2], interpolation: linear}}",
            "linear for 'gain.k', a parameter",
        ),
        ("  values: {gain.k: 3.0}", "a value of 'gain.k' at the start, which has the start value 2.0, too"),
        ("  values: {gain.u: {times: [0], values: [1], unit: parsec}}", "the unknown unit 'parsec'"),
        ("  events: [{at: 0.5, set: {gain.u: 1}}, {at: 0.5, set: {gain.u: 2}}]", "'gain.u' at 0.5 s a second time"),
        (
            " {values: {gain.u: {times: [0], values: [0], interpolation: linear}}, events: [{at: 1,set: {gain.u: 1}}]}",
            r"events\[0\].set.gain.u: an event for 'gain.u', which changes linearly",
        ),
        ("  events: [{at: later, set: {gain.u: 1}}]", r"events\[0\].at: 'later'; expected a finite number"),
        ("  event: []", "unknown key.*Did you mean 'events'"),
    ],
)
def test_a_wrong_scenario_is_a_finding_with_its_line(scenario: str, expected: str, tmp_path: Path) -> None:
    found = findings_of(tmp_path, scenario)

    assert len(found) == 1, found
    assert found[0].startswith(("mesh.yaml:11: scenario.", "mesh.yaml:12: scenario.", "mesh.yaml:10: scenario"))
    assert re.search(expected, found[0]), found[0]


def test_all_findings_of_a_scenario_stand_together_with_those_of_the_rest(tmp_path: Path) -> None:
    path = tmp_path / "mesh.yaml"
    text = BASE.replace("k: 2.0", "kk: 2.0") + "scenario: {values: {gain.v: 1, gain.w: 2}}"
    path.write_text(text, encoding="utf-8")

    assert [finding.line for finding in fmu_mesh.load(path).check().findings] == [5, 10, 10]


def test_scenario_of_its_own_is_told_by_its_own_file_and_lines(tmp_path: Path) -> None:
    (tmp_path / "drive.yaml").write_text("values:\n  gain.u: 1.0\nevents:\n  - {at: 0.5, set: {gain.q: 2}}\n")
    path = tmp_path / "mesh.yaml"
    path.write_text(f"{BASE}scenario: drive.yaml\n", encoding="utf-8")

    [found] = fmu_mesh.load(path).check().findings

    assert (Path(found.file).name, found.line, found.path) == ("drive.yaml", 4, "events[0].set.gain.q")


@pytest.mark.parametrize(
    ("text", "line", "expected"), [("values: [1]", 1, "a mapping"), ("value: {}", 1, "one of values, events")]
)
def test_a_scenario_file_of_another_structure(text: str, line: int, expected: str, tmp_path: Path) -> None:
    (tmp_path / "drive.yaml").write_text(text)
    path = tmp_path / "mesh.yaml"
    path.write_text(f"{BASE}scenario: drive.yaml\n", encoding="utf-8")

    [found] = fmu_mesh.load(path).check().findings

    assert (Path(found.file).name, found.line) == ("drive.yaml", line)
    assert expected in found.expected


def test_a_missing_scenario_file_names_the_nearest_one(tmp_path: Path) -> None:
    (tmp_path / "drive.yaml").write_text("values: {}")
    path = tmp_path / "mesh.yaml"
    path.write_text(f"{BASE}scenario: drve.yaml\n", encoding="utf-8")

    [found] = fmu_mesh.load(path).check().findings

    assert "no such file 'drve.yaml'" in found.found
    assert "drive.yaml" in str(found.suggestion)


@pytest.mark.parametrize(
    ("table", "given", "expected"),
    [
        ("time,u\n0,1\n1,x\n", {}, "'x' in row 2 of the column 'u'; expected a number"),
        ("time,u\n0,1\n2,1\n1,1\n", {}, "the time 1 s in line 4, after 2 s"),
        ("t,u\n0,1\n", {}, "the unknown column 'time' of 't.csv'; expected one of t, u"),
        ("time,u\n0,1\n", {"column": "v"}, "the unknown column 'v' of 't.csv'; expected one of time, u"),
        ("time,u\n", {}, "without a row"),
        ("", {}, "without a first line"),
        ("time,u\n0\n", {}, "1 cells in line 2"),
    ],
)
def test_a_wrong_table_is_told_by_its_line(table: str, given: dict[str, Any], expected: str, tmp_path: Path) -> None:
    (tmp_path / "t.csv").write_text(table)
    path = tmp_path / "mesh.yaml"
    path.write_text(BASE)
    mesh = fmu_mesh.load(path)
    mesh.scenario({"gain.u": {"file": "t.csv", **given}})

    [found] = mesh.check().findings

    assert expected in str(found)


@pytest.mark.parametrize(
    ("values", "events", "path", "time"),
    [
        ({}, [{"at": 1000.0, "set": {"gain.u": 1.0}}], "events[0].set.gain.u", "1000"),
        ({"gain.u": 1.0}, [{"at": 0.5, "set": {"gain.u": 2}}, {"at": 1.5, "set": {"gain.u": 3}}], "events[1]", "1.5"),
        ({"gain.u": {"times": [0, 0.5, 2, 3], "values": [0, 1, 2, 3]}}, [], "values.gain.u.times[2]", "2"),
        (
            {"gain.u": {"times": [0, 0.5, 2, 3], "values": [0, 1, 2, 3], "interpolation": "linear"}},
            [],
            "values.gain.u.times[3]",  # the line that ends at 2 s is in use before
            "3",
        ),
        ({"gain.u": {"file": "t.csv"}}, [], "values.gain.u", "5"),
    ],
)
def test_a_value_that_is_never_reached_is_a_warning(
    values: dict[str, Any], events: list[dict[str, Any]], path: str, time: str, tmp_path: Path
) -> None:
    (tmp_path / "t.csv").write_text("time,u\n5,1\n6,2\n")
    (tmp_path / "mesh.yaml").write_text(BASE)
    mesh = fmu_mesh.load(tmp_path / "mesh.yaml")
    mesh.scenario(values, events)

    check, longer = mesh.check(), mesh.check(stop_time=2000.0)

    assert check
    [warning] = check.warnings
    assert f"scenario.{path}" in warning
    assert warning.endswith(f"never reached: at {time} s, stop time 1 s; expected a time up to 0.9 s: the last step")
    assert not longer.warnings


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("gain.kk", "expected one of the variables of 'gain' that can be set: k, u. Did you mean 'k'?"),
        ("delay.xx", "expected one of the variables of 'delay' that can be set: none"),
        ("gain.y", "expected an input that is not connected, or a tunable parameter of 'gain': u, k"),
    ],
)
def test_a_wrong_name_in_a_scenario_offers_what_can_be_set(name: str, expected: str, tmp_path: Path) -> None:
    [found] = findings_of(tmp_path, f"  values: {{{name}: 1.0}}")

    assert found.endswith(expected)


def test_check_shows_what_a_scenario_does(tmp_path: Path) -> None:
    (tmp_path / "t.csv").write_text("t;a;gain.u\n0;0;1\n0.5;0;2\n0.7;0;4\n")
    path = tmp_path / "mesh.yaml"
    path.write_text(BASE)
    mesh = fmu_mesh.load(path)
    mesh.scenario(
        {"gain.u": {"file": "t.csv", "time": "t", "interpolation": "linear"}},
        [{"at": 0.55, "set": {"gain.k": 3}}],
    )

    page = mesh.check().page

    assert "gain.u  3 values from 0 s to 0.7 s  linear  column 'gain.u' of" in page
    assert "gain.k  = 3.0 from 0.6 s on" in page
    plan = mesh.check().plan
    assert plan is not None
    assert [(own.variable, own.values, own.interpolation) for own in plan.scenario] == [
        ("gain.u", 3, "linear"),
        ("gain.k", 1, "hold"),
    ]


def test_another_table_or_other_values_give_another_digest(tmp_path: Path) -> None:
    path = tmp_path / "mesh.yaml"
    path.write_text(BASE)
    digests = set()
    for table, k in (("time,u\n0,1\n", 3), ("time,u\n0,2\n", 3), ("time,u\n0,2\n", 4)):
        (tmp_path / "t.csv").write_text(table)
        mesh = fmu_mesh.load(path)
        mesh.scenario({"gain.u": {"file": "t.csv"}}, [{"at": 0.5, "set": {"gain.k": k}}])
        digests.add(mesh.plan().plan.digest)

    assert len(digests) == 3


def test_a_table_at_another_place_gives_the_same_digest(tmp_path: Path) -> None:
    digests = set()
    for name in ("one", "two"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "t.csv").write_text("time,u\n0,1\n")
        path = tmp_path / name / "mesh.yaml"
        path.write_text(f"{BASE}scenario: {{values: {{gain.u: {{file: t.csv}}}}}}")
        digests.add(fmu_mesh.load(path).plan().plan.digest)

    assert len(digests) == 1


def test_units_are_converted(tmp_path: Path) -> None:
    """The damper of the tests has a speed in m/s; 1000 mm/s are 1 m/s."""
    path = tmp_path / "mesh.yaml"
    path.write_text(
        f"mesh: m\nsimulation: {{stop_time: 1.0, step_size: 0.5}}\nrecord: {{file: null}}\n"
        f"instances: {{it: {{fmu: {FMUS}/CartPole.fmu}}}}\n"
    )
    mesh = fmu_mesh.load(path)
    plan = mesh.plan().plan
    inputs = [v for v in plan.system.instances["it"].description.variables if v.causality == "input"]
    assert inputs[0].unit == "N", inputs[0]
    name = inputs[0].name
    mesh.scenario({f"it.{name}": {"times": [0, 0.5], "values": [1500.0, 0.0], "unit": "mN"}})

    assert mesh.plan().plan.system.instances["it"].start_values[name] == pytest.approx(1.5, rel=1e-15)

    mesh.scenario({f"it.{name}": {"times": [0, 0.5], "values": [1500.0, 0.0], "unit": "rad"}})
    [found] = mesh.check().findings
    assert "'rad' (rad) for" in found.found
