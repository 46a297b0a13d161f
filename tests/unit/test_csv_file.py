"""The result file."""

from __future__ import annotations

import csv
import math
from contextlib import closing
from pathlib import Path
from resource import RLIMIT_FSIZE, getrlimit, setrlimit

import numpy as np
import pytest

from fmu_mesh.errors import ConfigurationError
from fmu_mesh.files import Kept
from fmu_mesh.results.csv_file import CsvFile
from fmu_mesh.variables.model_description import VariableType

COLUMNS: list[tuple[str, VariableType]] = [
    ("p.a", "Float64"),
    ("p.n", "Int32"),
    ("p.on", "Boolean"),
    ("p.e", "Enumeration"),
]


def write(path: Path, times: list[float], reals: list[float]) -> None:
    count = len(times)
    integers = np.arange(count, dtype=np.int32)
    with closing(CsvFile(path, COLUMNS)) as file:
        file.write(np.array(times), [np.array(reals), integers, integers % 2 == 1, integers + 10])
        assert file.rows == count


def test_a_row_is_time_and_values_as_short_as_they_read_back(tmp_path: Path) -> None:
    write(tmp_path / "a.csv", [0.0, 0.1, 1e-7, 1e15], [1.0, 0.1 + 0.2, -0.0, 5e-324])

    assert (tmp_path / "a.csv").read_text().splitlines() == [
        "time,p.a,p.n,p.on,p.e",
        "0.0,1.0,0,false,10",
        "0.1,0.30000000000000004,1,true,11",
        "1e-7,-0.0,2,false,12",
        "1000000000000000.0,5e-324,3,true,13",
    ]


def test_numbers_that_json_does_not_have_are_written_as_python_reads_them(tmp_path: Path) -> None:
    write(tmp_path / "a.csv", [0.0, 0.5, 1.0, 1.5], [math.nan, math.inf, -math.inf, 0.1])

    assert (tmp_path / "a.csv").read_text().splitlines()[1:] == [
        "0.0,nan,0,false,10",
        "0.5,inf,1,true,11",
        "1.0,-inf,2,false,12",
        "1.5,0.1,3,true,13",
    ]


@pytest.mark.parametrize("others", [[], [("p.n", "Int32")]])
def test_every_float_reads_back_exactly_and_is_as_short_as_repr(
    tmp_path: Path, others: list[tuple[str, VariableType]]
) -> None:
    bits = np.random.default_rng(1).integers(0, 2**64, size=(3, 5_000), dtype=np.uint64)
    reals = bits.view(np.float64)[:, np.isfinite(bits.view(np.float64)).all(axis=0)]
    times, a, b = np.hstack([reals, [[1e16], [1e22], [-1e-5]]])

    with closing(CsvFile(tmp_path / "a.csv", [("p.a", "Float64"), ("p.b", "Float64"), *others])) as file:
        file.write(times, [a, b, *(np.zeros(len(times), np.int32) for _ in others)])

    rows = [line.split(",") for line in (tmp_path / "a.csv").read_text().splitlines()[1:]]
    read = np.array([[float(text) for text in row[:3]] for row in rows])
    assert read.tobytes() == np.stack([times, a, b], axis=1).tobytes()
    # Exponents may have a sign or not, and numbers below 1e-4 none at all.
    assert all(len(text) <= len(repr(float(text))) + 2 for row in rows for text in row[:3])


def test_a_name_with_a_comma_is_quoted(tmp_path: Path) -> None:
    with closing(CsvFile(tmp_path / "a.csv", [("p.der(a,2)", "Float64"), ('p."x"', "Float64")])) as file:
        file.write(np.array([0.0]), [np.array([1.0]), np.array([2.0])])

    with (tmp_path / "a.csv").open(newline="") as written:
        assert next(csv.reader(written)) == ["time", "p.der(a,2)", 'p."x"']


def test_many_rows_at_once_are_all_written(tmp_path: Path) -> None:
    times = [0.01 * point for point in range(2000)]

    write(tmp_path / "a.csv", times, times)

    lines = (tmp_path / "a.csv").read_text().splitlines()[1:]
    assert [float(line.split(",")[0]) for line in lines] == times


def test_a_result_may_hold_the_time_only(tmp_path: Path) -> None:
    with closing(CsvFile(tmp_path / "a.csv", [])) as file:
        file.write(np.array([0.0, 0.5]), [])

    assert (tmp_path / "a.csv").read_text() == "time\n0.0\n0.5\n"


def test_the_folder_is_made_and_an_older_file_is_replaced(tmp_path: Path) -> None:
    path = tmp_path / "results" / "new" / "a.csv"
    write(path, [0.0, 1.0], [0.0, 1.0])

    write(path, [0.0], [0.0])

    assert len(path.read_text().splitlines()) == 2


def test_what_was_written_survives_the_end_of_the_process(tmp_path: Path) -> None:
    with closing(CsvFile(tmp_path / "a.csv", [])) as file:
        file.write(np.array([0.0]), [])
        assert (tmp_path / "a.csv").read_text() == "time\n0.0\n"


def test_a_file_that_cannot_be_written_is_an_error_that_says_so(tmp_path: Path) -> None:
    with pytest.raises(ConfigurationError, match=r"the result file '.*' cannot be written: Is a directory"):
        CsvFile(tmp_path, [])
    (tmp_path / "file").touch()
    with pytest.raises(ConfigurationError, match=r"cannot be written: (Not a directory|File exists)"):
        CsvFile(tmp_path / "file" / "a.csv", [])


def test_text_is_quoted_and_binary_is_base64(tmp_path: Path) -> None:
    columns: list[tuple[str, VariableType]] = [("s", "String"), ("b", "Binary"), ("n", "UInt64"), ("on", "Boolean")]
    texts = np.array(['a "b", c', "two\nlines", "[1]"], dtype=np.object_)
    data = np.array([b"", b"\xff\0", b"abc"], dtype=np.object_)
    numbers = np.array([2**64 - 1, 0, 1], dtype=np.uint64)

    with closing(CsvFile(tmp_path / "a.csv", columns)) as file:
        file.write(np.array([0.0, 0.1, math.inf]), [texts, data, numbers, numbers == 0])

    with (tmp_path / "a.csv").open(newline="") as written:
        assert list(csv.reader(written))[1:] == [
            ["0.0", 'a "b", c', "", "18446744073709551615", "false"],
            ["0.1", "two\nlines", "/wA=", "0", "true"],
            ["inf", "[1]", "YWJj", "1", "false"],
        ]


def test_until_the_first_row_nothing_changes(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    with closing(CsvFile(path, [])) as file:
        file.flush()
        assert not path.exists()
    assert list(tmp_path.iterdir()) == []

    path.write_text("an older result")
    with closing(CsvFile(path, [])) as file:
        file.flush()
    assert path.read_text() == "an older result"


def test_every_look_at_the_file_while_it_is_written_shows_whole_rows(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    with closing(CsvFile(path, COLUMNS)) as file:
        for _ in range(40):
            numbers = np.arange(700, dtype=np.int32)
            file.write(numbers / 3, [numbers / 7, numbers, numbers % 2 == 1, numbers])
            if file.kept.rows:
                text = path.read_text()
                assert (text.count("\n") - 1, len(text)) == file.kept
                assert text.endswith("\n")
        assert file.kept.rows > 0


def test_after_a_full_disk_a_file_ends_with_a_complete_row(
    tmp_path: Path,
) -> None:
    """The limit for the size of a file is the disk that a test can fill."""
    path = tmp_path / "a.csv"
    times = np.arange(20_000) / 7
    before = getrlimit(RLIMIT_FSIZE)
    file = CsvFile(path, [])
    try:
        setrlimit(RLIMIT_FSIZE, (100_000, before[1]))
        with pytest.raises(OSError, match="too large"):
            file.write(times, [])
    finally:
        setrlimit(RLIMIT_FSIZE, before)
    with pytest.raises(OSError, match="too large"):
        file.write(times[:1], [])
    file.close()

    lines = path.read_text().splitlines(keepends=True)
    assert len(lines) > 4000
    assert [float(line) for line in lines[1:]] == times[: len(lines) - 1].tolist()
    assert lines[-1].endswith("\n")
    assert file.rows == len(lines) - 1


@pytest.mark.parametrize(
    ("text", "kept", "rows", "left"),
    [
        ("time,a\n0.0,1\n0.1,2\n", Kept(), 2, "time,a\n0.0,1\n0.1,2\n"),
        ("time,a\n0.0,1\n0.1,", Kept(), 1, "time,a\n0.0,1\n"),
        ('time,a\n0.0,"two\nlines"\n0.1,"two\nli', Kept(), 1, 'time,a\n0.0,"two\nlines"\n'),
        ('time,a\n0.0,"say ""a\nb"""\n0.1,""\n0.2,"""', Kept(), 2, 'time,a\n0.0,"say ""a\nb"""\n0.1,""\n'),
        ('"time\n', Kept(), 0, ""),
        ("time,a\n0.", Kept(), 0, ""),
        ("", Kept(), 0, ""),
        ("time,a\n0.0,1\n0.1,2\n0.", Kept(1, 13), 2, "time,a\n0.0,1\n0.1,2\n"),
        ("time,a\n0.0,1\n", Kept(1, 13), 1, "time,a\n0.0,1\n"),
    ],
)
def test_a_file_is_cut_after_its_last_whole_row(tmp_path: Path, text: str, kept: Kept, rows: int, left: str) -> None:
    path = tmp_path / "a.csv"
    path.write_text(text)

    assert CsvFile.keep_whole_rows(path, kept) == rows

    assert path.read_text() == left
