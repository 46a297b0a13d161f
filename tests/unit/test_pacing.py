"""The wall clock of a run, with a clock of the test's own."""

from __future__ import annotations

import math
from pathlib import Path

import pytest

from fmu_mesh.master import pacing
from fmu_mesh.master.pacing import Pacer, Reach
from tests.helpers import write_config
from tests.planning import prepare

STEP_SIZE = 0.5


class Wall:
    """A clock that the test sets, in s."""

    def __init__(self) -> None:
        self.now = 100.0

    def perf_counter(self) -> float:
        return self.now


@pytest.fixture
def wall(monkeypatch: pytest.MonkeyPatch) -> Wall:
    clock = Wall()
    monkeypatch.setattr(pacing, "time", clock)
    return clock


def pacer(folder: Path, factor: float = 1.0, **simulation: float) -> Pacer:
    """A pacer that has been started, with steps of half a second."""
    plan = prepare(write_config(folder, stop_time=1000.0, simulation={"step_size": STEP_SIZE, **simulation}))
    made = Pacer(plan, factor)
    made.start(0)
    return made


def test_without_a_factor_nothing_is_held_back(tmp_path: Path, wall: Wall) -> None:
    assert pacer(tmp_path, 0.0).limit(1000, 0) == (1000, math.inf)
    assert wall.now == 100.0


def test_a_step_may_be_taken_when_wall_clock_is_at_its_start(tmp_path: Path, wall: Wall) -> None:
    paced = pacer(tmp_path, 2.0)

    assert paced.limit(1000, 0) == (1, 0.25)
    wall.now += 0.3
    allowed, pause = paced.limit(1000, 1)
    assert allowed == 2
    assert pause == pytest.approx(0.2)  # the clock of a test rounds as any other


def test_with_an_update_period_what_is_due_is_taken_together(tmp_path: Path, wall: Wall) -> None:
    paced = pacer(tmp_path, 1.0, update_period=2.0)

    assert paced.limit(1000, 0) == (1, 2.0)
    wall.now += 1.5
    assert paced.limit(1000, 1) == (1, 0.5)
    wall.now += 0.5
    assert paced.limit(1000, 1) == (5, 2.0)


def test_a_run_that_is_behind_catches_up_however_long_that_takes(tmp_path: Path, wall: Wall) -> None:
    paced = pacer(tmp_path, 1.0)
    wall.now += 100.0

    assert paced.limit(1000, 1)[0] == 201
    assert paced.overruns == 0


def test_with_a_bound_it_gives_up_what_it_lost_and_counts_it(tmp_path: Path, wall: Wall) -> None:
    paced = pacer(tmp_path, 1.0, catch_up=1.0)
    wall.now += 100.0  # 200 points, of which 3 may be left: two of one second, and the one that is on its way

    assert paced.limit(1000, 1)[0] == 1 + 3 + 1
    assert paced.overruns == 200 - 1 - 3
    wall.now += 1.0
    assert paced.limit(1000, 4)[0] == 7
    assert paced.overruns == 196


def test_a_run_that_keeps_up_has_no_overruns(tmp_path: Path, wall: Wall) -> None:
    paced = pacer(tmp_path, 1.0, catch_up=0.0, update_period=2.0)
    reached = 0

    for _ in range(100):
        wall.now += 0.4
        reached, _ = paced.limit(1000, reached)

    assert (reached, paced.overruns) == (81, 0)


@pytest.mark.parametrize(
    ("points_per_s", "expected"), [(10.0, 1024), (20_000.0, 1024), (50_000.0, 2500), (1_000_000.0, 50_000)]
)
def test_the_grant_reaches_50_ms_at_the_present_speed_or_1024_points(points_per_s: float, expected: int) -> None:
    reach = Reach(4096)
    reach.points(0, 1000.0)

    assert reach.points(round(points_per_s), 1001.0) == expected


def test_fast_start_is_not_held_up_until_speed_is_measured_next_time() -> None:
    reach = Reach(4096)

    assert reach.points(0, 1000.0) == 1024
    assert reach.points(511, 1000.001) == 1024
    assert reach.points(512, 1000.001) == 25_600  # in the last millisecond it took 512 points
    assert reach.points(512, 1000.012) == 1024


def test_a_small_window_is_always_used_as_a_whole() -> None:
    reach = Reach(16)

    assert [reach.points(point, 1000.0 + point) for point in range(5)] == [16] * 5
