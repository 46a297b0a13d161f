"""A system that goes on from a state in a file, in a process of its own: its floats are those of one that went on."""

from __future__ import annotations

import json
import random
import subprocess
import sys
from collections.abc import Callable
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

WORLD = """
<mujoco model="world"><option timestep="0.001"/><worldbody><geom type="plane" size="5 5 .1"/>
<body name="arm" pos="0 0 1"><joint name="swing" type="hinge" axis="0 1 0" damping="0.05"/>
<geom type="capsule" fromto="0 0 0 .4 0 0" size=".03"/></body>
<body name="ball" pos="0.2 0 0.3"><freejoint/><geom type="sphere" size=".05"/></body></worldbody></mujoco>
"""

GO_ON = """
import json, sys
import fmu_mesh

config, state, names, points = sys.argv[1], sys.argv[2], json.loads(sys.argv[3]), int(sys.argv[4])
rows = []
with fmu_mesh.load(config).open(state=state) as system:
    for _ in range(points + 1):
        rows.append(repr([system.point, system.time, *(system.get(name) for name in names)]))
        if _ < points:
            system.step()
print(json.dumps(rows))
"""


@pytest.fixture(scope="module")
def everything(tmp_path_factory: pytest.TempPathFactory, event_fmu: Callable[..., Path]) -> Path:
    """A mesh of all that has a state: FMUs of all kinds, engines, rates, values over time."""
    folder = tmp_path_factory.mktemp("everything")
    (folder / "noise.py").write_text(COMPONENT, encoding="utf-8")
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
    names = outputs_of(mesh)
    for number in range(2):
        file, rows = tmp_path / f"{number}.state", []
        with mesh.open() as system:
            system.step(drawn.randrange(1, 120))
            system.set("Gain.u", drawn.random())
            system.set("fast.k", drawn.random())
            system.step(drawn.randrange(1, 30))
            system.save(file)
            for point in range(GONE_ON + 1):
                rows.append(repr([system.point, system.time, *(system.get(name) for name in names)]))
                if point < GONE_ON:
                    system.step()
        command = [sys.executable, "-c", GO_ON, str(everything), str(file), json.dumps(names), str(GONE_ON)]
        done = subprocess.run(
            command, capture_output=True, text=True, timeout=on_a_busy_machine(DEADLINE_S), check=False
        )
        assert done.returncode == 0, done.stderr
        assert json.loads(done.stdout) == rows


def outputs_of(mesh: fmu_mesh.Mesh) -> list[str]:
    instances = mesh.plan().plan.system.instances
    outputs = [f"{n}.{v.name}" for n, own in instances.items() for v in own.description.with_causality("output")]
    return [*outputs, "Gain.u", "fast.k", "pid.target", "noise.level"]
