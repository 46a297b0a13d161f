"""What is wrong with a Zenoh key at an end of a connection is told with its path and the way out."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

import fmu_mesh
from tests.helpers import FMUS

BASE = f"""
mesh: told
simulation: {{stop_time: 2.0, step_size: 0.1}}
instances:
  gain: {{fmu: {FMUS}/Gain.fmu, start_values: {{u: 2.0}}}}
  pendulum: {{fmu: {FMUS}/DampedPendulum.fmu}}
  delay: {{fmu: {FMUS}/TransportDelay.fmu}}
  clutch: {{python: clutch.py:Clutch}}
connections:
- pendulum.a -> delay.x
- ENTRIES
record: {{file: null}}
"""
CLUTCH = """
import fmu_mesh

class Clutch(fmu_mesh.Component):
    force = fmu_mesh.Input(unit="N")
    gear = fmu_mesh.Input("low", type="Enumeration", items={"reverse": -1, "low": 1})
    speeds = fmu_mesh.Input(shape=2, unit="rad/s")
    y = fmu_mesh.Output(shape=2)
    count = fmu_mesh.Output(type="Int32")

    def step(self, time, step_size):
        self.y = self.speeds
"""
FLOAT64 = "std_msgs/msg/Float64"


def check_of(folder: Path, *entries: str) -> fmu_mesh.Check:
    """The check of a mesh with these connections after the first one."""
    (folder / "clutch.py").write_text(CLUTCH)
    path = folder / "mesh.yaml"
    path.write_text(BASE.replace("ENTRIES", "\n- ".join(entries)), encoding="utf-8")
    return fmu_mesh.load(path).check()


def only_finding(folder: Path, *entries: str) -> str:
    """The only finding, which has a line, as text without its file."""
    findings = check_of(folder, *entries).findings
    assert len(findings) == 1, findings
    assert findings[0].line is not None
    return str(findings[0]).partition("connections")[2]


@pytest.mark.parametrize(
    ("entry", "expected"),
    [
        ("{key: a/b, to: gain.v}", r"\[1\].to: the unknown variable 'v' of instance 'gain'; .* can be set: u, k"),
        ("{key: a/b, to: gian.u}", "to: the unknown instance 'gian'; .*Did you mean 'gain'"),
        ("{key: a/b, to: gain.y}", "to: 'gain.y', which is no input and no parameter"),
        ("{key: a/b, to: delay.x}", "to: 'delay.x', which is connected to 'pendulum'; .*'delay': none"),
        ("{key: a/b, to: pendulum.l}", "to: 'pendulum.l', which is a fixed parameter"),
        ("{key: a/b, to: 'clutch.speeds[1]'}", "to: .*an element of an array; expected the whole array: clutch.speeds"),
        ("{key: a/b}", "to: missing"),
        ("{key: a/b, to: gain.u, from: gain.y}", "to: an unknown key; expected one of from, key"),
        ("{key: '', to: gain.u}", "key: ''; expected a Zenoh key such as plant/pump/flow"),
        ("{key: 5, to: gain.u}", "key: 5; expected text"),
        ("{key: 'a/*', to: gain.u}", "key: 'a/.*several keys; expected one key, or `take: newest`"),
        ("{key: 'a/*', to: gain.u, take: newest, wait: true}", "wait: true for a key with a wildcard; .*one key"),
        ("{key: a/b, to: gain.u, take: oldest}", "take: 'oldest'; expected all or newest"),
        ("{key: a/b, to: gain.u, encoding: xml}", "encoding: 'xml'; expected auto or cdr or"),
        ("{key: a/b, to: gain.u, wait: 'on'}", "wait: 'on'; expected true or false"),
    ],
)
def test_a_key_for_no_input_is_a_finding(entry: str, expected: str, tmp_path: Path) -> None:
    assert re.search(expected, only_finding(tmp_path, entry))


@pytest.mark.parametrize("key", ["/a", "a/", "a//b", "a/b?c", "a#b", "a/b*", "a/$b"])
def test_what_is_no_key_of_zenoh_is_a_finding(key: str, tmp_path: Path) -> None:
    found = only_finding(tmp_path, f"{{key: '{key}', to: gain.u, take: newest}}")

    assert f"key: '{key}'; expected a Zenoh key such as plant/pump/flow, without #, ? and empty parts" in found


@pytest.mark.parametrize(
    ("keys", "expected"),
    [
        ("delay: 0.2", "delay: 0.2 for values that take effect on arrival; expected `time: timestamp`, or a field"),
        ("origin: first", "origin: first for values that take effect on arrival"),
        ("interpolation: linear", "interpolation: linear for values that take effect on arrival"),
        ("time: timestamp, delay: -1", "delay: -1; expected a time >= 0 in s"),
        ("time: timestamp, delay: .inf", "delay: inf; expected a finite number"),
        ("time: timestamp, origin: soon", "origin: 'soon'; expected first, seconds, or a time such as 2026-"),
        ("time: 'a..b'", "time: 'a..b'; expected a path such as "),
        ("field: 'a[b'", r"field: 'a\[b'; expected a path such as sensors\[0\].value"),
    ],
)
def test_a_time_that_means_nothing_is_a_finding(keys: str, expected: str, tmp_path: Path) -> None:
    assert re.search(expected, only_finding(tmp_path, f"{{key: a/b, to: gain.u, {keys}}}"))


@pytest.mark.parametrize("target", ["clutch.gear", "gain.k"])
def test_only_inputs_of_type_real_may_be_linear(target: str, tmp_path: Path) -> None:
    found = only_finding(tmp_path, f"{{key: a/b, to: {target}, time: timestamp, interpolation: linear}}")

    assert re.search(f"interpolation: linear for '{target}', .*; expected hold; inputs of type Real may be", found)


@pytest.mark.parametrize(
    ("keys", "expected"),
    [
        ("encoding: cdr", "type: `encoding: cdr` without a type; expected the type of a ROS message"),
        (f"type: {FLOAT64}", "type: a type for `encoding: (auto|json)`; .*`encoding: cdr`"),
        ("encoding: cdr, type: std_msgs/msg/Flot64", f"type: the unknown message type .*Did you mean '{FLOAT64}'"),
        (f"encoding: cdr, type: {FLOAT64}, field: datta", "field: .* has no field 'datta'.*Did you mean 'data'"),
        ("encoding: cdr, type: std_msgs/msg/String", "field: 'data' of 'std_msgs/msg/String' for 'gain"),
    ],
)
def test_a_message_of_ros_that_does_not_fit_is_a_finding(keys: str, expected: str, tmp_path: Path) -> None:
    assert re.search(expected, only_finding(tmp_path, f"{{key: a/b, to: gain.u, {keys}}}"))
    assert re.search(expected, only_finding(tmp_path, f"{{from: gain.y, key: a/b, {keys}}}"))


def test_the_time_of_a_message_is_that_of_its_header(tmp_path: Path) -> None:
    found = only_finding(tmp_path, f"{{key: a/b, to: gain.u, encoding: cdr, type: {FLOAT64}, time: t}}")

    assert "time: the field 't' of a message; expected arrival, timestamp or header.stamp" in found


@pytest.mark.parametrize(
    ("entry", "expected"),
    [
        ("{key: a/b, to: clutch.gear, factor: 2}", "factor 2 and offset 0 for the Enumeration 'gear'; .*Real only"),
        ("{from: clutch.count, key: a/b, offset: 1}", "factor 1 and offset 1 for the Int32 'count'; .*Real only"),
        ("{key: a/b, to: clutch.gear, encoding: float64}", "encoding: float64 for the Enumeration.*a Float64"),
        ("{from: clutch.count, key: a/b, encoding: float64}", "encoding: float64 for the Int32.*a Float64"),
        ("{key: a/b, to: gain.u, map: {open: 1}, factor: 2}", "map: a map, and factor and offset; expected one"),
        ("{key: a/b, to: gain.u, map: {open: wide}}", "map.open: 'wide' for the Real 'u'; expected a number"),
        ("{key: a/b, to: clutch.gear, map: {open: lo}}", "map.open: 'lo' for the Enum.*Did you mean 'low'"),
        ("{key: a/b, to: clutch.speeds, map: {open: 1}}", "map: a map for the array 'speeds'; .*a scalar"),
        ("{key: a/b, to: clutch.force, unit: m}", "unit: 'm' .m. for 'force' in N .*same dimension"),
        ("{key: a/b, to: clutch.force, unit: furlong}", "unit: the unknown unit 'furlong'"),
        ("{key: a/b, to: gain.u, unit: N}", "unit: 'N' for 'u', .*: it has no unit; .*no unit here"),
        ("{from: clutch.count, key: a/b, unit: N}", "unit: a unit for 'count', an output of type Int32"),
    ],
)
def test_a_change_that_no_value_can_have_is_a_finding(entry: str, expected: str, tmp_path: Path) -> None:
    assert re.search(expected, only_finding(tmp_path, entry))


@pytest.mark.parametrize(
    ("entry", "expected"),
    [
        ("{from: gain.z, key: a/b}", "from: the unknown variable 'z' of instance 'gain'; .*outputs of 'gain': y"),
        ("{from: gain.y, key: 'a/*'}", "key: 'a/.*one key, without wildcards"),
        ("{from: gain.y, key: fmu_mesh/told/gain/out/y}", "key: 'fmu_mesh.* not below fmu_mesh/told/"),
        ("{from: gain.y, key: a/b, every: 0.05}", "every: 0.05 s; expected a multiple of the step size 0.1 s"),
        ("{from: gain.y, key: a/b, every: 0}", "every: 0 s; expected a multiple of the step size"),
        ("{from: gain.y, key: a/b, on: never}", "on: 'never'; expected change or point"),
        ("{from: gain.y, key: a/b, field: data}", "field: a field for `encoding: json`; expected `encoding: cdr`"),
        ("{from: gain.y, key: a/b, encoding: auto}", "encoding: 'auto'; expected cdr or"),
        ("{from: gain.y, key: a/b, congestion: wait}", "congestion: 'wait'; expected block or drop"),
    ],
)
def test_an_output_that_no_key_can_have_is_a_finding(entry: str, expected: str, tmp_path: Path) -> None:
    assert re.search(expected, only_finding(tmp_path, entry))


def test_an_input_has_one_source_and_a_key_has_one_output(tmp_path: Path) -> None:
    two_keys = only_finding(tmp_path, "{key: a/b, to: gain.u}", "{key: c/d, to: gain.u}")
    key_and_output = only_finding(tmp_path, "{key: a/b, to: gain.u}", "pendulum.a -> gain.u")
    two_outputs = only_finding(tmp_path, "{from: gain.y, key: a/b}", "{from: pendulum.a, key: a/b}")

    assert "[2].to: 'gain.u', which is connected to 'key a/b'" in two_keys
    assert "[1].to: 'gain.u', which is connected to 'pendulum'" in key_and_output
    assert "[2].key: 'a/b' a second time; expected a key of its own for each output" in two_outputs


def test_all_findings_of_keys_are_told_at_once(tmp_path: Path) -> None:
    findings = check_of(
        tmp_path, "{key: 'a/*', to: gain.v, delay: 1}", "{from: gain.y, key: '#', every: 0.05}"
    ).findings

    paths = ["[1].to", "[1].key", "[1].delay", "[2].key", "[2].every"]
    assert [one.path for one in findings] == [f"connections{path}" for path in paths]


def test_keys_and_their_rules_are_in_the_plan_and_on_the_page(tmp_path: Path) -> None:
    entries = (
        "{key: 'plant/*/flow', to: gain.u, take: newest}",
        "{key: plant/force, to: clutch.force, field: 'sensors[0].value', time: at, delay: 0.2, interpolation: linear}",
        "{key: plant/gear, to: clutch.gear, encoding: text, time: timestamp, wait: true}",
        "{from: gain.y, key: twin/y, every: 0.2}",
        "{from: gain.y, key: twin/changes, on: change, every: 0.2, encoding: text}",
        f"{{from: 'clutch.y[2]', key: twin/speed, encoding: cdr, type: {FLOAT64}, congestion: block}}",
    )
    check = check_of(tmp_path, *entries)

    assert check.plan is not None
    assert check.plan.free_inputs == ["clutch.speeds"]
    assert [key.cells for key in check.plan.keys] == [
        ["plant/*/flow -> gain.u", "auto", "on arrival"],
        ["gain.y -> twin/y", "json", "every 2 points"],
        ["gain.y -> twin/changes", "text", "on change, at most every 2 points"],
        ["plant/force -> clutch.force", "auto sensors[0].value", "at its at, 0.2 s later, linear"],
        ["plant/gear -> clutch.gear", "text", "at its timestamp, the run waits for it"],
        ["clutch.y[2] -> twin/speed", FLOAT64, "at each point, the run waits for who is slow"],
    ]
    section = check.page.partition("Zenoh keys\n")[2].partition("\n\n")[0]
    assert [re.split(" {2,}", line.strip()) for line in section.splitlines()] == [k.cells for k in check.plan.keys]
    assert "'plant/" not in check.page.partition("Inputs that are not connected")[2]
