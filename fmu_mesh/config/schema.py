"""The JSON Schema of the configuration file, by which editors complete and check it.

Made from the Structs of `fmu_mesh.config.mesh` and of the kinds of instances; `configs/schema.json` is a copy for our
own kinds. A schema cannot check what names mean: `fmu_mesh.system.system` may refuse a file that is valid here.
"""

from __future__ import annotations

import json
from typing import Any

import msgspec

from fmu_mesh.config.instance_sections import KIND
from fmu_mesh.config.mesh import Config

__all__ = ["SCHEMA_ID", "json_schema", "schema_text"]

SCHEMA_ID = "urn:fmu-mesh:configuration:1"

_SHORT_CONNECTION = {
    "title": "instance.output -> instance.input",
    "description": "The short form of a connection, such as `pendulum.a -> delay.x`.",
    "type": "string",
    "pattern": r"^\s*[A-Za-z_][A-Za-z0-9_-]*\..*\S\s*->\s*[A-Za-z_][A-Za-z0-9_-]*\..*\S\s*$",
}


def json_schema(type_: type[Config]) -> dict[str, object]:
    """The schema (JSON Schema, draft 2020-12) of configurations with the kinds of instances of ``type_``."""
    (reference,), definitions = msgspec.json.schema_components([type_])
    config = definitions["Config"]
    config["properties"]["connections"]["items"] = {
        "anyOf": [_SHORT_CONNECTION, config["properties"]["connections"]["items"]]
    }
    _without_kinds(config, definitions)
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "$id": SCHEMA_ID,
        "title": "fmu_mesh configuration",
        "$ref": reference["$ref"],
        "$defs": definitions,
    }


def _without_kinds(config: dict[str, Any], definitions: dict[str, Any]) -> None:
    """Take out what tells the kinds of instances apart in the program: in a file their own keys do."""
    config["properties"]["instances"]["additionalProperties"].pop("discriminator", None)
    for section in definitions.values():
        if section["properties"].pop(KIND, None) is not None:
            section["required"].remove(KIND)


def schema_text(type_: type[Config]) -> str:
    """The schema as the text of a file."""
    return json.dumps(json_schema(type_), indent=2, ensure_ascii=False) + "\n"
