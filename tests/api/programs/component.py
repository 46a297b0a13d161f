import fmu_mesh                                                   # 2 no file, and a component in Python

class Controller(fmu_mesh.Component):
    """Torque against an angle."""
    kp = fmu_mesh.Parameter(1.0)
    angle = fmu_mesh.Input(unit="rad")
    torque = fmu_mesh.Output(unit="N.m", depends_on=("angle",))

    def step(self, time, step_size):
        self.torque = -self.kp * self.angle

if __name__ == "__main__":
    mesh = fmu_mesh.Mesh("controlled", step_size=0.01, stop_time=2.0)
    mesh.add("pendulum", fmu="fmus/DampedPendulum.fmu", start_values={"a": 1.3})
    mesh.add("controller", component=Controller, start_values={"kp": 2.0})
    mesh.connect("pendulum.a", "controller.angle")
    print(mesh.run(record="memory")["controller.torque"])         # a file as `launch` writes it, or arrays only
