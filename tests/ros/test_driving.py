"""What an FMU does with the time of a ROS node: without ROS, at every nanosecond that matters.

`Gain` with k = 1 shows after each step what the step was given.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest

from fmu_mesh import FMIAdapter
from fmu_mesh.errors import CallRefused
from fmu_mesh.ros.node.driving import DriveSettings, FmuDriver
from tests.helpers import FMUS

UNIX_NS = 1_700_000_000_123_456_789
MS = 1_000_000


@pytest.fixture
def gain() -> Iterator[FmuDriver]:
    driver = FmuDriver(DriveSettings(fmu_path=FMUS / "Gain.fmu", step_size=0.1))
    driver.set_value("k", 1.0)
    yield driver
    driver.close()


def y(driver: FmuDriver, time: int, *, restart: bool = True) -> float:
    value = driver.update(time, ["y"], restart=restart).values["y"]
    assert isinstance(value, float)
    return value


def test_the_first_turn_is_time_zero_of_fmu_and_takes_no_step(gain: FmuDriver) -> None:
    turn = gain.update(UNIX_NS, ["y"], restart=True)

    assert (turn.time, turn.steps, turn.values) == (UNIX_NS, 0, {"y": 0.0})
    assert gain.started


def test_a_run_by_turns_gives_the_floats_of_a_loop_of_steps() -> None:
    with FMIAdapter(FMUS / "DampedPendulum.fmu") as pendulum:
        pendulum.exit_initialization_mode(0.0)
        angles = []
        for _ in range(200):
            pendulum.do_step()
            angles.append(pendulum.get_output_value("a"))
    driver = FmuDriver(DriveSettings(fmu_path=FMUS / "DampedPendulum.fmu"))
    try:
        driver.update(UNIX_NS, [], restart=True)
        turns = [driver.update(UNIX_NS + k * 2 * MS, ["a"], restart=True) for k in range(1, 201)]
    finally:
        driver.close()

    assert [turn.values["a"] for turn in turns] == angles
    assert [turn.time for turn in turns] == [UNIX_NS + k * 2 * MS for k in range(1, 201)]


def test_an_input_holds_from_its_stamp_and_the_last_equal_counts(gain: FmuDriver) -> None:
    y(gain, UNIX_NS)

    gain.set_input("u", UNIX_NS + 100 * MS, 1.0)
    gain.set_input("u", UNIX_NS + 100 * MS, 7.0)

    assert [y(gain, UNIX_NS + k * 100 * MS) for k in (1, 2)] == [0.0, 7.0]


def test_catching_up_is_bounded_and_told_and_skips_no_step() -> None:
    driver = FmuDriver(DriveSettings(fmu_path=FMUS / "Gain.fmu", step_size=0.1, max_steps=4))
    try:
        driver.update(1, [], restart=True)
        turns = [driver.update(1 + 1000 * MS, [], restart=True) for _ in range(4)]
    finally:
        driver.close()

    assert [turn.steps for turn in turns] == [4, 4, 2, 0]
    assert [round(turn.behind, 6) for turn in turns] == [0.6, 0.2, 0.0, 0.0]


def test_simulated_time_that_jumps_back_starts_the_fmu_again_with_its_values(gain: FmuDriver) -> None:
    y(gain, 5_000 * MS)
    gain.set_value("k", 3.0)
    gain.set_input("u", 5_000 * MS, 2.0)
    before = y(gain, 6_000 * MS)

    turn = gain.update(1_000 * MS, ["y"], restart=True)
    gain.set_input("u", 1_000 * MS, 4.0)

    assert before == 6.0
    assert (turn.time, turn.steps, turn.values["y"], turn.jumped_back) == (1_000 * MS, 0, 0.0, 5.0)
    assert y(gain, 1_100 * MS) == 12.0


def test_a_wall_clock_that_is_set_back_does_not_disturb_the_fmu(gain: FmuDriver) -> None:
    y(gain, UNIX_NS)
    gain.set_input("u", UNIX_NS, 2.0)
    y(gain, UNIX_NS + 1_000 * MS)

    turn = gain.update(UNIX_NS, ["y"], restart=False)

    assert (turn.time, turn.jumped_back, turn.values["y"]) == (UNIX_NS, 1.0, 2.0)
    assert gain.update(UNIX_NS + 300 * MS, ["y"], restart=False).steps == 3


def test_time_that_is_less_than_half_a_step_early_is_no_jump(gain: FmuDriver) -> None:
    y(gain, UNIX_NS)
    y(gain, UNIX_NS + 60 * MS)

    turn = gain.update(UNIX_NS + 55 * MS, [], restart=True)

    assert (turn.jumped_back, turn.steps, turn.time) == (0.0, 0, UNIX_NS + 100 * MS)


def test_a_pause_is_no_time_for_the_fmu(gain: FmuDriver) -> None:
    y(gain, UNIX_NS)
    y(gain, UNIX_NS + 200 * MS)

    gain.resume(UNIX_NS + 5_000 * MS)
    turn = gain.update(UNIX_NS + 5_100 * MS, [], restart=True)

    assert (turn.steps, turn.time, turn.jumped_back) == (1, UNIX_NS + 5_100 * MS, 0.0)


@pytest.mark.parametrize(("stop_time", "steps"), [(0.3, 3), (0.35, 3), (0.05, 0)])
def test_the_last_step_ends_at_the_stop_time_at_the_latest(stop_time: float, steps: int) -> None:
    driver = FmuDriver(DriveSettings(fmu_path=FMUS / "Gain.fmu", step_size=0.1, stop_time=stop_time))
    try:
        driver.update(UNIX_NS, [], restart=True)
        turn = driver.update(UNIX_NS + 10_000 * MS, [], restart=True)
        again = driver.update(UNIX_NS + 11_000 * MS, [], restart=True)
    finally:
        driver.close()

    assert (turn.steps, turn.ended, turn.behind, turn.time) == (steps, True, 0.0, UNIX_NS + steps * 100 * MS)
    assert (again.steps, again.ended) == (0, True)


def test_after_the_stop_time_a_new_start_is_from_the_beginning() -> None:
    driver = FmuDriver(DriveSettings(fmu_path=FMUS / "DampedPendulum.fmu", stop_time=0.1))
    try:
        first = driver.update(UNIX_NS, ["a"], restart=True)
        driver.update(UNIX_NS + 200 * MS, [], restart=True)
        driver.resume(UNIX_NS + 300 * MS)
        second = driver.update(UNIX_NS + 300 * MS, ["a"], restart=True)
    finally:
        driver.close()

    assert (second.values, second.steps, second.ended) == (first.values, 0, False)


def test_a_parameter_that_is_not_tunable_changes_before_the_start_only() -> None:
    driver = FmuDriver(DriveSettings(fmu_path=FMUS / "DampedPendulum.fmu"))
    try:
        driver.set_value("l", 2)
        driver.update(UNIX_NS, [], restart=True)
        with pytest.raises(CallRefused, match="this fixed parameter is not a tunable parameter"):
            driver.check_value("l", 3.0)
    finally:
        driver.close()


def test_nothing_is_left_behind(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    driver = FmuDriver(DriveSettings(fmu_path=FMUS / "Gain.fmu", step_size=0.1))
    driver.update(5_000 * MS, [], restart=True)
    driver.update(6_000 * MS, [], restart=True)
    driver.update(1_000 * MS, [], restart=True)
    assert len(list(tmp_path.iterdir())) == 1

    driver.close()

    assert list(tmp_path.iterdir()) == []
