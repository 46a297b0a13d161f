"""What a Struct allows: every deviation of a plain value from it, and its JSON Schema.

Owns the comparison of plain values with the types of msgspec Structs: unknown and missing keys, wrong types, patterns
and ranges. Text, truth values, NaN and infinity are not numbers. Knows nothing of what the values mean.

`docs/adr/0055-the-structure-of-a-file-is-checked-by-our-own-code.md` says why this is not `jsonschema`.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Sequence
from inspect import cleandoc
from types import NoneType
from typing import Any

import msgspec
from msgspec import inspect

from fmu_mesh.config.findings import Findings
from fmu_mesh.config.instance_sections import KIND
from fmu_mesh.config.yaml_text import Plain
from fmu_mesh.text import listed, nearest, shown

__all__ = ["SCHEMA_ID", "check", "describe", "json_schema", "schema_text"]

_PLAIN: dict[type[inspect.Type], tuple[type, str]] = {
    inspect.StrType: (str, "text"),
    inspect.BoolType: (bool, "true or false"),
    inspect.NoneType: (NoneType, "null"),
    inspect.ListType: (list, "a list"),
    inspect.DictType: (dict, "a mapping"),
}
"""The types without further limits: the class of their values, and how a message calls them."""

SCHEMA_ID = "urn:fmu-mesh:configuration:1"

_SHORT_CONNECTION = {
    "title": "instance.output -> instance.input",
    "description": "The short form of a connection, such as `pendulum.a -> delay.x`.",
    "type": "string",
    "pattern": r"^\s*[A-Za-z_][A-Za-z0-9_-]*\..*\S\s*->\s*[A-Za-z_][A-Za-z0-9_-]*\..*\S\s*$",
}


def check(value: Plain, kind: inspect.Type, path: str, findings: Findings) -> None:
    """Add a finding for everything in ``value`` that the type ``kind`` does not allow.

    The type is as `msgspec.inspect.type_info` gives it; ``path`` is the place of the value, as `connections[2].to`.
    """
    match kind:
        case inspect.Metadata(type=inspect.StrType() as text) if not _fits(value, text):
            findings.add(path, shown(value), describe(kind))
        case inspect.Metadata():
            check(value, kind.type, path, findings)
        case inspect.UnionType():
            _check_union(value, kind, path, findings)
        case inspect.StructType() if isinstance(value, dict):
            _check_struct(value, kind, path, findings)
        case inspect.DictType() if isinstance(value, dict):
            _check_mapping(value, kind, path, findings)
        case inspect.ListType() if isinstance(value, list):
            for index, item in enumerate(value):
                check(item, kind.item_type, f"{path}[{index}]", findings)
        case _ if not _fits(value, kind):
            suggestion = nearest(value, _words(kind)) if isinstance(value, str) else None
            items = ", each item after '- '" if isinstance(kind, inspect.ListType) and isinstance(value, str) else ""
            findings.add(path, shown(value), describe(kind) + items, suggestion)


def describe(kind: inspect.Type) -> str:
    """What a value of the type ``kind`` is, for a message: `a finite number >= 0 or null`."""
    match kind:
        case inspect.Metadata():
            words = str((kind.extra_json_schema or {}).get("title") or describe(kind.type))
        case inspect.UnionType(types=(inspect.StructType() as usual, *_)):
            words = describe(usual)
        case inspect.UnionType():
            numbers = any(isinstance(option, inspect.FloatType) for option in kind.types)
            options = [
                describe(option)
                for option in kind.types
                if not (numbers and isinstance(option, inspect.IntType))  # a whole number is a number
            ]
            words = f"{', '.join(options[:-1])} or {options[-1]}"
        case inspect.LiteralType():
            words = " or ".join(str(value) for value in kind.values)
        case inspect.FloatType() | inspect.IntType():
            limits = ((">", kind.gt), (">=", kind.ge), ("<=", kind.le))
            bounds = " and ".join(f"{sign} {limit:g}" for sign, limit in limits if limit is not None)
            words = f"a {'finite' if isinstance(kind, inspect.FloatType) else 'whole'} number {bounds}".rstrip()
        case inspect.StrType(pattern=str(pattern)):
            words = f"text that matches {pattern}"
        case inspect.StructType():
            words = f"a mapping with {listed([field.encode_name for field in kind.fields])}"
        case inspect.AnyType():
            words = "a number, text, true or false, or a list"
        case _:
            words = _PLAIN[type(kind)][1]
    return words


def json_schema(config_type: type[msgspec.Struct]) -> dict[str, object]:
    """The JSON Schema (draft 2020-12) of the configuration file, by which editors complete and check it.

    What names mean is beyond a schema: `fmu_mesh.system.system` can still refuse a file that is valid by it.
    """
    (reference,), definitions = msgspec.json.schema_components([config_type])
    config = definitions[config_type.__name__]
    config["properties"]["connections"]["items"] = {
        "anyOf": [_SHORT_CONNECTION, config["properties"]["connections"]["items"]]
    }
    _as_in_a_file(config, definitions)
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "$id": SCHEMA_ID,
        "title": "fmu_mesh configuration",
        "$ref": reference["$ref"],
        "$defs": definitions,
    }


def _as_in_a_file(config: dict[str, Any], definitions: dict[str, Any]) -> None:
    """Remove the tags of sections, which the program adds after it has read a file, and indentation."""
    del config["properties"]["instances"]["additionalProperties"]["discriminator"]
    del config["properties"]["connections"]["items"]["anyOf"][1]["discriminator"]
    for section in definitions.values():
        if "description" in section:
            section["description"] = cleandoc(section["description"])  # msgspec does it from 0.23 on
        if section["properties"].pop(KIND, None) is not None:
            section["required"].remove(KIND)


def schema_text(config_type: type[msgspec.Struct]) -> str:
    """The JSON Schema as the text of a file, such as `configs/schema.json`."""
    return json.dumps(json_schema(config_type), indent=2, ensure_ascii=False) + "\n"


def _check_struct(value: dict[str, Plain], kind: inspect.StructType, path: str, findings: Findings) -> None:
    fields = {field.encode_name: field for field in kind.fields}
    absent = [name for name in fields if name not in value]
    meant: set[str | None] = set()
    for key, item in value.items():
        if key == kind.tag_field:
            continue
        place = f"{path}.{key}" if path else key
        if key in fields:
            check(item, fields[key].type, place, findings)
            continue
        suggestion = nearest(key, absent) or nearest(key, fields)
        meant.add(suggestion)
        findings.add(place, "an unknown key" if key else "an empty key", f"one of {listed(list(fields))}", suggestion)
    for name in absent:
        place = f"{path}.{name}" if path else name
        if fields[name].required and name in meant:
            findings.explain([place])
        elif fields[name].required and place not in findings.places:
            findings.add(place, "missing", describe(fields[name].type))


def _check_mapping(value: dict[str, Plain], kind: inspect.DictType, path: str, findings: Findings) -> None:
    if len(value) < (kind.min_length or 0):
        findings.add(path, "an empty mapping", f"at least {kind.min_length} entry")
    for key, item in value.items():
        place = f"{path}.{key}"
        check(key, kind.key_type, place, findings)
        if item is None and key.count("(") > key.count(")"):  # {der(a,2): 0} without quotes
            findings.add(place, f"'{key}' without a value", "quotes around a name with a comma inside { }")
        else:
            check(item, kind.value_type, place, findings)


def _check_union(value: Plain, kind: inspect.UnionType, path: str, findings: Findings) -> None:
    options = _options(kind)
    if isinstance(value, dict):  # of several Structs it is the one whose tag it has
        structs = [option for option in options if isinstance(option, inspect.StructType) and option.tag_field]
        options = [option for option in structs if value.get(str(option.tag_field)) == option.tag] or options
    for option in options:
        container = isinstance(option, inspect.StructType | inspect.DictType) and isinstance(value, dict)
        if container or (isinstance(option, inspect.ListType) and isinstance(value, list)):
            check(value, option, path, findings)
            return
    if not any(_fits(value, option) for option in options):
        words = [word for option in options for word in _words(option)]
        suggestion = nearest(value, words) if isinstance(value, str) else None
        findings.add(path, shown(value), describe(kind), suggestion)


def _options(kind: inspect.UnionType) -> list[inspect.Type]:
    return [option.type if isinstance(option, inspect.Metadata) else option for option in kind.types]


def _words(kind: inspect.Type) -> Sequence[str]:
    return [word for word in kind.values if isinstance(word, str)] if isinstance(kind, inspect.LiteralType) else ()


def _fits(value: Plain, kind: inspect.Type) -> bool:
    """Whether a value is of the type ``kind``, without a look into mappings and lists."""
    match kind:
        case inspect.LiteralType():
            fits = any(type(value) is type(word) and value == word for word in kind.values)
        case inspect.FloatType():
            number = type(value) is int or (isinstance(value, float) and math.isfinite(value))
            fits = number and _within(value, kind)
        case inspect.IntType():
            fits = type(value) is int and _within(value, kind)
        case inspect.AnyType():  # an element of an array of start values, which may be an array itself
            fits = isinstance(value, bool | int | float | str | list)
        case inspect.StrType(pattern=str(pattern)):
            fits = isinstance(value, str) and re.fullmatch(pattern, value) is not None
        case _:
            fits = type(kind) in _PLAIN and isinstance(value, _PLAIN[type(kind)][0])
    return fits


def _within(value: Plain, kind: inspect.FloatType | inspect.IntType) -> bool:
    assert isinstance(value, int | float)
    above = (kind.gt is None or value > kind.gt) and (kind.ge is None or value >= kind.ge)
    return above and (kind.le is None or value <= kind.le)
