"""A MuJoCo model as a model description, and where the value of each variable is stored.

Owns names, units and meaning of the variables; the only module that loads a model. What happens in a step is
`fmu_mesh.instances.mujoco.mujoco_instance`.

The last part of a name is the kind of the variable; the part before it is unique among the model's names of that kind.
So no two variables have the same name.

| variable | causality | what |
|---|---|---|
| `<joint>.position`, `.velocity` | output | of a revolute or prismatic joint at the communication point |
| `<joint>.acceleration` | output | of the engine's last step; 0 before the first |
| `<joint>.effort_applied` | output | what was applied in the last step, after limits; 0 before the first |
| `<joint>.effort_command` | input | the effort that a controller asks for; applied if the joint has no actuator |
| `<joint>.effort` | input | effort that is applied in addition: the torque of an actuator |
| `<body>.position_x/y/z`, `.orientation_w/x/y/z` | output | of the body's origin in world axes, as a unit quaternion |
| `<body>.linear_velocity_…`, `.angular_velocity_…` | output | of the body's origin, in world axes |
| `<body>.wind_…`, `.relative_velocity_…` | output | the wind, and the origin's velocity against it, in body axes |
| `<body>.body_linear_velocity_…`, `.body_angular_velocity_…` | local | of the body's origin, in body axes |
| `<body>.pose`, `.twist`, `.state` | parameter | set a body with a free joint: 7, 6 and all 13 numbers in world axes |
| `<body>.force_…`, `.moment_…` | input | acting at the body's origin, and about it, in body axes |
| `<sensor>.value`, `<sensor>.value[1]` … | output | at the point; of forces and accelerations: of the last step |
| `<actuator>.control` / `.force` | input / output | an actuator of the model / its force in the last step |
| `wind_x/y/z` | input | velocity of the medium in world axes |
"""

from __future__ import annotations

import hashlib
import xml.etree.ElementTree as ET
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import msgspec
import numpy as np

from ...errors import LoadFailed
from ...files import opened
from ...installing import importing
from ...text import did_you_mean, listed
from ...variables.model_description import DefaultExperiment, ModelDescription
from ..body_axes import to_world
from ..world_variables import (
    STATE,
    WorldVariable,
    body_state,
    body_variables,
    joint_variables,
    numbered,
    world_input,
    world_output,
)
from .mujoco_section import MujocoConfig

__all__ = ["World", "engine", "load_world", "warnings"]

warnings: list[str] = []
"""Warnings of MuJoCo since this was cleared. It has one handler per process; the default one would write a file."""

_WORLD_BODY = 0
_WIND = ("wind_x", "wind_y", "wind_z")
_OF_DOFS = ("velocity", "acceleration", "effort_applied", "effort_command", "effort")
"""What a joint has for each degree of freedom."""


class World(msgspec.Struct, frozen=True):
    """A loaded model."""

    model: Any  # the `mujoco.MjModel`
    description: ModelDescription
    entries: tuple[WorldVariable, ...]  # all variables
    # (index of the joint's velocity, smallest, largest effort) of joints whose effort is limited
    limits: tuple[tuple[int, float, float], ...]
    keyframe: int | None  # number of the keyframe to start from, or None


def load_world(path: Path, config: MujocoConfig) -> World:
    """Load the model at ``path`` (MJCF or URDF); `LoadFailed` if MuJoCo is not installed, or says why it cannot."""
    mujoco = engine()
    try:
        with opened(path) as file:
            data = file.read()
        warnings.clear()
        model = mujoco.MjModel.from_xml_path(str(path))
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) else " ".join(str(error).split())
        raise LoadFailed(f"MuJoCo cannot load '{path}': {reason}") from error
    keyframe = _keyframe(model, config.keyframe, path)
    entries = numbered(_entries(mujoco, model, keyframe))
    free = {actuator.joint for actuator in config.actuators if actuator.disable_velocity_effort_limits}
    description = ModelDescription(
        model_name=_text(model, 0) or path.stem,
        model_identifier="mujoco",
        fmi_version="",
        kind="physics_engine",
        guid=hashlib.sha256(data).hexdigest()[:32],
        variables=tuple(entry.variable for entry in entries),
        generation_tool=f"MuJoCo {mujoco.__version__}",
        default_experiment=DefaultExperiment(step_size=float(model.opt.timestep)),
        can_get_and_set_state=True,
        can_serialize_state=True,
        problems=(*(" ".join(text.split()) for text in warnings), *_left_out(mujoco, model, data)),
    )
    return World(model, description, entries, tuple(_limits(mujoco, model, free)), keyframe)


def engine() -> ModuleType:
    """The module `mujoco`; it is imported on first use, because it is optional and slow to import."""
    with importing("mujoco"):
        import mujoco  # noqa: PLC0415  an extra, and slow to import
    mujoco.set_mju_user_warning(warnings.append)
    module: ModuleType = mujoco
    return module


def _keyframe(model: Any, name: str | None, path: Path) -> int | None:  # noqa: ANN401  mujoco has no types
    if name is None:
        return None
    names = [model.key(number).name for number in range(model.nkey)]
    if name in names:
        return names.index(name)
    raise LoadFailed(f"'{path}' has no keyframe '{name}', but {listed(names)}", hint=did_you_mean(name, names))


def _entries(mujoco: ModuleType, model: Any, keyframe: int | None) -> Iterator[WorldVariable]:  # noqa: ANN401  mujoco has no types
    yield from _joints(mujoco, model, keyframe)
    yield from _bodies(model)
    yield from _free_bodies(mujoco, model, keyframe)
    for number in range(model.nsensor):
        sensor = model.sensor(number)
        first, size = int(sensor.adr[0]), int(sensor.dim[0])
        for offset in range(size if sensor.name else 0):
            index = f"[{offset + 1}]" if size > 1 else ""
            yield world_output(f"{sensor.name}.value{index}", ("sensor", first + offset), None, "value of a sensor")
    for number in range(model.nu):
        if name := model.actuator(number).name:
            yield world_input(f"{name}.control", ("control", number), None, "control of an actuator of the model")
            yield world_output(f"{name}.force", ("actuator_force", number), None, "its force in the last step")
    for axis, letter in enumerate("xyz"):
        start = float(model.opt.wind[axis])
        yield world_input(f"wind_{letter}", ("wind", axis), "m/s", "velocity of the medium in world axes", start)


def _joints(mujoco: ModuleType, model: Any, keyframe: int | None) -> Iterator[WorldVariable]:  # noqa: ANN401  mujoco has no types
    positions, velocities = _start(model, keyframe)
    for joint in _of_one_axis(mujoco, model):
        if not joint.name:
            continue
        revolute = joint.type[0] == mujoco.mjtJoint.mjJNT_HINGE
        qpos, dof = int(joint.qposadr[0]), int(joint.dofadr[0])
        places = {what: (what, dof) for what in _OF_DOFS} | {"position": ("position", qpos)}
        start = {"position": float(positions[qpos]), "velocity": float(velocities[dof])}
        yield from joint_variables(joint.name, places, revolute=revolute, start=start)


def _start(model: Any, keyframe: int | None) -> tuple[Any, Any]:  # noqa: ANN401  mujoco has no types
    """Positions and velocities at the start."""
    return (model.qpos0, [0.0] * model.nv) if keyframe is None else (model.key_qpos[keyframe], model.key_qvel[keyframe])


def _of_one_axis(mujoco: ModuleType, model: Any) -> list[Any]:  # noqa: ANN401  mujoco has no types
    """The revolute and prismatic joints."""
    types = (int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE))
    return [joint for joint in map(model.joint, range(model.njnt)) if int(joint.type[0]) in types]


def _bodies(model: Any) -> Iterator[WorldVariable]:  # noqa: ANN401  mujoco has no types
    for number in range(_WORLD_BODY + 1, model.nbody):
        if name := model.body(number).name:
            vectors = ("linear_velocity", "angular_velocity", "relative_velocity")
            in_body = ("body_linear_velocity", "body_angular_velocity")
            places = {what: (what, 3 * number) for what in (*vectors, *in_body)}
            places |= {"position": ("body_position", 3 * number), "orientation": ("body_orientation", 4 * number)}
            places |= {"force": ("wrench", 6 * number), "moment": ("wrench", 6 * number + 3)}
            yield from body_variables(name, "body", {**places, "wind": ("body_wind", 3 * number)}, _WIND)


def _free_bodies(mujoco: ModuleType, model: Any, keyframe: int | None) -> Iterator[WorldVariable]:  # noqa: ANN401  mujoco has no types
    positions, velocities = _start(model, keyframe)
    for joint in map(model.joint, range(model.njnt)):
        body = int(joint.bodyid[0])
        if joint.type[0] != mujoco.mjtJoint.mjJNT_FREE or not (name := model.body(body).name):
            continue
        pose = np.array(positions[int(joint.qposadr[0]) :][:7])
        linear, angular = np.array(velocities[int(joint.dofadr[0]) :][:6]).reshape(2, 3).tolist()
        mujoco.mju_normalize4(pose[3:])
        rotation = np.zeros(9)
        mujoco.mju_quat2Mat(rotation, pose[3:])
        start = (*pose.tolist(), *linear, *to_world(rotation.tolist(), angular))
        yield from body_state(name, "body", ("state", STATE * body), start)


def _limits(mujoco: ModuleType, model: Any, free: set[str]) -> Iterator[tuple[int, float, float]]:  # noqa: ANN401  mujoco has no types
    for joint in _of_one_axis(mujoco, model):
        if model.jnt_actfrclimited[joint.id] and joint.name not in free:
            lower, upper = model.jnt_actfrcrange[joint.id]
            yield int(joint.dofadr[0]), float(lower), float(upper)


def _left_out(mujoco: ModuleType, model: Any, data: bytes) -> Iterator[str]:  # noqa: ANN401  mujoco has no types
    """Parts of the file that have no variables. A free joint needs none: its body has position and velocity."""
    for joint in map(model.joint, range(model.njnt)):
        if joint.type[0] == mujoco.mjtJoint.mjJNT_BALL:
            yield f"the joint '{joint.name}' is simulated, and has no variables, as it is a ball joint"
    nameless = {
        "joints": sum(not joint.name for joint in _of_one_axis(mujoco, model)),
        "sensors": sum(not model.sensor(number).name for number in range(model.nsensor)),
        "actuators": sum(not model.actuator(number).name for number in range(model.nu)),
    }
    for what, count in nameless.items():
        if count:
            yield f"{what} without a name have no variables; there are {count}"
    try:
        root = ET.fromstring(data)  # noqa: S314  a file of the user's own; it is run as a simulation anyway
    except ET.ParseError:  # MuJoCo also reads formats that are not XML
        return
    bodies = {model.body(number).name for number in range(model.nbody)}
    links = [name for link in root.findall("link") if (name := link.get("name", "")) not in bodies]
    if root.tag == "robot" and links:
        yield f"links that a fixed joint makes part of another have no variables: {listed(links)}"


def _text(model: Any, address: int) -> str:  # noqa: ANN401  mujoco has no types
    """The text at an address among the names of a model; the first is the model's own."""
    end = model.names.index(b"\0", address)
    return str(model.names[address:end].decode(errors="replace"))
