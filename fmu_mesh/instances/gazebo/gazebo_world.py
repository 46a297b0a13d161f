"""An SDF world for Gazebo classic: read, completed, checked, and as a model description.

Owns which parts of SDF can be simulated, and where the value of each variable is stored. Parts that Gazebo would
silently leave out and that change the motion are refused by name; parts that have no variables or do not change the
motion are notes. Names, units and meaning of the variables are those of MuJoCo (`fmu_mesh.instances.world_variables`),
so that one configuration fits both engines; sensors and actuators of the model have no variables. The steps are in
`fmu_mesh.instances.gazebo.gazebo_classic`.

A joint or link is named as in the file where that name is unique, and `model::name` where it is not.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path, PurePosixPath

import msgspec
from lxml import etree

from ...errors import LoadFailed
from ...variables.model_description import DefaultExperiment, ModelDescription
from ..world_variables import WorldVariable, body_variables, joint_variables, numbered, world_input
from .gazebo_section import GazeboClassicConfig
from .world_includes import Element, WorldFile

__all__ = ["GazeboJoint", "GazeboLink", "GazeboPlugin", "GazeboWorld", "load_gazebo_world"]

JOINT_STATE, LINK_STATE = 3, 13
"""Numbers per joint (position, velocity, acceleration) and link (position, attitude, two velocities) in a state."""

DERIVED = ("body_wind", "relative_velocity", "body_linear_velocity", "body_angular_velocity")
"""Vectors of a link that are computed from its state and the wind."""

_DEFAULT_STEP_SIZE = 1e-3
"""s; of SDF (physics, max_step_size)."""

_DEFAULT_RATE = 1000.0
"""Steps per s; of SDF (physics, real_time_update_rate)."""

_WITH_VARIABLES = ("revolute", "prismatic")
_WITHOUT_VARIABLES = ("ball", "universal", "screw", "revolute2", "gearbox")
_JOINTS = ("revolute", "continuous", "prismatic", "fixed", *_WITHOUT_VARIABLES)

_PLUGINS = {"libFMIActuatorPlugin.so": "actuators", "libFMISingleBodyFluidDynamicsPlugin.so": "fluid_dynamics"}
"""The plugins of gazebo-fmi by file, and the section of an instance that each of them corresponds to."""

_NO_COUPLINGS = GazeboClassicConfig(gazebo_classic="")


class GazeboModel(msgspec.Struct, frozen=True):
    """A model, also one in another model."""

    scoped: str  # the name in Gazebo, such as `outer::inner`
    element: Element
    file: Path
    moving: bool  # whether it is not static; Gazebo lets a model in a static one move.


class GazeboJoint(msgspec.Struct, frozen=True):
    """A revolute or prismatic joint."""

    scoped: str  # the name in Gazebo, `model::joint`
    name: str  # the name in variables
    revolute: bool
    effort_limit: float  # largest absolute effort in N m or N; infinite without a limit
    free: bool  # whether it has no limits, whatever the file says


class GazeboLink(msgspec.Struct, frozen=True):
    """A link; `scoped` and `name` as those of a `GazeboJoint`."""

    scoped: str
    name: str


class GazeboPlugin(msgspec.Struct, frozen=True):
    """A plugin of gazebo-fmi in a model."""

    section: str  # that of the instance with the same meaning
    model: GazeboModel
    element: Element
    file: Path


class GazeboWorld(msgspec.Struct, frozen=True):
    """A world."""

    text: bytes  # the SDF that Gazebo gets, without the plugins of gazebo-fmi
    element: Element  # of the world, as Gazebo gets it
    plugins: tuple[GazeboPlugin, ...]
    step_size: float  # of the engine in s
    real_time_factor: float  # that Gazebo itself keeps; 0: as fast as possible
    joints: tuple[GazeboJoint, ...]
    links: tuple[GazeboLink, ...]
    description: ModelDescription
    places: dict[str, WorldVariable]  # the variables by name


def load_gazebo_world(path: Path, config: GazeboClassicConfig = _NO_COUPLINGS) -> GazeboWorld:
    """Read the world at ``path``; `LoadFailed` if Gazebo could not load it."""
    file = WorldFile(path)
    world, notes = file.world, file.notes
    models = [*_models(world, "", path, file)]
    _refuse_what_gazebo_leaves_out(world, models, path)
    continuous = [joint for joint in world.iter("joint") if joint.get("type") == "continuous"]
    for joint in continuous:
        _make_revolute(joint)
    physics = world.find("physics")
    if physics is not None and physics.get("type") == "bullet":
        notes.append("forces and moments of links have no effect: Gazebo does not apply any with Bullet")
        if config.fluid_dynamics:
            raise LoadFailed(f"'{path}' has the engine Bullet, with which Gazebo applies no forces to links")
    plugins = tuple(_taken_plugins(models, file))
    if plugins and not (config.actuators or config.fluid_dynamics):
        notes.append(
            f"the plugins of gazebo-fmi are not loaded: `fmu-mesh launch {path.name}` has their FMUs as instances"
        )
    text = etree.tostring(file.root) if notes or continuous or plugins else file.source
    notes += _notes(world, models)
    step_size = _number(world.findtext("physics/max_step_size"), _DEFAULT_STEP_SIZE, path)
    rate = _number(world.findtext("physics/real_time_update_rate"), _DEFAULT_RATE, path)
    free = {actuator.joint for actuator in config.actuators if actuator.disable_velocity_effort_limits}
    moving = [model for model in models if model.moving]
    joints, links = _joints(moving, free, path), _links(moving)
    variables = numbered(_variables(joints, links))
    description = ModelDescription(
        model_name=world.get("name") or path.stem,
        model_identifier="gazebo_classic",
        fmi_version="",
        kind="physics_engine",
        guid=file.sha256[:32],
        variables=tuple(own.variable for own in variables),
        generation_tool="Gazebo classic",
        default_experiment=DefaultExperiment(step_size=step_size),
        problems=tuple(notes),
    )
    places = {own.variable.name: own for own in variables}
    speed = max(0.0, rate * step_size)
    return GazeboWorld(text, world, plugins, step_size, speed, joints, links, description, places)


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
    in_state = {"position": 0, "orientation": 3, "linear_velocity": 7, "angular_velocity": 10}
    places = {what: ("state", state + offset) for what, offset in in_state.items()}
    places |= {what: (what, 3 * number) for what in DERIVED} | {"wind": ("body_wind", 3 * number)}
    places |= {"force": ("wrench", 6 * number), "moment": ("wrench", 6 * number + 3)}
    variables = [*body_variables(name, "link", places)]
    yield from variables[:LINK_STATE]
    for axis in range(3):  # in the order of value references, all that is along x comes before y and z
        yield from variables[LINK_STATE + axis :: 3]


# --- reading the file


def _models(parent: Element, scope: str, path: Path, file: WorldFile) -> Iterator[GazeboModel]:
    for element in parent.findall("model"):
        scoped, own = f"{scope}{element.get('name')}", file.files.get(element, path)
        yield GazeboModel(scoped, element, own, element.findtext("static", "false").strip() not in {"true", "1"})
        yield from _models(element, f"{scoped}::", own, file)


def _taken_plugins(models: Sequence[GazeboModel], file: WorldFile) -> Iterator[GazeboPlugin]:
    """The plugins of gazebo-fmi, taken out of their models: Gazebo would run the FMUs as well."""
    for model in models:
        for plugin in model.element.findall("plugin"):
            if (section := _PLUGINS.get(PurePosixPath(plugin.get("filename", "")).name)) is not None:
                model.element.remove(plugin)
                yield GazeboPlugin(section, model, plugin, file.files.get(plugin, model.file))


def _refuse_what_gazebo_leaves_out(world: Element, models: Sequence[GazeboModel], path: Path) -> None:
    """Parts that Gazebo ignores although they change the motion; and names with spaces.

    A space ends a name in the protocol of Gazebo's process.
    """
    problems = [f"the world '{inner.get('name')}' in a world" for inner in world.findall("world")]
    problems += [f"the joint '{joint.get('name')}' outside of a model" for joint in world.findall("joint")]
    names_of_models = Counter(model.scoped for model in models)
    problems += [f"{count} models '{name}'" for name, count in names_of_models.items() if count > 1]
    for model in models:
        for joint in model.element.findall("joint"):
            if joint.get("type") not in _JOINTS:
                problems.append(f"the joint '{model.scoped}::{joint.get('name')}' of the type '{joint.get('type')}'")
        names = [f"{model.scoped}::{own.get('name')}" for own in model.element if own.tag in {"joint", "link"}]
        problems += [f"a space in the name '{name}'" for name in names if model.moving and len(name.split()) != 1]
    if problems:
        hint = f"There are joints of the types {', '.join(_JOINTS)}, each in a <model>."
        raise LoadFailed(f"'{path}' has what cannot be simulated with Gazebo classic: {'; '.join(problems)}", hint=hint)


def _make_revolute(joint: Element) -> None:
    """Replace a continuous joint, which Gazebo classic does not have, by a revolute joint without position limits."""
    joint.set("type", "revolute")
    for limit in joint.iterfind("axis/limit"):
        for end in [*limit.findall("lower"), *limit.findall("upper")]:
            limit.remove(end)


def _notes(world: Element, models: Sequence[GazeboModel]) -> Iterator[str]:
    for model in models:
        for joint in model.element.findall("joint"):
            name, kind = f"{model.scoped}::{joint.get('name')}", joint.get("type")
            if kind in _WITHOUT_VARIABLES:
                yield f"the joint '{name}' is simulated, and has no variables, as it is a {kind} joint"
            elif kind in _WITH_VARIABLES and not model.moving:
                yield f"the joint '{name}' has no variables: its model is static"
        for collision in model.element.iterfind("link/collision"):
            for uri in collision.iterfind("geometry//uri"):
                name = f"{model.scoped}::{collision.get('name')}"
                yield f"the collision '{name}' is not simulated unless Gazebo finds {(uri.text or '').strip()}"
    for sensor in world.iter("sensor"):
        yield f"the sensor '{sensor.get('name')}' has no variables"
    for plugin in world.iter("plugin"):
        yield f"the plugin '{plugin.get('filename')}' does nothing unless Gazebo finds it"
