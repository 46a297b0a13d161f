"""FMUs that bring sources instead of a binary: compiled once, into the cache, or told why not."""

from __future__ import annotations

import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest
import yaml

from fmu_mesh.cli.main import main
from fmu_mesh.errors import LoadFailed
from fmu_mesh.fmu import read_description
from fmu_mesh.fmu.sources import extract
from tests.fmus.helpers import FMUS, NO_COMPILER
from tests.fmus.packing import repacked, unpacked, without_binaries

pytestmark = pytest.mark.skipif(NO_COMPILER is not None, reason=str(NO_COMPILER))


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A cache of the test's own."""
    monkeypatch.setenv("FMU_MESH_CACHE_DIR", str(tmp_path / "cache"))
    return tmp_path / "cache"


def libraries(cache: Path) -> list[Path]:
    return sorted(cache.rglob("*.so"))


def config_with(fmu: Path) -> Path:
    file = fmu.parent / "mesh.yaml"
    content = {
        "mesh": "one",
        "simulation": {"stop_time": 1, "step_size": 0.1},
        "instances": {"gain": {"fmu": fmu.name, "start_values": {"u": 3.0, "k": 0.1}}},
        "record": {"file": "one.csv"},
    }
    file.write_text(yaml.safe_dump(content), encoding="utf-8")
    return file


def test_a_source_fmu_is_compiled_once_told_and_gives_the_same_result(
    tmp_path: Path, cache: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    kept = tmp_path / "kept.fmu"
    shutil.copy(FMUS / "Gain.fmu", kept)
    assert main(["launch", "--local", str(config_with(kept))]) == 0
    expected = (tmp_path / "one.csv").read_bytes()
    config = config_with(without_binaries(tmp_path / "sources.fmu"))
    capsys.readouterr()

    assert main(["launch", "--local", str(config)]) == 0

    assert "sources.fmu' has no binary for this platform (linux64): compiling its sources" in capsys.readouterr().err
    assert (tmp_path / "one.csv").read_bytes() == expected
    (library,) = libraries(cache)
    assert library.name == "Gain.so"
    made = library.stat().st_mtime_ns
    assert main(["launch", "--local", str(config)]) == 0
    assert "compiling" not in capsys.readouterr().err
    assert [one.stat().st_mtime_ns for one in libraries(cache)] == [made]
    assert [one.name for one in library.parent.iterdir()] == ["Gain.so"]


def test_other_sources_are_compiled_anew(tmp_path: Path, cache: Path) -> None:
    extract(without_binaries(tmp_path / "first.fmu"), tmp_path)
    changed = repacked(
        tmp_path / "second.fmu", source=tmp_path / "first.fmu", add={"sources/extra.h": b"/* another file */"}
    )

    extract(changed, tmp_path)

    assert len(libraries(cache)) == 2


def test_an_unpacked_source_fmu_is_compiled_into_the_cache_and_not_into_its_folder(tmp_path: Path, cache: Path) -> None:
    source = unpacked(tmp_path / "gain", source=without_binaries(tmp_path / "sources.fmu"))
    before = sorted(source.rglob("*"))

    folder = extract(source, tmp_path / "parent")

    assert (folder / "binaries/linux64/Gain.so").is_file()
    assert sorted(source.rglob("*")) == before
    assert len(libraries(cache)) == 1


def test_an_unpacked_folder_runs_and_stays_as_it_is(tmp_path: Path) -> None:
    source = unpacked(tmp_path / "gain")
    before = {path: path.stat().st_mtime_ns for path in source.rglob("*")}

    assert main(["launch", "--local", str(config_with(source))]) == 0

    assert (tmp_path / "one.csv").read_text().splitlines()[-1] == "1.0,0.30000000000000004"
    assert {path: path.stat().st_mtime_ns for path in source.rglob("*")} == before


def test_functions_with_a_prefix_get_their_plain_names_in_the_library(tmp_path: Path) -> None:
    """Sources may define FMI2_FUNCTION_PREFIX, for linking them statically (FMI 2.0, 2.1.1)."""
    sources = without_binaries(tmp_path / "sources.fmu")
    with zipfile.ZipFile(sources) as archive:
        text = archive.read("sources/instance.h").decode()
    prefixed = repacked(
        tmp_path / "prefixed.fmu",
        source=sources,
        keep=lambda name: name != "sources/instance.h",
        add={"sources/instance.h": text.replace("#define INSTANCE_H", "#define FMI2_FUNCTION_PREFIX Gain_").encode()},
    )

    folder = extract(prefixed, tmp_path / "parent")

    library = (folder / "binaries/linux64/Gain.so").read_bytes()
    assert b"\0fmi2DoStep\0" in library
    assert b"Gain_fmi2DoStep" not in library


def test_without_a_list_all_sources_at_the_root_are_compiled(tmp_path: Path) -> None:
    def without_list(text: str) -> str:
        start, end = text.index("<SourceFiles>"), text.index("</SourceFiles>") + len("</SourceFiles>")
        return text[:start] + text[end:]

    sources = without_binaries(tmp_path / "sources.fmu")
    path = repacked(tmp_path / "unlisted.fmu", source=sources, description=without_list)

    assert (extract(path, tmp_path / "parent") / "binaries/linux64/Gain.so").is_file()


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (('<File name="Gain.c"/>', '<File name="Missing.c"/>'), "lists the source 'Missing.c', but does not contain"),
        (('<File name="Gain.c"/>', '<File name="../../x.c"/>'), "lists a source outside its own folder: '../../x.c'"),
        (('<File name="Gain.c"/>', ""), "do not compile: .*model"),
    ],
    ids=["a missing file", "a file outside", "an undefined symbol"],
)
def test_sources_that_do_not_compile_are_told_with_the_reason_and_leave_nothing(
    change: tuple[str, str], says: str, tmp_path: Path, cache: Path
) -> None:
    sources = without_binaries(tmp_path / "sources.fmu")
    path = repacked(tmp_path / "bad.fmu", source=sources, description=lambda text: text.replace(*change))

    with pytest.raises(LoadFailed, match=says):
        extract(path, tmp_path / "parent")

    assert list((tmp_path / "parent").iterdir()) == []
    assert libraries(cache) == []


def test_without_a_compiler_check_refuses_with_the_ways_out(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("CC", "no-such-compiler")
    config = config_with(without_binaries(tmp_path / "sources.fmu"))

    assert main(["check", str(config)]) == 2

    said = capsys.readouterr().err
    assert "mesh.yaml:" in said
    assert "instances.gain.fmu" in said
    assert "no binary for this platform (linux64) but sources, and there is no compiler" in said
    assert "no-such-compiler" in said
    assert "$CC" in said


def test_two_processes_at_once_compile_without_harm(tmp_path: Path, cache: Path) -> None:
    path = without_binaries(tmp_path / "sources.fmu")
    program = "import sys, pathlib as p; from fmu_mesh.fmu.sources import extract; extract(*map(p.Path, sys.argv[1:]))"
    command = [sys.executable, "-c", program, str(path), str(tmp_path / "parent")]

    processes = [subprocess.Popen(command) for _ in range(2)]

    assert [process.wait(50) for process in processes] == [0, 0]
    (library,) = libraries(cache)
    copies = sorted(tmp_path.glob("parent/*/binaries/linux64/Gain.so"))
    assert [copy.read_bytes() for copy in copies] == [library.read_bytes()] * 2


def test_an_fmu_for_another_platform_without_sources_is_refused(tmp_path: Path) -> None:
    path = repacked(
        tmp_path / "elsewhere.fmu",
        keep=lambda name: name == "modelDescription.xml",
        add={"binaries/win64/Gain.dll": b"", "binaries/aarch64-darwin/Gain.dylib": b""},
    )

    with pytest.raises(LoadFailed, match=r"no binary for this platform \(linux64\); it has: aarch64-darwin, win64"):
        read_description(path)
