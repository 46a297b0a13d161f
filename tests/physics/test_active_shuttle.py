"""The ActiveShuttle FMU: solutions on paper where friction is left out, a reference in numpy where it is not."""

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

MASS, YAW_INERTIA, TRAIL, TRACK, DRIVE_RADIUS = 200.0, 20.0, 0.03, 0.45, 0.08
CONSTANT, RESISTANCE, PROPORTIONAL, INTEGRAL = 0.06 * 20.0, 0.5, 20.0, 40.0
LOAD = 0.6 * MASS * 9.81 / 4
BORE_TORQUE = 2 / 3 * 0.89 * LOAD * 0.015
PIVOTS = np.array([[0.35, 0.2], [0.35, -0.2], [-0.35, 0.2], [-0.35, -0.2]])
NO_FRICTION = {"frictionCoefficient": 0.0, "rollingResistance": 0.0}
PLAIN = {**NO_FRICTION, "integralGain": 0.0}

ACCURACY = 1e-9
"""Relative, of the internal Runge-Kutta steps of 0.5 ms at the rates of the drives (about 80 1/s)."""


def run(unit: Unit, duration: float, step_size: float = 0.01) -> None:
    for point in range(round(duration / step_size)):
        unit.step(point * step_size, step_size)


@pytest.mark.parametrize(
    ("command", "velocity", "inertia"),
    [
        ("linearVelocityCommand", "linearVelocity", MASS),
        ("angularVelocityCommand", "angularVelocity", YAW_INERTIA / (TRACK / 2) ** 2),
    ],
)
def test_without_friction_a_velocity_is_approached_as_by_a_motor_with_mass(
    command: str, velocity: str, inertia: float, folder: Find
) -> None:
    gain = 2 * CONSTANT * (PROPORTIONAL + CONSTANT) / RESISTANCE / DRIVE_RADIUS**2  # N.s/m, of both drives

    with Unit(folder("ActiveShuttle")) as unit:
        unit.start({**PLAIN, command: 0.04})
        at_start = unit.real("currentRight")
        run(unit, 0.02)
        reached = unit.real(velocity)

    lever = 1.0 if velocity == "linearVelocity" else TRACK / 2
    wheel = 0.04 * lever / DRIVE_RADIUS
    assert at_start == pytest.approx((PROPORTIONAL + CONSTANT) * wheel / RESISTANCE, rel=1e-15)
    assert reached == pytest.approx(0.04 * -math.expm1(-gain / inertia * 0.02), rel=1e-6)


def test_the_voltage_and_with_it_the_current_is_limited(folder: Find) -> None:
    with Unit(folder("ActiveShuttle")) as unit:
        unit.start({"linearVelocityCommand": 5.0})

        assert unit.real("currentLeft") == unit.real("currentRight") == 24.0 / RESISTANCE


@pytest.mark.parametrize("speed", [0.5, -0.5])
def test_a_caster_behind_a_straight_motion_swings_as_the_tractrix(speed: float, folder: Find) -> None:
    start = {"linearVelocity": speed, "linearVelocityCommand": speed, "casterAngle[1]": 1.0, "casterAngle[4]": -2.0}

    with Unit(folder("ActiveShuttle")) as unit:
        unit.start({**PLAIN, **start})
        run(unit, 0.1)
        angles = [unit.real(f"casterAngle[{i}]") for i in (1, 4)]
        velocity = unit.real("linearVelocity")

    factor = math.exp(-speed * 0.1 / TRAIL)
    assert velocity == pytest.approx(speed, rel=1e-12)
    assert angles == pytest.approx([2 * math.atan(math.tan(a / 2) * factor) for a in (1.0, -2.0)], rel=1e-9)


def test_the_way_of_a_steady_curve_is_an_arc(folder: Find) -> None:
    start = {"linearVelocity": 0.4, "angularVelocity": 0.8, "linearVelocityCommand": 0.4, "angularVelocityCommand": 0.8}

    with Unit(folder("ActiveShuttle")) as unit:
        unit.start({**PLAIN, **start})
        run(unit, 2.0)
        x, y, heading = (unit.real(name) for name in ("x", "y", "heading"))

    assert (x, y) == pytest.approx((0.5 * math.sin(1.6), 0.5 * (1 - math.cos(1.6))), rel=ACCURACY)
    assert heading == pytest.approx(1.6, rel=ACCURACY)


def test_at_rest_the_casters_hold_against_the_torque_of_the_drives(
    folder: Find,
) -> None:
    """Straight casters, held drives and a slow turn: what the drives give is what the patches take."""
    start = {"angularVelocity": 0.02, "integralGain": 0.0, "rollingResistance": 0.0, "voltageLimit": 0.0}
    torque_constant = 1e-9  # the motors do not brake

    with Unit(folder("ActiveShuttle")) as unit:
        unit.start({**start, "torqueConstant": torque_constant})
        run(unit, 1e-6, 1e-6)
        lost = 0.02 - unit.real("angularVelocity")

    turning = 0.02 * 0.35 / TRAIL
    renewal = 0.02 * 0.2 / 0.015
    part = turning / math.sqrt(turning**2 + renewal**2 + 0.1**2)
    moment = 4 * BORE_TORQUE * part * 0.35 / TRAIL
    # The moment falls with the velocity, by up to 1e-3 in 1e-6 s.
    assert lost == pytest.approx(moment / YAW_INERTIA * 1e-6, rel=1e-3)


def test_without_motors_friction_takes_energy_at_every_point(folder: Find) -> None:
    start = {"angularVelocity": 1.0, "linearVelocity": 0.3, "torqueConstant": 1e-9, "voltageLimit": 0.0}

    with Unit(folder("ActiveShuttle")) as unit:
        unit.start(start)
        energies = []
        for point in range(100):
            unit.step(point * 0.01, 0.01)
            linear, angular = unit.real("linearVelocity"), unit.real("angularVelocity")
            energies.append((MASS * linear**2 + YAW_INERTIA * angular**2) / 2)

    assert (np.diff(energies) < 0.0).all()
    assert 0.0 < energies[-1] < 0.6 * energies[0]  # the way straight on costs little


# ---- a reference: virtual work with matrices, the explicit midpoint rule ----


def rate(z: Array, command: tuple[float, float]) -> Array:
    """Return dz/dt of z = linear, angular, four caster angles, two integrators (left, right)."""
    velocity, angles, integrators = z[:2], z[2:6], z[6:]
    wheels = np.array([[1.0, -TRACK / 2], [1.0, TRACK / 2]]) / DRIVE_RADIUS
    error = wheels @ (np.array(command) - velocity)
    voltage = np.clip(PROPORTIONAL * error + integrators + CONSTANT * wheels @ np.array(command), -24.0, 24.0)
    effort = wheels.T @ (CONSTANT * (voltage - CONSTANT * wheels @ velocity) / RESISTANCE)
    pivots = np.stack([np.column_stack([np.ones(4), -PIVOTS[:, 1]]), np.column_stack([np.zeros(4), PIVOTS[:, 0]])])
    ahead, left = np.stack([np.cos(angles), np.sin(angles)]), np.stack([-np.sin(angles), np.cos(angles)])
    rolls = np.einsum("ai,aij->ij", ahead, pivots)
    turns = np.einsum("ai,aij->ij", left, pivots) / TRAIL
    rolling, turning = rolls @ velocity, turns @ velocity
    bore = BORE_TORQUE * turning / np.linalg.norm([turning, rolling / 0.015, np.full(4, 0.1)], axis=0)
    effort -= turns.T @ bore + rolls.T @ (0.015 * LOAD * rolling / np.hypot(rolling, 0.01))
    return np.concatenate([effort / [MASS, YAW_INERTIA], turning - velocity[1], INTEGRAL * error])


def reference(command: Callable[[float], tuple[float, float]], points: int, step_size: float, substeps: int) -> Array:
    """Return the velocities and caster angles after each step."""
    z, rows, h = np.zeros(8), [], step_size / substeps
    for point in range(points):
        now = command((point + 1) * step_size)
        for _ in range(substeps):
            z = z + h * rate(z + h / 2 * rate(z, now), now)
        rows.append(z[:6])
    return np.array(rows)


def test_a_turn_from_standstill_is_that_of_the_reference(folder: Find) -> None:
    def command(time: float) -> tuple[float, float]:
        return 0.1 * time, 0.5 * time

    names = ("linearVelocity", "angularVelocity", *(f"casterAngle[{i}]" for i in range(1, 5)))
    with Unit(folder("ActiveShuttle")) as unit:
        unit.start()
        rows = []
        for point in range(80):
            linear, angular = command((point + 1) * 0.01)
            unit.set("linearVelocityCommand", linear)
            unit.set("angularVelocityCommand", angular)
            unit.step(point * 0.01, 0.01)
            rows.append([unit.real(name) for name in names])

    coarse, fine = reference(command, 80, 0.01, 20), reference(command, 80, 0.01, 40)
    # The midpoint rule is of second order, so the fine run is a third of the difference away from the solution.
    accuracy = np.abs(coarse - fine).max() / 3
    assert accuracy < 1e-5
    assert np.abs(np.array(rows) - fine).max() <= 1.5 * accuracy
    assert np.abs(np.array(rows)[-1, 2:]).max() > 1.0  # the casters have swung


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"mass": 0.0}, "mass is 0 but has to be finite and greater than 0"),
        ({"casterLoad": 1.5}, "casterLoad is 1.5 but has to be between 0 and 1"),
        ({"frictionCoefficient": math.nan}, "none may be negative"),
        ({"gripVelocity": 1e-9}, "these parameters move faster than 1e+06 1/s"),
    ],
)
def test_a_vehicle_that_cannot_be_solved_is_refused(values: dict[str, float], message: str, folder: Find) -> None:
    with Unit(folder("ActiveShuttle")) as unit:
        with pytest.raises(FMICallException):
            unit.start(values)

        assert message in unit.messages[-1].text
