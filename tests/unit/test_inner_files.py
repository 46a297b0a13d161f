"""FMUs inside archives: what is read, what is refused, and that nothing is left of it."""

from __future__ import annotations

import hashlib
import stat
import tempfile
import zipfile
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import pytest

from fmu_mesh import files
from fmu_mesh.archives import inner_files
from fmu_mesh.config.mesh import LimitsConfig
from fmu_mesh.errors import ConfigurationError, LoadFailed
from fmu_mesh.instances.fmi.archive.archive import content_of, opened, sha256_of, size_of
from fmu_mesh.instances.fmi.archive.reading import read_description
from fmu_mesh.instances.fmi.archive.sources import extract
from fmu_mesh.instances.fmi.opening import open_instance
from fmu_mesh.instances.fmi.step_options import Terms
from tests.fmus.helpers import FMUS
from tests.fmus.packing import without_binaries
from tests.planning import prepare
from tests.unit.test_archive import HOSTILE

GAIN = FMUS / "Gain.fmu"


def package(path: Path, content: dict[str | zipfile.ZipInfo, bytes] | None = None) -> Path:
    """An archive with these files; by default with one FMU."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in (content if content is not None else {"resources/a.fmu": GAIN.read_bytes()}).items():
            archive.writestr(name, data)
    return path


def test_an_fmu_inside_an_archive_is_the_same_fmu_and_runs(tmp_path: Path) -> None:
    path = package(tmp_path / "system.ssp") / "resources" / "a.fmu"

    description = read_description(path)

    assert description == read_description(GAIN)
    assert content_of(path) == sha256_of(path) == sha256_of(GAIN)
    assert size_of(path) == GAIN.stat().st_size
    with closing(open_instance(path, "a", description, tmp_path / "own", terms=Terms(content=sha256_of(GAIN)))) as gain:
        gain.enter_initialization(0.0, 1.0, {"u": 2.0, "k": 3.0})
        gain.exit_initialization()
        assert gain.get_values(["y"]) == [6.0]
    assert sorted(entry.name for entry in tmp_path.iterdir()) == ["own", "system.ssp"]
    assert list((tmp_path / "own").iterdir()) == []


def test_an_archive_may_lie_in_an_archive(tmp_path: Path) -> None:
    inner = package(tmp_path / "inner.ssp").read_bytes()
    outer = package(tmp_path / "outer.ssp", {"parts/inner.ssp": inner})
    path = outer / "parts/inner.ssp/resources/a.fmu"

    assert read_description(path) == read_description(GAIN)
    assert sha256_of(path) == sha256_of(GAIN)


def test_too_many_archives_in_one_another_are_refused(tmp_path: Path) -> None:
    data, path = GAIN.read_bytes(), Path("a.fmu")
    for _ in range(9):
        data, path = package(tmp_path / "shell.ssp", {str(path.parts[0]): data}).read_bytes(), Path("a.ssp") / path
    (tmp_path / "a.ssp").write_bytes(data)

    with pytest.raises(LoadFailed, match=r"in more than 8 archives inside one another"):
        read_description(tmp_path / path)


@pytest.mark.parametrize(
    ("name", "says"),
    [
        ("resources/b.fmu", r"has no file 'resources/b.fmu'. Did you mean 'resources/a.fmu'\?"),
        ("a.fmu", r"has no file 'a.fmu'. Did you mean 'resources/a.fmu'\?"),
        ("other/x.fmu", r"has no file 'other/x.fmu'."),
        ("resources", "'.*system.ssp/resources' is a folder inside '.*system.ssp'"),
        ("../a.fmu", r"has no file '../a.fmu'"),
        ("text.txt/a.fmu", r"'.*system.ssp/text.txt' is no ZIP archive, so it is no archive with 'a.fmu' inside"),
        ("text.txt", "'.*system.ssp/text.txt' is no ZIP archive, so it is no FMU"),
        ("cut.fmu", "'.*system.ssp/cut.fmu' is no ZIP archive, so it is no FMU"),
        ("broken.fmu", "'.*system.ssp/broken.fmu' is a damaged ZIP archive"),
    ],
)
def test_what_is_no_fmu_inside_an_archive_is_told_with_whole_path(name: str, says: str, tmp_path: Path) -> None:
    data = GAIN.read_bytes()
    content: dict[str | zipfile.ZipInfo, bytes] = {
        "resources/a.fmu": data,
        "text.txt": b"text",
        "cut.fmu": data[:5000],
        "broken.fmu": data[:200] + bytes(2000) + data[2200:],
    }
    path = package(tmp_path / "system.ssp", content)

    with pytest.raises(LoadFailed, match=says):
        extract(path / name, tmp_path / "parent")

    assert list((tmp_path / "parent").glob("*")) == []


def test_a_path_into_what_is_no_archive_is_told(tmp_path: Path) -> None:
    (tmp_path / "mesh.yaml").write_text("mesh: a", encoding="utf-8")

    with pytest.raises(LoadFailed, match=r"mesh.yaml' is no ZIP archive, so it is no archive with 'a.fmu' inside"):
        read_description(tmp_path / "mesh.yaml" / "a.fmu")
    with pytest.raises(LoadFailed, match=r"none.ssp/a.fmu' does not exist"):
        read_description(tmp_path / "none.ssp" / "a.fmu")


@pytest.mark.parametrize("depth", [0, 1], ids=["the outer one", "the inner one"])
@pytest.mark.parametrize(("hostile", "says"), HOSTILE)
def test_a_hostile_entry_is_refused_in_every_archive_on_the_way(
    hostile: zipfile.ZipInfo, says: str, depth: int, tmp_path: Path
) -> None:
    bad = package(tmp_path / "bad.ssp", {"resources/a.fmu": GAIN.read_bytes(), hostile: b"/etc/passwd"})
    name = "bad.ssp"
    if depth:
        bad, name = (
            package(tmp_path / "outer.ssp", {"inner.ssp": bad.read_bytes()}) / "inner.ssp",
            "outer.ssp/inner.ssp",
        )

    with pytest.raises(LoadFailed, match=f"{name}' has ") as caught:
        extract(bad / "resources/a.fmu", tmp_path / "parent")

    assert says in str(caught.value)
    assert list((tmp_path / "parent").glob("*")) == []


def encrypted(data: bytes) -> bytes:
    """The archive with its first entry marked as encrypted."""
    bytes_ = bytearray(data)
    bytes_[6] |= 1
    bytes_[bytes_.index(b"PK\x01\x02") + 8] |= 1
    return bytes(bytes_)


def test_encryption_is_refused_in_every_archive_on_the_way(tmp_path: Path) -> None:
    plain = package(tmp_path / "plain.ssp").read_bytes()
    (tmp_path / "outer.ssp").write_bytes(encrypted(plain))
    inner = package(tmp_path / "package.ssp", {"inner.ssp": encrypted(plain)}) / "inner.ssp"

    for path in (tmp_path / "outer.ssp", inner):
        with pytest.raises(LoadFailed, match=f"{path}' is encrypted: 'resources/a.fmu'"):
            read_description(path / "resources/a.fmu")


@pytest.mark.parametrize(
    ("limits", "says"),
    [
        (LimitsConfig(unpacked_bytes=1000), "system.ssp' has .* bytes when it is unpacked; the limit is 1000"),
        (LimitsConfig(entries=1), r"system.ssp' has 2 entries; the limit is 1"),
        (LimitsConfig(entries=2), r"system.ssp/a.fmu' has \d+ entries; the limit is 2"),
        (LimitsConfig(description_bytes=100), "modelDescription.xml of '.*system.ssp/a.fmu' has .*; the limit is 100"),
    ],
)
def test_limits_hold_for_every_archive_on_the_way(limits: LimitsConfig, says: str, tmp_path: Path) -> None:
    path = package(tmp_path / "system.ssp", {"a.fmu": GAIN.read_bytes(), "b.txt": b""}) / "a.fmu"

    with pytest.raises(LoadFailed, match=says) as caught:
        read_description(path, Terms(limits))

    assert "raise `limits` in the configuration" in str(caught.value)


def test_a_bomb_is_refused_in_every_archive_on_way_without_being_unpacked(tmp_path: Path) -> None:
    zeros = bytes(65 * 2**20)
    bomb = package(tmp_path / "bomb.ssp", {"a.fmu": zeros})
    inner = package(tmp_path / "outer.ssp", {"b.fmu": package(tmp_path / "b.fmu", {"zeros": zeros}).read_bytes()})

    for path, name in ((bomb / "a.fmu", "bomb.ssp"), (inner / "b.fmu", "outer.ssp/b.fmu")):
        with pytest.raises(LoadFailed, match=rf"{name}' is \d+ times as large when it is unpacked"):
            extract(path, tmp_path / "parent")


def test_an_entry_that_holds_more_than_it_announces_is_refused(tmp_path: Path) -> None:
    path = package(tmp_path / "liar.ssp", {"a.fmu": b"0123456789" * 100})
    data = bytearray(path.read_bytes())
    announced = data.rindex(b"PK\x01\x02") + 24
    data[announced : announced + 4] = (10).to_bytes(4, "little")
    path.write_bytes(data)

    with pytest.raises(LoadFailed, match=r"liar.ssp' is a damaged ZIP archive"):
        read_description(path / "a.fmu")


def test_a_checksum_is_that_of_fmu_and_not_of_archive_around_it(tmp_path: Path) -> None:
    path = package(tmp_path / "system.ssp") / "resources/a.fmu"

    assert read_description(path, Terms(sha256=sha256_of(GAIN))).model_name == "Gain"
    with pytest.raises(LoadFailed, match=f"a.fmu' has the SHA-256 {sha256_of(GAIN)}, not 0000"):
        read_description(path, Terms(sha256="0" * 64))
    with pytest.raises(LoadFailed, match=r"is not the FMU that this run was planned with"):
        extract(path, tmp_path / "parent", Terms(content="0" * 64))


def test_the_hash_of_an_inner_fmu_is_calculated_once_unless_archive_changes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    outer = package(tmp_path / "system.ssp")
    path = outer / "resources/a.fmu"
    read_description(path)
    copied: list[Path] = []
    real: Callable[..., object] = inner_files.inner_file

    def counted(path: Path, *rest: object) -> object:
        copied.append(path)
        return real(path, *rest)

    monkeypatch.setattr(inner_files, "inner_file", counted)

    assert content_of(path) == sha256_of(GAIN)
    assert copied == []
    adder = (FMUS / "Adder.fmu").read_bytes()
    package(outer, {"resources/a.fmu": adder})

    assert content_of(path) == hashlib.sha256(adder).hexdigest()
    assert copied == [path]


def test_a_large_fmu_goes_to_the_disk_and_leaves_nothing_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(inner_files, "_IN_MEMORY", 1000)
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "temporary"))
    (tmp_path / "temporary").mkdir()
    path = package(tmp_path / "system.ssp") / "resources/a.fmu"

    with opened(path, Terms()) as fmu:
        links = [str(entry.readlink()) for entry in Path("/proc/self/fd").iterdir() if entry.is_symlink()]
        assert "modelDescription.xml" in fmu.contents().names
        assert [link for link in links if "temporary" in link and not link.endswith("(deleted)")] == []
        assert any("temporary" in link for link in links)
    assert list((tmp_path / "temporary").iterdir()) == []


def test_a_disk_that_is_full_is_told(tmp_path: Path) -> None:
    path = package(tmp_path / "system.ssp", {"a.fmu": bytes(1000)}) / "a.fmu"

    def no_room(*_arguments: object) -> object:
        raise OSError(28, "No space left on device")

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(tempfile, "SpooledTemporaryFile", no_room)
        with pytest.raises(LoadFailed, match=r"No space left on device"):
            read_description(path)


def test_sources_inside_an_archive_are_compiled(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("FMU_MESH_CACHE_DIR", str(tmp_path / "cache"))
    data = without_binaries(tmp_path / "bare.fmu").read_bytes()
    path = package(tmp_path / "system.ssp", {"a.fmu": data}) / "a.fmu"

    folder = extract(path, tmp_path / "parent")

    assert (folder / "binaries/linux64/Gain.so").is_file()


def test_any_file_of_an_fmu_can_be_read_within_limit_of_descriptions(tmp_path: Path) -> None:
    outer = package(tmp_path / "system.ssp", {"a/table.txt": b"1,2", "large.txt": bytes(300)})
    (tmp_path / "folder" / "a").mkdir(parents=True)
    (tmp_path / "folder" / "a" / "table.txt").write_bytes(b"1,2")
    (tmp_path / "folder" / "large.txt").write_bytes(bytes(300))
    (tmp_path / "secret.txt").write_text("secret", encoding="utf-8")

    for path in (outer, tmp_path / "folder"):
        with opened(path, Terms(LimitsConfig(description_bytes=200))) as archive:
            assert archive.read("a/table.txt") == b"1,2"
            with pytest.raises(LoadFailed, match=r"has no file 'b.txt'"):
                archive.read("b.txt")
            with pytest.raises(LoadFailed, match=r"has no file '../secret.txt'"):
                archive.read("../secret.txt")
            with pytest.raises(LoadFailed, match=r"the large.txt of .* has 300 bytes; the limit is 200"):
                archive.read("large.txt")


def test_what_a_path_leads_into_is_known_without_opening_it(tmp_path: Path) -> None:
    outer = package(tmp_path / "system.ssp")

    assert files.archive_on_the_way(outer / "resources/a.fmu") == outer
    assert files.archive_on_the_way(outer) is None
    assert files.archive_on_the_way(tmp_path / "none.ssp" / "a.fmu") is None


def test_a_configuration_names_fmus_inside_an_archive_and_findings_suggest_the_nearest(tmp_path: Path) -> None:
    package(tmp_path / "system.ssp")
    file = tmp_path / "mesh.yaml"
    text = """\
mesh: inside
simulation: {step_size: 0.1, stop_time: 1.0}
instances:
  first: {fmu: system.ssp/resources/a.fmu, sha256: SHA}
  second: {fmu: system.ssp/resources/NAME.fmu}
"""
    file.write_text(text.replace("SHA", str(sha256_of(GAIN))).replace("NAME", "a"), encoding="utf-8")
    assert [*prepare(file).system.instances] == ["first", "second"]

    file.write_text(text.replace("SHA", "a" * 64).replace("NAME", "aa"), encoding="utf-8")
    with pytest.raises(ConfigurationError) as caught:
        prepare(file)

    first, second = caught.value.findings
    assert (first.path, first.line) == ("instances.first.fmu", 4)
    assert "has the SHA-256" in first.found
    assert "Did you mean 'resources/a.fmu'?" in second.found
    assert stat.S_ISREG((tmp_path / "system.ssp").stat().st_mode)
