"""Start values of the configuration to values of the variables' types.

Owns what may be set before the start, and which plain value stands for which value of an FMI type
(FMI 2.0, 2.2.7). Knows one instance at a time.
"""

from __future__ import annotations

from collections.abc import Mapping

from fmu_mesh.model.config import AnyInstanceConfig
from fmu_mesh.model.description import Value, Variable
from fmu_mesh.model.findings import Findings, listed, nearest, shown

__all__ = ["resolve_start_values"]

_INTEGER_RANGE = (-(2**31), 2**31 - 1)


def resolve_start_values(
    name: str, config: AnyInstanceConfig, variables: Mapping[str, Variable], findings: Findings
) -> dict[str, Value]:
    """The start values of the instance ``name``, converted to the types of its variables.

    Args:
        name: instance name.
        config: its section of the configuration.
        variables: its variables by name.
        findings: where unknown names and impossible values go; they are left out of the result.
    """
    settable = [variable.name for variable in variables.values() if variable.settable_before_start]
    values: dict[str, Value] = {}
    for variable_name, value in config.start_values.items():
        path = f"instances.{name}.start_values.{variable_name}"
        variable = variables.get(variable_name)
        if variable is None:
            found = f"the unknown variable '{variable_name}' of instance '{name}'"
            findings.add(path, found, f"one of {listed(settable)}", nearest(variable_name, settable))
        elif not variable.settable_before_start:
            found = f"'{variable_name}', {_role(variable)} that cannot be set before the start"
            findings.add(path, found, f"one of {listed(settable)}")
        elif (converted := _convert(value, variable)) is None:
            suggestion = nearest(value, [item for item, _ in variable.items]) if isinstance(value, str) else None
            found = f"{shown(value)} for the {variable.type} '{variable_name}'"
            findings.add(path, found, _expected(variable), suggestion)
        elif not _within(converted, variable):
            found = f"{shown(value)} for '{variable_name}', which is out of its range"
            findings.add(path, found, f"a value {_range(variable)}")
        else:
            values[variable_name] = converted
    return values


def _convert(value: Value, variable: Variable) -> Value | None:
    """``value`` as a value of the variable's type, or None if it is none."""
    converted: Value | None = None
    match variable.type:
        case "Real" if type(value) in (int, float):
            converted = float(value)
        case "Integer" if type(value) is int and _fits_integer(value):
            converted = value
        case "Boolean" if isinstance(value, bool):
            converted = value
        case "String" if isinstance(value, str):
            converted = value
        case "Enumeration":
            converted = _convert_item(value, dict(variable.items))
    return converted


def _convert_item(value: Value, items: Mapping[str, int]) -> int | None:
    """The number of an item that is given by its name or its number."""
    if isinstance(value, str):
        return items.get(value)
    if type(value) is not int or not _fits_integer(value):
        return None
    return value if not items or value in items.values() else None


def _fits_integer(value: int) -> bool:
    return _INTEGER_RANGE[0] <= value <= _INTEGER_RANGE[1]


def _within(value: Value, variable: Variable) -> bool:
    if isinstance(value, str | bool):
        return True
    above = variable.minimum is None or value >= variable.minimum
    return above and (variable.maximum is None or value <= variable.maximum)


def _expected(variable: Variable) -> str:
    match variable.type:
        case "Real":
            return "a finite number"
        case "Integer":
            return f"a whole number from {_INTEGER_RANGE[0]} to {_INTEGER_RANGE[1]}"
        case "Boolean":
            return "true or false"
        case "String":
            return "text"
        case "Enumeration":
            items = [f"{item} ({number})" for item, number in variable.items]
            return f"one of {listed(items)}" if items else "the number of an item"


def _range(variable: Variable) -> str:
    if variable.minimum is None:
        return f"<= {variable.maximum:g}"
    return f">= {variable.minimum:g}" + (f" and <= {variable.maximum:g}" if variable.maximum is not None else "")


def _role(variable: Variable) -> str:
    """Why a variable cannot be set, in FMI words."""
    if variable.variability == "constant":
        return "a constant"
    article = "an" if variable.causality[0] in "aeiou" else "a"
    initial = f" with initial '{variable.initial}'" if variable.initial is not None else ""
    return f"{article} {variable.causality}{initial}"
