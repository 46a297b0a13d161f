"""Whether the outputs that a step has written to its row are finite: one rule for all kinds of instances and engines.

The burst checks each row in C before it counts it (`is_finite` in `burst.c`); who steps in Python calls `FiniteRows`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence

import numpy as np

from ..errors import FmuError, FmuMeshError, NotFinite
from ..simtime import TimeGrid
from ..system.plan import InstancePlan
from ..variables.value_types import Value, VariableType
from .array_elements import element_of
from .native import NUMBER_TYPES, Span
from .ring import Ring

__all__ = ["FiniteRows"]

Get = Callable[[Sequence[str]], list[Value]]

_MANY = 32
"""From so many numbers on, a call of numpy takes less time than Python takes for them."""


class FiniteRows:
    """Checks the output rows of one instance, and says what was not finite; ``spans`` are for the burst."""

    def __init__(self, plan: InstancePlan, outputs: Ring, inputs: Ring) -> None:
        self._plan = plan
        self._outputs = outputs
        self._inputs = inputs
        runs: list[tuple[VariableType, int, int, int]] = []  # type, place in bytes, size in bytes, count
        for name in plan.finite:
            place, type_ = outputs.layout.place(name), outputs.layout.column(name).type
            start, count = outputs.place_in_row(place.part, place.first), place.size
            size = 8 if type_ == "Float64" else 4
            if runs and runs[-1][0] == type_ and runs[-1][1] + size * runs[-1][3] == start:
                _, start, _, before = runs.pop()
                count += before
            runs.append((type_, start, size, count))
        self.spans = [Span(start, count, NUMBER_TYPES[type_]) for type_, start, _, count in runs]
        self.check = _check(outputs, runs)

    def check_first(self, row: int, grid: TimeGrid, get: Get) -> None:
        """Check the row of the first point; ``get`` reads the inputs.

        Raises:
            NotFinite: it is not finite.
        """
        if not self.check(row):
            error = self.error(row, grid)
            self.explain(error, get)
            raise error

    def error(self, row: int, grid: TimeGrid) -> NotFinite:
        """The error for a row that is not finite; `explain` adds the cause."""
        plan, outputs, point = self._plan, self._outputs, row * self._plan.step_points
        output, value = next(
            (element, value)
            for column in map(outputs.layout.column, plan.finite)
            for element, value in zip(column.elements, _elements(outputs.value(row, column.name)), strict=True)
            if not math.isfinite(value)
        )
        hint = f"If {plan.name}.{output} may be so, write `not_finite: record` for '{plan.name}'."
        text = f"output {output} is {_shown(value)}"
        return NotFinite(text, instance=plan.name, variable=output, point=point, time=grid.time(point), hint=hint)

    def explain(self, error: FmuMeshError, get: Get | None = None) -> None:
        """Add to a failure of the instance the first input that was not finite, and its source.

        ``get`` reads the inputs after Initialization Mode; without it, they are those of the last step.
        """
        if not isinstance(error, FmuError):
            return
        for name, value, source in self._given(get):
            if wrong := [element for element in _elements(value) if not math.isfinite(element)]:
                text = error.message.rstrip(".")
                error.saying(f"{text}; its input {name} came as {_shown(wrong[0])} from {source}")
                return
        if isinstance(error, NotFinite):
            error.saying(f"{error.message}; its inputs were finite")

    def _given(self, get: Get | None) -> Iterator[tuple[str, Value, str]]:
        """Each connected input, its value, and the output that it came from."""
        plan = self._plan
        for feed in (*plan.feeds, *plan.parameters) if get is not None else plan.feeds:
            for own in feed.columns:
                if get is not None:
                    column = plan.initial_inputs.column(own.target)
                    value = element_of(get([column.name])[0], column, own.target)
                else:
                    value = self._inputs.value(0, own.target)
                yield own.target, value, f"{feed.source}.{own.source}"


def _check(ring: Ring, runs: Sequence[tuple[VariableType, int, int, int]]) -> Callable[[int], bool]:
    """A function that says whether a row is finite: as fast as Python is, because it is called after each step."""

    def of_run(type_: VariableType, place: int, size: int, count: int) -> Callable[[int], bool]:
        memory, mask, isfinite = ring.floats(type_), ring.mask, math.isfinite
        stride, first = ring.stride // size, place // size

        def check(row: int) -> bool:
            start = (row & mask) * stride + first
            return isfinite(memory[start]) if count == 1 else all(map(isfinite, memory[start : start + count]))

        numbers = np.asarray(memory)

        def check_many(row: int) -> bool:
            start = (row & mask) * stride + first
            many = numbers[start : start + count]
            with np.errstate(all="ignore"):  # where the sum of their squares is finite, so is each of them
                return isfinite(many.dot(many)) or bool(np.isfinite(many).all())

        return check if count < _MANY else check_many

    checks = [of_run(*run) for run in runs]
    return checks[0] if len(checks) == 1 else lambda row: all(check(row) for check in checks)


def _elements(value: Value) -> Iterator[float]:
    """The numbers of a scalar or an array; none of text."""
    if isinstance(value, list):
        for row in value:
            yield from _elements(row)
    elif isinstance(value, float | int):
        yield value


def _shown(value: float) -> str:
    return "NaN" if math.isnan(value) else str(value)
