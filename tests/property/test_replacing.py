"""A run that begins with a state, and in which some instances begin anew there, with another model or the same one."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import fmu_mesh
from fmu_mesh.errors import CallRefused, ConfigurationError
from tests.helpers import DEADLINE_S, write_config
from tests.property.test_branches import AT, KINDS, WAYS, H, alone, assert_goes_on, cycle

PARTS = """
import fmu_mesh

class Line(fmu_mesh.Component):
    x = fmu_mesh.Input()
    begun = fmu_mesh.Output(start=0.0)
    y = fmu_mesh.Output(depends_on=("x",))

    def initialize(self):
        self.begun, self.y = self.start_time, 2.0 * self.x

    def step(self, time, step_size):
        self.y = 2.0 * self.x

class Ramp(fmu_mesh.Component):
    y = fmu_mesh.Output(start=0.0)

    def step(self, time, step_size):
        self.y = time + step_size

class Wide(fmu_mesh.Component):
    x = fmu_mesh.Input(shape=(2,), start=(0.0, 0.0))
    y = fmu_mesh.Output()

    def step(self, time, step_size):
        self.y = self.x[0]
"""
LINE = {"python": "parts.py:Line"}


def saved(mesh: fmu_mesh.Mesh, file: Path, point: int = AT) -> Path:
    with mesh.open() as system:
        system.step(point)
        system.save(file)
    return file


def stepped(mesh: fmu_mesh.Mesh, names: list[str], **options: Any) -> dict[str, list[Any]]:  # noqa: ANN401  those of `open`
    """The rows of a program that steps."""
    with mesh.open(**options) as system:
        rows = [[system.get(name) for name in names]]
        while system.time < 40.0 - H / 2:
            system.step()
            rows.append([system.get(name) for name in names])
    return {name: list(column) for name, column in zip(names, zip(*rows, strict=True), strict=True)}


def chain(folder: Path, *models: Mapping[str, Any], **sections: Any) -> fmu_mesh.Mesh:  # noqa: ANN401  of the file
    """A ramp y = t that feeds two instances, one after the other."""
    (folder / "parts.py").write_text(PARTS, encoding="utf-8")
    instances = {"ramp": {"python": "parts.py:Ramp"}, **dict(zip(("first", "second"), models, strict=True))}
    first, second = ("x" if "python" in model else "u" for model in models)
    connections = [f"ramp.y -> first.{first}", f"first.y -> second.{second}"]
    given = {"simulation": {"step_size": H}, "stop_time": 40.0, "connections": connections, **sections}
    return fmu_mesh.load(write_config(folder, name="chain", instances=instances, **given))


def test_an_instance_begins_anew_with_the_values_of_its_sources(tmp_path: Path) -> None:
    before = chain(tmp_path, LINE, LINE)
    state, whole = saved(before, tmp_path / "a.state"), alone(before)
    for way in WAYS.values():
        found = before.run(record="memory", state=state, replaced=["second", "first"], **way)
        assert found.times[0] == AT * H
        assert {found[f"{name}.begun"][0] for name in ("first", "second")} == {AT * H}
        assert found["first.y"][0] == 2.0 * whole["ramp.y"][AT]
        assert found["second.y"][0] == 4.0 * whole["ramp.y"][AT]
        assert found["ramp.y"].tobytes() == whole["ramp.y"][AT:].tobytes()


def test_an_integrator_that_is_replaced_starts_again_from_its_start_value(tmp_path: Path) -> None:
    integrator = {"fmu": "Integrator", "start_values": {"y": 1.0, "k": 0.5}}
    mesh = chain(tmp_path, integrator, LINE)
    state = saved(mesh, tmp_path / "a.state")
    found = alone(mesh, state=state, replaced=["first"])
    y, ramp, expected = 1.0, found["ramp.y"], [1.0]
    for u in ramp[1:].tolist():  # a connection without a delay
        y += 0.5 * u * H
        expected.append(y)
    assert np.allclose(found["first.y"], expected, rtol=1e-12)
    assert found["first.y"][0] == 1.0


@pytest.mark.parametrize("way", WAYS)
def test_other_models_begin_anew_equally_in_every_way(tmp_path: Path, event_fmu: Callable[..., Path], way: str) -> None:
    (tmp_path / "parts.py").write_text(PARTS, encoding="utf-8")
    mesh = cycle(tmp_path, event_fmu("Oscillator", 2), "dopri5")
    state = saved(mesh, tmp_path / "a.state")
    data: Any = mesh.configuration.data
    instances = data["instances"]
    other = {
        "model": {"fmu": instances["model"]["fmu"], **KINDS["co_simulation"]},
        "delay": {**LINE, "step_size": 2 * H, "group": "both"},
    }
    instances.update(other)
    mesh = fmu_mesh.Mesh.from_configuration(mesh.configuration)
    replaced = ["model", "delay", "gain"]
    found = mesh.run(record="memory", state=state, replaced=replaced, **WAYS[way])
    expected = stepped(mesh, [*found], state=state, replaced=replaced)
    for name, values in expected.items():
        assert np.asarray(found[name]).tobytes() == np.asarray(values).tobytes(), name
    assert found["delay.begun"][0] == AT * H


def test_a_loop_of_an_instance_that_begins_anew_is_no_loop(tmp_path: Path) -> None:
    gain = {"fmu": "Gain", "start_values": {"k": 0.5}}
    connections = ["ramp.y -> add.u1", "gain.y -> add.u2", "add.y -> gain.u"]
    (tmp_path / "parts.py").write_text(PARTS, encoding="utf-8")
    config = write_config(
        tmp_path,
        instances={"ramp": {"python": "parts.py:Ramp"}, "add": {"fmu": "Adder"}, "gain": gain},
        connections=connections,
        simulation={"step_size": H},
        initialization={"relaxation": 0.7},
        stop_time=40.0,
    )
    mesh = fmu_mesh.load(config)
    state, whole = saved(mesh, tmp_path / "a.state"), alone(mesh)
    for processes in (False, True):
        found = alone(mesh, state=state, replaced=["gain"], start_values={"gain.k": 0.25}, processes=processes)
        assert found["gain.y"][0] == 0.25 * whole["add.y"][AT]
        assert found["add.y"][0] == whole["add.y"][AT]


def test_what_a_scenario_has_set_and_a_timeout_count_from_there(tmp_path: Path) -> None:
    mesh = fmu_mesh.load(
        write_config(
            tmp_path,
            instances={
                "gain": {"fmu": "Gain"},
                "line": {"fmu": "Gain", "inputs": {"u": {"timeout": {"after": 0.3, "then": 7.0}}}},
            },
            connections=(),
            scenario={"events": [{"at": 0.1, "set": {"gain.k": 3.0, "gain.u": 2.0, "line.u": 4.0}}]},
        )
    )
    state = saved(mesh, tmp_path / "a.state", 500)
    for processes in (False, True):
        found = alone(mesh, state=state, replaced=["gain", "line"], processes=processes)
        assert found["gain.y"][0] == 6.0
        assert [found["line.y"][point] for point in (0, 300, 301)] == [4.0, 4.0, 7.0]
    assert stepped_ends(mesh, state) == [6.0, 7.0]


def stepped_ends(mesh: fmu_mesh.Mesh, state: Path) -> list[Any]:
    with mesh.open(state=state, replaced=["gain", "line"]) as system:
        system.step(301)
        return [system.get("gain.y"), system.get("line.y")]


TALK = """
import numpy as np
import fmu_mesh

class Talker(fmu_mesh.Component):
    k = fmu_mesh.Parameter(3.0)
    word = fmu_mesh.Output(type="String", start="")
    wide = fmu_mesh.Output(shape=(2,), start=np.zeros(2))

    def step(self, time, step_size):
        self.word, self.wide = f"{time:.1f}", np.array([time, -time])

class Listener(fmu_mesh.Component):
    k = fmu_mesh.Parameter(1.0)
    word = fmu_mesh.Input(type="String", start="")
    wide = fmu_mesh.Input(shape=(2,), start=np.zeros(2))
    y = fmu_mesh.Output(start=0.0)

    def initialize(self):
        self.step(0.0, 0.0)

    def step(self, time, step_size):
        self.y = self.k * (self.wide[0] - 2 * self.wide[1]) + float(self.word or 0)
"""


def test_text_arrays_and_parameters_come_from_the_states_too(tmp_path: Path, event_fmu: Callable[..., Path]) -> None:
    (tmp_path / "talk.py").write_text(TALK, encoding="utf-8")
    cvode = {"kind": "model_exchange", "solver": {"name": "cvode"}}  # has no state that can be written
    config = write_config(
        tmp_path,
        instances={
            "talker": {"python": "talk.py:Talker", "start_values": {"k": 5.0}},
            "listener": {"python": "talk.py:Listener"},
            "model": {"fmu": str(event_fmu("Oscillator", 2)), "kind": "co_simulation"},
        },
        connections=[
            "talker.word -> listener.word",
            "talker.wide -> listener.wide",
            "talker.k -> listener.k",
            "listener.y -> model.u",
        ],
        simulation={"step_size": H},
        stop_time=40.0,
    )
    mesh = fmu_mesh.load(config)
    state, whole = saved(mesh, tmp_path / "a.state"), alone(mesh)
    data: Any = mesh.configuration.data
    data["instances"]["model"] |= cvode
    other = fmu_mesh.Mesh.from_configuration(mesh.configuration)
    runs = [alone(other, state=state, replaced=["listener", "model"], processes=own) for own in (False, True)]
    for found in runs:
        time = whole["talker.wide[1]"][AT]
        assert found["listener.y"][0] == pytest.approx(5.0 * 3.0 * time + float(f"{time:.1f}"))
        assert np.asarray(found["model.x"]).tobytes() == np.asarray(runs[0]["model.x"]).tobytes()
    expected = stepped(other, ["model.x", "listener.y"], state=state, replaced=["listener", "model"])
    for name, values in expected.items():
        assert runs[0][name].tobytes() == np.asarray(values).tobytes()


def test_without_being_asked_for_another_model_is_refused_with_a_way_out(tmp_path: Path) -> None:
    state = saved(chain(tmp_path, LINE, LINE), tmp_path / "a.state")
    other = chain(
        tmp_path, {"python": "parts.py:Wide"}, LINE, connections=["ramp.y -> first.x[1]", "first.y -> second.x"]
    )
    gain = chain(tmp_path, LINE, {"fmu": "Gain"})
    with pytest.raises(ConfigurationError, match=r"With `replaced=\['first'\]`, an instance") as refused:
        other.plan(state=state)
    assert "variable 'x': Float64[2] input here, and Float64 input in the state" in str(refused.value.findings)
    with pytest.raises(ConfigurationError, match="variable 'x': Float64"):
        other.run(state=state, replaced=["first"])
    with pytest.raises(ConfigurationError, match="connections: "):
        gain.run(state=state, replaced=["second"])
    with pytest.raises(ConfigurationError, match=r"(?s)no such instance.*Did you mean 'first'"):
        gain.open(state=state, replaced=["first1"])
    with pytest.raises(CallRefused, match="needs a state"):
        gain.run(replaced=["second"])


def test_a_system_begins_anew_only_where_each_instance_has_a_point(tmp_path: Path) -> None:
    mesh = chain(tmp_path, LINE, {**LINE, "step_size": 4 * H})
    state = saved(mesh, tmp_path / "a.state", AT + 2)
    with pytest.raises(ConfigurationError, match="its step is 4 points, and the state is of point 202, within one"):
        mesh.open(state=state, replaced=["first"])
    with mesh.open(state=saved(mesh, tmp_path / "b.state"), replaced=["first"]) as system:
        assert system.get("first.begun") == AT * H
        system.reset()
        assert (system.point, system.get("first.begun")) == (0, 0.0)


def test_a_sweep_and_a_rerun_replace_the_instance_again(tmp_path: Path) -> None:
    mesh = chain(tmp_path, {"fmu": "Integrator", "start_values": {"y": 1.0}}, LINE)
    state = saved(mesh, tmp_path / "a.state")
    how: dict[str, Any] = {"state": state, "replaced": ["first"]}
    first = mesh.run(output=tmp_path / "first.csv", processes=False, **how)
    again = fmu_mesh.rerun(tmp_path / "first.csv", output=tmp_path / "again.csv", processes=False, allow_code=True)
    assert_goes_on(again, first, 0)
    sweeping: dict[str, Any] = {"folder": tmp_path / "sweep", "workers": 1, "reduce": ["last(first.y)"], **how}
    with fmu_mesh.sweep(mesh, {"first.y": [1.0, 5.0]}, **sweeping) as running:
        found = running.wait(DEADLINE_S).values("last(first.y)")
    assert found[0] == first["first.y"][-1]
    assert found[1] == pytest.approx(found[0] + 4.0)
