"""An SDF world for Gazebo classic: read, completed, and checked for parts that Gazebo would silently leave out.

Owns which parts of SDF can be simulated. Other parts that change the motion are refused by name; parts that have no
variables or do not change the motion are notes. Knows nothing of variables: those are
`fmu_mesh.instances.gazebo.gazebo_world`.
"""

from __future__ import annotations

import re
import xml.etree.ElementTree as ET
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import unquote

import msgspec

from ...archives.safe_xml import safe_xml
from ...errors import LoadFailed
from ...files import opened

__all__ = ["GazeboModel", "SdfWorld", "read_world"]

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
    """A model, also one in another model.

    Attributes:
        scoped: the name in Gazebo, such as `outer::inner`.
        moving: whether it is not static; Gazebo lets a model in a static one move.
    """

    scoped: str
    element: ET.Element
    moving: bool


class SdfWorld(msgspec.Struct, frozen=True):
    """A world.

    Attributes:
        text: the SDF that Gazebo gets; the unchanged file if nothing had to be changed.
        source: the file.
        element: the world as Gazebo gets it.
        models: all models, outer ones first.
        notes: parts that differ from the file or have no variables.
    """

    text: bytes
    source: bytes
    element: ET.Element
    models: tuple[GazeboModel, ...]
    notes: tuple[str, ...]


def read_world(path: Path) -> SdfWorld:
    """Read the world at ``path``.

    Raises:
        LoadFailed: it is no world that Gazebo could simulate without looking elsewhere.
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
    models = tuple(_models(world, ""))
    _refuse_what_gazebo_leaves_out(world, models, path)
    changed = bool(notes)
    for joint in world.iter("joint"):
        if joint.get("type") == "continuous":
            _make_revolute(joint)
            changed = True
    notes += _notes(world, models)
    return SdfWorld(ET.tostring(root) if changed else source, source, world, models, tuple(notes))


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


def _refuse_what_gazebo_leaves_out(world: ET.Element, models: tuple[GazeboModel, ...], path: Path) -> None:
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


def _notes(world: ET.Element, models: tuple[GazeboModel, ...]) -> Iterator[str]:
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
