"""The ROS package `fmu_mesh_ros`: its executables as `ros2 run` starts them, its launch files, and its launch action.

Where colcon has installed it (`.ci/long ros` does) that is what runs. Elsewhere a folder stands in for what colcon
installs. `tests/ros/launching.py` stands in for launch; ROS, the meshes and the FMUs are real.
"""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.helpers import DEADLINE_S, FMUS, Place, write_config
from tests.ros.ros_peer import Ros, ros_or_skip

ros_or_skip()

from ament_index_python.packages import get_package_prefix  # noqa: E402 only where ROS is installed

from tests.ros.launching import Launch, LaunchDescription, described, stand_in  # noqa: E402 as above

pytestmark = pytest.mark.usefixtures("package")

SOURCE = Path(__file__).parents[2] / "bridges/fmu_mesh_ros"
EXECUTABLE = """#!{python}
import sys
from fmu_mesh_ros.executables import {name}
sys.exit({name}())
"""


@pytest.fixture
def package(place: Place, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder that has `lib/fmu_mesh_ros`, as `local_setup.sh` makes it known."""
    monkeypatch.setenv("FMU_MESH_RUNTIME_DIR", str(place.folder / "run"))
    if (installed := os.environ.get("FMU_MESH_ROS_INSTALLED")) is not None:
        assert get_package_prefix("fmu_mesh_ros") == installed
        return Path(installed)
    prefix = tmp_path / "install"
    index = prefix / "share/ament_index/resource_index/packages"
    index.mkdir(parents=True)
    (index / "fmu_mesh_ros").touch()
    executables = prefix / "lib/fmu_mesh_ros"
    executables.mkdir(parents=True)
    for name in ("gateway", "mesh", "node", "wait"):
        (executables / name).write_text(EXECUTABLE.format(python=sys.executable, name=name), encoding="utf-8")
        (executables / name).chmod(0o755)
    paths = [str(SOURCE), *filter(None, [os.environ.get("PYTHONPATH")])]
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(paths))
    monkeypatch.syspath_prepend(SOURCE)
    monkeypatch.setenv("AMENT_PREFIX_PATH", str(prefix))
    return prefix


@pytest.fixture
def ros(tmp_path: Path) -> Iterator[Ros]:
    with Ros(tmp_path / "log") as ros:
        yield ros


def config(folder: Path, **simulation: Any) -> Path:  # noqa: ANN401 whatever a configuration may say
    return write_config(folder, simulation={"stop_time": 2.0, "step_size": 0.01, **simulation})


def run(package: Path, folder: Path, name: str, *arguments: str) -> subprocess.CompletedProcess[str]:
    command = [str(package / "lib/fmu_mesh_ros" / name), *arguments]
    return subprocess.run(command, check=False, capture_output=True, text=True, timeout=DEADLINE_S, cwd=folder)


def observed(mesh: Any) -> LaunchDescription:  # noqa: ANN401 the class of the package
    """A launch file with this mesh that ends everything when it is ready."""
    from fmu_mesh_ros.actions import OnMeshReady  # noqa: PLC0415 it imports the stand-in

    from tests.ros.launching import RegisterEventHandler, Shutdown  # noqa: PLC0415 beside it

    ready = OnMeshReady(target_action=mesh, on_ready=[Shutdown(reason="ready")])
    return LaunchDescription([RegisterEventHandler(ready), mesh])


def test_the_executable_mesh_runs_a_mesh_to_its_end(package: Path, tmp_path: Path) -> None:
    done = run(package, tmp_path, "mesh", str(config(tmp_path)))

    assert done.returncode == 0, done.stderr
    assert "200 points in" in done.stdout


@pytest.mark.parametrize(
    ("name", "arguments", "text"),
    [
        ("gateway", (), "usage: ros2 run fmu_mesh_ros gateway CONFIG"),
        ("wait", ("--timeout", "1"), "usage: ros2 run fmu_mesh_ros wait CONFIG"),
        ("wait", ("missing.yaml",), "missing.yaml: no such file"),
        ("mesh", ("missing.yaml",), "missing.yaml: no such file"),
    ],
)
def test_an_executable_says_what_is_wrong_with_its_arguments(
    package: Path, tmp_path: Path, name: str, arguments: tuple[str, ...], text: str
) -> None:
    done = run(package, tmp_path, name, *arguments)

    assert done.returncode == 2
    assert text in done.stderr


def test_a_python_without_fmu_mesh_is_named_with_the_way_out(tmp_path: Path) -> None:
    code = f"import sys; sys.path.insert(0, {str(SOURCE)!r}); from fmu_mesh_ros.executables import mesh; mesh()"
    command = [sys.executable, "-IS", "-c", code]

    done = subprocess.run(command, check=False, capture_output=True, text=True, timeout=DEADLINE_S, cwd=tmp_path)

    assert done.returncode == 2
    assert done.stderr.startswith(
        f"fmu_mesh_ros: {sys.executable} has no fmu_mesh. Activate the environment that has it"
    )


def test_the_executable_gateway_has_the_names_that_the_user_gives(ros: Ros, package: Path, tmp_path: Path) -> None:
    from std_msgs.msg import Float64  # noqa: PLC0415 only where ROS is installed

    file = config(tmp_path, stop_time=60.0, real_time_factor=1)
    subscription, angles = ros.collect(ros.peer(), Float64, "/lab/pendulum/a")
    executables = package / "lib/fmu_mesh_ros"
    names = ["--ros-args", "-r", "__ns:=/lab", "-r", "__node:=twin"]
    mesh = subprocess.Popen([executables / "mesh", file, "--no-progress"], cwd=tmp_path)
    gateway = subprocess.Popen([executables / "gateway", file, *names], cwd=tmp_path)
    try:
        ros.matched(subscription)
        ros.until(lambda: angles, "an angle")
        looking = ros.peer("looking")

        def named() -> bool:
            """ROS hears of a publisher before it knows whose that is."""
            found = looking.get_publishers_info_by_topic("/lab/pendulum/a")
            return [(own.node_namespace, own.node_name) for own in found] == [("/lab", "twin")]

        ros.until(named, "a publisher of /lab/twin, and no other one")
    finally:
        for process in (mesh, gateway):
            process.terminate()
        for process in (mesh, gateway):
            process.wait(DEADLINE_S)


@pytest.mark.parametrize("arguments", [[], ["--paused"]])
def test_a_launch_file_hears_that_a_mesh_is_ready(
    ros: Ros, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, arguments: list[str]
) -> None:
    stand_in(monkeypatch)
    from fmu_mesh_ros.actions import Mesh  # noqa: PLC0415 it imports the stand-in

    file = config(tmp_path, stop_time=600.0, real_time_factor=1)

    with Launch(ros, tmp_path, observed(Mesh(config=str(file), arguments=arguments))) as launch:
        launch.until_over()

    assert launch.shut_down == "ready"
    assert launch.exits == [("mesh_ready", 0), ("mesh", 130)]


def test_a_mesh_that_does_not_start_ends_the_wait_for_it(
    ros: Ros, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    stand_in(monkeypatch)
    from fmu_mesh_ros.actions import Mesh  # noqa: PLC0415 it imports the stand-in

    mesh = Mesh(config=str(config(tmp_path)), arguments=["--set", "pendulum.nothing=1"], ready_timeout=1e6)

    with Launch(ros, tmp_path, observed(mesh)) as launch:
        launch.until_over()

    assert launch.shut_down is None
    assert launch.exits[0] == ("mesh", 2)
    # 130, or whatever Python says where the signal came while it was starting.
    name, code = launch.exits[1]
    assert name == "mesh_ready"
    assert code != 0


def test_the_launch_file_of_a_mesh_ends_with_it(ros: Ros, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    description = described(SOURCE / "launch/mesh.launch.py", monkeypatch)

    with Launch(ros, tmp_path, description, config=str(config(tmp_path))) as launch:
        launch.until_over()

    assert launch.shut_down == "the mesh has ended"
    assert ("mesh", 0) in launch.exits


def test_the_launch_file_with_a_gateway_shows_ros_the_mesh(
    ros: Ros, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from std_msgs.msg import Float64  # noqa: PLC0415 only where ROS is installed

    description = described(SOURCE / "launch/mesh_and_gateway.launch.py", monkeypatch)
    subscription, angles = ros.collect(ros.peer(), Float64, "/pendulum/a")

    with Launch(ros, tmp_path, description, config=str(config(tmp_path, stop_time=600.0))) as launch:
        ros.matched(subscription)
        ros.until(lambda: angles, "an angle")
        subprocess.run([sys.executable, "-Pm", "fmu_mesh", "stop", "pair"], check=True, timeout=DEADLINE_S)
        launch.until_over()

    assert launch.shut_down == "the mesh has ended"
    assert sorted(launch.exits) == [("fmu_mesh_gateway", 0), ("mesh", 130), ("mesh_ready", 0)]


def test_the_launch_file_of_one_fmu_activates_its_node(
    ros: Ros, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from std_msgs.msg import Float64  # noqa: PLC0415 only where ROS is installed

    description = described(SOURCE / "launch/fmu.launch.py", monkeypatch)
    subscription, angles = ros.collect(ros.peer(), Float64, "/a")

    with Launch(ros, tmp_path, description, fmu_path=str(FMUS / "DampedPendulum.fmu")):
        ros.matched(subscription)
        ros.until(lambda: angles, "the angle")
