"""A result file that cannot be written, from the start or from some point on, or that is no ordinary file."""

from __future__ import annotations

import os
import signal
import sys
import threading
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest

from tests.helpers import BY_STREAMS, BY_ZENOH, Place, row_count, rows_of, wait_until, write_config

MODES = pytest.mark.parametrize("options", [(), ("--local",)], ids=["distributed", "local"])


@MODES
def test_a_folder_is_no_result_file(place: Place, options: tuple[str, ...]) -> None:
    config = write_config(place.folder)

    launched = place.run("launch", config, "--output", place.folder, *options)

    assert launched.wait() == 2
    assert f"the folder '{place.folder}'; expected a file" in launched.errors
    assert "Traceback" not in launched.errors
    place.assert_nothing_left()


@MODES
def test_result_file_that_cannot_be_made_ends_run_before_its_first_point(
    place: Place, options: tuple[str, ...]
) -> None:
    in_a_file = place.folder / "file"
    in_a_file.touch()

    launched = place.run("launch", write_config(place.folder), "--output", in_a_file / "pair.csv", *options)

    assert launched.wait() == 2
    assert f"in the file '{in_a_file}'; expected a file in a folder" in launched.message
    place.assert_nothing_left()


@pytest.mark.skipif(not Path("/dev/full").exists(), reason=f"{sys.platform} has no /dev/full")
@pytest.mark.parametrize("stop_time", [0.01, 100.0], ids=["at the end", "in mid-run"])
@MODES
def test_a_full_disk_ends_the_run_and_is_told_as_such(place: Place, stop_time: float, options: tuple[str, ...]) -> None:
    launched = place.run("launch", write_config(place.folder, stop_time=stop_time), "--output", "/dev/full", *options)

    assert launched.wait() == 2
    assert "the result file '/dev/full' cannot be written: No space left on device" in launched.message
    assert "rows) is in" not in launched.message
    place.assert_nothing_left()


@MODES
def test_a_second_run_does_not_write_into_the_file_of_the_first(place: Place, options: tuple[str, ...]) -> None:
    """Nor does it take away what is there already."""
    first = place.start("launch", write_config(place.folder, stop_time=10_000.0, simulation={"real_time_factor": 1}))
    result = place.folder / "pair.csv"
    wait_until(lambda: row_count(result) > 10, "rows")

    second = place.run("launch", write_config(place.folder, name="other", record={"file": "pair.csv"}), *options)

    assert second.wait() == 2
    assert f"another run is writing the result file '{result}'" in second.message
    first.signal(signal.SIGINT)
    assert first.wait() == 130
    assert len(rows_of(result)) > 10
    place.assert_nothing_left()


@pytest.mark.parametrize(
    ("options", "zenoh"),
    [((), BY_STREAMS), ((), BY_ZENOH), (("--local",), {})],
    ids=["streams", "frames", "local"],
)
def test_a_disk_that_gets_full_leaves_as_many_complete_rows_as_reported(
    place: Place, options: tuple[str, ...], zenoh: Mapping[str, bool]
) -> None:
    """The limit for the size of a file is the disk that a test can fill."""
    config = write_config(place.folder, stop_time=100.0, zenoh=zenoh)
    result = config.with_suffix(".csv")

    launched = place.start("launch", config, *options, prefix=["prlimit", "--fsize=1000000"])

    assert launched.wait() == 2
    rows = rows_of(result)
    assert f"the result file '{result}' cannot be written: File too large" in launched.message
    assert f"({len(rows)} rows) is in '{result}'" in launched.message
    assert result.stat().st_size > 990_000
    assert [row[0] for row in rows] == [point * 0.001 for point in range(len(rows))]
    place.assert_nothing_left()


@MODES
def test_a_result_may_go_into_a_pipe(place: Place, options: tuple[str, ...]) -> None:
    pipe = place.folder / "pipe"
    os.mkfifo(pipe)
    read: list[bytes] = []
    reader = threading.Thread(target=lambda: read.append(pipe.read_bytes()), daemon=True)
    reader.start()

    piped = place.run("launch", write_config(place.folder), "--output", pipe, *options)
    plain = place.run("launch", place.folder / "pair.yaml", "--local")

    assert (piped.wait(), plain.wait()) == (0, 0), piped.errors
    reader.join(10.0)
    assert read == [(place.folder / "pair.csv").read_bytes()]


TWO: Any = [{"file": "first.csv"}, {"file": "second.csv", "variables": ["pendulum.a", "in:delay.x"], "every": 3}]


@pytest.mark.skipif(not Path("/dev/full").exists(), reason=f"{sys.platform} has no /dev/full")
@pytest.mark.parametrize("broken", [0, 1])
@MODES
def test_a_full_disk_of_one_file_leaves_the_rows_of_the_other(
    place: Place, options: tuple[str, ...], broken: int
) -> None:
    records: Any = [
        {**section, "file": "/dev/full"} if index == broken else section for index, section in enumerate(TWO)
    ]
    # A small window: else the nodes may be at the stop time before the disk is full, and the other file is complete.
    config = write_config(place.folder, stop_time=100.0, simulation={"window": 1024}, record=records)

    launched = place.run("launch", config, *options)

    assert launched.wait() == 2
    assert "the result file '/dev/full' cannot be written: No space left on device" in launched.message
    other = place.folder / str(TWO[1 - broken]["file"])
    rows = rows_of(other)
    assert f"({len(rows)} rows) is in '{other}'" in launched.message
    assert [row[0] for row in rows] == [point * 0.001 for point in range(0, 100_001, 1 if broken else 3)][: len(rows)]
    assert 0 < len(rows) < 100_001 // (1 if broken else 3)
    place.assert_nothing_left()


@MODES
def test_files_that_cannot_all_be_opened_stay_as_they_were(place: Place, options: tuple[str, ...]) -> None:
    in_a_file = place.folder / "file"
    in_a_file.touch()
    (place.folder / "first.csv").write_bytes(b"older")
    records: Any = [TWO[0], {"file": "file/second.csv"}]
    config = write_config(place.folder, record=records)

    launched = place.run("launch", config, *options)

    assert launched.wait() == 2
    assert str(in_a_file) in launched.errors
    assert (place.folder / "first.csv").read_bytes() == b"older"
    assert not list(place.folder.glob("*.starting"))
    place.assert_nothing_left()


def test_all_files_of_a_killed_master_end_with_a_whole_row(place: Place) -> None:
    """They are the beginning of what a run to the end writes."""
    records: Any = [*TWO, {"file": "late.csv", "every": 2, "from": 0.01}]
    config = write_config(place.folder, stop_time=20.0, record=records)
    names = [str(section["file"]) for section in records]
    assert place.run("launch", config, "--local").wait() == 0
    whole = [(place.folder / name).read_bytes() for name in names]
    for name in names:
        (place.folder / name).unlink()
    launched = place.start("launch", config, "--real-time-factor", "1")
    wait_until(lambda: not launched.running or row_count(place.folder / "late.csv") > 100, "rows of all files")

    launched.child("master").kill()

    assert launched.wait() == 4
    for name, expected in zip(names, whole, strict=True):
        found = (place.folder / name).read_bytes()
        assert found.endswith(b"\n")
        assert expected.startswith(found)
        rows = found.count(b"\n") - 1
        assert f"'{place.folder / name}' ({rows} rows)" in launched.message
    place.assert_nothing_left()
