"""Results in memory: what is written in blocks is read as it was, and a block that is not complete does not count."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from fmu_mesh.files import Kept
from fmu_mesh.results.arrays_file import ArraysFile
from fmu_mesh.results.formats import read_result
from fmu_mesh.variables.value_types import VariableType

TYPES: dict[str, VariableType] = {"a.x": "Float64", "a.flag": "Boolean", "a.text": "String"}


def some(rows: int) -> tuple[NDArray[np.float64], list[NDArray[Any]]]:
    numbers = np.arange(rows)
    texts = np.array([f"row {number}" for number in numbers], object)
    return numbers / 7, [np.stack([numbers, numbers / 3], axis=1)[:, 1], numbers % 3 == 0, texts]


@pytest.mark.parametrize("rows", [0, 1, 3_855, 3_856, 20_000])  # a row has 17 bytes, a block 65,536
def test_rows_of_any_number_are_read_as_they_were_written(tmp_path: Path, rows: int) -> None:
    times, columns = some(rows)
    file = ArraysFile(tmp_path / "a.arrays", 1 + len(TYPES))

    file.write(times, columns)
    file.write(times, columns)
    file.close()

    read = read_result(tmp_path / "a.arrays", TYPES)
    assert file.rows == 2 * rows
    assert read.times.tolist() == times.tolist() * 2
    assert [column.tolist() for column in read.values.values()] == [column.tolist() * 2 for column in columns]


def test_a_file_is_cut_after_its_last_whole_block(tmp_path: Path) -> None:
    path = tmp_path / "a.arrays"
    times, columns = some(10_000)
    file = ArraysFile(path, 1 + len(TYPES))
    file.write(times, columns)
    file.close()
    with path.open("r+b") as written:
        written.truncate(path.stat().st_size - 1)

    rows = ArraysFile.keep_whole_rows(path, Kept())

    assert 0 < rows < 10_000
    assert read_result(path, TYPES).times.tolist() == times[:rows].tolist()
