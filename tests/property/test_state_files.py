"""A system that goes on from a state in a file, in a process of its own: its floats are those of one that went on."""

from __future__ import annotations

import json
import random
import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import pytest
import yaml

import fmu_mesh
from tests.helpers import DEADLINE_S, FMUS, on_a_busy_machine
from tests.onnx_models import write_network

H = 0.01
GONE_ON = 25

COMPONENT = """
import random
import numpy as np
import fmu_mesh

class Noise(fmu_mesh.Component):
    u = fmu_mesh.Input(start=np.zeros((2, 3)), shape=(2, 3))
    level = fmu_mesh.Parameter(1.0, tunable=True)
    y = fmu_mesh.Output(start=0.0)
    word = fmu_mesh.Output(type="String", start="")
    total = fmu_mesh.Output(shape=(2, 3), start=np.zeros((2, 3)))

    def __init__(self):
        self.drawn, self.dice, self.seen = np.random.default_rng(1), random.Random(2), []
        self.last, self.known = self.seen, {("a", 1): np.float32(0.1), None: 2**100}

    def step(self, time, step_size):
        self.seen.append(self.level * float(self.drawn.normal()))
        self.known["a", 1] += np.float32(self.dice.random())
        self.total = self.total + self.u * self.last[-1]
        self.y = sum(self.last[-5:]) + float(self.known["a", 1])
        self.word = f"{self.y:.3f}"
"""

FAILING = """
import fmu_mesh

class Failing(fmu_mesh.Component):
    y = fmu_mesh.Output(start=0.0)

    def step(self, time, step_size):
        if time > 0.5:
            raise ValueError("too late")
        self.y = time
"""

WORLD = """
<mujoco model="world"><option timestep="0.001"/><worldbody><geom type="plane" size="5 5 .1"/>
<body name="arm" pos="0 0 1"><joint name="swing" type="hinge" axis="0 1 0" damping="0.05"/>
<geom type="capsule" fromto="0 0 0 .4 0 0" size=".03"/></body>
<body name="ball" pos="0.2 0 0.3"><freejoint/><geom type="sphere" size=".05"/></body></worldbody></mujoco>
"""

GO_ON = """
import json, sys
import fmu_mesh
from tests.property.test_state_files import rows_from

config, names, *states = sys.argv[1:]
mesh, found = fmu_mesh.load(config), []
for state in states:
    with mesh.open(state=state) as system:
        found.append(rows_from(system, json.loads(names)))
print(json.dumps(found))
"""


@pytest.fixture(scope="module")
def everything(tmp_path_factory: pytest.TempPathFactory, event_fmu: Callable[..., Path]) -> Path:
    """A mesh of all that has a state: FMUs of all kinds, engines, rates, values over time."""
    folder = tmp_path_factory.mktemp("everything")
    (folder / "noise.py").write_text(COMPONENT, encoding="utf-8")
    (folder / "failing.py").write_text(FAILING, encoding="utf-8")
    (folder / "world.xml").write_text(WORLD, encoding="utf-8")
    write_network(folder / "network.onnx")
    instances: dict[str, dict[str, Any]] = {path.stem: {"fmu": str(path)} for path in sorted(FMUS.glob("*.fmu"))}
    instances["Integrator"] |= {"start_values": {"k": -2.0}, "step_size": 3 * H}
    instances["TransportDelay"] |= {"start_values": {"d": 0.055}, "step_size": 2 * H}
    instances["Gain"]["inputs"] = {"u": {"timeout": {"after": 0.15, "then": 0.5}}}
    for name in ("Adder", "Pump"):
        instances[name]["group"] = "together"
    model_exchange = {"kind": "model_exchange"}
    instances |= {
        "fast": {"fmu": str(FMUS / "Integrator.fmu"), "start_values": {"y": 1.0}},
        "oscillator": {"fmu": str(event_fmu("Oscillator", 2)), **model_exchange},
        "level": {"fmu": str(event_fmu("Integral", 3)), **model_exchange},
        "plain": {"fmu": str(event_fmu("Oscillator", 2)), **model_exchange, "solver": {"name": "euler"}},
        "stairs": {"fmu": str(event_fmu("Stairs", 3)), "start_values": {"period": 0.07}},
        "pid": {"controller": "position_pid", "start_values": {"p": 3.0, "i": 2.0}},
        "noise": {"python": "noise.py:Noise", "step_size": 2 * H},
        "held": {"python": "failing.py:Failing", "on_failure": "hold"},
        "world": {"mujoco": "world.xml"},
        "network": {"onnx": "network.onnx"},
    }
    content = {
        "mesh": "everything",
        "simulation": {"stop_time": 2.0, "step_size": H},
        "instances": instances,
        "connections": [
            "Integrator.y -> fast.u",
            "fast.y -> Integrator.u",
            "fast.y -> TransportDelay.x",
            "TransportDelay.y -> Adder.u1",
            "Integrator.y -> Adder.u2",
            {"from": "Adder.y", "to": "oscillator.u", "extrapolation": "linear"},
            "Adder.y -> level.u",
            "CartPole.theta -> network.observation[3]",
            "network.action -> CartPole.force",
            "world.swing.position -> pid.position",
            "world.swing.velocity -> pid.velocity",
            "pid.effort -> world.swing.effort_command",
            "oscillator.x -> noise.u[2,1]",
            "DriveProfile.linearVelocity -> PathFilter.linearVelocity",
        ],
        "scenario": {
            "values": {"pid.target": {"times": [0.1, 0.5, 1.0], "values": [0.0, 0.5, 0.2], "interpolation": "linear"}},
            "events": [{"at": 0.3, "set": {"noise.level": 0.5}}, {"at": 0.9, "set": {"noise.level": 0.7}}],
        },
        "record": {"file": "all.csv"},
    }
    config = folder / "everything.yaml"
    config.write_text(yaml.safe_dump(content, sort_keys=False), encoding="utf-8")
    return config


def test_a_fresh_process_goes_on_with_the_same_floats(everything: Path, tmp_path: Path) -> None:
    mesh, drawn = fmu_mesh.load(everything), random.Random(7)  # noqa: S311  a test
    instances = mesh.plan().plan.system.instances
    names = [f"{n}.{v.name}" for n, own in instances.items() for v in own.description.with_causality("output")]
    names += ["Gain.u", "fast.k", "pid.target", "noise.level"]
    files, expected = [str(tmp_path / "1.state"), str(tmp_path / "2.state")], []
    with mesh.open() as system:
        for file in files:
            system.step(drawn.randrange(20, 60))
            system.set("Gain.u", drawn.random())
            system.set("fast.k", drawn.random())
            system.step(drawn.randrange(1, 30))
            system.save(file)
            expected.append(rows_from(system, names))

    command = [sys.executable, "-c", GO_ON, str(everything), json.dumps(names), *files]
    limit_s = on_a_busy_machine(DEADLINE_S)
    done = subprocess.run(command, capture_output=True, text=True, timeout=limit_s, check=False)

    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout) == expected
    assert len({*expected[0], *expected[1]}) == 2 * (GONE_ON + 1)


def rows_from(system: fmu_mesh.System, names: Sequence[str]) -> list[str]:
    """The values of this point and the next ones."""
    rows = []
    for steps in (0, *[1] * GONE_ON):
        if steps:
            system.step()
        rows.append(repr([system.point, system.time, *(system.get(name) for name in names)]))
    return rows


@pytest.mark.parametrize("at", [2, 30])
def test_a_branch_equals_a_run_whose_scenario_changes_the_parameter(
    at: int, event_fmu: Callable[..., Path], tmp_path: Path
) -> None:
    file, names = tmp_path / "a.state", ("oscillator.x", "oscillator.u", "tank.y", "gain.y")

    def mesh(*, changed: bool) -> fmu_mesh.Mesh:
        made = fmu_mesh.Mesh("branch", step_size=H, stop_time=1.0)
        made.add("oscillator", fmu=event_fmu("Oscillator", 2), kind="model_exchange")
        made.add("tank", fmu=FMUS / "Integrator.fmu", step_size=2 * H)
        made.add("gain", fmu=FMUS / "Gain.fmu")
        made.connect("oscillator.x", "tank.u")
        made.connect("tank.y", "gain.u")
        if changed:
            values = {"oscillator.u": 0.5, "tank.k": 3.0, "gain.k": 2.0}
            made.scenario(events=[{"at": at * H, "set": values}])
        return made

    with mesh(changed=False).open() as system:
        system.step(at)
        system.save(file)
    branch = {"oscillator.u": 0.5, "tank.k": 3.0, "gain.k": 2.0}
    with mesh(changed=True).open() as whole, mesh(changed=False).open(branch, state=file) as system:
        whole.step(at)
        for _ in range(GONE_ON):
            system.step()
            whole.step()
            assert [system.get(name) for name in names] == [whole.get(name) for name in names]
