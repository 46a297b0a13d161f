"""Errors of YAML syntax: no words of the parser, and the line of the cause."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from fmu_mesh.errors import ConfigurationError
from tests.planning import parse

GOOD = """\
mesh: pair
simulation: {stop_time: 1, step_size: 0.01}
instances:
  pendulum: {fmu: pendulum.fmu, start_values: {l: 2.0}}
  delay:
    fmu: delay.fmu
    start_values: {d: 0.1}
connections:
  - pendulum.a -> delay.x
record: {file: pair.csv}
"""
_PARSER = re.compile(r"<[a-z ]+>|while (parsing|scanning)|token|scalar|expected to|but (found|got)|mapping values")

NOT_CLOSED = "that is not closed before line"
IN_A_COLUMN = "lines that belong together in one column"

BAD = [
    pytest.param("{l: 2.0}}", "{l: 2.0}", f"mesh.yaml:4: a '{{' {NOT_CLOSED} 5; expected '}}' at its end", id="{"),
    pytest.param("1, step_size: 0.01}", "1", f"mesh.yaml:2: a '{{' {NOT_CLOSED} 3", id="{ to the end of the line"),
    pytest.param("{file: pair.csv}", "\n  variables: [pendulum.a\n", f"mesh.yaml:11: a '[' {NOT_CLOSED} 13", id="["),
    pytest.param(
        "{stop_time: 1, ", "{\n  stop_time: 1\n  ", f"mesh.yaml:2: a '{{' {NOT_CLOSED} 4", id="a comma between lines"
    ),
    pytest.param("{d: 0.1}", "{d: 0.1]", "mesh.yaml:7: a '{' that ']' closes; expected '}'", id="{ ]"),
    pytest.param("{d: 0.1}", "[1\n      }", "mesh.yaml:7: a '[' that '}' closes in line 8; expected ']'", id="[ }"),
    pytest.param("{d: 0.1}", "{d: 0.1}}", "mesh.yaml:7: a '}' that closes nothing; expected a '{' before", id="} }"),
    pytest.param("{d: 0.1}", "{d: 0.1}]", "mesh.yaml:7: a ']' that closes nothing; expected a '[' before", id="} ]"),
    pytest.param("1, step", "1 step", "mesh.yaml:2: no ',' between two entries of '{ }'", id="no comma"),
    pytest.param("1, step", "1,, step", "mesh.yaml:2: a ',' with nothing before it", id=",,"),
    pytest.param("{file: pair.csv}", "{", f"mesh.yaml:10: a '{{' {NOT_CLOSED} 11", id="{ at the end"),
    pytest.param("mesh: pair", "mesh: 'pair", "mesh.yaml:1: a quote that is not closed", id="'"),
    pytest.param("pair.csv}", '"pair.csv}', "mesh.yaml:10: a quote that is not closed", id='"'),
    pytest.param(
        "pendulum.fmu, start_values: {l: 2.0}}\n  delay:\n    fmu: delay.fmu",
        "'pendulum.fmu}\n  delay:\n    fmu: 'delay.fmu'",
        "mesh.yaml:4: a quote that only another one in line 6 closes",
        id="' closed by the next one",
    ),
    pytest.param("    fmu", "\tfmu", "mesh.yaml:6: a tab; expected blanks: YAML takes no tabs there", id="a tab"),
    pytest.param("mesh: pair", "mesh:\tpair", "mesh.yaml:1: a tab; expected blanks", id="a tab after a colon"),
    pytest.param("mesh: pair", "mesh:pair", "mesh.yaml:1: a line without ': '; expected `key: value`", id="key:value"),
    pytest.param(
        "l: 2.0",
        "l:2.0",
        "mesh.yaml:4: instances.pendulum.start_values.l:2.0: 'l:2.0' without a value; expected a blank after the colon",
        id="key:value in braces",
    ),
    pytest.param("mesh: pair", "mesh pair", "mesh.yaml:1: a line without ': '", id="no colon"),
    pytest.param("record: {file: pair.csv}", "record", "mesh.yaml:10: a line without ': '", id="no colon at the end"),
    pytest.param("mesh: pair", "mesh: a: b", "mesh.yaml:1: a second ': ' in one line; expected quotes", id="a: b: c"),
    pytest.param(
        "    start", "      start", f"mesh.yaml:7: a line too far to the right; expected {IN_A_COLUMN}", id="right"
    ),
    pytest.param("    start", "   start", f"in another column than those above it; expected {IN_A_COLUMN}", id="left"),
    pytest.param("mesh: pair", "- mesh: pair", "mesh.yaml:2: a line without '- ' among the items", id="- and no -"),
    pytest.param("  - pen", "  pen", "connections: 'pendulum.a -> delay.x'; expected a list, each item", id="no -"),
    pytest.param("mesh: pair", "mesh: 'pa' ir", "mesh.yaml:1: text after a value; expected one value", id="'a' b"),
    pytest.param("mesh: pair", "mesh: 'pa' {}", "mesh.yaml:1: text after a value; expected one value", id="'a' {}"),
    pytest.param("mesh: pair", "mesh: - pair", "mesh.yaml:1: a '- ' where no list can begin", id="a: - b"),
    pytest.param("mesh: pair", "mesh: ? pair", "mesh.yaml:1: a '? ' where no key can be", id="a: ? b"),
    pytest.param("mesh: pair", "mesh: @pair", "mesh.yaml:1: a value that begins with '@'; expected quotes", id="@"),
    pytest.param("mesh: pair", "mesh: `pair`", "mesh.yaml:1: a value that begins with '`'; expected quotes", id="`"),
    pytest.param("l: 2.0", "l: * a", "mesh.yaml:4: a '*' or '&' without a name after it; expected quotes", id="*"),
    pytest.param("l: 2.0", "l: & a", "mesh.yaml:4: a '*' or '&' without a name after it; expected quotes", id="&"),
    pytest.param("mesh: pair", "mesh: !<a b", "mesh.yaml:1: a value that begins with '!'; expected quotes", id="!"),
    pytest.param("mesh: pair", "mesh: !!str pair", "mesh.yaml:1: mesh: the tag '!!str'; expected a value", id="!!str"),
    pytest.param("mesh: pair", "%mesh: pair", "mesh.yaml:1: a line that begins with '%'; expected none", id="%"),
    pytest.param("mesh: pair", "mesh: | pair", "mesh.yaml:1: text after '|' or '>'", id="|"),
    pytest.param("delay.fmu", '"C:\\delay.fmu"', "mesh.yaml:6: '\\d' between double quotes; expected single", id="\\d"),
    pytest.param("delay.fmu", '"\\xzz.fmu"', "mesh.yaml:6: an escape sequence that is not complete", id="\\x"),
    pytest.param("delay.fmu", "de\alay.fmu", "mesh.yaml:6: the character U+0007; expected characters", id="a bell"),
    pytest.param("mesh: pair", "%YAML 3.0\n---\nmesh: pair", "mesh.yaml:1: another version of YAML", id="YAML 3.0"),
    pytest.param("{file: pair.csv}", "{{file: pair.csv}}", "mesh.yaml:10: record.?: a key that is no text", id="{{"),
]


@pytest.mark.parametrize(("old", "new", "says"), BAD)
def test_an_error_of_syntax_is_told_in_words_at_its_cause(old: str, new: str, says: str) -> None:
    assert old in GOOD

    with pytest.raises(ConfigurationError) as caught:
        parse(GOOD.replace(old, new, 1), Path("mesh.yaml"))

    assert says in str(caught.value)
    assert "\n" not in str(caught.value)
    assert not _PARSER.search(str(caught.value))
