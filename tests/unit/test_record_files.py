"""Several result files get their rows from the same values, whatever happens to one of them."""

from __future__ import annotations

import errno
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from fmu_mesh.errors import ConfigurationError
from fmu_mesh.files import Kept
from fmu_mesh.results.record_files import ReadColumn, RecordFiles
from fmu_mesh.simtime import TimeGrid
from fmu_mesh.system.records import RecordPlan

GRID = TimeGrid(start_time=1.0, step_size=0.5, last_point=100)


class ListFile:
    """A result file that keeps its rows in a list; the disk has room for ``room`` rows."""

    kept = Kept()

    def __init__(self, name: str, room: int = 1000, *, fails_to_close: bool = False) -> None:
        self.path = Path(name)
        self.lines: list[tuple[Any, ...]] = []
        self.calls: list[str] = []
        self._room = room
        self._fails_to_close = fails_to_close

    @property
    def rows(self) -> int:
        return len(self.lines)

    def write(self, times: NDArray[np.float64], columns: Sequence[NDArray[Any]]) -> None:
        self.calls.append("write")
        for row in zip(times.tolist(), *(column.tolist() for column in columns), strict=True):
            if len(self.lines) >= self._room:
                raise OSError(errno.ENOSPC, "No space left on device")
            self.lines.append(row)

    def note(self, entry: Mapping[str, Any]) -> None:
        self.calls.append(f"note {entry}")

    def flush(self) -> None:
        self.calls.append("flush")

    def close(self) -> None:
        self.calls.append("close")
        if self._fails_to_close:
            raise OSError(errno.EIO, "Input/output error")


def column_of(instance: str, variable: str) -> ReadColumn:
    return lambda first, end: np.arange(first, end) + (100 if variable == "y" else 0) + (1000 if instance == "b" else 0)


def begun(files: Sequence[ListFile], plans: Sequence[RecordPlan]) -> RecordFiles:
    record = RecordFiles(files)
    record.begin(GRID, plans, column_of)
    return record


def test_each_file_gets_its_columns_at_its_points() -> None:
    files = [ListFile("all.csv"), ListFile("some.csv"), ListFile("late.csv")]
    record = begun(
        files,
        [
            RecordPlan("all.csv", (("a", "x"), ("b", "y"))),
            RecordPlan("some.csv", (("b", "y"),), every=3),
            RecordPlan("late.csv", (("a", "x"),), first=4, every=2),
        ],
    )

    for first, end in ((0, 2), (2, 3), (3, 9), (9, 10)):
        record.write(first, end)

    assert files[0].lines == [(1.0 + 0.5 * k, k, 1100 + k) for k in range(10)]
    assert files[1].lines == [(1.0 + 0.5 * k, 1100 + k) for k in (0, 3, 6, 9)]
    assert files[2].lines == [(1.0 + 0.5 * k, k) for k in (4, 6, 8)]
    assert record.counted == (("all.csv", 10), ("some.csv", 4), ("late.csv", 3))
    assert files[1].calls == ["write"] * 3  # never without rows


def test_a_full_disk_of_one_file_leaves_the_others_their_rows() -> None:
    files = [ListFile("a.csv"), ListFile("b.csv", room=5), ListFile("c.csv")]
    record = begun(files, [RecordPlan(file.path.name, (("a", "x"),)) for file in files])
    record.write(0, 4)

    with pytest.raises(ConfigurationError, match=r"the result file 'b.csv' cannot be written: No space left"):
        record.write(4, 8)
    record.write(4, 12)  # what came until the run has ended
    record.flush()
    record.close()
    record.close()

    assert [row[1] for row in files[0].lines] == [row[1] for row in files[2].lines] == list(range(12))
    assert [row[1] for row in files[1].lines] == list(range(5))
    assert files[1].calls == ["write", "write", "close"]
    assert files[0].calls == ["write", "write", "write", "flush", "close"]


def test_a_file_that_cannot_be_closed_does_not_keep_the_others_open() -> None:
    files = [ListFile("a.csv", fails_to_close=True), ListFile("b.csv")]
    record = begun(files, [RecordPlan(file.path.name, (("a", "x"),)) for file in files])
    record.write(0, 3)

    with pytest.raises(ConfigurationError, match=r"'a.csv' cannot be written: Input/output error"):
        record.close()

    record.write(3, 6)
    assert [file.calls for file in files] == [["write", "close"]] * 2


def test_files_of_a_run_that_has_not_begun_are_only_closed() -> None:
    file = ListFile("a.csv")
    record = RecordFiles([file])

    record.write(0, 3)
    record.close()

    assert file.calls == ["close"]


def test_files_of_another_run_get_their_own_rows_and_notes() -> None:
    first, second = ListFile("first.csv"), ListFile("second.csv")
    record = begun([first], [RecordPlan("first.csv", (("a", "x"),))])
    record.note_event("stiff", "a", 1, "stiff")
    record.write(0, 5)
    record.close()

    record.begin_again([second])
    record.note_event("stiff", "b", 2, "stiff")
    record.write(0, 3)
    record.close()

    assert (first.rows, second.rows) == (5, 3)
    assert record.counted == (("second.csv", 3),)
    assert second.calls[0] == "note {'stiff': {'b': {'point': 2, 'message': 'stiff'}}}"
