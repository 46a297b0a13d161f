"""The LinearFluidDrag FMU: its equation in every float, and a body that it brakes."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

import pytest
from fmpy.fmi1 import FMICallException

from tests.fmus.harness import Unit

Find = Callable[[str], Path]


def test_force_is_against_velocity_along_each_axis_and_there_is_no_moment(folder: Find) -> None:
    velocity = {"x": 0.3, "y": -1.7, "z": 1e-9}

    with Unit(folder("LinearFluidDrag")) as unit:
        unit.setup()
        for axis, value in velocity.items():
            unit.set(f"relativeVelocity_{axis}", value)
        at_start = {axis: unit.real(f"fluidDynamicForce_{axis}") for axis in "xyz"}
        unit.fmi.exitInitializationMode()
        unit.step(0.0, 0.01)
        force = {axis: unit.real(f"fluidDynamicForce_{axis}") for axis in "xyz"}
        moment = [unit.real(f"fluidDynamicMoment_{axis}") for axis in "xyz"]

    assert at_start == force == {axis: -(10.0 * value) for axis, value in velocity.items()}
    assert moment == [0.0, 0.0, 0.0]


def test_body_of_one_kilogram_is_braked_as_exp_of_minus_gain_t(folder: Find) -> None:
    step_size, velocity, position = 1e-3, 1.0, 0.0

    with Unit(folder("LinearFluidDrag")) as unit:
        unit.start({"gain": 10.0})
        for point in range(2000):
            unit.set("relativeVelocity_x", velocity)
            unit.step(point * step_size, step_size)
            velocity += step_size * unit.real("fluidDynamicForce_x")
            position += step_size * velocity

    # A force held over a step multiplies the velocity by 1 - gain h, so the way is a geometric sum:
    # h (1 - gain h) (1 - (1 - gain h)^2000) / (gain h). The sum is rounded 2000 times.
    factor = 1 - 10.0 * step_size
    assert position == pytest.approx(factor * (1 - factor**2000) / 10.0, rel=2000 * 2**-53)
    # The exact motion, v' = -gain v, goes (1 - exp(-20)) / 10 m; the held force is short of it by gain h of that.
    assert position == pytest.approx((1 - math.exp(-20.0)) / 10.0, rel=10.0 * step_size)


@pytest.mark.parametrize("gain", [-1.0, math.nan, math.inf])
def test_a_gain_that_is_negative_or_not_finite_is_refused(gain: float, folder: Find) -> None:
    with Unit(folder("LinearFluidDrag")) as unit:
        with pytest.raises(FMICallException):
            unit.start({"gain": gain})

        assert "N.s/m but has to be finite and not negative" in unit.messages[-1].text
