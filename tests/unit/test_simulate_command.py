"""`fmu-mesh simulate`: one FMU to its end; nothing is written unless an option names a file."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

import fmu_mesh
from fmu_mesh.cli.main import main
from tests.fmus.helpers import find_fmu
from tests.helpers import FMUS

PENDULUM = str(FMUS / "DampedPendulum.fmu")


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize("way", [[], ["--local"]])
def test_the_summary_is_printed_and_only_named_files_are_written(
    folder: Path, capsys: pytest.CaptureFixture[str], way: list[str]
) -> None:
    options = ["--stop-time", "1", "--set", "a=1.3", "--no-progress", *way]

    assert main(["simulate", PENDULUM, *options]) == 0
    assert [*folder.iterdir()] == []
    assert main(["simulate", PENDULUM, *options, "--plot", "a.png", "--output", "a.csv", "--record", "a"]) == 0

    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith("500 points in ")
    assert lines[1:3] == ["plot: a.png", "result: a.csv (501 rows)"]
    assert {path.name for path in folder.iterdir()} == {"a.png", "a.csv", "a.csv.json"}
    result = fmu_mesh.Result.read("a.csv")
    assert (result.names, result["a"][0]) == (["DampedPendulum.a"], 1.3)


def test_a_picture_needs_no_result_file(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["simulate", PENDULUM, "--output-interval", "0.02", "--plot", "a.png", "--local", "--json"]) == 0

    report = json.loads(capsys.readouterr().out)
    assert (report["state"], report["point"], report["file"], report["files"]) == ("done", 20_000, None, [])
    assert (folder / "a.png").stat().st_size > 10_000
    assert [*folder.iterdir()] == [folder / "a.png"]


def test_inputs_come_from_a_table(folder: Path) -> None:
    (folder / "u.csv").write_text("time,u\n0,0\n1,4\n", encoding="utf-8")

    options = ["--inputs", "u.csv", "--stop-time", "1", "--step-size", "0.25", "--output", "y.csv", "--local"]
    assert main(["simulate", str(FMUS / "Gain.fmu"), *options]) == 0

    assert fmu_mesh.Result.read("y.csv")["y"].tolist() == [0.0, 0.0, 1.0, 2.0, 3.0]


def test_an_fmu_that_fails_is_drawn_as_far_as_it_came(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    fmu = find_fmu("Faulty", tmp_path)

    assert main(["simulate", str(fmu), "--set", "fail_at=0.5", "--plot", "y.png", "--local"]) == 3

    assert capsys.readouterr().out == "plot: y.png\n"
    assert (folder / "y.png").exists()


@pytest.mark.parametrize(
    ("options", "told"),
    [
        (["--set", "b=1"], "--set b=1: the unknown variable 'b'"),
        (["--inputs", "no.csv"], "no.csv"),
        (["--output-interval", "0.003"], "--output-interval"),
        (["--kind", "model-exchange"], "Did you mean"),
        (["--stop-time", "0.5001"], "stop_time"),
        (["--plot", "a.xyz"], "Name it .png, .svg or .pdf"),
    ],
)
def test_a_wrong_option_is_named_as_it_was_given(
    folder: Path, capsys: pytest.CaptureFixture[str], options: list[str], told: str
) -> None:
    assert main(["simulate", PENDULUM, *options]) == 2

    assert told in capsys.readouterr().err
    assert [*folder.iterdir()] == []


def test_the_helps_of_simulate_and_run_say_which_one_is_wanted(capsys: pytest.CaptureFixture[str]) -> None:
    for command, told in (("simulate", "`run` keeps it live"), ("run", "`simulate` runs it to its end")):
        with pytest.raises(SystemExit):
            main([command, "--help"])
        assert told in " ".join(capsys.readouterr().out.split())
