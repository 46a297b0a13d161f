"""The private prefix of Wine: made once, never half, and nothing of the user's is touched."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import psutil
import pytest

from fmu_mesh.errors import LoadFailed
from fmu_mesh.instances.fmi.wine import windows_path, windows_uri, wine_environment, wine_program
from tests.helpers import DEADLINE_S, wait_until
from tests.wine.windows import NEEDS_WINE, windows_program

ASK = """
from fmu_mesh.instances.fmi.wine import wine_environment
print(wine_environment(print)["WINEPREFIX"])
"""

SEEN = r"""
#include <stdio.h>
#include <stdlib.h>
int main(int count, char **arguments)
{
    FILE *file = fopen(arguments[1], "r");
    printf("%s|%s|%d|", arguments[1], getenv("LICENSES"), getenv("DISPLAY") == NULL);
    return file == NULL || count != 2;
}
"""


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The cache of this test, which has no prefix yet."""
    monkeypatch.setenv("FMU_MESH_CACHE_DIR", str(tmp_path / "cache"))
    return tmp_path / "cache" / "wine"


def start_asking() -> subprocess.Popen[str]:
    return subprocess.Popen([sys.executable, "-c", ASK], stdout=subprocess.PIPE, text=True, start_new_session=True)


def users_of(folder: Path) -> list[int]:
    """The processes whose prefix of Wine is in a folder."""
    found = []
    for process in psutil.process_iter():
        try:
            if process.environ().get("WINEPREFIX", "").startswith(str(folder)):
                found.append(process.pid)
        except (psutil.NoSuchProcess, psutil.AccessDenied):
            continue
    return found


@NEEDS_WINE
def test_many_processes_make_one_prefix_after_a_maker_was_killed(cache: Path) -> None:
    killed = start_asking()
    # Then programs of Wine run in it that do not end with their maker.
    wait_until(lambda: [*cache.glob("*.draft/drive_c/windows/system32/winedevice.exe")], "a prefix that is half made")
    os.killpg(killed.pid, signal.SIGKILL)
    killed.communicate(timeout=DEADLINE_S)

    asking = [start_asking() for _ in range(4)]
    said = [process.communicate(timeout=DEADLINE_S)[0].splitlines() for process in asking]

    (prefix,) = {Path(lines[-1]) for lines in said}
    assert sorted(lines[:-1] for lines in said) == [[], [], [], [f"preparing Wine in '{prefix}', once"]]
    assert sorted(path.name for path in cache.iterdir()) == [prefix.name, f"{prefix.name}.lock"]
    assert sum(file.lstat().st_size for file in prefix.rglob("*")) < 200e6
    wait_until(lambda: not users_of(cache), "the end of Wine")


@NEEDS_WINE
def test_a_program_sees_the_files_of_linux_and_no_desktop(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DISPLAY", ":0")
    monkeypatch.setenv("LICENSES", "27000@here")
    (tmp_path / "seen.c").write_text(SEEN, encoding="ascii")
    program = windows_program(tmp_path / "seen.c")

    done = subprocess.run(
        [str(wine_program()), program, windows_path(tmp_path / "seen.c")],
        env=wine_environment(),
        capture_output=True,
        text=True,
        check=False,
        timeout=DEADLINE_S,
    )

    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout == f"Z:{tmp_path}/seen.c|27000@here|1|".replace("/", "\\")


def test_resources_have_a_uri_that_windows_code_understands() -> None:
    assert windows_uri(Path("/tmp/a b/ä")) == "file:///Z:/tmp/a%20b/%C3%A4"  # noqa: S108 not opened


@NEEDS_WINE
def test_a_cache_that_cannot_be_written_has_a_way_out(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "file").write_text("", encoding="ascii")
    monkeypatch.setenv("FMU_MESH_CACHE_DIR", str(tmp_path / "file"))

    with pytest.raises(LoadFailed, match=r"Wine cannot be prepared in .*: Not a directory") as refused:
        wine_environment()

    assert refused.value.hint == "Set FMU_MESH_CACHE_DIR to a folder that can be written."


def test_without_wine_the_error_names_the_package(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", "/nonexistent")

    with pytest.raises(LoadFailed, match="is not installed") as refused:
        wine_environment()

    assert refused.value.hint == "`apt install wine` lets it run under Wine."
