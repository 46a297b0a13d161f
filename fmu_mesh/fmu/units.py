"""Unit definitions of a model description, as FMPy reads them.

Owns which of them can be used. FMI 1.0 names base units and gives no exponents, so nothing follows from it here.
"""

from __future__ import annotations

from fmpy.model_description import ModelDescription as FmpyDescription
from fmpy.model_description import ModelVariable

from ..model.units import BaseUnit

__all__ = ["base_units", "is_relative", "unit_of"]

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


def unit_of(source: ModelVariable) -> str | None:
    """The unit of a variable: its own, or that of its declared type."""
    declared = source.declaredType
    unit: str | None = source.unit or (declared.unit if declared is not None else None)
    return unit


def is_relative(source: ModelVariable) -> bool:
    """Whether a variable is a difference (relativeQuantity: FMI 2.0, 2.2.7).

    FMPy 0.3.32 hands on that of a declared type, and not that of the variable itself.
    """
    own = source.relativeQuantity
    return bool(own if own is not None else source.declaredType is not None and source.declaredType.relativeQuantity)
