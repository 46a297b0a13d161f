"""Values that a file or another program gives in a unit of its own: what brings them into that of the variable."""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import Any

from ..config.findings import Findings
from ..text import with_article
from ..variables.model_description import Variable
from ..variables.units import BaseUnit, Linear, conversion
from ..variables.value_types import is_float
from .connections import Variables

__all__ = ["changed", "type_in_words", "unit_change"]

_UNCHANGED = Linear()


def unit_change(  # noqa: PLR0913, PLR0917  what a unit refers to
    unit: str | None,
    variable: Variable,
    path: str,
    variables: Variables,
    unit_of: Callable[[str], BaseUnit | None],
    findings: Findings,
    *,
    outwards: bool = False,
) -> Linear | None:
    """What brings values into the unit of a variable, or out of it (``outwards``); None after a finding about ``path``.

    A unit means what a model of this mesh defines, or else what ``unit_of`` says.
    """
    if unit is None or unit == variable.unit:
        return _UNCHANGED
    if not is_float(variable.type):
        findings.add(f"{path}.unit", f"a unit for '{variable.name}', {type_in_words(variable)}", "no unit here")
        return None
    of_models = (v.base_unit for own in variables.values() for v in (own or {}).values() if v.unit == unit)
    base = next((one for one in of_models if one is not None), None) or unit_of(unit)
    if base is None:
        findings.add(f"{path}.unit", f"the unknown unit '{unit}'", f"a unit such as {variable.unit or 'N.m'}")
    elif variable.base_unit is None:
        what = f"its model does not define '{variable.unit}'" if variable.unit else "it has no unit"
        found = f"'{unit}' for '{variable.name}', which cannot be converted: {what}"
        findings.add(f"{path}.unit", found, "values in the unit of the variable, and no unit here")
    else:
        ends = (variable.base_unit, base) if outwards else (base, variable.base_unit)
        if (change := conversion(*ends, relative=variable.relative_quantity)) is not None:
            return change
        found = f"'{unit}' ({base}) for '{variable.name}' in {variable.unit} ({variable.base_unit})"
        findings.add(f"{path}.unit", found, "a unit of the same dimension")
    return None


def changed(plain: Any, change: Linear) -> Any:  # noqa: ANN401  whatever a file or a program gives
    """A number, or each number of nested lists, in the other unit; anything else as it is."""
    if change.identity:
        return plain
    if isinstance(plain, list):
        return [changed(one, change) for one in plain]
    is_number = isinstance(plain, int | float) and not isinstance(plain, bool)
    if isinstance(plain, int) and abs(plain) > sys.float_info.max:
        return plain  # it is no Real either
    return change.factor * plain + change.offset if is_number else plain


def type_in_words(variable: Variable) -> str:
    """What a variable is: `an input of type Real`."""
    return f"{with_article(variable.causality)} of type {variable.type_name}"
