"""What of a mesh is shown in Foxglove: a topic for each variable, its JSON Schema and its messages.

Pure values; knows nothing of the server. A variable has a topic of its own, not an instance: Foxglove subscribes to
topics, so only what a panel shows travels through the mesh, and a quoted topic takes any name of a variable.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, Final, cast

import msgspec

from ..config.key_sections import KEY
from ..variables.value_types import FMI2_TYPES, VariableType, is_float, split_element
from ..wire.client.readings import Reading, Target
from ..wire.views import InstanceInfo, MeshStatus, VariableView

__all__ = [
    "STATUS_SCHEMA",
    "message_of",
    "metadata_of",
    "schema_of",
    "status_message",
    "topic_of",
    "topics_by_instance",
    "type_of",
]

_JSON_TYPES: Final = {"Boolean": "boolean", "String": "string", "Binary": "string"}

STATUS_SCHEMA: Final[dict[str, Any]] = {
    "title": "fmu_mesh.status",
    "type": "object",
    "properties": {
        "state": {"type": "string", "description": "starting, initializing, running, paused, stopping, done or failed"},
        "point": {"type": "integer", "description": "the last point that every instance has reached"},
        "time": {"type": "number", "description": "the simulation time of this point in s"},
        "points_per_second": {"type": "number"},
        "real_time_factor": {"type": "number"},
        "overruns": {"type": "integer", "description": "points by which the run fell behind the wall clock"},
        "error": {"type": "string", "description": "why the run failed; empty otherwise"},
    },
}
"""The JSON Schema of the topic `/mesh/status`."""


def type_of(view: VariableView) -> VariableType:
    """The type of a variable in the words of FMI 3.0."""
    return FMI2_TYPES.get(view.type) or cast("VariableType", view.type)


def topic_of(target: Target) -> str:
    """The topic of a variable: `/instance/variable`."""
    return f"/{target.instance}/{target.variable.name}"


def schema_of(target: Target) -> dict[str, Any]:
    """The JSON Schema of the messages of a variable; its description has the unit."""
    view = target.variable
    type_ = type_of(view)
    value: dict[str, Any] = {"type": _JSON_TYPES.get(type_) or ("number" if is_float(type_) else "integer")}
    for _ in view.shape:
        value = {"type": "array", "items": value}
    if text := " in ".join(filter(None, (view.description, view.unit))):  # such as `angle in rad`
        value["description"] = text
    point = {"type": "integer", "description": "the communication point of the value"}
    return {
        "title": f"{target.instance}.{view.name}",
        "type": "object",
        "properties": {"value": value, "point": point},
    }


def metadata_of(target: Target) -> dict[str, str]:
    """What Foxglove shows about a topic."""
    names = ("unit", "description", "type", "causality", "variability")
    return {name: fact for name in names if (fact := getattr(target.variable, name))}


def message_of(target: Target, reading: Reading) -> bytes:
    """The message of a value. A number that is not finite is null, because JSON has none."""
    value = _finite(reading.value) if is_float(type_of(target.variable)) else reading.value
    return msgspec.json.encode({"value": value, "point": reading.point})


def status_message(status: MeshStatus) -> bytes:
    """The message of a status of the mesh."""
    facts = {name: getattr(status, name) for name in STATUS_SCHEMA["properties"]}
    facts["error"] = status.error.message if status.error is not None else ""
    return msgspec.json.encode(facts)


def topics_by_instance(
    infos: Mapping[str, InstanceInfo], targets: Sequence[Target]
) -> dict[str, tuple[str, tuple[str, ...]]]:
    """For every topic its instance or the Zenoh key that feeds it, and the instances and keys that get the variable."""
    readers: dict[str, dict[str, None]] = {}
    sources: dict[str, str] = {}
    for name, info in infos.items():
        for connection in info.connections:
            element = split_element(connection.source)
            for source in (connection.source, *([element[0]] if element is not None else ())):
                readers.setdefault(source, {})[name] = None
        for key in info.keys:
            variable = f"{name}.{key.variable}"
            if key.direction == "in":
                sources[variable] = f"{KEY}{key.key}"
                readers[variable] = {name: None}
            else:
                readers.setdefault(variable, {})[f"{KEY}{key.key}"] = None
    return {
        topic_of(target): (sources.get(target.name, target.instance), tuple(readers.get(target.name, ())))
        for target in targets
    }


def _finite(value: Any) -> Any:  # noqa: ANN401  plain JSON
    """A value without numbers that are not finite; over the wire they are text."""
    if isinstance(value, list):
        return [_finite(element) for element in value]
    return value if isinstance(value, int | float) and math.isfinite(value) else None
