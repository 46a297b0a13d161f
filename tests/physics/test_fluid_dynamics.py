"""The FluidDynamics FMU against the same plate, written with angles and unit vectors."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from fmpy.fmi1 import FMICallException
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from tests.fmus.harness import Unit

Find = Callable[[str], Path]
Array = NDArray[np.float64]

DENSITY, AREA, LENGTH, DRAG, PLATE, LIFT, MOMENT = 1.225, 1.0, 1.0, 0.05, 1.1, 0.8, 0.2
NORMAL = np.array([0.0, 0.0, 1.0])

component = st.floats(-50.0, 50.0).filter(lambda x: x == 0.0 or abs(x) > 1e-6)


@pytest.fixture(scope="module")
def plate(folder: Find) -> Callable[[Array], tuple[Array, Array]]:
    """Return force and moment at a velocity, as the FMU computes them with its defaults in initialization mode."""

    def load(velocity: Array) -> tuple[Array, Array]:
        with Unit(folder("FluidDynamics")) as unit:
            unit.setup()
            for axis, value in zip("xyz", velocity, strict=True):
                unit.set(f"relativeVelocity_{axis}", float(value))
            return (
                np.array([unit.real(f"fluidDynamicForce_{axis}") for axis in "xyz"]),
                np.array([unit.real(f"fluidDynamicMoment_{axis}") for axis in "xyz"]),
            )

    return load


def expected(velocity: Array) -> tuple[Array, Array]:
    """Drag along the flow, lift across it and a moment about the axis across both; attack is the angle to the plate."""
    speed = float(np.linalg.norm(velocity))
    if speed == 0.0:
        return np.zeros(3), np.zeros(3)
    along = velocity / speed
    attack = math.asin(np.clip(-along @ NORMAL, -1.0, 1.0))
    pressure = DENSITY / 2 * speed**2
    axis = np.cross(NORMAL, along)
    if (sideways := float(np.linalg.norm(axis))) > 0.0:
        axis /= sideways
    drag = pressure * AREA * (DRAG + PLATE * (1 - math.cos(2 * attack)) / 2) * -along
    lift = pressure * AREA * LIFT * math.sin(2 * attack) * np.cross(along, axis)
    return drag + lift, pressure * AREA * LENGTH * MOMENT * math.sin(2 * attack) * axis


@given(velocity=st.tuples(component, component, component))
def test_force_and_moment_are_those_of_plate_at_its_angle_of_attack(
    plate: Callable[[Array], tuple[Array, Array]], velocity: tuple[float, float, float]
) -> None:
    vector = np.array(velocity)

    force, moment = plate(vector)

    # The angle passes through asin, which loses half of the digits where the flow meets the plate head-on.
    wanted_force, wanted_moment = expected(vector)
    scale = DENSITY / 2 * float(vector @ vector)
    np.testing.assert_allclose(force, wanted_force, rtol=0, atol=1e-7 * scale)
    np.testing.assert_allclose(moment, wanted_moment, rtol=0, atol=1e-7 * scale)
    # Lift does no work, and drag takes energy out.
    assert force @ vector <= 0.0


def test_at_rest_there_is_no_load(plate: Callable[[Array], tuple[Array, Array]]) -> None:
    force, moment = plate(np.zeros(3))

    assert [*force, *moment] == [0.0] * 6


def test_nose_up_lifts_brakes_and_turns_the_nose_down(plate: Callable[[Array], tuple[Array, Array]]) -> None:
    force, moment = plate(np.array([10.0, 0.0, -1.0]))

    assert force[2] > 0.0 > force[0]
    assert moment[1] > 0.0  # about y, which points left: the nose goes down
    assert force[1] == moment[0] == moment[2] == 0.0


def test_twice_the_velocity_gives_exactly_four_times_the_load(plate: Callable[[Array], tuple[Array, Array]]) -> None:
    velocity = np.array([3.0, -0.7, 0.2])

    force, moment = plate(velocity)
    force_twice, moment_twice = plate(2 * velocity)

    assert (force_twice == 4 * force).all()
    assert (moment_twice == 4 * moment).all()


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"density": -1.0}, "density is -1 but has to be finite and not negative"),
        ({"plateCoefficient": math.nan}, "plateCoefficient is "),
        ({"liftCoefficient": math.inf}, "both have to be finite"),
    ],
)
def test_a_plate_that_cannot_be_is_refused(values: dict[str, float], message: str, folder: Find) -> None:
    with Unit(folder("FluidDynamics")) as unit:
        with pytest.raises(FMICallException):
            unit.start(values)

        assert message in unit.messages[-1].text
