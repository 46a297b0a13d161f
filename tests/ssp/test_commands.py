"""The commands that take a configuration take a package of SSP: as a file, a folder, a description, and by `--ssd`."""

from __future__ import annotations

import csv
import json
import shlex
from pathlib import Path

import pytest

import fmu_mesh
from fmu_mesh.cli.main import main
from tests.helpers import FMUS
from tests.ssp.packages import Files, write_package
from tests.ssp.ship import INSTANCES, SHIP, without_times

NEEDED = ("--step-size", "--stop-time", "--algorithm")


@pytest.fixture(autouse=True)
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def packed(name: str = "ship.ssp", files: Files = SHIP) -> str:
    """Write a package here; returns its name."""
    path = Path(name)
    path.parent.mkdir(parents=True, exist_ok=True)
    return str(write_package(path, files))


def refused(capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
    """What a command says that ends with exit code 2."""
    assert main([*arguments]) == 2
    return " ".join(capsys.readouterr().err.split())


@pytest.mark.parametrize(
    ("write", "name", "result"),
    [
        ("ship.ssp", "ship.ssp", "results/DP_ship.csv"),
        ("sub/ship.ssp", "sub/ship.ssp", "sub/results/DP_ship.csv"),
        ("ship.ssp", "ship.ssp/SystemStructure.ssd", "results/DP_ship.csv"),
        ("ship.ssp", "ship.ssp/VarB.ssd", "results/Variant_B.csv"),
        ("mit Leer/Schiff ß.ssp", "mit Leer/Schiff ß.ssp", "mit Leer/results/DP_ship.csv"),
        ("ship.zip", "ship.zip", "results/DP_ship.csv"),
        ("ship", "ship", "ship/results/DP_ship.csv"),
        ("ship", "ship/VarB.ssd", "ship/results/Variant_B.csv"),
    ],
)
def test_package_runs_by_each_of_its_names_and_rerun_has_its_values(write: str, name: str, result: str) -> None:
    packed(write)

    assert main(["launch", name, "--local", "--no-progress"]) == 0
    assert main(["rerun", result]) == 0

    assert {name.partition(".")[0] for name in fmu_mesh.Result.read(result).names} == {*INSTANCES}


def test_a_link_to_a_package_has_its_result_where_the_link_is(tmp_path: Path) -> None:
    package = packed("kept/ship.ssp")
    Path("link.ssp").symlink_to(tmp_path / package)

    assert main(["launch", "link.ssp", "--local", "--no-progress"]) == 0

    assert Path("results/DP_ship.csv").is_file()


def test_a_result_of_a_moved_package_runs_again_from_its_yaml_file() -> None:
    package = packed()
    assert main(["convert", package, "made/ship.yaml"]) == 2  # there is no such folder
    Path("made").mkdir()
    assert main(["convert", package, "made/ship.yaml"]) == 0
    assert main(["launch", "made/ship.yaml", "--local", "--no-progress"]) == 0
    assert main(["launch", package, "--local", "--no-progress"]) == 0
    Path("made/results/DP_ship.csv").rename("moved.csv")
    Path("made/results/DP_ship.csv.json").rename("moved.csv.json")

    assert main(["rerun", "moved.csv"]) == 0
    assert main(["compare", "moved.rerun.csv", "results/DP_ship.csv"]) == 0


def test_inspect_tells_a_program_what_is_wrong_with_its_arguments(capsys: pytest.CaptureFixture[str]) -> None:
    package = packed()

    for arguments in ([package, "--ssd", "VarC"], [f"{package}/VarB.ssd", "--ssd", "VarB"], [package, "x"]):
        assert main(["inspect", *arguments, "--json"]) == 2
        assert json.loads(capsys.readouterr().out)["error"]["kind"] == "ConfigurationError"


@pytest.mark.parametrize("name", ["VarB", "VarB.ssd", "Variant B"])
def test_the_file_and_the_name_of_a_description_choose_it(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    package = packed()

    for command in ("check", "inspect", "graph"):
        assert main([command, package, "--ssd", name]) == 0
        assert "Variant" in capsys.readouterr().out


def test_options_replace_what_a_package_says() -> None:
    package = packed()
    options = ["--set", "DP-32-Controller.k=-4", "--set-config", "simulation.stop_time=2", "--output", "own.csv"]

    assert main(["launch", package, "--local", "--no-progress", *options]) == 0

    own = fmu_mesh.Result.read("own.csv")
    assert own["DP-32-Controller.y"][-1] == -4.0 * own["Pendulum.a"][-2]


def test_what_a_package_cannot_say_is_asked_for_by_option(capsys: pytest.CaptureFixture[str]) -> None:
    package = packed(files=without_times(SHIP))

    for command in (["check"], ["launch"], ["graph"], ["sweep", "--vary", "Pendulum.l=1,2"]):
        text = refused(capsys, *command[:1], package, *command[1:])
        assert all(option in text for option in NEEDED), command
    given = ["--step-size", "0.01", "--stop-time", "1", "--algorithm", "jacobi"]
    assert main(["launch", package, "--local", "--no-progress", *given]) == 0
    assert main(["convert", package, "ship.yaml", *given]) == 0
    assert main(["launch", "ship.yaml", "--local", "--no-progress", "--output", "own.csv"]) == 0
    assert main(["compare", "own.csv", "results/DP_ship.csv"]) == 0


def test_the_name_of_an_element_is_answered_with_that_of_its_instance(capsys: pytest.CaptureFixture[str]) -> None:
    package = packed()

    assert "Did you mean 'DP-32-Controller'?" in refused(capsys, "launch", package, "--set", "DP Controller.k=4")
    assert "Did you mean 'DP-32-Controller'?" in refused(capsys, "node", package, "DP Controller")
    assert "'DP-32-Controller.k'" in refused(capsys, "sweep", package, "--vary", "DP Controller.k=1,2")


def test_a_sweep_of_a_package_goes_on_from_its_folder(capsys: pytest.CaptureFixture[str]) -> None:
    package = packed()
    vary = ["--vary", "DP-32-Controller.k=1,2", "--reduce", "max(Plant--49--46--32-Integrator.y)", "--workers", "1"]

    assert main(["sweep", package, *vary]) == 0
    assert main(["sweep", "results/DP_ship_sweep"]) == 0
    assert main(["sweep", "results/DP_ship_sweep", "--ssd", "VarB"]) == 2

    assert "2 of them before" in capsys.readouterr().out
    with Path("results/DP_ship_sweep/table.csv").open() as table:
        rows = list(csv.DictReader(table))
    half, whole = (float(row["max(Plant--49--46--32-Integrator.y)"]) for row in rows)
    assert whole == 2.0 * half


def test_the_check_of_a_package_says_where_each_value_comes_from(capsys: pytest.CaptureFixture[str]) -> None:
    package = packed()

    assert main(["check", package, "--json"]) == 0

    report = json.loads(capsys.readouterr().out)
    origins = {one["name"]: one["origins"] for one in report["plan"]["instances"]}
    assert origins["Pendulum"]["l"]["file"] == "ship.ssp/resources/values.ssv"
    assert origins["DP-32-Controller"]["k"]["file"] == "ship.ssp/SystemStructure.ssd"
    assert report["plan"]["result_file"].endswith("/results/DP_ship.csv")


def test_a_converted_variant_is_run_by_the_command_that_convert_prints(capsys: pytest.CaptureFixture[str]) -> None:
    package = packed()

    assert main(["convert", package, "my ship.ssp", "--ssd", "VarB"]) == 0
    command = shlex.split(capsys.readouterr().out.partition("`")[2].partition("`")[0])

    assert command == ["fmu-mesh", "launch", "my ship.ssp", "--ssd", "VarB.ssd"]
    assert main([*command[1:], "--local", "--no-progress"]) == 0
    assert Path("results/Variant_B.csv").is_file()


def test_inspect_shows_the_instances_that_run_where_an_annotation_chose_their_names(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert main(["convert", packed(), "new.ssp", "--version", "2.0"]) == 0
    capsys.readouterr()

    assert main(["inspect", "new.ssp", "--json"]) == 0

    shown = json.loads(capsys.readouterr().out)["elements"]
    assert [one["instance"] for one in shown if one["kind"] == "component"] == fmu_mesh.load("new.ssp").instances
    assert fmu_mesh.load("new.ssp").instances == [*INSTANCES]


def test_a_scenario_beside_a_package_is_found_by_a_relative_path(capsys: pytest.CaptureFixture[str]) -> None:
    package = packed()
    Path("steps.yaml").write_text("events: [{at: 0.5, set: {DP-32-Controller.k: 5}}]\n")

    assert main(["launch", package, "--local", "--no-progress", "--scenario", "steps.yaml"]) == 0
    own = ["--set-config", "scenario=../steps.yaml", "--output", "own.csv"]
    assert main(["launch", package, "--local", "--no-progress", *own]) == 0
    assert main(["compare", "own.csv", "results/DP_ship.csv"]) == 0
    text = refused(capsys, "check", package, "--set-config", "scenario=steps.yaml")
    assert "'steps.yaml' inside 'ship.ssp'" in text
    assert "`../NAME` is beside that archive" in text


def test_a_scenario_that_a_program_gives_a_package_is_exported_with_it() -> None:
    Path("steps.yaml").write_text("events: [{at: 0.5, set: {DP-32-Controller.k: 5}}]\n")
    mesh = fmu_mesh.load(packed())
    mesh.scenario(file="../steps.yaml")

    mesh.to_ssp("again.ssp")

    again = fmu_mesh.load("again.ssp").run(record="memory", processes=False)
    assert (
        again["DP-32-Controller.y"].tolist()
        == mesh.run(record="memory", processes=False)["DP-32-Controller.y"].tolist()
    )


def test_result_that_cannot_be_written_beside_package_is_refused_with_way_out(
    capsys: pytest.CaptureFixture[str],
) -> None:
    package = packed()
    Path("results").touch()

    assert "results'; expected a file in a folder; choose one with `--output`" in refused(
        capsys, "launch", package, "--local"
    )
    assert main(["launch", package, "--local", "--no-progress", "--output", "own/own.csv"]) == 0


def test_a_result_file_inside_a_package_is_refused_with_the_way_out(capsys: pytest.CaptureFixture[str]) -> None:
    text = refused(capsys, "launch", packed(), "--local", "--set-config", "record.file=own.csv")

    assert "--set-config record.file=own.csv: 'own.csv' in the file" in text
    assert "ship.ssp'; expected a file in a folder; choose one with `--output`" in text


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["check", "ship.ssp/resources/values.ssv"], "is a part of a package of SSP. Name the package"),
        (["check", "ship.ssp/resources"], "is a part of a package of SSP. Name the package"),
        (["check", "ship/resources/values.ssv"], "is a part of a package of SSP. Name the package"),
        (["launch", "ship.ssp/VarC.ssd"], "'ship.ssp' has no description 'VarC.ssd'. Did you mean 'VarB.ssd'?"),
        (["launch", "shop.ssp"], "shop.ssp: no such file. Did you mean 'ship.ssp'?"),
        (["launch", "ship.ssp/VarB.ssd", "--ssd", "VarB"], "Name the package, 'ship.ssp', or leave `--ssd` out."),
        (["inspect", "ship/VarB.ssd", "--ssd", "VarB"], "Name the package, 'ship', or leave `--ssd` out."),
        (["graph", "DP_ship", "--ssd", "VarB"], "'DP_ship' is no package"),
        (["graph", "--ssd", "VarB"], "--ssd and --ssv choose a variant of a package of SSP, and none is named"),
        (["convert", "ship.ssp", "no/ship.ssp"], "'no/ship.ssp' cannot be written: No such file or directory"),
        (["launch", "ship.ssp", "--ssd", "VarC"], "'ship.ssp' has no description 'VarC'. Did you mean 'VarB'?"),
        (["new", "ship.ssp"], "`fmu-mesh convert ship.ssp mesh.yaml` makes a file to change"),
        (["new", "ship"], "`fmu-mesh launch ship` runs it"),
        (["run", "ship.ssp"], "It is a package of SSP: `fmu-mesh launch ship.ssp` runs it"),
        (["inspect", "ship/VarB.ssd", "x"], "`fmu-mesh inspect ship/resources/NAME.fmu`"),
        (["inspect", "ship.ssp/resources/Gian.fmu"], "Did you mean 'resources/Gain.fmu'?"),
        (["check", "mesh.yaml"], "It is a package of SSP: name an FMU in it, as 'ship.ssp/resources/"),
        (["check", "mesh.yaml", "--ssd", "VarB"], "'mesh.yaml' is no package"),
    ],
)
def test_what_is_no_package_or_no_configuration_is_refused_with_way_out(
    arguments: list[str], words: str, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    packed()
    packed("ship")
    Path("mesh.yaml").write_text(
        "mesh: m\nsimulation: {step_size: 0.1, stop_time: 1}\ninstances: {ship: {fmu: ship.ssp}}\n"
    )

    assert words in refused(capsys, *arguments).replace(f"{tmp_path}/", "")


def test_a_mesh_that_was_loaded_from_package_is_changed_and_exported_again() -> None:
    mesh = fmu_mesh.load(packed())
    mesh.add("extra", fmu=str(FMUS / "Gain.fmu"), start_values={"k": 7.0})
    mesh.connect(f"{INSTANCES[2]}.y", "extra.u")
    mesh.configure(simulation={"window": 8}, group="auto")

    mesh.to_ssp("changed.ssp")
    mesh.save("changed.yaml")

    rows = [
        one.run(record="memory", processes=False)["extra.y"].tolist()
        for one in (mesh, fmu_mesh.load("changed.ssp"), fmu_mesh.load("changed.yaml"))
    ]
    assert rows[0] == rows[1] == rows[2]
    assert fmu_mesh.load("changed.ssp").instances == [*INSTANCES, "extra"]


def test_a_package_is_stepped_and_repeated_in_this_process() -> None:
    package = packed()

    with fmu_mesh.load(package).open({"DP-32-Controller.k": 4.0}) as system:
        system.step(100)
        last = system.get("Plant--49--46--32-Integrator.y")
    with fmu_mesh.load(package).repeated() as mesh:
        first = mesh.run(start_values={"DP-32-Controller.k": 4.0})
        second = mesh.run(start_values={"DP-32-Controller.k": 8.0})

    assert first["Plant--49--46--32-Integrator.y"][-1] == last
    assert second["Plant--49--46--32-Integrator.y"][-1] == 2.0 * last
