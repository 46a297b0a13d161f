"""What a connection makes of a value: factor and offset or a map, and the check whether its input can be the result.

One value at a time, in Python. The burst does the same by tables (`Move` in `native.py`), and calls for this module
where a value does not fit: the error is made here.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final, NamedTuple

import numpy as np

from ..errors import FmuError, StepFailed
from ..system.connections import Connection
from ..system.feeds import FeedColumn
from ..system.initialization_plan import Tear
from ..text import listed
from ..variables.value_types import INTEGERS, Value, VariableType
from .array_elements import scaled

__all__ = ["ValueChange"]

_DECLARED: Final = "Its model declares no such item."
_MAPPED: Final = "A `map` of the connection can give this value another one."


class ValueChange(NamedTuple):
    """What one connection makes of a value.

    An integer may be connected to an Enumeration, and an Enumeration to an integer that can be each of its items; a
    model may put out other numbers.

    Attributes:
        source: the output, as `instance.variable`.
        factor: of the connection; ``offset`` likewise. Only for floating-point inputs.
        mapping: what the input gets instead of a value; other values stay as they are.
        items: the names and numbers that the input can be; empty if it can be each number of its type.
    """

    source: str
    target: str
    variable: str
    input_type: VariableType
    factor: float = 1.0
    offset: float = 0.0
    mapping: Mapping[int, int] = {}
    items: tuple[tuple[str, int], ...] = ()

    @classmethod
    def of_column(cls, source: str, target: str, input_type: VariableType, column: FeedColumn) -> ValueChange:
        """The change of a column of a feed, from the instance ``source`` to ``target``."""
        ends = f"{source}.{column.source}", target, column.target, input_type
        return cls(*ends, column.factor, column.offset, dict(column.map), column.items)

    @classmethod
    def of_connection(cls, c: Connection) -> ValueChange:
        """The change of a connection."""
        ends = f"{c.source_instance}.{c.source_name}", c.target_instance, c.target_name, c.target.type
        return cls(*ends, c.factor, c.offset, dict(c.map), c.items)

    @classmethod
    def of_tear(cls, tear: Tear) -> ValueChange:
        """The change of a connection at which a loop is torn."""
        ends = f"{tear.source}.{tear.output}", tear.target, tear.input, tear.type
        return cls(*ends, tear.factor, tear.offset, dict(tear.map), tear.items)

    def is_checked(self, source: VariableType) -> bool:
        """Whether the input cannot be each number that an output of type ``source`` can be."""
        if self.items:
            return True
        if source not in INTEGERS or self.input_type not in INTEGERS:
            return False
        have, want = INTEGERS[source], INTEGERS[self.input_type]
        return have[0] not in want or have[-1] not in want

    def of(self, value: Value, kind: type[FmuError] = StepFailed) -> Value:
        """What the input gets for ``value``, which may be an array; an error of ``kind`` if it cannot be that.

        Example:
            >>> change = ValueChange("engine.gear", "clutch", "gear", "Int8", mapping={0: -1})
            >>> change.of([0, 1])
            [-1, 1]
            >>> change.of(300)
            Traceback (most recent call last):
            fmu_mesh.errors.StepFailed: instance clutch.gear: 'engine.gear' is 300, which is out of the range of Int8...
        """
        if isinstance(value, np.ndarray):
            value = value.tolist()
        if isinstance(value, list):
            return [self.of(element, kind) for element in value]
        if (self.factor, self.offset) != (1.0, 0.0):
            return scaled(value, self.factor, self.offset)
        if self.input_type == "Boolean":
            return bool(self.mapping.get(int(value), value)) if self.mapping and isinstance(value, int) else value
        if self.input_type not in INTEGERS or not isinstance(value, int):
            return value
        new = self.mapping.get(value, value)
        if self.items and new not in (number for _, number in self.items):
            names = [f"{name} ({number})" for name, number in self.items]
            raise self._refused(value, new, f"no item of its input: {listed(names)}", kind, _MAPPED)
        if new not in INTEGERS[self.input_type]:
            raise self._refused(value, new, f"out of the range of {self.input_type}", kind, _DECLARED)
        return new

    def _refused(self, value: int, new: int, what: str, kind: type[FmuError], hint: str) -> FmuError:
        mapped = "" if new == value else f" and is mapped to {new}"
        text = f"'{self.source}' is {value}{mapped}, which is {what}"
        return kind(text, instance=self.target, variable=self.variable, hint=hint)
