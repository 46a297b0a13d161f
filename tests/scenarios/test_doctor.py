"""`fmu-mesh doctor`: a host that lacks things is told each of them with the way out, in the words of a run."""

from __future__ import annotations

import json
import re
import socket
import subprocess
import sys
import tomllib
from pathlib import Path
from typing import get_args

import pytest

from fmu_mesh.cli.main import main
from fmu_mesh.errors import ConfigurationError, LibraryMissing
from fmu_mesh.hosts import processes
from fmu_mesh.hosts.slurm import submitted
from fmu_mesh.hosts.this_host import CheckState, HostCheck, report_of_this_host
from fmu_mesh.installing import PROGRAMS, USERS, version_of_library
from fmu_mesh.rings.library import LIBRARY_VARIABLE
from tests.helpers import Place
from tests.terminal import Terminal

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture
def bare(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A host with no programs, no screen and no choice of the user; its PATH is this folder."""
    for name in ("CC", "CXX", "DISPLAY", "WAYLAND_DISPLAY", "FMU_MESH_GAZEBO", "MUJOCO_GL", LIBRARY_VARIABLE):
        monkeypatch.delenv(name, raising=False)
    for name in ("PATH", "FMU_MESH_CACHE_DIR", "FMU_MESH_RUNTIME_DIR"):
        monkeypatch.setenv(name, str(folder := tmp_path / name))
        folder.mkdir(mode=0o700)
    return tmp_path / "PATH"


def checks() -> dict[str, HostCheck]:
    return {check.name: check for check in report_of_this_host().checks}


def distribution(folder: Path, name: str, version: str, entry_points: str = "") -> None:
    """What a folder of installed packages has of one."""
    own = folder / f"{name}-{version}.dist-info"
    own.mkdir(parents=True)
    (own / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: {version}\n", encoding="utf-8")
    (own / "entry_points.txt").write_text(entry_points, encoding="utf-8")


def doctor(*prefix: str) -> tuple[int, dict[str, HostCheck]]:
    command = [*prefix, sys.executable, "-m", "fmu_mesh", "doctor", "--json"]
    done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=ROOT)
    report = json.loads(done.stdout)
    assert (done.stderr, report["exit_code"]) == ("", done.returncode)
    return done.returncode, {check["name"]: HostCheck(**check) for check in report["checks"]}


@pytest.mark.usefixtures("bare")
@pytest.mark.parametrize(
    ("name", "found", "hint"),
    [
        (
            "C compiler",
            "there is no compiler (looked for cc, gcc, clang)",
            "Install one, name it in $CC, or export the",
        ),
        ("C++ compiler", "there is no compiler (looked for c++, g++, clang++)", "Install one, name it in $CXX, or"),
        ("wine", "FMUs that have only Windows binaries need the program wine", "on Debian with `apt install wine`."),
        ("Gazebo classic", "does not run on this host: there is no 'gazebo_lockstep'", "Build bridges/gazebo_classic"),
        ("Sandbox", "bubblewrap, which is not installed", "Use `apt-get install bubblewrap`, or `sandbox: none`."),
        ("ssh", "nodes on other hosts need the program ssh", "on Debian with `apt install openssh-client`."),
        ("sbatch", "jobs of Slurm need the program sbatch", "Install the programs of Slurm (Debian, Ubuntu: apt"),
        (
            "zenoh-bridge-ros2dds",
            "meshes beside ROS on DDS need the program",
            "Start it where ROS is; `ros.connect` says",
        ),
    ],
)
def test_a_host_without_something_is_told_the_way_out(name: str, found: str, hint: str) -> None:
    report = report_of_this_host()

    [check] = [one for one in report.checks if one.name == name]
    assert (check.state, report.exit_code) == ("missing", 0)
    assert found in check.found
    assert hint in (check.hint or "")


def test_a_missing_program_has_the_hint_of_a_run(bare: Path) -> None:
    with pytest.raises(ConfigurationError) as caught:
        submitted(bare / "job.sbatch", "#!/bin/sh\n")

    assert checks()["sbatch"].hint == caught.value.hint


def test_programs_that_are_there_are_told_with_their_place(bare: Path) -> None:
    for name in (*PROGRAMS, "cc"):
        (bare / name).write_text("#!/bin/false\n", encoding="ascii")
        (bare / name).chmod(0o755)

    found = checks()

    names = {"C compiler": "cc", **{program: program for program in PROGRAMS}}
    assert {name: (found[name].state, found[name].found) for name in names} == {
        name: ("ok", str(bare / program)) for name, program in names.items()
    }


@pytest.mark.usefixtures("bare")
def test_a_library_that_is_switched_off_is_a_limit_and_no_failure(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(LIBRARY_VARIABLE, "none")

    code, found = doctor()

    assert code == 0
    assert found["Library of C"].state == "limited"
    assert f"not used: the environment variable {LIBRARY_VARIABLE} is none." in found["Library of C"].found


@pytest.mark.usefixtures("bare")
def test_a_library_that_is_refused_ends_every_mesh_here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(LIBRARY_VARIABLE, str(tmp_path / "none.so"))

    code, found = doctor()

    assert code == 1
    assert found["Library of C"].state == "failed"
    assert f"{LIBRARY_VARIABLE} names a library that cannot be loaded" in found["Library of C"].found
    assert found["ssh"].state == "missing"  # the others are told all the same


@pytest.mark.usefixtures("bare")
def test_a_runtime_folder_of_everybody_ends_every_mesh_here(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("FMU_MESH_RUNTIME_DIR", str(folder := tmp_path / "open"))
    folder.mkdir()
    folder.chmod(0o755)

    code = main(["doctor"])

    lines = capsys.readouterr().out.splitlines()
    assert (code, lines[-1]) == (1, "No mesh can run on this host: see Runtime folder.")
    [line] = [line for line in lines if line.startswith("failed")]
    assert f"Close it with `chmod 700 {folder}`, or set FMU_MESH_RUNTIME_DIR to another folder." in line


@pytest.mark.usefixtures("bare")
@pytest.mark.parametrize(("limit", "state"), [("ulimit -v 1500000", "failed"), ("ulimit -n 256", "ok")])
def test_limits_of_the_shell_are_told(limit: str, state: str) -> None:
    code, found = doctor("/bin/sh", "-c", f'{limit}; exec "$@"', "sh")

    assert (found["Memory"].state, code) == (state, int(state == "failed"))
    if state == "failed":
        assert "Raise the limit with `ulimit -v unlimited`" in (found["Memory"].hint or "")
    else:
        assert found["Limits"].state == "limited"
        assert found["Limits"].hint == "Many nodes need more open files: `ulimit -n 256`."


@pytest.mark.usefixtures("bare")
def test_a_package_of_another_version_is_told_with_the_command(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    distribution(tmp_path, "numpy", "1.20.3")
    distribution(tmp_path, "nicegui", "4.0.1")
    monkeypatch.syspath_prepend(str(tmp_path))

    found = checks()

    assert found["numpy"].state == "failed"
    assert found["numpy"].found == "all meshes need the library numpy: numpy>=1.26, and 1.20.3 is installed"
    assert found["nicegui"].state == "missing"
    assert found["nicegui"].found == "dashboards need the library nicegui: nicegui<4,>=3.18, and 4.0.1 is installed"
    assert "install 'nicegui<4,>=3.18'`" in (found["nicegui"].hint or "")


def test_a_package_that_is_missing_is_told_as_a_run_tells_it() -> None:
    with pytest.raises(LibraryMissing, match="all meshes need the library no-such-library"):
        version_of_library("no-such-library")


def test_each_optional_library_of_an_extra_has_its_line() -> None:
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["optional-dependencies"]
    developers = {"test", "test-ros", "check", "package", "library", "docs", "dev"}
    needed = {re.split(r"[>=\[]", line)[0] for name in extras.keys() - developers for line in extras[name]}

    assert needed <= USERS.keys()
    assert USERS.keys() <= checks().keys()


@pytest.mark.usefixtures("bare")
def test_a_kind_whose_package_is_broken_hides_no_other(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    distribution(tmp_path / "own", "tables", "1.0", "[fmu_mesh.instances]\ntable = no_such_module:Table\n")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path / "own"))

    code, found = doctor()

    assert (code, found["Kind 'table'"].state, found["wine"].state) == (0, "missing", "missing")
    assert (
        "'table' of the package 'tables' cannot be imported from 'no_such_module:Table'" in found["Kind 'table'"].found
    )
    assert found["Kind 'table'"].hint == "Repair or uninstall it."


def test_a_check_that_does_not_answer_is_left_behind(bare: Path) -> None:
    (bare / "bwrap").write_text("#!/bin/sh\nexec /bin/sleep 60\n", encoding="ascii")
    (bare / "bwrap").chmod(0o755)

    found = {check.name: check for check in report_of_this_host(check_s=3.0).checks}

    assert (found["Sandbox"].state, found["Sandbox"].found) == ("unknown", "no answer within 3 s")
    assert found["sbatch"].state == "missing"


@pytest.mark.usefixtures("bare")
def test_a_folder_that_cannot_be_written_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "file").touch()
    monkeypatch.setenv("FMU_MESH_CACHE_DIR", str(tmp_path / "file" / "cache"))

    cache = checks()["Cache folder"]

    assert (cache.state, cache.hint) == ("missing", "Set FMU_MESH_CACHE_DIR to a folder that can be written.")
    assert cache.found == f"the cache folder '{tmp_path / 'file' / 'cache'}' cannot be written"


@pytest.mark.usefixtures("bare")
def test_the_default_port_that_another_program_has_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    with socket.create_server(("127.0.0.1", 0)) as other:
        port = other.getsockname()[1]
        monkeypatch.setattr(processes, "PORT", port)

        found = checks()["Default port"]

    assert (found.state, found.found) == ("limited", f"port {port} of 127.0.0.1 is taken by another program.")


@pytest.mark.usefixtures("bare")
def test_text_and_json_have_the_same_checks_in_order(capsys: pytest.CaptureFixture[str]) -> None:
    code = main(["doctor"])
    *lines, empty, verdict = capsys.readouterr().out.splitlines()
    main(["doctor", "--json"])
    report = json.loads(capsys.readouterr().out)

    assert (code, empty, report["exit_code"]) == (0, "", 0)
    assert [line.split()[0] for line in lines] == [check["state"] for check in report["checks"]]
    assert all(line[9:].startswith(check["name"]) for line, check in zip(lines, report["checks"], strict=True))
    assert verdict.startswith("Meshes can run on this host. Missing for some of them: C compiler, C++ compiler, ")


def test_the_page_of_json_names_each_state_and_field() -> None:
    page = (ROOT / "docs" / "reference" / "json.md").read_text(encoding="utf-8").partition("## `doctor`")[2]

    assert [name for name in (*get_args(CheckState), *HostCheck.__struct_fields__) if f"`{name}`" not in page] == []


def test_a_narrow_terminal_gets_lines_that_fit(place: Place) -> None:
    with Terminal(place, "doctor", columns=80, lines=100) as terminal:
        assert terminal.wait() == 0
        shown = terminal.shown

    *lines, _, verdict = "\n".join(shown).strip().partition("\n\n")
    assert verdict.startswith("Meshes can run on this host.")
    assert [line for line in lines[0].splitlines() if not line.startswith((*get_args(CheckState), " " * 31))] == []
