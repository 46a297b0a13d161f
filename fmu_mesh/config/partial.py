"""A partial configuration: the valid parts of a file whose structure is wrong.

Owns the placeholders for the invalid parts. With them the meaning of the valid parts can be checked, and one error
shows all findings. A partial configuration is never run.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from collections.abc import Set as AbstractSet

import msgspec

from fmu_mesh.config.instance_sections import KIND, InstanceSection
from fmu_mesh.config.mesh import Config, config_type
from fmu_mesh.config.yaml_text import Plain

__all__ = ["partial_configuration"]

_CONTAINERS = re.compile(
    r"|simulation|connections|initialization|record|zenoh|timeouts|limits|instances(\.[^.]+(\.start_values)?)?"
)
_KEPT_LISTS = ("connections", "record")
"""Lists whose other items keep their index if one is wrong."""

_TIMES = ("start_time", "stop_time", "step_size")


def partial_configuration(
    data: Plain, wrong: AbstractSet[str], sections: Mapping[str, type[InstanceSection]]
) -> Config | None:
    """The configuration without the values at the paths ``wrong``; None if too little is valid.

    A missing or wrong time is NaN, a missing model an empty path, a wrong connection has two empty ends.

    Args:
        data: what the file says.
        wrong: the places of all findings.
        sections: the sections of the kinds of instances by key, the usual kind first.
    """
    if not isinstance(data, dict):
        return None
    rest = _without(data, wrong, "")
    if not isinstance(rest, dict):
        return None
    try:
        return msgspec.convert(
            {
                **rest,
                "mesh": rest.get("mesh", "mesh"),
                "simulation": _simulation(rest.get("simulation"), wrong),
                "instances": _with_models(rest.get("instances"), sections),
                "connections": _with_ends(rest.get("connections", [])),
                "record": _with_records(rest.get("record", {})),
            },
            config_type(tuple(sections.values())),
        )
    except msgspec.ValidationError:
        return None


def _without(value: Plain, wrong: AbstractSet[str], path: str) -> Plain:
    """``value`` without its wrong entries; a wrong list item becomes null, so that the others keep their index."""
    if isinstance(value, dict):
        places = {key: f"{path}.{key}" if path else key for key in value}
        return {
            key: _without(item, wrong, places[key])
            for key, item in value.items()
            if places[key] not in wrong or (isinstance(item, dict | list) and _CONTAINERS.fullmatch(places[key]))
        }
    if isinstance(value, list):
        places_of_items = [f"{path}[{index}]" for index in range(len(value))]
        if path not in _KEPT_LISTS and any(_is_wrong(place, wrong) for place in places_of_items):
            return []
        pairs = zip(value, places_of_items, strict=True)
        return [None if place in wrong else _without(item, wrong, place) for item, place in pairs]
    return value


def _is_wrong(place: str, wrong: AbstractSet[str]) -> bool:
    """Whether an item of a list, or anything in it, is wrong."""
    return any(path == place or path.startswith(f"{place}.") for path in wrong)


def _simulation(section: Plain, wrong: AbstractSet[str]) -> dict[str, Plain]:
    times: dict[str, Plain] = {"stop_time": math.nan, "step_size": math.nan}
    unknown: dict[str, Plain] = {name: math.nan for name in _TIMES if f"simulation.{name}" in wrong}
    return {**times, **(section if isinstance(section, dict) else {}), **unknown}


def _with_models(section: Plain, sections: Mapping[str, type[InstanceSection]]) -> dict[str, Plain]:
    instances = section if isinstance(section, dict) else {}
    usual = next(iter(sections))
    written: dict[str, Plain] = {}
    for name, instance in instances.items():
        given = instance if isinstance(instance, dict) else {KIND: usual}
        key = str(given[KIND])
        with_path: dict[str, Plain] = {key: "", **given}
        try:
            msgspec.convert(with_path, sections[key])
        except msgspec.ValidationError:  # a kind without a file, or one that misses something else
            shared: dict[str, Plain] = {
                key: given[key] for key in ("step_size", "group", "host", "not_finite") if key in given
            }
            with_path = {KIND: usual, usual: "", **shared}
        written[name] = with_path
    return written


def _with_ends(section: Plain) -> list[Plain]:
    connections = section if isinstance(section, list) else []
    return [
        connection if isinstance(connection, dict) and {"from", "to"} <= connection.keys() else {"from": "", "to": ""}
        for connection in connections
    ]


def _with_records(section: Plain) -> Plain:
    """The section `record`; what is no section in a list of them records nothing."""
    if not isinstance(section, list):
        return section
    return [own if isinstance(own, dict) else {"file": None} for own in section]
