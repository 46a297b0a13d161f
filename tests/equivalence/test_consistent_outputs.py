"""`loops: solved` and `extrapolation`: the same floats in every way of running, states, and what is refused."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np
import pytest
import yaml

import fmu_mesh
from tests.all_systems import consistent_loop, written_system
from tests.equivalence.test_every_way import in_one_process
from tests.helpers import FMUS

PARTS: Final = '''
import fmu_mesh


class Mixer(fmu_mesh.Component):
    """An array of outputs, of which each depends on all inputs and on a state."""

    u = fmu_mesh.Input(shape=(2,))
    y = fmu_mesh.Output(shape=(2,), depends_on=("u",))
    x = 0.25

    def initialize(self):
        self.y = [0.3 * self.u[0] - 0.2 * self.u[1] + self.x, 0.1 * self.u[0] + 0.4 * self.u[1] - self.x]

    def step(self, time, step_size):
        self.x += step_size * (self.u[1] - self.x)
        self.initialize()


class Root(fmu_mesh.Component):
    """An output that depends on its input in another way at each value."""

    u = fmu_mesh.Input(1.0)
    y = fmu_mesh.Output(depends_on=("u",))

    def initialize(self):
        self.y = self.u * self.u

    def step(self, time, step_size):
        self.initialize()


class Crashing(fmu_mesh.Component):
    """It ends its process where it is opened a second time."""

    u = fmu_mesh.Input()
    y = fmu_mesh.Output(depends_on=("u",))

    def initialize(self):
        import os

        os.abort()

    def step(self, time, step_size):
        pass
'''


def arrays(folder: Path) -> dict[str, Any]:
    """A loop over elements of arrays, and an instance behind it that steps first in the file."""
    (folder / "parts.py").write_text(PARTS, encoding="utf-8")
    return {
        "simulation": {"stop_time": 1.0, "step_size": 0.01, "loops": "solved", "extrapolation": "auto"},
        "instances": {
            "behind": {"fmu": str(FMUS / "Integrator.fmu"), "step_size": 0.02},
            "one": {"python": "parts.py:Mixer"},
            "two": {"python": "parts.py:Mixer"},
        },
        "connections": ["one.y -> two.u", "two.y[2] -> one.u[1]", "two.y[1] -> one.u[2]", "one.y[2] -> behind.u"],
    }


def written(content: Mapping[str, Any], folder: Path) -> Path:
    """A file with a system; it records all outputs."""
    path = folder / "system.yaml"
    made = {"mesh": "system", "record": {"file": "system.csv"}, **content}
    path.write_text(yaml.safe_dump(made, sort_keys=False), encoding="utf-8")
    return path


@pytest.mark.parametrize("system", [lambda _: consistent_loop(), arrays], ids=["loop", "arrays"])
def test_solved_loops_are_the_same_in_every_way(system: Callable[[Path], dict[str, Any]], tmp_path: Path) -> None:
    config = written(system(tmp_path), tmp_path)
    expected, output = in_one_process(config), tmp_path / "other.csv"
    mesh = fmu_mesh.load(config)
    ways: list[dict[str, Any]] = [
        {"processes": False},
        {"window": 1},
        {"window": 16},
        {},
        {"config_values": {"group": "auto"}},
        {"config_values": {"zenoh.shared_memory": False}},
        {"config_values": {"zenoh.shared_memory": False, "zenoh.row_streams": False}},
    ]

    for way in ways:
        mesh.run(output=output, **way)
        assert output.read_bytes() == expected, way


def test_a_batch_and_a_system_equal_a_run(tmp_path: Path) -> None:
    mesh = fmu_mesh.load(written(consistent_loop(), tmp_path))
    expected = mesh.run(processes=False, record="memory")["integral.y"]

    batch = mesh.batch(2)
    batch.step(2000)
    with mesh.open() as system:
        system.step(1000)
        state = system.save()
        system.step(500)
        system.restore(state)
        system.step(1000)

        assert [system.get("integral.y"), *batch.get("integral.y")] == [expected[-1]] * 3


def test_recorded_outputs_of_a_loop_fit_together_at_each_point(tmp_path: Path) -> None:
    result = fmu_mesh.load(written(consistent_loop(), tmp_path)).run(processes=False, record="memory")

    both = result["pendulum.a"] + result["gain.y"] + 0.5
    assert np.abs(result["sum.y"] - both).max() < 1e-15  # a few roundings of numbers around 1
    assert np.abs(result["gain.y"] + 2.0 * result["sum.y"]).max() < 1e-15


def test_a_run_that_begins_with_a_state_goes_on_with_its_lines(tmp_path: Path) -> None:
    mesh = fmu_mesh.load(written(consistent_loop(), tmp_path))
    whole = mesh.run(processes=False, record="memory")
    with mesh.open() as system:
        system.step(1234)
        system.save(tmp_path / "at.state")

    rest = mesh.run(state=tmp_path / "at.state", output=tmp_path / "rest.csv")

    for name in ("sum.y", "gain.y", "integral.y"):
        assert rest[name].tolist() == whole[name][1234:].tolist()


def refusal(content: Mapping[str, Any], folder: Path) -> str:
    """Why a system is refused."""
    (folder / "parts.py").write_text(PARTS, encoding="utf-8")
    with pytest.raises(fmu_mesh.ConfigurationError) as refused:
        fmu_mesh.load(written(content, folder)).plan()
    return "\n".join(map(str, refused.value.findings))


def loop_with(instance: Mapping[str, Any]) -> dict[str, Any]:
    """A loop of a gain and an instance with `u` and `y`."""
    return {
        "simulation": {"stop_time": 1.0, "step_size": 0.01, "loops": "solved"},
        "instances": {"gain": {"fmu": str(FMUS / "Gain.fmu"), "start_values": {"k": 0.5}}, "other": dict(instance)},
        "connections": ["gain.y -> other.u", "other.y -> gain.u"],
    }


@pytest.mark.parametrize(
    ("instance", "words"),
    [
        ({"python": "parts.py:Root"}, "'y' by 'u' is no constant"),
        ({"python": "parts.py:Crashing"}, "the process that measures it ended the process by signal 6"),
        ({"python": "parts.py:Root", "feedthrough": {"y": {"x": 1.0}}}, "'x'; expected one of its inputs: u"),
        ({"fmu": str(FMUS / "Gain.fmu"), "start_values": {"k": 2.0}}, "their loop has the gain 1"),
    ],
    ids=["not linear", "crash", "wrong name", "gain 1"],
)
def test_a_loop_that_cannot_be_solved_is_refused(instance: dict[str, Any], words: str, tmp_path: Path) -> None:
    told = refusal(loop_with(instance), tmp_path)

    assert words in told
    assert "delayed" in told or "expected" in told


def test_a_given_feedthrough_is_taken_for_what_it_says(tmp_path: Path) -> None:
    content = loop_with({"fmu": str(FMUS / "Gain.fmu"), "start_values": {"k": 0.5}, "feedthrough": {"y": {"u": 0.5}}})
    given = fmu_mesh.load(written(content, tmp_path)).plan().plan.consistent
    del content["instances"]["other"]["feedthrough"]

    assert fmu_mesh.load(written(content, tmp_path)).plan().plan.consistent == given


def test_a_scenario_that_changes_a_gain_of_a_solved_loop_is_told(tmp_path: Path) -> None:
    content = consistent_loop() | {"scenario": {"events": [{"at": 1.0, "set": {"gain.k": -1.0, "sum.u1": 0.0}}]}}
    content["connections"] = content["connections"][1:]

    told = [str(one) for one in fmu_mesh.load(written(content, tmp_path)).check().warnings]

    (own,) = [one for one in told if "the scenario changes" in one]
    assert "changes k; how its outputs depend directly on inputs stays as it is at the start" in own


def test_a_delay_of_zero_within_a_solved_cycle_is_refused(tmp_path: Path) -> None:
    content = loop_with({"fmu": str(FMUS / "Gain.fmu"), "start_values": {"k": 0.5}})
    content["connections"][0] = {"from": "gain.y", "to": "other.u", "delay": 0}

    assert "0 for gain.y -> other.u, within a cycle whose loops are solved" in refusal(content, tmp_path)


def test_an_input_that_is_not_continuous_holds_its_value(tmp_path: Path) -> None:
    content = yaml.safe_load(written_system("types", tmp_path / "types").read_text(encoding="utf-8"))
    content["simulation"]["extrapolation"] = "midpoint"
    ways = {c.extrapolation for c in fmu_mesh.load(written(content, tmp_path / "types")).plan().plan.connections}

    assert ways <= {"hold", "midpoint"}
    content["connections"] = [{"from": "pendulum.a", "to": "gain.u", "extrapolation": "linear"}]
    content["instances"] = {
        "pendulum": {"fmu": str(FMUS / "DampedPendulum.fmu")},
        "gain": {"fmu": str(FMUS / "Gain.fmu")},
    }
    assert "expected hold, midpoint or auto" in refusal(content, tmp_path)


def test_a_step_of_the_source_is_no_line(tmp_path: Path) -> None:
    """After a jump an input with `midpoint` has the value of its source, and does not go beyond it."""
    content = {
        "simulation": {"stop_time": 1.0, "step_size": 0.1, "extrapolation": "midpoint"},
        "instances": {
            "source": {"fmu": str(FMUS / "Gain.fmu"), "start_values": {"u": 1.0, "k": 0.0}},
            "target": {"fmu": str(FMUS / "Gain.fmu")},
        },
        "connections": ["source.y -> target.u"],
        "scenario": {"events": [{"at": 0.5, "set": {"source.k": 1.0}}]},
    }
    for way in ({"processes": False}, {"window": 1}):
        result = fmu_mesh.load(written(content, tmp_path)).run(output=tmp_path / "out.csv", **way)

        assert sorted({*result["target.y"].tolist()}) == [0.0, 1.0]
