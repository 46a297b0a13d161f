"""Unit definitions of a model description, as FMPy reads them.

Owns which of them can be used. FMI 1.0 names base units and gives no exponents, so nothing follows from it here.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Mapping

from fmpy.model_description import ModelDescription as FmpyDescription
from fmpy.model_description import ModelVariable
from msgspec.structs import replace

from ....variables.model_description import Variable
from ....variables.units import BaseUnit

__all__ = ["base_units", "with_unit"]

_EXPONENTS = ("kg", "m", "s", "A", "K", "mol", "cd", "rad")


def base_units(source: FmpyDescription) -> dict[str, BaseUnit]:
    """The units that are defined in SI base units, by name (FMI 2.0, 2.2.2)."""
    units: dict[str, BaseUnit] = {}
    for unit in source.unitDefinitions:
        base = unit.baseUnit
        if unit.name is None or base is None:
            continue
        try:
            exponents = {name: int(getattr(base, name)) for name in _EXPONENTS}
            converted = BaseUnit(**exponents, factor=float(base.factor), offset=float(base.offset))
        except ValueError:
            continue
        if converted.usable:
            units[unit.name] = converted
    return units


def with_unit(
    variable: Variable, source: ModelVariable, element: ET.Element, units: Mapping[str, BaseUnit]
) -> Variable:
    """A variable with its unit in base units, if that is defined.

    Args:
        variable: the variable, with the name of its unit.
        source: the same as FMPy reads it.
        element: the same in the XML.
        units: what `base_units` returned.
    """
    base = units.get(variable.unit or "")
    if base is None:
        return variable
    return replace(variable, base_unit=base, relative_quantity=_is_relative(source, element))


def _is_relative(source: ModelVariable, element: ET.Element) -> bool:
    """Whether a variable is a difference: relativeQuantity of its own (FMI 2.0, 2.2.7), or of its declared type.

    FMPy 0.3.32 does not read that of the variable.
    """
    own = (child.get("relativeQuantity") for child in (element, *element))
    declared = source.declaredType.relativeQuantity if source.declaredType is not None else None
    value = next((text for text in own if text is not None), declared)
    return value in (True, "true", "1")
