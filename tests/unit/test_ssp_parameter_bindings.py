"""Parameter bindings of SSP: which value counts for which variable, what it becomes, and what is refused or noted."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fmu_mesh.errors import Finding
from fmu_mesh.ssp.flattening import PathChange
from fmu_mesh.ssp.package import Package
from fmu_mesh.ssp.parameter_bindings import AppliedValue, ResolvedParameters, changed, resolve_parameters
from fmu_mesh.ssp.problems import Problems
from fmu_mesh.ssp.ssd_reading import read_structure
from fmu_mesh.ssp.system_structure import (
    Binding,
    FilePlace,
    ParameterSet,
    ParameterValue,
    StructureComponent,
    StructureSystem,
    Unit,
    components_of,
)
from fmu_mesh.variables.model_description import Causality, ModelDescription, Variability, Variable
from fmu_mesh.variables.units import BaseUnit, Linear
from fmu_mesh.variables.value_types import PlainValue, Value, VariableType

NAMESPACES = " ".join(
    f'xmlns:{prefix}="http://ssp-standard.org/SSP1/SystemStructure{name}"'
    for prefix, name in (
        ("ssd", "Description"),
        ("ssc", "Common"),
        ("ssv", "ParameterValues"),
        ("ssm", "ParameterMapping"),
    )
)
KELVIN = BaseUnit(K=1)
UNITS = (
    '<ssc:Unit name="mm"><ssc:BaseUnit m="1" factor="0.001"/></ssc:Unit>'
    '<ssc:Unit name="m"><ssc:BaseUnit m="1"/></ssc:Unit>'
    '<ssc:Unit name="K"><ssc:BaseUnit K="1"/></ssc:Unit>'
    '<ssc:Unit name="degC"><ssc:BaseUnit K="1" offset="273.15"/></ssc:Unit>'
)
GEARS = (("reverse", -1), ("neutral", 0), ("first", 1))


def _variable(
    number: int,
    name: str,
    type_: VariableType,
    *,
    unit: str | None = None,
    base: BaseUnit | None = None,
    relative: bool = False,
    causality: Causality = "parameter",
    variability: Variability = "fixed",
    dimensions: tuple[int | str, ...] = (),
    start: Value | None = None,
) -> Variable:
    return Variable(
        name=name,
        value_reference=number,
        type=type_,
        causality=causality,
        variability=variability,
        initial="exact",
        unit=unit,
        base_unit=base,
        relative_quantity=relative,
        items=GEARS if type_ == "Enumeration" else (),
        dimensions=dimensions,
        shape=tuple(size if isinstance(size, int) else 1 for size in dimensions),
        start=start,
    )


ALL = ModelDescription(
    model_name="All",
    model_identifier="All",
    fmi_version="3.0",
    kind="co_simulation",
    guid="",
    variables=(
        _variable(0, "time", "Float64", causality="independent"),
        _variable(1, "k", "Float64"),
        _variable(2, "l", "Float64", unit="m", base=BaseUnit(m=1)),
        _variable(3, "T", "Float64", unit="K", base=KELVIN),
        _variable(4, "dT", "Float64", unit="K", base=KELVIN, relative=True),
        _variable(5, "odd", "Float64", unit="furlong"),
        _variable(6, "f", "Float32"),
        _variable(7, "n", "Int32"),
        _variable(8, "u8", "UInt8"),
        _variable(9, "b", "Boolean"),
        _variable(10, "s", "String"),
        _variable(11, "gear", "Enumeration"),
        _variable(12, "data", "Binary"),
        _variable(13, "size", "UInt64", causality="structuralParameter", start=2),
        _variable(14, "v", "Float64", unit="m", base=BaseUnit(m=1), dimensions=(3,)),
        _variable(15, "w", "Float64", dimensions=(2, "size")),
        _variable(16, "texts", "String", dimensions=(2,)),
        _variable(17, "gears", "Enumeration", dimensions=(2,)),
        _variable(18, "c", "Float64", variability="constant"),
        _variable(19, "u", "Float64", causality="input", variability="continuous"),
        _variable(1, "gain", "Float64"),  # an alias of k
    ),
)


def _real(name: str, value: object, unit: str | None = None) -> str:
    unit_text = f' unit="{unit}"' if unit is not None else ""
    return f'<ssv:Parameter name="{name}"><ssv:Real value="{value}"{unit_text}/></ssv:Parameter>'


def _typed(name: str, type_: str, value: object, more: str = "") -> str:
    return f'<ssv:Parameter name="{name}"><ssv:{type_} value="{value}"/>{more}</ssv:Parameter>'


def _entry(source: str, target: str, inside: str = "", more: str = "") -> str:
    return f'<ssm:MappingEntry source="{source}" target="{target}"{more}>{inside}</ssm:MappingEntry>'


def _binding(parameters: str, mapping: str | None = None, prefix: str = "") -> str:
    """A binding with its parameters in the line after its own, and its mapping in the one after that."""
    values = (
        f'<ssv:ParameterSet version="2.0" name="set"><ssv:Parameters>{parameters}</ssv:Parameters>'
        f"<ssv:Units>{UNITS}</ssv:Units></ssv:ParameterSet>"
    )
    entries = ""
    if mapping is not None:
        inside = f'<ssm:ParameterMapping version="2.0">{mapping}</ssm:ParameterMapping>'
        entries = f"<ssd:ParameterMapping>{inside}</ssd:ParameterMapping>"
    own = f' prefix="{prefix}"' if prefix else ""
    return (
        f"<ssd:ParameterBinding{own}>\n<ssd:ParameterValues>{values}</ssd:ParameterValues>\n{entries}"
        "</ssd:ParameterBinding>\n"
    )


def _component(name: str, bindings: str = "", connectors: str = "") -> str:
    return (
        f'<ssd:Component name="{name}" source="{name}.fmu"><ssd:Connectors>{connectors}</ssd:Connectors>'
        f"<ssd:ParameterBindings>{bindings}</ssd:ParameterBindings></ssd:Component>"
    )


def _system(name: str, elements: str, bindings: str = "", connectors: str = "") -> str:
    """A system; its bindings begin in the line after its own."""
    return (
        f'<ssd:System name="{name}"><ssd:Connectors>{connectors}</ssd:Connectors>'
        f"<ssd:ParameterBindings>\n{bindings}</ssd:ParameterBindings>"
        f"<ssd:Elements>{elements}</ssd:Elements></ssd:System>"
    )


def _connector(name: str, kind: str = "parameter", type_: str = "") -> str:
    return f'<ssd:Connector name="{name}" kind="{kind}">{type_}</ssd:Connector>'


def _resolve(folder: Path, root: str) -> tuple[ResolvedParameters, Problems]:
    """The values of a description whose root system begins in line 2; every FMU is `ALL`."""
    enumerations = '<ssc:Enumeration name="Gear"><ssc:Item name="first" value="5"/></ssc:Enumeration>'
    text = (
        f'<ssd:SystemStructureDescription {NAMESPACES} version="2.0" name="x">\n{root}'
        f"<ssd:Enumerations>{enumerations}</ssd:Enumerations><ssd:Units>{UNITS}</ssd:Units>"
        "</ssd:SystemStructureDescription>"
    )
    (folder / "SystemStructure.ssd").write_text(text)
    for name in re.findall(r'source="([^"]+\.fmu)"', text):
        (folder / name).touch()  # nothing reads it
    problems = Problems()
    with Package(folder) as package:
        structure = read_structure(package, "SystemStructure.ssd", problems)
    assert structure is not None
    return resolve_parameters(structure.system, lambda _path: ALL, problems), problems


def _values(resolved: ResolvedParameters) -> dict[str, PlainValue]:
    """The values of components by hierarchical name."""
    return {
        ".".join((*path, name)): value.value
        for path, values in resolved.of_components.items()
        for name, value in values.items()
    }


def _one(found: list[Finding]) -> str:
    assert len(found) == 1, [str(one) for one in found]
    return str(found[0]).partition("SystemStructure.ssd:")[2]


def _single(folder: Path, parameters: str, mapping: str | None = None, connectors: str = "") -> ResolvedParameters:
    """The values that one binding of one component `g` gives, without a finding or a warning."""
    resolved, problems = _resolve(folder, _system("root", _component("g", _binding(parameters, mapping), connectors)))
    assert not problems.findings, [str(one) for one in problems.findings]
    assert not problems.warnings, [str(one) for one in problems.warnings]
    return resolved


# --- names and precedence


def test_a_name_in_component_is_that_of_variable_and_needs_no_connector(tmp_path: Path) -> None:
    resolved = _single(tmp_path, _real("k", "1e-3") + _real("u", -2))

    assert _values(resolved) == {"g.k": 0.001, "g.u": -2.0}
    value = resolved.of_components["g",]["k"]
    assert (value.origin.line, value.origin.element, value.how) == (4, "Parameter 'k' of Component 'g'", "")


def test_a_hierarchical_name_begins_with_the_elements_on_the_way(tmp_path: Path) -> None:
    inner = _system("B", _component("C"), _binding(_real("C.l", 3)))

    resolved, problems = _resolve(tmp_path, _system("A", inner + _component("D"), _binding(_real("B.C.k", 2))))

    assert _values(resolved) == {"B.C.l": 3.0, "B.C.k": 2.0}
    assert not problems.warnings


def test_a_name_that_means_several_variables_is_applied_to_all_of_them(tmp_path: Path) -> None:
    dotted = _component("B.C")
    inner = _system("B", _component("C"))

    resolved, problems = _resolve(tmp_path, _system("A", inner + dotted, _binding(_real("B.C.k", 2))))

    assert resolved.of_components["B", "C"]["k"].value == 2.0
    assert resolved.of_components["B.C",]["k"].value == 2.0
    assert not problems.warnings


def _k(value: int, name: str = "k") -> str:
    return _binding(_real(name, value))


@pytest.mark.parametrize(
    ("of_root", "of_system", "of_component", "expected"),
    [
        ("", "", _k(1), 1.0),
        ("", "", _k(1) + _k(2), 2.0),
        ("", _k(3, "g.k"), _k(1) + _k(2), 3.0),
        ("", _k(3, "g.k") + _k(4, "g.k"), _k(1), 4.0),
        (_k(5, "S.g.k"), _k(3, "g.k") + _k(4, "g.k"), _k(1) + _k(2), 5.0),
        (_k(5, "S.g.k") + _k(6, "S.g.k"), _k(3, "g.k"), _k(1), 6.0),
        (_k(6, "S.g.k") + _k(5, "S.g.l"), _k(3, "g.k"), _k(1), 6.0),
        # a prefix is put in front of the names
        (_binding(_real("k", 7), prefix="S.g."), _k(3, "g.k"), "", 7.0),
        (_k(6, "S.g.k") + _binding(_real("g.k", 7), prefix="S."), "", "", 7.0),
        (_binding(_real("g.k", 7), prefix="S.") + _k(6, "S.g.k"), "", "", 6.0),
        # only what a mapping names is applied, and only by its new name
        (_binding(_real("a", 8) + _real("S.g.k", 9), _entry("a", "S.g.k")), _k(3, "g.k"), "", 8.0),
        (_binding(_real("S.g.k", 9), _entry("S.g.k", "S.g.l")), _k(3, "g.k"), "", 3.0),
        (_binding(_real("S.g.k", 9), ""), "", _k(1), 1.0),
        # the names of a mapping are those with the prefix
        (_binding(_real("a", 8), _entry("p.a", "S.g.k"), prefix="p."), "", _k(1), 8.0),
        (_binding(_real("a", 8), _entry("S.a", "S.g.k"), prefix="S."), _binding(_real("a", 4), prefix="g."), "", 8.0),
        # an alias of FMI 3.0 is the same variable
        ("", "", _k(1) + _k(2, "gain"), 2.0),
        ("", _k(3, "g.k"), _k(2, "gain"), 3.0),
        (_k(5, "S.g.gain"), _k(3, "g.k"), "", 5.0),
    ],
)
def test_higher_level_beats_lower_one_and_at_one_level_later_binding_counts(
    tmp_path: Path, of_root: str, of_system: str, of_component: str, expected: float
) -> None:
    system = _system("S", _component("g", of_component), of_system)

    resolved, problems = _resolve(tmp_path, _system("root", system, of_root))

    assert _values(resolved)["S.g.k"] == expected
    assert not problems.findings


ELEMENTS = ("a", "b", "a.b")


@given(
    st.lists(
        st.tuples(
            st.sampled_from([(), ("a",), ("a", "b"), ("a.b",), ("b",)]),
            st.lists(st.sampled_from(["k", "l", "b.k", "a.b.k", "a.k", "b.l"]), min_size=1, max_size=3, unique=True),
        ),
        max_size=12,
    )
)
def test_any_bindings_give_what_a_search_over_all_of_them_gives(
    bindings: list[tuple[tuple[str, ...], list[str]]],
) -> None:
    """The system has the components `b`, `a.b` and, inside the system `a`, `b` again."""
    place = FilePlace("x.ssv", 1, "")
    numbered = [
        (owner, {name: float(100 * number + index) for index, name in enumerate(names)})
        for number, (owner, names) in enumerate(bindings)
    ]

    def own(path: tuple[str, ...]) -> tuple[Binding, ...]:
        return tuple(
            Binding(
                ParameterSet("s", tuple(ParameterValue(n, "Real", (str(v),), place) for n, v in values.items()), place)
            )
            for owner, values in numbered
            if owner == path
        )

    inner = StructureSystem(
        "a", place, elements=(StructureComponent("b", "", place, bindings=own(("a", "b"))),), bindings=own(("a",))
    )
    others = tuple(StructureComponent(name, "", place, bindings=own((name,))) for name in ("a.b", "b"))
    root = StructureSystem("root", place, elements=(inner, *others), bindings=own(()))

    expected: dict[tuple[tuple[str, ...], str], float] = {}
    for path, _ in components_of(root):
        for variable in ("k", "l"):
            for level in range(len(path), -1, -1):
                name = ".".join((*path[level:], variable))
                for owner, values in numbered:
                    if owner == path[:level] and name in values:
                        expected[path, variable] = values[name]
    resolved = resolve_parameters(root, lambda _path: ALL, Problems())

    assert {
        (path, name): value.value for path, values in resolved.of_components.items() for name, value in values.items()
    } == expected


def test_connectors_of_systems_have_values_of_their_own(tmp_path: Path) -> None:
    inner = _system("B", _component("C"), _binding(_real("P", 1) + _real("Q", 2)), _connector("P") + _connector("Q"))

    resolved, problems = _resolve(
        tmp_path,
        _system("A", inner, _binding(_real("u", 3) + _real("B.P", 4)), _connector("u", "input", "<ssc:Real/>")),
    )

    assert {node: value.value for node, value in resolved.of_systems.items()} == {
        ((), "u"): 3.0,
        (("B",), "P"): 4.0,
        (("B",), "Q"): 2.0,
    }
    assert not resolved.of_components
    assert not problems.warnings


def test_a_name_may_be_a_connector_of_system_and_variable_at_once(tmp_path: Path) -> None:
    root = _system("A", _component("g"), _binding(_real("g.k", 3)), _connector("g.k"))

    resolved, _ = _resolve(tmp_path, root)

    assert resolved.of_systems[(), "g.k"].value == resolved.of_components["g",]["k"].value == 3.0


def test_the_value_of_an_fmu_that_cannot_be_read_is_not_judged() -> None:
    place = FilePlace("x.ssd", 1, "")
    values = ParameterSet("s", (ParameterValue("k", "Real", ("1",), place),), place)
    system = StructureSystem(
        "r", place, elements=(StructureComponent("g", "g.fmu", place, bindings=(Binding(values),)),)
    )
    problems = Problems()

    assert resolve_parameters(system, lambda _path: None, problems) == ResolvedParameters({}, {})
    assert not problems.findings + problems.warnings


def test_the_names_of_an_element_that_cannot_be_read_are_not_judged(tmp_path: Path) -> None:
    missing = '<ssd:Component name="m" type="x/unknown" source="m.x"/>'

    _, problems = _resolve(tmp_path, _system("root", missing, _binding(_real("m.k", 1))))

    assert "the type 'x/unknown'" in _one(problems.findings)
    assert not problems.warnings


# --- what has no effect


def test_a_name_that_matches_nothing_is_a_warning_with_the_nearest_name(tmp_path: Path) -> None:
    root = _system("root", _component("motor"), _binding(_real("motr.k", 1)))

    resolved, problems = _resolve(tmp_path, root)

    assert not resolved.of_components
    assert _one(problems.warnings) == (
        "4: Parameter 'motr.k' of System 'root': a value for 'motr.k', which System 'root' does not have: it has no "
        "effect; expected a name such as 'motor.k'"
    )


def test_of_many_names_that_match_nothing_first_ones_have_a_warning_each(tmp_path: Path) -> None:
    names = "".join(_real(f"x{number}", 1) for number in range(30))

    _, problems = _resolve(tmp_path, _system("root", _component("g", _binding(names))))

    assert len(problems.warnings) == 9
    assert "22 more values for names that Component 'g' of System 'root' does not have" in problems.warnings[-1].found


def test_target_and_source_of_mapping_that_are_nowhere_are_warnings_at_entry(tmp_path: Path) -> None:
    mapping = "\n" + _entry("a", "g.kk") + "\n" + _entry("b", "g.k")

    resolved, problems = _resolve(tmp_path, _system("root", _component("g"), _binding(_real("a", 1), mapping)))

    assert not resolved.of_components
    assert [(one.line, one.found) for one in problems.warnings] == [
        (7, "the source 'b', which the parameter set 'set' does not have"),
        (6, "a value for 'g.kk', which System 'root' does not have: it has no effect"),
    ]


@pytest.mark.parametrize("name", ["c", "time"])
def test_a_value_for_constant_or_time_has_no_effect_and_is_warning(tmp_path: Path, name: str) -> None:
    resolved, problems = _resolve(tmp_path, _system("root", _component("g", _binding(_real(name, 1)))))

    assert not resolved.of_components
    assert f"a value for '{name}' of 'g', which cannot be set: it has no effect" in _one(problems.warnings)


def test_a_value_that_another_one_replaces_is_not_judged(tmp_path: Path) -> None:
    bindings = _binding(_typed("n", "String", "x")) + _binding(_typed("n", "Integer", 3))

    resolved, problems = _resolve(tmp_path, _system("root", _component("g", bindings)))

    assert _values(resolved) == {"g.n": 3}
    assert not problems.findings


@pytest.mark.parametrize(
    ("second", "findings"), [(_real("k", 1), 0), (_real("k", 2), 1), (_typed("k", "Integer", 1), 1)]
)
def test_to_apply_a_parameter_that_has_two_values_is_a_finding(tmp_path: Path, second: str, findings: int) -> None:
    root = _system("root", _component("g", _binding(f"{_real('k', 1)}\n{second}")))

    _, problems = _resolve(tmp_path, root)

    assert len(problems.findings) == findings
    if findings:
        assert _one(problems.findings) == (
            "5: Parameter 'k' of Component 'g': a second parameter 'k' with another value; expected one of this name "
            "(first: line 4)"
        )


def test_a_parameter_that_has_two_values_and_is_not_applied_is_warning(tmp_path: Path) -> None:
    both = _real("a", 1) + _real("a", 2) + _real("b", 3)

    resolved, problems = _resolve(tmp_path, _system("root", _component("g", _binding(both, _entry("b", "k")))))

    assert _values(resolved) == {"g.k": 3.0}
    assert not problems.findings
    assert "Parameter 'a' of Component 'g': a second parameter of this name" in _one(problems.warnings)


# --- types


@pytest.mark.parametrize(
    ("variable", "type_", "text", "expected"),
    [
        ("k", "Real", "0.1", 0.1),
        ("k", "Float64", "-INF", "-INF"),
        ("k", "Real", "NaN", "NaN"),
        ("k", "Float32", "0.1", 0.1),
        ("k", "Integer", "-3", -3.0),
        ("k", "Int64", str(2**53), 2.0**53),
        ("f", "Real", "0.1", 0.1),
        ("n", "Integer", "+7", 7),
        ("n", "UInt8", "255", 255),
        ("n", "Int64", "-5", -5),
        ("n", "Real", "4.0", 4),
        ("n", "Boolean", "true", 1),
        ("b", "Boolean", "1", True),
        ("b", "Boolean", "false", False),
        ("s", "String", " two  words ", " two  words "),
        ("gear", "Enumeration", "first", "first"),
        ("gear", "Integer", "-1", -1),
        ("data", "Binary", "00fF", "AP8="),
        ("data", "Binary", "", ""),
        ("size", "Integer", "5", 5),
    ],
)
def test_a_value_becomes_one_of_type_of_variable_where_nothing_is_lost(
    tmp_path: Path, variable: str, type_: str, text: str, expected: PlainValue
) -> None:
    value = _values(_single(tmp_path, _typed(variable, type_, text)))[f"g.{variable}"]

    assert value == expected
    assert type(value) is type(expected)


@pytest.mark.parametrize(
    ("variable", "type_", "text", "message"),
    [
        ("k", "String", "fast", "the String value 'fast' for the Float64 'k' of 'g'; expected a number"),
        ("k", "Boolean", "true", "the Boolean value true for the Float64 'k' of 'g'; expected a number"),
        (
            "k",
            "Int64",
            2**53 + 1,
            f"the Int64 value {2**53 + 1} for the Float64 'k' of 'g'; expected a whole number that a floating-point",
        ),
        ("n", "Real", "2.5", "the Real value 2.5 for the Int32 'n' of 'g'; expected a whole number"),
        ("n", "Real", "INF", "the Real value INF for the Int32 'n' of 'g'; expected a whole number"),
        ("n", "Enumeration", "x", "the Enumeration value 'x' for the Int32 'n' of 'g'; expected a whole number"),
        ("n", "Int64", 2**31, f"the Int64 value {2**31} for the Int32 'n' of 'g'; expected a whole number from -2147"),
        ("u8", "Integer", -1, "the Integer value -1 for the UInt8 'u8' of 'g'; expected a whole number from 0 to 255"),
        ("b", "Integer", 1, "the Integer value 1 for the Boolean 'b' of 'g'; expected a value of type Boolean"),
        ("s", "Integer", 1, "the Integer value 1 for the String 's' of 'g'; expected a value of type String"),
        ("data", "String", "ff", "the String value 'ff' for the Binary 'data' of 'g'; expected a value of type Binary"),
        (
            "gear",
            "Enumeration",
            "frist",
            "the Enumeration value 'frist' for the Enumeration 'gear' of 'g'; expected one of reverse (-1)",
        ),
        ("gear", "Integer", 7, "the Integer value 7 for the Enumeration 'gear' of 'g'; expected one of reverse (-1),"),
        ("gear", "Real", 1.0, "the Real value 1.0 for the Enumeration 'gear' of 'g'; expected one of reverse (-1),"),
        ("gear", "String", "first", "the String value 'first' for the Enumeration 'gear' of 'g'; expected one of"),
    ],
)
def test_a_value_that_variable_cannot_have_is_a_finding_with_its_line(
    tmp_path: Path, variable: str, type_: str, text: object, message: str
) -> None:
    resolved, problems = _resolve(tmp_path, _system("root", _component("g", _binding(_typed(variable, type_, text)))))

    assert _one(problems.findings).startswith(f"4: Parameter '{variable}' of Component 'g': {message}")
    assert (problems.findings[0].suggestion == "first") is (text == "frist")
    assert not resolved.of_components.get(("g",))


def test_item_means_number_that_variable_gives_it_and_not_that_of_file(tmp_path: Path) -> None:
    named = '<ssv:Parameter name="gear"><ssv:Enumeration name="Gear" value="first"/></ssv:Parameter>'

    assert _values(_single(tmp_path, named)) == {"g.gear": "first"}  # 5 in the file, 1 in the FMU


def test_an_item_that_the_file_defines_is_a_number_for_an_integer(tmp_path: Path) -> None:
    named = '<ssv:Parameter name="n"><ssv:Enumeration name="Gear" value="first"/></ssv:Parameter>'

    assert _values(_single(tmp_path, named)) == {"g.n": 5}


# --- arrays


SIZE_2, SIZE_3 = '<ssc:Dimension size="2"/>', '<ssc:Dimension size="3"/>'


def test_arrays_become_nested_lists_in_the_shape_of_the_variable(tmp_path: Path) -> None:
    texts = '<ssv:Value value="a b"/><ssv:Value value=""/>'
    gears = '<ssv:Value value="first"/><ssv:Value value="neutral"/>'

    values = _single(
        tmp_path,
        _typed("v", "Real", "1 2.5 NaN", SIZE_3)
        + _typed("w", "Integer", "1 2 3 4", SIZE_2 + SIZE_2)
        + f'<ssv:Parameter name="texts"><ssv:String>{texts}</ssv:String>{SIZE_2}</ssv:Parameter>'
        + f'<ssv:Parameter name="gears"><ssv:Enumeration>{gears}</ssv:Enumeration>{SIZE_2}</ssv:Parameter>',
    )

    assert _values(values) == {
        "g.v": [1.0, 2.5, "NaN"],
        "g.w": [[1.0, 2.0], [3.0, 4.0]],
        "g.texts": ["a b", ""],
        "g.gears": ["first", "neutral"],
    }


def test_a_structural_parameter_gives_the_arrays_their_sizes_whatever_the_order(tmp_path: Path) -> None:
    array = _typed("w", "Real", "1 2 3 4 5 6", SIZE_2 + SIZE_3)

    values = _single(tmp_path, array + _typed("size", "Integer", 3))

    assert _values(values) == {"g.w": [[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]], "g.size": 3}


def test_units_and_transformations_apply_to_all_elements(tmp_path: Path) -> None:
    parameter = f'<ssv:Parameter name="a"><ssv:Real value="1000 2000 3000" unit="mm"/>{SIZE_3}</ssv:Parameter>'

    resolved = _single(tmp_path, parameter, _entry("a", "v", '<ssc:LinearTransformation factor="10" offset="1"/>'))

    assert _values(resolved) == {"g.v": [11.0, 21.0, 31.0]}
    assert resolved.of_components["g",]["v"].how == "mapped in line 5, from mm to m, 10 * value + 1"


@pytest.mark.parametrize(
    ("parameter", "message"),
    [
        (_typed("k", "Real", "1 2", SIZE_2), "an array of 2 values for the Float64 'k' of 'g'; expected one value"),
        (_typed("v", "Real", "1"), "one value for the Float64[3] 'v' of 'g'; expected 3 values, with a Dimension for"),
        (_typed("v", "Real", "1 2", SIZE_2), "an array of 2 values for the Float64[3] 'v' of 'g'; expected 3 values"),
        (
            _typed("w", "Real", "1 2 3 4 5 6", SIZE_3 + SIZE_2),
            "an array of 3 x 2 values for the Float64[2,2] 'w' of 'g'",
        ),
        (_typed("v", "String", "x", '<ssc:Dimension size="1"/>'), "an array of 1 value for the Float64[3] 'v' of 'g'"),
    ],
)
def test_an_array_of_another_shape_is_a_finding(tmp_path: Path, parameter: str, message: str) -> None:
    _, problems = _resolve(tmp_path, _system("root", _component("g", _binding(parameter))))

    assert message in _one(problems.findings)


def test_several_values_without_dimensions_take_the_shape_of_the_variable(tmp_path: Path) -> None:
    resolved, problems = _resolve(tmp_path, _system("root", _component("g", _binding(_typed("w", "Real", "1 2 3 4")))))

    assert _values(resolved) == {"g.w": [[1.0, 2.0], [3.0, 4.0]]}
    assert "several values without a Dimension" in _one(problems.warnings)


# --- units and transformations


LINEAR = '<ssc:LinearTransformation factor="2" offset="10"/>'
SUPPRESSED = ' suppressUnitConversion="true"'


@pytest.mark.parametrize(
    ("variable", "unit", "entry", "expected", "how"),
    [
        ("l", "mm", None, 2.5, "from mm to m"),
        ("l", "m", None, 2500.0, ""),
        ("l", None, None, 2500.0, ""),
        ("l", "", None, 2500.0, ""),
        ("k", "mm", None, 2500.0, ""),
        ("T", "degC", None, 2773.15, "from degC to K"),
        ("dT", "degC", None, 2500.0, ""),
        ("l", "mm", _entry("a", "l", LINEAR), 15.0, "mapped in line 5, from mm to m, 2 * value + 10"),
        ("l", "mm", _entry("a", "l", LINEAR, SUPPRESSED), 5010.0, "mapped in line 5, 2 * value + 10"),
        ("l", "mm", _entry("a", "l", "", SUPPRESSED), 2500.0, "mapped in line 5"),
        (
            "k",
            None,
            _entry("a", "k", '<ssc:LinearTransformation offset="-0.5"/>'),
            2499.5,
            "mapped in line 5, value - 0.5",
        ),
    ],
)
def test_units_are_converted_before_the_transformation(
    tmp_path: Path, variable: str, unit: str | None, entry: str | None, expected: float, how: str
) -> None:
    resolved = _single(tmp_path, _real(variable if entry is None else "a", 2500, unit), entry)

    assert _values(resolved) == {f"g.{variable}": expected}
    assert resolved.of_components["g",][variable].how == how


@pytest.mark.parametrize(
    ("connector", "expected"),
    [('<ssc:Real unit="mm"/>', 2500.0), ('<ssc:Real unit=""/>', 2500.0), ("<ssc:Real/>", 2.5), ("", 2.5)],
)
def test_the_unit_of_the_connector_counts_where_it_has_one(tmp_path: Path, connector: str, expected: float) -> None:
    resolved = _single(tmp_path, _real("l", 2500, "mm"), connectors=_connector("l", "parameter", connector))

    assert _values(resolved) == {"g.l": expected}


def test_a_connector_has_its_unit_or_that_of_the_file(tmp_path: Path) -> None:
    connectors = _connector("p", type_='<ssc:Real unit="m"/>') + _connector("q", type_="<ssc:Real/>") + _connector("r")
    bindings = _binding(_real("p", 5, "mm") + _real("q", 5, "mm") + _typed("r", "Enumeration", "any"))

    resolved, problems = _resolve(tmp_path, _system("root", _component("g"), bindings, connectors))

    found = {name: (value.value, value.type, value.unit) for (_, name), value in resolved.of_systems.items()}
    assert found == {
        "p": (0.005, "Float64", Unit("m", BaseUnit(m=1))),
        "q": (5.0, "Float64", Unit("mm", BaseUnit(m=1, factor=0.001))),
        "r": ("any", "Enumeration", None),
    }
    assert not problems.findings


def test_units_of_other_dimensions_are_a_finding(tmp_path: Path) -> None:
    _, problems = _resolve(tmp_path, _system("root", _component("g", _binding(_real("l", 1, "degC")))))

    assert _one(problems.findings) == (
        "4: Parameter 'l' of Component 'g': a value in 'degC' (K) for the Float64 'l' of 'g' in 'm' (m); expected "
        'units of one dimension, or a mapping with suppressUnitConversion="true"'
    )


def test_an_undefined_unit_of_another_name_is_a_warning_and_converts_nothing(tmp_path: Path) -> None:
    bindings = _binding(_real("odd", 2, "mm") + _real("l", 3, "inch"))

    resolved, problems = _resolve(tmp_path, _system("root", _component("g", bindings)))

    assert _values(resolved) == {"g.odd": 2.0, "g.l": 3.0}
    assert not problems.findings
    found = [one.found for one in problems.warnings]
    assert len(found) == 3
    assert found[0].startswith("the unit 'inch', which the file does not define")
    assert found[1].endswith("in 'furlong' is not converted, because the unit 'furlong' is not defined")
    assert found[2].endswith("in 'm' is not converted, because the unit 'inch' is not defined")


def _map(kind: str, *entries: tuple[str, str]) -> str:
    inside = "".join(f'<ssc:MapEntry source="{source}" target="{target}"/>' for source, target in entries)
    return f"<ssc:{kind}MappingTransformation>{inside}</ssc:{kind}MappingTransformation>"


@pytest.mark.parametrize(
    ("parameter", "target", "mapping", "expected"),
    [
        (_typed("a", "Boolean", "true"), "b", _map("Boolean", ("1", "0")), False),
        (_typed("a", "Boolean", "false"), "b", _map("Boolean", ("true", "false")), False),
        (_typed("a", "Integer", "3"), "n", _map("Integer", ("3", "-30")), -30),
        (_typed("a", "Integer", "4"), "n", _map("Integer", ("3", "-30")), 4),
        (_typed("a", "Integer", "300"), "u8", _map("Integer", ("300", "44")), 44),
        (_typed("a", "Integer", "300"), "gear", _map("Integer", ("300", "1")), 1),
        (_typed("a", "Enumeration", "first"), "gear", _map("Integer", ("1", "-1")), -1),
        (_typed("a", "Enumeration", "one"), "gear", _map("Enumeration", ("one", "first")), "first"),
        (_typed("a", "Enumeration", "neutral"), "gear", _map("Enumeration", ("one", "first")), "neutral"),
        (_typed("a", "Real", "3"), "n", _map("Integer", ("3", "5")), 5),
        (_typed("a", "Integer", "3"), "k", '<ssc:LinearTransformation factor="0.5"/>', 1.5),
    ],
)
def test_a_value_goes_through_the_transformation_of_its_mapping(
    tmp_path: Path, parameter: str, target: str, mapping: str, expected: PlainValue
) -> None:
    assert _values(_single(tmp_path, parameter, _entry("a", target, mapping))) == {f"g.{target}": expected}


@pytest.mark.parametrize(
    ("parameter", "target", "mapping", "expected"),
    [
        (_typed("a", "Integer", "3"), "n", LINEAR, "a Real variable: its mapping has a LinearTransformation"),
        (_typed("a", "String", "3"), "k", LINEAR, "a number: its mapping has a LinearTransformation"),
        (_typed("a", "Integer", "1"), "b", _map("Boolean", ("1", "0")), "a Boolean: its mapping has a Boolean"),
        (_typed("a", "Boolean", "1"), "n", _map("Integer", ("1", "0")), "a whole number: its mapping has an Integer"),
        (_typed("a", "Real", "0.5"), "n", _map("Integer", ("1", "0")), "a whole number"),
        (_typed("a", "Integer", "1"), "gear", _map("Enumeration", ("1", "first")), "an Enumeration: its mapping has"),
        (_typed("a", "Integer", "1"), "gear", _map("Integer", ("1", "7")), "one of reverse (-1), neutral (0), first"),
        (_typed("a", "Integer", "1"), "u8", _map("Integer", ("1", "256")), "a whole number from 0 to 255"),
        (_typed("a", "Enumeration", "x"), "gear", _map("Enumeration", ("x", "y")), "one of reverse (-1), neutral (0)"),
    ],
)
def test_a_transformation_that_does_not_fit_value_or_variable_is_a_finding(
    tmp_path: Path, parameter: str, target: str, mapping: str, expected: str
) -> None:
    root = _system("root", _component("g", _binding(parameter, _entry("a", target, mapping))))

    _, problems = _resolve(tmp_path, root)

    assert f"expected {expected}" in _one(problems.findings)
    assert _one(problems.findings).startswith("4: Parameter 'a' of Component 'g'")


# --- values of connectors on their way to components


def _applied(value: PlainValue, type_: VariableType, shape: tuple[int, ...] = (), **more: object) -> AppliedValue:
    return AppliedValue(value, type_, FilePlace("x.ssv", 9, "Parameter 'a'"), shape=shape, **more)  # type: ignore[arg-type]  # by keyword


@pytest.mark.parametrize(
    ("value", "change", "target", "expected"),
    [
        (_applied(3.0, "Float64"), PathChange(), "k", 3.0),
        (_applied(3.0, "Float64"), PathChange(Linear(2.0, 1.0)), "k", 7.0),
        (_applied("INF", "Float64"), PathChange(Linear(-2.0, 1.0)), "k", "-INF"),
        (_applied(3, "Int32"), PathChange(Linear(0.5, 0.0)), "k", 1.5),
        (_applied([1.0, 2.0, 3.0], "Float64", (3,)), PathChange(Linear(2.0, 0.0)), "v", [2.0, 4.0, 6.0]),
        (_applied(bool(1), "Boolean"), PathChange(mapping={"true": "false"}), "b", False),
        (_applied(3, "Int32"), PathChange(mapping={"3": "1"}), "gear", 1),
        (_applied("one", "Enumeration", items={"one": 3}), PathChange(mapping={"3": "1"}), "gear", 1),
        (_applied("one", "Enumeration"), PathChange(mapping={"one": "first"}), "gear", "first"),
        (_applied("AP8=", "Binary"), PathChange(), "data", "AP8="),
        (_applied(4.0, "Float64"), PathChange(), "n", 4),
    ],
)
def test_the_value_of_a_connector_becomes_that_of_a_variable(
    value: AppliedValue, change: PathChange, target: str, expected: PlainValue
) -> None:
    problems = Problems()

    found = changed(value, change, ALL.variable(target), ("g",), problems)

    assert found is not None
    assert found.value == expected
    assert type(found.value) is type(expected)
    assert found.origin == value.origin


@pytest.mark.parametrize(
    ("value", "change", "target", "message"),
    [
        (_applied("x", "String"), PathChange(Linear(2.0)), "s", "the String value 'x' for the String 's' of 'g'"),
        (_applied(1.5, "Float64"), PathChange(), "n", "the Float64 value 1.5 for the Int32 'n' of 'g'"),
        (_applied(1.5, "Float64"), PathChange(), "v", "the Float64 value 1.5 for the Float64[3] 'v' of 'g'"),
    ],
)
def test_the_value_of_connector_that_variable_cannot_have_is_finding_at_value(
    value: AppliedValue, change: PathChange, target: str, message: str
) -> None:
    problems = Problems()

    assert changed(value, change, ALL.variable(target), ("g",), problems) is None
    assert str(problems.findings[0]).startswith(f"x.ssv:9: Parameter 'a': {message}")
