"""What `load` accepts, and what it says about what it does not."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from fmu_mesh.config.loading import MAXIMUM_BYTES, LoadedConfig, read_file
from fmu_mesh.config.mesh import ConnectionConfig
from fmu_mesh.config.yaml_text import MAXIMUM_DEPTH, Plain
from fmu_mesh.errors import ConfigurationError, Finding
from fmu_mesh.instances.configuration import examine_data
from tests.planning import parse

CONFIGS = sorted((Path(__file__).parents[2] / "configs").glob("*.yaml"))

GOOD = """\
mesh: pair
simulation: {stop_time: 1, step_size: 1e-3}
instances:
  pendulum: {fmu: pendulum.fmu, start_values: {a: 1, name: off, "der(a,2)": 0.5, on: true}}
  delay: {fmu: delay.fmu}
connections:
  - pendulum.der(a,2) -> delay.x
  - {from: pendulum.a, to: delay.z, factor: 2}
"""


def load(path: Path) -> LoadedConfig:
    loaded, findings = examine_data(read_file(path))
    findings.raise_any()
    return loaded


def findings_of(text: str, **start_values: Any) -> tuple[Finding, ...]:  # noqa: ANN401 as a file has them
    with pytest.raises(ConfigurationError) as caught:
        parse(text, Path("mesh.yaml"), start_values)
    return caught.value.findings


def changed(old: str, new: str) -> str:
    assert old in GOOD
    return GOOD.replace(old, new)


def test_a_good_file_becomes_structs_with_numbers_as_floats() -> None:
    config = parse(GOOD, Path("mesh.yaml")).config
    assert config.mesh == "pair"
    assert (config.simulation.stop_time, config.simulation.step_size) == (1.0, 0.001)
    assert isinstance(config.simulation.stop_time, float)
    assert config.instances["pendulum"].start_values == {"a": 1, "name": "off", "der(a,2)": 0.5, "on": True}
    assert config.connections == [
        ConnectionConfig(source="pendulum.der(a,2)", target="delay.x"),
        ConnectionConfig(source="pendulum.a", target="delay.z", factor=2.0),
    ]


@pytest.mark.parametrize("path", CONFIGS, ids=lambda path: path.name)
def test_every_kept_configuration_loads(path: Path) -> None:
    loaded = load(path)
    assert loaded.config.mesh == path.stem
    assert loaded.file == path


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("1e-3", 0.001),
        ("1E3", 1000.0),
        (".5", 0.5),
        ("5.", 5.0),
        ("-3", -3),
        ("007", 7),
        ("0x1F", 31),
        ("0o17", 15),
        ("1_000", "1_000"),
        ("0b11", "0b11"),
        ("on", "on"),
        ("no", "no"),
        ("1:30", "1:30"),
        ("2020-01-01", "2020-01-01"),
        ("'1'", "1"),
        ("True", True),
        ("18446744073709551615", 2**64 - 1),
        ("-9223372036854775808", -(2**63)),
        ("18446744073709551616", 18446744073709551616.0),
        ("0xFFFFFFFFFFFFFFFFF", "0xFFFFFFFFFFFFFFFFF"),
    ],
)
def test_plain_scalars_follow_the_core_schema_of_yaml_1_2(text: str, value: object) -> None:
    loaded = parse(changed("a: 1,", f"a: {text},"), Path("mesh.yaml"))
    found = loaded.config.instances["pendulum"].start_values["a"]
    assert found == value
    assert type(found) is type(value)


def test_an_escape_in_two_halves_is_one_character() -> None:
    loaded = parse(changed("fmu: delay.fmu", 'fmu: "\\ud83d\\ude00.fmu"'), Path("mesh.yaml"))
    assert loaded.config.instances["delay"].path == "\N{GRINNING FACE}.fmu"


def test_an_alias_stands_for_the_value_of_its_anchor() -> None:
    text = changed("step_size: 1e-3", "step_size: &h 1e-3").replace(
        "{fmu: delay.fmu}", "{fmu: delay.fmu, step_size: *h}"
    )
    assert parse(text, Path("mesh.yaml")).config.instances["delay"].step_size == 0.001


def test_a_byte_order_mark_is_no_error(tmp_path: Path) -> None:
    file = tmp_path / "mesh.yaml"
    file.write_bytes(b"\xef\xbb\xbf" + GOOD.encode())
    assert load(file).config.mesh == "pair"


STRUCTURE = [
    pytest.param(
        changed("step_size", "step_sise"),
        "mesh.yaml:2: simulation.step_sise: an unknown key; expected one of start_time, stop_time, "
        "step_size, algorithm, window, real_time_factor, update_period, catch_up and 4 more. Did you mean 'step_size'?",
        id="an unknown key suggests the nearest and hides that this one is missing",
    ),
    pytest.param(
        changed(", step_size: 1e-3", ""),
        "mesh.yaml:2: simulation.step_size: missing; expected a finite number",
        id="a missing key",
    ),
    pytest.param(
        changed("stop_time: 1", 'stop_time: "1"'),
        "mesh.yaml:2: simulation.stop_time: '1'; expected a finite number or null",
        id="text is no number",
    ),
    pytest.param(
        changed("stop_time: 1", "stop_time: true"),
        "mesh.yaml:2: simulation.stop_time: true; expected a finite number or null",
        id="a truth value is no number",
    ),
    pytest.param(
        changed("stop_time: 1", "stop_time: .nan"),
        "mesh.yaml:2: simulation.stop_time: nan; expected a finite number or null",
        id="NaN",
    ),
    pytest.param(
        changed("stop_time: 1", "stop_time: 1e999"),
        "mesh.yaml:2: simulation.stop_time: inf; expected a finite number or null",
        id="an overflow",
    ),
    pytest.param(
        changed("a: 1,", "a: -.inf,"),
        "mesh.yaml:4: instances.pendulum.start_values.a: -inf; expected a finite number, true or false, text or a list",
        id="an infinite start value",
    ),
    pytest.param(
        changed("1e-3", "1e-3, window: 0"),
        "mesh.yaml:2: simulation.window: 0; expected auto or a whole number >= 1 and <= 1e+06",
        id="a number out of range",
    ),
    pytest.param(
        changed("1e-3", "1e-3, window: 2.0"),
        "mesh.yaml:2: simulation.window: 2.0; expected auto or a whole number >= 1 and <= 1e+06",
        id="a float for a whole number",
    ),
    pytest.param(
        changed("1e-3", "1e-3, algorithm: gaus_seidel"),
        "mesh.yaml:2: simulation.algorithm: 'gaus_seidel'; expected gauss_seidel or jacobi. "
        "Did you mean 'gauss_seidel'?",
        id="an unknown word",
    ),
    pytest.param(
        changed("factor: 2", "delay: true"),
        "mesh.yaml:8: connections[1].delay: true; expected 0 or 1 or null",
        id="true is not 1",
    ),
    pytest.param(
        changed("mesh: pair", "mesh: my mesh"),
        "mesh.yaml:1: mesh: 'my mesh'; expected a name of letters, digits, _ and - that starts with a letter or _",
        id="a name with a blank",
    ),
    pytest.param(
        changed("mesh: pair", 'mesh: "pair\\n"'),
        "mesh.yaml:1: mesh: 'pair\\n'; expected a name of letters, digits, _ and - that starts with a letter or _",
        id="a name with a line end",
    ),
    pytest.param(
        changed("  delay: {", "  2.delay: {"),
        "mesh.yaml:5: instances.2.delay: '2.delay'; expected a name of letters, digits, _ and - "
        "that starts with a letter or _",
        id="an instance name with a dot",
    ),
    pytest.param(
        changed("{fmu: delay.fmu}", "{start_values: {d: 1}}"),
        "mesh.yaml:5: instances.delay.fmu: missing; expected the path of an FMU",
        id="no FMU",
    ),
    pytest.param(
        changed("{fmu: delay.fmu}", "delay.fmu"),
        "mesh.yaml:5: instances.delay: 'delay.fmu'; expected a mapping with fmu, kind, solver, tolerance, "
        "retry_discarded_steps, start_values, inputs, step_size and 11 more",
        id="text for a mapping",
    ),
    pytest.param(
        changed("a: 1,", "a: [1, {b: 2}],"),
        "mesh.yaml:4: instances.pendulum.start_values.a[1]: a mapping; "
        "expected a number, text, true or false, or a list",
        id="a mapping in an array of start values",
    ),
    pytest.param(
        changed('"der(a,2)": 0.5', "der(a,2): 0.5").replace("2)", "'2)'"),
        "mesh.yaml:4: instances.pendulum.start_values.der(a: 'der(a' without a value; "
        "expected quotes around a name with a comma inside { }",
        id="a name with a comma and no quotes",
    ),
    pytest.param(
        changed("- {from: pendulum.a, to: delay.z, factor: 2}", "- pendulum.a => delay.z"),
        "mesh.yaml:8: connections[1]: 'pendulum.a => delay.z'; expected 'instance.output -> instance.input', "
        "or {from: instance.output, to: instance.input}. Did you mean 'pendulum.a -> delay.z'?",
        id="another arrow",
    ),
    pytest.param(
        changed("- {from: pendulum.a, to: delay.z, factor: 2}", "- delay.z <- pendulum.a"),
        "mesh.yaml:8: connections[1]: 'delay.z <- pendulum.a'; expected 'instance.output -> instance.input', "
        "or {from: instance.output, to: instance.input}. Did you mean 'pendulum.a -> delay.z'?",
        id="an arrow backwards",
    ),
    pytest.param(
        changed("- {from: pendulum.a, to: delay.z, factor: 2}", "- 7"),
        "mesh.yaml:8: connections[1]: 7; expected 'instance.output -> instance.input', "
        "or {from: instance.output, to: instance.input}",
        id="a number for a connection",
    ),
    pytest.param(
        changed("connections:\n", "connections: {}\nx:\n").replace("\nx:", "\nrecord:"),
        "mesh.yaml:6: connections: a mapping; expected a list",
        id="a mapping for a list",
    ),
    pytest.param(
        GOOD + "zenoh: {listen: ['7447']}\n",
        "mesh.yaml:9: zenoh.listen[0]: '7447'; expected a Zenoh endpoint such as tcp/192.168.1.2:7447",
        id="no endpoint",
    ),
    pytest.param(
        GOOD + "timeouts: {step: 0}\n",
        "mesh.yaml:9: timeouts.step: 0; expected a finite number > 0",
        id="a deadline of zero",
    ),
    pytest.param(
        "mesh: m\nsimulation: {stop_time: 1, step_size: 1}\ninstances: {}\n",
        "mesh.yaml:3: instances: an empty mapping; expected at least 1 entry",
        id="no instance",
    ),
    pytest.param(
        GOOD + "version: 2\n",
        "mesh.yaml:9: version: 2; expected 1",
        id="a later version",
    ),
]


@pytest.mark.parametrize(("text", "expected"), STRUCTURE)
def test_a_wrong_structure_is_told_with_its_place(text: str, expected: str) -> None:
    assert expected in [str(finding) for finding in findings_of(text)]


TEXTS = [
    pytest.param("", "mesh.yaml:1: an empty file; expected a configuration", id="an empty file"),
    pytest.param("# only\n", "mesh.yaml:1: an empty file; expected a configuration", id="only a comment"),
    pytest.param(
        "null\n",
        "mesh.yaml:1: nothing (null); expected a mapping with mesh, simulation and instances",
        id="null",
    ),
    pytest.param(
        "- 1\n",
        "mesh.yaml:1: a list; expected a mapping with mesh, simulation, instances, group, connections, initialization, "
        "record, scenario and 11 more",
        id="a list",
    ),
    pytest.param(
        GOOD + "---\nmesh: b\n",
        "mesh.yaml:9: a second document; expected one document in the file",
        id="two documents",
    ),
    pytest.param(
        GOOD + "mesh: again\n",
        "mesh.yaml:9: mesh: duplicate key (first in line 1)",
        id="a duplicate key",
    ),
    pytest.param(
        "a: [1\n",
        "mesh.yaml:1: a '[' that is not closed before line 2; expected ']' at its end, and ',' between its entries",
        id="an open bracket",
    ),
    pytest.param(
        "a: b: c\n",
        "mesh.yaml:1: a second ': ' in one line; expected quotes around text with ': ' in it",
        id="two colons",
    ),
    pytest.param(
        "a:\n\tb: 1\n",
        "mesh.yaml:2: a tab; expected blanks: YAML takes no tabs there",
        id="a tab",
    ),
    pytest.param(
        'a: "\\UFFFFFFFF"\n',
        "mesh.yaml:1: an escape sequence that is no character; expected YAML 1.2",
        id="an impossible escape",
    ),
    pytest.param(
        "mesh: !!python/name:os.system\n",
        "mesh.yaml:1: mesh: the tag '!!python/name:os.system'; expected a value without a tag",
        id="a tag",
    ),
    pytest.param(
        "a: &a [*a]\n",
        "mesh.yaml:1: a[0]: the alias *a; expected the anchor &a before it, complete",
        id="an alias inside its anchor",
    ),
    pytest.param(
        "a: *b\n",
        "mesh.yaml:1: a: the alias *b; expected the anchor &b before it, complete",
        id="no such anchor",
    ),
    pytest.param("? [1, 2]\n: 3\n", "mesh.yaml:1: ?: a key that is no text; expected a name as the key", id="a key"),
    pytest.param(
        'mesh: "a\\0"\n',
        "mesh.yaml:1: mesh: 'a\\x00', which no file and no model can hold; expected other characters",
        id="a null character",
    ),
    pytest.param(
        'mesh: "a\\ud800"\n',
        "mesh.yaml:1: mesh: 'a\\ud800', which no file and no model can hold; expected other characters",
        id="half a character",
    ),
]


@pytest.mark.parametrize(("text", "expected"), TEXTS)
def test_a_text_that_is_no_such_yaml_is_refused(text: str, expected: str) -> None:
    assert expected in [str(finding) for finding in findings_of(text)]


def test_nesting_has_a_limit() -> None:
    (finding,) = findings_of("a:\n  " + "[" * 100_000)
    assert finding.found == f"more than {MAXIMUM_DEPTH} nested levels"


def test_aliases_that_explode_are_refused() -> None:
    levels = [f"l{n}: &l{n} [{', '.join([f'*l{n - 1}'] * 10)}]" for n in range(1, 9)]
    (finding,) = findings_of("\n".join(["l0: &l0 [x, x]", *levels]))
    assert finding.found == "more than 200000 values"


def test_all_findings_of_a_file_are_shown_in_the_order_of_lines() -> None:
    text = """\
mesh: 1
simulation: {stop_time: x, step_size: .inf, windows: 3}
instances:
  a: {fmu: 1, group: "b c"}
  b: {}
connections: [a.y b.u, {from: a.y}, 3, {to: a.y}]
mesh: 2
"""
    findings = findings_of(text, **{"a": 1, "c.x": 1, "a.x": {}})
    assert [(finding.line, finding.path) for finding in findings] == [
        (2, "simulation.stop_time"),
        (2, "simulation.step_size"),
        (2, "simulation.windows"),
        (4, "instances.a.fmu"),
        (4, "instances.a.group"),
        (5, "instances.b.fmu"),
        (6, "connections[0]"),
        (6, "connections[2]"),
        (6, "connections[1].to"),
        (6, "connections[3].from"),
        (7, "mesh"),
        (7, "mesh"),
        (None, "`start_values={'a': 1}`"),
        (None, "`start_values={'c.x': 1}`"),
        (None, "`start_values={'a.x': {}}`"),
    ]


def test_the_message_counts_the_problems() -> None:
    with pytest.raises(ConfigurationError, match=r"^mesh\.yaml: 2 problems\n  - mesh\.yaml:9: .*\n  - mesh") as caught:
        parse(GOOD + "foo: 1\nbar: 2\n", Path("mesh.yaml"))
    assert caught.value.exit_code == 2


def test_a_single_problem_is_the_message(tmp_path: Path) -> None:
    with pytest.raises(ConfigurationError) as caught:
        load(tmp_path / "none.yaml")

    assert str(caught.value) == f"{tmp_path / 'none.yaml'}: no such file"


def test_an_override_takes_the_place_of_a_start_value() -> None:
    loaded = parse(GOOD, Path("mesh.yaml"), {"delay.body[1].x": "on", "pendulum.a": 3})
    assert loaded.config.instances["pendulum"].start_values["a"] == 3
    assert loaded.config.instances["delay"].start_values == {"body[1].x": "on"}
    assert loaded.overrides["instances.pendulum.start_values.a"] == "`start_values={'pendulum.a': 3}`"


@pytest.mark.parametrize(
    ("name", "value", "expected"),
    [
        ("pendulum", 1, "the name 'pendulum'; expected instance.variable"),
        (
            "pendulam.a",
            1,
            "the unknown instance 'pendulam'; expected one of pendulum, delay. Did you mean 'pendulum'?",
        ),
        ("delay.d", None, "the value nothing (null); expected a number, text, true or false, or a list"),
        ("delay.d", {}, "the value a mapping; expected a number, text, true or false, or a list"),
        ("delay.d", float("nan"), "nan; expected a finite number, true or false, text or a list"),
    ],
)
def test_a_wrong_override_is_told_by_its_option(name: str, value: Plain, expected: str) -> None:
    (finding,) = findings_of(GOOD, **{name: value})
    assert str(finding) == f"mesh.yaml: `start_values={{'{name}': {value!r}}}`: {expected}"


def test_a_missing_file_suggests_the_nearest(tmp_path: Path) -> None:
    (tmp_path / "pendulum_delay.yaml").write_text(GOOD)
    with pytest.raises(ConfigurationError) as caught:
        load(tmp_path / "pendulum_dealy.yaml")
    (finding,) = caught.value.findings
    assert (finding.found, finding.suggestion) == ("no such file", str(tmp_path / "pendulum_delay.yaml"))


def test_a_missing_folder_is_a_missing_file(tmp_path: Path) -> None:
    with pytest.raises(ConfigurationError, match="no such file"):
        load(tmp_path / "nowhere" / "mesh.yaml")


@pytest.mark.parametrize("name", ["a\0b", "x" * 5000, "file/mesh.yaml"])
def test_a_path_that_cannot_be_opened_is_refused(tmp_path: Path, name: str) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(ConfigurationError, match="it cannot be read"):
        load(tmp_path / name)


def test_a_folder_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigurationError, match="a folder; expected a configuration file"):
        load(tmp_path)


def test_a_file_that_is_not_utf8_is_refused_with_the_line(tmp_path: Path) -> None:
    file = tmp_path / "mesh.yaml"
    file.write_bytes(b"mesh: a\n# \xe9\n")
    with pytest.raises(ConfigurationError, match="the byte 0xe9 in line 2; expected text in UTF-8"):
        load(file)


def test_a_file_that_is_too_long_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "mesh.yaml"
    file.write_bytes(b"#" * (MAXIMUM_BYTES + 1))
    with pytest.raises(ConfigurationError, match=f"more than {MAXIMUM_BYTES} bytes"):
        load(file)


def test_places_without_a_line_have_that_of_the_place_around_them() -> None:
    loaded = parse(GOOD, Path("mesh.yaml"))
    assert loaded.origin("connections[0].to").line == 7
    assert loaded.origin("instances.pendulum.start_values.body[1].x").line == 4
    assert loaded.origin("zenoh.mode").line == 1
    assert loaded.finding("connections[1].to", "a", "b") == Finding("mesh.yaml", "connections[1].to", "a", "b", None, 8)


def test_paths_are_relative_to_the_file(tmp_path: Path) -> None:
    (tmp_path / "configs").mkdir()
    loaded = LoadedConfig(parse(GOOD, Path("mesh.yaml")).config, tmp_path / "configs" / "mesh.yaml")
    assert loaded.resolve("../fmus/a.fmu") == tmp_path.resolve() / "fmus" / "a.fmu"
    assert loaded.resolve("/dev/stdout") == Path("/dev/stdout")
