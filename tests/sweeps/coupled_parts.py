"""Linear parts that step exactly, as components: what is left of the error of a mesh is that of its coupling.

Two masses with a spring and a damper between them (force and displacement), a PI controller and a plant of first order,
and an oscillator that drives a lag (one way). `exact` has the solution of the whole.
"""

from __future__ import annotations

from functools import cache

import numpy as np
from numpy.typing import NDArray

from fmu_mesh import Component, Input, Output, Parameter

Matrix = tuple[tuple[float, ...], ...]


def exponential(matrix: NDArray[np.float64]) -> NDArray[np.float64]:
    """By scaling and squaring, to the last digits for the small matrices here."""
    squarings = max(0, int(np.ceil(np.log2(np.abs(matrix).sum(1).max() + 1e-16)))) + 4
    term = result = np.eye(len(matrix))
    for n in range(1, 18):
        term = term @ matrix / 2**squarings / n
        result = result + term
    return np.linalg.matrix_power(result, 2**squarings)


@cache
def transition(a: Matrix, b: Matrix, step_size: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """What becomes of the states and the inputs of x' = A x + B u after a step."""
    n, m = len(a), len(b[0])
    big = np.zeros((n + m, n + m))
    big[:n, :n], big[:n, n:] = a, b
    moved = exponential(big * step_size)[:n]
    return moved[:, :n], moved[:, n:]


def moved(a: Matrix, b: Matrix, x: list[float], u: list[float], step_size: float) -> list[float]:
    """The states after a step in which the inputs hold."""
    of_states, of_inputs = transition(a, b, step_size)
    return [float(one) for one in of_states @ np.array(x) + of_inputs @ np.array(u)]


def exact(a: NDArray[np.float64], x: list[float], step_size: float, points: int) -> NDArray[np.float64]:
    """The solution of x' = A x at all points, shape `(points + 1, states)`."""
    move, rows = exponential(a * step_size), [np.array(x)]
    for _ in range(points):
        rows.append(move @ rows[-1])
    return np.array(rows)


class FirstMass(Component):
    """x'' = -10 x - x' + F, with 1 kg."""

    force = Input()
    x = Output(1.0, unit="m")
    v = Output(unit="m/s")

    def step(self, time: float, step_size: float) -> None:  # noqa: ARG002 as the base class
        a = (0.0, 1.0), (-10.0, -1.0)
        self.x, self.v = moved(a, ((0.0,), (1.0,)), [self.x, self.v], [self.force], step_size)


class SecondMass(Component):
    """x'' = -100 x - 2 x' - F, with 1 kg; F = kc (x - x1) + dc (v - v1)."""

    kc = Parameter(10.0)
    dc = Parameter(1.0)
    x1 = Input(1.0)
    v1 = Input()
    force = Output(depends_on=("x1", "v1"), unit="N")
    x = Output(1.0, unit="m")
    steps = Output(type="Int64")

    def initialize(self) -> None:
        self._v = 0.0
        self.force = self.kc * (self.x - self.x1)

    def step(self, time: float, step_size: float) -> None:  # noqa: ARG002 as the base class
        a = (0.0, 1.0), (-(100.0 + self.kc), -(2.0 + self.dc))
        b = (0.0, 0.0), (self.kc, self.dc)
        self.x, self._v = moved(a, b, [self.x, self._v], [self.x1, self.v1], step_size)
        self.force = self.kc * (self.x - self.x1) + self.dc * (self._v - self.v1)
        self.steps += 1


class Controller(Component):
    """PI: z' = r - y, u = 2 (r - y) + z, with r = 1."""

    y = Input()
    u = Output(2.0, depends_on=("y",))

    def initialize(self) -> None:
        self._z = 0.0
        self.u = 2.0 * (1.0 - self.y)

    def step(self, time: float, step_size: float) -> None:  # noqa: ARG002 as the base class
        self._z += step_size * (1.0 - self.y)
        self.u = 2.0 * (1.0 - self.y) + self._z


class Lag(Component):
    """0.5 x' = -x + u."""

    u = Input()
    x = Output(depends_on=())

    def step(self, time: float, step_size: float) -> None:  # noqa: ARG002 as the base class
        (self.x,) = moved(((-2.0,),), ((2.0,),), [self.x], [self.u], step_size)


class Oscillator(Component):
    """x'' = -x."""

    x = Output(1.0)
    own_step = Output()

    def initialize(self) -> None:
        self._v = 0.0

    def step(self, time: float, step_size: float) -> None:  # noqa: ARG002 as the base class
        a = (0.0, 1.0), (-1.0, 0.0)
        self.x, self._v = moved(a, ((0.0,), (0.0,)), [self.x, self._v], [0.0], step_size)
        self.own_step = step_size


class Growing(Component):
    """Its value is infinite after some steps, unless they are small."""

    y = Output(2.0)

    def step(self, time: float, step_size: float) -> None:  # noqa: ARG002 as the base class
        self.y = float(np.float64(self.y) ** (2.0 if step_size > 0.01 else 1.0))


class Coarse(Component):
    """Refuses small steps."""

    y = Output()

    def step(self, time: float, step_size: float) -> None:  # noqa: ARG002 as the base class
        if step_size < 0.01:
            msg = f"a step of {step_size} s is too small for me"
            raise ValueError(msg)
        self.y = step_size
