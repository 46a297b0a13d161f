"""The model description of an instance: its variables, capabilities and default experiment.

Owns the description Structs that every layer above speaks of; independent of FMPy and of the FMI version. The readers
in `fmu_mesh.instances.fmi` (and later the hosts) fill them.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import cached_property
from typing import Literal

import msgspec
from msgspec.structs import replace

from ..simtime import steps_between
from ..text import counted
from .units import BaseUnit
from .value_types import MAX_ELEMENTS, PlainValue, Value, VariableType, element_names, flattened, nested, split_element

__all__ = [
    "Causality",
    "Clock",
    "DefaultExperiment",
    "Kind",
    "ModelDescription",
    "PlainValue",
    "Runs",
    "Value",
    "Variability",
    "Variable",
    "VariableType",
    "runs_of",
]

Causality = Literal[
    "parameter", "calculatedParameter", "structuralParameter", "input", "output", "local", "independent"
]
Variability = Literal["constant", "fixed", "tunable", "discrete", "continuous"]
Initial = Literal["exact", "approx", "calculated"]
Kind = Literal["co_simulation", "model_exchange"]
Runs = Literal["native", "wine", "wasm"]
"""What runs the library of an FMU: the process itself, Wine, or wasmtime, whose library is a component."""


def runs_of(library: str | None) -> Runs:
    """What runs a library of an FMU, by its name."""
    suffix = library.rpartition(".")[2] if library is not None else ""
    return "wine" if suffix == "dll" else "wasm" if suffix == "wasm" else "native"


class Variable(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One variable of a model description (FMI 2.0, 2.2.7; FMI 3.0, 2.4.7).

    Attributes:
        type: the type, in the words of FMI 3.0 for all versions.
        declared_type: the type in the words of FMI 1.0 and 2.0, such as Real; None for FMI 3.0.
        dimensions: of each dimension its size, or the name of the structural parameter that is its size; empty for a
            scalar (FMI 3.0, 2.4.7.5.1).
        shape: the sizes of all dimensions.
        negated: whether it is an FMI 1.0 alias with the opposite sign of the value behind its value reference.
        max_size: most bytes of a Binary, if known.
        dependencies: names of the knowns an output depends on in Initialization Mode; None if it may depend on all
            (FMI 2.0, 2.2.8, InitialUnknowns). Empty for a variable that is not an initial unknown.
        feedthrough: names of the knowns that its value at a point directly depends on at this point (FMI 2.0, 2.2.8,
            Outputs; FMI 3.0, 2.4.8); None if nothing is declared.
        items: item names and values of an Enumeration.
        base_unit: its unit in SI base units, if the model description defines it.
        relative_quantity: whether it is a difference, to which the offset of a unit does not apply.
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
    feedthrough: tuple[str, ...] | None = None
    items: tuple[tuple[str, int], ...] = ()
    base_unit: BaseUnit | None = None
    relative_quantity: bool = False
    declared_type: str | None = None
    dimensions: tuple[int | str, ...] = ()
    shape: tuple[int, ...] = ()
    negated: bool = False
    max_size: int | None = None
    nominal: float | None = None

    @property
    def type_name(self) -> str:
        """The type in the words of its FMU, with the sizes of its dimensions: `Real`, `Float64[2,3]`."""
        name = self.declared_type or self.type
        return f"{name}[{','.join(map(str, self.shape))}]" if self.shape else name

    @property
    def size(self) -> int:
        """Number of elements; 1 for a scalar."""
        return math.prod(self.shape)

    @property
    def elements(self) -> tuple[str, ...]:
        """The names of its elements, such as `y[1,2]`; for a scalar its own name."""
        return element_names(self.name, self.shape)

    @property
    def settable_before_start(self) -> bool:
        """Whether a start value may be given (FMI 2.0, 2.2.7: initial is exact or approx, or it is an input)."""
        if not self.may_take_start_value:
            return False
        return self.causality in ("input", "structuralParameter") or self.initial in ("exact", "approx")

    @property
    def may_take_start_value(self) -> bool:
        """Whether an FMU may be given a start value; some accept one where the standard forbids it."""
        return self.variability != "constant" and self.causality != "independent"

    @property
    def changes(self) -> bool:
        """Whether it may have another value at every point (FMI 2.0, 2.2.7: it is discrete or continuous)."""
        return self.variability in ("discrete", "continuous")

    @property
    def role(self) -> str:
        """Causality and initial for a message about setting it: `an output with initial 'calculated'`."""
        if self.variability == "constant":
            return "a constant"
        article = "an" if self.causality[0] in "aeiou" else "a"
        initial = f" with initial '{self.initial}'" if self.initial is not None else ""
        return f"{article} {self.causality}{initial}"


class DefaultExperiment(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The default experiment of a model description, times in s (FMI 2.0, 2.2.5)."""

    start_time: float | None = None
    stop_time: float | None = None
    step_size: float | None = None
    tolerance: float | None = None


class Clock(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One clock of an FMI 3.0 model description (FMI 3.0, 2.2.8).

    Attributes:
        interval_variability: constant, fixed, tunable, changing, countdown or triggered.
        interval: in s; None where parameters or the FMU decide.
        shift: time of the first tick after the start, in s.
    """

    name: str
    value_reference: int
    causality: Causality
    interval_variability: str
    interval: float | None = None
    shift: float = 0.0

    @property
    def refusal(self) -> str:
        """What is said wherever its name stands for a variable."""
        return f"'{self.name}' is a clock, and clocks cannot be connected yet, nor set or recorded"

    @property
    def never_ticks(self) -> bool:
        """Whether only a connection could make it tick (FMI 3.0, 2.2.8.1), and clocks are not connected."""
        return self.causality == "input" and self.interval_variability == "triggered"

    def __str__(self) -> str:
        """The clock for a person: `tick (input, constant, every 0.4 s from 0.2 s on)`."""
        every = f", every {self.interval:g} s from {self.shift:g} s on" if self.interval is not None else ""
        return f"{self.name} ({self.causality}, {self.interval_variability}{every})"


class ModelDescription(msgspec.Struct, frozen=True, forbid_unknown_fields=True, dict=True):
    """The part of a model description (FMI 2.0, 2.2) that the mesh needs.

    Attributes:
        kind: a `Kind` of FMU, or in one word what the model is: physics_engine, controller, ...
        library: the file of the FMU that is loaded on this platform; None if it is compiled, or nothing is loaded.
        guest_memory: the memory in bytes of the sandbox of WebAssembly that it runs in; None: it runs in none.
        fixed_step_size: that of its solver in s, if it has a fixed one (FMI 3.0, 4.3.1, fixedInternalStepSize). An FMU
            may take other steps, with a warning; for what is no FMU they are refused.
        not_repeatable: why two runs may differ, for a warning of `check`; None: they do not.
        states: the names of its continuous states, if it declares their derivatives (FMI 2.0, 2.2.8; FMI 3.0, 2.4.8).
    """

    model_name: str
    model_identifier: str
    fmi_version: str
    kind: str
    guid: str
    variables: tuple[Variable, ...]
    description: str | None = None
    generation_tool: str | None = None
    default_experiment: DefaultExperiment = DefaultExperiment()
    can_handle_variable_step_size: bool = False
    can_reject_steps: bool = False
    can_get_and_set_state: bool = False
    can_serialize_state: bool = False
    only_once_per_process: bool = False
    needs_execution_tool: bool = False
    can_interpolate_inputs: bool = False
    has_event_mode: bool = False
    tell_completed_steps: bool = False
    continuous_states: int = 0
    event_indicators: int = 0
    clocks: tuple[Clock, ...] = ()
    platforms: tuple[str, ...] = ()
    kinds: tuple[Kind, ...] = ()
    problems: tuple[str, ...] = ()
    library: str | None = None
    guest_memory: int | None = None
    fixed_step_size: float | None = None
    not_repeatable: str | None = None
    states: tuple[str, ...] = ()

    def __repr__(self) -> str:
        version = f"FMI {self.fmi_version}" if self.fmi_version else self.kind
        return f"<ModelDescription of {self.model_name}: {version}, {counted(len(self.variables), 'variable')}>"

    @property
    def runs(self) -> Runs:
        """What runs it on this system: its library says it, such as `wine` for one that is only for Windows."""
        return runs_of(self.library)

    @property
    def step_size(self) -> float | None:
        """The communication step size in s that the model suggests; None if it suggests none."""
        return self.default_experiment.step_size or self.fixed_step_size

    def doubt_about_step(self, step_size: float) -> str | None:
        """Why steps of this size (s) may give wrong values, as `steps of 0.015 s, ...`; None if there is no doubt.

        A model-exchange FMU has no steps of its own.
        """
        suggested = self.step_size
        if self.kind != "co_simulation" or suggested is None:
            return None
        if self.fixed_step_size is not None:
            fits = bool(steps_between(0.0, step_size, self.fixed_step_size))
            why = f"no whole multiple of the {self.fixed_step_size:.12g} s (fixedInternalStepSize)"
        else:
            fits = self.can_handle_variable_step_size or steps_between(0.0, step_size, suggested) == 1
            why = f"not the {suggested:.12g} s (stepSize, without canHandleVariableCommunicationStepSize)"
        return None if fits else f"steps of {step_size:.12g} s, {why} that the FMU is made for"

    def clock(self, name: str) -> str | None:
        """The refusal of the clock with this name; None if there is none."""
        return next((clock.refusal for clock in self.clocks if clock.name == name), None)

    def variable(self, name: str) -> Variable | None:
        """The variable with this name, or None."""
        return self._by_name.get(name)

    @cached_property
    def _by_name(self) -> dict[str, Variable]:
        return {variable.name: variable for variable in self.variables}

    def variable_of(self, name: str) -> Variable | None:
        """The variable with this name, or whose element has this name, such as `y[1,2]`; None if there is none."""
        found = self.variable(name)
        if found is None and (parts := split_element(name)) is not None:
            found = self.variable(parts[0])
        return found

    def with_causality(self, *causalities: Causality) -> tuple[Variable, ...]:
        """All variables with one of these causalities, in the order of the model description."""
        return tuple(variable for variable in self.variables if variable.causality in causalities)

    def sized(self, start_values: Mapping[str, Value]) -> ModelDescription:
        """A copy with the shapes of arrays for these values of structural parameters (FMI 3.0, 2.2.8)."""
        if not any(isinstance(size, str) for variable in self.variables for size in variable.dimensions):
            return self
        sizes = {v.name: v.start for v in self.variables if v.causality in ("structuralParameter", "parameter")}
        sizes.update({name: value for name, value in start_values.items() if name in sizes})

        def size_of(dimension: int | str) -> int:
            value = dimension if isinstance(dimension, int) else sizes.get(dimension)
            return value if isinstance(value, int) and value > 0 else 1

        return replace(self, variables=tuple(_reshaped(v, tuple(map(size_of, v.dimensions))) for v in self.variables))


def _reshaped(variable: Variable, shape: tuple[int, ...]) -> Variable:
    """A variable with another shape; a start value that is equal for all elements is kept."""
    if shape == variable.shape:
        return variable
    elements = [] if variable.start is None else flattened(variable.start, len(variable.shape))
    is_one = bool(elements) and elements == elements[:1] * len(elements) and math.prod(shape) <= MAX_ELEMENTS
    start = nested(elements[:1] * math.prod(shape), shape) if is_one else None
    return replace(variable, shape=shape, start=start)
