"""Changes of a configuration: by the calls of a program, which findings name, and for a file in another folder.

Owns no values: a `Mesh` asks these functions before and after it changes its own. What needs the models, such as
whether a variable exists, is checked by `Mesh.check`.
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final, TypeGuard, TypeVar

from msgspec.structs import replace

from ..config.findings import ValueOrigin
from ..config.instance_sections import InstanceSection, key_of, keys_of
from ..config.key_sections import KEY
from ..config.loading import PlainConfig
from ..config.plain_values import plain as plain_value
from ..errors import CallRefused, ConfigurationError, UnknownName
from ..instances.configuration import examine_data
from ..text import did_you_mean, listed, shown

__all__ = [
    "check_part",
    "connections_of",
    "ends_of",
    "rebased",
    "said_by",
    "sections_of",
    "unknown",
    "with_connections",
    "with_record",
    "without_instance",
]

T = TypeVar("T")

_CONNECTION: Final = re.compile(r"connections\[(\d+)\]")
_REST: Final[dict[str, Any]] = {
    "mesh": "mesh",
    "simulation": {"step_size": 1.0, "stop_time": 1.0},
    "instances": {"instance": {"fmu": "any.fmu"}},
}
"""A configuration without an error, around the part that is checked."""


def check_part(call: str, part: Mapping[str, Any], paths: Sequence[str], inside: str = "") -> None:
    """Check the structure of a part of a configuration, before it becomes one.

    ``paths`` are what the call gives: findings about anything else in these sections are not its own. ``inside`` is the
    start of these paths, which the call says already.

    Raises:
        CallRefused: there is a finding.
    """
    try:
        findings = [*examine_data(PlainConfig({**_REST, **part}, Path(call)))[1]]
    except ConfigurationError as error:
        findings = [*error.findings]
    own = [finding for finding in findings if any(_is_inside(finding.path, path) for path in paths)]
    if own:
        told = (replace(one, file=call, path=one.path.removeprefix(inside).removeprefix(".")) for one in own)
        raise CallRefused("; ".join(map(str, told)))


def said_by(plain: PlainConfig, call: str, paths: Sequence[str], *, new: bool = False) -> PlainConfig:
    """The same values, of which findings about the ones at ``paths`` name a call, and no line of a file.

    With ``new``, nothing is known about these paths; to look for it would make long programs slow.
    """
    left = plain if new else _without_places(plain, paths)
    return left._replace(origins={**left.origins, **dict.fromkeys(paths, ValueOrigin(call, None))})


def with_connections(plain: PlainConfig, keeps: Callable[[Any, Any], bool]) -> PlainConfig:
    """The values with some connections only; ``keeps`` is called with the source and the target of each."""
    connections = connections_of(plain)
    kept = [place for place, one in enumerate(connections) if keeps(*ends_of(one))]

    def moved(known: Mapping[str, T]) -> dict[str, T]:
        found: dict[str, T] = {}
        for path, own in known.items():
            item = _CONNECTION.match(path)
            if item is None:
                found[path] = own
            elif (place := int(item[1])) in kept:
                found[f"connections[{kept.index(place)}]{path[item.end() :]}"] = own
        return found

    data = {**sections_of(plain), "connections": [connections[place] for place in kept]}
    return plain._replace(data=data, lines=moved(plain.lines), origins=moved(plain.origins))


def without_instance(plain: PlainConfig, name: str) -> PlainConfig:
    """The values without an instance, its connections, what a scenario sets of it and what is recorded of it."""
    plain = with_connections(plain, lambda *ends: not any(_is_of(end, name) for end in ends))
    data = sections_of(plain)
    data["instances"] = {one: own for one, own in data["instances"].items() if one != name}
    for section in {"scenario", "record"} & data.keys():
        data[section] = _without(data[section], name)
    gone = f"instances.{name}", "scenario.events", "record"  # of lists, some items may be left out
    return _without_places(plain, gone)._replace(data=data)


def with_record(section: Any, variables: Sequence[str], keys: Mapping[str, Any], *, also: bool) -> Any:  # noqa: ANN401  as a file has it
    """The section `record`, a mapping or a list of mappings, with another first file; or with one more (``also``).

    Without ``variables``, the file gets all outputs. A key that is None leaves what the section says.
    """
    given = {"from" if key == "start" else key: plain_value(value) for key, value in keys.items() if value is not None}
    given["variables"] = list(variables) or None
    sections = section if isinstance(section, list) else [section]
    if also:  # a file that is there already gets another section
        return [
            *(one for one in sections if not (isinstance(one, dict) and one.get("file") == given.get("file"))),
            given,
        ]
    changed = {**(sections[0] if sections and isinstance(sections[0], dict) else {}), **given}
    return [changed, *sections[1:]] if isinstance(section, list) else changed


def _without_places(plain: PlainConfig, paths: Sequence[str]) -> PlainConfig:
    lines, origins = plain.lines, plain.origins
    for path in paths:
        lines = {own: line for own, line in lines.items() if not _is_inside(own, path)}
        origins = {own: origin for own, origin in origins.items() if not _is_inside(own, path)}
    return plain._replace(lines=lines, origins=origins)


def _without(value: Any, name: str) -> Any:  # noqa: ANN401  as a file has it
    """A value without keys and list items that are variables of an instance, and without an event that sets nothing."""
    if isinstance(value, dict):
        left = {key: _without(own, name) for key, own in value.items() if not _is_of(key, name)}
        return left | {"variables": None} if left.get("variables") == [] else left  # nothing chosen: all outputs
    if isinstance(value, list):
        items = (_without(own, name) for own in value if not _is_of(own, name))
        return [own for own in items if not (isinstance(own, dict) and own.get("set") == {})]
    return value


def _is_of(variable: object, name: str) -> bool:
    return str(variable).removeprefix("in:").startswith(f"{name}.")


def sections_of(plain: PlainConfig) -> dict[str, Any]:
    """The sections of a configuration, which is an error without any."""
    if not isinstance(plain.data, dict):
        raise ConfigurationError(f"'{plain.file}' has {shown(plain.data)} where a configuration should be")
    return plain.data


def connections_of(plain: PlainConfig) -> list[Any]:
    """The connections of a configuration; anything but a list is an error."""
    own = sections_of(plain).get("connections") or []
    if not isinstance(own, list):
        raise ConfigurationError(f"'connections' of '{plain.file}' is {shown(own)}, where a list should be")
    return own


def ends_of(connection: Any) -> tuple[Any, Any]:  # noqa: ANN401  as a file has it
    """Source and target of a connection in one of its two forms; a Zenoh key is `key <key>`."""
    if isinstance(connection, dict):
        key = f"{KEY}{connection['key']}" if "key" in connection else None
        return connection.get("from", key), connection.get("to", key)
    source, _, target = str(connection).partition("->")
    return source.strip(), target.strip()


def unknown(what: str, name: str, there: Sequence[str]) -> UnknownName:
    """The error for a name that is not there; suggests the nearest one."""
    return UnknownName(what, hint=did_you_mean(name, there, f"There are: {listed(there)}."))


def _is_inside(path: str, outer: str) -> bool:
    return path.startswith(outer) and path[len(outer) : len(outer) + 1] in ("", ".", "[")


# --- for a file in another folder


def rebased(configuration: PlainConfig, folder: Path) -> dict[str, Any]:
    """The values of a configuration as a file in ``folder`` has them.

    Example:
        >>> from fmu_mesh.config.loading import read_file
        >>> rebased(read_file(Path("configs/pendulum_delay.yaml")), Path())["instances"]["pendulum"]["fmu"]
        'fmus/DampedPendulum.fmu'
    """
    data: dict[str, Any] = plain_value(configuration.data)
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
        if isinstance(mapping, dict) and _is_relative(mapping.get(key)):
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


def _places(data: dict[str, Any]) -> Iterator[tuple[Any, str]]:
    """Where other sections may have paths: what may be a mapping, and the key in it whose value is a path."""
    records, scenario, ros = data.get("record"), data.get("scenario"), data.get("ros")
    for record in records if isinstance(records, list) else [records]:
        yield record, "file"
    yield data, "scenario"
    for values in (scenario.get("values") or {}).values() if isinstance(scenario, dict) else ():
        yield values, "file"
    yield data.get("zenoh"), "config"
    messages = ros.get("messages") if isinstance(ros, dict) else None
    for name in messages if isinstance(messages, dict) else ():
        yield messages, name
    topics = ros.get("topics") if isinstance(ros, dict) else None
    for topic in topics if isinstance(topics, list) else ():
        for constant in (topic.get("constants") or {}).values() if isinstance(topic, dict) else ():
            yield constant, "file"


def _is_relative(path: object) -> TypeGuard[str]:
    return isinstance(path, str) and path != "" and not path.startswith("~") and not Path(path).is_absolute()
