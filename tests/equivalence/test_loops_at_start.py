"""Loops at the start that need acceleration: every way to run them begins with the same floats, a solution."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import fmu_mesh
from fmu_mesh.errors import LoopNotConverged
from fmu_mesh.run.options import PlanOptions
from tests.helpers import Place, wait_until, write_config
from tests.plain_run import PlainRun
from tests.planning import prepare

PARTS = """\
import math

import numpy as np

import fmu_mesh
from fmu_mesh import Input, Output, Parameter


class Linear(fmu_mesh.Component):
    k = Parameter(1.0)
    b = Parameter(0.0)
    u = Input()
    y = Output()

    def initialize(self):
        self.y = self.k * self.u + self.b

    def step(self, time, step_size):
        self.y = self.k * math.sin(self.u + time) + self.b


class Cosine(fmu_mesh.Component):
    u = Input()
    y = Output()

    def initialize(self):
        self.y = math.cos(self.u)

    def step(self, time, step_size):
        self.y = math.cos(self.u)


class Vector(fmu_mesh.Component):
    gain = Parameter(1.0)
    u = Input(shape=3)
    y = Output(shape=3)

    def initialize(self):
        a, b, c = self.u
        self.y = [self.gain * (b - 2 * c) + 1, self.gain * (a + c), 0.5 - self.gain * (a + 3 * b)]

    def step(self, time, step_size):
        self.y = np.tanh(self.u)


class Switched(fmu_mesh.Component):
    u = Input()
    level = Input(type="Int32")
    y = Output()
    on = Output(type="Boolean")
    above = Output(type="Int32")

    def initialize(self):
        self.y = -2.0 * self.u + self.level
        self.on, self.above = self.y > 0.4, min(self.level + 1, 3)

    def step(self, time, step_size):
        self.y += time


class Relay(fmu_mesh.Component):
    u = Input()
    on = Input(type="Boolean")
    y = Output()

    def initialize(self):
        self.y = self.u - (0.5 if self.on else 0.0)

    def step(self, time, step_size):
        self.y = -self.y
"""

Equations = Callable[[Callable[[str], float]], list[float]]
"""What a solution leaves of the equations, from a function that reads an output."""


def part(kind: str, **start_values: float) -> dict[str, Any]:
    return {"python": f"parts.py:{kind}", "start_values": start_values}


def round_about(name: str) -> list[str]:
    return [f"{name}_a.y -> {name}_b.u", f"{name}_b.y -> {name}_a.u"]


def linear(name: str, k: float) -> tuple[dict[str, Any], list[str], Equations]:
    parts = {f"{name}_a": part("Linear", k=k, b=1.0), f"{name}_b": part("Linear")}
    return parts, round_about(name), lambda y: [y(f"{name}_a.y") - 1.0 / (1.0 - k)]


def of_three_values(y: Callable[[str], float]) -> list[float]:
    a, b, c = (y(f"three_b.y[{n}]") for n in (1, 2, 3))
    new = 1.5 * (b - 2 * c) + 1, 1.5 * (a + c), 0.5 - 1.5 * (a + 3 * b)
    return [value - y(f"three_a.y[{n}]") for n, value in enumerate(new, 1)]


LOOPS: tuple[tuple[dict[str, Any], list[str], Equations], ...] = (
    linear("strong", -3.0),
    linear("double", -2.0),
    linear("slow", 0.9),
    ({f"three_{n}": part("Vector", gain=1.5) for n in "ab"}, round_about("three"), of_three_values),
    (
        {"cosine_a": part("Cosine"), "cosine_b": part("Linear", k=2.0)},
        round_about("cosine"),
        lambda y: [y("cosine_a.y") - math.cos(2.0 * y("cosine_a.y"))],
    ),
    (
        {"mode_a": part("Switched"), "mode_b": part("Relay")},
        [*round_about("mode"), "mode_a.on -> mode_b.on", "mode_a.above -> mode_a.level"],
        lambda y: [y("mode_a.y") - (3.0 - 2.0 * (y("mode_a.y") - 0.5))],  # it is on, and the level is 3
    ),
)
ALL: tuple[dict[str, Any], list[str]] = (
    {name: own for parts, _, _ in LOOPS for name, own in parts.items()},
    [one for _, connections, _ in LOOPS for one in connections],
)


def written(
    place: Place, instances: Mapping[str, Any], connections: Sequence[str], section: Mapping[str, str] = {}
) -> Path:
    (place.folder / "parts.py").write_text(PARTS, encoding="utf-8")
    parts = {name: {**own, **section} for name, own in instances.items()}
    return write_config(place.folder, instances=parts, connections=connections, name="m", stop_time=0.01)


def plain_bytes(config: Path) -> bytes:
    """The result of the plain reference."""
    output = config.with_name("plain.csv")
    PlainRun(prepare(config, PlanOptions(output=output))).run()
    return output.read_bytes()


@pytest.mark.parametrize("section", [{}, {"group": "all"}], ids=["processes", "a group"])
def test_every_way_to_run_begins_with_the_same_solution(place: Place, section: Mapping[str, str]) -> None:
    config, local = written(place, *ALL, section), place.folder / "local.csv"

    runs = [place.run("launch", config, "--no-progress"), place.run("launch", config, "--local", "--output", local)]

    assert [run.wait() for run in runs] == [0, 0], place.story()
    result = (place.folder / "m.csv").read_bytes()
    assert result == local.read_bytes() == plain_bytes(config)
    names, row = (line.split(",") for line in result.decode().splitlines()[:2])
    first = {name: float(value) for name, value in zip(names, row, strict=True) if ".y" in name}
    for _, _, equations in LOOPS:
        assert max(map(abs, equations(first.__getitem__))) <= 1e-8  # the tolerance, and what a gain makes of it
    mesh = fmu_mesh.load(config)
    with mesh.batch(2) as batch, mesh.open() as system:
        for output in (f"{name}.y" for name in ALL[0]):
            expected = [own for key, own in first.items() if key.partition("[")[0] == output]
            assert batch.get(output).reshape(2, -1).tolist() == [expected, expected]
            assert np.ravel(system.get(output)).tolist() == expected


def test_results_and_info_tell_iterations_and_residual(place: Place) -> None:
    instances, connections, _ = linear("strong", -3.0)
    mesh = fmu_mesh.load(written(place, instances, connections))

    by_processes, in_this_one = (mesh.run(processes=own).metadata["loops"] for own in (True, False))
    with mesh.start(stop_time=1e6, real_time_factor=1.0) as run:
        wait_until(lambda: run.status.state == "running", "a run that has begun")
        infos = [run.instance_info(name).loops for name in instances]

    solved = "strong_a.y -> strong_b.y solved after 3 iterations, residual 0"
    assert by_processes == in_this_one == {"strong_a": {"point": 0, "message": solved}}
    assert infos[0] == infos[1]
    assert [(str(own), own.iterations, own.residual) for own in infos[0]] == [(solved, 3, 0.0)]


def test_a_loop_without_solution_ends_each_way_with_the_same_words(place: Place) -> None:
    parts = {"a": part("Linear", b=1.0), "b": part("Linear")}
    config = written(place, parts, ["a.y -> b.u", "b.y -> a.u"])

    runs = [place.run("launch", config, "--no-progress", *more) for more in ((), ("--local",))]

    assert [run.wait() for run in runs] == [3, 3]
    with pytest.raises(LoopNotConverged) as caught:
        plain_bytes(config)
    assert "a.y -> b.y did not converge at the start: after 1000 iterations not within" in caught.value.message
    assert "residuals: b.y -> a.u 1 (from 999 to 1000)" in caught.value.message
    assert all(caught.value.message in run.message for run in runs)
    place.assert_nothing_left()
