"""The curves of a result file: each row once, and gaps only where rows were left out."""

from __future__ import annotations

from pathlib import Path

import pytest

from fmu_mesh.dashboard import result_source
from fmu_mesh.dashboard.curve import BoundedCurve
from fmu_mesh.dashboard.result_source import ResultSource


def _write(path: Path, first: int, last: int) -> None:
    with path.open("a") as file:
        file.write("".join(f"{time}.0,{time}.5,1\n" for time in range(first, last)))


@pytest.fixture
def path(tmp_path: Path) -> Path:
    path = tmp_path / "result.csv"
    path.write_text("time,a.x,a.y\n", encoding="utf-8")
    return path


def _known(curve: BoundedCurve) -> tuple[list[float], list[int]]:
    """The times of all values, and the intervals that no line leaves."""
    change = curve.since(0)
    return sorted(change.t_low), sorted(change.gaps)


def test_a_row_of_which_a_part_was_there_is_not_lost(path: Path) -> None:
    _write(path, 0, 5)
    with path.open("a") as file:
        file.write("5.0,5.")
    curves = {"a.x": BoundedCurve(0.0, 1.0)}
    source = ResultSource(path)

    source.read(lambda: curves, lambda: None)
    with path.open("a") as file:
        file.write("5,1\n")
    _write(path, 6, 9)
    source.read(lambda: curves, lambda: None)

    assert _known(curves["a.x"]) == ([float(time) for time in range(9)], [8])
    source.close()


def test_a_curve_that_is_chosen_later_has_no_gap(path: Path) -> None:
    curves = {"a.x": BoundedCurve(0.0, 1.0)}
    source = ResultSource(path)

    for look in range(6):
        _write(path, 10 * look, 10 * look + 10)
        if look == 3:
            curves["a.y"] = BoundedCurve(0.0, 1.0)
        source.read(lambda: curves, lambda: None)

    times = [float(time) for time in range(60)]
    assert [_known(curve) for curve in curves.values()] == [(times, [59])] * 2
    source.close()


def test_rows_that_are_left_out_are_a_gap(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    _write(path, 0, 10)
    curves = {"a.x": BoundedCurve(0.0, 1.0)}
    source = ResultSource(path)
    source.read(lambda: curves, lambda: None)
    monkeypatch.setattr(result_source, "_FAR_BEHIND", 10)

    _write(path, 10, 20)
    source.read(lambda: curves, lambda: None)
    monkeypatch.undo()
    _write(path, 20, 30)
    source.read(lambda: curves, lambda: None)

    assert _known(curves["a.x"])[1] == [9, 29]
    source.close()
