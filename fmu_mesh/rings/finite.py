"""Whether the outputs that a step has written to its row are finite: one rule for all kinds of instances and engines.

The burst checks each row in C before it counts it (`is_finite` in `burst.c`); who steps in Python calls `FiniteRows`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence

from ..errors import FmuError, NotFinite
from ..simtime import TimeGrid
from ..system.plan import InstancePlan
from ..variables.value_types import Value, flattened
from .array_elements import element_of
from .native import NUMBER_TYPES, Span
from .ring import Ring

__all__ = ["FiniteRows"]


class FiniteRows:
    """Checks the output rows of one instance, and says what was not finite.

    Args:
        plan: says which outputs have to be finite.
        outputs: the rows.
        inputs: the row of inputs.
        get: reads variables of the instance.

    Attributes:
        spans: where these outputs are in a row, for the burst.
    """

    def __init__(
        self, plan: InstancePlan, outputs: Ring, inputs: Ring, get: Callable[[Sequence[str]], list[Value]]
    ) -> None:
        self._plan = plan
        self._outputs = outputs
        self._inputs = inputs
        self._get = get
        self.spans: list[Span] = []
        self._runs: list[tuple[memoryview, int, int, int]] = []
        end = -1
        for name in plan.finite:
            place, type_ = outputs.layout.place(name), outputs.layout.column(name).type
            start, size = outputs.place_in_row(place.part, place.first), outputs.parts[place.part].itemsize
            if start == end and self.spans[-1].type == NUMBER_TYPES[type_]:
                self.spans[-1].count += place.size
                self._runs[-1] = (*self._runs[-1][:3], self.spans[-1].count)
            else:
                self.spans.append(Span(start, place.size, NUMBER_TYPES[type_]))
                self._runs.append((outputs.floats(type_), outputs.stride // size, start // size, place.size))
            end = start + place.size * size

    def __call__(self, row: int) -> bool:
        """Whether a row is finite."""
        slot = row & self._outputs.mask
        for memory, stride, first, count in self._runs:
            start = slot * stride + first
            if not all(map(math.isfinite, memory[start : start + count])):
                return False
        return True

    def error(self, row: int, grid: TimeGrid) -> NotFinite:
        """The error for a row that is not finite."""
        plan, point = self._plan, row * self._plan.step_points
        columns = (self._outputs.layout.column(name) for name in plan.finite)
        output, value = next(
            (element, value)
            for column in columns
            for element, value in zip(
                column.elements, flattened(self._outputs.value(row, column.name), len(column.shape)), strict=True
            )
            if not math.isfinite(value)
        )
        error = NotFinite(
            f"output {output} is {_shown(value)}",
            instance=plan.name,
            variable=output,
            hint=f"If {plan.name}.{output} may be so, write `not_finite: record` for '{plan.name}'.",
        )
        self.explain(error, initial=row == 0)
        if "came as" not in error.message:
            error.saying(f"{error.message}; its inputs were finite")
        return error.at(point, grid.time(point))

    def explain(self, error: FmuError, *, initial: bool = False) -> None:
        """Add to a failure of the instance which input was not finite, and its source, if there is one."""
        for name, value, source in self._given(initial=initial):
            wrong = next(
                (v for v in flattened(value, _rank(value)) if isinstance(v, float) and not math.isfinite(v)), 0
            )
            if wrong:
                error.saying(f"{error.message.rstrip('.')}; its input {name} came as {_shown(wrong)} from {source}")
                return

    def _given(self, *, initial: bool) -> Iterator[tuple[str, Value, str]]:
        """Each connected input, its value in the last step or in Initialization Mode, and the output it came from."""
        plan = self._plan
        for feed in (*plan.feeds, *plan.parameters) if initial else plan.feeds:
            for own in feed.columns:
                if initial:
                    column = plan.initial_inputs.column(own.target)
                    value = element_of(self._get([column.name])[0], column, own.target)
                else:
                    value = self._inputs.value(0, own.target)
                yield own.target, value, f"{feed.source}.{own.source}"


def _rank(value: Value) -> int:
    return 1 + _rank(value[0]) if isinstance(value, list) and value else int(isinstance(value, list))


def _shown(value: float) -> str:
    return "NaN" if math.isnan(value) else str(value)
