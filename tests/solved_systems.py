"""Systems with a group that is solved (`group: {name: g, solve: newton}`), as configurations in a folder."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from tests.helpers import FMUS

__all__ = ["LINKS", "MASSES", "PARTS", "contradiction", "driven_masses", "masses"]

LINKS = ("two.y -> one.u", "one.x -> two.u", "one.v -> two.w")
"""Of two masses, each an FMU or a component: the force, the position and the velocity."""

MASSES: Sequence[Mapping[str, float]] = (
    {"masses": 1, "a": 10.0, "b": 1.0, "x": 1.0},
    {"masses": 2, "a": 100.0, "b": 2.0, "e": 1000.0, "c": 10.0, "x": 1.0},
)
"""The start values of `LinearPart` for two masses with a medium coupling."""

PARTS = """
import fmu_mesh


class Mass(fmu_mesh.Component):
    "The second mass, with a push from outside and its own way back to it, in ten small steps of Heun."

    u = fmu_mesh.Input()
    w = fmu_mesh.Input()
    push = fmu_mesh.Input()
    back = fmu_mesh.Input()
    bias = fmu_mesh.Input()
    ramp = fmu_mesh.Input()
    free = fmu_mesh.Input()
    y = fmu_mesh.Output(depends_on=("u", "w"))
    x = fmu_mesh.Output(depends_on=())

    def initialize(self):
        self.state = [1.0, 0.0]
        self.tell()

    def tell(self):
        self.x, v = self.state
        self.y = 1000.0 * (self.x - self.u) + 10.0 * (v - self.w)

    def slopes(self, x, v):
        force = 1000.0 * (x - self.u) + 10.0 * (v - self.w)
        return v, -100.0 * x - 2.0 * v - force + self.push + self.bias + self.ramp + self.free - 0.1 * self.back

    def step(self, time, step_size):
        h = step_size / 10
        for _ in range(10):
            x, v = self.state
            a = self.slopes(x, v)
            b = self.slopes(x + h * a[0], v + h * a[1])
            self.state = [x + 0.5 * h * (a[0] + b[0]), v + 0.5 * h * (a[1] + b[1])]
        self.tell()


class Loop(fmu_mesh.Component):
    "An output that is its input, times a gain, at once."

    gain = fmu_mesh.Parameter(1.0)
    u = fmu_mesh.Input()
    y = fmu_mesh.Output(depends_on=("u",))

    def initialize(self):
        self.y = self.gain * self.u + 1.0

    def step(self, time, step_size):
        self.y = self.gain * self.u + 1.0


class Late(Loop):
    "As a loop, but it is closed in the first step only: at the start there is a solution."

    def initialize(self):
        self.y = 0.0


class Relay(fmu_mesh.Component):
    "From 0.01 s on, its output contradicts its input."

    u = fmu_mesh.Input()
    y = fmu_mesh.Output(0.0, depends_on=("u",))

    def step(self, time, step_size):
        self.y = 1.0 if time > 0.005 and self.u < 0.4 else 0.0
"""


def masses(fmu: Path, **group: Any) -> dict[str, dict[str, Any]]:  # noqa: ANN401  keys of a group
    """Two masses as model exchange FMUs `LinearPart`, whose step is solved together."""
    own = {"fmu": str(fmu), "kind": "model_exchange", "solver": {"relative_tolerance": 1e-10}}
    first, second = MASSES
    return {
        "one": {**own, "start_values": first, "group": {"name": "g", "solve": "newton", **group}},
        "two": {**own, "start_values": second, "group": "g"},
    }


def driven_masses(fmu: Path, folder: Path, **group: Any) -> dict[str, Any]:  # noqa: ANN401  keys of a group
    """A group of an FMU, which takes lines, and a component, which takes means, with all that may come from outside.

    Two inputs come from other nodes: one follows the middle of its line, and one closes a cycle through the group. One
    input has values over time. The sections are those of `write_config`.
    """
    (folder / "parts.py").write_text(PARTS, encoding="utf-8")
    instances = masses(fmu, **group)
    instances["two"] = {"python": "parts.py:Mass", "group": "g"}
    return {
        "instances": {
            "pendulum": {"fmu": str(FMUS / "DampedPendulum.fmu"), "start_values": {"a": 1.3}},
            "back": {"fmu": str(FMUS / "Gain.fmu"), "start_values": {"k": 3.0}},
            **instances,
        },
        "connections": [
            *LINKS,
            {"from": "pendulum.a", "to": "two.push", "extrapolation": "midpoint"},
            "one.x -> back.u",
            "back.y -> two.back",
        ],
        "scenario": {
            "values": {"two.ramp": {"times": [0.1, 0.8], "values": [0.0, 30.0], "interpolation": "linear"}},
            "events": [{"at": 0.2, "set": {"two.bias": 5.0}}, {"at": 0.31, "set": {"two.bias": 0.0}}],
        },
        "record": {"file": "driven.csv", "variables": ["one.x", "one.v", "two.y", "two.x", "back.y", "pendulum.a"]},
    }


def contradiction(folder: Path, **group: Any) -> dict[str, Any]:  # noqa: ANN401  keys of a group
    """A group without a solution from the second point on. The sections are those of `write_config`."""
    (folder / "parts.py").write_text(PARTS, encoding="utf-8")
    return {
        "instances": {
            "relay": {"python": "parts.py:Relay", "group": {"name": "g", "solve": "newton", **group}},
            "echo": {"python": "parts.py:Loop", "group": "g"},
        },
        "connections": ["relay.y -> echo.u", {"from": "echo.y", "to": "relay.u", "offset": -1.0}],
        "simulation": {"step_size": 0.01},
    }
