"""Meshes that a program reads or builds: the same as those of files, with the same findings."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import fmu_mesh
from fmu_mesh.api.mesh_editing import connections_of
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
    assert "  - mesh.connect('pendulum.b', 'delay.x'): connections[1].from: " in str(caught.value)
    assert "  - mesh.add('gain'): instances.gain.fmu: " in str(caught.value)


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


def test_keys_are_connections_that_can_be_changed_and_removed(folder: Path) -> None:
    mesh = built()
    mesh.add("gain", fmu=FMUS / "Gain.fmu")
    mesh.subscribe("plant/flow", "gain.u", factor=2.0)
    mesh.subscribe("plant/flow", "gain.k")
    mesh.subscribe("plant/flow", "gain.u", encoding="text")
    mesh.publish("gain.y", "twin/y", every=0.1)
    mesh.publish("delay.y", "twin/angle")

    assert [key.ends for key in mesh.check().plan.keys] == [  # type: ignore[union-attr]  # it has one
        "delay.y -> twin/angle",
        "plant/flow -> gain.u",
        "plant/flow -> gain.k",
        "gain.y -> twin/y",
    ]
    mesh.save(folder / "keys.yaml")
    assert fmu_mesh.load(folder / "keys.yaml").configuration.data == mesh.configuration.data

    mesh.disconnect("plant/flow", "gain.k")
    mesh.disconnect(target="twin/angle")
    assert connections_of(mesh.configuration) == [
        {"from": "pendulum.a", "to": "delay.x"},
        {"key": "plant/flow", "to": "gain.u", "encoding": "text"},
        {"from": "gain.y", "key": "twin/y", "every": 0.1},
    ]
    mesh.remove("gain")
    assert connections_of(mesh.configuration) == [{"from": "pendulum.a", "to": "delay.x"}]


def test_a_key_with_the_name_of_an_instance_stays_when_that_goes() -> None:
    mesh = built()
    mesh.add("gain", fmu=FMUS / "Gain.fmu")
    mesh.subscribe("pendulum.a", "gain.u")

    mesh.remove("pendulum")

    assert connections_of(mesh.configuration) == [{"key": "pendulum.a", "to": "gain.u"}]


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda mesh: mesh.subscribe("a/b", "delay"), r"mesh.subscribe\('a/b', 'delay'\): 'delay'; expected instance"),
        (lambda mesh: mesh.publish("delay", "a/b"), r"mesh.publish\('delay', 'a/b'\): 'delay'; expected instance"),
        (lambda mesh: mesh.subscribe("", "delay.x"), "key: ''; expected a Zenoh key"),
        (lambda mesh: mesh.subscribe("a/b", "delay.x", encodin="text"), "encodin: an unknown key.*'encoding'"),
        (lambda mesh: mesh.publish("delay.y", "a/b", on="x"), "on: 'x'; expected change or point"),
        (
            lambda mesh: mesh.disconnect("delay.y", "twin/z"),
            "no connection 'delay.y -> twin/z'.*'delay.y -> key twin/y'",
        ),
    ],
)
def test_a_call_with_a_wrong_key_is_refused(call: Callable[[fmu_mesh.Mesh], None], message: str) -> None:
    mesh = built()
    mesh.publish("delay.y", "twin/y")

    with pytest.raises(fmu_mesh.FmuMeshError, match=message):
        call(mesh)
    assert len(connections_of(mesh.configuration)) == 2


def test_a_mesh_that_is_saved_in_another_folder_has_the_same_files(folder: Path) -> None:
    (folder / "other").mkdir()
    mesh = built()
    ros = {"messages": {"a/msg/B": "B.msg"}, "topics": [{"topic": "/x", "constants": {"data": {"file": "x.urdf"}}}]}
    mesh.configure(scenario="values.yaml", zenoh={"config": "zenoh.json5"}, ros=ros)
    mesh.record("pendulum.a", file="a.csv")
    mesh.record("pendulum.a", file="/dev/null", also=True)

    mesh.save(folder / "other" / "pair.yaml")

    before: Any = mesh.configuration.data
    after: Any = fmu_mesh.load(folder / "other" / "pair.yaml").configuration.data
    assert [own["file"] for own in after["record"]] == ["../a.csv", "/dev/null"]
    assert (after["scenario"], after["zenoh"]["config"]) == ("../values.yaml", "../zenoh.json5")
    assert after["ros"]["messages"] == {"a/msg/B": "../B.msg"}
    assert after["ros"]["topics"][0]["constants"] == {"data": {"file": "../x.urdf"}}
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


def cell(mesh: fmu_mesh.Mesh) -> None:
    """What a cell of a notebook says, which its user runs again and again."""
    mesh.add("gain", fmu=FMUS / "Gain.fmu", start_values={"k": 2.0}, replace=True)
    mesh.connect("delay.y", "gain.u", factor=3.0)
    mesh.record("gain.y", file="gain.csv")
    mesh.record("delay.y", file="delay.csv", also=True)
    mesh.scenario({"delay.d": 0.2}, [{"at": 0.5, "set": {"gain.k": 5.0}}])
    mesh.configure(timeouts={"step": 5.0})


def test_a_cell_that_runs_twice_says_the_same_as_once() -> None:
    once, twice = built(), built()
    cell(once)

    cell(twice)
    cell(twice)

    assert twice.to_yaml() == once.to_yaml()
    with pytest.raises(fmu_mesh.CallRefused, match=r"has an instance 'pendulum' already\. Call it with `replace=True`"):
        twice.add("pendulum", fmu="x.fmu")


def test_an_instance_with_another_section_keeps_its_connections() -> None:
    mesh = built()
    mesh.add("delay", fmu=FMUS / "TransportDelay.fmu", start_values={"d": 0.5}, replace=True)

    result = mesh.run(record="memory", processes=False)

    assert same(result, built().run(record="memory", processes=False, start_values={"delay.d": 0.5}))


def test_what_belongs_to_an_instance_goes_with_it() -> None:
    mesh = built()
    mesh.add("gain", fmu=FMUS / "Gain.fmu")
    mesh.add("gain2", fmu=FMUS / "Gain.fmu")
    mesh.connect("delay.y", "gain.u")
    mesh.connect("gain.y", "gain2.u")
    mesh.record("pendulum.a", "gain.y", "in:gain.u", file="gain.csv")
    mesh.record("gain.y", file="only.csv", also=True)
    mesh.scenario(
        {"gain2.k": 0.2}, [{"at": 0.5, "set": {"gain.k": 5.0}}, {"at": 0.6, "set": {"gain.k": 5.0, "gain2.k": 1}}]
    )

    mesh.remove("gain")

    data: Any = mesh.configuration.data
    assert [*data["instances"]] == ["pendulum", "delay", "gain2"]
    assert [one["to"] for one in data["connections"]] == ["delay.x"]
    assert [one["variables"] for one in data["record"]] == [["pendulum.a"], None]
    assert data["scenario"] == {"values": {"gain2.k": 0.2}, "events": [{"at": 0.6, "set": {"gain2.k": 1}}]}
    assert mesh.check()


def test_connections_are_cut_by_their_ends() -> None:
    mesh = built()
    for name in ("one", "two"):
        mesh.add(name, fmu=FMUS / "Gain.fmu")
        mesh.connect("pendulum.a", f"{name}.u")

    def targets() -> list[str]:
        data: Any = mesh.configuration.data
        return [one["to"] for one in data["connections"]]

    mesh.disconnect(target="one.u")
    assert targets() == ["delay.x", "two.u"]
    mesh.disconnect("pendulum.a", "two.u")
    assert targets() == ["delay.x"]
    mesh.disconnect("pendulum.a")
    assert targets() == []
    with pytest.raises(fmu_mesh.UnknownName, match=r"no connection 'pendulum\.a -> \*'"):
        mesh.disconnect("pendulum.a")


def test_findings_of_file_keep_their_lines_and_those_of_calls_name_them(folder: Path) -> None:
    (folder / "mesh.yaml").write_text(
        f"mesh: lines\nsimulation: {{step_size: 0.1, stop_time: 1.0}}\ninstances:\n"
        f"  one: {{fmu: '{FMUS / 'Gain.fmu'}'}}\n  two: {{fmu: '{FMUS / 'Gain.fmu'}'}}\n  old: {{fmu: gone.fmu}}\n"
        "connections:\n  - one.y -> old.u\n  - two.y -> one.k\nscenario: {values: {two.q: 1.0}}\n"
    )
    mesh = fmu_mesh.load("mesh.yaml")
    mesh.remove("old")
    mesh.add("old", fmu="gone.fmu")
    mesh.add("two", fmu="other.fmu", replace=True)
    mesh.connect("one.y", "one.x")
    mesh.scenario({"one.w": 1.0})

    places = {finding.path: (finding.file, finding.line) for finding in mesh.check().findings}
    mesh.add("two", fmu=FMUS / "Gain.fmu", replace=True)
    places |= {finding.path: (finding.file, finding.line) for finding in mesh.check().findings}

    assert places == {
        "instances.old.fmu": ("mesh.add('old')", None),
        "instances.two.fmu": ("mesh.add('two')", None),
        "connections[0].to": ("mesh.yaml", 9),
        "connections[1].to": ("mesh.connect('one.y', 'one.x')", None),
        "scenario.values.one.w": ("mesh.scenario(...)", None),
        "scenario.values.two.q": ("mesh.yaml", 10),
    }


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda mesh: mesh.add("g", fmu="a.fmu", start_valus={}), r"mesh\.add\('g'\): start_valus: .*'start_values'"),
        (lambda mesh: mesh.add("g", fmu="a.fmu", start_values=[1]), r"mesh\.add\('g'\): start_values: a list"),
        (lambda mesh: mesh.add("a b", fmu="a.fmu"), r"mesh\.add\('a b'\): 'a b'; expected a name"),
        (lambda mesh: mesh.connect("pendulum.a", "delay.x", factr=2), r"'delay\.x'\): factr: .*'factor'"),
        (lambda mesh: mesh.connect("pendulum", "delay.x"), "'pendulum'; expected instance.variable"),
        (lambda mesh: mesh.connect(None, "delay.x"), r"mesh\.connect\(None, 'delay\.x'\): from: "),
        (lambda mesh: mesh.record("pendulum.a", evry=2), r"record\.evry: .*'every'"),
        (lambda mesh: mesh.record("pendulum.a", file="b.csv", also=True, every=0), r"record\[1\]\.every: 0"),
        (lambda mesh: mesh.scenario({"delay.d": {"tims": [0]}}), r"scenario\.values\.delay\.d\.tims: .*'times'"),
        (lambda mesh: mesh.scenario(events=[{"at": 1.0}]), r"mesh\.scenario\(\.\.\.\): scenario\.events\[0\]\.set"),
        (lambda mesh: mesh.configure(timeouts={"stepp": 1}), r"mesh\.configure\(timeouts=\.\.\.\): timeouts\.stepp"),
        (lambda mesh: mesh.configure(group="auto", colour=3), "colour: an unknown key"),
        (lambda mesh: mesh.configure(simulation=5), "simulation: 5; expected a mapping"),
        (lambda mesh: mesh.remove("delai"), "no instance 'delai'. Did you mean 'delay'"),
        (lambda mesh: mesh.disconnect("pendulum.a", "delay.y"), "Did you mean 'pendulum.a -> delay.x'"),
        (lambda mesh: mesh.disconnect(), r"no connection '\* -> \*'"),
    ],
)
def test_a_wrong_call_changes_nothing_and_names_itself(call: Callable[[fmu_mesh.Mesh], None], message: str) -> None:
    mesh = built()
    before, origins = mesh.to_yaml(), mesh.configuration.origins

    with pytest.raises(fmu_mesh.CallRefused, match=message):
        call(mesh)

    assert mesh.to_yaml() == before
    assert mesh.configuration.origins == origins
