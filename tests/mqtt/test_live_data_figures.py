"""What the benchmark of live data measures, in a short form: no value is lost, each is at its point, nothing grows.

`.ci/long live_data` takes more values: FMU_MESH_LIVE_POINTS is the length of the long run.
"""

from __future__ import annotations

import os

import pytest

from benchmarks.live_data import ahead, flooded, main

POINTS = int(os.environ.get("FMU_MESH_LIVE_POINTS", "40000"))
LONG = pytest.mark.skipif(POINTS < 1_000_000, reason="FMU_MESH_LIVE_POINTS is not 1000000 or more: .ci/long live_data")
SMALLEST = 8 + 24
"""Bytes of a number that is kept in a list."""


@pytest.mark.timeout(900)
def test_no_client_loses_a_value_and_each_run_can_be_repeated(capsys: pytest.CaptureFixture[str]) -> None:
    code = main(["--parts", "clients", "--seconds", str(max(2.0, POINTS / 1e5)), "--repeat", "1"])

    shown = capsys.readouterr()
    assert code == 0, shown.err
    rows = [line.split(" | ") for line in shown.out.splitlines() if line.startswith(("| Zenoh", "| MQTT"))]
    assert rows[0][-2:] == ["0", "0 |"]
    assert rows[1][-2:] == ["0", "0 |"] or "not measured" in rows[1][1]


def test_a_value_for_each_point_is_at_its_point() -> None:
    assert ahead(min(POINTS, 100_000)).problems == []


@LONG
@pytest.mark.timeout(900)
def test_memory_and_files_of_a_long_run_do_not_grow() -> None:
    run = ahead(POINTS)

    before, most, files, most_files = run.grown(0.25)
    assert run.problems == []
    assert most - before < 0.75 * POINTS * SMALLEST / 1e6
    assert most_files == files


@LONG
@pytest.mark.timeout(900)
@pytest.mark.parametrize("kind", ["arrival", "t"])
def test_a_flood_ends_no_run_and_its_memory_does_not_grow(kind: str) -> None:
    run = flooded(kind, 30.0)

    before, most, files, most_files = run.grown(0.5)
    assert run.problems == []
    assert run.figures["points"] > 0
    assert most - before < 0.5 * run.figures["received"] * SMALLEST / 1e6
    assert most_files == files
