"""The SimpleElectricalActuator FMU against the solution of its equation, and in a loop against linear algebra."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from fmpy.fmi1 import FMICallException
from numpy.typing import NDArray

from tests.fmus.harness import VARYING_STEPS, Unit

Find = Callable[[str], Path]
Array = NDArray[np.float64]

ROTOR_INERTIA, GEAR, DAMPING = 1e-5, 100.0, 0.25
JOINT_INERTIA, JOINT_DAMPING = 1.001, 0.1
"""1 kg at 1 m with 0.001 kg m2 of its own, and the damping of the joint (the chapter's world)."""
DURATION = 12.0
"""s; the slowest loop has its peak before."""


@dataclass(frozen=True)
class Motor:
    """The motor with held voltage (V) and joint velocity (rad/s): its final speed, its rate, and what follows."""

    constant: float
    voltage: float
    joint_velocity: float

    def velocity_after(self, duration: float) -> float:
        """Return the rotor's velocity (rad/s) that long (s) after standstill."""
        gain = self.constant**2 + DAMPING / GEAR**2
        final = (self.constant * self.voltage + DAMPING * self.joint_velocity / GEAR) / gain
        return final * -math.expm1(-gain / ROTOR_INERTIA * duration)

    def torque_after(self, duration: float) -> float:
        return DAMPING * (self.velocity_after(duration) / GEAR - self.joint_velocity)


@pytest.mark.parametrize("steps", [1, 7, 1000])
@pytest.mark.parametrize("constant", [0.1, 1e-3])
def test_with_held_inputs_the_motor_follows_the_exponential_at_any_step_size(
    constant: float, steps: int, folder: Find
) -> None:
    motor, duration = Motor(constant, voltage=12.0, joint_velocity=0.4), 2e-3

    with Unit(folder("SimpleElectricalActuator")) as unit:
        unit.start({"motorConstant": constant, "actuatorInput": motor.voltage, "jointVelocity": motor.joint_velocity})
        for point in range(steps):
            unit.step(point * duration / steps, duration / steps)

        # Each step is rounded a few times, and errors decay; 4 per step is far above what comes together.
        rel = 4 * steps * 2**-53
        assert unit.real("motorVelocity") == pytest.approx(motor.velocity_after(duration), rel=rel)
        assert unit.real("jointTorque") == pytest.approx(motor.torque_after(duration), rel=1e-12)
        back_emf = constant * motor.velocity_after(duration)
        assert unit.real("motorCurrent") == pytest.approx(motor.voltage - back_emf, rel=1e-12)


@pytest.mark.parametrize(("asked", "given"), [(1e6, 48.0), (-60.0, -48.0), (48.0, 48.0), (47.9, 47.9)])
def test_the_voltage_is_limited(asked: float, given: float, folder: Find) -> None:
    with Unit(folder("SimpleElectricalActuator")) as unit:
        unit.start({"actuatorInput": asked})

        assert unit.real("motorCurrent") == given / 1.0


def test_the_damper_is_in_series_so_a_stalled_motor_brakes_the_joint(folder: Find) -> None:
    with Unit(folder("SimpleElectricalActuator")) as unit:
        unit.start({"jointVelocity": 1.0})
        at_start = unit.real("jointTorque")
        unit.step(0.0, 1.0)

        # The motor is dragged along by the damper's torque over the gear, and its short circuit holds against it.
        dragged = (DAMPING / GEAR) / (0.1**2 + DAMPING / GEAR**2)
        assert at_start == -0.25
        assert unit.real("motorVelocity") == pytest.approx(dragged, rel=1e-14)
        assert unit.real("jointTorque") == pytest.approx(DAMPING * (dragged / GEAR - 1.0), rel=1e-14)


def closed_loop(proportional: float, derivative: float, constant: float) -> tuple[Array, Array]:
    """Return A and b of z' = A z + b for joint, motor and a position controller with target 1 rad.

    z is joint angle, joint velocity and motor velocity. The voltage stays within its limits.
    """
    a = np.zeros((3, 3))
    a[0, 1] = 1.0
    a[1, 1:] = np.array([-(DAMPING + JOINT_DAMPING), DAMPING / GEAR]) / JOINT_INERTIA
    a[2] = np.array([-constant * proportional, -constant * derivative + DAMPING / GEAR, 0.0]) / ROTOR_INERTIA
    a[2, 2] = -(constant**2 + DAMPING / GEAR**2) / ROTOR_INERTIA
    return a, np.array([0.0, 0.0, constant * proportional / ROTOR_INERTIA])


def exact_angles(proportional: float, derivative: float, constant: float, times: Array) -> Array:
    """Return the angle (rad) of the continuous closed loop from rest, by eigenvalues."""
    a, b = closed_loop(proportional, derivative, constant)
    values, vectors = np.linalg.eig(a)
    rest = np.linalg.solve(a, -b)
    parts = np.linalg.solve(vectors, -rest.astype(complex))
    angles: Array = (rest[0] + (vectors[0] * parts * np.exp(np.outer(times, values))).sum(axis=1)).real
    return angles


def seconds(step_size: float) -> Array:
    """Return the times (s) at the ends of the steps."""
    return np.linspace(step_size, DURATION, round(DURATION / step_size))


@pytest.mark.parametrize(
    ("proportional", "derivative", "constant", "peak"),
    [(10.0, 3.0, 0.1, 1.229), (10.0, 3.0, 1e-3, 1.861)],
)
def test_the_angle_of_a_position_loop_is_of_first_order(
    proportional: float, derivative: float, constant: float, peak: float, folder: Find
) -> None:
    errors = []
    for step_size in (2e-3, 1e-3):
        angles = simulated_angles(folder, proportional, derivative, constant, step_size)
        exact = exact_angles(proportional, derivative, constant, seconds(step_size))
        assert exact.max() == pytest.approx(peak, abs=5e-4)  # as printed, with three decimals
        errors.append(float(np.abs(angles - exact).max()))

    assert errors[1] < 3e-3  # the co-simulation's error: torque and voltage are held over a step
    assert 1.8 < errors[0] / errors[1] < 2.2  # and of first order


@pytest.mark.parametrize(("constant", "peak"), [(0.1, 1.113), (1e-3, 1.262)])
def test_gains_that_reach_the_limits_of_the_voltage_give_the_known_peak(
    constant: float, peak: float, folder: Find
) -> None:
    angles = simulated_angles(folder, 109.0, 60.0, constant, 1e-3)

    assert angles.max() == pytest.approx(peak, abs=5e-4)  # as printed, with three decimals
    # Without the limits the loop would be another one.
    assert abs(exact_angles(109.0, 60.0, constant, seconds(1e-3)).max() - peak) > 5e-3


def simulated_angles(folder: Find, proportional: float, derivative: float, constant: float, step_size: float) -> Array:
    """Return the angle after each step of a joint that the FMU drives, by the semi-implicit Euler method."""
    angle = velocity = 0.0
    angles = []
    with Unit(folder("SimpleElectricalActuator")) as unit:
        unit.start({"motorConstant": constant})
        inputs = [unit.reference("actuatorInput"), unit.reference("jointVelocity")]
        output = [unit.reference("jointTorque")]
        for point in range(round(DURATION / step_size)):
            unit.fmi.setReal(inputs, [proportional * (1.0 - angle) - derivative * velocity, velocity])
            unit.step(point * step_size, step_size)
            (torque,) = unit.fmi.getReal(output)
            velocity += step_size * (torque - JOINT_DAMPING * velocity) / JOINT_INERTIA
            angle += step_size * velocity
            angles.append(angle)
    return np.array(angles)


def test_without_motor_constant_and_damping_the_motor_stands_still(folder: Find) -> None:
    with Unit(folder("SimpleElectricalActuator")) as unit:
        rows = unit.start({"motorConstant": 0.0, "damping": 0.0}).run(VARYING_STEPS[:20])

    assert {row["motorVelocity"] for row in rows} == {0.0}


@pytest.mark.parametrize(
    ("values", "expected"),
    [
        ({"voltageLimit": -1.0}, "voltageLimit is -1 V but must not be negative"),
        ({"resistance": 0.0}, "resistance is 0 ohm but has to be greater than 0"),
        ({"rotorInertia": math.nan}, "kg.m2 but has to be greater than 0"),
        ({"gearRatio": 0.0}, "gearRatio is 0 but must not be 0"),
        ({"damping": -0.25}, "damping is -0.25 N.m.s/rad but must not be negative"),
        ({"motorConstant": math.inf}, "give no finite time constant"),
    ],
)
def test_a_motor_that_cannot_be_solved_is_refused_with_its_values(
    values: dict[str, float], expected: str, folder: Find
) -> None:
    with Unit(folder("SimpleElectricalActuator")) as unit:
        with pytest.raises(FMICallException):
            unit.start(values)

        assert expected in unit.messages[-1].text
