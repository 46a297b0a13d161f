"""What `CartPole.fmu` computes: bit for bit the Runge-Kutta method of its page, and accurate."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import pytest
from fmpy.fmi1 import FMICallException
from scipy.integrate import solve_ivp

from tests.fmus.harness import VARYING_STEPS, Unit

Find = Callable[[str], Path]
Motion = tuple[float, float, float, float]

STATE = ("x", "der(x)", "theta", "der(theta)")
LONG_SWING = {"x": 0.3, "der(x)": -0.4, "theta": 0.5, "der(theta)": 1.5}


@dataclass
class CartPole:
    """The parameters and the force, in SI units."""

    cart_mass: float = 1.0
    pole_mass: float = 0.1
    l: float = 0.5  # noqa: E741  the model's name for it
    g: float = 9.81
    force: float = 0.0

    def rates(self, motion: Motion) -> Motion:
        """How fast x, its velocity, theta and its velocity change."""
        _, velocity, theta, omega = motion
        mass, sine, cosine = self.cart_mass + self.pole_mass, math.sin(theta), math.cos(theta)
        push = (self.force + self.pole_mass * self.l * omega * omega * sine) / mass
        turn = (self.g * sine - cosine * push) / (self.l * (4.0 / 3.0 - self.pole_mass * cosine * cosine / mass))
        return velocity, push - self.pole_mass * self.l * turn * cosine / mass, omega, turn

    def after(self, motion: Motion, step_size: float) -> Motion:
        """The motion after one communication step, by the internal steps of the FMU."""
        longest = min(2e-3, 1e-2 / math.sqrt(abs(self.g) / self.l)) if self.g else 2e-3
        count = max(1, math.ceil(step_size / longest * (1.0 - 1e-9)))
        for _ in range(count):
            motion = self._runge_kutta(motion, step_size / count)
        return motion

    def _runge_kutta(self, motion: Motion, h: float) -> Motion:
        k1 = self.rates(motion)
        k2 = self.rates(_moved(motion, 0.5 * h, k1))
        k3 = self.rates(_moved(motion, 0.5 * h, k2))
        k4 = self.rates(_moved(motion, h, k3))
        mean = [(a + 2.0 * (b + c) + d) / 6.0 for a, b, c, d in zip(k1, k2, k3, k4, strict=True)]
        return _moved(motion, h, (mean[0], mean[1], mean[2], mean[3]))

    def energy(self, motion: Motion) -> float:
        """Kinetic and potential energy of cart and pole in J."""
        _, velocity, theta, omega = motion
        mass, moment = self.cart_mass + self.pole_mass, 4.0 / 3.0 * self.pole_mass * self.l**2
        kinetic = 0.5 * mass * velocity**2 + 0.5 * moment * omega**2
        return (
            kinetic
            + self.pole_mass * self.l * velocity * omega * math.cos(theta)
            + self.pole_mass * self.g * self.l * math.cos(theta)
        )


def _moved(motion: Motion, h: float, rates: Motion) -> Motion:
    x, velocity, theta, omega = (value + h * rate for value, rate in zip(motion, rates, strict=True))
    return x, velocity, theta, omega


def motion_of(unit: Unit) -> Motion:
    x, velocity, theta, omega = (unit.real(name) for name in STATE)
    return x, velocity, theta, omega


@pytest.mark.parametrize(
    "parameters",
    [
        {},
        {"cart_mass": 2.5, "pole_mass": 0.7, "l": 0.11},
        {"g": 0.0},
        {"g": -9.81, "pole_mass": 0.0},
    ],
    ids=str,
)
def test_every_float_is_that_of_the_equations_in_python(parameters: Mapping[str, float], folder: Find) -> None:
    model, expected, rows = CartPole(**parameters), [], []
    with Unit(folder("CartPole")) as unit:
        unit.start({**LONG_SWING, **parameters})
        motion, time = motion_of(unit), 0.0
        for step_size, force in VARYING_STEPS:
            unit.set("force", force)
            unit.step(time, step_size)
            time += step_size
            model.force = force
            motion = model.after(motion, step_size)
            expected.append(motion)
            rows.append(motion_of(unit))

    assert rows == expected


def test_the_motion_is_accurate(folder: Find) -> None:
    model = CartPole(force=0.7)
    solution = solve_ivp(
        lambda _, motion: model.rates(tuple(motion)),
        (0.0, 5.0),
        [*LONG_SWING.values()],
        "DOP853",
        rtol=1e-13,
        atol=1e-13,
    )

    with Unit(folder("CartPole")) as unit:
        unit.start({**LONG_SWING, "force": 0.7})
        for point in range(250):
            unit.step(point * 0.02, 0.02)

        # The pole turns around several times; one internal step of 2 ms is wrong by about 1e-12.
        assert motion_of(unit) == pytest.approx(solution.y[:, -1].tolist(), abs=1e-7)


def test_without_a_force_the_energy_stays(folder: Find) -> None:
    with Unit(folder("CartPole")) as unit:
        unit.start(LONG_SWING)
        before = CartPole().energy(motion_of(unit))
        for point in range(500):
            unit.step(point * 0.02, 0.02)

        assert CartPole().energy(motion_of(unit)) == pytest.approx(before, rel=1e-9)


def test_a_tuned_parameter_acts_at_the_next_step(folder: Find) -> None:
    with Unit(folder("CartPole")) as unit:
        unit.start({"theta": 0.1})
        unit.step(0.0, 0.02)
        first = motion_of(unit)
        unit.set("pole_mass", 0.5)
        unit.set("cart_mass", 3.0)
        unit.set("l", 0.8)
        unchanged = motion_of(unit)
        unit.step(0.02, 0.02)

        assert unchanged == first
        assert motion_of(unit) == CartPole(cart_mass=3.0, pole_mass=0.5, l=0.8).after(first, 0.02)


def test_a_stored_state_goes_on_in_another_instance(folder: Find) -> None:
    with Unit(folder("CartPole")) as one, Unit(folder("CartPole")) as other:
        one.start({"theta": 0.1, "force": 2.0})
        other.start({"l": 0.9})
        one.step(0.0, 0.02)
        state = one.fmi.getFMUstate()
        stored = one.fmi.serializeFMUstate(state)
        one.fmi.freeFMUstate(state)
        taken = other.fmi.deSerializeFMUstate(stored)
        other.fmi.setFMUstate(taken)
        other.fmi.freeFMUstate(taken)
        for unit in (one, other):
            unit.step(0.02, 0.02)

        assert motion_of(other) == motion_of(one)


@pytest.mark.parametrize(
    ("name", "value", "expected"),
    [
        ("cart_mass", 0.0, "cart_mass is 0 kg but has to be greater than 0"),
        ("cart_mass", math.nan, "but has to be greater than 0"),
        ("pole_mass", -0.5, "pole_mass is -0.5 kg but must not be negative"),
        ("l", -1.0, "l is -1 m but has to be greater than 0"),
        ("g", 1e9, "move faster than 10000 1/s"),
    ],
)
def test_parameter_that_makes_no_sense_is_refused_at_start_and_in_step(
    name: str, value: float, expected: str, folder: Find
) -> None:
    with Unit(folder("CartPole")) as unit, pytest.raises(FMICallException, match="fmi2ExitInitializationMode"):
        unit.start({name: value})
    assert expected in unit.messages[-1].text

    with Unit(folder("CartPole")) as unit:
        unit.start()
        unit.set(name, value)
        with pytest.raises(FMICallException, match="fmi2DoStep"):
            unit.step(0.0, 0.02)
        assert expected in unit.messages[-1].text
