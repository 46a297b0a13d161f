"""Runs that begin with a state: every float is that of a run from the start, in all ways of running."""

from __future__ import annotations

import random
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pytest

import fmu_mesh
from fmu_mesh.errors import ConfigurationError, FmuError
from tests.helpers import BY_STREAMS, BY_ZENOH, DEADLINE_S, write_config

H = 0.1
COMPONENT = """
import fmu_mesh

class Words(fmu_mesh.Component):
    u = fmu_mesh.Input()
    word = fmu_mesh.Output(type="String", start="")
    count = fmu_mesh.Output(start=0.0)

    def step(self, time, step_size):
        self.count += self.u
        self.word = f"{self.count:.3f}"
"""
LARGE = """
import numpy as np
import fmu_mesh

class Large(fmu_mesh.Component):
    y = fmu_mesh.Output(start=0.0)

    def __init__(self):
        self.memory = np.arange(2**24, dtype=float)

    def step(self, time, step_size):
        self.memory[0] += 0.5
        self.y = self.memory[0] + self.memory[-1]
"""
AT = 200
"""The point of the branch: 20 s."""

EVENTS = [{"at": 10.0, "set": {"gain.k": 2.0}}, {"at": 25.0, "set": {"gain.k": 3.0}}]

WAYS: Mapping[str, Mapping[str, Any]] = {
    "in this process": {"processes": False},
    "in step": {"window": 1},
    "a window of 16": {"window": 16},
    "shared memory": {},
    "streams": {"config_values": {f"zenoh.{key}": value for key, value in BY_STREAMS.items()}},
    "Zenoh": {"config_values": {f"zenoh.{key}": value for key, value in BY_ZENOH.items()}},
}
KINDS: Mapping[str, Mapping[str, Any]] = {
    "co_simulation": {"kind": "co_simulation"},
    "dopri5": {"kind": "model_exchange", "solver": {"name": "dopri5"}},
}


def cycle(folder: Path, fmu: Path, kind: str, *, words: bool = True) -> fmu_mesh.Mesh:
    """A cycle of several rates, a group, values over time, and a component with text, with an FMU of one kind in it."""
    (folder / "words.py").write_text(COMPONENT, encoding="utf-8")
    instances: dict[str, Mapping[str, Any]] = {
        "model": {"fmu": str(fmu), **KINDS[kind]},
        "slow": {"fmu": "Integrator", "start_values": {"y": 1.0, "k": -0.3}, "step_size": 4 * H},
        "delay": {"fmu": "TransportDelay", "start_values": {"d": 1.3}, "step_size": 2 * H, "group": "both"},
        "gain": {"fmu": "Gain", "group": "both"},
    }
    connections = ["slow.y -> model.u", "model.x -> delay.x", "delay.y -> slow.u", "delay.y -> gain.u"]
    if words:
        instances["words"] = {"python": "words.py:Words", "step_size": 2 * H}
        connections.append("gain.y -> words.u")
    config = write_config(
        folder,
        name="branching",
        instances=instances,
        connections=connections,
        stop_time=40.0,
        simulation={"step_size": H},
        scenario={"events": EVENTS},
    )
    return fmu_mesh.load(config)


def alone(mesh: fmu_mesh.Mesh, **options: Any) -> fmu_mesh.Result:  # noqa: ANN401  those of `run`
    """A run in this process, unless the options say otherwise."""
    return mesh.run(**{"record": "memory", "processes": False, **options})


def assert_goes_on(found: fmu_mesh.Result, whole: fmu_mesh.Result, first: int) -> None:
    assert found.times.tobytes() == whole.times[first:].tobytes()
    for name in whole:
        assert np.asarray(found[name]).tobytes() == np.asarray(whole[name])[first:].tobytes(), name


@pytest.mark.parametrize("kind", KINDS)
def test_a_branch_equals_a_run_whose_scenario_changes_the_parameter(
    tmp_path: Path, event_fmu: Callable[..., Path], kind: str
) -> None:
    mesh = cycle(tmp_path, event_fmu("Oscillator", 2), kind, words=False)
    drawn = random.Random(kind)  # noqa: S311  a test
    with mesh.open() as system:
        system.step(AT)
        system.save(tmp_path / "at.state")
    for number in range(10):
        k = -drawn.random()
        changed = {"at": AT * H, "set": {"slow.k": k}}
        whole = alone(mesh, scenario={"events": [*EVENTS, changed]})
        branch = alone(mesh, state=tmp_path / "at.state", start_values={"slow.k": k}, processes=number == 0)
        assert_goes_on(branch, whole, AT)


@pytest.mark.parametrize("way", WAYS)
def test_a_run_is_saved_and_begins_there_in_every_way(tmp_path: Path, event_fmu: Callable[..., Path], way: str) -> None:
    how: dict[str, Any] = dict(WAYS[way])
    mesh = cycle(tmp_path, event_fmu("Oscillator", 2), "dopri5")
    whole = mesh.run(record="memory", processes=False)
    running = {name: value for name, value in how.items() if name != "processes"}
    with mesh.start(record="memory", real_time_factor=10.0, paused=True, **running) as run:
        run.wait_for("paused")
        run.resume()
        points = [run.checkpoint(tmp_path / f"{number}.state") for number in range(3)]
        run.pause()
        run.step(-run.status.point % 4 or 4)
        points.append(run.checkpoint(tmp_path / "3.state"))
        assert run.status.state == "paused"
        run.resume()
        assert_goes_on(run.wait(), whole, 0)
    assert [point % 4 for point in points] == [0, 0, 0, 0]
    assert points == sorted(points)
    for number in (1, 3):
        branch = mesh.run(record="memory", state=tmp_path / f"{number}.state", **how)
        assert_goes_on(branch, whole, points[number])
        with mesh.open(state=tmp_path / f"{number}.state") as system:
            assert system.point == points[number]
            system.step(4)
            assert system.get("slow.y") == whole["slow.y"][system.point]


def large(folder: Path) -> fmu_mesh.Mesh:
    """A mesh with a component whose state takes 128 MiB."""
    (folder / "large.py").write_text(LARGE, encoding="utf-8")
    instances = {"large": {"python": "large.py:Large"}, "gain": {"fmu": "Gain"}}
    return fmu_mesh.load(write_config(folder, instances=instances, connections=["large.y -> gain.u"]))


def test_a_large_state_comes_in_parts_and_leaves_no_memory_behind(tmp_path: Path) -> None:
    mesh, state = large(tmp_path), tmp_path / "a.state"
    whole = alone(mesh)

    def in_use() -> float:
        """The memory of all processes of the run, in MiB."""
        return sum(own.memory_info().rss for own in psutil.Process().children(recursive=True)) / 2**20

    with mesh.start(record="memory", paused=True) as run:
        run.step(100)
        found = []
        for _ in range(10):
            assert run.checkpoint(state, timeout=DEADLINE_S) == 100
            found.append(in_use())
        run.resume()
        assert_goes_on(run.wait(), whole, 0)
    assert state.stat().st_size > 2**27
    # Each state that stayed would add 128. The allocator may keep the parts of one or two for the next one.
    assert max(found) < found[0] + 3 * 128, found
    assert_goes_on(mesh.run(record="memory", state=state), whole, 100)


def test_values_that_wait_for_their_time_are_in_a_checkpoint(tmp_path: Path) -> None:
    config = write_config(
        tmp_path,
        instances={
            "gain": {"fmu": "Gain", "start_values": {"k": 2.0}},
            "line": {"fmu": "Gain", "inputs": {"u": {"timeout": {"after": 0.3, "then": 7.0}}}},
        },
        connections=(),
    )
    mesh = fmu_mesh.load(config)
    with mesh.start(record="memory", paused=True) as run:
        run.step(100)
        run.set("gain.k", 3.0, at=0.5)
        run.set("line.u", 5.0, at=0.4)
        run.set("gain.u", 1.0)
        run.step(10)
        assert run.checkpoint(tmp_path / "a.state") == 110
        run.resume()
        whole = run.wait()
    assert_goes_on(mesh.run(record="memory", state=tmp_path / "a.state"), whole, 110)
    assert_goes_on(mesh.run(record="memory", state=tmp_path / "a.state", processes=False), whole, 110)
    with pytest.raises(FmuError, match="values of k wait for their time, which a program that steps cannot have"):
        mesh.open(state=tmp_path / "a.state")


def test_a_state_within_a_step_and_one_after_the_end_are_refused(
    tmp_path: Path, event_fmu: Callable[..., Path]
) -> None:
    mesh = cycle(tmp_path, event_fmu("Oscillator", 2), "co_simulation", words=False)
    with mesh.open() as system:
        system.step(AT + 2)
        system.save(tmp_path / "within.state")
    with pytest.raises(ConfigurationError, match="its step is 4 points, and the state is of point 202, within one"):
        mesh.plan(state=tmp_path / "within.state")
    with pytest.raises(ConfigurationError, match=r"10 s, and the state is of 20\.2 s"):
        mesh.plan(state=tmp_path / "within.state", stop_time=10.0)


def test_all_variants_of_a_sweep_begin_with_one_state(tmp_path: Path, event_fmu: Callable[..., Path]) -> None:
    mesh = cycle(tmp_path, event_fmu("Oscillator", 2), "dopri5", words=False)
    with mesh.open() as system:
        system.step(AT)
        system.save(tmp_path / "at.state")
    values, at = [-0.2, -0.5], tmp_path / "at.state"
    own: dict[str, Any] = {"folder": tmp_path / "sweep", "workers": 1, "reduce": ["last(slow.y)"]}
    with fmu_mesh.sweep(mesh, {"slow.k": values}, state=at, **own) as running:
        found = running.wait(DEADLINE_S).values("last(slow.y)")
    ends = [alone(mesh, state=at, start_values={"slow.k": value})["slow.y"][-1] for value in values]
    assert found == ends


def test_a_result_that_began_with_a_state_can_be_run_again(tmp_path: Path) -> None:
    mesh = fmu_mesh.load(write_config(tmp_path))
    with mesh.open() as system:
        system.step(300)
        system.save(tmp_path / "a.state")
    first = mesh.run(state=tmp_path / "a.state", output=tmp_path / "first.csv", processes=False)
    again = fmu_mesh.rerun(tmp_path / "first.csv", output=tmp_path / "again.csv", processes=False)
    assert_goes_on(again, first, 0)
    assert len(first.times) == 701
