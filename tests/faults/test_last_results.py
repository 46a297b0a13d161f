"""What a run that fails leaves of an older result, and what it says of its own."""

from __future__ import annotations

import csv
import signal
from contextlib import suppress
from pathlib import Path
from typing import Any

import psutil
import pytest

from tests.fmus.helpers import NO_COMPILER, built_once, find_fmu
from tests.helpers import Launched, Place, row_count, rows_of, wait_until, write_config

MODES = pytest.mark.parametrize("options", [(), ("--local",)], ids=["distributed", "local"])
OLDER = pytest.mark.parametrize("older", ["time,an.older\n0.0,1.0\n", None], ids=["older result", "no result"])
FOREVER = {"call": 300.0, "start": 300.0, "initialize": 300.0}


@pytest.fixture(scope="module")
def hostile() -> Path:
    """The FMU that does what its instance name says."""
    if NO_COMPILER is not None:
        pytest.skip(NO_COMPILER)
    return built_once(Path(__file__).parent / "fmus" / "Hostile")


def kept_bytes(file: Path) -> bytes | None:
    return file.read_bytes() if file.exists() else None


def is_held(place: Place, file: Path) -> bool:
    """Whether a run has this result file open to write, or the name that it has until its first point.

    Its lock is not tried: who tries it holds it for a moment, and the run would be refused.
    """
    names = {str(file), f"{file}.starting"}
    for process in place.processes():
        with suppress(psutil.Error):
            if any(opened.path in names and opened.mode != "r" for opened in process.open_files()):
                return True
    return False


def hanging(place: Place, hostile: Path, *options: str, older: str | None) -> tuple[Launched, Path]:
    """A run that never leaves Initialization Mode, although all that it records has reached the first point."""
    config = write_config(
        place.folder,
        instances={"pendulum": {"fmu": "DampedPendulum"}, "hang_fmi2ExitInitializationMode": {"fmu": str(hostile)}},
        connections=[],
        record={"file": "pair.csv", "variables": ["pendulum.a"]},
        timeouts=FOREVER,
    )
    result = config.with_suffix(".csv")
    if older is not None:
        result.write_text(older)
    launched = place.start("launch", config, *options)
    wait_until(lambda: is_held(place, result), "the result file to be opened")
    return launched, result


@OLDER
@pytest.mark.parametrize("suffix", [".csv", ".mcap"])
@MODES
def test_a_run_that_fails_before_its_first_point_leaves_what_was_there(
    place: Place, options: tuple[str, ...], suffix: str, older: str | None
) -> None:
    result = place.folder / "results" / f"pair{suffix}"
    config = write_config(place.folder, record={"file": f"results/{result.name}"}, stop_time=0.4)
    if older is not None:
        assert place.run("launch", config, *options).wait() == 0
        assert result.stat().st_size > 0
    before = kept_bytes(result)
    there = {path: path.read_bytes() for path in result.parent.glob("*")}  # a CSV and its metadata

    launched = place.run("launch", config, "--set", "pendulum.l=0", *options)

    assert launched.wait() == 3
    assert "fmi2ExitInitializationMode returned error" in launched.message
    assert "rows" not in launched.message
    assert kept_bytes(result) == before
    assert {path: path.read_bytes() for path in result.parent.glob("*")} == there
    assert (result in there) == (older is not None)
    place.assert_nothing_left()


@OLDER
def test_a_run_that_only_some_have_begun_leaves_what_was_there(place: Place, hostile: Path, older: str | None) -> None:
    launched, result = hanging(place, hostile, older=older)
    before = kept_bytes(result)
    with place.session() as session:

        def reached() -> bool:
            replies = session.get("fmu_mesh/pair/pendulum/out/a", timeout=5.0)
            return any(reply.ok is not None for reply in replies)

        wait_until(reached, "the first point of the pendulum")

    launched.signal(signal.SIGINT)

    assert launched.wait() == 130
    assert "rows" not in launched.message
    assert kept_bytes(result) == before
    place.assert_nothing_left()


@OLDER
@MODES
def test_second_run_is_refused_although_first_has_not_reached_its_first_point(
    place: Place, hostile: Path, options: tuple[str, ...], older: str | None
) -> None:
    first, result = hanging(place, hostile, older=older)
    before = kept_bytes(result)

    second = place.run("launch", write_config(place.folder, name="other", record={"file": "pair.csv"}), *options)

    assert second.wait() == 2
    assert f"another run is writing the result file '{result}'" in second.message
    assert first.running
    assert kept_bytes(result) == before
    first.signal(signal.SIGINT)
    assert first.wait() == 130
    assert kept_bytes(result) == before


@OLDER
def test_a_master_that_is_killed_before_first_point_leaves_what_was_there(
    place: Place, hostile: Path, older: str | None
) -> None:
    launched, result = hanging(place, hostile, older=older)
    before = kept_bytes(result)

    launched.child("master").kill()

    assert launched.wait() == 4
    assert "rows" not in launched.message
    assert kept_bytes(result) == before
    assert sorted(path.name for path in place.folder.glob("pair.csv*")) == (["pair.csv"] if older else [])
    place.assert_nothing_left()


@OLDER
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGKILL])
def test_run_in_one_process_ended_before_first_point_leaves_what_was_there(
    place: Place, hostile: Path, number: signal.Signals, older: str | None
) -> None:
    launched, result = hanging(place, hostile, "--local", older=older)
    before = kept_bytes(result)

    launched.signal(number)

    assert launched.wait() == (130 if number == signal.SIGINT else -signal.SIGKILL)
    assert kept_bytes(result) == before
    if number == signal.SIGINT:
        assert not list(place.folder.glob("*.starting"))
    assert place.run("launch", write_config(place.folder, stop_time=0.1), "--local").wait() == 0
    assert len(rows_of(result)) == 101
    assert not list(place.folder.glob("*.starting"))


def test_run_paused_at_its_first_point_has_that_as_its_result(place: Place) -> None:
    config = write_config(place.folder)
    launched = place.start("launch", config, "--paused")
    wait_until(lambda: row_count(config.with_suffix(".csv")) == 1, "the row of the first point")

    launched.signal(signal.SIGINT)

    assert launched.wait() == 130
    assert "(1 rows)" in launched.message
    assert len(rows_of(config.with_suffix(".csv"))) == 1


@MODES
def test_run_that_records_nothing_says_nothing_of_older_result_and_leaves_it(
    place: Place, options: tuple[str, ...]
) -> None:
    old = place.folder / "old.csv"
    old.write_text("time,pendulum.a\n" + "0.0,1.0\n" * 5000)
    before = old.read_bytes()
    record = {"file": "old.csv", "variables": []}

    done = place.run("launch", write_config(place.folder, record=record), *options)
    plotted = place.run("launch", place.folder / "pair.yaml", "--plot", place.folder / "old.png", *options)
    long = write_config(place.folder, name="long", stop_time=10_000.0, record=record)
    interrupted = place.start("launch", long, *options)
    if options:
        wait_until(lambda: list((place.folder / "run").glob("long.*/fmus/*/*")), "the run")
    else:
        interrupted.wait_for_error_line("mesh 'long' at")
    interrupted.signal(signal.SIGINT)

    assert done.wait() == 0
    assert "rows" not in done.output
    assert plotted.wait() == 2
    assert "nothing is recorded, so there is nothing to plot" in plotted.message
    assert interrupted.wait() == 130
    assert "rows" not in interrupted.message
    assert old.read_bytes() == before


@pytest.mark.parametrize("victim", ["pendulum", "master"])
def test_rows_with_lines_of_text_in_them_are_counted_as_rows(place: Place, tmp_path: Path, victim: str) -> None:
    config = write_config(
        place.folder,
        instances={
            "pendulum": {"fmu": "DampedPendulum"},
            "text": {"fmu": str(find_fmu("AllTypes", tmp_path)), "start_values": {"string_in": 'two\n"lines"'}},
        },
        connections=[],
        record={"file": "pair.csv", "variables": ["text.string_out", "pendulum.a"]},
        simulation={"real_time_factor": 1},
        stop_time=10_000.0,
    )
    result = config.with_suffix(".csv")
    launched = place.start("launch", config)
    wait_until(lambda: row_count(result) > 500, "rows")

    launched.child(victim).kill()

    assert launched.wait() == 4
    with result.open(newline="") as file:
        header, *rows = csv.reader(file)
    assert {len(row) for row in rows} == {len(header)}
    assert [float(row[0]) for row in rows] == [point * 0.001 for point in range(len(rows))]
    assert {row[1] for row in rows[1:]} == {'two\n"lines"'}
    assert f"({len(rows)} rows) is in '{result}'" in launched.message


def test_a_bag_of_a_killed_master_has_the_rows_that_are_told(place: Place) -> None:
    mcap = pytest.importorskip("mcap.stream_reader", reason="the package mcap is not installed")
    config = write_config(
        place.folder, record={"file": "pair.mcap"}, simulation={"real_time_factor": 1}, stop_time=10_000.0
    )
    result = place.folder / "pair.mcap"

    def messages() -> int:
        if not result.exists():
            return 0
        records: list[Any] = []
        with result.open("rb") as file, suppress(Exception):  # its end is missing
            records.extend(mcap.StreamReader(file).records)
        return sum(isinstance(record, mcap.Message) and record.channel_id == 1 for record in records)

    launched = place.start("launch", config)
    wait_until(lambda: messages() > 300, "messages")

    launched.child("master").kill()

    assert launched.wait() == 4
    assert f"({messages()} rows) is in '{result}'" in launched.message
