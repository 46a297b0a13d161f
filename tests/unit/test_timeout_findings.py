"""What is wrong with the timeout of an input is told with its path and the way out."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

import fmu_mesh
from tests.helpers import FMUS

BASE = f"""
mesh: told
simulation: {{start_time: 1.0e9, stop_time: 1000000002.0, step_size: 0.1}}
instances:
  gain: {{fmu: {FMUS}/Gain.fmu, start_values: {{u: 2.0}}, step_size: 0.2, INPUTS}}
  pendulum: {{fmu: {FMUS}/DampedPendulum.fmu}}
  delay: {{fmu: {FMUS}/TransportDelay.fmu, DELAY}}
  clutch: {{python: clutch.py:Clutch, CLUTCH}}
connections: [pendulum.a -> delay.x]
record: {{file: null}}
"""
CLUTCH = """
import fmu_mesh

class Clutch(fmu_mesh.Component):
    force = fmu_mesh.Input(min=0.0, max=10.0)
    gear = fmu_mesh.Input("low", type="Enumeration", items={"reverse": -1, "low": 1})
    speeds = fmu_mesh.Input(shape=2)
    y = fmu_mesh.Output()

    def step(self, time, step_size):
        self.y = self.force
"""


def written(folder: Path, **inputs: str) -> Path:
    """A mesh with these inputs of its instances."""
    (folder / "clutch.py").write_text(CLUTCH)
    text = BASE
    for name in ("gain", "delay", "clutch"):
        key = "INPUTS" if name == "gain" else name.upper()
        text = text.replace(f", {key}", f", inputs: {inputs[name]}" if name in inputs else "")
    path = folder / "mesh.yaml"
    path.write_text(text, encoding="utf-8")
    return path


@pytest.mark.parametrize(
    ("instance", "inputs", "expected"),
    [
        ("gain", "{v: {timeout: {after: 1, then: hold}}}", "gain.inputs.v: the unknown input 'v'; expected .* u"),
        ("gain", "{k: {timeout: {after: 1, then: hold}}}", "gain.inputs.k: the unknown input 'k'"),
        ("delay", "{x: {timeout: {after: 1, then: hold}}}", "delay.inputs.x: 'x', which is connected; .*: none"),
        ("gain", "{u: {timeout: {after: 0, then: hold}}}", "gain.inputs.u.timeout.after: 0; expected a time > 0 in s"),
        ("gain", "{u: {timeout: {after: -0.5, then: hold}}}", "timeout.after: -0.5; expected a time > 0"),
        ("gain", "{u: {timeout: {after: .inf, then: hold}}}", "timeout.after: "),
        ("gain", "{u: {timeout: {then: hold}}}", "timeout.after: missing"),
        ("gain", "{u: {timeout: {after: 1}}}", "timeout.then: missing"),
        ("gain", "{u: {timeout: {after: soon, then: hold}}}", "timeout.after: 'soon'"),
        ("gain", "{u: {timeoutt: {after: 1, then: hold}}}", "unknown key.*Did you mean 'timeout'"),
        (
            "gain",
            "{u: {timeout: {after: 1, then: off}}}",
            "then: 'off' for the Real 'u'; expected hold, start, stop, or",
        ),
        ("gain", "{u: {timeout: {after: 1, then: true}}}", "then: true for the Real 'u'"),
        ("gain", "{u: {timeout: {after: 1, then: NaN}}}", "then: 'NaN' for the Real 'u'.*a finite number"),
        ("clutch", "{force: {timeout: {after: 1, then: 11}}}", "then: 11 for the .*'force'.*<= 10"),
        ("clutch", "{gear: {timeout: {after: 1, then: lo}}}", "then: 'lo' for the Enumeration 'gear'.*mean 'low'"),
        ("clutch", "{speeds: {timeout: {after: 1, then: [1]}}}", "then: .* for the .*'speeds'.*a list of 2 values"),
        ("clutch", "{'speeds[1]': {timeout: {after: 1, then: 0}}}", "the unknown input 'speeds.1.'"),
    ],
)
def test_a_wrong_timeout_is_a_finding_with_its_path(instance: str, inputs: str, expected: str, tmp_path: Path) -> None:
    findings = fmu_mesh.load(written(tmp_path, **{instance: inputs})).check().findings

    assert len(findings) == 1, findings
    assert findings[0].line is not None
    assert findings[0].path.startswith(f"instances.{instance}.inputs.")
    assert re.search(expected, str(findings[0])), str(findings[0])


@pytest.mark.parametrize(
    ("after", "steps"), [("0.2", 1), ("1e-9", 1), ("0.21", 2), ("0.6", 3), ("0.6000001", 4), ("1e300", 2**53)]
)
def test_a_timeout_is_counted_in_whole_steps_of_the_instance(after: str, steps: int, tmp_path: Path) -> None:
    config = written(tmp_path, gain=f"{{u: {{timeout: {{after: {after}, then: start}}}}}}")

    [timeout] = fmu_mesh.load(config).plan().plan.system.instances["gain"].timeouts

    assert (timeout.steps, timeout.points, timeout.value) == (steps, 2, 2.0)


def test_a_value_may_be_an_item_an_array_or_start(tmp_path: Path) -> None:
    inputs = {"force": "start", "gear": "reverse", "speeds": "[1, 2.5]"}
    given = ", ".join(f"{name}: {{timeout: {{after: 1, then: {then}}}}}" for name, then in inputs.items())

    timeouts = fmu_mesh.load(written(tmp_path, clutch=f"{{{given}}}")).plan().plan.system.instances["clutch"].timeouts

    assert [own.value for own in timeouts] == [0.0, -1, [1.0, 2.5]]


def test_a_program_adds_an_instance_with_a_timeout() -> None:
    mesh = fmu_mesh.Mesh("quiet", step_size=0.1, stop_time=1.0)
    mesh.add("gain", fmu=FMUS / "Gain.fmu", inputs={"u": {"timeout": {"after": 0.5, "then": 3.0}}})
    changed = {"instances.gain.inputs.u.timeout.after": 0.2}

    assert mesh.run(processes=False, record="memory")["gain.y"].tolist() == [0.0] * 6 + [3.0] * 5
    assert mesh.run(processes=False, record="memory", config_values=changed)["gain.y"].tolist() == [0.0] * 3 + [3.0] * 8
