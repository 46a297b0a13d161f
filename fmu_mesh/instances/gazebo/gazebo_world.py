"""An SDF world for Gazebo classic: read, completed, checked, and as a model description.

Owns which parts of SDF can be simulated, and where the value of each variable is stored. Parts that Gazebo would
silently leave out and that change the motion are refused by name; parts that have no variables or do not change the
motion are notes. Names, units and meaning of the variables are those of MuJoCo (`fmu_mesh.instances.world_variables`),
so that one configuration fits both engines; sensors and actuators of the model have no variables. The steps are in
`fmu_mesh.instances.gazebo.gazebo_classic`.

A joint or link is named as in the file where that name is unique, and `model::name` where it is not.
"""

from __future__ import annotations

import hashlib
import math
import re
import xml.etree.ElementTree as ET
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from urllib.parse import unquote

import msgspec

from ...archives.safe_xml import safe_xml
from ...errors import LoadFailed
from ...files import opened
from ...variables.model_description import DefaultExperiment, ModelDescription
from ..world_variables import WorldVariable, body_variables, joint_variables, numbered, world_input
from .gazebo_section import GazeboClassicConfig

__all__ = ["GazeboJoint", "GazeboLink", "GazeboWorld", "load_gazebo_world"]

JOINT_STATE, LINK_STATE = 3, 13
"""Numbers per joint (position, velocity, acceleration) and link (position, attitude, two velocities) in a state."""

_DEFAULT_STEP_SIZE = 1e-3
"""s; of SDF (physics, max_step_size)."""

_WITH_VARIABLES = ("revolute", "prismatic")
_WITHOUT_VARIABLES = ("ball", "universal", "screw", "revolute2", "gearbox")
_JOINTS = ("revolute", "continuous", "prismatic", "fixed", *_WITHOUT_VARIABLES)

_VERSION = re.compile(r"/(\d+|tip)$")

_GROUND = """
<model name="ground_plane">
  <static>true</static>
  <link name="link">
    <collision name="collision">
      <geometry><plane><normal>0 0 1</normal><size>100 100</size></plane></geometry>
      <surface><friction><ode><mu>100</mu><mu2>50</mu2></ode></friction></surface>
    </collision>
  </link>
</model>
"""
"""Has the same effect on the motion as Gazebo's own model of this name."""


class GazeboModel(msgspec.Struct, frozen=True):
    """A model, also one in another model."""

    scoped: str  # the name in Gazebo, such as `outer::inner`
    element: ET.Element
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


class GazeboWorld(msgspec.Struct, frozen=True):
    """A world."""

    text: bytes  # the SDF that Gazebo gets
    step_size: float  # of the engine in s
    joints: tuple[GazeboJoint, ...]
    links: tuple[GazeboLink, ...]
    description: ModelDescription
    places: dict[str, WorldVariable]  # the variables by name


def load_gazebo_world(path: Path, config: GazeboClassicConfig) -> GazeboWorld:
    """Read the world at ``path``; `LoadFailed` if Gazebo could not load it without looking elsewhere."""
    text, source, world, models, notes = _read(path)
    step_size = _number(world.findtext("physics/max_step_size"), _DEFAULT_STEP_SIZE, path)
    free = {actuator.joint for actuator in config.actuators if actuator.disable_velocity_effort_limits}
    moving = [model for model in models if model.moving]
    joints, links = _joints(moving, free, path), _links(moving)
    variables = numbered(_variables(joints, links))
    description = ModelDescription(
        model_name=world.get("name") or path.stem,
        model_identifier="gazebo_classic",
        fmi_version="",
        kind="physics_engine",
        guid=hashlib.sha256(source).hexdigest()[:32],
        variables=tuple(own.variable for own in variables),
        generation_tool="Gazebo classic",
        default_experiment=DefaultExperiment(step_size=step_size),
        problems=tuple(notes),
    )
    places = {own.variable.name: own for own in variables}
    return GazeboWorld(text, step_size, joints, links, description, places)


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
    places |= {"wind": ("body_wind", 3 * number), "relative_velocity": ("relative_velocity", 3 * number)}
    places |= {"force": ("wrench", 6 * number), "moment": ("wrench", 6 * number + 3)}
    variables = [*body_variables(name, "link", places)]
    yield from variables[:LINK_STATE]
    for axis in range(3):  # in the order of value references, all that is along x comes before y and z
        yield from variables[LINK_STATE + axis :: 3]


# --- reading the file


def _read(path: Path) -> tuple[bytes, bytes, ET.Element, Sequence[GazeboModel], list[str]]:
    """The world at ``path``: the text that Gazebo gets, and that of the file.

    Then the element of the world as Gazebo gets it; all models, outer ones first; and the parts that differ from the
    file or have no variables.
    """
    try:
        with opened(path) as file:
            source = file.read()
        safe_xml(source, f"'{path}'")
        root = ET.fromstring(source)  # noqa: S314  it was parsed safely
    except (OSError, ET.ParseError) as error:
        reason = error.strerror if isinstance(error, OSError) else str(error)
        raise LoadFailed(f"'{path}' cannot be read as an SDF world: {reason}") from error
    worlds = root.findall("world")
    if root.tag != "sdf" or len(worlds) != 1:
        raise LoadFailed(f"'{path}' is no SDF file with one world", hint="Gazebo classic 11 reads SDF up to 1.7.")
    (world,) = worlds
    notes = list(_without_known_includes(world))
    _refuse_includes(world, path)
    models = [*_models(world, "")]
    _refuse_what_gazebo_leaves_out(world, models, path)
    changed = bool(notes)
    for joint in world.iter("joint"):
        if joint.get("type") == "continuous":
            _make_revolute(joint)
            changed = True
    notes += _notes(world, models)
    return ET.tostring(root) if changed else source, source, world, models, notes


def _models(parent: ET.Element, scope: str) -> Iterator[GazeboModel]:
    for element in parent.findall("model"):
        scoped = f"{scope}{element.get('name')}"
        yield GazeboModel(scoped, element, element.findtext("static", "false").strip() not in {"true", "1"})
        yield from _models(element, f"{scoped}::")


def _without_known_includes(world: ET.Element) -> Iterator[str]:
    """Replace each include that needs no file by its model; yields a note for each."""
    for number, include in enumerate([*world]):
        uri = include.findtext("uri", "").strip() if include.tag == "include" else ""
        name = _VERSION.sub("", unquote(uri).rstrip("/")).rpartition("/")[2].casefold().replace(" ", "_")
        if name not in {"sun", "ground_plane"} or include.find("plugin") is not None:
            continue
        if name == "sun":
            world[number] = ET.Comment("a light")
            yield f"left out, as a light moves nothing: the included '{uri}'"
            continue
        ground = ET.fromstring(_GROUND)  # noqa: S314  our own text
        ground.set("name", include.findtext("name", "ground_plane").strip())
        if (pose := include.find("pose")) is not None:
            ground.append(pose)
        world[number] = ground
        yield f"a static plane stands for the included '{uri}'"


def _refuse_includes(world: ET.Element, path: Path) -> None:
    uris = [include.findtext("uri", "without a uri").strip() for include in world.iter("include")]
    if uris:
        models = f"a model ({uris[0]})" if len(uris) == 1 else f"models ({', '.join(uris)})"
        raise LoadFailed(
            f"'{path}' includes {models}",
            hint="Nothing is fetched for a run: write the text of each model in the place of its <include>, as "
            "`gz sdf -p WORLD` of a Gazebo that has the models prints it.",
        )


def _refuse_what_gazebo_leaves_out(world: ET.Element, models: Sequence[GazeboModel], path: Path) -> None:
    """Parts that Gazebo ignores although they change the motion; and names with spaces.

    A space ends a name in the protocol of Gazebo's process.
    """
    problems = [f"the world '{inner.get('name')}' in a world" for inner in world.findall("world")]
    problems += [f"the joint '{joint.get('name')}' outside of a model" for joint in world.findall("joint")]
    for model in models:
        for joint in model.element.findall("joint"):
            if joint.get("type") not in _JOINTS:
                problems.append(f"the joint '{model.scoped}::{joint.get('name')}' of the type '{joint.get('type')}'")
        names = [f"{model.scoped}::{own.get('name')}" for own in model.element if own.tag in {"joint", "link"}]
        problems += [f"a space in the name '{name}'" for name in names if model.moving and len(name.split()) != 1]
    if problems:
        hint = f"There are joints of the types {', '.join(_JOINTS)}, each in a <model>."
        raise LoadFailed(f"'{path}' has what cannot be simulated with Gazebo classic: {'; '.join(problems)}", hint=hint)


def _make_revolute(joint: ET.Element) -> None:
    """Replace a continuous joint, which Gazebo classic does not have, by a revolute joint without position limits."""
    joint.set("type", "revolute")
    for limit in joint.iterfind("axis/limit"):
        for end in [*limit.findall("lower"), *limit.findall("upper")]:
            limit.remove(end)


def _notes(world: ET.Element, models: Sequence[GazeboModel]) -> Iterator[str]:
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
