"""Meshes that a program reads or builds: the same as those of files, with the same findings."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import fmu_mesh
from tests.helpers import FMUS, write_config


def built(stop_time: float | None = 1.0) -> fmu_mesh.Mesh:
    mesh = fmu_mesh.Mesh("pair", step_size=0.001, stop_time=stop_time)
    mesh.add("pendulum", fmu=FMUS / "DampedPendulum.fmu")
    mesh.add("delay", fmu=FMUS / "TransportDelay.fmu", start_values={"d": 0.1})
    mesh.connect("pendulum.a", "delay.x")
    return mesh


def same(one: fmu_mesh.Result, other: fmu_mesh.Result) -> bool:
    """Whether two results are equal in every float."""
    return (
        list(one) == list(other)
        and one.times.tobytes() == other.times.tobytes()
        and all(one[name].tobytes() == other[name].tobytes() for name in one)
    )


def test_a_mesh_that_a_program_builds_gives_what_its_file_gives(folder: Path) -> None:
    from_file = fmu_mesh.load(write_config(folder)).run(record="memory")

    assert same(built().run(record="memory"), from_file)


def test_a_mesh_goes_through_yaml_and_back(folder: Path) -> None:
    mesh = built()
    mesh.record("delay.y", file="chosen.csv")
    mesh.configure(group="auto", timeouts={"step": 5.0}, simulation={"window": 64})
    mesh.save("pair.yaml")

    again = fmu_mesh.load("pair.yaml")

    assert again.to_yaml() == mesh.to_yaml() == Path("pair.yaml").read_text(encoding="utf-8")
    result = again.run()
    assert result.file == folder / "chosen.csv"
    assert same(fmu_mesh.Result.read("chosen.csv"), mesh.run(record="memory"))
    assert list(fmu_mesh.Mesh.from_yaml(mesh.to_yaml(), folder=folder).run(record="memory")) == ["delay.y"]


def test_start_values_are_exact_and_may_come_from_numpy() -> None:
    value = 0.1 + 2**-53
    mesh = fmu_mesh.Mesh("gain", step_size=0.5, stop_time=1.0)
    mesh.add("gain", fmu=FMUS / "Gain.fmu", start_values={"u": np.float64(value)})

    assert mesh.run(record="memory")["gain.y"].tolist() == [value] * 3
    assert (
        mesh.run(record="memory", start_values={"gain.u": np.float64(3 * value)})["gain.y"].tolist() == [3 * value] * 3
    )


def test_findings_name_their_place() -> None:
    mesh = built()
    mesh.connect("pendulum.b", "delay.x")
    mesh.add("gain", fmu="Nothing.fmu")

    check = mesh.check()

    assert not check
    assert {finding.path for finding in check.findings} == {
        "connections[1]",
        "connections[1].from",
        "instances.gain.fmu",
    }
    assert check.run is None
    with pytest.raises(fmu_mesh.ConfigurationError) as caught:
        mesh.run()
    assert caught.value.findings == check.findings
    assert "  - <mesh pair>: connections[1].from: " in str(caught.value)


def test_what_is_right_has_a_plan() -> None:
    check = built().check()

    assert check
    assert str(check) == "OK"
    assert check.run is not None
    assert check.run.plan.order == ("pendulum", "delay")


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ({"fmu": "x.fmu"}, "mesh 'pair' has an instance 'pendulum' already"),
        ({"start_values": {}}, "nothing says what 'pendulum' is. Give it one of the keys "),
    ],
)
def test_an_instance_is_added_once_and_says_what_it_is(keys: dict[str, Any], message: str) -> None:
    mesh = built() if "fmu" in keys else fmu_mesh.Mesh("pair", step_size=0.1, stop_time=1.0)
    with pytest.raises(fmu_mesh.CallRefused, match=message):
        mesh.add("pendulum", **keys)


def test_a_mesh_is_saved_where_its_paths_are_right(folder: Path) -> None:
    (folder / "other").mkdir()
    with pytest.raises(fmu_mesh.ConfigurationError, match="to which the paths in it refer"):
        built().save(folder / "other" / "pair.yaml")


def test_options_are_checked_as_on_the_command_line() -> None:
    with pytest.raises(fmu_mesh.ConfigurationError, match="--window 0"):
        built().run(window=0)
    with pytest.raises(fmu_mesh.CallRefused, match="exclude each other"):
        built().run(output="a.csv", record="memory")
    with pytest.raises(fmu_mesh.CallRefused, match=r"the start value of 'pendulum\.a' is"):
        built().run(start_values={"pendulum.a": object()})
