"""The DriveProfile FMU: its motions in their order, as areas under trapezoids."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from fmpy.fmi1 import FMICallException

from tests.fmus.harness import Unit

Find = Callable[[str], Path]


def sampled(unit: Unit, step_size: float, duration: float, start_time: float = 0.0) -> dict[str, list[float]]:
    """Return the velocities after each step of a started unit."""
    names = ("linearVelocity", "angularVelocity")
    rows: dict[str, list[float]] = {name: [] for name in names}
    for point in range(round(duration / step_size)):
        unit.step(start_time + point * step_size, step_size)
        for name in names:
            rows[name].append(unit.real(name))
    return rows


def test_it_drives_forward_turns_drives_forward_and_backward_and_stands_between(folder: Find) -> None:
    with Unit(folder("DriveProfile")) as unit:
        unit.start()
        rows = sampled(unit, 0.25, 20.0)

    motions = [(np.sign(v), np.sign(w)) for v, w in zip(rows["linearVelocity"], rows["angularVelocity"], strict=True)]
    changes = [motion for i, motion in enumerate(motions) if i == 0 or motion != motions[i - 1]]
    assert changes == [(0, 0), (1, 0), (0, 0), (0, 1), (0, 0), (1, 0), (0, 0), (-1, 0), (0, 0)]


def test_each_motion_covers_velocity_times_the_time_between_half_velocities(folder: Find) -> None:
    values = {"speed": 0.8, "linearAcceleration": 0.4, "turnRate": 1.5, "angularAcceleration": 1.0, "hold": 0.5}
    step_size, way, turn = 0.125, 0.8 * (2.0 + 0.5), 1.5 * (1.5 + 0.5)

    with Unit(folder("DriveProfile")) as unit:
        unit.start(values, start_time=64.0)
        rows = sampled(unit, step_size, 24.0, start_time=64.0)

    # All corners are at multiples of 1/8 s, where the trapezoidal rule is exact; the sums are rounded.
    assert sum(map(abs, rows["linearVelocity"])) * step_size == pytest.approx(3 * way, rel=1e-14)
    assert sum(rows["linearVelocity"]) * step_size == pytest.approx(way, rel=1e-14)
    assert sum(rows["angularVelocity"]) * step_size == pytest.approx(turn, rel=1e-14)


def test_short_ramps_make_triangles_never_more_than_the_velocity(folder: Find) -> None:
    with Unit(folder("DriveProfile")) as unit:
        unit.start({"hold": 0.0, "speed": 0.5, "linearAcceleration": 0.5})
        rows = sampled(unit, 0.125, 20.0)

    assert max(rows["linearVelocity"]) == 0.5
    assert rows["linearVelocity"].count(0.5) == 2


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"speed": -0.5}, "speed is -0.5 but has to be finite and not negative"),
        ({"pause": math.inf}, "pause is inf but has to be finite"),
        ({"linearAcceleration": 0.0}, "linearAcceleration is 0 m/s2 and angularAcceleration 0.5 rad/s2"),
    ],
)
def test_a_profile_that_cannot_be_driven_is_refused(values: dict[str, float], message: str, folder: Find) -> None:
    with Unit(folder("DriveProfile")) as unit:
        with pytest.raises(FMICallException):
            unit.start(values)

        assert message in unit.messages[-1].text
