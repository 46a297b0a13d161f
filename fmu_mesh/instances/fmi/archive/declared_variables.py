"""Variables of a model description as FMPy reads it to our own, for each version of FMI.

What FMPy leaves out comes from the XML itself: aliases and direct dependencies of FMI 1.0; start values of String and
Binary arrays, sizes and some limits of FMI 3.0. FMI 1.0 names base units and gives no exponents, so none of its units
can be converted.
"""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from collections.abc import Callable, Iterable

from fmpy.model_description import ModelDescription as FmpyDescription
from fmpy.model_description import ModelVariable, Unknown
from msgspec.structs import replace

from ....variables.model_description import Causality, Initial, Value, Variable, VariableType
from ....variables.units import BASE_UNITS, BaseUnit
from ....variables.value_types import FMI2_TYPES, INTEGERS, TYPES, nested

__all__ = ["number", "states_of", "variables_of"]

Dependencies = dict[str, tuple[str, ...] | None]


def variables_of(source: FmpyDescription, root: ET.Element) -> tuple[Variable, ...]:
    """All variables whose type we know, in the order of the model description; FMI 3.0 aliases at the end.

    Of several with one name, which no version of FMI allows and some FMUs have, the last one is the variable: a name is
    a key, a column and an address, and cannot stand for two things.
    """
    elements = {element.get("name"): element for element in root.iterfind("ModelVariables/*")}
    convert: Callable[[ModelVariable, ET.Element, Dependencies], Variable]
    if source.fmiVersion == "1.0":
        convert, dependencies = _fmi1, _direct_dependencies(source, elements.values())
        feedthrough = dependencies
    else:
        convert = _fmi3 if source.fmiVersion.startswith("3.") else _fmi2
        dependencies = _dependencies(source, source.initialUnknowns)
        feedthrough = _dependencies(source, [*source.derivatives, *source.outputs])
        feedthrough |= dict.fromkeys(states_of(source), ())  # a state depends on no value of the same point
    units = _base_units(source)
    variables: dict[str, Variable] = {}
    for declared in source.modelVariables:
        if declared.type in FMI2_TYPES or declared.type in TYPES:
            element = elements[(declared.alias or declared).name]
            variable = convert(declared, element, dependencies)
            base = units.get(variable.unit or "")
            variables[variable.name] = replace(
                variable,
                base_unit=base,
                relative_quantity=base is not None and _is_relative(declared, element),
                feedthrough=feedthrough.get((declared.alias or declared).name),
            )
    return tuple(variables.values())


def _fmi1(source: ModelVariable, element: ET.Element, dependencies: Dependencies) -> Variable:
    """A variable of FMI 1.0 (ME 3.3); what has a start value can be set before the slave is initialized."""
    value = next((child for child in element if child.tag in FMI2_TYPES), element)
    initial: Initial | None = None
    if source.start is not None:
        initial = "approx" if value.get("fixed") in ("false", "0") else "exact"
    causality: Causality = source.causality if source.causality in ("input", "output", "parameter") else "local"
    return _variable(
        source,
        FMI2_TYPES[source.type],
        causality=causality,
        initial=initial,
        start=_start(FMI2_TYPES[source.type], source.start),
        dependencies=dependencies.get(source.name, ()),
        negated=element.get("alias") == "negatedAlias",
    )


def _fmi2(source: ModelVariable, _element: ET.Element, dependencies: Dependencies) -> Variable:
    """A variable of FMI 2.0 (2.2.7)."""
    return _variable(
        source,
        FMI2_TYPES[source.type],
        start=_start(FMI2_TYPES[source.type], source.start),
        dependencies=dependencies.get(source.name, ()),
    )


def _fmi3(source: ModelVariable, element: ET.Element, dependencies: Dependencies) -> Variable:
    """A variable of FMI 3.0 (2.4.7), or an alias of one."""
    type_: VariableType = source.type
    shape = tuple(source.shape or ())
    if type_ in ("String", "Binary"):
        texts = [start.get("value") or "" for start in element.iterfind("Start")]
    else:
        texts = (element.get("start") or "").split()
    return _variable(
        source,
        type_,
        start=_array_start(type_, texts, shape),
        dependencies=dependencies.get((source.alias or source).name, ()),
        declared_type=None,
        nominal=number(element.get("nominal")),
        minimum=number(element.get("min")),
        maximum=number(element.get("max")),
        dimensions=tuple(d.start if d.start is not None else d.variable.name for d in source.dimensions),
        shape=shape,
        max_size=int(size) if (size := element.get("maxSize")) is not None and size.isdecimal() else None,
    )


def _variable(source: ModelVariable, type_: VariableType, **more: object) -> Variable:
    declared = source.declaredType
    items = tuple((item.name, int(item.value)) for item in declared.items) if declared and declared.items else ()
    fields: dict[str, object] = {
        "causality": source.causality or "local",
        "initial": source.initial,
        "variability": source.variability or ("continuous" if type_ == "Float64" else "discrete"),
        "unit": source.unit or (declared.unit if declared is not None else None),
        "description": source.description,
        "minimum": number(source.min),
        "maximum": number(source.max),
        "nominal": number(source.nominal),
        "items": items,
        "declared_type": source.type,
        **more,
    }
    return Variable(name=source.name, value_reference=int(source.valueReference), type=type_, **fields)  # type: ignore[arg-type] # by keyword


def _base_units(source: FmpyDescription) -> dict[str, BaseUnit]:
    """The units that are defined in SI base units, by name (FMI 2.0, 2.2.2)."""
    units: dict[str, BaseUnit] = {}
    for unit in source.unitDefinitions:
        base = unit.baseUnit
        if unit.name is None or base is None:
            continue
        try:
            exponents = {name: int(getattr(base, name)) for name in BASE_UNITS}
            converted = BaseUnit(**exponents, factor=float(base.factor), offset=float(base.offset))
        except ValueError:
            continue
        if converted.usable:
            units[unit.name] = converted
    return units


def _is_relative(source: ModelVariable, element: ET.Element) -> bool:
    """Whether a variable is a difference: relativeQuantity of its own (FMI 2.0, 2.2.7), or of its declared type.

    FMPy 0.3.32 does not read that of the variable.
    """
    own = (child.get("relativeQuantity") for child in (element, *element))
    declared = source.declaredType.relativeQuantity if source.declaredType is not None else None
    value = next((text for text in own if text is not None), declared)
    return value in (True, "true", "1")


def states_of(source: FmpyDescription) -> tuple[str, ...]:
    """The names of the continuous states, in the order of their derivatives; FMI 1.0 does not tell them."""
    derivatives = (unknown.variable for unknown in source.derivatives if unknown.variable is not None)
    return tuple(own.derivative.name for own in derivatives if own.derivative is not None)


def _dependencies(source: FmpyDescription, unknowns: Iterable[Unknown]) -> Dependencies:
    """What unknowns depend on, None for all (FMI 2.0, 2.2.8; FMI 3.0, 2.4.8); with aliases of knowns."""
    names: dict[int, list[str]] = {}
    for variable in source.modelVariables:
        names.setdefault(id(variable.alias or variable), []).append(variable.name)
    return {
        unknown.variable.name: None
        if unknown.dependencies is None
        else tuple(name for known in unknown.dependencies for name in names.get(id(known), ()))
        for unknown in unknowns
        if unknown.variable is not None
    }


def _direct_dependencies(source: FmpyDescription, elements: Iterable[ET.Element]) -> Dependencies:
    """What outputs of FMI 1.0 depend on; on all inputs if they do not say (ME 3.3)."""
    dependencies: Dependencies = {v.name: None for v in source.modelVariables if v.causality == "output"}
    for element in elements:
        direct = element.find("DirectDependency")
        if direct is not None:
            dependencies[element.get("name") or ""] = tuple(name.text or "" for name in direct.iterfind("Name"))
    return dependencies


def _array_start(type_: VariableType, texts: list[str], shape: tuple[int, ...]) -> Value | None:
    """The start value of a scalar or an array, for which one value stands for all elements (FMI 3.0, 2.4.7)."""
    if len(texts) == 1:
        texts *= math.prod(shape)
    values = [_start(type_, text) for text in texts]
    if not values or len(values) != math.prod(shape) or None in values:
        return None
    return nested(values, shape)


def _start(type_: VariableType, text: str | None) -> Value | None:
    """The start value of one element, or None if there is none or it is not of the type."""
    if text is None:
        return None
    readers: dict[VariableType, Callable[[str], Value]] = {
        "Float64": float,
        "Float32": float,
        "Boolean": lambda word: word in ("true", "1"),
        "String": str,
        "Binary": bytes.fromhex,
    }
    try:
        value = readers.get(type_, int)(text)
    except ValueError:
        return None
    return value if not isinstance(value, int) or type_ == "Boolean" or value in INTEGERS[type_] else None


def number(text: str | float | None) -> float | None:
    """The number in an attribute; None if there is none."""
    if text is None:
        return None
    try:
        return float(text)
    except ValueError:
        return None
