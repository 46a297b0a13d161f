"""The installed kinds of instances, found by their keys through the entry points `fmu_mesh.instances`.

Our own kinds are found in the same way as those of other packages. Nothing else in the package knows which kinds there
are. A kind is imported when a configuration has its key, and what it needs when a model is described or opened.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from functools import cache, partial
from pathlib import Path
from typing import Any

import msgspec
from msgspec.structs import replace

from ..config.findings import Findings
from ..config.instance_sections import KIND, InstanceSection, key_of
from ..config.mesh import LimitsConfig
from ..errors import ConfigurationError, LoadFailed
from ..plugins import own_plugin_names, plugin, plugin_names
from ..system.process_sharing import Claims
from ..text import listed
from ..variables.model_description import ModelDescription
from .contract import Instance, Kind, Opening, Showing
from .held_instance import HeldInstance
from .midpoint_inputs import MidpointInputs
from .tight_member import TightMember

__all__ = [
    "GROUP",
    "KINDS",
    "check_engines",
    "check_showing",
    "claims",
    "content",
    "decode_section",
    "describe",
    "expected_model",
    "files_of",
    "host_checks",
    "needs_compiler",
    "open_instance",
    "preload",
    "prepare",
]

GROUP = "fmu_mesh.instances"
"""The group of entry points."""

_USUAL = "fmu"
"""The kind of an instance whose keys do not say it, for findings."""


class InstalledKinds:
    """The installed kinds as reading a configuration needs them; see `fmu_mesh.config.instance_sections.Kinds`."""

    def own(self) -> dict[str, type[InstanceSection]]:
        """The sections of our own kinds by key, that of FMUs first."""
        names = sorted(own_plugin_names(GROUP), key=lambda name: (name != _USUAL, name))
        return {name: self.section(name) for name in names}

    def names(self) -> list[str]:
        """The keys of all installed kinds, ours first."""
        return _names()

    def section(self, key: str) -> type[InstanceSection]:
        """The section of the kind with the key ``key``; `ConfigurationError` says why there is none."""
        section: type[InstanceSection] = _kind(key).section
        return section


KINDS = InstalledKinds()


@cache
def _names() -> list[str]:
    return plugin_names(GROUP)  # reads all distributions


def decode_section(type_: type, value: object) -> object:
    """The `dec_hook` of msgspec for what holds an `InstanceSection`: its tag says which kind decodes it.

    Example:
        >>> received = '{"@kind": "fmu", "fmu": "fmus/Gain.fmu"}'
        >>> msgspec.json.decode(received, type=InstanceSection, dec_hook=decode_section).fmu
        'fmus/Gain.fmu'

    Raises:
        ConfigurationError: no installed kind has this tag.
    """
    if type_ is not InstanceSection or not isinstance(value, dict):
        raise NotImplementedError(type_)
    return msgspec.convert(value, _kind(str(value.get(KIND))).section)


def describe(
    path: Path,
    section: InstanceSection,
    limits: LimitsConfig = LimitsConfig(),  # noqa: B008  a frozen Struct
    tell: Callable[[str], None] = lambda _text: None,
) -> ModelDescription:
    """The model description of an instance; see `Kind.describe`."""
    return _kind_of(section).describe(path, section, limits, tell)


def needs_compiler(path: Path, section: InstanceSection, limits: LimitsConfig) -> bool:
    """Whether `describe` would compile something; see `Kind.needs_compiler`. No, where it would say what is wrong."""
    with suppress(LoadFailed):
        return _kind_of(section).needs_compiler(path, section, limits)
    return False


def content(path: Path, section: InstanceSection) -> str:
    """A SHA-256 of all files that the model of an instance consists of; `LoadFailed` if one cannot be read."""
    try:
        return _kind_of(section).content(path)
    except OSError as error:
        raise LoadFailed(f"'{path}' cannot be read: {error.strerror or error}.") from error


def files_of(path: Path, section: InstanceSection) -> Sequence[Path]:
    """All files of the model of an instance; see `Kind.files`."""
    return _kind_of(section).files(path)


def claims(path: Path, section: InstanceSection, description: ModelDescription, limits: LimitsConfig) -> Claims:
    """What an instance claims of its process; see `Kind.claims`."""
    only_once = {f"the FMU {description.guid} allows one instance per process": ""}
    try:
        claimed = _kind_of(section).claims(path, section, description, limits)
    except OSError as error:
        raise LoadFailed(f"'{path}' cannot be read: {error.strerror or error}.") from error
    return {**claimed, **only_once} if description.only_once_per_process else claimed


def expected_model(section: InstanceSection) -> str:
    """In words, what the file of the model of an instance should be."""
    return _kind_of(section).expected


def preload() -> None:
    """Import what the instances of most meshes need; see `Kind.preload`."""
    _kind(_USUAL).preload()


def prepare(opening: Opening[Any]) -> None:
    """Do once what every `open_instance` of a model needs; see `Kind.preload` and `Kind.prepare`."""
    kind = _kind_of(opening.section)
    kind.preload()
    kind.prepare(opening)


def open_instance(opening: Opening[Any]) -> Instance:
    """Open an instance of whatever kind, with its `midpoint` inputs, `on_failure` and group; the caller closes it."""
    kind = _kind_of(opening.section)
    if opening.showing and not kind.can_be_shown:
        opening = replace(opening, showing=Showing())
    instance = kind.open(opening)
    if opening.group is not None:
        instance = TightMember(instance, opening)
    elif opening.midpoint_inputs:
        instance = MidpointInputs(instance, opening.midpoint_inputs)
    return instance if opening.section.on_failure == "stop" else HeldInstance(instance, opening)


def check_engines(
    sections: Mapping[str, InstanceSection],
    models: Mapping[str, tuple[Path, ModelDescription]],
    limits: LimitsConfig,
    findings: Findings,
) -> None:
    """Check that this host has what all instances need that no `host` is named for: engines, and libraries of a system.

    A finding is added for each instance that misses something. ``models`` has the absolute path and the description of
    the model of each.
    """
    reasons: dict[object, LoadFailed | None] = {}
    for name, section in sections.items():
        if section.host is not None:
            continue
        key, kind, (path, description) = key_of(section), _kind_of(section), models[name]
        asked: dict[object, Callable[[], None]] = {
            key: kind.check_engine,
            (key, path): partial(kind.check_model, path, description, limits),
        }
        for what, check in asked.items():
            if what not in reasons:
                reasons[what] = None
                try:
                    check()
                except LoadFailed as error:
                    reasons[what] = error
            if (reason := reasons[what]) is not None:
                needed = "an engine that runs here" if what == key else "a system that has all libraries"
                expected = f"{needed}, or the `host` of the instance. {reason.hint or ''}".rstrip()
                findings.add(f"instances.{name}.{key}", reason.message, expected)
                break


def host_checks() -> dict[str, Callable[[], str]]:
    """What all installed kinds look for on this host, by its name; see `Kind.host_checks`."""
    found: dict[str, Callable[[], str]] = {}
    for key in _names():
        try:
            found.update(_kind(key).host_checks())
        except ConfigurationError:  # its package is broken, and says so when it is asked again
            found[f"Kind '{key}'"] = partial(lambda key: str(_kind(key)), key)
    return found


def check_showing(sections: Mapping[str, InstanceSection], showing: Showing) -> None:
    """Check that there is one world to show, and that this host can show it.

    Call it before any model is described: an engine may have to know of a film when it is imported.
    """
    if not showing:
        return
    worlds = [name for name, section in sections.items() if _kind_of(section).can_be_shown]
    if len(worlds) != 1:
        option = "`view=True`" if showing.view else "`video=...`"
        found = f"this one has {listed(worlds)}" if worlds else "this one has none"
        raise ConfigurationError(f"{option} shows the one physics engine of a mesh, and {found}.")
    _kind_of(sections[worlds[0]]).check_showing(showing)


def _kind_of(section: InstanceSection) -> Kind[Any]:
    return _kind(key_of(section))


def _kind(key: str) -> Kind[Any]:
    """The kind with a key."""
    kind = plugin(GROUP, key)
    if kind is None:
        text = f"no installed package offers the kind of instance '{key}'; there are {listed(plugin_names(GROUP))}."
        raise ConfigurationError(text, hint="Install its package in the same Python on this host.")
    if not isinstance(kind, Kind) or key_of(kind.section) != key:
        text = f"what the entry point '{key}' ('{GROUP}') names is no kind whose section has the tag '{key}'."
        raise ConfigurationError(text, hint="See docs/extending.md.")
    return kind
