"""Two masses with springs and dampers, one component each: a dual mass oscillator, as co-simulation tools are tried on.

Each component solves its own equation exactly for an input that is constant over the step. So all that is wrong in a
result comes from the coupling.
"""

import cmath

import fmu_mesh
from fmu_mesh import Input, Output, Parameter


class Mass:
    """A mass of 1 kg on a spring and a damper: x'' = force - stiffness x - damping x'."""

    def __init__(self, stiffness: float, damping: float, x: float) -> None:
        root = cmath.sqrt(damping**2 / 4 - stiffness)
        self.rates = -damping / 2 + root, -damping / 2 - root
        self.stiffness, self.x, self.v = stiffness, x, 0.0

    def step(self, force: float, step_size: float) -> None:
        """Go on by a step with a constant force."""
        (r, s), rest = self.rates, force / self.stiffness
        a = (self.v - s * (self.x - rest)) / (r - s)
        b = self.x - rest - a
        grown_a, grown_b = a * cmath.exp(r * step_size), b * cmath.exp(s * step_size)
        self.x, self.v = (grown_a + grown_b).real + rest, (r * grown_a + s * grown_b).real


class Left(fmu_mesh.Component):
    """The left mass, between the ground and the coupling."""

    x1_0 = Parameter(0.0, unit="m")
    force = Input(unit="N")
    x1 = Output(unit="m", depends_on=())
    v1 = Output(unit="m/s", depends_on=())

    def initialize(self) -> None:
        """The place of the mass at rest."""
        self.mass = Mass(10.0, 0.2, self.x1_0)
        self.x1, self.v1 = self.mass.x, 0.0

    def step(self, time: float, step_size: float) -> None:
        """Go on with the force of the coupling."""
        self.mass.step(self.force, step_size)
        self.x1, self.v1 = self.mass.x, self.mass.v


class Right(fmu_mesh.Component):
    """The right mass with the spring and the damper of the coupling, whose force depends directly on the left mass."""

    x2_0 = Parameter(0.5, unit="m")
    k = Parameter(10.0, unit="N/m")
    d = Parameter(0.5, unit="N.s/m")
    x1 = Input(unit="m")
    v1 = Input(unit="m/s")
    x2 = Output(unit="m", depends_on=())
    force = Output(unit="N", depends_on=("x1", "v1"))

    def initialize(self) -> None:
        """The place of the mass at rest, and the first force."""
        self.mass = Mass(20.0 + self.k, 0.3 + self.d, self.x2_0)
        self.give()

    def step(self, time: float, step_size: float) -> None:
        """Go on with the place of the left mass, which belongs to the other side of spring and damper."""
        self.mass.step(self.k * self.x1 + self.d * self.v1, step_size)
        self.give()

    def give(self) -> None:
        """The outputs after a step, or at the start."""
        self.x2 = self.mass.x
        self.force = self.k * (self.mass.x - self.x1) + self.d * (self.mass.v - self.v1)
