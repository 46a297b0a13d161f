"""The pendulum's motion to machine precision, by other means than the FMU's.

Owns two independent answers: a Taylor series of high order for any parameters, and the exact period of the
undamped pendulum. Neither shares a formula with the FMU's Runge-Kutta solver apart from the equation itself.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

__all__ = ["Pendulum", "angle_after"]

ORDER = 30
LONGEST_STEP = 0.05
"""Well inside the radius of convergence (about 0.5 s for l = 1 m), so the series is exact to rounding."""


@dataclass(frozen=True)
class Pendulum:
    """The parameters of a'' = -(g/l) sin a - d a', in SI units."""

    a: float = 1.5
    velocity: float = 0.0
    l: float = 1.0  # noqa: E741 - the model's name for it
    d: float = 0.1
    g: float = 9.81

    def period(self) -> float:
        """Return the period (s) of the undamped swing from rest at ``a``: the arithmetic-geometric mean."""
        x, y = 1.0, math.cos(self.a / 2)
        while abs(x - y) > 1e-15:
            x, y = (x + y) / 2, math.sqrt(x * y)
        return 2 * math.pi * math.sqrt(self.l / self.g) / x


def angle_after(pendulum: Pendulum, duration: float) -> float:
    """Return the angle in rad ``duration`` seconds after the start."""
    count = math.ceil(duration / LONGEST_STEP)
    a, velocity = pendulum.a, pendulum.velocity
    for _ in range(count):
        angles, velocities = series(pendulum, a, velocity)
        a, velocity = evaluate(angles, duration / count), evaluate(velocities, duration / count)
    return a


def series(pendulum: Pendulum, a: float, velocity: float) -> tuple[list[float], list[float]]:
    """Return the Taylor coefficients of angle and velocity; with s = sin a, s' = c v and c' = -s v."""
    angles, velocities = [a], [velocity]
    sines, cosines = [math.sin(a)], [math.cos(a)]
    for k in range(ORDER):
        next_sine = sum(cosines[j] * velocities[k - j] for j in range(k + 1)) / (k + 1)
        next_cosine = -sum(sines[j] * velocities[k - j] for j in range(k + 1)) / (k + 1)
        angles.append(velocities[k] / (k + 1))
        velocities.append((-pendulum.g / pendulum.l * sines[k] - pendulum.d * velocities[k]) / (k + 1))
        sines.append(next_sine)
        cosines.append(next_cosine)
    return angles, velocities


def evaluate(coefficients: Sequence[float], x: float) -> float:
    """Return the value of a polynomial by Horner's rule."""
    value = 0.0
    for coefficient in reversed(coefficients):
        value = value * x + coefficient
    return value
