"""Where the files of FMUs are: shared, private where an FMU may write, and elsewhere where there is no room."""

from __future__ import annotations

import os
import shutil
import tempfile
from pathlib import Path

import pytest

from fmu_mesh.files import remove_tree
from fmu_mesh.instances.fmi.archive.library_names import rename_libraries
from fmu_mesh.instances.fmi.archive.reading import read_description
from fmu_mesh.instances.fmi.archive.sources import extract, prepare
from fmu_mesh.instances.fmi.step_options import Terms
from tests.fmus.packing import repacked, unpacked
from tests.helpers import Launched, Place, write_config

LARGE = os.urandom(6_000_000)
NEEDS_MOUNTS = pytest.mark.skipif(os.geteuid() != 0 or shutil.which("unshare") is None, reason="needs root and unshare")
MOUNT = 'mkdir -p "$FMU_MESH_RUNTIME_DIR" && mount -t tmpfs -o "mode=700,$1" tmpfs "$FMU_MESH_RUNTIME_DIR" '
MOUNT += '&& mount -t tmpfs -o "mode=700,$2" tmpfs "$TMPDIR" && shift 2 && "$@" '
MOUNT += '&& ls -A "$FMU_MESH_RUNTIME_DIR" "$TMPDIR"'
ROOMY = "size=100m"
ELSEWHERE = "/dev/shm"  # noqa: S108 another file system; each test has a private folder there


def launched(place: Place, name: str, runtime: str, temporary: str, *options: str) -> Launched:
    """Launch four instances of an FMU with the large file ``name``, with these options for the two file systems."""
    fmu = repacked(place.folder / "large.fmu", add={name: LARGE})
    instances = {f"gain{number}": {"fmu": str(fmu)} for number in range(4)}
    config = write_config(place.folder, instances=instances, connections=[], stop_time=0.01)
    prefix = ("unshare", "--mount", "sh", "-c", MOUNT, "sh", runtime, temporary)
    run = place.start("launch", config, "--no-progress", *options, prefix=prefix)
    run.wait()
    return run


@NEEDS_MOUNTS
@pytest.mark.parametrize(
    ("name", "runtime", "temporary", "options"),
    [
        ("binaries/any/large.bin", "size=16m", "size=1m", ()),
        ("resources/large.bin", "size=16m", ROOMY, ()),
        ("binaries/any/large.bin", "size=4m", ROOMY, ()),
        ("binaries/any/large.bin", "size=100m,noexec", ROOMY, ()),
        ("binaries/any/large.bin", "size=16m", ROOMY, ("--local",)),
    ],
    ids=["shared", "full", "small", "noexec", "local"],
)
def test_four_instances_of_a_large_fmu_find_room(
    place: Place, name: str, runtime: str, temporary: str, options: tuple[str, ...]
) -> None:
    run = launched(place, name, runtime, temporary, *options)

    assert run.wait() == 0, run.story()
    left = run.output.partition("points/s")[2].splitlines()[1:]
    assert [line for line in left if line and not line.endswith(":")] == []


@NEEDS_MOUNTS
@pytest.mark.parametrize(
    ("runtime", "reason"),
    [
        ("size=4m", "too little room (6."),
        ("size=100m,noexec", "no code may run from there (the file system is mounted noexec)"),
    ],
    ids=["full", "noexec"],
)
def test_an_fmu_without_a_place_names_folder_reason_and_the_way_out(place: Place, runtime: str, reason: str) -> None:
    run = launched(place, "binaries/any/large.bin", runtime, "size=3m")

    assert run.wait() == 3, run.story()
    message = run.errors.splitlines()[-1]  # other nodes may have found the same
    assert f"large.fmu' cannot be extracted into '{place.folder / 'run' / 'pair'}." in message
    assert f"': {reason}" in message
    assert f"or into '{place.folder / 'tmp'}': too little room (6." in message
    assert "Set FMU_MESH_RUNTIME_DIR, or TMPDIR, to a folder with room from which code may run." in message
    place.assert_nothing_left()


def test_path_that_is_too_long_for_socket_is_found_before_anything_starts(place: Place) -> None:
    config = write_config(place.folder)
    place.environment |= {"FMU_MESH_RUNTIME_DIR": str(place.folder / ("x" * 80))}

    run = place.run("launch", config, "--no-progress")

    assert run.wait() == 2
    assert run.errors.count("fmu-mesh: ") == 1
    assert "is too long for a socket (107 bytes). Set FMU_MESH_RUNTIME_DIR to a shorter path." in run.message
    assert not config.with_suffix(".csv").exists()
    assert [*(place.folder / ("x" * 80)).iterdir()] == []


@pytest.fixture
def prepared(tmp_path: Path) -> Path:
    """An FMU that the process of a fork server has extracted, with something in its resources."""
    fmu = repacked(tmp_path / "gain.fmu", add={"resources/state.txt": b"as it was"})
    (parent := tmp_path / "server").mkdir()
    prepare(fmu, parent, Terms(), read_description(fmu))
    return fmu


def extracted(fmu: Path, parent: Path) -> tuple[Path, Path]:
    """The library and the resource of a new instance."""
    folder = extract(fmu, parent, Terms(), model=read_description(fmu))
    [library] = folder.glob("binaries/linux64/*.so")
    return library, folder / "resources" / "state.txt"


def test_the_first_instance_of_a_process_shares_the_library_and_no_resource(prepared: Path, tmp_path: Path) -> None:
    [original] = (tmp_path / "server").glob("*/binaries/linux64/*.so")

    first, second = (extracted(prepared, tmp_path / "node") for _ in range(2))
    first[1].write_text("changed")

    assert first[0].samefile(original)
    assert not second[0].samefile(original)  # it has variables of its own in the same process
    assert second[0].read_bytes() == original.read_bytes()
    assert second[1].read_text() == "as it was"
    assert (original.parents[2] / "resources" / "state.txt").read_text() == "as it was"


@pytest.mark.skipif(not os.access(ELSEWHERE, os.W_OK), reason="needs a second file system")
def test_room_for_a_copy_on_another_file_system_is_looked_for(
    prepared: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    [library] = (tmp_path / "server").glob("*/binaries/linux64/*.so")
    asked: list[int] = []
    monkeypatch.setattr("fmu_mesh.instances.fmi.archive.archive._refuse_unfit", lambda _place, size: asked.append(size))

    with tempfile.TemporaryDirectory(dir=ELSEWHERE) as elsewhere:
        extracted(prepared, Path(elsewhere))
    monkeypatch.setattr("fmu_mesh.instances.fmi.archive.sources._linked", set())
    extracted(prepared, tmp_path / "node")

    assert asked[0] > library.stat().st_size > asked[1] > 0  # linked: only the resources are written


def test_a_shared_library_that_is_renamed_stays_as_it_was_for_others(
    prepared: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    [original] = (tmp_path / "server").glob("*/binaries/linux64/*.so")
    before = original.read_bytes()
    monkeypatch.setattr("fmu_mesh.instances.fmi.archive.library_names._is_loaded", lambda name: name == "Gain.so")

    own, _ = extracted(prepared, tmp_path / "node")
    rename_libraries(own.parents[2])

    assert not own.samefile(original)
    assert original.read_bytes() == before


def test_an_fmu_that_is_a_folder_keeps_its_resources(tmp_path: Path) -> None:
    fmu = unpacked(tmp_path / "gain", source=repacked(tmp_path / "a.fmu", add={"resources/state.txt": b"as it was"}))

    first, second = (extracted(fmu, tmp_path / "node") for _ in range(2))
    first[1].write_text("changed")

    assert (second[1].read_text(), (fmu / "resources" / "state.txt").read_text()) == ("as it was", "as it was")


def test_a_folder_elsewhere_is_removed_and_no_folder_of_the_user(tmp_path: Path) -> None:
    (parent := tmp_path / "run").mkdir()
    for name, link in (("gain-1", "gain-1.elsewhere"), ("own.elsewhere", "own.elsewhere")):
        (tmp_path / name).mkdir()
        (parent / link).symlink_to(tmp_path / name)

    remove_tree(parent)

    assert [path.name for path in tmp_path.iterdir()] == ["own.elsewhere"]
