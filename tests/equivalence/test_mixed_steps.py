"""Instances that step in C and instances that step in Python, in one burst: each gets the values of the reference."""

from __future__ import annotations

import csv
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from fmu_mesh.instances.contract import Instance, Showing
from fmu_mesh.instances.registry import open_instance
from fmu_mesh.node.engine import PlainEngine
from fmu_mesh.node.stepping import Runner
from fmu_mesh.rings import native
from fmu_mesh.rings.host_memory import HostMemory
from fmu_mesh.run.local_system import opening_of
from fmu_mesh.run.options import PlanOptions
from fmu_mesh.system.plan import NodePlan, Plan
from tests.helpers import FMUS, rows_of
from tests.plain_run import PlainRun
from tests.planning import prepare
from tests.scenarios.engines import EngineMesh, MakeEngine, burst_engine, windows_of

POINTS = 400
SOURCE = """
import fmu_mesh

class Mid(fmu_mesh.Component):
    \"\"\"Between two FMUs.\"\"\"
    u = fmu_mesh.Input()
    v = fmu_mesh.Input()
    y = fmu_mesh.Output()
    z = fmu_mesh.Output()

    def step(self, time, step_size):
        self.y = 0.9 * self.u - self.v + time
        self.z = self.y * step_size
"""
INSTANCES: dict[str, dict[str, Any]] = {
    "left": {"fmu": str(FMUS / "Gain.fmu"), "start_values": {"k": 0.7}},
    "mid": {"python": "mid.py:Mid"},
    "right": {"fmu": str(FMUS / "TransportDelay.fmu"), "start_values": {"d": 0.01}},
    "pendulum": {"fmu": str(FMUS / "DampedPendulum.fmu"), "start_values": {"a": 1.3}},
    "last": {"fmu": str(FMUS / "Gain.fmu"), "start_values": {"k": -3.0}},
}
CONNECTIONS: list[object] = [
    "left.y -> mid.u",
    {"from": "pendulum.a", "to": "mid.v", "factor": 0.5, "offset": 0.25},
    {"from": "mid.y", "to": "right.x", "factor": 0.5},
    "right.y -> left.u",
    "mid.z -> last.u",
]


def plain_engine(plan: NodePlan, units: Sequence[Sequence[Runner]], memory: HostMemory) -> PlainEngine:
    return PlainEngine(plan, units, memory, windows_of(plan, memory))


@contextmanager
def opener(plan: Plan, folder: Path) -> Iterator[Callable[[str], Instance]]:
    """Opens the instances of a plan; they are closed at the end."""
    with ExitStack() as stack:

        def opened(name: str) -> Instance:
            place = folder / name
            place.mkdir()
            instance = open_instance(opening_of(plan, name, place, lambda _message: None, Showing()))
            stack.callback(instance.close)
            return instance

        yield opened


@pytest.mark.parametrize(
    "make",
    [
        pytest.param(burst_engine, id="C", marks=pytest.mark.skipif(native.library is None, reason="no library")),
        pytest.param(plain_engine, id="Python"),
    ],
)
@pytest.mark.parametrize("steps", [{}, {"mid": 2}, {"left": 3, "pendulum": 2}], ids=["one rate", "two", "three"])
@pytest.mark.parametrize("groups", ["none", "all", "two"])
@pytest.mark.parametrize("window", [1, 50])
def test_fmus_and_components_in_one_burst_get_the_values_of_the_reference(
    tmp_path: Path, make: MakeEngine, steps: dict[str, int], groups: str, window: int
) -> None:
    group_of = {"none": {}, "all": dict.fromkeys(INSTANCES, "g"), "two": {"left": "g", "mid": "g", "last": "g"}}[groups]
    content = {
        "mesh": "mixed",
        "simulation": {"stop_time": POINTS * 0.001, "step_size": 0.001, "window": window},
        "instances": {
            name: {
                **own,
                **({"step_size": steps[name] * 0.001} if name in steps else {}),
                **({"group": group_of[name]} if name in group_of else {}),
            }
            for name, own in INSTANCES.items()
        },
        "connections": CONNECTIONS,
        "record": {"file": "mixed.csv"},
    }
    (tmp_path / "mid.py").write_text(SOURCE, encoding="utf-8")
    config = tmp_path / "mixed.yaml"
    config.write_text(yaml.safe_dump(content, sort_keys=False), encoding="utf-8")
    output = tmp_path / "local.csv"
    plan = prepare(config, PlanOptions(output=output))
    PlainRun(plan).run()
    with output.open(encoding="utf-8", newline="") as file:
        header = next(csv.reader(file))
    reference = np.array(rows_of(output))

    with opener(plan, tmp_path) as opened:
        mesh = EngineMesh(plan, opened, make)
        mesh.run(seed=window)

    points = np.arange(POINTS + 1)
    for number, column in enumerate(header[1:], 1):
        instance, _, variable = column.partition(".")
        place = mesh.runners[instance].outputs.layout.place(variable)
        values = np.array(mesh.recorded[instance])[points // mesh.runners[instance].plan.step_points, place.first]
        assert values.tobytes() == reference[:, number].tobytes(), column
    if make is burst_engine:
        in_c = {name for name, own in mesh.runners.items() if getattr(own.instance, "native", None) is not None}
        assert in_c == INSTANCES.keys() - {"mid"}
