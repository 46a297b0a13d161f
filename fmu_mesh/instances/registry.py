"""From an entry of the configuration to its model description, and from a plan to an instance.

The one place that knows all kinds of instances: a new kind is described and opened here, and nowhere else.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import msgspec

from .. import files
from ..config.findings import Findings
from ..config.mesh import AnyInstanceConfig, GazeboClassicConfig, MujocoConfig, PidConfig
from ..errors import ConfigurationError, LoadFailed
from ..system.plan import InstancePlan
from ..system.system import System
from ..text import listed
from ..variables.model_description import ModelDescription
from .contract import Instance
from .fmi import FmuInstance, LogMessage, Terms, content_of
from .fmi import describe as describe_fmu
from .fmi import open_instance as open_fmu
from .fmi import stepped as stepped_fmu
from .gazebo import GazeboClassicInstance, check_gazebo_classic, describe_gazebo_world
from .mujoco import Film, MujocoInstance, Picture, Window, describe_world, world_content
from .position_pid import PidInstance, describe_pid

__all__ = [
    "Showing",
    "check_engines",
    "check_showing",
    "content",
    "describe",
    "expected_model",
    "open_instance",
    "stepped",
]


class Showing(msgspec.Struct, frozen=True):
    """Whether and how a physics engine shows its world.

    Attributes:
        view: in a window.
        video: in a film.
    """

    view: bool = False
    video: Path | None = None


def describe(
    path: Path, config: AnyInstanceConfig, terms: Terms, tell: Callable[[str], None] = lambda _text: None
) -> ModelDescription:
    """The model description of an instance; an FMU without a binary for this platform is compiled.

    Args:
        path: the file of its model.
        config: its section of the configuration.
        terms: what an FMU has to keep to.
        tell: called with what takes its time before it begins.

    Raises:
        LoadFailed: the model cannot be read.
    """
    match config:
        case MujocoConfig():
            return describe_world(path, config)
        case GazeboClassicConfig():
            return describe_gazebo_world(path, config)
        case PidConfig():
            return describe_pid()
        case _:
            return describe_fmu(path, terms, config.kind, tell)


def content(path: Path, config: AnyInstanceConfig) -> str:
    """A SHA-256 of all files that the model of an instance is made of, wherever they lie.

    Raises:
        LoadFailed: one cannot be read.
    """
    try:
        match config:
            case MujocoConfig():
                return world_content(path)
            case GazeboClassicConfig():
                return files.sha256_of(path)  # nothing else is read, see `fmu_mesh.instances.gazebo.gazebo_world`
            case PidConfig():
                return ""  # it is part of our version
            case _:
                return content_of(path)
    except OSError as error:
        raise LoadFailed(f"'{path}' cannot be read: {error.strerror or error}.") from error


def expected_model(config: AnyInstanceConfig) -> str:
    """In words what an instance's file should be."""
    if isinstance(config, MujocoConfig):
        return "a MuJoCo model (MJCF or URDF)"
    if isinstance(config, GazeboClassicConfig):
        return "an SDF world for Gazebo classic 11"
    return "an FMI 1.0, 2.0 or 3.0 FMU for this platform"


def open_instance(  # noqa: PLR0913, PLR0917 an instance and its surroundings
    item: InstancePlan,
    description: ModelDescription,
    folder: Path,
    log: Callable[[LogMessage], None],
    terms: Terms,
    showing: Showing = Showing(),  # noqa: B008  a frozen Struct
) -> Instance:
    """Open an instance; the caller closes it.

    Args:
        item: what the plan says of it.
        description: what `describe` returned for it.
        folder: an existing private folder for files.
        log: called with every message of the FMU or engine.
        terms: what an FMU has to keep to.
        showing: for a physics engine.

    Raises:
        LoadFailed: it cannot be opened.
    """
    match item.hosted:
        case MujocoConfig() as config:

            def log_engine(status: str, text: str, step: int) -> None:
                log(LogMessage(item.name, status, "engine", text, step))

            return MujocoInstance(Path(item.fmu), item.name, config, log_engine, _picture(item.name, showing))
        case GazeboClassicConfig() as config:
            return GazeboClassicInstance(Path(item.fmu), item.name, config)
        case PidConfig():
            return PidInstance(item.name)
        case None:
            return open_fmu(Path(item.fmu), item.name, description, folder, log, terms, item.options)


def stepped(instance: Instance, item: InstancePlan) -> Instance:
    """What is stepped for an opened instance: it with its linear inputs, if it has some."""
    return stepped_fmu(instance, item.options) if isinstance(instance, FmuInstance) else instance


def check_engines(system: System, file: str) -> None:
    """See whether the engines of all instances that no `host` is named for are on this host.

    Raises:
        ConfigurationError: one is missing.
    """
    hosted = {name: own.hosted for name, own in system.instances.items()}
    here = [name for name, own in hosted.items() if isinstance(own, GazeboClassicConfig) and own.host is None]
    try:
        if here:
            check_gazebo_classic()
    except LoadFailed as error:
        expected = f"an engine that runs here, or the `host` of the instance. {error.hint}"
        findings = Findings(file)
        for name in here:
            findings.add(f"instances.{name}.gazebo_classic", error.message, expected)
        findings.raise_any()


def check_showing(system: System, showing: Showing) -> None:
    """See whether there is one world to show.

    Raises:
        ConfigurationError: there is none, or there are several.
    """
    if not showing.view and showing.video is None:
        return
    worlds = [name for name, instance in system.instances.items() if isinstance(instance.hosted, MujocoConfig)]
    if len(worlds) != 1:
        option = "--view" if showing.view else "--video"
        found = f"this one has {listed(worlds)}" if worlds else "this one has none"
        raise ConfigurationError(f"{option} shows the one physics engine of a mesh, and {found}.")


def _picture(name: str, showing: Showing) -> Picture | None:
    if showing.video is not None:
        return Film(showing.video, name)
    return Window() if showing.view else None
