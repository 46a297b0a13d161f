"""The PathFilter FMU against equations 1 and 2 of the chapter, and against a reference of its own in numpy."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from fmpy.fmi1 import FMICallException
from numpy.typing import NDArray

from tests.fmus.harness import Unit

Find = Callable[[str], Path]
Array = NDArray[np.float64]
Command = Callable[[float], tuple[float, float]]

TRAIL, WHEEL_RADIUS, SLOPE_SPEED, TIME_CONSTANT = 0.03, 0.05, 4.0, 0.05
PIVOTS = np.array([0.35 + 0.2j, 0.35 - 0.2j, -0.35 + 0.2j, -0.35 - 0.2j])
"""m, forward + 1j * left."""
RADIUS = abs(PIVOTS[0])

LEAST_SQUARES = np.linalg.pinv(
    np.block([[np.ones((4, 1)), -PIVOTS.imag[:, None]], [np.zeros((4, 1)), PIVOTS.real[:, None]]])
)
"""From the velocities of the pivots (four forward, four left) to the vehicle's forward and angular velocity."""


def filtered(unit: Unit) -> tuple[float, float]:
    return unit.real("filteredLinearVelocity"), unit.real("filteredAngularVelocity")


def drive(unit: Unit, command: Command, duration: float, step_size: float = 0.01) -> Array:
    """Hold the command of the end of each step, as Gauss-Seidel does; return the filtered one after each."""
    rows = []
    for point in range(round(duration / step_size)):
        linear, angular = command((point + 1) * step_size)
        unit.set("linearVelocity", linear)
        unit.set("angularVelocity", angular)
        unit.step(point * step_size, step_size)
        rows.append(filtered(unit))
    return np.array(rows)


def test_a_turn_from_standstill_begins_in_the_direction_of_the_casters(folder: Find) -> None:
    with Unit(folder("PathFilter")) as unit:
        unit.start({"angularVelocity": 0.5})

        linear, angular = filtered(unit)

    assert linear == pytest.approx(0.5 * RADIUS, rel=1e-15)  # all casters at the speed that the turn gives them
    assert angular == pytest.approx(0.0, abs=1e-16)


@pytest.mark.parametrize(("k", "velocity"), [(0.25, 1.0), (0.75, 3.0), (1.0, 4.0), (1.0, 100.0)])
def test_one_caster_in_a_row_is_corrected_by_equations_1_and_2(k: float, velocity: float, folder: Find) -> None:
    # With all pivots nearly on one spot ahead, a turn asks all casters for 90 degrees at once.
    casters = {f"casterVelocity[{i}]": velocity for i in range(1, 5)}
    start = {"halfWidth": 1e-9, "angularVelocity": 1.0, **casters}

    with Unit(folder("PathFilter")) as unit:
        unit.start(start)
        linear, angular = filtered(unit)

    # Front and rear casters turn to opposite sides: their forward parts add up, their lateral ones make the turn.
    assert linear == pytest.approx(0.35 * math.cos(k * math.pi / 2), abs=1e-8)
    assert angular == pytest.approx(math.sin(k * math.pi / 2), abs=1e-8)


@pytest.mark.parametrize("speed", [0.5, -0.5])
def test_straight_motions_of_straight_casters_pass_unchanged(speed: float, folder: Find) -> None:
    with Unit(folder("PathFilter")) as unit:
        unit.start()
        rows = drive(unit, lambda time: (min(1.0, time) * speed, 0.0), 2.0)

    np.testing.assert_allclose(rows[:, 0], [min(1.0, (i + 1) * 0.01) * speed for i in range(200)], rtol=1e-15)
    assert (np.abs(rows[:, 1]) < 1e-16).all()


@pytest.mark.parametrize("command", [(0.0, 1.0), (0.0, -0.7), (0.4, 0.6), (-0.3, 0.2)])
def test_a_command_that_lasts_is_followed_in_the_end(command: tuple[float, float], folder: Find) -> None:
    with Unit(folder("PathFilter")) as unit:
        unit.start()
        rows = drive(unit, lambda _time: command, 4.0)
        angles = np.array([unit.real(f"casterAngle[{i}]") for i in range(1, 5)])

    pivots = command[0] + 1j * command[1] * PIVOTS
    np.testing.assert_allclose(rows[-1], command, rtol=1e-12, atol=1e-12)
    # At rest relative to the vehicle, a caster trails behind its pivot: sin(angle - direction) = trail turn / speed.
    lag = np.arcsin(-TRAIL * command[1] / np.abs(pivots))
    np.testing.assert_allclose(np.exp(1j * angles), pivots / np.abs(pivots) * np.exp(1j * lag), atol=1e-9)


def test_a_stop_stops(folder: Find) -> None:
    with Unit(folder("PathFilter")) as unit:
        unit.start()
        drive(unit, lambda _time: (0.3, 0.5), 0.2)
        unit.set("linearVelocity", 0.0)
        unit.set("angularVelocity", 0.0)
        unit.step(0.2, 0.01)

        assert filtered(unit) == (0.0, 0.0)


class Reference:
    """The filter with complex velocities, a pseudoinverse and the explicit midpoint rule."""

    def __init__(self) -> None:
        self.angle = np.zeros(4)
        self.reached = np.zeros(4)
        self.direction = 1.0

    def filter(self, command: tuple[float, float], angle: Array, reached: Array) -> tuple[float, float]:
        wanted = self.direction * (command[0] + 1j * command[1] * PIVOTS)
        k = np.minimum(1.0, reached / SLOPE_SPEED)
        turned = np.exp(1j * (angle + k * np.angle(wanted * np.exp(-1j * angle))))
        velocity = self.direction * np.abs(wanted) * turned
        linear, angular = LEAST_SQUARES @ np.concatenate([velocity.real, velocity.imag])
        return float(linear), float(angular)

    def rate(self, command: tuple[float, float], angle: Array, reached: Array) -> tuple[Array, Array]:
        linear, angular = self.filter(command, angle, reached)
        local = (linear + 1j * angular * PIVOTS) * np.exp(-1j * angle)
        rise = (np.abs(local.real) / WHEEL_RADIUS - reached) / TIME_CONSTANT
        if command == (0.0, 0.0):
            return local.imag / TRAIL - angular, -reached / TIME_CONSTANT
        return local.imag / TRAIL - angular, np.maximum(rise, 0.0)

    def run(self, command: Command, duration: float, step_size: float, substeps: int) -> Array:
        rows, before = [], (0.0, 0.0)
        for point in range(round(duration / step_size)):
            now = command((point + 1) * step_size)
            if before == (0.0, 0.0):
                rolling = (now[0] + 1j * now[1] * PIVOTS) * np.exp(-1j * self.angle)
                self.direction = -1.0 if rolling.real.sum() < -np.abs(rolling).sum() / 2 else 1.0
            before, h = now, step_size / substeps
            for _ in range(substeps):
                angle_rate, rise = self.rate(now, self.angle, self.reached)
                middle = self.angle + h / 2 * angle_rate, self.reached + h / 2 * rise
                angle_rate, rise = self.rate(now, *middle)
                self.angle, self.reached = self.angle + h * angle_rate, self.reached + h * rise
            rows.append(self.filter(now, self.angle, self.reached))
        return np.array(rows)


def forward_stop_turn_stop_backward(time: float) -> tuple[float, float]:
    """0.1 s of standstill between motions of 0.5 s."""
    phase, within = divmod(time, 0.6)
    ramp = max(0.0, min(within, 0.5 - within))
    return {0: (2.0 * ramp, 0.0), 1: (0.0, 3.0 * ramp), 2: (-1.5 * ramp, 0.3 * ramp)}.get(int(phase), (0.0, 0.0))


def test_the_filter_is_that_of_the_reference_through_a_whole_profile(folder: Find) -> None:
    with Unit(folder("PathFilter")) as unit:
        rows = drive(unit.start(), forward_stop_turn_stop_backward, 1.8)

    coarse = Reference().run(forward_stop_turn_stop_backward, 1.8, 0.01, 10)
    fine = Reference().run(forward_stop_turn_stop_backward, 1.8, 0.01, 20)
    # The midpoint rule is of second order, so the fine run is a third of the difference away from the solution; min
    # and max make corners, for which twice of that is allowed.
    accuracy = 2 * np.abs(coarse - fine).max() / 3
    assert accuracy < 2e-4
    assert np.abs(rows - fine).max() <= accuracy
    assert np.abs(rows).max() > 0.3


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"slopeSpeed": 0.0}, "slopeSpeed is 0 but has to be finite and greater than 0"),
        ({"trail": math.nan}, "trail is "),
        ({"timeConstant": 1e-4}, "timeConstant is 0.0001 s but has to be 0.001 s or more"),
    ],
)
def test_a_filter_that_cannot_be_solved_is_refused(values: dict[str, float], message: str, folder: Find) -> None:
    with Unit(folder("PathFilter")) as unit:
        with pytest.raises(FMICallException):
            unit.start(values)

        assert message in unit.messages[-1].text
