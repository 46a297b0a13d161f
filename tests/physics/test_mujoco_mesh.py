"""A physics engine as a node of a mesh: looked at and changed while it runs, killed, failing, and missing."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from fmu_mesh.cli.main import main
from fmu_mesh.errors import LoadFailed
from fmu_mesh.instances import child_question
from fmu_mesh.instances.mujoco.mujoco_section import MujocoConfig
from fmu_mesh.instances.registry import describe
from tests.helpers import FMUS, Place, row_count, rows_of, wait_until
from tests.physics.mujoco_worlds import write_world

ROOT = Path(__file__).resolve().parents[2]
CONFIGS = ROOT / "configs"
WORLDS = CONFIGS / "worlds"

ENDLESS = "{stop_time: 100000.0, step_size: 0.001, algorithm: gauss_seidel, real_time_factor: 1}"


def endless(folder: Path) -> Path:
    """The weak arm of the electrical actuator, every instance in a process of its own, in real time and without end."""
    path = folder / "arm.yaml"
    path.write_text(
        f"""\
mesh: arm
simulation: {ENDLESS}
instances:
  world:
    mujoco: {WORLDS}/electrical_actuator.xml
    controllers: [{{name: weak, joint: weak, instance: controller}}]
    actuators: [{{name: weak, joint: weak, instance: motor}}]
  controller: {{controller: position_pid, start_values: {{p: 10, d: 3}}}}
  motor: {{fmu: {FMUS}/SimpleElectricalActuator.fmu}}
record: {{file: arm.csv, variables: [world.weak.position, controller.effort]}}
""",
        encoding="utf-8",
    )
    return path


def test_target_and_gains_are_set_while_the_world_is_watched(place: Place) -> None:
    config = endless(place.folder)
    launched = place.start("launch", config)
    result = config.with_suffix(".csv")
    wait_until(lambda: row_count(result) > 100, "100 rows")

    assert place.run("set", "controller.p", "109").wait() == 0
    assert place.run("set", "controller.target", "1").wait() == 0
    wait_until(
        lambda: any(row[2] > 50.0 for row in rows_of_so_far(result)), "an effort that only the new gain can ask for"
    )
    wait_until(lambda: rows_of_so_far(result)[-1][1] > 0.2, "an arm that moves")

    info = json.loads(place.run("info", "world", "--json").output)
    command = json.loads(place.run("get", "world.weak.effort_command", "--json").output)
    refused = place.run("set", "world.weak.effort", "3")
    launched.child("master").terminate()
    assert launched.wait() != 0
    place.assert_nothing_left(5.0)
    assert (info["kind"], info["model_name"]) == ("physics_engine", "electrical_actuator")
    assert info["generation_tool"].startswith("MuJoCo ")
    units = {variable["name"]: variable.get("unit") for variable in info["variables"]}
    assert (units["weak.position"], units["weak.effort"]) == ("rad", "N.m")
    assert "weak.effort_command" in json.dumps(command)
    assert refused.wait() == 2
    assert "is connected to 'motor'" in refused.message


def rows_of_so_far(file: Path) -> list[tuple[float, ...]]:
    """The complete rows of a file that is being written."""
    complete = file.read_text(encoding="utf-8").rpartition("\n")[0].splitlines()[1:]
    return [tuple(map(float, line.split(","))) for line in complete]


@pytest.mark.parametrize("victim", ["world", "motor", "controller"])
def test_a_killed_engine_actuator_or_controller_ends_the_run_with_its_name(place: Place, victim: str) -> None:
    config = endless(place.folder)
    launched = place.start("launch", config)
    result = config.with_suffix(".csv")
    wait_until(lambda: row_count(result) > 50, "50 rows")

    launched.child(victim).kill()

    assert launched.wait() == 4
    assert f"instance {victim}, point" in launched.message
    assert len(rows_of(result)) > 50
    place.assert_nothing_left()


@pytest.mark.parametrize("how", [("--local",), ()], ids=["local", "distributed"])
def test_a_world_that_cannot_be_computed_ends_run_with_what_came_before(place: Place, how: tuple[str, ...]) -> None:
    world = (WORLDS / "damped_pendulum.xml").read_text(encoding="utf-8").replace('damping="0.1"', 'damping="1e6"')
    (place.folder / "world.xml").write_text(world, encoding="utf-8")
    config = place.folder / "flies.yaml"
    config.write_text(
        """\
mesh: flies
simulation: {stop_time: 1.0, step_size: 0.001}
instances:
  world: {mujoco: world.xml, start_values: {engine.velocity: 1.0}}
record: {file: flies.csv, variables: [world.engine.position]}
""",
        encoding="utf-8",
    )

    launched = place.run("launch", config, "--no-progress", *how)

    assert launched.wait() == 3
    assert "instance world.engine.acceleration, point " in launched.message
    assert "MuJoCo says: " in launched.message
    assert len(rows_of(config.with_suffix(".csv"))) >= 1
    assert not (place.folder / "MUJOCO_LOG.TXT").exists()
    place.assert_nothing_left(5.0)


def test_check_shows_a_world_its_couplings_and_its_controllers(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["check", str(CONFIGS / "electrical_actuator.yaml")]) == 0

    page = capsys.readouterr().out
    assert "electrical_actuator.xml (MuJoCo " in page
    assert "position_pid (fmu_mesh)" in page
    assert "weak_motor.jointTorque -> world.weak.effort" in page
    assert "bare_controller -> weak_controller -> tuned_controller -> weak_motor -> tuned_motor -> world" in page


def test_without_mujoco_check_says_what_to_install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "mujoco.py").write_text("raise ImportError('not here')")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))

    assert main(["check", str(CONFIGS / "fluid_body.yaml")]) == 2

    message = capsys.readouterr().err
    assert "instances.world.mujoco: worlds of MuJoCo need the library mujoco" in message
    assert "-m pip install 'mujoco>=3.3'`" in message


def test_a_model_that_is_loaded_for_ever_is_a_finding(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(child_question, "_DEADLINE_S", 3.0)
    path = write_world(tmp_path, "<replicate count='2000000000'><body><geom size='1'/></body></replicate>")

    with pytest.raises(LoadFailed) as caught:
        describe(path, MujocoConfig(mujoco=path.name))

    assert str(caught.value) == f"MuJoCo, which loads '{path}', did not end within 3 s"


def test_a_path_that_is_no_text_is_a_finding(tmp_path: Path) -> None:
    (folder := tmp_path / "\udcff").mkdir()
    path = write_world(folder, "")

    with pytest.raises(LoadFailed, match=r"its path is no UTF-8\. Rename the folder"):
        describe(path, MujocoConfig(mujoco=path.name))


def test_a_world_that_is_not_there_is_refused_with_the_nearest_file(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    config = tmp_path / "mesh.yaml"
    config.write_text(
        "mesh: m\nsimulation: {stop_time: 1, step_size: 0.1}\n"
        f"instances: {{world: {{mujoco: {WORLDS}/fluid_bod.xml}}, other: {{mujoco: 3}}}}\n",
        encoding="utf-8",
    )

    assert main(["check", str(config)]) == 2

    message = capsys.readouterr().err
    assert "instances.world.mujoco: MuJoCo cannot load" in message
    assert "expected a MuJoCo model (MJCF or URDF)" in message
    assert "fluid_body.xml'?" in message
    assert "instances.other.mujoco: 3; expected text" in message
