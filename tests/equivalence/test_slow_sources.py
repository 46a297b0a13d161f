"""Sources that go ahead of targets with smaller steps, which interpolate: the same floats in every way of running."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Final

import pytest
import yaml

import fmu_mesh
from tests.equivalence.test_every_way import in_one_process
from tests.helpers import FMUS

H: Final = 0.0078125
POINTS: Final = 203
"""Neither 8 nor 4 nor 3 nor 2 divides it."""


def slow_sources(groups: Mapping[str, str], **simulation: object) -> dict[str, Any]:
    """A chain of 8, 4 and 1 points, a cycle of 4 and 1 points, and 3 points for 2; values change within slow steps."""
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
        "simulation": {"stop_time": POINTS * H, "step_size": H, "extrapolation": "midpoint"} | simulation,
        "instances": {
            name: {"fmu": str(FMUS / f"{fmu}.fmu"), "start_values": start_values, "step_size": points * H}
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
        "scenario": {"events": [{"at": 50 * H, "set": {"gain.k": 0.9}}, {"at": 101 * H, "set": {"three.k": -1.0}}]},
        "record": {"file": "system.csv"},
    }


def written(content: Mapping[str, Any], folder: Path) -> Path:
    path = folder / "system.yaml"
    path.write_text(yaml.safe_dump(content, sort_keys=False), encoding="utf-8")
    return path


GROUPS: Final[dict[str, dict[str, str]]] = {
    "alone": {},
    "a cycle in one": {"back": "cycle", "sum": "cycle"},
    "mixed": {"back": "slow", "gain": "slow", "three": "slow", "sum": "fast", "two": "fast", "both": "fast"},
}
WAYS: Final[list[dict[str, Any]]] = [
    {"processes": False},
    {"window": 1},
    {"window": 16},
    {},
    {"config_values": {"group": "auto"}},
    {"config_values": {"zenoh.shared_memory": False}, "window": 1},
    {"config_values": {"zenoh.shared_memory": False, "zenoh.row_streams": False}},
]


@pytest.mark.parametrize("groups", GROUPS)
def test_interpolated_inputs_are_the_same_in_every_way(groups: str, tmp_path: Path) -> None:
    config, output = written(slow_sources(GROUPS[groups]), tmp_path), tmp_path / "other.csv"
    expected = in_one_process(config)
    mesh = fmu_mesh.load(config)
    plan = mesh.plan().plan
    assert {c.source_instance for c in plan.connections if c.ahead} == {"pendulum", "gain", "back", "three"}

    for way in WAYS if groups == "alone" else WAYS[1:4]:
        mesh.run(output=output, **way)
        assert output.read_bytes() == expected, way


def test_interpolated_inputs_are_the_same_without_the_library(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    config, output = written(slow_sources({}), tmp_path), tmp_path / "other.csv"
    expected = in_one_process(config)
    monkeypatch.setattr("fmu_mesh.rings.native.library", None)
    mesh = fmu_mesh.load(config)

    result = mesh.run(output=output, processes=False)
    batch = mesh.batch(1)
    batch.step(51)

    assert output.read_bytes() == expected
    assert [batch.get(name)[0] for name in ("gain.y", "two.y")] == [result[name][51] for name in ("gain.y", "two.y")]


def test_linear_inputs_of_model_exchange_follow_both_ends(event_fmu: Callable[..., Path], tmp_path: Path) -> None:
    content = slow_sources({}, extrapolation="auto")
    content["instances"]["model"] = {
        "fmu": str(event_fmu("Oscillator", 2)),
        "kind": "model_exchange",
        "solver": {"name": "dopri5"},
    }
    content["connections"] += ["gain.y -> model.u"]
    config, output = written(content, tmp_path), tmp_path / "other.csv"
    expected = in_one_process(config)
    mesh = fmu_mesh.load(config)
    assert [c.extrapolation for c in mesh.plan().plan.connections if c.ahead][-1] == "linear"

    for way in [{"processes": False}, {"window": 1}, {}]:
        mesh.run(output=output, **way)
        assert output.read_bytes() == expected, way


def test_pauses_and_single_steps_change_nothing(tmp_path: Path) -> None:
    config = written(slow_sources({}), tmp_path)
    expected = in_one_process(config)

    with fmu_mesh.load(config).start(output=tmp_path / "other.csv", paused=True) as run:
        run.wait_for("paused")
        for points in (1, 2, 3, 1, 7, 10):
            run.step(points)
        assert run.checkpoint(tmp_path / "at.state") == 24
        run.resume()
        run.wait()

    assert (tmp_path / "other.csv").read_bytes() == expected


def test_copies_and_a_program_that_steps_see_the_same_values(tmp_path: Path) -> None:
    mesh = fmu_mesh.load(written(slow_sources({}), tmp_path))
    expected = mesh.run(processes=False, record="memory")
    names = ["sum.y", "both.y", "two.y", "three.y", "back.y", "gain.y", "pendulum.a"]

    batch = mesh.batch(2)
    with mesh.open() as system:
        for point in range(POINTS + 1):
            row = [expected[name][point] for name in names]
            assert [system.get(name) for name in names] == row, point
            assert [batch.get(name)[1] for name in names] == row, point
            if point == 102:
                saved = batch.save(), system.save()
                batch.step(5)
                system.step(5)
                batch.restore(saved[0])
                system.restore(saved[1])
            if point < POINTS:
                batch.step()
                system.step()


def test_a_run_that_begins_with_a_state_goes_on_between_both_ends(tmp_path: Path) -> None:
    mesh = fmu_mesh.load(written(slow_sources({}), tmp_path))
    whole = mesh.run(processes=False, record="memory")
    with mesh.open() as system:
        system.step(96)
        system.save(tmp_path / "at.state")

    for way in ({"processes": False}, {"window": 1}):
        rest = mesh.run(state=tmp_path / "at.state", output=tmp_path / "rest.csv", **way)

        for name in ("sum.y", "both.y", "two.y", "pendulum.a"):
            assert rest[name].tolist() == whole[name][96:].tolist(), (name, way)


def test_a_value_that_is_set_within_a_step_is_for_the_next_one(tmp_path: Path) -> None:
    content = slow_sources({})
    expected = fmu_mesh.load(written(content, tmp_path)).run(processes=False, record="memory")
    del content["scenario"]
    mesh = fmu_mesh.load(written(content, tmp_path))
    names = ["both.y", "two.y", "three.y", "gain.y"]

    batch = mesh.batch(2)
    with mesh.open() as system:
        for point in range(POINTS + 1):
            for name, value in {50: {"gain.k": 0.9}, 101: {"three.k": -1.0}}.get(point, {}).items():
                system.set(name, value)
                batch.set(name, [value, value])
            row = [expected[name][point] for name in names]
            assert [system.get(name) for name in names] == row, point
            assert [batch.get(name)[1] for name in names] == row, point
            if point < POINTS:
                batch.step()
                system.step()


ENDING: Final = '''
import math

import fmu_mesh
from fmu_mesh.errors import TerminationRequested


class Ending(fmu_mesh.Component):
    """It ends the run, or has a value that is not finite, in the step that begins at 0.5 s."""

    asks = fmu_mesh.Parameter(True)
    y = fmu_mesh.Output(depends_on=())

    def step(self, time, step_size):
        if time >= 0.5 and self.asks:
            raise TerminationRequested("enough")
        self.y = math.nan if time >= 0.5 else time + step_size
'''


@pytest.mark.parametrize("asks", [True, False], ids=["asks to end", "not finite"])
def test_a_source_that_ends_the_run_ends_it_at_the_start_of_its_step(*, asks: bool, tmp_path: Path) -> None:
    """Its targets wait for the end of this step, so they come no further."""
    (tmp_path / "parts.py").write_text(ENDING, encoding="utf-8")
    content = slow_sources({}) | {"connections": ["ending.y -> both.u1", "both.y -> two.u"], "scenario": {}}
    ending = {"python": "parts.py:Ending", "step_size": 4 * H, "start_values": {"asks": asks}}
    content["instances"] = {name: content["instances"][name] for name in ("both", "two")} | {"ending": ending}
    mesh = fmu_mesh.load(written(content, tmp_path))
    ends = []

    for number, way in enumerate([{"processes": False}, {"window": 1}, {}]):
        output = tmp_path / f"{number}.csv"
        if asks:
            mesh.run(output=output, **way)
        else:
            with pytest.raises(fmu_mesh.NotFinite, match=r"ending\.y|output y"):
                mesh.run(output=output, **way)
        ends.append(output.read_bytes())

    assert ends[1:] == [ends[0]] * 2
    assert ends[0].splitlines()[-1].split(b",")[0] == b"0.5"
