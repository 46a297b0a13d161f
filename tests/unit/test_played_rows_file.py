"""The file with the rows that nodes play after a loss: bytes of rings, with stamps, in chunks."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from pathlib import Path
from resource import RLIMIT_FSIZE, getrlimit, setrlimit

import numpy as np
import pytest

from fmu_mesh.errors import FmuMeshError
from fmu_mesh.results.played_rows import PlayedRows, RowsToPlay, cut_rows, rows_to_play
from fmu_mesh.rings.ring import Ring
from fmu_mesh.system.layout import Layout, row_bytes

LAYOUT = Layout.of([("y", "Float64"), ("n", "Int32"), ("b", "Boolean"), ("field", "Float32", (1000,))])
POINTS = {"fast": 1, "slow": 3, "slower": 700}
RING_ROWS = 64


def opened(path: Path) -> PlayedRows:
    return PlayedRows(path, {name: (row_bytes(LAYOUT), points) for name, points in POINTS.items()})


def written(file: PlayedRows, first: int, end: int) -> None:
    """Write the rows of these points, whose values follow from the instance and the row, from small rings."""
    rings = {name: Ring(LAYOUT, RING_ROWS) for name in POINTS}

    def memory(name: str, start: int, stop: int) -> Iterator[memoryview]:
        for row in range(start, stop):
            rings[name].put(row, "y", row + POINTS[name] / 1000)
            rings[name].put(row, "field", np.arange(1000) + row)
            rings[name].stamp(row)
        return (rings[name].memory(slots) for _, slots in rings[name].pieces(start, stop))

    for point in range(first, end, RING_ROWS):
        file.write(point, min(end, point + RING_ROWS), {name: partial(memory, name) for name in POINTS})


def assert_has_rows(path: Path, end: int) -> None:
    rows, ring = RowsToPlay(path), Ring(LAYOUT, RING_ROWS)
    for name, points in POINTS.items():
        last = -(-end // points)
        for first in range(0, last, RING_ROWS):
            rows.read(name, ring, first, min(last, first + RING_ROWS))
            for row in range(first, min(last, first + RING_ROWS)):
                assert ring.value(row, "y") == row + points / 1000
                assert ring.value(row, "field[1000]") == np.float32(row + 999)


def test_rows_are_read_as_they_were_written(tmp_path: Path) -> None:
    file = opened(path := tmp_path / "rows")
    written(file, 0, 1500)

    assert (file.points, rows_to_play(path), file.error) == (1500, 1500, "")
    assert_has_rows(path, 1500)


def test_a_further_attempt_goes_on_after_the_rows(tmp_path: Path) -> None:
    written(opened(path := tmp_path / "rows"), 0, 500)
    cut_rows(path, 450)
    cut_rows(path, 480)
    file = opened(path)

    assert file.points == 450
    written(file, 0, 900)
    assert_has_rows(path, 900)


def test_rows_of_another_plan_begin_anew(tmp_path: Path) -> None:
    written(opened(path := tmp_path / "rows"), 0, 100)

    assert PlayedRows(path, {"fast": (24, 1)}).points == 0
    assert rows_to_play(path) == 0
    assert rows_to_play(tmp_path / "none") == 0


def test_rows_that_are_missing_are_not_played(tmp_path: Path) -> None:
    written(opened(path := tmp_path / "rows"), 0, 100)
    rows, ring = RowsToPlay(path), Ring(LAYOUT, RING_ROWS)

    with pytest.raises(FmuMeshError, match=r"cannot be read: rows of 'fast' are missing from row 98 on"):
        rows.read("fast", ring, 98, 103)
    path.write_bytes(b"FMU")
    with pytest.raises(FmuMeshError, match=r"for a restart .* cannot be read"):
        RowsToPlay(path)


def test_where_there_is_no_room_the_rows_before_stay(tmp_path: Path) -> None:
    file = opened(path := tmp_path / "rows")
    before = getrlimit(RLIMIT_FSIZE)
    try:
        setrlimit(RLIMIT_FSIZE, (1_500_000, before[1]))
        written(file, 0, 1500)
    finally:
        setrlimit(RLIMIT_FSIZE, before)

    assert file.error == f"the rows for a restart ('{path}') cannot be written: File too large"
    assert 0 < file.points == rows_to_play(path) < 1500
    assert_has_rows(path, file.points)


def test_a_file_that_cannot_be_opened_is_an_error_in_words(tmp_path: Path) -> None:
    file = opened(tmp_path / "none" / "rows")
    file.write(0, 1, {})

    assert "cannot be written: No such file or directory" in file.error
    file.close()
