"""The digest by which processes prove that they agree: what counts, what does not, and how a difference is told."""

from __future__ import annotations

import hashlib
import shutil
from collections.abc import Callable
from io import BufferedReader
from pathlib import Path
from typing import Any

import pytest
import yaml

from fmu_mesh.run.options import PlanOptions
from fmu_mesh.system import digest
from fmu_mesh.system.digest import difference
from fmu_mesh.system.plan import Plan
from tests.fmus.packing import repacked, unpacked
from tests.helpers import FMUS, write_config
from tests.planning import prepare

WORLDS = FMUS.parent / "configs" / "worlds"
TRIANGLES = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"


def change(path: Path, old: str, new: str) -> None:
    text = path.read_text(encoding="utf-8")
    assert old in text
    path.write_text(text.replace(old, new), encoding="utf-8")


def plan_of(folder: Path, *options: str) -> Plan:
    """The plan of ``mesh.yaml`` in a folder."""
    return prepare(folder / "mesh.yaml", PlanOptions(start_values=options))


def write_mesh(folder: Path, instance: dict[str, object]) -> None:
    content = {
        "mesh": "one",
        "simulation": {"stop_time": 1.0, "step_size": 0.01},
        "instances": {"it": instance, "pid": {"controller": "position_pid"}},
        "record": {"file": None},
    }
    (folder / "mesh.yaml").write_text(yaml.safe_dump(content), encoding="utf-8")


def archive(folder: Path) -> None:
    repacked(folder / "model.fmu")
    write_mesh(folder, {"fmu": "model.fmu"})


def changed_archive(folder: Path) -> None:
    repacked(folder / "model.fmu", add={"resources/table.txt": b"1"})


def unpacked_fmu(folder: Path) -> None:
    (unpacked(folder / "model") / "resources").mkdir()
    (folder / "model" / "resources" / "table.txt").write_text("1")
    write_mesh(folder, {"fmu": "model"})


def mujoco(folder: Path) -> None:
    """A world that includes a model, which attaches another one, which has a mesh."""
    (folder / "assets").mkdir()
    (folder / "assets" / "box.obj").write_text(TRIANGLES)
    part = "<worldbody><body name='part'><geom type='mesh' mesh='box'/></body></worldbody>"
    asset = "<compiler meshdir='assets'/><asset><mesh name='box' file='box.obj'/></asset>"
    (folder / "part.xml").write_text(f"<mujoco>{asset}{part}</mujoco>")
    (folder / "included.xml").write_text("<mujoco><asset><model name='part' file='part.xml'/></asset></mujoco>")
    attach = "<body name='it'><freejoint/><attach model='part' body='part' prefix='p'/></body>"
    world = f"<mujoco><include file='included.xml'/><worldbody>{attach}</worldbody></mujoco>"
    (folder / "world.xml").write_text(world)
    write_mesh(folder, {"mujoco": "world.xml"})


def urdf(folder: Path) -> None:
    (folder / "meshes").mkdir()
    (folder / "meshes" / "box.obj").write_text(TRIANGLES)
    inertial = "<inertial><mass value='1'/><inertia ixx='1' iyy='1' izz='1' ixy='0' ixz='0' iyz='0'/></inertial>"
    mesh = "<collision><geometry><mesh filename='meshes/box.obj'/></geometry></collision>"
    robot = f"<robot name='it'><link name='it'>{inertial}{mesh}</link></robot>"
    (folder / "it.urdf").write_text(robot)
    write_mesh(folder, {"mujoco": "it.urdf"})


def gazebo(folder: Path) -> None:
    shutil.copy(WORLDS / "damped_pendulum.sdf", folder)
    write_mesh(folder, {"gazebo_classic": "damped_pendulum.sdf"})


def edit(name: str) -> Callable[[Path], None]:
    """Change a file of a model in a way that changes nothing of its description."""

    def append(folder: Path) -> None:
        with (folder / name).open("a", encoding="utf-8") as file:
            file.write("\n")

    return append


KINDS = [
    pytest.param(archive, changed_archive, id="an archive"),
    pytest.param(unpacked_fmu, edit("model/resources/table.txt"), id="a folder"),
    pytest.param(mujoco, edit("world.xml"), id="a MuJoCo model"),
    pytest.param(mujoco, edit("included.xml"), id="a file that it includes"),
    pytest.param(mujoco, edit("assets/box.obj"), id="a mesh of a model that it attaches"),
    pytest.param(urdf, edit("meshes/box.obj"), id="a mesh of a URDF"),
    pytest.param(gazebo, edit("damped_pendulum.sdf"), id="an SDF world"),
]


@pytest.mark.parametrize(("write", "alter"), KINDS)
def test_the_files_of_a_model_count_by_content_and_not_by_place(
    tmp_path: Path, write: Callable[[Path], None], alter: Callable[[Path], None]
) -> None:
    if write in (mujoco, urdf):
        pytest.importorskip("mujoco", reason="MuJoCo is not installed")
    here, there = tmp_path / "here", tmp_path / "there"
    for folder in (here, there):
        folder.mkdir()
        write(folder)
    same = plan_of(here).digest

    assert plan_of(there).digest == same
    alter(there)

    assert plan_of(there).digest != same
    assert difference(same, plan_of(there).digest, ["it", "pid"]) == "another model of 'it'"


@pytest.mark.parametrize(
    ("kind", "file"), [("mujoco", "damped_pendulum.xml"), ("gazebo_classic", "damped_pendulum.sdf")]
)
def test_the_path_of_a_world_is_no_part_of_the_configuration(tmp_path: Path, kind: str, file: str) -> None:
    if kind == "mujoco":
        pytest.importorskip("mujoco", reason="MuJoCo is not installed")
    digests = []
    for name in ("here", "elsewhere"):
        (tmp_path / name / name).mkdir(parents=True)
        shutil.copy(WORLDS / file, tmp_path / name / name)
        write_mesh(tmp_path / name, {kind: f"{name}/{file}"})
        digests.append(plan_of(tmp_path / name).digest)

    assert digests[0] == digests[1]


def test_our_version_and_the_configuration_count_and_are_told_apart(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    archive(tmp_path)
    own = plan_of(tmp_path).digest
    configured = plan_of(tmp_path, "it.k=2").digest
    monkeypatch.setattr(digest, "__version__", "0.0.1")
    older = plan_of(tmp_path).digest

    names = ["it", "pid"]
    assert difference(own, configured, names) == "another configuration"
    assert difference(own, older, names).startswith("another version of fmu_mesh than ")
    assert difference(own, "0123456789abcdef", names).startswith("another version of fmu_mesh than ")


def test_a_process_reads_an_fmu_once_for_its_digest(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    hashed = []
    real = hashlib.file_digest

    def file_digest(file: BufferedReader, kind: str) -> Any:  # noqa: ANN401 as hashlib has it
        hashed.append(str(file.name))
        return real(file, kind)

    monkeypatch.setattr(hashlib, "file_digest", file_digest)
    fmu = repacked(tmp_path / "model.fmu")
    gains = {name: {"fmu": str(fmu)} for name in ("first", "second")}
    config = write_config(tmp_path, instances=gains, connections=["first.y -> second.u"])

    assert prepare(config).digest == prepare(config).digest

    assert hashed == [str(fmu)]
