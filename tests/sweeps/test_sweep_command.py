"""`fmu-mesh sweep`, as a person types it: what it prints, what it leaves, and what happens when something ends it."""

from __future__ import annotations

import csv
import json
import signal
import sys
from pathlib import Path

import psutil
import pytest

import fmu_mesh
from tests.helpers import FMUS, Launched, Place, wait_until, write_config

VARY = ("--vary", "pendulum.d=0.05:0.8:8", "--vary", "delay.d=0.1,0.25")


@pytest.fixture
def config(place: Place) -> Path:
    return write_config(place.folder)


def table(folder: Path) -> list[dict[str, str]]:
    """The table without what tells how a variant was run."""
    with (folder / "table.csv").open(newline="") as file:
        return [
            {name: cell for name, cell in row.items() if name not in {"seconds", "worker"}}
            for row in csv.DictReader(file)
        ]


def rows(folder: Path) -> int:
    """The rows that are there by now."""
    return sum(file.read_bytes().count(b"\n") for file in folder.glob("rows*.jsonl"))


def workers(launched: Launched) -> list[psutil.Process]:
    """The processes that a sweep has started."""
    return psutil.Process(launched.pid).children(recursive=True)


def test_a_sweep_prints_its_table_and_leaves_no_process_or_file(place: Place, config: Path) -> None:
    done = place.run("sweep", config, *VARY, "--reduce", "max(pendulum.a)", "--reduce", "at(delay.y, 0.5)")

    assert done.wait() == 0
    folder = place.folder / "pair_sweep"
    first, second = done.output.splitlines()
    assert first == "table: pair_sweep/table.csv"
    assert second.startswith("16 of 16 runs, 0 failed, in ")
    assert second.endswith(" runs/s")
    lines = table(folder)
    assert list(lines[0]) == [
        "variant",
        "pendulum.d",
        "delay.d",
        "exit_code",
        "message",
        "max(pendulum.a)",
        "at(delay.y, 0.5)",
        "id",
    ]
    assert [(line["pendulum.d"], line["delay.d"]) for line in lines[:3]] == [
        ("0.05", "0.1"),
        ("0.05", "0.25"),
        ("0.15714285714285714", "0.1"),
    ]
    assert sorted(path.name for path in (folder / "runs").iterdir()) == sorted(f"{line['id']}.csv" for line in lines)
    place.assert_nothing_left()


def test_curves_are_those_of_launch_with_the_same_values(place: Place, config: Path) -> None:
    place.run("sweep", config, *VARY)
    line = table(place.folder / "pair_sweep")[5]
    values = [f"--set={name}={line[name]}" for name in ("pendulum.d", "delay.d")]

    place.run("launch", config, *values)

    alone = (place.folder / "pair.csv").read_bytes()
    assert (place.folder / "pair_sweep" / "runs" / f"{line['id']}.csv").read_bytes() == alone
    names, *_, last = csv.reader(alone.decode().splitlines())
    assert [line[f"last({name})"] for name in names[1:]] == last[1:]


def test_a_sweep_whose_process_is_killed_goes_on_where_it_was(place: Place, config: Path) -> None:
    vary = ("--vary", "pendulum.d=0.05:0.8:60", "--reduce", "max(pendulum.a)")
    place.run("sweep", config, *vary, "--folder", "whole")
    folder = place.folder / "killed"
    sweep = place.start("sweep", config, *vary, "--folder", "killed")
    wait_until(lambda: rows(folder) > 5, "some rows")
    started = workers(sweep)

    sweep.signal(signal.SIGKILL)
    sweep.wait()

    wait_until(lambda: not any(process.is_running() for process in started), "the end of its processes")
    kept = rows(folder)
    assert 5 < kept < 60
    assert not (folder / "table.csv").exists()
    again = place.run("sweep", folder, "--json")
    assert again.wait() == 0
    report = json.loads(again.output)
    assert (report["variants"], report["runs"], report["failed"], report["state"]) == (60, 60, 0, "done")
    assert rows(folder) == 60  # nothing ran twice
    assert table(folder) == table(place.folder / "whole")
    for file in (place.folder / "whole" / "runs").iterdir():
        assert (folder / "runs" / file.name).read_bytes() == file.read_bytes()


def test_ctrl_c_keeps_the_rows_and_says_how_to_go_on(place: Place, config: Path) -> None:
    sweep = place.start("sweep", config, "--vary", "pendulum.d=0.05:0.8:5000", "--json")
    folder = place.folder / "pair_sweep"
    wait_until(lambda: rows(folder) > 5, "some rows")

    sweep.signal(signal.SIGINT)

    assert sweep.wait() == 130
    assert "of 5000 runs are in" in sweep.message
    assert "`--resume`" in sweep.message
    report = json.loads(sweep.output)
    assert 5 < report["runs"] == len(table(folder)) < 5000
    assert report["error"]["exit_code"] == 130
    place.assert_nothing_left()


def test_a_failed_run_is_told_and_counted(place: Place, faulty: Path) -> None:
    config = write_config(place.folder, instances={"f": {"fmu": str(faulty)}}, connections=[], stop_time=0.01)

    done = place.run("sweep", config, "--vary", "f.fail_at=0.0025,1,0.0045", "--no-curves")

    assert done.wait() == 3
    assert done.errors.splitlines() == [
        f"fmu-mesh: variant {number} (f.fail_at={at}) failed: instance f, point {point}, t = 0.00{point} s: "
        "fmi2DoStep returned error; the FMU says: the reactor is empty."
        for number, at, point in ((0, 0.0025, 2), (2, 0.0045, 4))
    ]
    assert done.output.splitlines()[1].startswith("3 of 3 runs, 2 failed, in ")
    lines = table(place.folder / "pair_sweep")
    assert [line["exit_code"] for line in lines] == ["3", "0", "3"]
    assert [line["last(f.y)"] for line in lines] == ["", "0.0", ""]
    assert not (place.folder / "pair_sweep" / "runs").exists()


def test_a_sampler_chooses_the_same_variants_with_the_same_seed(place: Place, config: Path) -> None:
    found = []
    for folder, seed in (("a", "1"), ("b", "1"), ("c", "2")):
        arguments = ("--vary", "pendulum.d=0.05:0.8", "--sampler", "lhs:4", "--seed", seed, "--stop-time", "0.1")
        assert place.run("sweep", config, *arguments, "--folder", folder).wait() == 0
        found.append([line["pendulum.d"] for line in table(place.folder / folder)])

    assert found[0] == found[1] != found[2]
    assert len(found[0]) == 4


def test_the_parts_of_a_sweep_together_are_the_whole(place: Place, config: Path) -> None:
    place.run("sweep", config, *VARY, "--folder", "whole")
    place.run("sweep", config, *VARY, "--folder", "parts", "--workers", "1")
    folder = place.folder / "parts"
    for file in folder.glob("rows*.jsonl"):
        file.unlink()

    for number in (1, 2, 3):
        assert place.run("sweep", folder, "--part", f"{number}/3").wait() == 0
    place.run("sweep", folder)

    counts = [rows_of_part.read_bytes().count(b"\n") for rows_of_part in sorted(folder.glob("rows-*.jsonl"))]
    assert counts == [6, 5, 5]
    assert table(folder) == table(place.folder / "whole")


WRONG = [
    (("--vary", "pendulum.d"), "expected NAME=LOW:HIGH:COUNT or NAME=VALUE,VALUE"),
    ((), "nothing varies. Name a parameter"),
    (("--vary", "pendulum.d=0.1:0.2"), "has no count. Give it one"),
    (("--vary", "pendulum.d=1", "--vary", "pendulum.d=2"), "--vary pendulum.d is there twice"),
    (("--vary", "pendulum.d=1", "--reduce", "maximum(pendulum.a)"), "Did you mean 'max(pendulum.a)'"),
    (("--vary", "pendulum.d=1", "--reduce", "max(pendulum.x)"), "pendulum.x"),
    (("--vary", "pendulum.d=1", "--max-instances", "DampedPendulum.fmu"), "expected MODEL.fmu=N"),
    (("--vary", "pendulum.d=1", "--slurm", "--dask"), "--slurm and --dask do not go together"),
    (("--vary", "pendulum.d=1", "--part", "1/2"), "--part needs the folder of a sweep"),
    (("--vary", "pendulum.d=1", "--part", "3/2"), "'3/2' is no part such as 1/8"),
    (("--vary", "pendulum.d=1", "--seed", "-1"), "is no whole number of at least 0"),
    (("--vary", "pendulum.d=1", "--sampler", "lsh:4"), "Did you mean 'lhs:4'"),
]


@pytest.mark.parametrize(("arguments", "said"), WRONG, ids=[said for _, said in WRONG])
def test_what_is_wrong_is_said_in_one_sentence(
    place: Place, config: Path, arguments: tuple[str, ...], said: str
) -> None:
    done = place.run("sweep", config, *arguments)

    assert done.wait() == 2
    assert said in done.message
    assert done.output == ""
    assert not (place.folder / "pair_sweep").exists()


def test_the_folder_of_a_sweep_says_what_varies(place: Place, config: Path) -> None:
    place.run("sweep", config, *VARY)

    again = place.run("sweep", place.folder / "pair_sweep", "--vary", "pendulum.d=1")

    assert again.wait() == 2
    assert "is the folder of a sweep, which says what varies" in again.message
    assert place.run("sweep", config, *VARY).message.startswith("fmu-mesh: there is a sweep in ")


@pytest.mark.parametrize("call", ["study()", "if True:\n    study()", "[study() for _ in range(2)]"])
def test_a_program_without_a_guard_starts_no_sweep(place: Place, call: str) -> None:
    program = place.folder / "unguarded.py"
    program.write_text(
        "import fmu_mesh\n"
        f"mesh = fmu_mesh.Mesh('gain', step_size=0.01, stop_time=0.1)\nmesh.add('g', fmu='{FMUS / 'Gain.fmu'}')\n"
        "def study():\n"
        "    with fmu_mesh.sweep(mesh, {'g.k': [1.0, 2.0]}) as running:\n"
        "        print(running.wait().summary)\n"
        f"{call}\n"
        'if __name__ == "__main__":\n    print("too late")\n'
    )

    done = place.start_command([sys.executable, str(program)])

    assert done.wait() != 0
    assert "fmu_mesh.errors.CallRefused: each worker of the sweep would come to 'unguarded.py:" in done.errors
    assert '`if __name__ == "__main__":`' in done.errors
    assert not (place.folder / "gain_sweep").exists()
    place.assert_nothing_left(10.0)


def test_force_replaces_a_sweep_and_no_other_file(place: Place, config: Path) -> None:
    folder = place.folder / "pair_sweep"
    place.run("sweep", config, *VARY)
    old = {path.name for path in (folder / "runs").iterdir()}
    for name in ("notes.txt", "runs/mine.csv"):
        (folder / name).write_text("mine")

    done = place.run("sweep", config, "--vary", "pendulum.d=0.3,0.5", "--force")
    both = place.start("sweep", config, *VARY, "--force", "--resume")

    new = {path.name for path in (folder / "runs").iterdir()} - {"mine.csv"}
    assert "2 of 2 runs, 0 failed" in done.output
    assert len((folder / "rows.jsonl").read_text().splitlines()) == len(new) == 2
    assert not new & old
    assert (folder / "notes.txt").read_text() == (folder / "runs/mine.csv").read_text() == "mine"
    assert both.wait() == 2
    assert "`--force` removes them" in both.message


def test_the_folder_of_a_sweep_is_plotted(place: Place, config: Path) -> None:
    place.run("sweep", config, *VARY, "--reduce", "rms(pendulum.a)")
    folder = place.folder / "pair_sweep"

    curves = place.run("plot", folder, "--variables", "pendulum.a", "--colour", "delay.d")
    cells = place.run("plot", folder, "--heat-map", "rms(pendulum.a)")
    nothing = place.run("plot", folder)

    assert (curves.wait(), cells.wait(), nothing.wait()) == (0, 0, 2)
    for file in ("pendulum.a.png", "rms(pendulum.a).png"):
        assert (folder / file).read_bytes().startswith(b"\x89PNG")
    assert "--variables has to name the one variable" in nothing.message
    assert fmu_mesh.SweepResult.read(folder).variables[0] == "pendulum.a"
