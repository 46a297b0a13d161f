"""Start values of the configuration to values of the variables' types.

Owns what may be set before the start (FMI 2.0, 2.2.7). Knows one instance at a time; which plain value stands for which
value is `fmu_mesh.model.values`.
"""

from __future__ import annotations

from collections.abc import Mapping

from fmu_mesh.model.config import InstanceConfig
from fmu_mesh.model.description import ModelDescription, Value, Variable
from fmu_mesh.model.findings import Findings, listed, nearest, shown
from fmu_mesh.model.types import MAX_ELEMENTS
from fmu_mesh.model.values import ValueRefused, to_value

__all__ = ["resolve_start_values", "sized"]


def sized(name: str, description: ModelDescription, config: InstanceConfig, findings: Findings) -> ModelDescription:
    """A model description with the shapes that its arrays get by the structural parameters of the configuration.

    Args:
        name: instance name.
        description: the model description.
        config: the instance's section of the configuration.
        findings: where arrays go that would be too large; they keep their shapes.
    """
    sizes: dict[str, Value] = {}
    for variable in description.with_causality("structuralParameter"):
        try:
            sizes[variable.name] = to_value(config.start_values[variable.name], variable)
        except (KeyError, ValueRefused):
            continue  # it keeps its own, or `resolve_start_values` finds it
    made = description.sized(sizes)
    for variable in made.variables:
        if variable.size > MAX_ELEMENTS:
            path, found = f"instances.{name}.start_values", f"'{variable.name}' would have {variable.size} elements"
            findings.add(path, found, f"{MAX_ELEMENTS} elements of an array at most")
            return description
    return made


def resolve_start_values(
    name: str, config: InstanceConfig, variables: Mapping[str, Variable], findings: Findings
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
        else:
            try:
                values[variable_name] = to_value(value, variable)
            except ValueRefused as refused:
                found = f"{shown(value)} for the {variable.type_name} '{variable_name}'"
                if refused.out_of_range:
                    found = f"{shown(value)} for '{variable_name}', which is out of its range"
                findings.add(path, found, refused.expected, refused.suggestion)
    return values


def _role(variable: Variable) -> str:
    """Why a variable cannot be set, in FMI words."""
    if variable.variability == "constant":
        return "a constant"
    article = "an" if variable.causality[0] in "aeiou" else "a"
    initial = f" with initial '{variable.initial}'" if variable.initial is not None else ""
    return f"{article} {variable.causality}{initial}"
