"""A system for Gazebo (gz-sim 8 and later) that drives a joint by an actuator in a mesh, as gazebo-fmi does by an FMU.

Gazebo's `gz-sim-python-system-loader-system` loads it; see README.md in this folder. In every step of Gazebo:

1. a position controller computes the actuator's input from the joint's position and velocity;
2. the mesh takes one step with these as inputs;
3. the joint gets the torque that the actuator has after it.

Not run with a real Gazebo where this project is built: its packages are not to be had there. What is tested is this
file with a stand-in for `gz.sim8`, and the mesh behind it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from gz.sim8 import Joint, Model
from mesh_client import HeldMesh

if TYPE_CHECKING:
    from gz.sim8 import EntityComponentManager, EventManager, UpdateInfo
    from sdformat14 import Element

__all__ = ["MeshActuator", "get_system"]


class MeshActuator:
    """One joint, one actuator, one mesh; the elements of the plugin in the SDF file are listed in README.md."""

    def configure(self, entity: int, sdf: Element, ecm: EntityComponentManager, _events: EventManager) -> None:
        """Find the joint and hold the mesh."""
        name = sdf.get_string("joint")
        self._joint = Joint(Model(entity).joint_by_name(ecm, name))
        if not self._joint.valid(ecm):
            raise ValueError(f"the model has no joint '{name}'")
        self._joint.enable_position_check(ecm)
        self._joint.enable_velocity_check(ecm)
        self._p, self._d, self._target = (sdf.get_double(key) for key in ("p", "d", "target"))
        self._instance = sdf.get_string("instance")
        self._mesh = HeldMesh(sdf.get_string("connect"), sdf.get_string("mesh"))

    def pre_update(self, info: UpdateInfo, ecm: EntityComponentManager) -> None:
        """Before a step of the engine: its torque is that of the actuator after the same step."""
        positions, velocities = self._joint.position(ecm), self._joint.velocity(ecm)
        if info.paused or not positions or not velocities:
            return  # the engine reports a joint from its first step on
        position, velocity = positions[0], velocities[0]
        inputs = {
            "actuatorInput": self._p * (self._target - position) - self._d * velocity,
            "jointPosition": position,
            "jointVelocity": velocity,
        }
        values = {f"{self._instance}.{variable}": value for variable, value in inputs.items()}
        (torque,) = self._mesh.step(values, [f"{self._instance}.jointTorque"])
        self._joint.set_force(ecm, [torque])


def get_system() -> MeshActuator:
    """What Gazebo's loader calls."""
    return MeshActuator()
