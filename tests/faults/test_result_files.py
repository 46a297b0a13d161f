"""A result file that cannot be written, from the start or from some point on."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from tests.helpers import Place, write_config

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
