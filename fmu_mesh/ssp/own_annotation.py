"""Our annotation of a system structure description: what SSP cannot say about a mesh, as JSON.

Owns which keys of a configuration stand there, and how they come back. Everything that SSP can say stands in the
description itself, so what another tool changes there is right. Where the annotation stands is `exporting` and
`ssd_reading`.

Example:
    >>> data = {"mesh": "m", "simulation": {"step_size": 0.1}, "instances": {"a": {"fmu": "a.fmu", "group": "g"}}}
    >>> described = {"mesh": "m", "simulation": {}, "instances": {"a": {"fmu": "a.fmu"}}}
    >>> text = written(data, described)
    >>> merged(described, text).data == data
    True
"""

from __future__ import annotations

import json
import posixpath
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any, Final, NamedTuple

from ..config.mesh import RecordConfig
from ..text import listed

__all__ = [
    "ANNOTATION_ELEMENT",
    "ANNOTATION_TYPE",
    "AnnotationRefused",
    "Merged",
    "has_key",
    "merged",
    "names_in",
    "written",
]

ANNOTATION_TYPE: Final = "io.github.fmu-mesh"
"""The type of our annotation. It is one of the root system."""

ANNOTATION_ELEMENT: Final = "{https://fmu-mesh.github.io/ssp/1}Mesh"
"""The element inside it; its text is the JSON."""

_VERSION: Final = 1
_OF_SSP: Final = ("fmu", "kind", "start_values")
_INSTANCE_KEYS: Final = (
    "deep_binding",
    "group",
    "host",
    "inputs",
    "interpolation",
    "not_finite",
    "on_failure",
    "retry_discarded_steps",
    "sha256",
    "solver",
    "step_size",
    "strict",
    "tolerance",
)
"""All other keys of an FMU. No key that names another kind of instance: a package never names code of the user."""

_CONNECTION_KEYS: Final = ("delay", "extrapolation")
_SECTIONS: Final = (
    "group",
    "initialization",
    "record",
    "scenario",
    "zenoh",
    "timeouts",
    "limits",
    "strict",
    "ros",
)
"""The top-level keys that stand there as they are."""

_KEYS: Final = "keys"
"""The connections with a Zenoh key at one end, which stand there as they are."""

_KNOWN: Final = ("version", "mesh", "names", "simulation", "instances", "connections", _KEYS, *_SECTIONS)
_ABSENT: Final = object()
_LARGEST_TEXT: Final = 4 * 2**20
"""In characters, as a configuration file."""


class AnnotationRefused(ValueError):
    """The text of an annotation is none of ours: there is something else ``found`` than ``expected``."""

    def __init__(self, found: str, expected: str) -> None:
        super().__init__(f"{found}; expected {expected}")
        self.found = found
        self.expected = expected


class Merged(NamedTuple):
    """A configuration with what an annotation says.

    Attributes:
        paths: what the annotation says of it, such as `simulation.step_size`.
        gone: what the annotation says about instances and connections that there are not.
    """

    data: dict[str, Any]
    paths: list[str]
    gone: list[str]


def written(
    data: Mapping[str, Any],
    described: Mapping[str, Any],
    *,
    names: Mapping[str, str] = {},
    moved: Callable[[str], str] = lambda path: path,
) -> str | None:
    """The text of the annotation for the values of a valid configuration; None if SSP can say all of it.

    Args:
        data: the values, with a scenario in the place of the path of one.
        described: what the description says but for its annotation of ours, with the same names.
        names: the instances whose names do not follow from those of their elements, by the names that would follow.
        moved: from the path of a result file to one for the folder of the package. The annotation gets it without what
            leads out of that folder, because a package is given to others.
    """
    simulation, said = data["simulation"], described.get("simulation", {})
    connections = data.get("connections", ())
    known = {_ends(one): one for one in described.get("connections", ()) if isinstance(one, dict)}
    own = {
        "mesh": data["mesh"] if described.get("mesh") != data["mesh"] else None,
        "names": dict(names),
        "simulation": {key: simulation[key] for key in simulation if key not in said or said[key] != simulation[key]},
        "instances": dict(_own_instances(data["instances"], described.get("instances", {}))),
        "connections": list(_own_connections(connections, known)),
        _KEYS: [one for one in connections if has_key(one)],
    }
    sections = {key: data[key] for key in _SECTIONS if key in data and data[key] != described.get(key, _ABSENT)}
    if "record" in sections:
        record = _with_files(sections.pop("record"), lambda path: _inside(moved(path)))
        if isinstance(record, dict) and record.get("file") == RecordConfig().file:
            del record["file"]
        if record != {}:
            sections["record"] = record
    content = {**{key: value for key, value in own.items() if value}, **sections}
    return json.dumps({"version": _VERSION, **content}, indent=2, allow_nan=False) if content else None


def names_in(text: str) -> dict[str, str]:
    """The names of the instances that do not follow from those of their elements, by the names that would follow.

    Raises:
        AnnotationRefused: the text is no annotation of ours.
    """
    names = _mapping(_parsed(text), "names")
    if not all(isinstance(name, str) for name in names.values()):
        raise AnnotationRefused("a name in 'names' that is no text", "the name of an instance")
    return dict(names)


def chosen_names(defaults: Sequence[str], text: str) -> dict[str, str]:
    """The name of each instance, by the one that follows from its element; those are the ``defaults``.

    Raises:
        AnnotationRefused: the text is no annotation of ours, or gives one name to two instances.
    """
    wanted = names_in(text)
    chosen = {default: wanted.get(default, default) for default in defaults}
    first: dict[str, str] = {}
    for default, name in chosen.items():
        if name in first:
            found = f"the name '{name}' of the elements '{first[name]}' and '{default}'"
            raise AnnotationRefused(found, "a name of its own for each of them")
        first[name] = default
    return chosen


def merged(data: Mapping[str, Any], text: str, *, moved: Callable[[str], str] = lambda path: path) -> Merged:
    """A configuration of a description with what its annotation says.

    The ``data`` are not changed: what the description itself says, a mapping as in a configuration file, with long
    connections, and with the names that `chosen_names` gives. A result file is ``moved`` from its path for the folder
    of the package to one for the folder of the configuration.

    Raises:
        AnnotationRefused: the text is no annotation of ours.
    """
    content = _parsed(text)
    simulation = _mapping(content, "simulation")
    made = {**data, "simulation": {**data.get("simulation", {}), **simulation}}
    result = Merged(made, [f"simulation.{key}" for key in simulation], [])
    if "mesh" in content:
        made["mesh"] = content["mesh"]
        result.paths.append("mesh")
    _merge_instances(content, result)
    _merge_connections(content, result)
    _merge_keys(content, result)
    for key in _SECTIONS:
        if key in content:
            made[key] = content[key] if key != "record" else _with_files(content[key], lambda path: moved(_own(path)))
            result.paths.append(key)
    return result


def _parsed(text: str) -> dict[str, Any]:
    """The content of an annotation, with a known version and known keys."""
    expected = "the JSON that fmu_mesh writes"
    if len(text) > _LARGEST_TEXT:
        raise AnnotationRefused(f"{len(text)} characters", f"{_LARGEST_TEXT} characters at most")
    try:
        content = json.loads(text, parse_constant=_no_number)
    except (ValueError, RecursionError) as error:
        raise AnnotationRefused(f"no JSON: {error}", expected) from error
    if not isinstance(content, dict):
        raise AnnotationRefused("no mapping", expected)
    if content.get("version") != _VERSION:
        raise AnnotationRefused(f"version {content.get('version')!r}", f"version {_VERSION}")
    for key in content:
        if key not in _KNOWN:
            raise AnnotationRefused(f"the key '{key}'", f"one of {listed(_KNOWN)}")
    _mapping(content, "names")
    return content


def _no_number(text: str) -> float:
    raise ValueError(f"'{text}' is no number of JSON")


def _mapping(content: Mapping[str, Any], key: str) -> dict[str, Any]:
    section = content.get(key, {})
    if not isinstance(section, dict):
        raise AnnotationRefused(f"no mapping in '{key}'", "a mapping")
    return section


def has_key(connection: object) -> bool:
    """Whether a connection has a Zenoh key at one end."""
    return isinstance(connection, dict) and "key" in connection


def _ends(connection: Mapping[str, Any]) -> tuple[str, str]:
    return connection["from"], connection["to"]


def _own_instances(
    instances: Mapping[str, Mapping[str, Any]], described: Mapping[str, Mapping[str, Any]]
) -> Iterator[tuple[str, dict[str, Any]]]:
    """The keys of the instances that SSP does not have, and that the description does not say."""
    for name, section in instances.items():
        said = described.get(name, {})
        kept = {
            key: section[key]
            for key in section
            if key not in _OF_SSP and (key not in said or said[key] != section[key])
        }
        kept |= {key: None for key in said if key not in _OF_SSP and key not in section}
        if kept:
            yield name, kept


def _own_connections(
    connections: Iterable[Mapping[str, Any] | str], described: Mapping[tuple[str, str], Mapping[str, Any]]
) -> Iterator[dict[str, Any]]:
    """The connections with keys that SSP does not have, by their ends."""
    for connection in connections:
        if isinstance(connection, str) or has_key(connection):
            continue  # the short form has no keys, and the others stand elsewhere
        said = described.get(_ends(connection), {})
        kept = {key: connection[key] for key in _CONNECTION_KEYS if key in connection}
        kept = {key: value for key, value in kept.items() if value != said.get(key)}
        if kept:
            yield {"from": connection["from"], "to": connection["to"], **kept}


def _merge_instances(content: Mapping[str, Any], result: Merged) -> None:
    instances = {name: dict(section) for name, section in result.data.get("instances", {}).items()}
    result.data["instances"] = instances
    for name, section in _mapping(content, "instances").items():
        if not isinstance(section, dict):
            raise AnnotationRefused(f"no mapping for the instance '{name}'", "a mapping")
        for key in section:
            if key not in _INSTANCE_KEYS:
                raise AnnotationRefused(f"the key '{key}' of '{name}'", f"one of {listed(_INSTANCE_KEYS)}")
        if name in instances:
            instances[name] |= section
            result.paths.extend(f"instances.{name}.{key}" for key in section)
        else:
            result.gone.append(f"the instance '{name}', which the annotation has {listed([*section])} for")


def _merge_connections(content: Mapping[str, Any], result: Merged) -> None:
    entries = content.get("connections", [])
    if not isinstance(entries, list) or not all(isinstance(entry, dict) for entry in entries):
        raise AnnotationRefused("no list of mappings in 'connections'", "a list of mappings")
    if not entries:
        return
    connections = [dict(one) for one in result.data.get("connections", ())]
    result.data["connections"] = connections
    numbers = {_ends(one): number for number, one in enumerate(connections)}
    for entry in entries:
        keys = {key: value for key, value in entry.items() if key not in ("from", "to")}
        for key in keys:
            if key not in _CONNECTION_KEYS:
                raise AnnotationRefused(f"the key '{key}' of a connection", f"one of {listed(_CONNECTION_KEYS)}")
        ends = entry.get("from"), entry.get("to")
        number = numbers.get(ends) if all(isinstance(end, str) for end in ends) else None
        if number is not None:
            connections[number] |= keys
            result.paths.extend(f"connections[{number}].{key}" for key in keys)
        else:
            result.gone.append(f"the connection {ends[0]} -> {ends[1]}, which the annotation has {listed([*keys])} for")


def _merge_keys(content: Mapping[str, Any], result: Merged) -> None:
    entries = content.get(_KEYS, [])
    if not isinstance(entries, list) or not all(map(has_key, entries)):
        raise AnnotationRefused(f"no list of connections with a key in '{_KEYS}'", "such a list")
    for entry in entries:
        end = entry.get("to", entry.get("from"))
        connections = result.data["connections"] = [*result.data.get("connections", ())]
        if str(end).partition(".")[0] in result.data["instances"]:
            result.paths.append(f"connections[{len(connections)}]")
            connections.append(entry)
        else:
            result.gone.append(f"the instance of '{end}', which the annotation has the key '{entry['key']}' for")


def _with_files(record: Any, moved: Callable[[str], str]) -> Any:  # noqa: ANN401  a section as in a file
    """The section `record` with other paths of its result files."""
    if isinstance(record, list):
        return [_with_files(one, moved) for one in record]
    if not isinstance(record, dict) or not isinstance(record.get("file"), str):
        return record
    return {**record, "file": moved(record["file"])}


def _inside(path: str) -> str:
    """The path of a result file without what leads out of the folder of the package."""
    if posixpath.isabs(path):
        return posixpath.join("results", posixpath.basename(path))
    return "/".join(part for part in posixpath.normpath(path).split("/") if part != "..")


def _own(path: str) -> str:
    """The path of a result file in an annotation; somebody else may have written it."""
    if _inside(path) != posixpath.normpath(path):
        raise AnnotationRefused(f"the result file '{path}'", "a path into the folder of the package, without '..'")
    return path
