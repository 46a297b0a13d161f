"""Packages with wrong parameter values, mappings or units: each is refused with the file, the line and the element."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import pytest

from fmu_mesh.ssp.system_reading import read_system
from tests.fmus.helpers import FMUS
from tests.fmus.packing import repacked

NAMESPACES = " ".join(
    f'xmlns:{prefix}="http://ssp-standard.org/SSP1/SystemStructure{name}"'
    for prefix, name in (
        ("ssd", "Description"),
        ("ssc", "Common"),
        ("ssv", "ParameterValues"),
        ("ssm", "ParameterMapping"),
    )
)
TYPES = '<TypeDefinitions><SimpleType name="Gear"><Enumeration><Item name="low" value="1"/></Enumeration></SimpleType>'
MORE = (
    '<ScalarVariable name="n" valueReference="9" causality="parameter" variability="fixed" initial="exact">'
    '<Integer start="1"/></ScalarVariable>'
    '<ScalarVariable name="gear" valueReference="10" causality="parameter" variability="fixed" initial="exact">'
    '<Enumeration declaredType="Gear" start="1"/></ScalarVariable>'
    "</ModelVariables>"
)


class Bad(NamedTuple):
    """A package, and what its only finding says.

    Attributes:
        parameters: begin in line 3 of `start.ssv`.
        mapping: begins in line 2 of `start.ssm`; None: there is no such file.
        units: begin in line 2 of `start.ssv`, in front of the parameters.
    """

    what: str
    message: str
    parameters: str = ""
    mapping: str | None = None
    units: str = ""


def _real(name: str, value: str, more: str = "") -> str:
    return f'<ssv:Parameter name="{name}">\n<ssv:Real value="{value}"{more}/></ssv:Parameter>\n'


def _entry(source: str, target: str, inside: str = "") -> str:
    return f'<ssm:MappingEntry source="{source}" target="{target}">{inside}</ssm:MappingEntry>\n'


METRE = '<ssc:Unit name="m"><ssc:BaseUnit m="1"/></ssc:Unit>'
ENUMERATION = '<ssv:Parameter name="motor.gear">\n<ssv:Enumeration value="hgih"/></ssv:Parameter>'
BOTH = '<ssv:Parameter name="motor.k">\n<ssv:String value="a"><ssv:Value value="b"/></ssv:String></ssv:Parameter>'
ARRAY = '<ssv:Parameter name="motor.k"><ssv:Real value="1 2 3"/>\n<ssc:Dimension size="3"/></ssv:Parameter>'
SIZES = '<ssv:Parameter name="motor.k">\n<ssv:Real value="1 2 3"/><ssc:Dimension size="2"/></ssv:Parameter>'
TWICE = '<ssc:MapEntry source="1" target="2"/>\n<ssc:MapEntry source="+1" target="3"/>'
INTEGERS = f"<ssc:IntegerMappingTransformation>\n{TWICE}</ssc:IntegerMappingTransformation>"

PACKAGES = [
    Bad("a number that is none", "start.ssv:4: Real of Parameter 'motor.k': the value '1,5'", _real("motor.k", "1,5")),
    Bad("a number too large", "start.ssv:4: Real of Parameter 'motor.k': the value '1e999'", _real("motor.k", "1e999")),
    Bad("no value", "start.ssv:4: Real of Parameter 'motor.k': no value; expected a number", _real("motor.k", "")),
    Bad("two ways of a value", "start.ssv:4: String of Parameter 'motor.k': the attribute 'value' and elements", BOTH),
    Bad(
        "two values of one parameter",
        "start.ssv:5: Parameter 'motor.k': a second parameter 'motor.k' with another value",
        _real("motor.k", "1") + _real("motor.k", "2"),
    ),
    Bad("sizes that do not fit", "start.ssv:4: Real of Parameter 'motor.k': 3 values for the dimensions 2", SIZES),
    Bad("an array for a scalar", "start.ssv:3: Parameter 'motor.k': an array of 3 values for the Real 'k'", ARRAY),
    Bad(
        "a broken number",
        "start.ssv:3: Parameter 'motor.n': the Real value 2.5 for the Integer",
        _real("motor.n", "2.5"),
    ),
    Bad("an unknown item", "start.ssv:3: Parameter 'motor.gear': the Enumeration value 'hgih' for", ENUMERATION),
    Bad(
        "units of other dimensions",
        "start.ssv:3: Parameter 'pendulum.g': a value in 'm' (m) for the Real 'g' of 'pendulum' in 'm/s2' (m.s-2)",
        _real("pendulum.g", "9.81", ' unit="m"'),
        units=METRE,
    ),
    Bad(
        "a unit with the factor 0",
        "start.ssv:2: BaseUnit of Unit 'x': factor 0 and offset 0",
        units='<ssc:Unit name="x"><ssc:BaseUnit m="1" factor="0"/></ssc:Unit>',
    ),
    Bad("two units of one name", "start.ssv:3: Unit 'm': a second unit 'm'; expected one", units=f"{METRE}\n{METRE}"),
    Bad(
        "two entries for one target",
        "start.ssm:3: MappingEntry 'b to motor.k': a second entry for the target 'motor.k'",
        _real("a", "1") + _real("b", "2"),
        _entry("a", "motor.k") + _entry("b", "motor.k"),
    ),
    Bad(
        "a linear transformation of an Integer",
        "start.ssv:3: Parameter 'a': the Real value 4 for the Integer 'n' of 'motor'; expected a Real variable",
        _real("a", "4"),
        _entry("a", "motor.n", '<ssc:LinearTransformation factor="2"/>'),
    ),
    Bad(
        "an ambiguous mapping",
        "start.ssm:4: MapEntry '+1' of MappingEntry 'a to motor.n': a second entry for the source '1'",
        _real("a", "1"),
        _entry("a", "motor.n", INTEGERS),
    ),
]


@pytest.mark.parametrize("bad", PACKAGES, ids=lambda bad: bad.what)
def test_a_package_with_wrong_parameters_is_refused_with_the_line_and_element(bad: Bad, tmp_path: Path) -> None:
    findings = read_system(_package(tmp_path, bad)).findings

    assert len(findings) == 1, [str(one) for one in findings]
    assert str(findings[0]).startswith(f"{tmp_path}/resources/{bad.message}")


def test_all_that_is_wrong_in_several_files_is_found_at_once(tmp_path: Path) -> None:
    wrong = Bad(
        "",
        "",
        _real("a", "x") + _real("motor.n", "y"),
        _entry("a", "motor.k", '<ssc:LinearTransformation factor="z"/>') + _entry("motor.n", "motor.k"),
    )

    findings = read_system(_package(tmp_path, wrong)).findings

    assert sorted((Path(one.file).name, one.line or 0) for one in findings) == [
        ("start.ssm", 2),
        ("start.ssm", 3),
        ("start.ssv", 4),
        ("start.ssv", 6),
    ]


def _package(folder: Path, bad: Bad) -> Path:
    """An unpacked package with the FMUs `motor` and `pendulum`."""
    resources = folder / "resources"
    resources.mkdir()
    repacked(resources / "motor.fmu", description=_with_more_types)
    repacked(resources / "pendulum.fmu", source=FMUS / "DampedPendulum.fmu")
    units = f"<ssv:Units>{bad.units}</ssv:Units>" if bad.units else ""
    (resources / "start.ssv").write_text(
        f'<ssv:ParameterSet {NAMESPACES} version="2.0" name="set">\n'
        f"{units}<ssv:Parameters>\n{bad.parameters}</ssv:Parameters></ssv:ParameterSet>"
    )
    mapping = ""
    if bad.mapping is not None:
        mapping = '<ssd:ParameterMapping source="resources/start.ssm"/>'
        text = f'<ssm:ParameterMapping {NAMESPACES} version="2.0">\n{bad.mapping}</ssm:ParameterMapping>'
        (resources / "start.ssm").write_text(text)
    binding = f'<ssd:ParameterBinding source="resources/start.ssv">{mapping}</ssd:ParameterBinding>'
    components = "".join(f'<ssd:Component name="{n}" source="resources/{n}.fmu"/>' for n in ("motor", "pendulum"))
    (folder / "SystemStructure.ssd").write_text(
        f'<ssd:SystemStructureDescription {NAMESPACES} version="2.0" name="x"><ssd:System name="root">'
        f"<ssd:ParameterBindings>{binding}</ssd:ParameterBindings><ssd:Elements>{components}</ssd:Elements>"
        "</ssd:System></ssd:SystemStructureDescription>"
    )
    return folder


def _with_more_types(description: str) -> str:
    description = description.replace("<LogCategories>", f"{TYPES}</TypeDefinitions><LogCategories>", 1)
    return description.replace("</ModelVariables>", MORE)
