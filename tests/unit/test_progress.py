"""The progress line: what matters most stays where there is no room for all."""

from __future__ import annotations

import pytest

from fmu_mesh.cli.output.progress import progress_parts
from fmu_mesh.simtime import ENDLESS, TimeGrid
from fmu_mesh.wire.views import MeshState, MeshStatus

GRID = TimeGrid(0.0, 0.01, 6000)
ENDLESS_GRID = TimeGrid(0.0, 0.01, ENDLESS)


def status(point: int, state: MeshState = "running", rate: float = 100.0) -> MeshStatus:
    return MeshStatus("demo", state, point, 6000, point * 0.01, rate, 0.01 * rate, {})


def test_it_tells_percent_stop_time_time_left_and_speed() -> None:
    assert progress_parts(GRID, status(1500), 80) == [
        "25 %",
        "15 of 60 s",
        "0:45 left",
        "100 points/s",
        "factor 1",
    ]


def test_without_a_stop_time_it_tells_what_is_known() -> None:
    assert progress_parts(ENDLESS_GRID, status(1500), 80) == ["15 s", "100 points/s", "factor 1"]


@pytest.mark.parametrize(("width", "parts"), [(41, 4), (40, 3), (30, 3), (20, 2), (10, 1), (3, 0)])
def test_what_does_not_fit_is_left_out_from_the_end(width: int, parts: int) -> None:
    shown = progress_parts(GRID, status(1500), width)

    assert len(shown) == parts
    assert len("  ".join(shown)) <= width


@pytest.mark.parametrize(
    ("rate", "left"),
    [(100.0, "0:45"), (1.0, "1:15:00"), (0.01, "5 d 5 h"), (1e6, "0:00")],
    ids=str,
)
def test_the_time_left_is_in_the_form_of_a_clock(rate: float, left: str) -> None:
    assert progress_parts(GRID, status(1500, rate=rate), 80)[2] == f"{left} left"


def test_a_mesh_that_rests_or_starts_has_no_time_left() -> None:
    assert progress_parts(GRID, status(1500, "paused"), 80)[2] == "paused"
    assert progress_parts(GRID, status(0, rate=0.0), 80) == ["0 %", "0 of 60 s", "0 points/s", "factor 0"]
    assert progress_parts(GRID, None, 80) == ["starting"]
    assert progress_parts(GRID, status(0, "initializing"), 80) == ["initializing"]
