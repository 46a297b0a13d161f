"""The JSON Schema accepts what `load` accepts and refuses what editors can know to be wrong."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from jsonschema import Draft202012Validator

from fmu_mesh.config.findings import Findings
from fmu_mesh.config.structure import json_schema, schema_text
from fmu_mesh.config.yaml_text import read
from fmu_mesh.instances.configuration import installed_config

FOLDER = Path(__file__).parents[2] / "configs"
CONFIGS = sorted(FOLDER.glob("*.yaml"))

GOOD = """\
mesh: pair
simulation: {stop_time: 1, step_size: 0.1}
instances: {a: {fmu: a.fmu, start_values: {x: 1, y: text, z: true}}, b: {fmu: b.fmu, step_size: null}}
connections: ['a.der(x,2) -> b.u', {from: a.x, to: b.v, delay: 1}]
"""


def errors_of(text: str) -> list[str]:
    content = read(text, Findings("text"), {})  # YAML 1.2, as editors read it: `on` is a key
    return [error.message for error in Draft202012Validator(json_schema(installed_config())).iter_errors(content)]


def test_the_schema_is_one_of_draft_2020_12() -> None:
    Draft202012Validator.check_schema(json_schema(installed_config()))


def test_the_kept_copy_is_what_the_code_makes() -> None:
    assert (FOLDER / "schema.json").read_text(encoding="utf-8") == schema_text(installed_config())


def test_every_key_is_described_for_editors() -> None:
    definitions = json.loads(schema_text(installed_config()))["$defs"]
    keys = [(name, schema) for section in definitions.values() for name, schema in section["properties"].items()]
    assert len(keys) > 30
    assert [name for name, schema in keys if "description" not in schema and "$ref" not in schema] == []


@pytest.mark.parametrize("path", CONFIGS, ids=lambda path: path.name)
def test_every_kept_configuration_keeps_the_schema_and_names_it(path: Path) -> None:
    text = path.read_text(encoding="utf-8")
    assert text.startswith("# yaml-language-server: $schema=schema.json\n")
    assert errors_of(text) == []


def test_both_forms_of_a_connection_keep_the_schema() -> None:
    assert errors_of(GOOD) == []


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("mesh: pair", "mesh: a pair"),
        ("mesh: pair\n", ""),
        ("step_size: 0.1", "step_sise: 0.1"),
        ("step_size: 0.1", "step_size: 0"),
        ("stop_time: 1", "stop_time: '1'"),
        ("stop_time: 1", "stop_time: 1, window: 0"),
        ("stop_time: 1", "stop_time: 1, window: 1000001"),
        ("stop_time: 1", "stop_time: 1, real_time_factor: -1"),
        ("stop_time: 1", "stop_time: 1, algorithm: gauss"),
        ("{fmu: b.fmu, step_size: null}", "b.fmu"),
        ("b: {", "b.c: {"),
        ("x: 1", "x: {a: 1}"),
        ("a.der(x,2) -> b.u", "a.der(x,2) => b.u"),
        ("a.der(x,2) -> b.u", "a -> b.u"),
        ("delay: 1", "delay: 2"),
        (", to: b.v", ""),
    ],
)
def test_a_broken_configuration_does_not_keep_the_schema(old: str, new: str) -> None:
    assert old in GOOD
    assert errors_of(GOOD.replace(old, new)) != []
