"""The Damper FMU: its one equation, in every float."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

import pytest
from fmpy.fmi1 import FMICallException

from tests.fmus.harness import VARYING_STEPS, Unit

Find = Callable[[str], Path]


def test_torque_is_what_engine_s_own_damping_would_be_in_every_float(folder: Find) -> None:
    with Unit(folder("Damper")) as unit:
        rows = unit.start({"d": 0.3}).run(VARYING_STEPS)

    assert [row["jointTorque"] for row in rows] == [-(0.3 * velocity) for _, velocity in VARYING_STEPS]


def test_the_torque_follows_the_joint_in_initialization_mode(folder: Find) -> None:
    with Unit(folder("Damper")) as unit:
        unit.setup()
        unit.set("jointVelocity", 2.0)

        assert unit.real("jointTorque") == -(0.1 * 2.0)


def test_what_the_controller_asks_for_does_not_reach_the_joint(folder: Find) -> None:
    with Unit(folder("Damper")) as unit:
        unit.start()
        for name in ("actuatorInput", "jointPosition", "jointAcceleration"):
            unit.set(name, 7.0)

        unit.step(0.0, 0.1)

        assert unit.real("jointTorque") == 0.0


@pytest.mark.parametrize("d", [-0.1, math.nan, math.inf])
def test_a_damping_that_is_negative_or_not_finite_is_refused(d: float, folder: Find) -> None:
    with Unit(folder("Damper")) as unit:
        with pytest.raises(FMICallException):
            unit.start({"d": d})

        assert "N.m.s/rad but has to be finite and not negative" in unit.messages[-1].text
