"""From an SDF world with the plugins of gazebo-fmi to the values of a configuration, as a YAML file gives them.

Owns the tags of the two plugins, and how these find joints, links and FMUs. Where the code of gazebo-fmi does something
else than its documentation, there is a warning.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Final, NamedTuple, TypeVar

from msgspec import structs

from .. import files
from ..config.findings import ValueOrigin
from ..config.loading import PlainConfig
from ..config.yaml_text import Plain
from ..errors import ConfigurationError, LoadFailed
from ..instances.gazebo.gazebo_process import HOW_TO_GET_IT, GazeboGone, find_program
from ..instances.gazebo.gazebo_world import GazeboJoint, GazeboLink, GazeboPlugin, GazeboWorld, load_gazebo_world
from ..instances.gazebo.world_includes import MODELS, Element, folders_of
from ..text import listed, nearest
from .naming import WORLD, instance_name, mesh_name
from .problems import Problems
from .system_structure import FilePlace

__all__ = ["read_fmi_world"]

_RESOURCES: Final = "GAZEBO_RESOURCE_PATH"
_BOOLEANS: Final = {"true": True, "1": True, "false": False, "0": False}
_ENTRIES: Final = {"actuators": ("actuator", "joint"), "fluid_dynamics": ("single_body_fluid_dynamics", "link")}
"""By section of the world: the tag of an entry of the plugin, and in it that of the part of the model."""
_NO_LIMITS: Final = "disable_velocity_effort_limits"
_OLD_NAMES: Final = {
    f"{name}Name": name
    for name in ("actuatorInput", "jointPosition", "jointVelocity", "jointAcceleration", "jointTorque")
}
"""Old tags with the name of a variable in the FMU; now these are in `<variable_names>`."""


P = TypeVar("P", GazeboJoint, GazeboLink)


class _Entry(NamedTuple):
    """One entry of a plugin: its name, and the first child with each tag."""

    plugin: GazeboPlugin
    element: Element
    name: str
    given: dict[str, Element]


def read_fmi_world(path: Path) -> PlainConfig:
    """Read a world as the values of a configuration; Gazebo is not needed for that.

    The world is the instance `world`. Every joint has a controller, as in Gazebo, without an effect until its gains are
    set. What the configuration means is checked with everything else before a run.
    """
    try:
        return _Couplings(path, load_gazebo_world(path)).plain()
    except LoadFailed as error:
        raise ConfigurationError(error.message, hint=error.hint) from error


class _Couplings:
    """The instances for the joints of a world and for all entries of its plugins, and how they are coupled to it."""

    def __init__(self, path: Path, world: GazeboWorld) -> None:
        self._path, self._world, self._problems = path, world, Problems()
        self._section: dict[str, Plain] = {"gazebo_classic": path.name}
        self._instances: dict[str, Plain] = {WORLD: self._section}
        self._origins: dict[str, ValueOrigin] = {}

    def plain(self) -> PlainConfig:
        """All of it."""
        world, line = self._world, self._world.element.sourceline
        top = FilePlace(str(self._path), line, "world")
        try:
            find_program()
        except GazeboGone as error:
            found = f"Gazebo classic does not run on this host: {error}. {HOW_TO_GET_IT}"
            self._problems.warn(top, found)
        for joint in world.joints:
            instance = self._instance([*joint.name.split("::"), "pid"], {"controller": "position_pid"}, top)
            self._couple("controllers", {"name": joint.name, "joint": joint.name, "instance": instance}, top)
        entries = [entry for plugin in world.plugins for entry in self._entries(plugin)]
        counts = Counter(entry.name for entry in entries)
        for entry in entries:
            self._add(entry, is_unique=counts[entry.name] == 1)
        speed = world.real_time_factor
        data: dict[str, Plain] = {
            "mesh": mesh_name(self._path.stem),
            "simulation": {"stop_time": None, "step_size": world.step_size, "real_time_factor": speed},
            "instances": self._instances,
            "group": "auto",
        }
        findings, warnings = map(tuple, (self._problems.findings, self._problems.warnings))
        return PlainConfig(data, self._path, {"": line}, findings, origins=self._origins, warnings=warnings)

    def _entries(self, plugin: GazeboPlugin) -> Iterator[_Entry]:
        """The entries of a plugin that are enabled; that for fluid dynamics reads only its first one."""
        tag, part = _ENTRIES[plugin.section]
        known = ["name", part, "fmu", "variable_names"]
        if part == "joint":
            known += ["enabled", _NO_LIMITS, *_OLD_NAMES]
        if tag not in self._children(plugin, plugin.element, ("verbose", tag)):
            self._problems.add(_place(plugin, plugin.element), "a plugin without an entry", f"<{tag}>")
        for element in plugin.element.findall(tag)[: None if part == "joint" else 1]:
            given = self._children(plugin, element, known)
            missing = [own for own in (part, "fmu") if not _text(given.get(own))]
            for own in missing:
                near = nearest(own, given.keys() - {*known})
                unknown = f", but the unknown tag <{near}>" if near is not None else ""
                self._problems.add(_place(plugin, element), f"no <{own}>{unknown}", f"<{own}>")
            if not missing and self._flag(plugin, given.get("enabled"), default=True):
                yield _Entry(plugin, element, _text(given.get("name")) or _text(given[part]), given)

    def _children(self, plugin: GazeboPlugin, element: Element, known: Sequence[str]) -> dict[str, Element]:
        """The first child with each tag; a warning for each one that has no effect."""
        first: dict[str, Element] = {}
        for child in element.iterchildren("*"):
            if child.tag not in known:
                near = nearest(child.tag, known)
                expected = f"<{near}>" if near is not None else f"one of {listed(known)}"
                self._problems.warn(_place(plugin, child), "the unknown tag has no effect", expected)
            elif child.tag in first and child.tag != "actuator":
                self._problems.warn(_place(plugin, child), "a second one has no effect", f"one <{child.tag}>")
            first.setdefault(child.tag, child)
        return first

    def _flag(self, plugin: GazeboPlugin, element: Element | None, *, default: bool = False) -> bool:
        text = _text(element).lower()
        if element is not None and text not in _BOOLEANS:
            self._problems.add(_place(plugin, element), f"'{text}'", "true or false")
        return _BOOLEANS.get(text, default)

    def _add(self, entry: _Entry, *, is_unique: bool) -> None:
        """Add the instance of an entry, and how it is coupled to the world."""
        plugin, _, name, given = entry
        part = _ENTRIES[plugin.section][1]
        found = self._joint(entry) if part == "joint" else self._link(entry)
        fmu = self._fmu(plugin, given["fmu"])
        if found is None or fmu is None:
            return
        place = _place(plugin, entry.element)
        path = [name] if is_unique and name != WORLD else [*plugin.model.scoped.split("::"), name]
        instance = self._instance(path, {"fmu": fmu}, place)
        coupling: dict[str, Plain] = {"name": name, part: found.name, "instance": instance}
        if self._flag(plugin, given.get(_NO_LIMITS)):
            coupling[_NO_LIMITS] = True
        names = {own.tag: own.get("name") for own in given.get("variable_names", ()) if isinstance(own.tag, str)}
        for tag, own in _OLD_NAMES.items():
            if tag in given:
                names[own] = _text(given[tag])
                expected = f'<variable_names><{own} name="{names[own]}"/></variable_names>'
                self._problems.warn(_place(plugin, given[tag]), "an old tag", expected)
        for own in [own for own in names if not names[own]]:
            self._problems.add(place, f"<{own}> without a name", f'<{own} name="..."/>')
        if names:
            coupling["variable_names"] = names
        self._couple(plugin.section, coupling, place)

    def _joint(self, entry: _Entry) -> GazeboJoint | None:
        """The joint with a name, or else the first one whose last part is the name, or which ends with it."""
        own, wanted = _inside(entry.plugin, self._world.joints), _text(entry.given["joint"])
        exact = [joint for name, joint in own.items() if wanted in {name, joint.scoped}]
        last = [joint for name, joint in own.items() if name.rpartition("::")[2] == wanted]
        found = exact or last or [joint for name, joint in own.items() if name.endswith(wanted)]
        place = _place(entry.plugin, entry.given["joint"])
        if not found:
            self._problems.unknown(place, f"no moving revolute or prismatic joint '{wanted}'", wanted, own)
        elif len(found) > 1 or not (exact or last):
            ends = listed([joint.scoped for joint in found])
            self._problems.warn(place, f"'{wanted}' is the end of {ends}: the first one is used", "a full name")
        return found[0] if found else None

    def _link(self, entry: _Entry) -> GazeboLink | None:
        """The link with a name, or else the first one of the model."""
        own, wanted = _inside(entry.plugin, self._world.links), _text(entry.given["link"])
        named = next((link for name, link in own.items() if wanted in {name, link.scoped}), None)
        first = next((link for name, link in own.items() if "::" not in name), None)
        chosen, place = named or first, _place(entry.plugin, entry.given["link"])
        if chosen is None:
            self._problems.unknown(place, f"no moving link '{wanted}'", wanted, own)
        elif named is None or named is not first:
            found = f"'{chosen.scoped}' is used; the code of gazebo-fmi always takes the first link of the model"
            self._problems.warn(place, found, f"one of {listed([*own])}" if named is None else "")
        return chosen

    def _fmu(self, plugin: GazeboPlugin, element: Element) -> str | None:
        """The path of an FMU, relative to the world if it is beside it."""
        scheme, _, name = _text(element).rpartition("://")
        folders = folders_of(variable := MODELS if scheme == "model" else _RESOURCES, self._path)
        for folder in folders:
            if files.exists(folder / name):
                return name if folder == self._path.parent else str((folder / name).absolute())
        near = nearest(name, [own.name for folder in folders for own in folder.glob("*.fmu")])
        expected = f"a file beside the world, or in a folder of {variable} ({listed([*map(str, folders[1:])])})"
        self._problems.add(_place(plugin, element), f"no such file '{name}'", expected, near)
        return None

    def _instance(self, names: Sequence[str], section: Plain, place: FilePlace) -> str:
        """Add an instance; returns its name, which is made of ``names``."""
        instance = instance_name(names)
        while instance in self._instances:
            instance += "_"
        self._instances[instance] = section
        self._origins[f"instances.{instance}"] = ValueOrigin(*structs.astuple(place))
        return instance

    def _couple(self, section: str, coupling: Plain, place: FilePlace) -> None:
        entries = self._section.setdefault(section, [])
        assert isinstance(entries, list)  # only made here
        self._origins[f"instances.{WORLD}.{section}[{len(entries)}]"] = ValueOrigin(*structs.astuple(place))
        entries.append(coupling)


def _text(element: Element | None) -> str:
    return (element.text or "").strip() if element is not None else ""


def _place(plugin: GazeboPlugin, element: Element) -> FilePlace:
    words = f"<{element.tag}> of the model '{plugin.model.scoped}'"
    return FilePlace(str(plugin.file), element.sourceline or 0, words)


def _inside(plugin: GazeboPlugin, parts: Sequence[P]) -> dict[str, P]:
    """The parts of the model of a plugin and of the models in it, by their names in it."""
    scope = f"{plugin.model.scoped}::"
    return {part.scoped.removeprefix(scope): part for part in parts if part.scoped.startswith(scope)}
