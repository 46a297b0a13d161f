"""From the XML of parameter values and of parameter mappings to Structs (SSP 2.0, 6 and 7).

Owns which texts are values of which type. What the names mean in a system is `parameter_bindings`.
"""

from __future__ import annotations

import math
import re
import sys
from collections.abc import Iterable, Mapping
from typing import Final

import numpy as np
from msgspec.structs import replace

from ..text import listed, shown
from ..variables.value_types import FMI2_TYPES, INTEGERS, TYPES, VariableType
from .file_definitions import enumeration_named, enumerations_of, transformation_of, unit_named, units_of
from .grammar import PATTERNS
from .problems import Problems
from .system_structure import Enumeration, MappingEntry, ParameterMapping, ParameterSet, ParameterValue, Unit
from .xml_reading import XmlElement

__all__ = ["VARIABLE_TYPES", "parameter_mapping", "parameter_set", "refuse_ambiguous"]

VARIABLE_TYPES: Final[dict[str, VariableType]] = {**{name: name for name in TYPES}, **FMI2_TYPES}
"""The types of variables by the names of the elements for types (SSP 2.0, 4.5.1)."""

_TYPES: Final = tuple(f"ssv:{name}" for name in VARIABLE_TYPES)
_WITH_ELEMENTS: Final = ("String", "Enumeration", "Binary")
_HEX: Final = re.compile(r"([0-9a-fA-F]{2})*")
_LARGEST: Final = {
    "Real": sys.float_info.max,
    "Float64": sys.float_info.max,
    "Float32": float(np.finfo(np.float32).max),
}


def parameter_set(
    element: XmlElement,
    problems: Problems,
    units: Mapping[str, Unit] = {},
    enumerations: Mapping[str, Enumeration] = {},
) -> ParameterSet:
    """The parameters of an SSV file, or of a set inside a system structure description.

    A parameter whose values are wrong is a finding and has no values. A second one of the same name, which tools write,
    is a warning; if its value is another one, to apply it is a finding. The ``units`` and ``enumerations`` are those of
    the file around it, which a set inside a description may use; its own ones come first.
    """
    own_units = units_of(element, "ssv:Units", problems, units)
    own_enumerations = {**enumerations, **enumerations_of(element, "ssv:Enumerations", problems)}
    parameters: dict[str, ParameterValue] = {}
    repeated: list[ParameterValue] = []
    for one in element.inside("ssv:Parameters"):
        if one.tag != "ssv:Parameter" or not one.text("name"):
            continue  # there is a finding
        parameter = _parameter(one, own_units, own_enumerations, problems)
        if parameter is not None and parameters.setdefault(parameter.name, parameter) is not parameter:
            repeated.append(parameter)
    if repeated:
        first = parameters[repeated[0].name].place.line
        lines = [str(one.place.line) for one in repeated[1:]]
        more = f", and other names again in line{'s' if len(lines) > 1 else ''} {listed(lines)}" if lines else ""
        found = f"a second parameter of this name{more}"
        problems.warn(repeated[0].place, found, f"one of each name (first: line {first})")
    firsts = {one.name: parameters[one.name] for one in repeated}
    others = {one.name: one.place for one in repeated if replace(one, place=firsts[one.name].place) != firsts[one.name]}
    return ParameterSet(element.text("name"), tuple(parameters.values()), element.place, others)


def parameter_mapping(element: XmlElement, problems: Problems) -> ParameterMapping:
    """The entries of an SSM file, or of a mapping inside a system structure description.

    Entries with an empty source are left out, because they map nothing; a second entry with one target is a finding.
    """
    lines: dict[str, int] = {}
    entries: list[MappingEntry] = []
    without: list[XmlElement] = []
    for one in element.children("ssm:MappingEntry"):
        source, target = one.get("source"), one.text("target")
        if source is None or not target:
            continue  # there is a finding
        if not source:
            without.append(one)
            continue
        if target in lines:
            found = f"a second entry for the target {shown(target)}"
            problems.add(one.place, found, f"one entry for each target (first: line {lines[target]})")
            continue
        lines[target] = one.place.line
        suppressed = one.boolean("suppressUnitConversion")
        entries.append(MappingEntry(source, target, one.place, suppressed, transformation_of(one, problems)))
    if len(without) == 1:
        problems.warn(without[0].place, "an empty source, which maps nothing")
    elif without:
        found = f"{len(without)} entries with an empty source, which map nothing (first: line {without[0].place.line})"
        problems.warn(element.place, found)
    return ParameterMapping(tuple(entries), element.place)


def refuse_ambiguous(values: ParameterSet, names: Iterable[str], problems: Problems) -> None:
    """Add a finding for each of the applied ``names`` of which the set has a second parameter with another value."""
    for name in names:
        if name in values.ambiguous:
            first = next(one.place.line for one in values.parameters if one.name == name)
            found = f"a second parameter {shown(name)} with another value"
            problems.add(values.ambiguous[name], found, f"one of this name (first: line {first})")


def _parameter(
    element: XmlElement, units: dict[str, Unit], enumerations: Mapping[str, Enumeration], problems: Problems
) -> ParameterValue | None:
    """One parameter; None if it has no type."""
    types = [*element.children(*_TYPES)]
    if not types:
        return None
    for second in types[1:]:
        if second.tag != types[0].tag:  # of the same element, there is a finding
            problems.add(second.place, f"a second type {_local(second)}", "one type")
    type_ = types[0]
    kind, enumeration = _local(type_), type_.get("name")
    dimensions, fits = _dimensions(element, problems)
    values = _values(type_, problems)
    if len(values) > 1 and fits and not dimensions:
        found = "several values without a Dimension: they are taken as an array of the size that the variable has"
        problems.warn(type_.place, found, '<ssc:Dimension size="..."/> for each dimension (SSP 2.0, 6.2)')
    if dimensions and fits and values and math.prod(dimensions) != len(values):
        sizes = " x ".join(map(str, dimensions))
        found = f"{len(values)} value{'s' if len(values) > 1 else ''} for the dimensions {sizes}"
        problems.add(type_.place, found, f"{math.prod(dimensions)} values, row by row")
        fits = False
    return ParameterValue(
        element.text("name"),
        kind,
        values if fits else (),
        element.place,
        unit_named(type_.get("unit"), units),
        enumeration_named(enumeration, enumerations, type_.place, problems)
        if kind == "Enumeration" and enumeration is not None
        else None,
        dimensions,
    )


def _dimensions(element: XmlElement, problems: Problems) -> tuple[tuple[int, ...], bool]:
    """The sizes of an array, and whether all of them are known: a parameter has fixed sizes only (SSP 2.0, 4.5.3)."""
    sizes: list[int] = []
    fits = True
    for dimension in element.children("ssc:Dimension"):
        if dimension.get("sizeConnector") is not None:
            problems.add(dimension.place, "the attribute 'sizeConnector' for a parameter", "size, a whole number")
            fits = False
        elif dimension.get("size") is None:
            problems.add(dimension.place, "no attribute 'size'", "a whole number")
            fits = False
        sizes.append(dimension.integer("size"))
    return tuple(sizes), fits


def _values(element: XmlElement, problems: Problems) -> tuple[str, ...]:
    """The values of a type's element, as written; empty after a finding."""
    kind, text = _local(element), element.get("value")
    inside = [*element.children("ssv:Value")] if kind in _WITH_ELEMENTS else []
    if text is not None and inside:
        problems.add(element.place, "the attribute 'value' and elements Value", "only one of them")
        return ()
    if kind in _WITH_ELEMENTS:
        texts = [text] if text is not None else [one.text("value") for one in inside]
        if not texts:
            problems.add(element.place, "no value", "the attribute 'value', or elements Value")
    else:
        texts = (text or "").split()
        if text is not None and not texts:
            problems.add(element.place, "no value", _EXPECTED[kind])
    wrong = next((one for one in texts if not _is_value(one, kind)), None)
    if wrong is None:
        return tuple(texts)
    problems.add(element.place, f"the value {shown(wrong)}", _EXPECTED[kind])
    return ()


def _is_value(text: str, kind: str) -> bool:
    """Whether a text is a value of a type."""
    match kind:
        case "Real" | "Float64" | "Float32" if text in ("INF", "-INF", "NaN"):
            return True
        case "Real" | "Float64" | "Float32":  # digits must not become infinite
            return bool(PATTERNS["number"].fullmatch(text)) and abs(float(text)) <= _LARGEST[kind]
        case "Boolean":
            return bool(PATTERNS["boolean"].fullmatch(text))
        case "Binary":
            return bool(_HEX.fullmatch(text.strip()))
        case "Enumeration" | "String":
            return bool(text) or kind == "String"
        case _:
            return bool(PATTERNS["integer"].fullmatch(text)) and int(text) in INTEGERS[VARIABLE_TYPES[kind]]


_EXPECTED: Final = {
    **{
        name: f"a whole number from {INTEGERS[type_][0]} to {INTEGERS[type_][-1]}"
        for name, type_ in VARIABLE_TYPES.items()
        if type_ in INTEGERS
    },
    **{
        name: f"a number such as 2.5 or 1e-3, at most {largest:.3g}; INF, -INF or NaN"
        for name, largest in _LARGEST.items()
    },
    "Boolean": "true or false",
    "Enumeration": "the name of an item",
    "Binary": "an even number of hexadecimal digits",
    "String": "a text",
}
"""What the values of a type are, in words."""


def _local(element: XmlElement) -> str:
    return element.tag.partition(":")[2]
