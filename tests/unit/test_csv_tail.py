"""A growing result file is read row by row, each row once."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from fmu_mesh.dashboard.result_source import as_floats
from fmu_mesh.results.formats import followed
from fmu_mesh.results.recording import Columns, Tail

HEADING = b'time,a.x,"a.der(x,2)",a.flag\n'


@pytest.fixture
def path(tmp_path: Path) -> Path:
    path = tmp_path / "result.csv"
    path.write_bytes(HEADING + b"0.0,1.0,2.0,true\n")
    return path


def _add(path: Path, data: bytes) -> None:
    with path.open("ab") as file:
        file.write(data)


def _known(rows: Columns | None) -> tuple[list[float], list[list[float]]]:
    """The times, and each column in numbers."""
    assert rows is not None
    return rows.times.tolist(), [as_floats(values).tolist() for values in rows.values.values()]


def _opened(path: Path) -> Tail:
    tail = followed(path)
    assert tail is not None
    return tail


def test_rows_come_once_and_a_row_that_is_not_complete_comes_later(path: Path) -> None:
    tail = _opened(path)

    first = tail.read(["a.der(x,2)", "a.flag"])
    _add(path, b"0.1,1.5,2.5,fal")
    unfinished = tail.read(["a.x"])
    _add(path, b"se\n0.2,1.75,2.75,true\n")
    rest = tail.read(["a.x", "a.flag"])

    assert tail.names == ["a.x", "a.der(x,2)", "a.flag"]
    assert _known(first) == ([0.0], [[2.0], [1.0]])
    assert unfinished is None
    assert _known(rest) == ([0.1, 0.2], [[1.5, 1.75], [0.0, 1.0]])
    tail.close()


def test_after_a_skip_only_new_rows_come(path: Path) -> None:
    tail = _opened(path)
    _add(path, b"0.1,3.0,4.0")

    tail.skip()
    _add(path, b"5,true\n0.2,5.0,6.0,true\n")

    assert _known(tail.read(["a.x"])) == ([0.2], [[5.0]])
    tail.close()


def test_texts_with_commas_and_line_ends_do_not_shift_columns(tmp_path: Path) -> None:
    path = tmp_path / "texts.csv"
    path.write_bytes(b'time,a.s,a.x\n0.0,"one, two",1.0\n0.1,"a ""line""\nends",2.0\n')

    tail = _opened(path)
    _, (numbers, texts) = _known(tail.read(["a.x", "a.s"]))

    assert numbers == [1.0, 2.0]
    assert np.isnan(texts).all()
    tail.close()


def test_a_text_that_is_cut_off_at_a_line_end_comes_later(tmp_path: Path) -> None:
    path = tmp_path / "texts.csv"
    path.write_bytes(b'time,a.s,a.x\n0.0,"one",1.0\n0.1,"two\n')
    tail = _opened(path)

    first = tail.read(["a.x"])
    _add(path, b'lines",2.0\n')

    assert _known(first) == ([0.0], [[1.0]])
    assert _known(tail.read(["a.x"])) == ([0.1], [[2.0]])
    tail.close()


def test_a_damaged_row_does_not_end_the_rows(path: Path) -> None:
    tail = _opened(path)
    tail.skip()
    _add(path, b"\n0.1,x,1.0,true\n")

    damaged = tail.read(["a.x"])
    _add(path, b"0.2,1.0,1.0,true\n0.3,2.0,1.0,true\n")

    assert _known(damaged) == ([], [[]])  # and not None, which is the end of the file
    assert _known(tail.read(["a.x"])) == ([0.3], [[2.0]])
    tail.close()


def test_a_file_that_takes_the_name_is_noticed(path: Path) -> None:
    tail = _opened(path)
    before = tail.replaced
    other = path.with_name("other")
    other.write_bytes(HEADING)
    other.replace(path)

    assert not before
    assert tail.replaced
    tail.close()


@pytest.mark.parametrize("content", [b"", b"time", b"x,y\n1,2\n", b"\xff\xfe\n"])
def test_what_is_no_result_file_is_not_read(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "other.csv"
    path.write_bytes(content)

    assert followed(path) is None
    assert followed(tmp_path / "missing.csv") is None
