"""The wheel for arm64 under qemu-aarch64: that it starts and computes. `.ci/long arm64` makes what these tests need.

Not that its rings are right: an emulated processor has the memory order of the one below it (docs/rings.md).

`FMU_MESH_ARM64` is a folder with `venv`, a Python for arm64 that has the wheel, and `examples`: the configurations of
the clone, and its FMUs with libraries for arm64 only.
"""

from __future__ import annotations

import json
import os
import subprocess
from pathlib import Path

import pytest

ROOT = Path(os.environ.get("FMU_MESH_ARM64", "missing"))
pytestmark = pytest.mark.skipif("FMU_MESH_ARM64" not in os.environ, reason=".ci/long arm64 runs it")

OFF = "it has not run on real linux-aarch64, so it is used only with FMU_MESH_LIBRARY=shipped"


def fmu_mesh(*arguments: str, library: str = "", ends_with: int = 0) -> subprocess.CompletedProcess[str]:
    """A command of the emulated program, with what `FMU_MESH_LIBRARY` is."""
    done = subprocess.run(
        [ROOT / "venv/bin/python", "-m", "fmu_mesh", *arguments],
        cwd=ROOT / "examples",
        env=os.environ | {"FMU_MESH_LIBRARY": library},
        capture_output=True,
        text=True,
        check=False,
        timeout=500,
    )
    assert done.returncode == ends_with, done.stdout + done.stderr
    return done


@pytest.mark.parametrize("config", ["pendulum_delay", "cycle2"])
@pytest.mark.parametrize("library", ["", "shipped"])
def test_a_mesh_of_processes_equals_one_process_in_every_float(library: str, config: str) -> None:
    results = [ROOT / f"{config}-{library}-{name}.csv" for name in ("local", "processes")]
    options = "launch", f"configs/{config}.yaml", "--no-progress", "--output"

    fmu_mesh(*options, str(results[0]), "--local", library=library)
    said = fmu_mesh(*options, str(results[1]), library=library).stderr

    rows = results[0].read_text()
    assert rows.count("\n") > 100
    assert results[1].read_text() == rows
    assert (OFF in said) == (library == "")


def test_the_library_changes_no_float() -> None:
    results = [ROOT / f"pendulum_delay-{library}-processes.csv" for library in ("", "shipped")]

    assert results[0].read_text() == results[1].read_text()


def test_check_and_inspect_say_what_runs() -> None:
    plan = json.loads(fmu_mesh("check", "--json", "configs/pendulum_delay.yaml").stdout)["plan"]
    gain = fmu_mesh("inspect", "--json", "fmus/Gain.fmu", library="shipped")
    shown = json.loads(gain.stdout)

    assert OFF in plan["library"]
    assert gain.stderr == ""
    assert shown["runs_here"]
    assert shown["description"]["platforms"] == ["aarch64-linux"]
