"""Every example, and a system for each other thing that a mesh may have: what each way of rows has to run.

Each is written as one file, `system.yaml`, with what belongs to it beside it, and with one node for each instance.
"""

from __future__ import annotations

import math
import re
import shutil
from collections.abc import Callable, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any, Final

import pytest
import yaml

from tests.equivalence import test_equivalence as rates
from tests.equivalence import test_events as events
from tests.equivalence import test_types as types
from tests.fmus.event_fmus import Version, build_event_fmu
from tests.fmus.helpers import NO_COMPILER, session_folder
from tests.helpers import FMUS

__all__ = ["FEATURES", "SLOW_POINTS", "SYSTEMS", "consistent_loop", "slow_sources", "written_system"]

ROOT: Final = Path(__file__).resolve().parents[1]
POINTS: Final = 2000
"""More than an example of this many points takes too long; in all of them, something happens before."""

SLOW_POINTS: Final = 203
"""Points of `slow_sources`: neither 8 nor 4 nor 3 nor 2 divides it."""

EXAMPLES: Final = {
    path.stem: path
    for pattern in ("configs/*.yaml", "examples/*/*.yaml")
    for path in sorted(ROOT.glob(pattern))
    if "gazebo" not in str(path.relative_to(ROOT))
}

_PARTS: Final = '''
"""Text, truths, whole numbers and arrays, and what becomes of them."""

import fmu_mesh
from fmu_mesh import Input, Output


class Teller(fmu_mesh.Component):
    word = Output(type="String")
    truth = Output(type="Boolean")
    number = Output(type="Int32")
    field = Output(shape=(3, 50))

    def step(self, time, step_size):
        self.number = self.number + 1
        self.word = f"{self.number} ü, 'a \\\\n" * (self.number % 3)
        self.truth = self.number % 7 == 0
        self.field = self.field + time


class Hearer(fmu_mesh.Component):
    word = Input(type="String")
    truth = Input(type="Boolean")
    number = Input(type="Int32")
    field = Input(shape=(3, 50))
    words = Output(type="String")
    sum = Output()

    def step(self, time, step_size):
        self.words = f"{self.word}, {self.truth}, {self.number}"
        self.sum = float(self.field.sum())
'''


def _star(_: Path) -> dict[str, Any]:
    spokes = {f"gain_{k}": {"fmu": str(FMUS / "Gain.fmu"), "start_values": {"k": 1.0 / k}} for k in range(1, 5)}
    return {
        "simulation": {"stop_time": 2.0, "step_size": 0.001},
        "instances": {"pendulum": {"fmu": str(FMUS / "DampedPendulum.fmu"), "start_values": {"a": 1.3}}, **spokes},
        "connections": [f"pendulum.a -> {name}.u" for name in spokes],
    }


def _set(_: Path) -> dict[str, Any]:
    return {
        "simulation": {"stop_time": 2.0, "step_size": 0.001},
        "instances": {
            "pendulum": {"fmu": str(FMUS / "DampedPendulum.fmu"), "start_values": {"a": 1.3}},
            "gain": {"fmu": str(FMUS / "Gain.fmu")},
            "integral": {"fmu": str(FMUS / "Integrator.fmu")},
        },
        "connections": ["pendulum.a -> gain.u", "gain.y -> integral.u"],
        "scenario": {"events": [{"at": 1.5, "set": {"gain.k": 3.0}}]},
    }


def consistent_loop(gain: float = -2.0, **simulation: object) -> dict[str, Any]:
    """A loop of direct dependencies over two FMUs, which a pendulum drives, and an instance behind it."""
    usual = {"stop_time": 2.0, "step_size": 0.001, "loops": "solved", "extrapolation": "midpoint"}
    return {
        "simulation": usual | simulation,
        "instances": {
            "pendulum": {"fmu": str(FMUS / "DampedPendulum.fmu"), "start_values": {"a": 1.3}},
            "sum": {"fmu": str(FMUS / "Adder.fmu")},
            "gain": {"fmu": str(FMUS / "Gain.fmu"), "start_values": {"k": gain}},
            "integral": {"fmu": str(FMUS / "Integrator.fmu")},
        },
        "connections": [
            "pendulum.a -> sum.u1",
            {"from": "gain.y", "to": "sum.u2", "offset": 0.5},
            "sum.y -> gain.u",
            "gain.y -> integral.u",
        ],
    }


def slow_sources(groups: Mapping[str, str] = MappingProxyType({}), **simulation: object) -> dict[str, Any]:
    """A chain of 8, 4 and 1 points, a cycle of 4 and 1 points, and 3 points for 2; values change within slow steps."""
    h = rates.H
    members: dict[str, tuple[str, dict[str, float], int]] = {
        "sum": ("Adder", {}, 1),
        "both": ("Adder", {}, 1),
        "two": ("Integrator", {"k": 0.8}, 2),
        "three": ("Integrator", {"k": 1.5, "y": 0.2}, 3),
        "back": ("Integrator", {"k": -2.0}, 4),
        "gain": ("Gain", {"k": 0.7}, 4),
        "pendulum": ("DampedPendulum", {"a": 1.3}, 8),
    }
    return {
        "mesh": "system",
        "simulation": {"stop_time": SLOW_POINTS * h, "step_size": h, "extrapolation": "midpoint"} | simulation,
        "instances": {
            name: {"fmu": str(FMUS / f"{fmu}.fmu"), "start_values": start_values, "step_size": points * h}
            | ({"group": groups[name]} if name in groups else {})
            for name, (fmu, start_values, points) in members.items()
        },
        "connections": [
            "pendulum.a -> gain.u",
            "gain.y -> sum.u1",
            "back.y -> sum.u2",
            {"from": "sum.y", "to": "back.u", "delay": 1},
            {"from": "gain.y", "to": "both.u1", "extrapolation": "hold"},
            {"from": "gain.y", "to": "both.u2", "factor": 2.0},
            {"from": "sum.y", "to": "three.u", "delay": 1},
            "three.y -> two.u",
        ],
        "scenario": {"events": [{"at": 50 * h, "set": {"gain.k": 0.9}}, {"at": 101 * h, "set": {"three.k": -1.0}}]},
        "record": {"file": "system.csv"},
    }


def _told(folder: Path) -> dict[str, Any]:
    (folder / "parts.py").write_text(_PARTS, encoding="utf-8")
    return {
        "simulation": {"stop_time": 2.0, "step_size": 0.01},
        "instances": {"teller": {"python": "parts.py:Teller"}, "hearer": {"python": "parts.py:Hearer"}},
        "connections": [f"teller.{name} -> hearer.{name}" for name in ("word", "truth", "number", "field")],
    }


def _grouped(_: Path) -> dict[str, Any]:
    content = _example(EXAMPLES["chain8"])
    for number, instance in enumerate(content["instances"].values()):
        instance["group"] = f"side_{number % 3}"
    return content


def _events(folder: Path) -> dict[str, Any]:
    def here(name: str, version: Version, **changes: str) -> Path:
        return Path(shutil.copy(build_event_fmu(name, version, session_folder(), **changes), folder))

    return events.system(here, events.MIXED)


def _example(path: Path) -> dict[str, Any]:
    text = path.read_text(encoding="utf-8")
    for kind, module in (("mujoco: ", "mujoco"), ("onnx: ", "onnxruntime")):
        if kind in text:
            pytest.importorskip(module)
    content: dict[str, Any] = yaml.safe_load(re.sub(r"(\.\./)+fmus", str(FMUS), text))
    content.pop("ros", None)  # only `launch` starts a gateway
    connections = content.get("connections", [])  # and only it has a session for keys
    content["connections"] = [one for one in connections if not (isinstance(one, dict) and "key" in one)]
    content.pop("group", None)
    simulation = content["simulation"]
    simulation.pop("real_time_factor", None)
    simulation["stop_time"] = min(simulation["stop_time"] or math.inf, POINTS * simulation["step_size"])
    return content


FEATURES: Final[Mapping[str, Callable[[Path], dict[str, Any]]]] = {
    "star": _star,
    "set": _set,
    "text and arrays": _told,
    "groups": _grouped,
    "consistent": lambda _: consistent_loop(),
    "rates": lambda _: rates.multi_rate(rates.GAUSS_SEIDEL, rates.MIXED, rates.H),
    "slow sources": lambda _: slow_sources(),
    "events": _events,
    "types": lambda folder: yaml.safe_load(types.written(folder).read_text(encoding="utf-8")),
}

SYSTEMS: Final = (*EXAMPLES, *FEATURES)


def written_system(name: str, folder: Path, *, lasts_s: float = 0.0, **sections: Mapping[str, Any]) -> Path:
    """Write a system, and return the path of its configuration; a test is skipped where it cannot run.

    Args:
        name: one of `SYSTEMS`.
        folder: where it goes.
        lasts_s: how long a run takes by the wall clock; 0: as short as it can.
        sections: more of the file.
    """
    if name in {"events", "types"} and NO_COMPILER is not None:
        pytest.skip(NO_COMPILER)
    folder.mkdir(exist_ok=True)
    if (example := EXAMPLES.get(name)) is not None:
        shutil.copytree(example.parent, folder, dirs_exist_ok=True)
        content = _example(example)
    else:
        content = FEATURES[name](folder)
    record = {"variables": None, **content.get("record", {}), "file": "system.csv"}
    for instance in content["instances"].values():
        if Path(instance.get("fmu", "")).parent == folder:  # which has another path for a host
            instance["fmu"] = Path(instance["fmu"]).name
    simulation = content["simulation"]
    if lasts_s:
        simulation["real_time_factor"] = simulation["stop_time"] / lasts_s
    made = {**content, "mesh": "system", "record": record} | {key: dict(section) for key, section in sections.items()}
    path = folder / "system.yaml"
    path.write_text(yaml.safe_dump(made, sort_keys=False, allow_unicode=True), encoding="utf-8")
    return path
