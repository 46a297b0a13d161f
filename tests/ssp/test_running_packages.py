"""A package of SSP in processes: commands for what runs, parts started manually, and a package that changes."""

from __future__ import annotations

from pathlib import Path

import fmu_mesh
from fmu_mesh.ros.bags.playing import running_configuration
from tests.helpers import Place
from tests.ssp.packages import Files, component, connector, description, fmus, system, write_package
from tests.ssp.ship import INSTANCES, SHIP, without_times


def equal(one: Path, other: Path) -> bool:
    return bool(fmu_mesh.Result.read(one).compare(fmu_mesh.Result.read(other)))


def test_package_that_runs_is_seen_and_steered_by_names_of_its_instances(place: Place) -> None:
    package = write_package(place.folder / "ship.ssp", SHIP)
    launched = place.start("launch", package, "--paused", "--no-progress")
    assert place.run("wait", "DP_ship", "--state", "paused").wait() == 0

    assert all(name in place.run("ls").output for name in INSTANCES)
    assert "fed by       Pendulum.a -> DP-32-Controller.u" in place.run("info", "DP-32-Controller").output
    assert "from point 0 on" in place.run("set", "DP-32-Controller.k", "2.5").output
    assert place.run("step", "5").wait() == 0
    assert "2.5" in place.run("get", "DP-32-Controller.k").output
    assert "Did you mean 'DP-32-Controller'?" in place.run("get", "DP Controller.k").errors
    assert "DP-32-Controller.u" in place.run("graph", "DP_ship").output
    assert place.run("resume").wait() == 0
    assert launched.wait() == 0
    assert place.run("rerun", "results/DP_ship.csv").wait() == 0


def test_nodes_and_a_master_that_are_started_manually_give_result_of_launch(place: Place) -> None:
    package = write_package(place.folder / "ship.ssp", SHIP)
    parts = [place.start("node", package, "--ssd", "VarB", name) for name in INSTANCES]
    parts.append(place.start("master", package, "--ssd", "VarB", "--output", "own.csv", "--no-progress"))

    assert [part.wait() for part in parts] == [0, 0, 0, 0]
    assert place.run("launch", package, "--ssd", "VarB", "--local").wait() == 0

    assert equal(place.folder / "own.csv", place.folder / "results/Variant_B.csv")


def test_a_bag_is_played_into_a_package_whose_times_option_has_given(place: Place) -> None:
    package = write_package(place.folder / "ship.ssp", SHIP)
    assert place.run("launch", package, "--local", "--output", "bag.mcap").wait() == 0
    gain = component("the gain", "Gain", connector("u", "input"), connector("y", "output"))
    free: Files = {
        "SystemStructure.ssd": description(system("root", gain), name="free", stop_time=None),
        **fmus("Gain"),
    }
    write_package(place.folder / "free.ssp", free)
    times = ["--step-size", "0.01", "--stop-time", "1", "--algorithm", "jacobi"]
    launched = place.start("launch", "free.ssp", *times, "--paused", "--no-progress")
    assert place.run("wait", "free", "--state", "paused").wait() == 0

    played = place.run("play", "bag.mcap", "free", "--topic", "/Pendulum/a=the-32-gain.u")

    assert (played.wait(), launched.wait()) == (0, 0), (played.errors, launched.errors)
    assert "played 100 values of /Pendulum/a from point 0 to point 99" in played.output


def test_a_package_is_the_configuration_of_a_mesh_that_others_look_at(place: Place) -> None:
    package = write_package(place.folder / "ship.ssp", without_times(SHIP))

    loaded = running_configuration(package)

    assert loaded.config.mesh == "DP_ship"
    assert [*loaded.config.instances] == [*INSTANCES]


def test_a_run_goes_on_where_its_package_is_replaced_or_deleted(place: Place) -> None:
    package = write_package(place.folder / "ship.ssp", SHIP)
    kept = package.read_bytes()
    assert place.run("launch", package, "--output", "first.csv", "--no-progress").wait() == 0
    launched = place.start("launch", package, "--paused", "--output", "second.csv", "--no-progress")
    assert place.run("wait", "DP_ship", "--state", "paused").wait() == 0

    package.write_bytes(b"")
    assert place.run("step", "5").wait() == 0
    package.unlink()
    assert place.run("resume").wait() == 0

    assert launched.wait() == 0
    assert equal(place.folder / "first.csv", place.folder / "second.csv")
    assert "does not exist" in place.run("rerun", "second.csv").errors
    package.write_bytes(kept)
    assert place.run("rerun", "second.csv").wait() == 0
