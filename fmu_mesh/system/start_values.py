"""From the start values of a configuration to values of the types of the variables.

Owns which variables can be set before the start (FMI 2.0, 2.2.7) and which between two steps, and which start values
an FMU gets although FMI forbids them. The conversion of a single value is `fmu_mesh.variables.value_conversion`.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

import numpy as np
from msgspec.structs import replace

from fmu_mesh.config.findings import Findings
from fmu_mesh.config.instance_sections import InstanceSection, SubstitutesConfig
from fmu_mesh.config.mesh import Config
from fmu_mesh.system.connections import element_of
from fmu_mesh.text import listed, nearest, shown
from fmu_mesh.variables.model_description import ModelDescription, Value, Variable
from fmu_mesh.variables.value_conversion import ValueRefused, to_value
from fmu_mesh.variables.value_types import MAX_ELEMENTS, flattened, nested, split_element

__all__ = [
    "check_substitutes",
    "forbidden",
    "forbidden_start_values",
    "resolve_start_values",
    "sized",
    "why_not_settable",
]

_SOURCES: Final = {"1": "FMI 1.0 (ME 3.3)", "2": "FMI 2.0 (2.2.7)", "3": "FMI 3.0 (2.4.7)"}
"""The clause that says which variables may have a start value, by version of FMI."""


def sized(name: str, description: ModelDescription, config: InstanceSection, findings: Findings) -> ModelDescription:
    """A model description with its arrays in the sizes that the structural parameters of the configuration give.

    If an array would be too large, which is a finding, all keep their sizes.
    """
    sizes: dict[str, Value] = {}
    for variable in description.with_causality("structuralParameter"):
        try:
            sizes[variable.name] = to_value(config.start_values[variable.name], variable)
        except (KeyError, ValueRefused):
            continue  # there is none, or `resolve_start_values` refuses it
    made = description.sized(sizes)
    for variable in made.variables:
        if variable.size > MAX_ELEMENTS:
            path, found = f"instances.{name}.start_values", f"'{variable.name}' would have {variable.size} elements"
            findings.add(path, found, f"{MAX_ELEMENTS} elements of an array at most")
            return description
    return made


def resolve_start_values(
    name: str, config: InstanceSection, description: ModelDescription, findings: Findings, *, finite: bool = False
) -> dict[str, Value]:
    """The start values of the instance ``name``, converted to the types of its variables.

    Unknown names and wrong values are findings, and with ``finite`` NaN and infinity are; the result has the others.
    """
    settable = [variable.name for variable in description.variables if variable.settable_before_start]
    values: dict[str, Value] = {}
    # Elements come last: they replace those of the array.
    for variable_name, value in sorted(config.start_values.items(), key=lambda one: not description.variable(one[0])):
        path = f"instances.{name}.start_values.{variable_name}"
        variable, parts = description.variable_of(variable_name), split_element(variable_name)
        index = parts[1] if parts is not None and variable is not None and variable.name != variable_name else ()
        if (clock := description.clock(variable_name)) is not None:
            findings.add(path, clock, "")
        elif variable is None:
            found = f"the unknown variable '{variable_name}' of instance '{name}'"
            findings.add(path, found, f"one of {listed(settable)}", nearest(variable_name, settable))
        elif not (variable.may_take_start_value if config.follows_fmi else variable.settable_before_start):
            found = f"'{variable_name}', {variable.role} that cannot be set before the start"
            findings.add(path, found, f"one of {listed(settable)}")
        else:
            if index and element_of(variable, index, path, variable_name, findings) is None:
                continue
            whole, own = values.get(variable.name, variable.start), replace(variable, shape=()) if index else variable
            if index and whole is None:
                findings.add(path, f"an element of '{variable.name}', which has no start value", "that of all elements")
                continue
            try:
                converted = to_value(value, own, finite=finite)
                if index and whole is not None:
                    elements = flattened(whole, len(variable.shape))
                    elements[int(np.ravel_multi_index(index, variable.shape))] = converted
                    converted = nested(elements, variable.shape)
                values[variable.name] = converted
            except ValueRefused as refused:
                found = f"{shown(value)} for the {own.type_name} '{variable_name}'"
                if refused.out_of_range:
                    found = f"{shown(value)} for '{variable_name}', which is out of its range"
                findings.add(path, found, refused.expected, refused.suggestion)
    return values


def check_substitutes(
    name: str, config: InstanceSection, description: ModelDescription, findings: Findings, *, finite: bool
) -> None:
    """Add a finding for each substitute of `on_failure` that is for no output, or that its output cannot have."""
    given = config.on_failure.disable if isinstance(config.on_failure, SubstitutesConfig) else {}
    outputs = {variable.name: variable for variable in description.with_causality("output")}
    for output, value in given.items():
        path = f"instances.{name}.on_failure.disable.{output}"
        if output not in outputs:
            variable = description.variable_of(output)
            what = f"the unknown variable '{output}' of instance '{name}'"
            if variable is not None:
                is_element = variable.name != output and variable.name in outputs
                what = f"'{output}', an element of an array" if is_element else f"'{output}', {variable.role}"
            findings.add(path, what, f"one of the outputs {listed([*outputs])}", nearest(output, [*outputs]))
            continue
        try:
            to_value(value, outputs[output], finite=finite)
        except ValueRefused as refused:
            found = f"{shown(value)} for the {outputs[output].type_name} '{output}'"
            findings.add(path, found, refused.expected, refused.suggestion)


def forbidden_start_values(
    config: Config, descriptions: Mapping[str, ModelDescription], findings: Findings, *, strict: bool
) -> None:
    """Add a finding for each start value that FMI forbids. FMUs get these values anyway, because some use them.

    They are those of the instances where they are errors (``strict``), or of those where they are warnings.
    """
    for name, instance in config.instances.items():
        if not instance.follows_fmi or name not in descriptions or config.is_strict(instance) != strict:
            continue
        settable = [variable.name for variable in descriptions[name].variables if variable.settable_before_start]
        for variable_name, value in instance.start_values.items():
            variable = descriptions[name].variable_of(variable_name)
            if variable is None or variable.settable_before_start or not variable.may_take_start_value:
                continue  # it is allowed, or `resolve_start_values` refuses it
            found = f"{shown(value)} for {forbidden(variable, descriptions[name])}"
            expected = f"one of {listed(settable)}; `strict: false` leaves it to the FMU" if strict else ""
            findings.add(f"instances.{name}.start_values.{variable_name}", found, expected)


def forbidden(variable: Variable, description: ModelDescription) -> str:
    """Why a start value of a variable may have no effect, as the end of the sentence `1.0 for ...`."""
    source = _SOURCES[description.fmi_version[0]]
    what = f"'{variable.name}', {variable.role}"
    return f"{what}: {source} does not allow setting it; whether it takes effect is up to the FMU"


def why_not_settable(variable: Variable, source: str | None) -> str | None:
    """Why a variable may not be set between two steps, as the predicate of a sentence about it; None if it may.

    Nobody else decides it: `VariableView.settable` tells tools of a running mesh. ``source`` is the instance that the
    variable is connected to; None if it is not connected.
    """
    match variable.causality:
        case "input" if source is not None:
            return f"is connected to '{source}'; only unconnected inputs can be set"
        case "parameter" if source is not None:
            return f"gets its value from '{source}'; only parameters without a connection can be prescribed"
        case "parameter" | "calculatedParameter" if variable.variability != "tunable":
            return f"is a {variable.variability} parameter; only tunable ones can be set while it runs"
        case "input" | "parameter" | "calculatedParameter":
            return None
        case _:
            return "is no input and no parameter, so it cannot be set"
