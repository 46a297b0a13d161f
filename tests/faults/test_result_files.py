"""A result file that cannot be written, from the start or from some point on."""

from __future__ import annotations

import signal
import sys
from pathlib import Path

import pytest

from tests.helpers import Place, row_count, rows_of, wait_until, write_config

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
def test_a_result_file_that_cannot_be_made_ends_the_run_before_its_first_point(
    place: Place, options: tuple[str, ...]
) -> None:
    in_a_file = place.folder / "file"
    in_a_file.touch()

    launched = place.run("launch", write_config(place.folder), "--output", in_a_file / "pair.csv", *options)

    assert launched.wait() == 2
    assert str(in_a_file) in launched.errors
    assert "cannot be written: " in launched.message
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
