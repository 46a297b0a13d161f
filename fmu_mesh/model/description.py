"""What an instance offers: its variables, capabilities and default experiment.

Owns the description Structs that every layer above speaks of; independent of FMPy and of the FMI version. The readers
in `fmu_mesh.fmu` (and later the hosts) fill them.
"""

from __future__ import annotations

from typing import Literal

import msgspec

__all__ = [
    "Causality",
    "DefaultExperiment",
    "ModelDescription",
    "Value",
    "Variability",
    "Variable",
    "VariableType",
]

Causality = Literal["parameter", "calculatedParameter", "input", "output", "local", "independent"]
Variability = Literal["constant", "fixed", "tunable", "discrete", "continuous"]
Initial = Literal["exact", "approx", "calculated"]
VariableType = Literal["Real", "Integer", "Boolean", "String", "Enumeration"]
Value = float | int | bool | str


class Variable(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One scalar variable of a model description (FMI 2.0, 2.2.7).

    Attributes:
        dependencies: names of the knowns an output depends on in Initialization Mode; None if it may depend on all
            (FMI 2.0, 2.2.8, InitialUnknowns). Empty for a variable that is not an initial unknown.
        items: item names and values of an Enumeration.
    """

    name: str
    value_reference: int
    type: VariableType
    causality: Causality
    variability: Variability
    initial: Initial | None = None
    start: Value | None = None
    unit: str | None = None
    description: str | None = None
    minimum: float | None = None
    maximum: float | None = None
    dependencies: tuple[str, ...] | None = None
    items: tuple[tuple[str, int], ...] = ()

    @property
    def settable_before_start(self) -> bool:
        """Whether a start value may be given (FMI 2.0, 2.2.7: initial is exact or approx, or it is an input)."""
        if self.variability == "constant" or self.causality == "independent":
            return False
        return self.causality == "input" or self.initial in ("exact", "approx")


class DefaultExperiment(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The default experiment of a model description, times in s (FMI 2.0, 2.2.5)."""

    start_time: float | None = None
    stop_time: float | None = None
    step_size: float | None = None
    tolerance: float | None = None


class ModelDescription(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A model description (FMI 2.0, 2.2) as far as the mesh needs it."""

    model_name: str
    model_identifier: str
    fmi_version: str
    kind: Literal["co_simulation", "physics_engine", "controller"]
    guid: str
    variables: tuple[Variable, ...]
    description: str | None = None
    generation_tool: str | None = None
    default_experiment: DefaultExperiment = DefaultExperiment()
    can_handle_variable_step_size: bool = False
    can_get_and_set_state: bool = False
    can_serialize_state: bool = False
    only_once_per_process: bool = False
    needs_execution_tool: bool = False
    platforms: tuple[str, ...] = ()
    problems: tuple[str, ...] = ()

    def variable(self, name: str) -> Variable | None:
        """The variable with this name, or None."""
        return next((variable for variable in self.variables if variable.name == name), None)

    def with_causality(self, *causalities: Causality) -> tuple[Variable, ...]:
        """All variables with one of these causalities, in the order of the model description."""
        return tuple(variable for variable in self.variables if variable.causality in causalities)
