"""The results of the two kept configurations against what is known on paper about pendulums and delays.

Both run in one process; that a distributed run gives the same floats is shown by the tests about equivalence. A
tolerance here is worked out from what causes it, where it is used.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from fmu_mesh.run.options import PlanOptions
from tests.fmus.reference import Pendulum, angle_after
from tests.plain_run import PlainRun
from tests.planning import prepare

CONFIGS = Path(__file__).resolve().parents[2] / "configs"
MAIN = "pendulum_delay"
CHAPTER = "chapter_library_example"
PENDULUMS = {MAIN: Pendulum(a=1.3, l=1.0, d=0.1), CHAPTER: Pendulum(a=1.3, l=2.0, d=0.001)}
DELAYS = {MAIN: 2.33, CHAPTER: 5.5}

both = pytest.mark.parametrize("name", [MAIN, CHAPTER])

Array = NDArray[np.float64]
Result = dict[str, Array]
Run = Callable[..., Result]


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Run:
    """Run a configuration with some start values changed, record all outputs, and return the columns by name."""
    folder = tmp_path_factory.mktemp("results")
    known: dict[tuple[str, ...], Result] = {}

    def result(name: str, *start_values: str) -> Result:
        key = (name, *start_values)
        if key not in known:
            output = folder / f"{len(known)}.csv"
            everything = ("record.variables=null",)
            options = PlanOptions(start_values=start_values, config_values=everything, output=output)
            PlainRun(prepare(CONFIGS / f"{name}.yaml", options)).run()
            known[key] = columns_of(output)
        return known[key]

    return result


def columns_of(path: Path) -> Result:
    with path.open(newline="") as file:
        header, *rows = csv.reader(file)
    table = np.array(rows, dtype=np.float64)
    return {name: table[:, column] for column, name in enumerate(header)}


def clock_rounding(result: Result) -> float:
    """How far rounding may move the time at which the delay reads its samples, in s.

    The ends of two steps, and the difference of one and the delay, are rounded to half a unit in the last place each;
    the communication points that they start from are products that are rounded, too.
    """
    return 4 * math.ulp(result["time"][-1])


# ---- the delay ----


@both
def test_the_delayed_angle_is_the_angle_that_many_steps_ago(run: Run, name: str) -> None:
    result = run(name)
    angle, delayed, time = result["pendulum.a"], result["delay.y"], result["time"]
    steps = round(DELAYS[name] / time[1])
    assert steps * time[1] == pytest.approx(DELAYS[name], rel=1e-15)  # a whole number of steps: no interpolation

    fastest = np.abs(result["pendulum.der(a)"]).max()

    # Times that are no binary fractions leave the delay a hair beside its sample, and the angle moves on meanwhile.
    # The last part is for the rounding of the interpolation itself: two differences, a quotient, a product and a sum.
    tolerance = fastest * clock_rounding(result) + 5 * math.ulp(np.abs(angle).max())
    assert np.abs(delayed[steps:] - angle[:-steps]).max() <= tolerance
    assert tolerance < 1e-12


@both
def test_before_the_delay_has_passed_the_delayed_angle_is_the_initial_one(run: Run, name: str) -> None:
    result = run(name)
    steps = round(DELAYS[name] / result["time"][1])

    assert set(result["delay.y"][:steps]) == {1.3}


@both
def test_a_delay_of_a_whole_number_of_steps_and_half_is_interpolated(run: Run, name: str) -> None:
    step_size = float(run(name)["time"][1])
    steps = round(DELAYS[name] / step_size)
    result = run(name, f"delay.d={DELAYS[name] + step_size / 2!r}")
    angle, delayed = result["pendulum.a"], result["delay.y"]

    middle = (angle[1:] + angle[:-1]) / 2

    fastest = np.abs(result["pendulum.der(a)"]).max()
    tolerance = fastest * clock_rounding(result) + 5 * math.ulp(np.abs(angle).max())  # as above
    assert np.abs(delayed[steps + 1 :] - middle[:-steps]).max() <= tolerance


def test_the_interpolated_angle_is_the_true_one_within_error_of_a_chord(run: Run) -> None:
    result = run(MAIN, "delay.d=2.331")
    time, delayed = result["time"], result["delay.y"]
    step_size = time[1]

    # A chord misses a curve by at most h^2/8 times its second derivative. The solver's own error is below 1e-10 rad
    # (docs/models/DampedPendulum.md), which is a thousandth of that.
    chord = step_size**2 / 8 * np.abs(result["pendulum.der(a,2)"]).max()
    for point in (2000, 7777, 13_332, 20_000):
        exact = angle_after(PENDULUMS[MAIN], time[point] - 2.331)
        assert abs(delayed[point] - exact) <= chord + 1e-10
    assert 1e-10 < chord < 1e-5


# ---- the pendulum ----


@both
def test_the_angle_is_that_of_the_exact_motion(run: Run, name: str) -> None:
    result = run(name)

    for point in (1, len(result["time"]) // 3, len(result["time"]) - 1):
        exact = angle_after(PENDULUMS[name], result["time"][point])
        # The solver's error that docs/models/DampedPendulum.md gives for 40 s, 2e-11 rad, with room for 60 s.
        assert abs(result["pendulum.a"][point] - exact) <= 1e-10


def energy_per_mass(result: Result, pendulum: Pendulum) -> Array:
    """Kinetic and potential energy per mass in J/kg, from 0 at rest."""
    angle, velocity = result["pendulum.a"], result["pendulum.der(a)"]
    # 2 sin^2 is 1 - cos without its cancellation near the rest position.
    energy: Array = (pendulum.l * velocity) ** 2 / 2 + pendulum.g * pendulum.l * 2 * np.sin(angle / 2) ** 2
    return energy


@both
def test_the_energy_of_a_damped_pendulum_falls_from_each_point_to_next(run: Run, name: str) -> None:
    energy = energy_per_mass(run(name), PENDULUMS[name])

    # No tolerance: even at a turning point a step loses d l^2 a''^2 h^3 / 12, which is above 1e-10 J/kg here; rounding
    # (1e-15) and the solver (1e-18 of the energy per internal step) are far below.
    assert (np.diff(energy) < 0.0).all()
    assert energy[-1] > 0.0


@both
def test_the_energy_that_is_gone_is_what_the_damper_took(run: Run, name: str) -> None:
    result, pendulum = run(name), PENDULUMS[name]
    energy = energy_per_mass(result, pendulum)
    power = pendulum.d * (pendulum.l * result["pendulum.der(a)"]) ** 2
    step_size = result["time"][1]

    lost = step_size * (power.sum() - (power[0] + power[-1]) / 2)  # trapezoidal rule

    # Its error is at most T h^2 / 12 times the second derivative of the power, here estimated by differences; a fifth
    # is added, because the true maximum may lie between two points.
    curvature = np.abs(np.diff(power, 2)).max() / step_size**2
    assert abs((energy[0] - energy[-1]) - lost) <= 1.2 * result["time"][-1] * step_size**2 / 12 * curvature
    assert lost > 0.0


def test_without_damping_the_energy_stays(run: Run) -> None:
    result = run(MAIN, "pendulum.d=0.0")

    energy = energy_per_mass(result, Pendulum(a=1.3, d=0.0))

    # The solver's error of 1e-10 rad and 1e-10 rad/s, times the steepest slopes of the energy, both below 10.
    assert np.abs(energy - energy[0]).max() <= 2e-9


@both
def test_a_small_oscillation_has_the_period_of_the_damped_harmonic_oscillator(run: Run, name: str) -> None:
    start_angle = 0.01
    result, pendulum = run(name, f"pendulum.a={start_angle}"), PENDULUMS[name]
    crossings = downward_crossings(result["time"], result["pendulum.a"])

    period = (crossings[-1] - crossings[0]) / (len(crossings) - 1)

    harmonic = 2 * math.pi / math.sqrt(pendulum.g / pendulum.l - pendulum.d**2 / 4)
    # A finite swing is slower by a^2/16, and damping makes it less. Near 0 the motion is straight: a chord misses a
    # crossing by less than the rounding of the period.
    assert 0.0 < period / harmonic - 1 <= start_angle**2 / 16 * 1.001
    assert len(crossings) > 15


def downward_crossings(time: Array, angle: Array) -> Array:
    """When the angle falls through 0, by a straight line between two points."""
    before = np.flatnonzero((angle[:-1] > 0.0) & (angle[1:] <= 0.0))
    part = angle[before] / (angle[before] - angle[before + 1])
    crossings: Array = time[before] + part * (time[before + 1] - time[before])
    return crossings
