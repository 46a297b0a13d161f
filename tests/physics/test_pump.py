"""The Pump FMU: the affinity laws in every float, and a forecast that comes true."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

import pytest
from fmpy.fmi1 import FMICallException

from tests.fmus.harness import Unit

Find = Callable[[str], Path]


@pytest.mark.parametrize("speed", [0.0, 150.0, 300.0, 333.3, -120.0])
def test_flow_and_power_follow_the_affinity_laws(speed: float, folder: Find) -> None:
    part = speed / 300.0

    with Unit(folder("Pump")) as unit:
        unit.setup()
        unit.set("speed", speed)
        at_start = unit.real("flow"), unit.real("power")
        unit.fmi.exitInitializationMode()
        unit.step(0.0, 0.1)
        after = unit.real("flow"), unit.real("power")

    assert at_start == after == (0.01 * part, 4000.0 * abs(part * part * part))


def test_forecast_is_the_temperature_that_comes_in_any_steps(folder: Find) -> None:
    with Unit(folder("Pump")) as unit:
        unit.start({"horizon": 100.0, "time_constant": 80.0, "temperature": 20.0})
        unit.set("speed", 240.0)
        unit.set("ambient", 25.0)
        unit.step(0.0, 0.1)
        promised = unit.real("forecast")
        for point in range(1, 1001):
            unit.step(point * 0.1, 0.1)
        came = unit.real("temperature")

    final = 25.0 + 60.0 * (240.0 / 300.0) ** 3
    # 1001 steps, each rounded a few times.
    assert came == pytest.approx(promised, rel=4 * 1001 * 2**-53)
    assert came == pytest.approx(final + (20.0 - final) * math.exp(-100.1 / 80.0), rel=4 * 1001 * 2**-53)


def test_a_warm_pump_that_stands_cools_down_to_ambient(folder: Find) -> None:
    with Unit(folder("Pump")) as unit:
        unit.start({"temperature": 80.0, "time_constant": 10.0, "horizon": 0.0})
        unit.step(0.0, 1000.0)

        assert unit.real("forecast") == unit.real("temperature") == 20.0


@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        ("rated_speed", 0.0, "rad/s but has to be finite and greater than 0"),
        ("rated_speed", math.nan, "rad/s but has to be finite and greater than 0"),
        ("time_constant", -1.0, "s but has to be finite and greater than 0"),
        ("time_constant", math.inf, "s but has to be finite and greater than 0"),
        ("horizon", -1.0, "s but has to be finite and not negative"),
    ],
)
def test_a_parameter_without_meaning_is_refused(name: str, value: float, words: str, folder: Find) -> None:
    with Unit(folder("Pump")) as unit:
        with pytest.raises(FMICallException):
            unit.start({name: value})

        assert words in unit.messages[-1].text
