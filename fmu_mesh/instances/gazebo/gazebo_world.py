"""An SDF world as a model description, and where the value of each variable is stored.

Owns names, units and meaning of the variables, which are those of `fmu_mesh.instances.mujoco.mujoco_world`, so that one
configuration fits both engines; sensors and actuators of the model have no variables. Which parts of the file are
simulated is in `fmu_mesh.instances.gazebo.gazebo_sdf`; the steps are in `fmu_mesh.instances.gazebo.gazebo_classic`.

A joint or link is named as in the file where that name is unique, and `model::name` where it is not.
"""

from __future__ import annotations

import hashlib
import math
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path

import msgspec

from ...errors import LoadFailed
from ...variables.model_description import DefaultExperiment, ModelDescription
from ..world_variables import WorldVariable, joint_variables, numbered, world_input, world_output
from .gazebo_sdf import GazeboModel, read_world
from .gazebo_section import GazeboClassicConfig

__all__ = ["GazeboJoint", "GazeboLink", "GazeboWorld", "load_gazebo_world"]

JOINT_STATE, LINK_STATE = 3, 13
"""Numbers per joint (position, velocity, acceleration) and link (position, attitude, two velocities) in a state."""

_DEFAULT_STEP_SIZE = 1e-3
"""s; of SDF (physics, max_step_size)."""


class GazeboJoint(msgspec.Struct, frozen=True):
    """A revolute or prismatic joint.

    Attributes:
        scoped: the name in Gazebo, `model::joint`.
        name: the name in variables.
        effort_limit: largest absolute effort in N m or N; infinite without a limit.
        free: whether it has no limits, whatever the file says.
    """

    scoped: str
    name: str
    revolute: bool
    effort_limit: float
    free: bool


class GazeboLink(msgspec.Struct, frozen=True):
    """A link; `scoped` and `name` as those of a `GazeboJoint`."""

    scoped: str
    name: str


class GazeboWorld(msgspec.Struct, frozen=True):
    """A world.

    Attributes:
        text: the SDF that Gazebo gets.
        step_size: of the engine in s.
        places: the variables by name.
    """

    text: bytes
    step_size: float
    joints: tuple[GazeboJoint, ...]
    links: tuple[GazeboLink, ...]
    description: ModelDescription
    places: dict[str, WorldVariable]


def load_gazebo_world(path: Path, config: GazeboClassicConfig) -> GazeboWorld:
    """Read the world at ``path``.

    Raises:
        LoadFailed: it is no world that Gazebo could load without looking elsewhere.
    """
    sdf = read_world(path)
    step_size = _number(sdf.element.findtext("physics/max_step_size"), _DEFAULT_STEP_SIZE, path)
    free = {actuator.joint for actuator in config.actuators if actuator.disable_velocity_effort_limits}
    moving = [model for model in sdf.models if model.moving]
    joints, links = _joints(moving, free, path), _links(moving)
    variables = numbered(_variables(joints, links))
    description = ModelDescription(
        model_name=sdf.element.get("name") or path.stem,
        model_identifier="gazebo_classic",
        fmi_version="",
        kind="physics_engine",
        guid=hashlib.sha256(sdf.source).hexdigest()[:32],
        variables=tuple(own.variable for own in variables),
        generation_tool="Gazebo classic",
        default_experiment=DefaultExperiment(step_size=step_size),
        problems=sdf.notes,
    )
    places = {own.variable.name: own for own in variables}
    return GazeboWorld(sdf.text, step_size, joints, links, description, places)


def _joints(models: Sequence[GazeboModel], free: set[str], path: Path) -> tuple[GazeboJoint, ...]:
    found = [
        (f"{model.scoped}::{joint.get('name')}", joint)
        for model in models
        for joint in model.element.findall("joint")
        if joint.get("type") in {"revolute", "prismatic"}
    ]
    joints = []
    for name, (scoped, joint) in zip(_names([scoped for scoped, _ in found]), found, strict=True):
        # SDF has a negative number where there is no limit.
        limit = -1.0 if name in free else _number(joint.findtext("axis/limit/effort"), -1.0, path)
        revolute = joint.get("type") == "revolute"
        joints.append(GazeboJoint(scoped, name, revolute, limit if limit >= 0.0 else math.inf, name in free))
    return tuple(joints)


def _links(models: Sequence[GazeboModel]) -> tuple[GazeboLink, ...]:
    scoped = [f"{model.scoped}::{link.get('name')}" for model in models for link in model.element.findall("link")]
    return tuple(GazeboLink(*names) for names in zip(scoped, _names(scoped), strict=True))


def _names(scoped: list[str]) -> list[str]:
    """The last part of each name, where no other has the same; else all of it."""
    last = [name.rpartition("::")[2] for name in scoped]
    counts = Counter(last)
    return [short if counts[short] == 1 else full for short, full in zip(last, scoped, strict=True)]


def _number(text: str | None, default: float, path: Path) -> float:
    if text is None:
        return default
    try:
        return float(text)
    except ValueError as error:
        raise LoadFailed(f"'{path}' has '{text.strip()}' where a number should be") from error


def _variables(joints: tuple[GazeboJoint, ...], links: tuple[GazeboLink, ...]) -> Iterator[WorldVariable]:
    for number, joint in enumerate(joints):
        places = {what: (what, number) for what in ("effort_applied", "effort_command", "effort")}
        in_state = enumerate(("position", "velocity", "acceleration"), JOINT_STATE * number)
        places |= {what: ("state", place) for place, what in in_state}
        yield from joint_variables(joint.name, places, revolute=joint.revolute)
    for number, link in enumerate(links):
        yield from _link_variables(link.name, number, JOINT_STATE * len(joints) + LINK_STATE * number)
    for axis, letter in enumerate("xyz"):
        yield world_input(f"wind_{letter}", ("wind", axis), "m/s", "velocity of the medium in world axes")


def _link_variables(name: str, number: int, state: int) -> Iterator[WorldVariable]:
    in_state = (
        ("position", "xyz", "m", "of the link's origin in world axes"),
        ("orientation", "wxyz", "1", "attitude as a unit quaternion, link axes to world axes"),
        ("linear_velocity", "xyz", "m/s", "of the link's origin, in world axes"),
        ("angular_velocity", "xyz", "rad/s", "in world axes"),
    )
    for what, letters, unit, text in in_state:
        for letter in letters:
            yield world_output(f"{name}.{what}_{letter}", ("state", state), unit, text)
            state += 1
    for axis, letter in enumerate("xyz"):
        place = 3 * number + axis
        text = "velocity of the medium in link axes"
        yield world_output(f"{name}.wind_{letter}", ("body_wind", place), "m/s", text)
        text = "velocity of the link's origin against the medium in link axes"
        yield world_output(f"{name}.relative_velocity_{letter}", ("relative_velocity", place), "m/s", text)
        text = "acts at the link's origin, in link axes"
        yield world_input(f"{name}.force_{letter}", ("wrench", 6 * number + axis), "N", text)
        text = "acts about the link's origin, in link axes"
        yield world_input(f"{name}.moment_{letter}", ("wrench", 6 * number + 3 + axis), "N.m", text)
