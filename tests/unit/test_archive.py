"""Hostile archives, limits, checksums and folders: what is refused, and that nothing is left of it."""

from __future__ import annotations

import hashlib
import os
import stat
import zipfile
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import pytest

from fmu_mesh.config.mesh import LimitsConfig
from fmu_mesh.errors import LoadFailed
from fmu_mesh.instances.fmi.archive.archive import sha256_of
from fmu_mesh.instances.fmi.archive.reading import read_description
from fmu_mesh.instances.fmi.archive.sources import extract, prepare
from fmu_mesh.instances.fmi.opening import open_instance
from fmu_mesh.instances.fmi.step_options import Terms
from tests.fmus.helpers import FMUS, find_fmu
from tests.fmus.packing import repacked, unpacked

GAIN = FMUS / "Gain.fmu"


def entry(name: str, mode: int = stat.S_IFREG | 0o644) -> zipfile.ZipInfo:
    info = zipfile.ZipInfo("placeholder")
    info.filename = name  # the constructor would tidy the name up
    info.external_attr = mode << 16
    info.create_system = 3
    return info


def encrypted(path: Path) -> None:
    """Mark the first entry as encrypted, in its local header and in the directory."""
    repacked(path)
    data = bytearray(path.read_bytes())
    data[6] |= 1
    data[data.index(b"PK\x01\x02") + 8] |= 1
    path.write_bytes(data)


def damaged(path: Path) -> None:
    repacked(path)
    data = bytearray(path.read_bytes())
    data[200:220] = bytes(20)
    path.write_bytes(data)


def cut_off(path: Path) -> None:
    path.write_bytes(GAIN.read_bytes()[:5000])


HOSTILE: list[object] = [
    pytest.param(entry("../evil"), "outside its own folder: '../evil'", id="a parent folder"),
    pytest.param(entry("resources/../../evil"), "outside its own folder", id="a parent folder on the way"),
    pytest.param(entry("/tmp/fmu_mesh_evil"), "outside its own folder", id="an absolute path"),  # noqa: S108 refused
    pytest.param(entry("C:/evil"), "outside its own folder", id="a drive"),
    pytest.param(entry("./../evil"), "outside its own folder", id="a parent folder of the folder itself"),
    pytest.param(entry("."), "outside its own folder: '.'", id="a file in the place of the folder itself"),
    pytest.param(entry("resources\\..\\..\\evil"), "outside its own folder", id="a parent folder of Windows"),
    pytest.param(entry("C:\\evil"), "outside its own folder", id="a drive of Windows"),
    pytest.param(entry("\\\\host\\evil"), "outside its own folder", id="a host of Windows"),
    pytest.param(entry("resources/link", stat.S_IFLNK | 0o777), "a symbolic link inside", id="a link"),
    pytest.param(entry("resources/fifo", stat.S_IFIFO | 0o644), "neither a file nor a folder", id="a fifo"),
    pytest.param(entry("resources/disk", stat.S_IFBLK | 0o644), "neither a file nor a folder", id="a device"),
]


@pytest.mark.parametrize(("hostile", "says"), HOSTILE)
def test_an_entry_that_would_leave_folder_is_refused_before_anything_is_written(
    hostile: zipfile.ZipInfo, says: str, tmp_path: Path
) -> None:
    path = repacked(tmp_path / "hostile.fmu", add={hostile: b"/etc/passwd"})
    parent = tmp_path / "deep" / "parent"

    for refused in (lambda: read_description(path), lambda: extract(path, parent)):
        with pytest.raises(LoadFailed, match=r"hostile\.fmu") as caught:
            refused()
        assert says in str(caught.value)
    assert list(parent.glob("*")) == []
    assert not (tmp_path / "evil").exists()
    assert not Path("/tmp/fmu_mesh_evil").exists()  # noqa: S108 that it is not written is the point


@pytest.mark.parametrize("before", ["", "./"], ids=["for the folder itself", "before every name, too"])
@pytest.mark.parametrize("fmu", ["Gain", "AllTypes3"])
def test_fmu_whose_tool_wrote_dot_as_folder_is_same_fmu_and_runs(fmu: str, before: str, tmp_path: Path) -> None:
    """`zip -r model.fmu .` and the tool of Vico write such entries."""
    plain = find_fmu(fmu, tmp_path / "built")
    path = tmp_path / "dotted.fmu"
    with zipfile.ZipFile(plain) as old, zipfile.ZipFile(path, "w") as new:
        for name in ("./", "resources/", "./resources/"):
            new.writestr(entry(name, stat.S_IFDIR | 0o755), b"")
        for name in old.namelist():
            new.writestr(entry(f"{before}{name}"), old.read(name))

    description = read_description(path)

    assert description == read_description(plain)
    with closing(open_instance(path, "dotted", description, tmp_path)) as instance:
        instance.enter_initialization(0.0, 1.0, {})
        instance.exit_initialization()


def test_an_fmu_with_backslashes_of_windows_is_the_same_fmu_and_runs(tmp_path: Path) -> None:
    path = tmp_path / "windows.fmu"
    with zipfile.ZipFile(GAIN) as old, zipfile.ZipFile(path, "w") as new:
        new.writestr(entry("binaries\\"), b"")
        for name in old.namelist():
            new.writestr(entry(name.replace("/", "\\")), old.read(name))

    description = read_description(path)

    assert description == read_description(GAIN)
    with closing(open_instance(path, "windows", description, tmp_path)) as instance:
        instance.enter_initialization(0.0, 1.0, {})
        instance.exit_initialization()


@pytest.mark.filterwarnings("ignore:Duplicate name")
@pytest.mark.parametrize("name", ["__MACOSX/._Gain.so", "documentation/index.html", "Documentation/a/b.png"])
def test_two_files_of_one_name_that_nobody_reads_are_left_out(name: str, tmp_path: Path) -> None:
    path = repacked(tmp_path / "twice.fmu", add={entry(name): b"one", entry(name.replace("/", "\\")): b"other"})

    description, folder = read_description(path), extract(path, tmp_path / "parent")

    assert description == read_description(GAIN)
    assert not (folder / name).exists()
    assert (folder / "binaries/linux64/Gain.so").is_file()


@pytest.mark.filterwarnings("ignore:Duplicate name")
def test_two_entries_with_one_name_are_refused(tmp_path: Path) -> None:
    path = repacked(tmp_path / "twice.fmu", add={entry("modelDescription.xml"): b"<another/>"})

    with pytest.raises(LoadFailed, match=r"two entries with one name: 'modelDescription\.xml'"):
        read_description(path)


@pytest.mark.parametrize("name", ["./sources/Gain.c", "sources\\Gain.c", ".\\sources\\Gain.c"])
def test_two_spellings_of_one_name_are_refused_as_well(name: str, tmp_path: Path) -> None:
    path = repacked(tmp_path / "twice.fmu", add={entry(name): b"another"})

    with pytest.raises(LoadFailed, match=r"two entries with one name: 'sources/Gain\.c'"):
        read_description(path)


@pytest.mark.parametrize(
    ("make", "says"), [(encrypted, "is encrypted"), (damaged, "is a damaged ZIP archive"), (cut_off, "no ZIP archive")]
)
def test_an_archive_that_cannot_be_unpacked_is_told_with_the_reason(
    make: Callable[[Path], None], says: str, tmp_path: Path
) -> None:
    make(tmp_path / "broken.fmu")

    with pytest.raises(LoadFailed, match=says):
        extract(tmp_path / "broken.fmu", tmp_path / "parent")

    assert list((tmp_path / "parent").glob("*")) == []


def test_a_file_in_place_of_folder_is_told_and_nothing_is_left(tmp_path: Path) -> None:
    path = repacked(tmp_path / "odd.fmu", add={entry("resources"): b"a file", entry("resources/table.txt"): b"1"})

    with pytest.raises(LoadFailed, match=r"odd\.fmu"):
        extract(path, tmp_path / "parent")

    assert list((tmp_path / "parent").glob("*")) == []


@pytest.mark.parametrize(
    ("limits", "says"),
    [
        (LimitsConfig(unpacked_bytes=1000), "bytes when it is unpacked; the limit is 1000"),
        (LimitsConfig(entries=3), "entries; the limit is 3"),
        (LimitsConfig(description_bytes=100), "modelDescription.xml .* has .* bytes; the limit is 100"),
    ],
)
def test_a_limit_that_is_broken_is_told_with_the_way_out(limits: LimitsConfig, says: str) -> None:
    with pytest.raises(LoadFailed, match=says) as caught:
        read_description(GAIN, Terms(limits))

    assert "raise `limits` in the configuration" in str(caught.value)


def test_an_archive_bomb_is_refused_by_its_ratio_without_being_unpacked(tmp_path: Path) -> None:
    path = repacked(tmp_path / "bomb.fmu", add={"resources/zeros": bytes(65 * 2**20)})
    assert path.stat().st_size < 200_000

    with pytest.raises(LoadFailed, match=r"is \d+ times as large when it is unpacked; the limit is 200"):
        extract(path, tmp_path / "parent")

    assert list((tmp_path / "parent").glob("*")) == []
    read_description(path, Terms(LimitsConfig(ratio=2000)))  # a person may trust it


def test_an_entry_that_holds_more_than_it_announces_is_refused(tmp_path: Path) -> None:
    path = repacked(tmp_path / "liar.fmu", add={"resources/table": b"0123456789" * 100})
    data = bytearray(path.read_bytes())
    announced = data.rindex(b"PK\x01\x02") + 24
    assert int.from_bytes(data[announced : announced + 4], "little") == 1000
    data[announced : announced + 4] = (10).to_bytes(4, "little")
    path.write_bytes(data)

    with pytest.raises(LoadFailed, match="damaged"):
        extract(path, tmp_path / "parent")

    assert list((tmp_path / "parent").glob("*")) == []


def test_an_fmu_is_unpacked_into_private_folder_and_keeps_what_is_executable(tmp_path: Path) -> None:
    helper = entry("resources/helper", stat.S_IFREG | 0o755)
    path = repacked(tmp_path / "some.name.fmu", add={helper: b"#!/bin/sh\n", "resources/table": b"1"})

    folder = extract(path, tmp_path / "parent")

    assert folder.parent == tmp_path / "parent"
    assert folder.name.startswith("some.name-")
    assert [stat.S_IMODE(one.stat().st_mode) for one in (folder, folder / "resources/helper")] == [0o700, 0o700]
    assert stat.S_IMODE((folder / "resources/table").stat().st_mode) == 0o600
    assert list(folder.parent.iterdir()) == [folder]  # nothing half done beside it


def test_checksum_is_verified_when_fmu_is_read_and_when_it_is_unpacked(tmp_path: Path) -> None:
    right = hashlib.sha256(GAIN.read_bytes()).hexdigest()
    wrong = Terms(sha256="0" * 64)

    assert sha256_of(GAIN) == right
    assert read_description(GAIN, Terms(sha256=right.upper())).model_name == "Gain"
    for refused in (lambda: read_description(GAIN, wrong), lambda: extract(GAIN, tmp_path / "parent", wrong)):
        with pytest.raises(LoadFailed, match=f"has the SHA-256 {right}, not 0000"):
            refused()
    assert list((tmp_path / "parent").glob("*")) == []


def test_a_prepared_fmu_is_opened_once_and_each_instance_has_its_files(tmp_path: Path) -> None:
    path = tmp_path / "Gain.fmu"
    path.write_bytes(GAIN.read_bytes())
    model, terms = read_description(path), Terms(content=sha256_of(path))
    prepare(path, tmp_path / "server", terms, model)
    path.unlink()

    first, second = (extract(path, tmp_path / "nodes", terms, model=model) for _ in range(2))
    (first / "modelDescription.xml").write_text("changed", encoding="utf-8")

    assert first != second
    assert (second / "modelDescription.xml").read_bytes() == (
        unpacked(tmp_path / "plain") / "modelDescription.xml"
    ).read_bytes()
    with pytest.raises(LoadFailed, match="does not exist"):
        extract(path, tmp_path / "nodes", Terms(content="0" * 64), model=model)


def test_an_unpacked_folder_is_used_without_writing_into_it(tmp_path: Path) -> None:
    source = unpacked(tmp_path / "gain")
    (source / "resources").mkdir()
    (source / "resources" / "table").write_text("1")
    for parent, folders, files in os.walk(source, topdown=False):
        for name in [*folders, *files, "."]:
            Path(parent, name).chmod(0o500)
    before = {path: path.stat().st_mtime_ns for path in source.rglob("*")}

    description = read_description(source)
    folder = extract(source, tmp_path / "parent")

    assert description == read_description(GAIN)
    assert (folder / "resources" / "table").read_text() == "1"
    assert (folder / "binaries/linux64/Gain.so").read_bytes() == (source / "binaries/linux64/Gain.so").read_bytes()
    assert not (folder / "binaries/linux64/Gain.so").samefile(source / "binaries/linux64/Gain.so")
    assert {path: path.stat().st_mtime_ns for path in source.rglob("*")} == before


def test_a_checksum_of_a_folder_is_refused(tmp_path: Path) -> None:
    source = unpacked(tmp_path / "gain")

    with pytest.raises(LoadFailed, match="is a folder, and `sha256` is that of an archive"):
        read_description(source, Terms(sha256="0" * 64))


def test_a_folder_that_is_no_fmu_is_told(tmp_path: Path) -> None:
    with pytest.raises(LoadFailed, match=r"is a folder, but has no modelDescription.xml"):
        read_description(tmp_path)
