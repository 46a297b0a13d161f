"""The wall clock of a run, with a clock of the test's own."""

from __future__ import annotations

import math
from pathlib import Path

import pytest

from fmu_mesh.master import pacing
from fmu_mesh.master.granting import Granting
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


@pytest.mark.parametrize("round_trip_s", [0.0, 0.05, 0.2])
@pytest.mark.parametrize("points_per_s", [2.0, 30.0, 1_000.0, 5_000_000.0])
def test_the_grant_reaches_50_ms_and_one_round_trip(points_per_s: float, round_trip_s: float) -> None:
    reach, granted, stood = Reach(), [0], 0.0
    for tick in range(3000):  # of 1 ms; what they have heard by now, the master has granted a round trip ago
        granted.append(int(stood) + reach.points(int(stood), 1000.0 + tick / 1000, round_trip_s))
        heard = max(granted[: max(1, len(granted) - round(round_trip_s * 1000))])
        stood = min(heard, stood + points_per_s / 1000)

    aim = points_per_s * (0.05 + round_trip_s)
    assert granted[1] == 1
    assert granted[-1] - int(stood) == pytest.approx(aim, rel=0.5, abs=1.0)  # the clock has ticks of 1 ms


def test_a_fast_start_over_a_far_link_takes_five_round_trips() -> None:
    reach, slowest, now = Reach(), 0, 1000.0

    for _ in range(5):
        slowest += reach.points(slowest, now, 0.05)
        now += 0.05 + 0.005  # they need less than 5 ms, and nobody knows how much less

    assert reach.points(slowest, now, 0.05) > 100_000


def test_a_grant_that_is_used_late_is_halved() -> None:
    reach = Reach()
    fast = [reach.points(round(1e6 * (now - 1000.0)), now, 0.0) for now in (1000.0, 1000.001, 1000.002)]

    assert [reach.points(2001, now, 0.0) for now in (1000.2, 1000.203)] == [fast[-1], fast[-1] // 2]


def test_fast_instances_are_at_most_a_second_ahead_of_a_slow_one(tmp_path: Path) -> None:
    granting = Granting(prepare(write_config(tmp_path, stop_time=1e6)))
    ahead = []
    for point in range(1000):  # 100 points/s; a pause takes effect where the fast ones are
        granting.take((node, point) for node in granting.progress)
        granting.raise_to(granting.led(1_000_000, 1000.0 + point / 100))
        ahead.append(granting.grant - point)

    assert ahead[0] <= 2
    assert 50 <= min(ahead[100:]) <= max(ahead) <= 101
