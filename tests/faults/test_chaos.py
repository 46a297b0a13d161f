"""`python -m benchmarks.chaos`: kills processes of a mesh at random, and says whether the result is the same."""

from __future__ import annotations

import json
import signal
import sys
from pathlib import Path

import psutil
import pytest

from benchmarks.chaos import main
from tests.helpers import Place, wait_until, write_config

UNSTEADY = """
import os
import fmu_mesh

class Unsteady(fmu_mesh.Component):
    y = fmu_mesh.Output()

    def step(self, time, step_size):
        self.y = float(os.getpid())
"""

FEW = ["--faults", "kill", "--lasts", "0.5", "--per-run", "3"]


def test_three_kills_of_a_small_mesh_change_nothing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    config, report = write_config(tmp_path), tmp_path / "report.json"

    code = main([str(config), "--kills", "3", "--seed", "3", "--json", str(report), *FEW])

    shown = capsys.readouterr().out
    assert code == 0, shown
    told = json.loads(report.read_text())
    given = [one for run in told["runs"] for one in run["given"]]
    assert len(given) == 3
    assert {run["problem"] for run in told["runs"]} == {""}
    assert all(f"| {one['label']} |" in shown for one in given)


def test_a_mesh_is_resumed_after_its_launcher_was_killed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    few = ["--faults", "resume", "--lasts", "2", "--per-run", "2", "--seed", "22", "--checkpoints", "0.2"]

    code = main([str(write_config(tmp_path)), "--kills", "2", *few])

    shown = capsys.readouterr().out
    assert code == 0, shown
    assert "| resume all | 1 | 1 | 0 | 0 |" in shown
    assert "| resume launch | 1 | 1 | 0 | 0 |" in shown


@pytest.mark.parametrize("options", [[], ["--checkpoints", "0.05"]], ids=["restarts", "checkpoints"])
def test_a_short_soak_shows_what_a_run_has(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], options: list[str]
) -> None:
    code = main([str(write_config(tmp_path)), "--soak", "300000", *options])

    shown = capsys.readouterr().out
    assert code == 0 or "has grown" in shown or "too short" in shown, shown
    assert "300000 points in" in shown
    assert "| at, s | memory (PSS), MB | open files | files of the run, MB | result, MB | checkpoint |" in shown


def test_a_mesh_that_is_not_deterministic_is_found(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "unsteady.py").write_text(UNSTEADY, encoding="utf-8")
    config = write_config(tmp_path, instances={"own": {"python": "unsteady.py:Unsteady"}}, connections=())

    code = main([str(config), "--kills", "1", *FEW])

    assert code == 1
    assert "line 3 is 0.001," in capsys.readouterr().out


def test_sigterm_leaves_no_process(place: Place) -> None:
    config = write_config(place.folder)
    command = [sys.executable, "-m", "benchmarks.chaos", str(config), "--faults", "kill", "--lasts", "50"]
    chaos = place.start_command(["env", f"PYTHONPATH={Path(__file__).parents[2]}", *command])
    wait_until(lambda: len(psutil.Process(chaos.pid).children(recursive=True)) > 2, "a run")
    family = psutil.Process(chaos.pid).children(recursive=True)

    chaos.signal(signal.SIGTERM)

    assert chaos.wait() == 130
    wait_until(lambda: not any(one.is_running() for one in family), "the end of all processes", 5.0)
