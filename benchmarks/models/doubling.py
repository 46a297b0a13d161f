"""The component of the job that measures a step of each kind."""

import fmu_mesh


class Doubling(fmu_mesh.Component):
    """Twice the input."""

    u = fmu_mesh.Input(1.0)
    y = fmu_mesh.Output()

    def step(self, time: float, step_size: float) -> None:  # noqa: ARG002  the contract has both
        """The output at the end of the step."""
        self.y = 2.0 * self.u
