"""The values of a configuration for a file in another folder: relative paths lead to the same files from there."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, TypeGuard

from ..config.instance_sections import InstanceSection, key_of, keys_of
from ..config.loading import PlainConfig
from ..config.plain_values import plain
from ..instances.configuration import examine_data

__all__ = ["rebased"]

_Place = tuple[dict[str, Any], str]
"""A mapping, and the key in it whose value is a path."""


def rebased(configuration: PlainConfig, folder: Path) -> dict[str, Any]:
    """The values of a configuration as a file in ``folder`` has them.

    Example:
        >>> from fmu_mesh.config.loading import read_file
        >>> rebased(read_file(Path("configs/pendulum_delay.yaml")), Path())["instances"]["pendulum"]["fmu"]
        'fmus/DampedPendulum.fmu'

    Raises:
        ConfigurationError: too much of the configuration is wrong to know its paths.
    """
    data: dict[str, Any] = plain(configuration.data)
    old, new = (os.path.realpath(path) for path in (configuration.file.absolute().parent, folder))
    if old == new:
        return data

    def moved(path: str) -> str:
        # The last part is not resolved: a link says which file is meant.
        parent, name = os.path.split(path)
        return Path(os.path.relpath(os.path.realpath(os.path.join(old, parent)), new), name).as_posix()  # noqa: PTH118 text

    for name, section in examine_data(configuration)[0].config.instances.items():
        _move_files(data["instances"][name], section, moved, Path(old))
    for mapping, key in _places(data):
        if _is_relative(mapping.get(key)):
            mapping[key] = moved(mapping[key])
    return data


def _move_files(written: dict[str, Any], section: InstanceSection, moved: Callable[[str], str], folder: Path) -> None:
    """Move the paths of one instance: its model, and the other files that its section names."""
    key, path = key_of(section), section.path
    if _is_relative(path) and str(written.get(key, "")).startswith(path):  # behind it may be the name of a class
        written[key] = moved(path) + str(written[key])[len(path) :]
    located = section.located(folder)
    for other in keys_of(type(section)):
        value = written.get(other)
        if getattr(located, other) != getattr(section, other) and _is_relative(value) and "/" in value:
            written[other] = moved(value)


def _places(data: dict[str, Any]) -> Iterator[_Place]:
    """Where other sections may have paths."""
    records = data.get("record", {})
    for record in records if isinstance(records, list) else [records]:
        yield from _in(record, "file")
    yield data, "scenario"
    scenario = data.get("scenario")
    for values in (scenario.get("values") or {}).values() if isinstance(scenario, dict) else ():
        yield from _in(values, "file")
    yield from _in(data.get("zenoh"), "config")
    ros = data.get("ros")
    messages = ros.get("messages") if isinstance(ros, dict) else None
    if isinstance(messages, dict):
        yield from ((messages, name) for name in messages)


def _in(section: object, key: str) -> Iterator[_Place]:
    if isinstance(section, dict):
        yield section, key


def _is_relative(path: object) -> TypeGuard[str]:
    return isinstance(path, str) and path != "" and not path.startswith("~") and not Path(path).is_absolute()
