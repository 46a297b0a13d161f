"""The library of C: that it is the one of its sources, how it is found, and what a mesh is told where there is none."""

from __future__ import annotations

import ctypes
import json
import os
import re
import shutil
import subprocess
import sys
import tarfile
import zipfile
from enum import IntEnum
from pathlib import Path

import pytest
from hatchling.builders.sdist import SdistBuilder
from hatchling.builders.wheel import WheelBuilder

import build_library
from fmu_mesh.errors import ConfigurationError
from fmu_mesh.instances.fmi.model_exchange.dormand_prince import Solved
from fmu_mesh.instances.fmi.wine import wine_program
from fmu_mesh.instances.fmi.wine_library import Request
from fmu_mesh.rings import native
from fmu_mesh.rings.library import LIBRARY_VARIABLE, TRIED_ON, library_missed, load_library, why_no_library
from tests.helpers import write_config

LIBRARY = build_library.library_path("linux-x86_64")
NAME = "fmu_mesh/rings/burst-linux-x86_64.so"
COST = (
    "Steps are slower. Results are the same, except with `solver: {name: auto}`. "
    "See 'The library of C' in docs/installation.md."
)
ASK = "from fmu_mesh.rings.library import *; print(load_library(), why_no_library(), sep='\\n')"


@pytest.fixture(autouse=True)
def as_users_have_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv(LIBRARY_VARIABLE, raising=False)


@pytest.fixture
def clone(tmp_path: Path) -> Path:
    """A copy of the package and of what builds a wheel of it."""
    root = build_library.ROOT
    shutil.copytree(root / "fmu_mesh", tmp_path / "fmu_mesh", ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("LICENSE", "README.md", "build_library.py", "pyproject.toml"):
        shutil.copy(root / name, tmp_path)
    return tmp_path


def ask_in(clone: Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, "-c", ASK], cwd=clone, capture_output=True, text=True, check=False)


def built_by_the_pinned_compiler() -> bool:
    try:
        build_library.require_compiler()
    except build_library.BuildError:
        return False
    return True


needs_the_compiler = pytest.mark.skipif(not built_by_the_pinned_compiler(), reason="`make library` installs ziglang")


@pytest.mark.parametrize("platform", build_library.TARGETS)
def test_the_library_in_the_tree_was_built_from_the_sources_in_tree(platform: str) -> None:
    assert build_library.manifest(platform).encode() in build_library.library_path(platform).read_bytes(), (
        "make library"
    )


@needs_the_compiler
@pytest.mark.parametrize(
    "platform",
    [
        *(platform for platform in build_library.TARGETS if platform.startswith("linux")),
        pytest.param(
            "windows-x86_64",
            marks=pytest.mark.skipif(wine_program() is None, reason="minutes: .ci/long wine runs it"),
        ),
    ],
)
def test_whoever_builds_the_library_gets_the_bytes_in_the_tree(platform: str) -> None:
    assert build_library.build(platform) == build_library.library_path(platform).read_bytes(), "make library"


@needs_the_compiler
def test_a_library_is_built_from_several_files_and_knows_the_headers_too(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "one.c").write_text('#include "two/two.h"\nVISIBLE int one(void) { return two() - 1; }\n')
    (tmp_path / "two").mkdir()
    (tmp_path / "two" / "two.c").write_text('#include "two.h"\nint two(void) { return 2; }\n')
    (tmp_path / "two" / "two.h").write_text('#define VISIBLE __attribute__((visibility("default")))\nint two(void);\n')
    monkeypatch.setattr(build_library, "PACKAGE", tmp_path)
    monkeypatch.setattr(build_library, "SOURCES", ("one.c", "two/two.c", "two/two.h"))

    path = tmp_path / "library.so"
    path.write_bytes(build_library.build("linux-x86_64"))

    assert ctypes.CDLL(str(path)).one() == 1
    assert not hasattr(ctypes.CDLL(str(path)), "two")
    assert re.findall(rb"[0-9a-f]{64}  (\S+)\n", path.read_bytes()) == [b"one.c", b"two/two.c", b"two/two.h"]


@needs_the_compiler
def test_a_source_that_the_compiler_refuses_is_told_with_its_message(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "wrong.c").write_text("int wrong(void) { return unknown; }\n")
    monkeypatch.setattr(build_library, "PACKAGE", tmp_path)
    monkeypatch.setattr(build_library, "SOURCES", ("wrong.c",))

    with pytest.raises(build_library.BuildError, match=r"wrong\.c:1:\d+: error: .*unknown"):
        build_library.build("linux-x86_64")


def test_each_access_of_an_atomic_names_its_memory_order() -> None:
    sources = {name: (build_library.PACKAGE / name).read_text() for name in build_library.SOURCES}
    without = [
        found for text in sources.values() for found in re.findall(r"\batomic_\w+(?<!_explicit)(?<!_fence)\(", text)
    ]

    assert without == []
    assert "-Watomic-implicit-seq-cst" in build_library.FLAGS


def test_another_version_of_the_compiler_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("importlib.metadata.version", lambda _: "0.1.0")

    with pytest.raises(build_library.BuildError, match=r"by ziglang [\d.]+; installed: 0\.1\.0"):
        build_library.build("linux-x86_64")


@pytest.mark.parametrize(("platform", "machine"), [("linux-x86_64", 62), ("linux-aarch64", 183)])
def test_the_library_needs_nothing_but_a_c_library_of_2014_or_later(platform: str, machine: int) -> None:
    content = build_library.library_path(platform).read_bytes()
    versions = {tuple(map(int, version.split(b"."))) for version in re.findall(rb"GLIBC_([\d.]+)\0", content)}

    assert int.from_bytes(content[18:20], "little") == machine  # of ELF
    assert max(versions) <= (2, 17)
    assert set(re.findall(rb"\0([\w.-]+\.so[\w.]*)\0", content)) <= {b"libc.so.6", b"libm.so.6", b"libpthread.so.0"}


def test_the_library_beside_its_module_is_the_one_that_is_loaded() -> None:
    assert TRIED_ON == ("linux-x86_64",)
    assert load_library() == str(LIBRARY)
    assert why_no_library() is None


def test_a_variable_of_the_environment_switches_the_library_off(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(LIBRARY_VARIABLE, "none")

    assert load_library() is None
    assert why_no_library() == f"not used: the environment variable FMU_MESH_LIBRARY is none. {COST}"
    assert not library_missed()


def test_on_platform_never_tried_library_is_used_only_if_it_is_named(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    named = tmp_path / "named.so"
    shutil.copy(LIBRARY, named)
    monkeypatch.setattr("platform.machine", lambda: "aarch64")

    assert load_library() is None
    assert why_no_library() == (
        f"not used: it has not run on real linux-aarch64, so it is used only with FMU_MESH_LIBRARY=shipped. {COST}"
    )
    assert library_missed()
    monkeypatch.setenv(LIBRARY_VARIABLE, str(named))
    assert load_library() == str(named)
    assert why_no_library() is None
    assert not library_missed()


def test_the_shipped_library_is_used_where_it_is_asked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("fmu_mesh.rings.library.TRIED_ON", ())
    without = load_library()
    for_messages = load_library(to_step=False)  # has nothing to do with the rings

    monkeypatch.setenv(LIBRARY_VARIABLE, "shipped")

    assert (without, for_messages) == (None, str(LIBRARY))
    assert load_library() == str(LIBRARY)
    assert not library_missed()


def test_a_processor_that_no_library_is_for_has_none(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("platform.machine", lambda: "riscv64")
    monkeypatch.setenv(LIBRARY_VARIABLE, "shipped")

    assert load_library(to_step=False) is None
    assert (why_no_library() or "").startswith(
        "not used: it is for linux-x86_64 and linux-aarch64, and this is linux-riscv64."
    )


@pytest.mark.parametrize(("machine", "libc"), [("riscv64", "glibc"), ("x86_64", "")])
def test_where_nobody_has_the_library_nobody_misses_it(
    monkeypatch: pytest.MonkeyPatch, machine: str, libc: str
) -> None:
    monkeypatch.setattr("platform.machine", lambda: machine)
    monkeypatch.setattr("platform.libc_ver", lambda: (libc, ""))
    monkeypatch.setattr("fmu_mesh.rings.library.TRIED_ON", ())

    assert why_no_library() is not None
    assert not library_missed()


def test_a_library_that_is_named_and_cannot_be_loaded_is_an_error(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv(LIBRARY_VARIABLE, str(tmp_path / "missing.so"))

    with pytest.raises(ConfigurationError, match=r"FMU_MESH_LIBRARY names a library .*missing\.so: cannot open"):
        load_library()


def test_a_library_of_somebody_else_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(LIBRARY_VARIABLE, sys.modules["_ctypes"].__file__ or "")

    with pytest.raises(ConfigurationError, match=r"does not say what it was built from\. In a clone, `make library`"):
        load_library()


def test_library_of_older_sources_is_error_that_says_how_to_build_it(clone: Path) -> None:
    with (clone / "fmu_mesh" / "rings" / "burst.c").open("a") as source:
        source.write("/* changed */\n")
    command = [sys.executable, "-m", "fmu_mesh", "launch", str(write_config(clone))]

    asked = subprocess.run(command, cwd=clone, capture_output=True, text=True, check=False)

    assert asked.returncode == 2
    assert asked.stderr == (
        f"fmu-mesh: {clone / NAME} was built from another version of {clone / 'fmu_mesh/rings/burst.c'}. "
        "In a clone, `make library` builds it; an installation has to be installed again.\n"
    )


@pytest.mark.parametrize(
    "known", [native.StepKind, native.Stage, native.RowBase, native.Change, native.BurstEnd, Solved, Request]
)
def test_an_enumeration_has_the_names_of_the_header_in_their_order(known: type[IntEnum]) -> None:
    header = (LIBRARY.parent / "burst.h").read_text()
    declared = re.search(rf"enum {known.__name__} \{{ (.*) \}};", header)

    assert declared is not None
    assert [member.name for member in known] == declared[1].split(", ")
    assert [*known] == [*range(len(known))]


def test_fields_of_a_table_are_those_of_the_header_with_their_types() -> None:
    assert ("members", ctypes.POINTER(native.MemberTable)) in native.UnitTable._fields_
    assert ("outputs", native.OutputTable * 2) in native.MemberTable._fields_
    assert ("said", ctypes.c_void_p) in native.MemberTable._fields_
    assert [name for name, *_ in native.Entry._fields_] == ["from_", "to", "from_large", "to_large"]


def test_a_library_without_its_sources_is_loaded(clone: Path) -> None:
    (clone / "fmu_mesh" / "rings" / "burst.c").unlink()

    assert ask_in(clone).stdout == f"{clone / NAME}\nNone\n"


@pytest.mark.parametrize("content", [None, b"", b"\x7fELF is not enough"], ids=["missing", "empty", "broken"])
def test_where_the_library_cannot_be_loaded_a_sentence_says_why(clone: Path, content: bytes | None) -> None:
    (clone / NAME).unlink()
    if content is not None:
        (clone / NAME).write_bytes(content)

    asked = ask_in(clone)

    assert re.fullmatch(
        rf"None\nnot used: it cannot be loaded: {clone / NAME}: .+\. {re.escape(COST)}\n", asked.stdout
    ), asked


@pytest.mark.parametrize("processor", ["x86_64", "aarch64"])
def test_a_wheel_for_linux_has_the_library_of_the_tree(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, processor: str
) -> None:
    monkeypatch.setenv("_PYTHON_HOST_PLATFORM", f"linux-{processor}")  # of Python's own build; tools keep to it

    wheel = next(WheelBuilder(str(build_library.ROOT)).build(directory=str(tmp_path), versions=["standard"]))

    library = build_library.library_path(f"linux-{processor}")
    name = library.relative_to(build_library.ROOT).as_posix()
    assert wheel.endswith(f"-py3-none-manylinux_2_17_{processor}.whl")
    with zipfile.ZipFile(wheel) as archive:
        assert archive.read(name) == library.read_bytes()
        assert "fmu_mesh/rings/burst.h" in archive.namelist()
        assert [name for name in archive.namelist() if name.endswith(".so")] == [name]


def test_a_wheel_that_is_built_on_another_system_has_no_library(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("packaging.tags.platform_tags", lambda: iter(["musllinux_1_2_x86_64"]))

    wheel = next(WheelBuilder(str(build_library.ROOT)).build(directory=str(tmp_path), versions=["standard"]))

    assert wheel.endswith("-py3-none-any.whl")
    with zipfile.ZipFile(wheel) as archive:
        assert [name for name in archive.namelist() if name.endswith(".so")] == []


@pytest.mark.parametrize("change", ["missing", "stale"])
def test_no_wheel_is_built_with_a_library_of_other_sources(clone: Path, change: str) -> None:
    if change == "missing":
        (clone / NAME).unlink()
    else:
        (clone / "fmu_mesh" / "rings" / "burst.c").write_text("")

    with pytest.raises(Exception, match=r"is missing, or was built from other sources: make library"):
        next(WheelBuilder(str(clone)).build(directory=str(clone / "dist"), versions=["standard"]))


def test_the_source_distribution_has_the_library_and_what_builds_it(tmp_path: Path) -> None:
    sdist = next(SdistBuilder(str(build_library.ROOT)).build(directory=str(tmp_path), versions=["standard"]))

    with tarfile.open(sdist) as archive:
        names = {name.partition("/")[2] for name in archive.getnames()}
    assert {NAME, "fmu_mesh/rings/burst.c", "fmu_mesh/rings/burst.h", "build_library.py"} <= names


@pytest.mark.parametrize("chosen", [False, True], ids=["missing", "switched off"])
def test_a_mesh_without_the_library_is_reported_by_check_and_launch(
    clone: Path,
    chosen: bool,  # noqa: FBT001 a parameter of a test
) -> None:
    (clone / NAME).unlink()
    config = write_config(clone, instances={"gain": {"fmu": "Gain"}}, connections=[], stop_time=0.01)
    environment = os.environ | ({LIBRARY_VARIABLE: "none"} if chosen else {})

    def run(*arguments: str) -> subprocess.CompletedProcess[str]:
        command = [sys.executable, "-m", "fmu_mesh", *arguments, str(config)]
        return subprocess.run(command, cwd=clone, env=environment, capture_output=True, text=True, check=True)

    said = json.loads(run("check", "--json").stdout)["plan"]["library"]
    assert said.startswith("not used: ")
    assert said.endswith(COST)
    assert said in run("check").stdout
    launched = run("launch", "--local", "--no-progress").stderr
    assert launched == ("" if chosen else f"fmu-mesh: warning: the library of C is {said}\n")
