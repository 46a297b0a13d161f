"""A recorder of a package outside this one: installed by pip, and found by the ending of the result file."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

import fmu_mesh
from fmu_mesh.dashboard.curve import BoundedCurve
from fmu_mesh.dashboard.result_source import ResultSource
from tests.fmus.helpers import find_fmu
from tests.helpers import Place, rows_of, wait_until, write_config

EXTENSION = Path(__file__).parents[2] / "examples" / "extension"


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the package of the example."""
    target = tmp_path_factory.mktemp("installed")
    install = "-m pip install --quiet --no-deps --no-build-isolation --no-index --disable-pip-version-check --target"
    subprocess.run([sys.executable, *install.split(), target, EXTENSION], check=True)
    return target


@pytest.fixture
def extended(place: Place, installed: Path) -> Place:
    """A place for processes that find the package."""
    path = os.pathsep.join(filter(None, [str(installed), os.environ.get("PYTHONPATH")]))
    place.environment["PYTHONPATH"] = path
    return place


def lines_of(path: Path) -> list[dict[str, float]]:
    return [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]


def test_distributed_run_and_local_one_write_same_bytes_with_numbers_of_csv(extended: Place) -> None:
    config = write_config(extended.folder, record={"file": "pair.jsonl"})
    local, table = extended.folder / "local.jsonl", extended.folder / "pair.csv"

    runs = [
        extended.run("launch", config),
        extended.run("launch", config, "--local", "--output", local),
        extended.run("launch", config, "--local", "--output", table),
    ]

    assert [run.wait() for run in runs] == [0, 0, 0], extended.story()
    assert "pair.jsonl (1001 rows)" in runs[0].output
    assert (extended.folder / "pair.jsonl").read_bytes() == local.read_bytes()
    assert [tuple(line.values()) for line in lines_of(local)] == rows_of(table)
    assert list(lines_of(local)[0]) == ["time", "pendulum.a", "pendulum.der(a)", "pendulum.der(a,2)", "delay.y"]


def test_a_killed_master_leaves_whole_rows_as_many_as_are_told(extended: Place) -> None:
    config = write_config(
        extended.folder, record={"file": "pair.jsonl"}, simulation={"real_time_factor": 1}, stop_time=10_000.0
    )
    result = extended.folder / "pair.jsonl"
    launched = extended.start("launch", config)
    wait_until(lambda: result.exists() and result.read_bytes().count(b"\n") > 300, "rows")

    launched.child("master").kill()

    assert launched.wait() == 4
    lines = lines_of(result)
    assert result.read_text(encoding="utf-8").endswith("\n")
    assert [line["time"] for line in lines] == [point * 0.001 for point in range(len(lines))]
    assert f"({len(lines)} rows) is in '{result}'" in launched.message


def test_what_is_cut_off_within_a_row_is_not_counted(extended: Place) -> None:
    """The writer was killed between two notes."""
    result = extended.folder / "pair.jsonl"
    result.write_text('{"time": 0.0}\n{"time": 0.5}\n{"time": 1')
    program = (
        "from pathlib import Path\n"
        "from fmu_mesh.files import Kept\n"
        "from fmu_mesh.results.formats import result_format\n"
        "print(result_format('pair.jsonl').keep_whole_rows(Path('pair.jsonl'), Kept(1, 14)))"
    )

    done = extended.start_command([sys.executable, "-c", program])

    assert (done.wait(), done.output) == (0, "2\n"), done.errors
    assert result.read_text() == '{"time": 0.0}\n{"time": 0.5}\n'


def test_disk_that_gets_full_leaves_whole_rows_as_many_as_are_told(extended: Place) -> None:
    config = write_config(extended.folder, record={"file": "pair.jsonl"}, stop_time=100.0)
    result = extended.folder / "pair.jsonl"

    launched = extended.start("launch", config, "--local", prefix=["prlimit", "--fsize=1000000"])

    assert launched.wait() == 2
    assert f"({len(lines_of(result))} rows) is in '{result}'" in launched.message
    extended.assert_nothing_left()


def test_what_the_format_cannot_hold_is_a_finding_of_check(extended: Place) -> None:
    config = write_config(
        extended.folder,
        instances={"all": {"fmu": str(find_fmu("AllTypes3", extended.folder))}},
        connections=(),
        record={"file": "pair.jsonl", "variables": ["all.binary_out"]},
    )

    checked = extended.run("check", config)

    assert checked.wait() == 2
    assert "'all.binary_out', which is Binary; expected types that JSON has, or a .csv file" in checked.errors


def test_its_results_are_compared_and_plotted_as_those_of_a_csv(extended: Place) -> None:
    config = write_config(extended.folder)

    runs = [
        extended.run("launch", config, "--output", "pair.jsonl", "--plot", "pair.png"),
        extended.run("launch", config, "--output", "pair.csv"),
        extended.run("compare", "pair.jsonl", "pair.csv"),
    ]

    assert [run.wait() for run in runs] == [0, 0, 0], extended.story()
    assert (extended.folder / "pair.png").is_file()


def test_a_cut_off_file_is_recovered_and_read_before_and_after(
    tmp_path: Path, installed: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(installed)
    result = tmp_path / "pair.jsonl"
    result.write_text('{"time": 0.0, "a.s": "x"}\n{"time": 0.5, "a.s": "y"}\n{"time": 1')

    before = fmu_mesh.Result.read(result)
    rows = fmu_mesh.recover(result)

    assert rows == 2
    assert result.read_text().endswith('"y"}\n')
    for found in (before, fmu_mesh.Result.read(result)):
        assert found.times.tolist() == [0.0, 0.5]
        assert found["a.s"].tolist() == ["x", "y"]


def test_the_page_follows_a_growing_file_of_the_package(
    tmp_path: Path, installed: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(installed)
    result, curves = tmp_path / "pair.jsonl", {"a.x": BoundedCurve(0.0, 1.0)}
    result.write_text('{"time": 0.0, "a.x": 1.0}\n{"time": 1.0, "a.')
    source = ResultSource(result)

    source.read(lambda: curves, lambda: None)
    with result.open("a") as file:
        file.write('x": 2.0}\n{"time": 2.0, "a.x": true}\n')
    source.read(lambda: curves, lambda: None)

    assert source.names == ["a.x"]
    change = curves["a.x"].since(0)
    assert sorted(zip(change.t_low, change.low, strict=True)) == [(0.0, 1.0), (1.0, 2.0), (2.0, 1.0)]
    source.close()


def test_a_format_that_can_only_be_written_is_not_plotted(extended: Place, installed: Path) -> None:
    information = installed / "written-1.0.dist-info"
    information.mkdir()
    (information / "METADATA").write_text("Metadata-Version: 2.1\nName: written\nVersion: 1.0\n")
    (information / "entry_points.txt").write_text("[fmu_mesh.recorders]\nwritten = written:Written\n")
    (installed / "written.py").write_text(
        "from fmu_mesh_extension.json_lines import JsonLinesFile as Lines\n\n"
        "class Written:\n"
        "    check, open = Lines.check, Lines.open\n"
        "    growing_file, keep_whole_rows = Lines.growing_file, Lines.keep_whole_rows\n"
    )
    config = write_config(extended.folder)

    launched = extended.run("launch", config, "--output", "pair.written", "--plot", "pair.png")

    assert launched.wait() == 2
    assert "its format can only be written" in launched.message
    assert "Record into a .csv or .parquet file" in launched.message


def test_without_the_package_a_run_warns_that_the_file_becomes_a_csv(place: Place) -> None:
    launched = place.run("launch", write_config(place.folder, record={"file": "pair.jsonl"}))

    assert launched.wait() == 0
    assert "'pair.jsonl', an ending of no installed format, so the file becomes a CSV" in launched.errors
    assert (place.folder / "pair.jsonl").read_text().startswith("time,")
