"""A long result is read, compared and drawn in pieces, with the same values as all at once, and in little memory."""

from __future__ import annotations

import random
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from msgspec.structs import replace
from numpy.typing import NDArray

import fmu_mesh
from fmu_mesh.api import result_reading
from fmu_mesh.api.result import Result
from fmu_mesh.api.result_reading import Columns
from fmu_mesh.pictures import drawing
from fmu_mesh.recorder.csv_file import NativeLines, python_lines

TEXTS = ["one, two", 'a "b"', "line\nbreak", "", "plain", "é"]
NUMBERS = [0.0, -0.0, np.nan, np.inf, -np.inf, 5e-324, 1.7976931348623157e308, 1 / 3, 0.1]


def columns_of(rows: int) -> dict[str, Any]:
    """Values of all kinds that a CSV tells apart."""
    return {
        "a.x": np.resize(NUMBERS, rows),
        "a.whole": np.arange(rows) + (1 << 62),
        "a.flag": np.arange(rows) % 3 == 0,
        "a.text": np.resize(np.array(TEXTS, object), rows),
        "a.late": np.where(np.arange(rows) < rows // 2, np.arange(rows), np.arange(rows) + 0.5),
    }


def written(path: Path, columns: dict[str, Any]) -> Path:
    """A CSV with these columns; `a.late` has whole numbers first."""
    rows = len(columns["a.x"])
    lines = python_lines([np.arange(rows) * 0.1, *columns.values()])
    path.write_bytes(f"time,{','.join(columns)}\n".encode() + lines.replace(b".0\n", b"\n"))
    return path


@pytest.mark.parametrize("size", [1, 7, 100, 4096])
def test_pieces_of_any_size_give_the_same_values(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, size: int) -> None:
    monkeypatch.setattr(result_reading, "_PIECE_BYTES", size)
    columns = columns_of(200)

    result = Result.read(written(tmp_path / "a.csv", columns))

    assert result.times.tobytes() == (np.arange(200) * 0.1).tobytes()
    for name, values in columns.items():
        assert result[name].dtype == values.dtype, name
        same = result[name].tolist() == values.tolist() if values.dtype == object else None
        assert same if same is not None else result[name].tobytes() == values.tobytes(), name


def made(chance: random.Random) -> Columns:
    """A short result with some of the values, and some of the times, of all others."""
    rows = chance.choice((0, 1, 5, 20, 40))
    columns = columns_of(40)
    times: NDArray[np.float64] = np.arange(40, dtype=np.float64) + chance.choice((0, 0, 0, 7))
    times = times * chance.choice((0.1, 0.1, 0.1, 0.2)) + chance.choice((0.0, 1e-9))
    if chance.random() < 0.5 and rows:
        columns["a.x"][chance.randrange(rows)] = chance.random()
        columns["a.text"][chance.randrange(rows)] = "other"
    if chance.random() < 0.2:
        columns["a.flag"] = np.array(["text"] * 40, object)
    return Columns(times[:rows], {name: values[:rows] for name, values in columns.items()})


class InPieces(Result):
    """A result that is read in pieces of some rows."""

    def _pieces(self) -> Iterator[Columns]:
        own, rows = self._columns, 7 if self.title == "one" else 3
        for first in range(0, max(1, len(own.times)), rows):
            part = slice(first, first + rows)
            yield Columns(own.times[part], {name: values[part] for name, values in own.values.items()})


def test_a_comparison_in_pieces_finds_what_one_of_arrays_finds() -> None:
    chance = random.Random(4)  # noqa: S311  no secret
    found = set()
    for _ in range(300):
        one, other = made(chance), made(chance)
        atol = chance.choice((0.0, 0.0, 0.5))

        whole = Result("one", columns=one).compare(Result("other", columns=other), atol=atol)
        pieces = InPieces("one", columns=one).compare(InPieces("other", columns=other), atol=atol)

        assert repr(replace(pieces, drawn=None)) == repr(replace(whole, drawn=None))
        found.add(whole.matching)
    assert found == {"same", "common", "interpolated"}


def test_a_thinned_result_has_the_extremes_and_the_gaps(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(drawing, "_KEPT", 30_000)
    values = np.sin(np.arange(200_000) * 1e-3)
    values[[77_777, 123_456]] = 9.0, -9.0
    values[50_000:60_000] = np.nan
    parts = [slice(first, first + 1000) for first in range(0, 200_000, 1000)]

    rows = drawing.thinned((Columns(np.arange(200_000.0)[part], {"a.x": values[part]}) for part in parts), ["a.x"])

    assert len(rows.times) < 40_000
    assert (np.diff(rows.times) > 0.0).all()
    assert np.nanmax(rows.values["a.x"]) == 9.0
    assert np.nanmin(rows.values["a.x"]) == -9.0
    assert np.isnan(rows.values["a.x"][(rows.times > 51_000) & (rows.times < 59_000)]).all()
    assert abs(rows.times[np.nanargmax(rows.values["a.x"])] - 77_777) < 50.0  # within its section


MEMORY = """
import sys
from fmu_mesh import Result
import fmu_mesh.cli.main, fmu_mesh.cli.plotting, matplotlib.figure
from matplotlib.backends import backend_agg

def peak():
    [line] = [line for line in open("/proc/self/status") if line.startswith("VmHWM")]
    return int(line.split()[1]) / 1024

before = peak()
if sys.argv[1] == "read":
    result = Result.read(sys.argv[2])
    assert len(result["a.y"]) == 1_000_000
else:
    assert fmu_mesh.cli.main.main(sys.argv[1:]) == 0
print(peak() - before)
"""


@pytest.mark.parametrize(("command", "most"), [("read", 60.0), ("compare", 60.0), ("plot", 120.0)])
def test_a_long_result_needs_little_memory(tmp_path: Path, command: str, most: float) -> None:
    path = tmp_path / "long.csv"
    lines, count = NativeLines(3, 50_000), 1_000_000
    with path.open("wb") as file:
        file.write(b"time,a.x,a.y\n")
        for first in range(0, count, 50_000):
            times = np.arange(first, first + 50_000) * 1e-3
            file.write(lines([times, np.sin(times), np.cos(times)]))
    others: dict[str, list[str | Path]] = {"read": [], "compare": [path], "plot": ["--output", tmp_path / "a.png"]}
    words: list[str | Path] = [command, path, *others[command]]

    printed = subprocess.run([sys.executable, "-c", MEMORY, *words], check=True, timeout=300, stdout=subprocess.PIPE)

    # The numbers have 23 MiB, and their text 52.
    assert float(printed.stdout.split()[-1]) < most


def test_a_file_that_was_not_read_is_compared_as_one_that_was(tmp_path: Path) -> None:
    one, other = (written(tmp_path / name, columns_of(50)) for name in ("a.csv", "b.csv"))
    other.write_bytes(other.read_bytes().replace(b"plain", b"other", 1))

    lazy = Result("a", file=one).compare(Result("b", file=other))
    read = fmu_mesh.Result.read(one).compare(fmu_mesh.Result.read(other))

    assert lazy.text == read.text
    assert not lazy
