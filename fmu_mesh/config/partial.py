"""A partial configuration: the valid parts of a file whose structure is wrong.

Owns the placeholders for the invalid parts. With them the meaning of the valid parts can be checked, and one error
shows all findings. A partial configuration is never run.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from collections.abc import Set as AbstractSet
from typing import Final

import msgspec

from fmu_mesh.config.findings import CONTAINERS
from fmu_mesh.config.instance_sections import KIND, InstanceSection
from fmu_mesh.config.mesh import Config, config_type
from fmu_mesh.config.scenario_section import ScenarioConfig
from fmu_mesh.config.yaml_text import Plain

__all__ = ["partial_configuration", "partial_scenario"]

_PLACEHOLDERS: Final[dict[str, Plain]] = {
    "connections": {"from": "", "to": ""},
    "record": {"file": None},
    r"record(\[\d+\])?\.variables": "",
    r"scenario\.events": {"at": math.inf, "set": {}},
    r"scenario\.values\..+\.times": math.nan,
    r"scenario\.values\..+\.values": 0,
    r"ros\.topics": "",
}
"""By the path of a list, what stands for a wrong item, so that others keep their index, and for keys that miss."""

_TIMES = ("start_time", "stop_time", "step_size")


def partial_configuration(
    data: Plain, wrong: AbstractSet[str], sections: Mapping[str, type[InstanceSection]]
) -> Config | None:
    """The configuration without the values at the paths ``wrong``; None if too little is valid.

    A missing or wrong time is NaN, a missing model an empty path, a missing end of a connection an empty name, and an
    event without a time never happens. The sections are those of the kinds of instances by key, the usual kind first.
    """
    rest = _without(data, wrong, "")
    instances = data.get("instances") if isinstance(data, dict) else None
    if not isinstance(rest, dict) or not isinstance(instances, dict):
        return None
    models = [_with_model(own, sections) for own in ({**instances, **_mapping(rest.get("instances"))}).values()]
    try:
        config = msgspec.convert(
            {
                **rest,
                "mesh": rest.get("mesh", "mesh"),
                "simulation": _simulation(rest.get("simulation"), wrong),
                "instances": {f"i{number}": model for number, model in enumerate(models)},
            },
            config_type(tuple(sections.values())),
        )
    except msgspec.ValidationError:
        return None
    # A name that is not allowed, for which there is a finding, is still that of an instance.
    return msgspec.structs.replace(config, instances=dict(zip(instances, config.instances.values(), strict=True)))


def partial_scenario(data: Plain, wrong: AbstractSet[str]) -> ScenarioConfig | None:
    """As `partial_configuration`, for a scenario in a file of its own."""
    rest = _without(data, {f"scenario.{place}" for place in wrong}, "scenario")
    try:
        return msgspec.convert(rest, ScenarioConfig)
    except msgspec.ValidationError:
        return None


def _without(value: Plain, wrong: AbstractSet[str], path: str) -> Plain:
    """``value`` without its wrong entries; placeholders are in their place where they are in a list."""
    if isinstance(value, dict):
        places = {key: f"{path}.{key}" if path else key for key in value}
        return {
            key: _without(item, wrong, places[key])
            for key, item in value.items()
            if places[key] not in wrong or (isinstance(item, dict | list) and CONTAINERS.fullmatch(places[key]))
        }
    if isinstance(value, list):
        places_of_items = [f"{path}[{index}]" for index in range(len(value))]
        placeholder = next((own for lists, own in _PLACEHOLDERS.items() if re.fullmatch(lists, path)), None)
        inside = (place for place in places_of_items for one in wrong if one == place or one.startswith(f"{place}."))
        if placeholder is None and any(inside):
            return []
        pairs = zip(value, places_of_items, strict=True)
        kept = [placeholder if place in wrong else _without(item, wrong, place) for item, place in pairs]
        return [{**_mapping(placeholder), **item} if isinstance(item, dict) else item for item in kept]
    return value


def _mapping(value: Plain) -> dict[str, Plain]:
    return value if isinstance(value, dict) else {}


def _simulation(section: Plain, wrong: AbstractSet[str]) -> dict[str, Plain]:
    times: dict[str, Plain] = {"stop_time": math.nan, "step_size": math.nan}
    unknown: dict[str, Plain] = {name: math.nan for name in _TIMES if f"simulation.{name}" in wrong}
    return {**times, **_mapping(section), **unknown}


def _with_model(instance: Plain, sections: Mapping[str, type[InstanceSection]]) -> dict[str, Plain]:
    usual = next(iter(sections))
    given = instance if isinstance(instance, dict) else {KIND: usual}
    key = str(given[KIND])
    with_path: dict[str, Plain] = {key: "", **given}
    try:
        msgspec.convert(with_path, sections[key])
    except msgspec.ValidationError:  # a kind without a file, or one that misses something else
        shared = {key: given[key] for key in ("step_size", "group", "host", "not_finite") if key in given}
        return {KIND: usual, usual: "", **shared}
    return with_path
