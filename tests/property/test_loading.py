"""Whatever a file holds, `load` gives a configuration or a ConfigurationError, and `build` a system or the same."""

from __future__ import annotations

import contextlib
import json
from functools import partial
from pathlib import Path
from typing import Any

import msgspec
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from fmu_mesh.config.findings import located
from fmu_mesh.config.loading import LoadedConfig, examine_data, read_text
from fmu_mesh.config.mesh import MAX_WINDOW, Config, ConnectionConfig, SimulationConfig
from fmu_mesh.config.yaml_text import resolve
from fmu_mesh.errors import ConfigurationError, Finding
from fmu_mesh.instances.configuration import installed_config
from fmu_mesh.instances.fmi.fmu_kind import FmuConfig
from fmu_mesh.instances.registry import KINDS
from fmu_mesh.results.formats import check_record
from fmu_mesh.system.system import build
from fmu_mesh.text import nearest, option_text
from fmu_mesh.variables.model_description import ModelDescription, Variable
from tests.planning import parse

FILE = Path("/nowhere/mesh.yaml")

relaxed = settings(deadline=None)  # how long an example takes says more about the machine than about the code

WORDS = st.sampled_from(
    [
        "mesh",
        "simulation",
        "step_size",
        "stop_time",
        "instances",
        "a",
        "b",
        "fmu",
        "start_values",
        "connections",
        "from",
        "to",
        "record",
        "variables",
        "zenoh",
        "connect",
        "a.y",
        "b.u",
        "a.y->b.u",
        "timeouts",
        "group",
    ]
)
SCALARS = st.none() | st.booleans() | st.integers() | st.floats() | st.text() | WORDS
KEYS = st.text(max_size=40)  # YAML ends a key after 1024 characters, and JSON writes up to 12 for one
STRUCTURES = st.recursive(
    SCALARS, lambda inner: st.lists(inner, max_size=4) | st.dictionaries(WORDS | KEYS, inner, max_size=4)
)
YAML_MARKS = st.text(alphabet="ab:-[]{}&*!|>'\"%@?#,. \n\t01\\\0\ufeff\ud800", max_size=40)
FINITE = st.floats(allow_nan=False, allow_infinity=False)
NAMES = st.from_regex(r"[A-Za-z_][A-Za-z0-9_-]{0,9}", fullmatch=True).filter(lambda name: name != "mesh")
TEXTS = st.text(alphabet=st.characters(exclude_categories=["Cs"], exclude_characters="\0"), max_size=40)

SECTIONS = {
    "mesh": "pair",
    "simulation": {"stop_time": 1, "step_size": 1},
    "instances": {"a": {"fmu": "a.fmu"}},
}
VALUES = FINITE | st.integers(-(10**17), 10**17) | st.booleans() | TEXTS
SIMULATIONS = st.builds(
    SimulationConfig,
    start_time=FINITE,
    stop_time=FINITE,
    step_size=FINITE,
    algorithm=st.sampled_from(["jacobi", "gauss_seidel"]),
    window=st.just("auto") | st.integers(1, MAX_WINDOW),
    real_time_factor=FINITE,
)
INSTANCES = st.dictionaries(
    NAMES,
    st.builds(
        FmuConfig,
        fmu=TEXTS,
        start_values=st.dictionaries(st.sampled_from(["u", "y", "k"]) | TEXTS, VALUES, max_size=3),
        step_size=st.none() | FINITE,
        group=st.none() | NAMES,
        host=st.none() | TEXTS,
    ),
    min_size=1,
    max_size=3,
)
CONNECTIONS = st.lists(
    st.builds(
        ConnectionConfig,
        source=TEXTS,
        target=TEXTS,
        factor=FINITE,
        offset=FINITE,
        delay=st.none() | st.sampled_from([0, 1]),
    ),
    max_size=3,
)
CONFIGS = st.builds(
    installed_config(), mesh=NAMES, simulation=SIMULATIONS, instances=INSTANCES, connections=CONNECTIONS
)

GAIN = ModelDescription(
    model_name="Gain",
    model_identifier="Gain",
    fmi_version="2.0",
    kind="co_simulation",
    guid="{1}",
    variables=(
        Variable("u", 0, "Float64", "input", "continuous"),
        Variable("y", 1, "Float64", "output", "continuous", "calculated"),
        Variable("k", 2, "Float64", "parameter", "tunable", "exact", minimum=-1.0),
    ),
)


def as_json(data: object) -> str:
    """JSON is YAML; Python writes NaN and Infinity as words, which are text in YAML."""
    return json.dumps(data)


def findings_of(text: str, start_values: dict[str, Any] | None = None) -> tuple[Finding, ...]:
    """What is wrong with a file; empty if it is right."""
    try:
        parse(text, FILE, start_values or {})
    except ConfigurationError as error:
        return error.findings or (Finding(str(FILE), "", "an error without a finding", "a finding"),)
    return ()


@relaxed
@given(st.text() | YAML_MARKS, st.dictionaries(st.text() | YAML_MARKS, STRUCTURES, max_size=2))
def test_any_text_is_a_configuration_or_a_configuration_error(text: str, overrides: dict[str, Any]) -> None:
    with contextlib.suppress(ConfigurationError):
        parse(text, FILE, overrides)


@relaxed
@given(STRUCTURES)
def test_any_structure_is_a_configuration_or_a_configuration_error(data: object) -> None:
    with contextlib.suppress(ConfigurationError):
        parse(as_json(data), FILE)


@relaxed
@given(
    st.dictionaries(WORDS, STRUCTURES, max_size=3), st.sampled_from(["simulation", "instances", "connections", "mesh"])
)
def test_any_section_is_accepted_or_told_with_its_path(section: object, name: str) -> None:
    for finding in findings_of(as_json(SECTIONS | {name: section})):
        assert finding.line is not None
        assert finding.path.startswith(name)


@relaxed
@given(
    st.dictionaries(WORDS, STRUCTURES, max_size=3), st.sampled_from(["simulation", "instances", "connections", "mesh"])
)
def test_what_is_wrong_in_structure_is_never_lost_on_way_to_system(section: object, name: str) -> None:
    text = as_json(SECTIONS | {name: section})
    found = findings_of(text)
    assume(found)
    with contextlib.suppress(ConfigurationError):
        loaded, findings = examine_data(read_text(text, FILE), {}, KINDS)
        with pytest.raises(ConfigurationError) as caught:
            build(loaded, dict.fromkeys(loaded.config.instances, GAIN), findings)
        assert set(found) <= set(caught.value.findings)


@relaxed
@given(SCALARS)
def test_any_value_of_an_option_is_taken_or_told_with_the_option(value: object) -> None:
    given = {"a.k": value}
    option = option_text("start_values", given)
    assert all(finding.path == option for finding in findings_of(as_json(SECTIONS), given))


@relaxed
@given(CONFIGS)
def test_a_valid_configuration_survives_the_way_through_a_file(config: Config) -> None:
    plain = Config(**msgspec.structs.asdict(config))  # without the union of the kinds, by which a file is read
    assert parse(as_json(msgspec.to_builtins(config)), FILE).config == plain


@relaxed
@given(CONFIGS)
def test_any_valid_structure_builds_or_is_a_configuration_error(config: Config) -> None:
    loaded = LoadedConfig(config, FILE)
    with contextlib.suppress(ConfigurationError):
        build(loaded, dict.fromkeys(config.instances, GAIN), check_record=partial(check_record, loaded))


@relaxed
@given(FINITE)
def test_a_float_keeps_every_bit(number: float) -> None:
    assert resolve(repr(number)) == number


@relaxed
@given(st.text(), st.lists(st.text()))
def test_the_nearest_name_is_one_of_the_names(name: str, names: list[str]) -> None:
    found = nearest(name, names)
    assert found is None or found in names


@relaxed
@given(st.dictionaries(st.text(alphabet="ab.[]0"), st.integers(1)), st.text(alphabet="ab.[]0"))
def test_every_place_has_the_line_of_a_place_around_it(lines: dict[str, int], path: str) -> None:
    line = located(path, "", lines, {}, {}).line
    around = [place for place in lines if path.startswith(place)]
    assert line is None if not around or line is None else line in [lines[place] for place in around]


@pytest.mark.parametrize("depth", [1, 10, 100, 10_000])
def test_any_depth_ends_without_a_stack_overflow(depth: int) -> None:
    with pytest.raises(ConfigurationError):
        parse("a: " + "{a: " * depth + "}" * depth, FILE)
