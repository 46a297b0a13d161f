"""From an entry of the configuration to its model description, and from a plan to an instance.

The one place that knows all kinds of instances: a new kind is described and opened here, and nowhere else.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import msgspec

from ..errors import ConfigurationError
from ..fmu import Fmi2Instance, LogMessage, read_description
from ..hosts import (
    Film,
    GazeboClassicInstance,
    MujocoInstance,
    Picture,
    PidInstance,
    Window,
    describe_gazebo_world,
    describe_pid,
    describe_world,
)
from ..model.config import AnyInstanceConfig, GazeboClassicConfig, MujocoConfig, PidConfig
from ..model.description import ModelDescription
from ..model.findings import listed
from ..model.instance import Instance
from ..model.plan import InstancePlan
from ..model.system import System, SystemInstance

__all__ = ["Showing", "check_showing", "describe", "expected_model", "open_instance"]


class Showing(msgspec.Struct, frozen=True):
    """Whether and how a physics engine shows its world.

    Attributes:
        view: in a window.
        video: in a film.
    """

    view: bool = False
    video: Path | None = None


def describe(path: Path, config: AnyInstanceConfig) -> ModelDescription:
    """The model description of an instance.

    Args:
        path: the file of its model.
        config: its section of the configuration.

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
            return read_description(path)


def expected_model(config: AnyInstanceConfig) -> str:
    """In words what an instance's file should be."""
    if isinstance(config, MujocoConfig):
        return "a MuJoCo model (MJCF or URDF)"
    if isinstance(config, GazeboClassicConfig):
        return "an SDF world for Gazebo classic 11"
    return "an FMI 2.0 co-simulation FMU for this platform"


def open_instance(
    item: InstancePlan | SystemInstance,
    folder: Path,
    log: Callable[[LogMessage], None],
    showing: Showing = Showing(),  # noqa: B008  a frozen Struct
) -> Instance:
    """Open an instance; the caller closes it.

    Args:
        item: what the plan says of it.
        folder: an existing private folder for files.
        log: called with every message of the FMU or engine.
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
            path = Path(item.fmu)
            return Fmi2Instance(path, item.name, read_description(path), folder, log)


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
