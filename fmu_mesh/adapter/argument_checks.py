"""Checks names, values and times of the caller before they are given to the FMU.

Owns the texts of `CallRefused` about arguments. Knows nothing of modes and steps.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping

import numpy as np

from ..errors import CallRefused
from ..text import did_you_mean, listed
from ..variables.model_description import Causality, ModelDescription, Value, Variable
from ..variables.value_conversion import ValueRefused, to_value
from .times import Instant, RosStamp, RosTime, Time, instant_of

__all__ = ["Arguments"]

log = logging.getLogger(__name__)


class Arguments:
    """The variables of one FMU by their use; a wrong argument raises `CallRefused`."""

    def __init__(self, instance: str, description: ModelDescription) -> None:
        self.instance = instance
        self._description = description
        self.all: dict[str, Variable] = {variable.name: variable for variable in description.variables}
        self.inputs: dict[str, Variable] = self._having("input")
        self.outputs: dict[str, Variable] = self._having("output")
        self.parameters: dict[str, Variable] = self._having("parameter")
        self._tunable = {v.name: v for v in self.parameters.values() if v.variability == "tunable"}
        self._settable = {v.name: v for v in description.variables if v.settable_before_start}

    def tunable(self, name: str) -> Variable:
        """The tunable parameter called ``name``."""
        return self.find(name, self._tunable, "a tunable parameter")

    def settable(self, name: str) -> Variable:
        """The variable called ``name``, which can be set before the start."""
        known = self.all.get(name)
        if known is not None and known.may_take_start_value:
            return known  # FMI forbids some of these, but some FMUs accept them
        return self.find(name, self._settable, "settable before the start")

    def value(self, variable: Variable, value: Value) -> Value:
        """``value`` as a value of the variable's type and within its range."""
        try:
            return to_value(value, variable)
        except ValueRefused as refused:
            if refused.out_of_range:
                low, high = variable.minimum, variable.maximum
                text = f"{value!r} is out of its range, {low} to {high}."
            else:
                kind = f"a value of type {variable.type_name}"
                text = f"{value!r} cannot be its value; expected {kind}: {refused.expected}."
            raise self.refusal(text, variable=variable.name) from refused

    def time(self, value: Time) -> Instant:
        """``value`` as a time in its exact form."""
        return instant_of(value) if isinstance(value, RosTime | RosStamp) else self.seconds(value, "time")

    def seconds(self, value: float | RosTime, what: str) -> float:
        """``value`` as a finite number; ``what`` is its name for messages."""
        number = value.nanoseconds / 1e9 if isinstance(value, RosTime) else _plain(value)
        if isinstance(number, bool) or not isinstance(number, int | float) or not math.isfinite(number):
            raise self.refusal(f"the {what} is {value!r}; expected a finite number of seconds.")
        return float(number)

    def step_size(self, value: float | RosTime | None) -> float:
        """``value``, or else the FMU's own step size, as a number of seconds above 0; a doubtful one is logged."""
        if value is None:
            value = self._description.step_size
            if value is None:
                raise self.refusal("the FMU has no default step size.", "Give one: FMIAdapter(path, step_size).")
        number = self._above_zero(value)
        if (doubt := self._description.doubt_about_step(number)) is not None:
            log.warning("step_size instance=%s: %s", self.instance, doubt)
        return number

    def _above_zero(self, value: float | RosTime) -> float:
        number = self.seconds(value, "step size")
        if number <= 0.0:
            raise self.refusal(f"the step size is {value!r} s; expected one above 0.")
        return number

    def other_step_size(self, value: float | RosTime, default: float) -> float:
        """``value`` as the size of one step; ``default`` is the usual step size in s."""
        number = self._above_zero(value)
        if number != default and not self._description.can_handle_variable_step_size:
            raise self.refusal(
                f"a step of {value!r} s is not one of {default!r} s, and this FMU takes steps of one size only.",
                "Give the step size to the constructor.",
            )
        return number

    def refusal(self, message: str, hint: str | None = None, variable: str | None = None) -> CallRefused:
        """A `CallRefused` that names this instance."""
        return CallRefused(message, instance=self.instance, variable=variable, hint=hint)

    def _having(self, causality: Causality) -> dict[str, Variable]:
        return {variable.name: variable for variable in self._description.with_causality(causality)}

    def find(self, name: str, allowed: Mapping[str, Variable], role: str) -> Variable:
        """The variable called ``name`` among those of a role, which an error names."""
        if name in allowed:
            return allowed[name]
        expected = f"Possible here: {listed(tuple(allowed))}."
        known = self.all.get(name)
        if known is not None:
            kind = f"{known.variability} {known.causality}"
            raise self.refusal(f"this {kind} is not {role}.", expected, name)
        if (clock := self._description.clock(str(name))) is not None:
            raise self.refusal(f"{clock}.")
        raise self.refusal(f"there is no variable '{name}'.", did_you_mean(str(name), allowed, expected))


def _plain(value: object) -> object:
    """The Python value of a numpy scalar, which robot programs often use."""
    return value.item() if isinstance(value, np.generic) else value
