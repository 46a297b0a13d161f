"""What a 3D view shows of a vehicle: the frames of its body and of its casters, and the way that it has driven."""

from math import cos, sin

import fmu_mesh
from fmu_mesh import Input, Output


class Frames(fmu_mesh.Component):
    """The pose of a vehicle. An angle about the vertical axis becomes z and w of a quaternion; x and y are 0."""

    x = Input(unit="m")
    y = Input(unit="m")
    body = Input(unit="rad")
    front_left = Input(unit="rad")
    front_right = Input(unit="rad")
    rear_left = Input(unit="rad")
    rear_right = Input(unit="rad")

    base_x = Output(unit="m")
    base_y = Output(unit="m")
    body_z, body_w = Output(), Output()
    front_left_z, front_left_w = Output(), Output()
    front_right_z, front_right_w = Output(), Output()
    rear_left_z, rear_left_w = Output(), Output()
    rear_right_z, rear_right_w = Output(), Output()

    def initialize(self) -> None:
        """The frames at the start."""
        self.base_x, self.base_y = self.x, self.y
        for name in ("body", "front_left", "front_right", "rear_left", "rear_right"):
            half = getattr(self, name) / 2.0
            setattr(self, f"{name}_z", sin(half))
            setattr(self, f"{name}_w", cos(half))

    def step(self, time: float, step_size: float) -> None:
        """The frames at the end of the step."""
        self.initialize()


class Way(fmu_mesh.Component):
    """The way of a vehicle as pieces, each a line with a number: a marker of its own, so a view keeps all of them."""

    x = Input(unit="m")
    y = Input(unit="m")
    piece = Output(0, type="Int32")
    from_x = Output(unit="m")
    from_y = Output(unit="m")
    to_x = Output(unit="m")
    to_y = Output(unit="m")

    def initialize(self) -> None:
        """A piece without a length."""
        self.from_x, self.from_y = self.to_x, self.to_y = self.x, self.y

    def step(self, time: float, step_size: float) -> None:
        """The piece that was driven in this step."""
        self.piece += 1
        self.from_x, self.from_y = self.to_x, self.to_y
        self.to_x, self.to_y = self.x, self.y
