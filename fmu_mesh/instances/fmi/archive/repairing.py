"""Repairs of descriptions that break a rule of FMI and can be understood all the same, before FMPy reads them.

Owns what is repaired, always in memory: each repair says so in a problem, and none guesses a number. What decides how
an FMU is called, and cannot be repaired, is illegal: then the FMU is refused. Most comes from the schemas of FMI, so
that there is no list of mistakes here; the rest are rules that no schema has, on which FMPy relies.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping
from functools import cache
from pathlib import Path
from typing import Any, Final, NamedTuple, TypeAlias

import fmpy
from lxml import etree

from ....variables.value_types import FMI2_TYPES, MAX_ELEMENTS

__all__ = ["Repairs", "repair"]

Xml: TypeAlias = Any
"""An object of lxml, which ships no types."""

_SCHEMAS: Final = {
    "1": "fmi1/fmiModelDescription.xsd",
    "2": "fmi2/fmi2ModelDescription.xsd",
    "3": "fmi3/fmi3ModelDescription.xsd",
    "build": "fmi3/fmi3BuildDescription.xsd",
}
"""What can be repaired, each with its schema: model descriptions by the first digit of the version, and build ones."""

_PASSES: Final = 10
"""How often the schema is asked: where it finds an element that it does not know, it ignores those after it."""

_DECIDING: Final = re.compile(
    r"valueReference|causality|variability|initial|can[A-Z]\w*|needs[A-Z]\w*|has[A-Z]\w*|numberOf\w+|intervalVariability"
)
"""Attributes that decide how an FMU is called; an invalid date or unit is only a problem of the description."""

_ATTRIBUTE: Final = re.compile(r"attribute '([^']+)': (?:\[[^]]*\] )?(.*)")
_MISSING: Final = re.compile(r"attribute '([^']+)' is required")
_ILLEGAL: Final = frozenset({"SCHEMAV_CVC_DATATYPE_VALID_1_2_1", "SCHEMAV_CVC_ENUMERATION_VALID"})
_LEFT_OUT: Final = re.compile("SimpleType|Type|Item|Unit|DisplayUnit|Alias|File|SourceFile|IncludeDirectory")
"""Elements without which an FMU runs, where they lack a name, a value or what they are about."""

_REFERENCES: Final = frozenset({"dependencies", "derivative", "clocks"})
_REAL: Final = ("Real", "Float64", "Float32")
_ORDER: Final[Mapping[str, tuple[str, ...]]] = {
    "fmiModelDescription": (
        *("ModelExchange", "CoSimulation", "ScheduledExecution", "UnitDefinitions", "TypeDefinitions"),
        *("LogCategories", "DefaultExperiment", "VendorAnnotations", "ModelVariables", "Implementation"),
        *("ModelStructure", "Annotations"),
    ),
    "ModelStructure": (
        *("Outputs", "Derivatives", "InitialUnknowns", "Output", "ContinuousStateDerivative", "ClockedState"),
        *("InitialUnknown", "EventIndicator"),
    ),
    "Unit": ("BaseUnit", "DisplayUnit"),
}
"""The order of children, where FMI has one and a file may have another."""

_VARIABILITIES: Final[Mapping[str, tuple[str, ...]]] = {
    "parameter": ("fixed", "tunable"),
    "structuralParameter": ("fixed", "tunable"),
    "calculatedParameter": ("fixed", "tunable"),
    "input": ("discrete", "continuous"),
    "output": ("discrete", "continuous", "constant"),
    "independent": ("continuous",),
    "local": ("discrete", "continuous", "constant", "fixed", "tunable"),
}
"""What FMI allows for each causality (FMI 2.0, 2.2.7; 3.0, 2.4.7.4); the first one takes the place of another.

That is the one which promises least: a parameter that may not change later, a value that changes at events.
"""


class Repairs(NamedTuple):
    """What was found."""

    problems: dict[str, None]  # what breaks a rule, and what was done about it; the keys are the texts, in their order
    illegal: dict[str, None]  # what keeps the FMU from being used

    def tell(self, element: Xml, what: str) -> None:
        """Add a problem of an element."""
        self.problems[f"{_owner(element)} {what}"] = None


def repair(root: Xml, generation: str, fmi_version: str = "") -> Repairs:
    """Repair a description.

    ``generation`` is a key of `_SCHEMAS`, ``fmi_version`` the version that it should have; empty: that is right
    already.
    """
    found = Repairs({}, {})
    etree.strip_tags(root, etree.Comment, etree.ProcessingInstruction)
    if fmi_version and root.get("fmiVersion") != fmi_version:
        found.tell(root, f"is for FMI '{root.get('fmiVersion')}'; it is read as FMI {fmi_version}")
        root.set("fmiVersion", fmi_version)
    _remove_namespaces(root, found)
    if generation != "build" and root.find("ModelVariables") is None:
        found.tell(root, "has no ModelVariables; it is read as an FMU without variables")
        root.append(root.makeelement("ModelVariables"))
    _follow_schema(root, generation, found)
    if generation != "build":
        for rule in _RULES[generation] if not found.illegal else ():
            rule(root, found)
    return found


def _owner(element: Xml) -> str:
    """How a text names an element: as the variable that it belongs to, if there is one."""
    for one in (element, *element.iterancestors()):
        if one.get("name") and _is_variable(one):
            return f"variable '{one.get('name')}' (line {one.sourceline})"
    return f"{etree.QName(element).localname} (line {element.sourceline})"


def _is_variable(element: Xml) -> bool:
    parent = element.getparent()
    return parent is not None and parent.tag == "ModelVariables"


def _remove_namespaces(root: Xml, found: Repairs) -> None:
    """FMI has no namespace: remove that of the root from all, and elements of others where no annotation has them."""
    own = etree.QName(root).namespace
    if own:
        found.tell(root, f"has the XML namespace '{own}', and FMI has none; it is ignored")
    for element in [one for one in root.iter() if one.tag.startswith("{")]:
        name = etree.QName(element)
        if name.namespace == own:
            element.tag = name.localname
        elif not any(one.tag in ("VendorAnnotations", "Annotations") for one in element.iterancestors()):
            found.tell(element, f"is of the XML namespace '{name.namespace}'; it is left out")
            element.getparent().remove(element)
    etree.cleanup_namespaces(root)


# --- what the schema finds


@cache
def _schema(generation: str) -> Xml:
    return etree.XMLSchema(file=str(Path(fmpy.__file__).parent / "schema" / _SCHEMAS[generation]))


def _follow_schema(root: Xml, generation: str, found: Repairs) -> None:
    schema = _schema(generation)
    for _ in range(_PASSES):
        schema.validate(root)
        # A repair moves other elements, and the paths are those of before.
        errors = [(error, element) for error in schema.error_log for element in root.xpath(error.path)[:1]]
        ends = [_on_attribute(*one, found) or _on_content(*one, found) for one in errors]
        for (error, _), end in zip(errors, ends, strict=True):
            found.problems[f"line {error.line}: {error.message.rstrip('.')}{end and f'; {end}'}"] = None
        if not any(ends) or found.illegal:
            return


def _on_attribute(error: Xml, element: Xml, found: Repairs) -> str:
    """Repair what an error says about an attribute; returns what was done."""
    match = _ATTRIBUTE.search(error.message)
    if match is None or (value := element.get(match[1])) is None:
        return ""
    name, rule = match.groups()
    # Without one of its attributes it would be another unit.
    if element.tag in ("BaseUnit", "DisplayUnit") and element.getparent() is not None:
        element.getparent().remove(element)
        return "the unit is left undefined"
    if "xs:boolean" in rule and set(value.lower().split()) <= {"true", "false"}:
        element.set(name, value.lower())
        return f"it is read as '{value.lower()}'"
    if error.type_name in _ILLEGAL and _DECIDING.fullmatch(name):
        found.illegal[f"{_owner(element)}: {name}: {rule.rstrip('.')}"] = None
        return ""
    # One that FMI does not know may be known to FMPy, such as a stepSize in FMI 1.0: it stays.
    if element.getparent() is not None and "DATATYPE_VALID" in error.type_name:
        del element.attrib[name]
        return "it is left out"
    return ""


def _on_content(error: Xml, element: Xml, found: Repairs) -> str:
    """Repair what an error says about an element and its children; returns what was done."""
    parent, missing = element.getparent(), _MISSING.search(error.message)
    if parent is None:
        return ""
    if "is not expected" in error.message:
        order = {tag: place for place, tag in enumerate(_ORDER.get(parent.tag, ()))}
        before = list(parent)
        parent[:] = sorted(before, key=lambda child: order.get(child.tag, len(order)))
        if element.tag in order and list(parent) != before:
            return "it is read in the right order"
        unknown = [element, *element.itersiblings(element.tag)]
    elif (missing and missing[1] in ("name", "valueReference", "value")) or "Missing child" in error.message:
        if _is_variable(element):
            found.illegal[f"{_owner(element)}: {error.message.partition(': ')[2].rstrip('.')}"] = None
        unknown = [element] if _LEFT_OUT.fullmatch(element.tag) else []
    else:
        return ""
    for one in unknown:
        parent.remove(one)
    return "it is left out" if unknown else ""


# --- rules that no schema has


def _types(root: Xml, found: Repairs) -> None:
    """Types that are declared exist; what FMPy 0.3.32 does not know of them goes to the variables (FMI 3.0, 2.4.4)."""
    types = {one.get("name"): one for one in root.iterfind("TypeDefinitions/*")}
    for element in root.iterfind("ModelVariables//*[@declaredType]"):
        name = element.get("declaredType")
        if name not in types:
            found.tell(element, f"has the declaredType '{name}', which is not defined; it is left out")
            del element.attrib["declaredType"]
        elif types[name].tag in ("ClockType", "BinaryType"):
            inherited = {key: value for key, value in types[name].items() if key not in ("name", "description")}
            for key in inherited.keys() - element.keys():
                element.set(key, inherited[key])
            del element.attrib["declaredType"]
    for one in root.xpath("TypeDefinitions/ClockType | TypeDefinitions/BinaryType"):
        one.getparent().remove(one)


def _variabilities(root: Xml, found: Repairs) -> None:
    """The variability is one that FMI allows for the causality and the type."""
    for variable in root.iterfind("ModelVariables/*"):
        fmi2_type = next((child.tag for child in variable if child.tag in FMI2_TYPES), None)
        causality = variable.get("causality", "local")
        # FMI 2.0 has one default, which is illegal for most; those of FMI 3.0 are all legal.
        variability = variable.get("variability", "continuous" if fmi2_type else None)
        allowed = [
            one
            for one in _VARIABILITIES.get(causality, ())
            if one != "continuous" or (fmi2_type or variable.tag) in _REAL or causality == "independent"
        ]
        if variability is not None and allowed and variability not in allowed:
            told = f"variability '{variability}'" if "variability" in variable.keys() else "no variability"  # noqa: SIM118 an element of lxml iterates over its children
            what = f"{causality} of the type {fmi2_type or variable.tag}"
            found.tell(variable, f"is a {what} with {told}; it is read as '{allowed[0]}'")
            variable.set("variability", allowed[0])


def _structure(root: Xml, found: Repairs) -> None:
    """All references lead to a variable: those of the structure, of derivatives and of clocks."""
    variables = list(root.iterfind("ModelVariables/*"))
    in_fmi3 = root.get("fmiVersion").startswith("3")
    references = [one.get("valueReference", "") for one in variables]
    known = {int(text) for text in references if text.isdecimal()} if in_fmi3 else range(1, len(variables) + 1)
    own = "valueReference" if in_fmi3 else "index"

    def lost(element: Xml, name: str) -> str | None:
        """What an attribute has that leads to no variable; its blanks are as FMPy wants them afterwards."""
        texts = (element.get(name) or "").split()
        if texts:
            element.set(name, " ".join(texts))
        return next((text for text in texts if not text.isdecimal() or int(text) not in known), None)

    for element in root.findall("ModelStructure/*" if in_fmi3 else "ModelStructure/*/Unknown"):
        text = lost(element, own) or (None if element.get(own) else "")
        counted = re.search("State|EventIndicator", element.tag) or element.getparent().tag == "Derivatives"
        if text is not None and counted and root.find("ModelExchange") is not None:
            found.illegal[f"{_owner(element)}: {own}: there is no variable '{text}'"] = None
        elif text is not None:
            found.tell(element, f"has the {own} '{text}', and there is no such variable; it is left out")
            element.getparent().remove(element)
    for element in (*root.iterfind("ModelVariables//*"), *root.iterfind("ModelStructure//*")):
        for name in _REFERENCES.intersection(element.keys()):
            if (text := lost(element, name)) is not None:
                found.tell(element, f"has '{text}' in {name}, and there is no such variable; {name} is left out")
                for one in (name, *(("dependenciesKind",) if name == "dependencies" else ())):
                    element.attrib.pop(one, None)


def _dimensions(root: Xml, found: Repairs) -> None:
    """The sizes of arrays are known and have a limit (FMI 3.0, 2.2.9)."""
    starts = {one.get("valueReference"): one.get("start", "") for one in root.iterfind("ModelVariables/*")}
    for variable in root.iterfind("ModelVariables/*[Dimension]"):
        sizes = [
            one.get("start") or starts.get(one.get("valueReference"), "") for one in variable.iterfind("Dimension")
        ]
        if not all(size.isdecimal() for size in sizes):
            found.illegal[f"{_owner(variable)}: the size of a Dimension is not given"] = None
        elif (count := math.prod(map(int, sizes))) > MAX_ELEMENTS:
            found.illegal[f"{_owner(variable)}: an array of {count} elements; the limit is {MAX_ELEMENTS}"] = None


def _counts(root: Xml, found: Repairs) -> None:
    """The numbers of states and event indicators are known where they are needed: in model exchange of FMI 1.0."""
    for name in ("numberOfContinuousStates", "numberOfEventIndicators"):
        if root.get(name) is None and root.find("Implementation") is None:
            found.illegal[f"{_owner(root)}: {name} is missing"] = None
        root.set(name, root.get(name, "0"))


_RULES: Final[Mapping[str, tuple[Callable[[Xml, Repairs], None], ...]]] = {
    "1": (_types, _counts),
    "2": (_types, _variabilities, _structure),
    "3": (_types, _variabilities, _structure, _dimensions),
}
"""The rules of each generation, in the order in which they are followed."""
