"""Sources that go ahead of targets with smaller steps, which interpolate: the same floats in every way of running."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Final

import pytest
import yaml

import fmu_mesh
from tests.all_systems import SLOW_POINTS, slow_sources
from tests.equivalence.test_equivalence import H
from tests.equivalence.test_every_way import in_one_process


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
FEW: Final[list[dict[str, Any]]] = [{"processes": False}, {"window": 1}, {}]


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
    config, output = written(slow_sources(), tmp_path), tmp_path / "other.csv"
    expected = in_one_process(config)
    monkeypatch.setattr("fmu_mesh.rings.native.library", None)
    mesh = fmu_mesh.load(config)

    result = mesh.run(output=output, processes=False)
    batch = mesh.batch(1)
    batch.step(51)

    assert output.read_bytes() == expected
    assert [batch.get(name)[0] for name in ("gain.y", "two.y")] == [result[name][51] for name in ("gain.y", "two.y")]


def test_linear_inputs_of_model_exchange_follow_both_ends(event_fmu: Callable[..., Path], tmp_path: Path) -> None:
    content = slow_sources(extrapolation="auto")
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

    for way in FEW:
        mesh.run(output=output, **way)
        assert output.read_bytes() == expected, way


def test_pauses_and_single_steps_change_nothing(tmp_path: Path) -> None:
    config = written(slow_sources(), tmp_path)
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
    mesh = fmu_mesh.load(written(slow_sources(), tmp_path))
    expected = mesh.run(processes=False, record="memory")
    names = ["sum.y", "both.y", "two.y", "three.y", "back.y", "gain.y", "pendulum.a"]

    batch = mesh.batch(2)
    with mesh.open() as system:
        for point in range(SLOW_POINTS + 1):
            row = [expected[name][point] for name in names]
            assert [system.get(name) for name in names] == row, point
            assert [batch.get(name)[1] for name in names] == row, point
            if point == 102:
                saved = batch.save(), system.save()
                batch.step(5)
                system.step(5)
                batch.restore(saved[0])
                system.restore(saved[1])
            if point < SLOW_POINTS:
                batch.step()
                system.step()


def test_a_run_that_begins_with_a_state_goes_on_between_both_ends(tmp_path: Path) -> None:
    mesh = fmu_mesh.load(written(slow_sources(), tmp_path))
    whole = mesh.run(processes=False, record="memory")
    with mesh.open() as system:
        system.step(96)
        system.save(tmp_path / "at.state")

    for way in FEW[:2]:
        rest = mesh.run(state=tmp_path / "at.state", output=tmp_path / "rest.csv", **way)

        for name in ("sum.y", "both.y", "two.y", "pendulum.a"):
            assert rest[name].tolist() == whole[name][96:].tolist(), (name, way)


def test_a_value_that_is_set_within_a_step_waits_for_the_next(tmp_path: Path) -> None:
    content = slow_sources()
    expected = fmu_mesh.load(written(content, tmp_path)).run(processes=False, record="memory")
    del content["scenario"]
    mesh = fmu_mesh.load(written(content, tmp_path))
    names = ["both.y", "two.y", "three.y", "gain.y"]

    batch = mesh.batch(2)
    with mesh.open() as system:
        for point in range(SLOW_POINTS + 1):
            for name, value in {50: {"gain.k": 0.9}, 101: {"three.k": -1.0}}.get(point, {}).items():
                system.set(name, value)
                batch.set(name, [value, value])
            row = [expected[name][point] for name in names]
            assert [system.get(name) for name in names] == row, point
            assert [batch.get(name)[1] for name in names] == row, point
            if point < SLOW_POINTS:
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
def test_a_source_that_ends_a_run_does_so_before_its_step(*, asks: bool, tmp_path: Path) -> None:
    """Its targets wait for the end of this step, so they come no further."""
    (tmp_path / "parts.py").write_text(ENDING, encoding="utf-8")
    content = slow_sources() | {"connections": ["ending.y -> both.u1", "both.y -> two.u"], "scenario": {}}
    ending = {"python": "parts.py:Ending", "step_size": 4 * H, "start_values": {"asks": asks}}
    content["instances"] = {name: content["instances"][name] for name in ("both", "two")} | {"ending": ending}
    mesh = fmu_mesh.load(written(content, tmp_path))
    ends = []

    for number, way in enumerate(FEW):
        output = tmp_path / f"{number}.csv"
        if asks:
            mesh.run(output=output, **way)
        else:
            with pytest.raises(fmu_mesh.NotFinite, match=r"ending\.y|output y"):
                mesh.run(output=output, **way)
        ends.append(output.read_bytes())

    assert ends[1:] == [ends[0]] * 2
    assert ends[0].splitlines()[-1].split(b",")[0] == b"0.5"
