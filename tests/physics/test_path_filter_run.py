"""`configs/path_filter.yaml`: what figure 18 of the chapter shows, as far as a fitted model can show it.

The peak without the filter is fitted to the 18 A of the chapter (docs/models/ActiveShuttle.md). That the filter takes
it down, more so with a greater slope speed, is not fitted.
"""

from __future__ import annotations

import csv
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from fmu_mesh.run.options import PlanOptions
from tests.plain_run import PlainRun
from tests.planning import prepare

CONFIG = Path(__file__).resolve().parents[2] / "configs" / "path_filter.yaml"

Array = NDArray[np.float64]
Peaks = Callable[[str, float], dict[str, float]]

TURN = (5.0, 10.0)
"""s; from the second motion's begin to the third's."""


@pytest.fixture(scope="module")
def columns(tmp_path_factory: pytest.TempPathFactory) -> Callable[[float], dict[str, Array]]:
    """Return the columns of a run with a slope speed (rad/s)."""
    folder = tmp_path_factory.mktemp("path_filter")

    def run(slope_speed: float) -> dict[str, Array]:
        output = folder / f"{slope_speed}.csv"
        if not output.exists():
            options = PlanOptions(start_values=(f"filter.slopeSpeed={slope_speed!r}",), output=output)
            PlainRun(prepare(CONFIG, options)).run()
        with output.open(newline="") as file:
            header, *rows = csv.reader(file)
        table = np.array(rows, dtype=np.float64)
        return {name: table[:, column] for column, name in enumerate(header)}

    return run


def peak_of_the_turn(columns: dict[str, Array], vehicle: str) -> float:
    """Return the greatest current (A) of either motor during the turn on the spot."""
    turning = (columns["time"] >= TURN[0]) & (columns["time"] < TURN[1])
    currents = [columns[f"{vehicle}.current{side}"][turning] for side in ("Left", "Right")]
    return float(np.abs(currents).max())


def test_the_peak_without_filter_is_18_ampere_that_it_is_fitted_to(
    columns: Callable[[float], dict[str, Array]],
) -> None:
    assert peak_of_the_turn(columns(4.0), "bare") == pytest.approx(18.0, abs=0.05)


def test_at_documented_slope_speed_peak_is_a_quarter_to_two_fifths_less(
    columns: Callable[[float], dict[str, Array]],
) -> None:
    bare, filtered = (peak_of_the_turn(columns(4.0), vehicle) for vehicle in ("bare", "filtered"))

    assert 0.25 <= 1 - filtered / bare <= 0.40


def test_the_peak_falls_with_the_slope_speed(columns: Callable[[float], dict[str, Array]]) -> None:
    peaks = [peak_of_the_turn(columns(slope_speed), "filtered") for slope_speed in (0.5, 1.0, 2.0, 4.0, 8.0, 16.0)]

    assert (np.diff(peaks) < 0.0).all()


def test_the_filter_changes_neither_the_way_forward_nor_the_last_standstill(
    columns: Callable[[float], dict[str, Array]],
) -> None:
    result = columns(4.0)
    forward = result["time"] < TURN[0]

    for side in ("Left", "Right"):
        bare, filtered = result[f"bare.current{side}"], result[f"filtered.current{side}"]
        # The filter's own arithmetic: a mean over four casters, rounded.
        np.testing.assert_allclose(filtered[forward], bare[forward], rtol=0, atol=1e-9)
        assert abs(filtered[-1]) < 0.5
