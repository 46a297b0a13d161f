"""A world computed by Gazebo classic 11 behind the `Instance` Protocol.

One own step from n to n + 1, in pseudocode::

    inputs of row n
    applied effort of every joint = effort, plus effort_command if the joint has no actuator; limited
    Gazebo: physics_steps times
        these efforts, and force and moment of every link
        one step of the engine
    outputs into row n + 1

The engine is a process of its own (`fmu_mesh.instances.gazebo.gazebo_process`) that advances only within a step. All
efforts and forces are set anew in every step. Positions and velocities are those of the point; accelerations are those
of the engine's last step. A step of Gazebo cannot be undone, so this instance has no state to get and set.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...config.mesh import TimeoutsConfig
from ...errors import InitializationFailed, LoadFailed, StepFailed
from ...rings.ring import Ring
from ...simtime import TimeGrid, steps_between
from ...variables.model_description import Value
from ..body_axes import relative_velocity, to_body
from ..world_variables import WorldVariable
from .gazebo_process import HOW_TO_GET_IT, GazeboGone, GazeboProcess
from .gazebo_section import GazeboClassicConfig
from .gazebo_world import DERIVED, JOINT_STATE, LINK_STATE, load_gazebo_world

__all__ = ["GazeboClassicInstance"]

Floats = NDArray[np.float64]


class GazeboClassicInstance:
    """One world; see `fmu_mesh.instances.contract.Instance` for the call sequence."""

    def __init__(
        self,
        path: Path,
        name: str,
        config: GazeboClassicConfig,
        timeouts: TimeoutsConfig = TimeoutsConfig(),  # noqa: B008  a frozen Struct
    ) -> None:
        self.name = name
        self._world = world = load_gazebo_world(path, config)
        self.description = world.description
        self._config = config
        try:
            self._process = GazeboProcess(
                world.text,
                [(joint.scoped, joint.free) for joint in world.joints],
                [link.scoped for link in world.links],
                timeouts,
            )
        except GazeboGone as error:
            text = f"Gazebo classic does not run '{path}': {error}"
            raise LoadFailed(text, instance=name, hint=HOW_TO_GET_IT) from error
        joints, links = len(world.joints), len(world.links)
        self._arrays: dict[str, Floats] = {
            "state": np.array(self._process.state, dtype=np.float64),
            "effort_applied": np.zeros(joints),
            "effort_command": np.zeros(joints),
            "effort": np.zeros(joints),
            "wrench": np.zeros(6 * links),
            "wind": np.zeros(3),
            **{what: np.zeros(3 * links) for what in DERIVED},
        }
        inputs = world.description.with_causality("input")
        self._inputs_by_name = {variable.name: world.places[variable.name] for variable in inputs}
        self._limits = np.array([joint.effort_limit for joint in world.joints], dtype=np.float64)
        driven = {actuator.joint for actuator in config.actuators if actuator.enabled}
        self._direct = np.array([joint.name not in driven for joint in world.joints], dtype=bool)
        self._check_state()

    def enter_initialization(
        self, start_time: float, stop_time: float | None, start_values: Mapping[str, Value]
    ) -> None:
        """Set the start values of inputs; the world starts as its file says."""
        self.set_values(start_values)

    def exit_initialization(self) -> None:
        """Nothing to do: the loaded world is the first point."""

    def set_values(self, values: Mapping[str, Value]) -> None:
        """Set inputs by name."""
        for name, value in values.items():
            if name not in self._inputs_by_name:
                raise InitializationFailed(
                    f"'{name}' cannot be set: Gazebo starts a world with the values of its file",
                    instance=self.name,
                    variable=name,
                )
            place = self._inputs_by_name[name]
            self._arrays[place.where][place.index] = value

    def get_values(self, names: Sequence[str]) -> list[Value]:
        """Current values of variables by name."""
        places = [self._world.places[name] for name in names]
        self._derive(_derived_links(places))
        return [float(self._arrays[place.where][place.index]) for place in places]

    def bind(self, inputs: Ring, outputs: Sequence[Ring], grid: TimeGrid, points: int, step: int = 0) -> None:
        """Let `do_step` work on these rings, ``points`` of ``grid`` each; write the current outputs as row ``step``."""
        step_size = points * grid.step_size
        whole = steps_between(0.0, step_size, self._world.step_size) or math.ceil(step_size / self._world.step_size)
        self._substeps = self._config.physics_steps or max(1, whole)
        self._inputs = inputs
        self._taken = [self._world.places[name] for name in inputs.layout.names]
        self._given = [(ring, [self._world.places[name] for name in ring.layout.names]) for ring in outputs]
        self._derived = _derived_links([place for _, places in self._given for place in places])
        try:
            self._process.set_step_size(step_size / self._substeps)
        except GazeboGone as error:
            raise self._failed(error) from error
        self._write_outputs(step)

    def do_step(self, step: int) -> None:
        """Take the inputs of row ``step``, advance to own step ``step + 1``, write the outputs to row ``step + 1``."""
        arrays, row = self._arrays, self._inputs.part("Float64")[step & self._inputs.mask]
        for place, value in zip(self._taken, row.tolist(), strict=True):
            arrays[place.where][place.index] = value
        effort = arrays["effort"] + np.where(self._direct, arrays["effort_command"], 0.0)
        arrays["effort_applied"][:] = effort = np.clip(effort, -self._limits, self._limits)
        if not (np.isfinite(effort).all() and np.isfinite(arrays["wrench"]).all()):
            raise StepFailed("an input is no finite number", instance=self.name, variable=self._culprit())
        try:
            self._process.step(self._substeps, effort.tolist(), arrays["wrench"].tolist())
        except GazeboGone as error:
            raise self._failed(error) from error
        self._check_state()
        arrays["state"][:] = self._process.state
        self._write_outputs(step + 1)

    def close(self) -> None:
        """End Gazebo's process. Never raises; may be called twice."""
        self._process.close()

    def _check_state(self) -> None:
        expected = JOINT_STATE * len(self._world.joints) + LINK_STATE * len(self._world.links)
        if len(self._process.state) != expected or not all(map(math.isfinite, self._process.state)):
            self._process.close()
            hint = "Are the inputs of this instance right? Otherwise a smaller step or more `physics_steps` may help."
            raise StepFailed("the state of the world is not finite any more", instance=self.name, hint=hint)

    def _culprit(self) -> str | None:
        """The first input that is not finite."""
        bad = (name for name, place in self._inputs_by_name.items() if not math.isfinite(self._value(place)))
        return next(bad, None)

    def _value(self, place: WorldVariable) -> float:
        return float(self._arrays[place.where][place.index])

    def _derive(self, links: Sequence[int]) -> None:
        """Compute the wind, and the velocities also against it, for these links in their axes."""
        arrays, wind = self._arrays, self._arrays["wind"].tolist()
        for link in links:
            first = JOINT_STATE * len(self._world.joints) + LINK_STATE * link
            state = arrays["state"][first : first + LINK_STATE].tolist()
            rotation, place = _matrix(*state[3:7]), slice(3 * link, 3 * link + 3)
            arrays["body_wind"][place] = to_body(rotation, wind)
            arrays["relative_velocity"][place] = relative_velocity(rotation, state[7:10], wind)
            arrays["body_linear_velocity"][place] = to_body(rotation, state[7:10])
            arrays["body_angular_velocity"][place] = to_body(rotation, state[10:13])

    def _write_outputs(self, step: int) -> None:
        self._derive(self._derived)
        for ring, places in self._given:
            ring.part("Float64")[step & ring.mask] = [self._value(place) for place in places]

    def _failed(self, error: GazeboGone) -> StepFailed:
        return StepFailed(f"Gazebo classic: {error}", instance=self.name)


def _derived_links(places: Sequence[WorldVariable]) -> list[int]:
    """The links for which these places need a computation."""
    return sorted({place.index // 3 for place in places if place.where in DERIVED})


def _matrix(w: float, x: float, y: float, z: float) -> list[float]:
    """The rotation matrix of a unit quaternion, row by row."""
    return [
        1 - 2 * (y * y + z * z),
        2 * (x * y - w * z),
        2 * (x * z + w * y),
        2 * (x * y + w * z),
        1 - 2 * (x * x + z * z),
        2 * (y * z - w * x),
        2 * (x * z - w * y),
        2 * (y * z + w * x),
        1 - 2 * (x * x + y * y),
    ]
