"""Units, enumerations, transformations, parameter sets and mappings of SSP: what is read, and each finding's line."""

from __future__ import annotations

import math

import pytest

from fmu_mesh.errors import Finding
from fmu_mesh.ssp.file_definitions import enumeration_named, enumerations_of, unit_named, units_of
from fmu_mesh.ssp.parameter_reading import parameter_mapping, parameter_set
from fmu_mesh.ssp.problems import Problems
from fmu_mesh.ssp.system_structure import Enumeration, ParameterMapping, ParameterSet, Transformation, Unit
from fmu_mesh.ssp.xml_reading import XmlElement, read_xml
from fmu_mesh.variables.units import BaseUnit

NAMESPACES = " ".join(
    f'xmlns:{prefix}="http://ssp-standard.org/SSP1/SystemStructure{name}"'
    for prefix, name in (("ssc", "Common"), ("ssv", "ParameterValues"), ("ssm", "ParameterMapping"))
)
METRE = '<ssc:Unit name="m"><ssc:BaseUnit m="1"/></ssc:Unit>'


def _values(inside: str, problems: Problems, version: str = "2.0") -> XmlElement:
    """A parameter set; ``inside`` begins in line 2 of its file."""
    text = f'<ssv:ParameterSet {NAMESPACES} version="{version}" name="set">\n{inside}</ssv:ParameterSet>'
    root = read_xml(text.encode(), "x.ssv", "ssv:ParameterSet", problems)
    assert root is not None
    return root


def _set(parameters: str, more: str = "", version: str = "2.0") -> tuple[ParameterSet, Problems]:
    """The parameters begin in line 3 of their file."""
    problems = Problems()
    inside = f"<ssv:Parameters>\n{parameters}</ssv:Parameters>\n{more}"
    return parameter_set(_values(inside, problems, version), problems), problems


def _mapping(entries: str, version: str = "2.0") -> tuple[ParameterMapping, Problems]:
    """The entries begin in line 2 of their file."""
    problems = Problems()
    text = f'<ssm:ParameterMapping {NAMESPACES} version="{version}">\n{entries}</ssm:ParameterMapping>'
    root = read_xml(text.encode(), "x.ssm", "ssm:ParameterMapping", problems)
    assert root is not None
    return parameter_mapping(root, problems), problems


def _factor(text: str) -> float:
    """What an attribute of a number is read as; 0.0 if it is none."""
    unit = f'<ssv:Units><ssc:Unit name="m"><ssc:BaseUnit factor="{text}"/></ssc:Unit></ssv:Units>'
    [element] = [one for one in _values(unit, Problems()).own_elements() if one.tag == "ssc:BaseUnit"]
    return element.number("factor", 0.0)


def _one(found: list[Finding]) -> str:
    assert len(found) == 1, [str(one) for one in found]
    return str(found[0])


def test_a_unit_is_read_with_its_exponents_its_factor_and_its_offset() -> None:
    problems = Problems()
    celsius = '<ssc:Unit name="degC"><ssc:BaseUnit K="1" offset="273.15"/></ssc:Unit>'
    speed = '<ssc:Unit name="km/h"><ssc:BaseUnit m="1" s="-1" factor="0.2777777777777778"/></ssc:Unit>'

    units = units_of(
        _values(f"<ssv:Parameters/><ssv:Units>{celsius}{speed}</ssv:Units>", problems), "ssv:Units", problems
    )

    assert units == {
        "degC": Unit("degC", BaseUnit(K=1, offset=273.15)),
        "km/h": Unit("km/h", BaseUnit(m=1, s=-1, factor=0.2777777777777778)),
    }
    assert not problems.findings


def test_of_two_units_with_one_name_second_is_finding_with_both_lines() -> None:
    _, problems = _set("", f"<ssv:Units>\n{METRE}\n{METRE}</ssv:Units>")

    assert _one(problems.findings) == "x.ssv:6: Unit 'm': a second unit 'm'; expected one of this name (first: line 5)"


@pytest.mark.parametrize(
    ("base", "found"),
    [
        ('m="1" factor="0"', "factor 0 and offset 0; expected a finite factor that is not 0, and a finite offset"),
        ('m="1" factor="INF"', "factor inf and offset 0; expected a finite factor that is not 0, and a finite offset"),
        ('m="1" offset="NaN"', "factor 1 and offset nan; expected a finite factor that is not 0, and a finite offset"),
        ('m="1.5"', "m '1.5'; expected a whole number"),
        ('factor="1,5"', "factor '1,5'; expected a number"),
    ],
)
def test_a_unit_into_which_nothing_can_be_converted_is_a_finding(base: str, found: str) -> None:
    _, problems = _set("", f'<ssv:Units>\n<ssc:Unit name="x">\n<ssc:BaseUnit {base}/></ssc:Unit></ssv:Units>')

    assert _one(problems.findings) == f"x.ssv:6: BaseUnit of Unit 'x': {found}"


def test_an_undefined_unit_has_one_warning_and_no_base_units() -> None:
    length = '<ssv:Parameter name="{}">\n<ssv:Real value="1" unit="mm"/></ssv:Parameter>\n'

    values, problems = _set(length.format("a") + length.format("b"), f"<ssv:Units>{METRE}</ssv:Units>")

    assert [one.unit for one in values.parameters] == [Unit("mm"), Unit("mm")]
    assert not problems.findings
    assert _one(problems.warnings) == (
        "x.ssv:4: Real of Parameter 'a': the unit 'mm', which the file does not define: values in it are not "
        "converted; expected one of its Units: m (did you mean 'm'?)"
    )


def test_an_empty_unit_is_no_unit_and_without_attribute_nothing_is_said() -> None:
    values, problems = _set(
        '<ssv:Parameter name="a"><ssv:Real value="1" unit=""/></ssv:Parameter>'
        '<ssv:Parameter name="b"><ssv:Real value="1"/></ssv:Parameter>'
    )

    assert [one.unit for one in values.parameters] == [Unit(""), None]
    assert not problems.warnings
    assert unit_named("", {}) == Unit("")


def test_all_units_that_file_uses_and_does_not_define_are_one_warning() -> None:
    parameter = '<ssv:Parameter name="{}"><ssv:Real value="1" unit="{}"/></ssv:Parameter>\n'
    units = {"a": "m", "b": "[m]", "c": "[rad]", "d": "[m]"}

    values, problems = _set("".join(map(parameter.format, units, units.values())), f"<ssv:Units>{METRE}</ssv:Units>")

    assert [one.unit for one in values.parameters][1:] == [Unit("[m]"), Unit("[rad]"), Unit("[m]")]
    assert _one(problems.warnings) == (
        "x.ssv:4: Real of Parameter 'b': the units '[m]', '[rad]', which the file does not define: values in them are "
        "not converted; expected one of its Units: m"
    )


def test_a_unit_that_a_file_without_units_uses_is_a_warning() -> None:
    _, problems = _set('<ssv:Parameter name="a">\n<ssv:Real value="1" unit="m"/></ssv:Parameter>')

    assert _one(problems.warnings).endswith("values in it are not converted; expected a definition in Units")


def test_a_set_inside_a_description_may_use_the_units_of_the_description() -> None:
    problems = Problems()
    parameter = '<ssv:Parameter name="a"><ssv:Real value="1" unit="km"/></ssv:Parameter>'
    root = _values(f"<ssv:Parameters>{parameter}</ssv:Parameters>", problems)
    kilometre = Unit("km", BaseUnit(m=1, factor=1000.0))

    assert parameter_set(root, problems, {"km": kilometre}).parameters[0].unit == kilometre
    assert not problems.warnings


ITEMS = (
    '<ssc:Enumeration name="{}">\n<ssc:Item name="off" value="0"/>\n<ssc:Item name="{}" value="{}"/></ssc:Enumeration>'
)


def _enumerations(*enumerations: str) -> tuple[dict[str, Enumeration], Problems]:
    """The enumerations begin in line 3 of their file."""
    problems = Problems()
    inside = f"<ssv:Parameters/><ssv:Enumerations>\n{''.join(enumerations)}</ssv:Enumerations>"
    return enumerations_of(_values(inside, problems), "ssv:Enumerations", problems), problems


def test_an_enumeration_is_read_with_the_numbers_of_its_items() -> None:
    found, problems = _enumerations(ITEMS.format("State", "on", "-5"))

    assert found == {"State": {"off": 0, "on": -5}}
    assert not problems.findings


@pytest.mark.parametrize(
    ("enumerations", "message"),
    [
        (
            [ITEMS.format("S", "off", 1)],
            "x.ssv:5: Item 'off' of Enumeration 'S': a second item 'off'; expected one item",
        ),
        (
            [ITEMS.format("S", "on", 1), "\n" + ITEMS.format("S", "on", 1)],
            "x.ssv:6: Enumeration 'S': a second enumeration 'S'; expected one of this name (first: line 3)",
        ),
        (
            [ITEMS.format("S", "on", 2**63)],
            f"x.ssv:5: Item 'on' of Enumeration 'S': the value {2**63}; expected a whole",
        ),
        (
            [ITEMS.format("S", "on", "1.0")],
            "x.ssv:5: Item 'on' of Enumeration 'S': value '1.0'; expected a whole number",
        ),
    ],
)
def test_an_enumeration_that_is_ambiguous_or_has_no_numbers_is_a_finding(enumerations: list[str], message: str) -> None:
    _, problems = _enumerations(*enumerations)

    assert _one(problems.findings).startswith(message)


def test_an_enumeration_that_the_file_does_not_define_is_a_warning() -> None:
    found, problems = _enumerations(ITEMS.format("State", "on", 1))
    place = _mapping("")[0].place

    assert enumeration_named("Stat", found, place, problems) is None
    assert "the enumeration 'Stat', which the file does not define" in _one(problems.warnings)
    assert _one(problems.warnings).endswith("one of its Enumerations: State (did you mean 'State'?)")


def _transformation(inside: str) -> tuple[Transformation | None, Problems]:
    """``inside`` begins in line 3 of its file."""
    mapping, problems = _mapping(f'<ssm:MappingEntry source="a" target="b">\n{inside}</ssm:MappingEntry>')
    return mapping.entries[0].transformation, problems


def test_linear_transformation_has_factor_1_and_offset_0_where_none_are_given() -> None:
    found, problems = _transformation('<ssc:LinearTransformation factor="2.5"/>')

    assert found is not None
    assert (found.kind, found.factor, found.offset, found.place.line) == ("linear", 2.5, 0.0, 3)
    assert not problems.findings
    assert _transformation("")[0] is None


@pytest.mark.parametrize(
    ("kind", "entries", "expected"),
    [
        ("Boolean", [("true", "0"), ("0", "1")], [("true", "false"), ("false", "true")]),
        ("Integer", [("+01", "-3"), ("4294967296", "2")], [("1", "-3"), ("4294967296", "2")]),
        ("Enumeration", [("off", "aus"), ("on", "ein ")], [("off", "aus"), ("on", "ein ")]),
    ],
)
def test_a_mapping_of_values_is_read_in_the_shortest_form(
    kind: str, entries: list[tuple[str, str]], expected: list[tuple[str, str]]
) -> None:
    inside = "\n".join(f'<ssc:MapEntry source="{source}" target="{target}"/>' for source, target in entries)

    found, problems = _transformation(f"<ssc:{kind}MappingTransformation>{inside}</ssc:{kind}MappingTransformation>")

    assert found is not None
    assert found.kind == kind.lower()
    assert [*found.entries.items()] == expected
    assert not problems.findings


def _mapped(kind: str, *entries: tuple[str, str]) -> str:
    """A mapping of values with one entry in each line after its own."""
    inside = "".join(f'\n<ssc:MapEntry source="{source}" target="{target}"/>' for source, target in entries)
    return f"<ssc:{kind}MappingTransformation>{inside}</ssc:{kind}MappingTransformation>"


@pytest.mark.parametrize(
    ("inside", "message"),
    [
        (
            '<ssc:LinearTransformation factor="INF"/>',
            "3: LinearTransformation of MappingEntry 'a to b': factor inf and",
        ),
        ('<ssc:LinearTransformation factor="two"/>', "3: LinearTransformation of MappingEntry 'a to b': factor 'two'"),
        (
            f"<ssc:LinearTransformation/>\n{_mapped('Boolean', ('1', '0'))}",
            "4: BooleanMappingTransformation of MappingEntry 'a to b': a second transformation; expected one at most",
        ),
        (
            _mapped("Boolean", ("1", "0"), ("true", "1")),
            "5: MapEntry 'true' of MappingEntry 'a to b': a second entry for the source 'true'; expected one entry",
        ),
        (_mapped("Boolean", ("on", "0")), "4: MapEntry 'on' of MappingEntry 'a to b': source 'on'; expected true or"),
        (_mapped("Integer", ("1", "1.5")), "4: MapEntry '1' of MappingEntry 'a to b': target '1.5'; expected a whole"),
        (
            _mapped("Enumeration", ("a", "")),
            "4: MapEntry 'a' of MappingEntry 'a to b': target ''; expected the name of",
        ),
        (_mapped("Integer"), "3: IntegerMappingTransformation of MappingEntry 'a to b': no MapEntry; expected one"),
    ],
)
def test_a_transformation_that_is_wrong_or_ambiguous_is_a_finding(inside: str, message: str) -> None:
    _, problems = _transformation(inside)

    assert _one(problems.findings).startswith(f"x.ssm:{message}")


@pytest.mark.parametrize(
    ("type_", "text"),
    [
        ("Real", "1e-3"),
        ("Real", "-INF"),
        ("Real", "NaN"),
        ("Float64", "1.7976931348623157e308"),
        ("Float32", "3.4028234663852886e38"),
        ("Integer", "-2147483648"),
        ("Int8", "+127"),
        ("UInt64", "18446744073709551615"),
        ("Boolean", "true"),
        ("Boolean", "0"),
        ("String", ""),
        ("String", " two  words "),
        ("Enumeration", "item one"),
        ("Binary", ""),
        ("Binary", "0aFF"),
    ],
)
def test_a_value_of_its_type_is_kept_as_it_is_written(type_: str, text: str) -> None:
    values, problems = _set(f'<ssv:Parameter name="a"><ssv:{type_} value="{text}"/></ssv:Parameter>')

    assert (values.parameters[0].type, values.parameters[0].values) == (type_, (text,))
    assert not problems.findings
    assert not problems.warnings


@pytest.mark.parametrize(
    ("type_", "text", "found"),
    [
        ("Real", "one", "the value 'one'; expected a number"),
        ("Real", "1,5", "the value '1,5'; expected a number"),
        ("Real", "inf", "the value 'inf'; expected a number"),
        ("Real", "1e999", "the value '1e999'; expected a number"),
        ("Real", "", "no value; expected a number"),
        ("Float32", "1e39", "the value '1e39'; expected a number such as 2.5 or 1e-3, at most 3.4e+38"),
        ("Integer", "1.0", "the value '1.0'; expected a whole number from -2147483648 to 2147483647"),
        ("Integer", "2147483648", "the value '2147483648'; expected a whole number from -2147483648"),
        ("UInt8", "-1", "the value '-1'; expected a whole number from 0 to 255"),
        ("Boolean", "yes", "the value 'yes'; expected true or false"),
        ("Boolean", "True", "the value 'True'; expected true or false"),
        ("Enumeration", "", "the value ''; expected the name of an item"),
        ("Binary", "0af", "the value '0af'; expected an even number of hexadecimal digits"),
    ],
)
def test_value_that_is_none_of_its_type_is_finding_with_its_line(type_: str, text: str, found: str) -> None:
    values, problems = _set(f'<ssv:Parameter name="a">\n<ssv:{type_} value="{text}"/></ssv:Parameter>')

    assert _one(problems.findings).startswith(f"x.ssv:4: {type_} of Parameter 'a': {found}")
    assert values.parameters[0].values == ()


@pytest.mark.parametrize(
    ("inside", "message"),
    [
        ("", "3: Parameter 'a': no type; expected one of Real, Integer, Boolean, String,"),
        (
            '<ssv:Real value="1"/>\n<ssv:Integer value="1"/>',
            "4: Integer of Parameter 'a': a second type Integer; expected",
        ),
        ("<ssv:Real/>", "3: Real of Parameter 'a': no attribute 'value'"),
        ("<ssv:String/>", "3: String of Parameter 'a': no value; expected the attribute 'value', or elements Value"),
        (
            '<ssv:String value="x"><ssv:Value value="y"/></ssv:String>',
            "3: String of Parameter 'a': the attribute 'value' and elements Value; expected only one of them",
        ),
        ("<ssv:String>\n<ssv:Value/></ssv:String>", "4: Value of Parameter 'a': no attribute 'value'; expected a text"),
        (
            '<ssv:Real value="1 2 3"/><ssc:Dimension size="2"/>',
            "3: Real of Parameter 'a': 3 values for the dimensions 2; expected 2 values, row by row",
        ),
        (
            '<ssv:String value="x"/><ssc:Dimension size="2"/><ssc:Dimension size="3"/>',
            "3: String of Parameter 'a': 1 value for the dimensions 2 x 3; expected 6 values, row by row",
        ),
        (
            '<ssv:Real value="1"/>\n<ssc:Dimension/>',
            "4: Dimension of Parameter 'a': no attribute 'size'; expected a whole",
        ),
        (
            '<ssv:Real value="1"/>\n<ssc:Dimension sizeConnector="n"/>',
            "4: Dimension of Parameter 'a': the attribute 'sizeConnector' for a parameter; expected size, a whole",
        ),
    ],
)
def test_a_parameter_that_is_wrong_is_a_finding_with_its_line(inside: str, message: str) -> None:
    _, problems = _set(f'<ssv:Parameter name="a">{inside}</ssv:Parameter>')

    assert _one(problems.findings).startswith(f"x.ssv:{message}")


@pytest.mark.parametrize(("other", "ambiguous"), [("1", {}), ("2", {"a": 4})])
def test_a_second_parameter_of_one_name_is_a_warning_or_ambiguous(other: str, ambiguous: dict[str, int]) -> None:
    parameter = '<ssv:Parameter name="a"><ssv:Real value="{}"/></ssv:Parameter>\n'

    values, problems = _set(parameter.format(1) + parameter.format(other))

    assert [one.values for one in values.parameters] == [("1",)]
    assert {name: place.line for name, place in values.ambiguous.items()} == ambiguous
    assert not problems.findings
    assert _one(problems.warnings) == (
        "x.ssv:4: Parameter 'a': a second parameter of this name; expected one of each name (first: line 3)"
    )


def test_all_parameters_that_have_the_name_of_another_one_are_one_warning() -> None:
    parameter = '<ssv:Parameter name="{}"><ssv:Real value="1"/></ssv:Parameter>\n'

    _, problems = _set("".join(parameter.format(name) for name in ("a", "b", "a", "b", "a")))

    assert _one(problems.warnings) == (
        "x.ssv:5: Parameter 'a': a second parameter of this name, and other names again in lines 6, 7; expected one of "
        "each name (first: line 3)"
    )


def test_all_wrong_parameters_of_a_file_are_found_at_once() -> None:
    wrong = '<ssv:Parameter name="{}"><ssv:Integer value="x"/></ssv:Parameter>\n'

    _, problems = _set("".join(wrong.format(name) for name in "abcde"))

    assert [finding.line for finding in problems.findings] == [3, 4, 5, 6, 7]


def test_an_array_has_its_values_row_by_row_and_its_dimensions() -> None:
    dimensions = '<ssc:Dimension size="2"/><ssc:Dimension size="3"/>'
    texts = "".join(f'<ssv:Value value="{text}"/>' for text in ("a b", "", "c", "d", "e", "f"))

    values, problems = _set(
        f'<ssv:Parameter name="m"><ssv:Real value="1 2 3\n4 5 6"/>{dimensions}</ssv:Parameter>'
        f'<ssv:Parameter name="s"><ssv:String>{texts}</ssv:String>{dimensions}</ssv:Parameter>'
    )

    assert [one.dimensions for one in values.parameters] == [(2, 3), (2, 3)]
    assert values.parameters[0].values == ("1", "2", "3", "4", "5", "6")
    assert values.parameters[1].values == ("a b", "", "c", "d", "e", "f")
    assert not problems.findings
    assert not problems.warnings


def test_array_in_file_of_1_0_and_one_without_dimensions_are_warnings() -> None:
    array = '<ssv:Parameter name="m"><ssv:Real value="1 2"/>{}</ssv:Parameter>'

    old, of_old = _set(array.format('\n<ssc:Dimension size="2"/>'), version="1.0")
    without, of_without = _set(array.format(""))

    assert old.parameters[0].values == without.parameters[0].values == ("1", "2")
    assert _one(of_old.warnings).startswith("x.ssv:4: Dimension of Parameter 'm': Dimension of SSP 2.0 in a file that")
    assert _one(of_without.warnings).startswith("x.ssv:3: Real of Parameter 'm': several values without a Dimension")
    assert not of_old.findings + of_without.findings


def test_two_entries_with_one_target_are_a_finding_and_two_targets_none() -> None:
    entry = '<ssm:MappingEntry source="{}" target="{}"/>\n'

    mapping, problems = _mapping(entry.format("a", "x") + entry.format("b", "x") + entry.format("a", "y"))

    assert [(one.source, one.target) for one in mapping.entries] == [("a", "x"), ("a", "y")]
    assert _one(problems.findings) == (
        "x.ssm:3: MappingEntry 'b to x': a second entry for the target 'x'; expected one entry for each target "
        "(first: line 2)"
    )


def test_entries_with_an_empty_source_map_nothing_and_one_warning_says_so() -> None:
    entry = '<ssm:MappingEntry source="" target="x"/>\n'

    mapping, problems = _mapping(2 * entry + '<ssm:MappingEntry source="a" target="x" suppressUnitConversion="1"/>')

    assert [(one.source, one.suppress_unit_conversion) for one in mapping.entries] == [("a", True)]
    assert not problems.findings
    assert _one(problems.warnings) == (
        "x.ssm:1: ParameterMapping: 2 entries with an empty source, which map nothing (first: line 2)"
    )


def test_one_entry_with_an_empty_source_is_named_by_its_target() -> None:
    _, problems = _mapping('<ssm:MappingEntry source="" target="x"/>')

    assert _one(problems.warnings) == "x.ssm:2: MappingEntry to 'x': an empty source, which maps nothing"


@pytest.mark.parametrize("attribute", ["source", "target"])
def test_an_entry_without_a_source_or_a_target_is_a_finding(attribute: str) -> None:
    _, problems = _mapping(f'\n<ssm:MappingEntry {attribute}="a"/>')

    assert _one(problems.findings).startswith("x.ssm:3: MappingEntry")


def test_a_number_is_read_as_python_reads_its_digits() -> None:
    factors = [_factor(text) for text in ("0.1", "-1e-308", "+.5", "5.", "INF", "-INF")]

    assert factors == [0.1, -1e-308, 0.5, 5.0, math.inf, -math.inf]
    assert math.isnan(_factor("NaN"))
    assert _factor("inf") == _factor("nan") == _factor("1_0") == 0.0
