"""What a file defines for its other parts (SSP 2.0, 4.4, 4.5): units, enumerations, and transformations of values.

Units and enumerations belong to their file. What a unit of one file is in another one is decided by its base units.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Mapping
from types import MappingProxyType
from typing import Final, Literal

from ..text import listed, nearest, shown
from ..variables.units import BaseUnit
from ..variables.value_types import INTEGERS
from .grammar import PATTERNS
from .problems import Problems
from .system_structure import Enumeration, FilePlace, Transformation, Unit
from .xml_reading import XmlElement

__all__ = ["enumeration_named", "enumerations_of", "transformation_of", "unit_named", "units_of"]

_KINDS: Final[dict[str, Literal["linear", "boolean", "integer", "enumeration"]]] = {
    "ssc:LinearTransformation": "linear",
    "ssc:BooleanMappingTransformation": "boolean",
    "ssc:IntegerMappingTransformation": "integer",
    "ssc:EnumerationMappingTransformation": "enumeration",
}
_BOOLEANS: Final = {"true": "true", "1": "true", "false": "false", "0": "false"}


def units_of(
    root: XmlElement, tag: str, problems: Problems, around: Mapping[str, Unit] = MappingProxyType({})
) -> dict[str, Unit]:
    """The units of a file by name, or those of a parameter set with the ones of the file ``around`` it.

    Those that it uses and does not define have no base units; there is one warning about all of them. A second unit of
    one name is a finding, and so is one into which nothing can be converted, which has no base units, too.
    """
    units = dict(around)
    for element in _unique(root, tag, "ssc:Unit", problems):
        name, base = element.text("name"), element.child("ssc:BaseUnit")
        units[name] = Unit(name, _base_unit(base, problems) if base is not None else None)
    undefined: dict[str, FilePlace] = {}
    for element in root.own_elements():
        used = element.get("unit")
        if used and used not in units:
            undefined.setdefault(used, element.place)
    if undefined:
        [first, *others] = undefined
        what, values = ("the units", "them") if others else ("the unit", "it")
        found = f"{what} {listed([*map(shown, undefined)])}, which the file does not define: values in {values}"
        defined = [unit.name for unit in units.values() if unit.base is not None]
        expected = _defined("" if others else first, defined, "Unit")
        problems.warn(undefined[first], f"{found} are not converted", expected)
    return {**units, **{name: Unit(name) for name in undefined}}


def _defined(name: str, defined: Collection[str], kind: Literal["Unit", "Enumeration"]) -> str:
    """What a file should refer to instead of a name that it does not define."""
    if not defined:
        return f"a definition in {kind}s"
    near = nearest(name, defined)
    return f"one of its {kind}s: {listed([*defined])}{f' (did you mean {shown(near)}?)' if near is not None else ''}"


def unit_named(name: str | None, units: Mapping[str, Unit]) -> Unit | None:
    """The unit that an attribute `unit` names; an empty name is explicitly no unit, None is none at all."""
    return units[name] if name else None if name is None else Unit("")


def enumerations_of(root: XmlElement, tag: str, problems: Problems) -> dict[str, Enumeration]:
    """The enumerations that a file or a parameter set defines, by name.

    A second enumeration or item of one name is a finding, and so is a number of more than 64 bits.
    """
    enumerations: dict[str, Enumeration] = {}
    for element in _unique(root, tag, "ssc:Enumeration", problems):
        items: dict[str, int] = {}
        for item in element.children("ssc:Item"):
            name, number = item.text("name"), item.integer("value")
            if name in items:
                problems.add(item.place, f"a second item {shown(name)}", "one item of each name")
            elif number not in INTEGERS["Enumeration"]:
                problems.add(item.place, f"the value {number}", "a whole number of 64 bits")
            else:
                items[name] = number
        enumerations[element.text("name")] = items
    return enumerations


def enumeration_named(
    name: str, enumerations: Mapping[str, Enumeration], place: FilePlace, problems: Problems
) -> Enumeration | None:
    """The enumeration that an attribute `name` of a type names; None after a warning if the file does not define it."""
    found = enumerations.get(name)
    if found is None and name:  # without a name there is a finding
        found_name = f"the enumeration {shown(name)}, which the file does not define: the items of the FMU count"
        problems.warn(place, found_name, _defined(name, enumerations, "Enumeration"))
    return found


def transformation_of(element: XmlElement, problems: Problems) -> Transformation | None:
    """The transformation of a connection or of an entry of a mapping; None if it has none.

    Entries of a mapping whose values are wrong, and all but the first for one source, are findings and left out.
    """
    found = [*element.children(*_KINDS)]
    if not found:
        return None
    for second in found[1:]:
        if second.tag != found[0].tag:  # of the same element, there is a finding
            problems.add(second.place, "a second transformation", "one at most")
    kind = _KINDS[found[0].tag]
    place = found[0].place
    if kind != "linear":
        return Transformation(kind, place, entries=_entries(found[0], kind, problems))
    factor, offset = found[0].number("factor", 1.0), found[0].number("offset", 0.0)
    if not (math.isfinite(factor) and math.isfinite(offset)):
        problems.add(place, f"factor {factor:g} and offset {offset:g}", "finite numbers")
        return Transformation(kind, place)
    return Transformation(kind, place, factor, offset)


def _unique(root: XmlElement, tag: str, child: str, problems: Problems) -> Iterator[XmlElement]:
    """The definitions in a list; those with a name that another one has already are findings instead."""
    lines: dict[str, int] = {}
    for element in root.inside(tag):
        name = element.text("name")
        if element.tag != child or not name:
            continue  # there is a finding
        if name in lines:
            found = f"a second {child.partition(':')[2].lower()} {shown(name)}"
            problems.add(element.place, found, f"one of this name (first: line {lines[name]})")
        else:
            lines[name] = element.place.line
            yield element


def _base_unit(element: XmlElement, problems: Problems) -> BaseUnit | None:
    """A unit in base units; None after a finding."""
    unit = BaseUnit(
        **{name: element.integer(name) for name in ("kg", "m", "s", "A", "K", "mol", "cd", "rad")},
        factor=element.number("factor", 1.0),
        offset=element.number("offset", 0.0),
    )
    if unit.usable:
        return unit
    found = f"factor {unit.factor:g} and offset {unit.offset:g}"
    problems.add(element.place, found, "a finite factor that is not 0, and a finite offset")
    return None


def _entries(element: XmlElement, kind: str, problems: Problems) -> dict[str, str]:
    entries: dict[str, str] = {}
    lines: dict[str, int] = {}
    for entry in element.children("ssc:MapEntry"):
        source, target = (_map_value(entry, side, kind, problems) for side in ("source", "target"))
        if source is None or target is None:
            continue
        if source in lines:
            found = f"a second entry for the source {shown(source)}"
            problems.add(entry.place, found, f"one entry for each source (first: line {lines[source]})")
            continue
        lines[source] = entry.place.line
        entries[source] = target
    return entries


def _map_value(entry: XmlElement, side: str, kind: str, problems: Problems) -> str | None:
    """One value of an entry in its shortest form: `true` for 1, `3` for +03; None if there is a finding."""
    text = entry.get(side)
    if text is None:
        return None
    value: str | None = text
    expected = "the name of an item"
    match kind:
        case "boolean":
            value, expected = _BOOLEANS.get(text.strip()), "true or false"
        case "integer":
            value = str(int(text)) if PATTERNS["integer"].fullmatch(text.strip()) else None
            expected = "a whole number"
        case _ if not text:
            value = None
    if value is None:
        problems.add(entry.place, f"{side} {shown(text)}", expected)
    return value
