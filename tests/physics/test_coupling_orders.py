"""How right a coupling is: parts with exact steps against the exact solution of the whole."""

from __future__ import annotations

from pathlib import Path
from typing import Final

import numpy as np
import pytest

import fmu_mesh
from tests.physics.linear_parts import COUPLED

FILE: Final = Path(__file__).with_name("linear_parts.py")
STEP_SIZES: Final = (0.02, 0.01, 0.005)

# The largest errors of a plain master in numpy over the same parts, which shares nothing with the package.
HOLD: Final = {
    "SoftMasses": (2.4158e-2, 1.2066e-2, 6.0271e-3),
    "MediumMasses": (5.3728e-1, 3.6588e-1, 2.2470e-1),
    "DualMass": (2.4666e-2, 1.2251e-2, 6.1066e-3),
    "Ladder": (4.8712e-3, 2.4336e-3, 1.2163e-3),
    "SteepLadder": (6.0143e-3, 3.0063e-3, 1.5029e-3),
    "Controlled": (9.7126e-3, 4.7510e-3, 2.3502e-3),
    "Thermal": (2.4735e-3, 1.2359e-3, 6.1773e-4),
}
MIDPOINT: Final = {
    "SoftMasses": (1.6419e-3, 4.0919e-4, 1.0210e-4),
    "MediumMasses": (1.2205e-1, 3.1614e-2, 7.9245e-3),
    "DualMass": (1.6869e-3, 4.2220e-4, 1.0564e-4),
    "Ladder": (2.6140e-4, 6.6004e-5, 1.6584e-5),
    "SteepLadder": (1.3157e-4, 3.3112e-5, 8.3056e-6),
    "Controlled": (2.6604e-3, 6.8228e-4, 1.7277e-4),
    "Thermal": (9.8843e-5, 2.4855e-5, 6.2318e-6),
}
CLOSE: Final = 0.002
"""The reference has five digits, and its exponentials are rounded in another order."""


def coupled(name: str, step_size: float, **simulation: object) -> fmu_mesh.Mesh:
    """The mesh of two parts."""
    own = COUPLED[name]
    mesh = fmu_mesh.Mesh("coupled", step_size=step_size, stop_time=own.stop_time)
    mesh.configure(simulation={"algorithm": "jacobi", **simulation})
    for number, instance in enumerate(("one", "two"), 1):
        mesh.add(instance, python=f"{FILE}:{name}{number}")
    for link in own.links:
        mesh.connect(*link.split(" -> "))
    return mesh


def error_of(name: str, step_size: float, **simulation: object) -> float:
    """The largest error of the first states of both parts."""
    result = coupled(name, step_size, **simulation).run(processes=False, record="memory")
    found = np.stack([result["one.s"], result["two.s"]], axis=1)
    return float(np.abs(found - COUPLED[name].exact(step_size)).max())


@pytest.mark.parametrize("name", HOLD)
@pytest.mark.parametrize(("way", "expected", "order"), [("hold", HOLD, 1.0), ("midpoint", MIDPOINT, 2.0)])
def test_solved_loops_have_the_errors_of_a_plain_master(
    name: str, way: str, expected: dict[str, tuple[float, ...]], order: float
) -> None:
    errors = [error_of(name, step_size, loops="solved", extrapolation=way) for step_size in STEP_SIZES]

    if (name, way) == ("MediumMasses", "midpoint"):
        errors, given = errors[1:], expected[name][1:]  # outside its range a turn is taken for a jump now and then
    else:
        given = expected[name]
    assert errors == pytest.approx(given, rel=CLOSE)
    if name != "MediumMasses":  # these steps are outside the range where it converges
        assert np.log2(errors[-2] / errors[-1]) == pytest.approx(order, abs=0.1)  # as it is of higher orders, too


@pytest.mark.parametrize("name", ["Ladder", "SteepLadder"])
def test_a_loop_that_is_only_delayed_is_told(name: str) -> None:
    check = coupled(name, 0.02).check()

    (told,) = [str(one) for one in check.warnings if "a loop at every point" in str(one)]
    assert "`loops: solved`" in told


def test_stiff_masses_need_more_than_a_solved_loop() -> None:
    with pytest.raises(fmu_mesh.NotFinite):
        error_of("HotThermal", 0.02, loops="solved", extrapolation="midpoint")


WAVE: Final = """
import math

import fmu_mesh


class Wave(fmu_mesh.Component):
    u = fmu_mesh.Input()
    y = fmu_mesh.Output(depends_on=())

    def step(self, time, step_size):
        self.y = math.sin(time + step_size)


class Integral(fmu_mesh.Component):
    u = fmu_mesh.Input()
    y = fmu_mesh.Output(depends_on=())

    def step(self, time, step_size):
        self.y += step_size * self.u
"""
"""A source with exact values, and a target that integrates lines exactly, by the value in the middle of its steps."""

SLOW: Final = {
    "hold": (2.0e-2, 5.0e-2, 1.0e-1),  # H / 2
    "extrapolated": (8.0e-4, 5.0e-3, 2.0e-2),  # H^2 / 2: 5 / 6 H^2 between its ends, and no line in the first step
    "interpolated": (2.667e-4, 1.667e-3, 6.667e-3),  # H^2 / 6
}
"""The largest errors for steps H of the source of 40, 100 and 200 ms, as the series of the error says."""


@pytest.mark.parametrize("way", SLOW)
def test_a_line_between_both_ends_of_slow_steps_is_of_order_2(way: str, tmp_path: Path) -> None:
    (tmp_path / "wave.py").write_text(WAVE, encoding="utf-8")
    errors = []
    for size in (0.04, 0.1, 0.2):
        mesh = fmu_mesh.Mesh("wave", step_size=0.001, stop_time=7.0)
        mesh.configure(simulation={"extrapolation": "hold" if way == "hold" else "midpoint"})
        for name, kind, own in (("wave", "Wave", size), ("integral", "Integral", 0.001), ("fast", "Integral", 0.001)):
            mesh.add(name, python=f"{tmp_path / 'wave.py'}:{kind}", step_size=own)
        mesh.connect("wave.y", "integral.u")
        if way == "extrapolated":  # the source waits for the end of its step
            mesh.connect("fast.y", "wave.u")
        result = mesh.run(processes=False, record="memory")
        errors.append(float(np.abs(result["integral.y"] + np.cos(result.times) - 1.0).max()))

    assert errors == pytest.approx(SLOW[way], rel=0.1)
