"""The benchmark of ROS topics: it runs, and no value with a stamp of its own is lost."""

from __future__ import annotations

import pytest

from benchmarks.ros_topics import main
from tests.ros.peers import need


def test_values_at_1_khz_with_stamps_are_never_lost(capsys: pytest.CaptureFixture[str]) -> None:
    need("rosbags", "xxhash")

    code = main(["--profiles", "rmw_zenoh", "--count", "1000", "--repeat", "1"])

    shown = capsys.readouterr().out
    assert code == 0
    [row] = [line for line in shown.splitlines() if line.startswith("| rmw_zenoh |")]
    cells = [cell.strip() for cell in row.strip("|").split("|")]
    assert (cells[3], cells[8]) == ("0", "0"), shown
