"""A result file of a run that starts again: what is there is compared, and what follows is appended."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import fmu_mesh
from fmu_mesh.errors import NotDeterministic
from fmu_mesh.results.recording import ResultFile, ResultFormat
from fmu_mesh.results.resumed_file import opened_again
from fmu_mesh.variables.value_types import VariableType
from tests.unit.test_result_formats import ALL_FORMATS, SET, assert_rows, recording, times_of, values_of, write

ROWS = 40


def written(path: Path, types: list[VariableType], rows: int, before: int, *, block: int = 7) -> ResultFile:
    """An attempt that writes these rows, of which there are some from ``before``; what is set is given again."""
    file = opened_again(path, recording(types), before)
    file.note(SET)
    write(file, types, rows, block)
    return file


@ALL_FORMATS
@pytest.mark.parametrize("block", [1, 7, 100])
def test_rows_of_three_attempts_are_those_of_one(
    tmp_path: Path, format_: ResultFormat, name: str, types: list[VariableType], block: int
) -> None:
    path = tmp_path / name

    for rows, before in ((10, 0), (23, 10), (ROWS, 23)):
        file = written(path, types, rows, before, block=block)
        file.close()
        assert file.rows == rows
        assert format_.keep_whole_rows(path, file.kept) == rows

    assert_rows(path, ROWS, types)
    assert fmu_mesh.Result.read(path).metadata["set"] == [SET]
    written(tmp_path / f"one-{name}", types, ROWS, 0).close()
    if name == "a.csv":
        assert path.read_bytes() == (tmp_path / f"one-{name}").read_bytes()


@ALL_FORMATS
@pytest.mark.parametrize("rows", [6, 10, 23])
def test_of_attempt_killed_while_it_comes_back_or_after_all_rows_stay(
    tmp_path: Path, format_: ResultFormat, name: str, types: list[VariableType], rows: int
) -> None:
    path = tmp_path / name
    written(path, types, 10, 0).close()
    file = written(path, types, rows, 10)

    kept = format_.keep_whole_rows(path, file.kept)  # its writer is killed here

    assert kept == max(rows, 10)
    assert_rows(path, kept, types)
    file.close()


@ALL_FORMATS
def test_a_difference_is_named_and_changes_nothing(
    tmp_path: Path, format_: ResultFormat, name: str, types: list[VariableType]
) -> None:
    path = tmp_path / name
    written(path, types, 10, 0).close()
    before = path.read_bytes()
    file = opened_again(path, recording(types), 10)
    columns = [values_of(type_, 20) for type_ in types]
    columns[types.index("Int32")][4] = 7

    with pytest.raises(NotDeterministic, match=r"'it' is not deterministic: point 4, it\.Int32 was .* and 7 after it"):
        file.write(times_of(20), columns)
    file.close()

    assert path.read_bytes() == before
    assert format_.keep_whole_rows(path, file.kept) == 10


@pytest.mark.parametrize("name", ["a.csv", "a.parquet"])
def test_the_sign_of_zero_is_a_difference(tmp_path: Path, name: str) -> None:
    file = opened_again(tmp_path / name, recording(["Float64"]), 0)
    file.write(times_of(2), [np.array([0.0, 1.0])])
    file.close()
    again = opened_again(tmp_path / name, recording(["Float64"]), 2)

    with pytest.raises(NotDeterministic, match=r"was 0\.0 before the restart and -0\.0 after it"):
        again.write(times_of(2), [np.array([-0.0, 1.0])])
    again.close()
