"""An arm that an electrical actuator lifts, and the PID that controls it: two components in Python.

`fmu-mesh launch examples/components/arm.yaml` runs them. As a program, this file runs the same mesh twice, without and
with the integral part of the controller, and prints how far from its target the arm comes to rest.
"""

from math import cos
from pathlib import Path

import fmu_mesh
from fmu_mesh import Input, Output, Parameter


class Pid(fmu_mesh.Component):
    """A position controller with a limited output, which stops to integrate while the output is at its limit."""

    p = Parameter(100.0, unit="V/rad", tunable=True)
    i = Parameter(100.0, unit="V/(rad.s)", tunable=True)
    d = Parameter(20.0, unit="V.s/rad", tunable=True)
    limit = Parameter(48.0, unit="V", min=0.0)
    target = Input(unit="rad")
    position = Input(unit="rad")
    velocity = Input(unit="rad/s")
    voltage = Output(unit="V")

    def __init__(self) -> None:
        self.integral = 0.0

    def initialize(self) -> None:
        """The voltage before the first step."""
        self.voltage = self.limited(self.wanted(self.integral))

    def step(self, time: float, step_size: float) -> None:
        """Integrate the error, and set the voltage."""
        integral = self.integral + (self.target - self.position) * step_size
        wanted = self.wanted(integral)
        self.voltage = self.limited(wanted)
        if self.voltage == wanted:
            self.integral = integral

    def wanted(self, integral: float) -> float:
        """The voltage without its limit."""
        return self.p * (self.target - self.position) + self.i * integral - self.d * self.velocity

    def limited(self, voltage: float) -> float:
        """A voltage within the limit."""
        return min(max(voltage, -self.limit), self.limit)


class Arm(fmu_mesh.Component):
    """A mass at the end of a rod that turns in a vertical plane; at the position 0 the rod is horizontal."""

    mass = Parameter(0.05, unit="kg")
    length = Parameter(1.0, unit="m")
    friction = Parameter(0.01, unit="N.m.s/rad")
    torque = Input(unit="N.m")
    position = Output(0.0, unit="rad", depends_on=())
    velocity = Output(0.0, unit="rad/s", depends_on=())

    def step(self, time: float, step_size: float) -> None:
        """One step of Euler's method, the position with the new velocity."""
        weight = self.mass * 9.81 * self.length * cos(self.position)
        torque = self.torque - weight - self.friction * self.velocity
        self.velocity += torque / (self.mass * self.length**2) * step_size
        self.position += self.velocity * step_size


def main() -> None:
    """Run the mesh without and with the integral part."""
    mesh = fmu_mesh.load(Path(__file__).with_name("arm.yaml"))
    for gain in (0.0, 100.0):
        result = mesh.run(record="memory", start_values={"controller.i": gain})
        away = abs(1.0 - result["arm.position"][-1])
        print(f"with i = {gain:g} the arm comes to rest {away:.3f} rad from its target")


if __name__ == "__main__":
    main()
