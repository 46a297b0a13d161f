"""Names that are longer than a file system or a socket takes them, and places where nobody can look."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import yaml

from fmu_mesh import FMIAdapter
from fmu_mesh.cli.main import main
from fmu_mesh.errors import LoadFailed
from tests.fmus.packing import repacked
from tests.helpers import FMUS, Place, write_config

LONG = "x" * 300
TOO_LONG = "File name too long"


def config_with(folder: Path, change: dict[str, Any]) -> Path:
    content = {
        "mesh": "one",
        "simulation": {"stop_time": 1, "step_size": 0.1},
        "instances": {"gain": {"fmu": str(FMUS / "Gain.fmu")}},
        "record": {"file": "one.csv"},
    }
    file = folder / "mesh.yaml"
    file.write_text(yaml.safe_dump({**content, **change}), encoding="utf-8")
    return file


PATHS = [
    pytest.param({"instances": {"gain": {"fmu": f"{LONG}.fmu"}}}, "instances.gain.fmu", TOO_LONG, id="an FMU"),
    pytest.param({"instances": {"gain": {"mujoco": f"{LONG}.xml"}}}, "instances.gain.mujoco", TOO_LONG, id="a world"),
    pytest.param(
        {"instances": {"gain": {"gazebo_classic": f"{LONG}.world"}}}, "gain.gazebo_classic", TOO_LONG, id="of Gazebo"
    ),
    pytest.param({"record": {"file": f"{LONG}.csv"}}, "record.file", TOO_LONG, id="a result"),
    pytest.param({"zenoh": {"config": f"{LONG}.json5"}}, "zenoh.config", "no such file", id="of Zenoh"),
]


@pytest.mark.parametrize("command", [("check",), ("launch",), ("launch", "--local")], ids=" ".join)
@pytest.mark.parametrize(("change", "place_in_file", "says"), PATHS)
def test_a_path_that_is_too_long_is_told_with_its_place(
    change: dict[str, Any],
    place_in_file: str,
    says: str,
    command: tuple[str, ...],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert main([*command, str(config_with(tmp_path, change))]) == 2

    said = capsys.readouterr().err
    assert f"{place_in_file}: " in said
    assert says in said


@pytest.mark.parametrize(
    "arguments",
    [("check", f"{LONG}.yaml"), ("inspect", f"{LONG}.fmu"), ("run", f"{LONG}.fmu"), ("plot", f"{LONG}.csv")],
    ids=lambda arguments: arguments[0],
)
def test_an_argument_that_is_too_long_is_told(arguments: tuple[str, str], capsys: pytest.CaptureFixture[str]) -> None:
    assert main(list(arguments)) == 2

    assert TOO_LONG in capsys.readouterr().err


def test_the_adapter_tells_a_path_that_is_too_long() -> None:
    with pytest.raises(LoadFailed, match=f"cannot be read: {TOO_LONG}"):
        FMIAdapter(f"{LONG}.fmu", 0.1)


def test_a_bag_with_a_name_that_is_too_long_does_not_exist(capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("rosbags")

    assert main(["play", f"{LONG}.mcap"]) == 2

    assert "does not exist" in capsys.readouterr().err


@pytest.mark.parametrize("options", [(), ("--local",)], ids=["distributed", "local"])
def test_a_mesh_with_a_long_name_runs(place: Place, options: tuple[str, ...]) -> None:
    """The path of a Unix socket has a hundred characters, which the name of a run's folder would fill."""
    config = write_config(place.folder, name="m" * 200)

    launched = place.run("launch", "--no-progress", *options, config)

    assert launched.wait() == 0, launched.errors
    place.assert_nothing_left()


def test_an_fmu_with_a_long_model_identifier_runs_by_itself(place: Place) -> None:
    long = "Modelica_Mechanics_MultiBody_Examples_Systems_RobotR3_fullRobot_with_gripper"
    fmu = repacked(
        place.folder / "long.fmu", description=lambda text: text.replace('Identifier="Gain"', f'Identifier="{long}"')
    )

    launched = place.run("run", fmu, "--step-size", "0.1", "--stop-time", "1", "--real-time-factor", "0")

    assert launched.wait() == 0, launched.errors
    assert f"mesh '{long}'" in launched.errors
    place.assert_nothing_left()
