"""A user's components in Python, as type checkers see them."""

import fmu_mesh


class Controller(fmu_mesh.Component):
    """Torque against an angle."""

    kp = fmu_mesh.Parameter(1.0)
    angle = fmu_mesh.Input(unit="rad")
    torque = fmu_mesh.Output(unit="N.m", depends_on=("angle",))

    def step(self, time: float, step_size: float) -> None:
        """One step."""
        gain: float = self.kp
        self.torque = -gain * self.angle


@fmu_mesh.component(y=fmu_mesh.Output(unit="V"))
def amplifier(time: float, u: float, k: float = 2.0) -> float:
    """A gain."""
    return k * u


def controlled() -> fmu_mesh.Result:
    """A pendulum and its controller."""
    mesh = fmu_mesh.Mesh("controlled", step_size=0.01, stop_time=2.0)
    mesh.add("pendulum", fmu="fmus/DampedPendulum.fmu", start_values={"a": 1.3})
    mesh.add("controller", component=Controller, start_values={"kp": 2.0})
    mesh.add("amplifier", component=amplifier)
    mesh.connect("pendulum.a", "controller.angle")
    return mesh.run(record="memory")


def mistaken(controller: Controller) -> None:
    """What a type checker has to find."""
    controller.torque = "1 N.m"  # type: ignore[assignment]  # pyright: ignore[reportAttributeAccessIssue]


if __name__ == "__main__":
    print(controlled()["controller.torque"])
