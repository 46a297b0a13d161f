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
    assert str(check).endswith("\n\nOK: <mesh pair> can run.")
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


def test_a_mesh_that_is_saved_in_another_folder_has_the_same_files(folder: Path) -> None:
    (folder / "other").mkdir()
    mesh = built()
    mesh.configure(scenario="values.yaml", zenoh={"config": "zenoh.json5"}, ros={"messages": {"a/msg/B": "B.msg"}})
    mesh.record("pendulum.a", file="a.csv")
    mesh.record("pendulum.a", file="/dev/null", also=True)

    mesh.save(folder / "other" / "pair.yaml")

    before: Any = mesh.configuration.data
    after: Any = fmu_mesh.load(folder / "other" / "pair.yaml").configuration.data
    assert [own["file"] for own in after["record"]] == ["../a.csv", "/dev/null"]
    assert (after["scenario"], after["zenoh"]["config"]) == ("../values.yaml", "../zenoh.json5")
    assert after["ros"]["messages"] == {"a/msg/B": "../B.msg"}
    for name, instance in after["instances"].items():
        there, here = folder / "other" / instance["fmu"], folder / before["instances"][name]["fmu"]
        assert there.resolve() == here.resolve()
    assert fmu_mesh.Mesh.from_yaml(mesh.to_yaml(), folder=folder).to_yaml() == mesh.to_yaml()


def test_options_are_checked_as_on_the_command_line() -> None:
    with pytest.raises(fmu_mesh.ConfigurationError, match="`window=0`"):
        built().run(window=0)
    with pytest.raises(fmu_mesh.CallRefused, match="exclude each other"):
        built().run(output="a.csv", record="memory")
    with pytest.raises(fmu_mesh.ConfigurationError, match=r"`start_values=\{'pendulum\.a': <object"):
        built().run(start_values={"pendulum.a": object()})


def test_a_plan_is_made_once_and_started_as_often_as_wanted() -> None:
    plan = built().plan(record="memory", config_values={"simulation.stop_time": 0.5}, algorithm="jacobi")

    assert plan.plan.grid.last_point == 500
    assert plan.loaded.config.simulation.algorithm == "jacobi"
    results = []
    for processes in (True, False):
        with fmu_mesh.Run.start(plan, processes=processes) as run:
            results.append(run.wait())
    assert len(results[0].times) == 501
    assert same(*results)


def test_a_plan_leaves_nothing_where_it_is_not_started(folder: Path) -> None:
    assert built().check(record="memory")

    assert list((folder / "run").glob("*")) == []


def test_a_plan_runs_once_at_a_time() -> None:
    plan = built(stop_time=None).plan(record="memory")

    with fmu_mesh.Run.start(plan), pytest.raises(fmu_mesh.CallRefused, match="this plan of 'pair' runs already"):
        fmu_mesh.Run.start(plan)


def test_values_of_keys_are_refused_where_they_stand() -> None:
    check = built().check(config_values={"simulation.stop_tme": 2.0, "instances.delay.start_values": {"d": 1.0}})

    assert [finding.path for finding in check.findings] == [
        "`config_values={'instances.delay.start_values': {'d': 1.0}}`",
        "`config_values={'simulation.stop_tme': 2.0}`",
    ]
    assert check.plan is None
    assert check.page == ""
    with pytest.raises(fmu_mesh.ConfigurationError, match="stop_tme"):
        check.require()


def test_one_fmu_is_a_mesh() -> None:
    mesh = fmu_mesh.Mesh.from_fmu(FMUS / "Gain.fmu", name="one", simulation={"step_size": 0.1, "stop_time": 1.0})

    result = mesh.run(record="memory", start_values={"one.k": 2.0, "one.u": 3.0})

    assert result["one.y"].tolist() == [6.0] * 11


def test_what_is_no_fmu_makes_no_mesh(folder: Path) -> None:
    with pytest.raises(fmu_mesh.LoadFailed, match="A configuration is run by"):
        fmu_mesh.Mesh.from_fmu(write_config(folder))
    with pytest.raises(fmu_mesh.LoadFailed, match="does not exist"):
        fmu_mesh.inspect("nothing.fmu")


def test_a_profile_is_in_the_outcome() -> None:
    outcome = built().run(record="memory", profile=True).outcome

    assert outcome is not None
    assert outcome.profile is not None
    assert {node.node for node in outcome.profile.nodes} >= {"pendulum", "delay"}
