"""Moving values from a row of a source into the row of inputs of a target, with factor and offset of a connection.

Which row a step reads is `fmu_mesh.system.coupling_rule`. The burst moves numbers by tables (`moves`); the same moves
in Python are `step`, which is also the only way for text.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..errors import FmuError, StepFailed
from ..system.coupling_rule import CouplingRule
from ..system.plan import Feed
from ..variables.value_types import INTEGERS, Value, VariableType, is_text
from .native import NUMBER_TYPES, Move, RowBase
from .ring import Ring

__all__ = ["Narrowing", "Transfer"]

Index = slice | NDArray[np.intp]


class Narrowing(NamedTuple):
    """The two ends of a connection whose input may be unable to take a number of its output.

    An Enumeration may be connected to an integer that can be each of its items; a model may put out other numbers.

    Attributes:
        source: the output, as `instance.variable`.
        target: the instance of the input.
        variable: the input.
        input_type: its type.
    """

    source: str
    target: str
    variable: str
    input_type: VariableType

    @staticmethod
    def is_between(source: VariableType, target: VariableType) -> bool:
        """Whether an input of type ``target`` cannot be each number that an output of type ``source`` can be."""
        if source not in INTEGERS or target not in INTEGERS:
            return False
        have, want = INTEGERS[source], INTEGERS[target]
        return have[0] not in want or have[-1] not in want

    def checked(self, value: Value, kind: type[FmuError] = StepFailed) -> Value:
        """``value``, which may be an array; an error of ``kind`` if the input cannot be this number.

        Example:
            >>> Narrowing("engine.gear", "clutch", "gear", "Int8").checked([1, 300])
            Traceback (most recent call last):
            fmu_mesh.errors.StepFailed: instance clutch.gear: 'engine.gear' is 300, which is out of the range of Int8...
        """
        if isinstance(value, list):
            return [self.checked(element, kind) for element in value]
        if self.input_type in INTEGERS and value not in INTEGERS[self.input_type]:
            raise kind(
                f"'{self.source}' is {value!r}, which is out of the range of {self.input_type}",
                instance=self.target,
                variable=self.variable,
                hint="Its model declares no such item.",
            )
        return value


class Transfer:
    """The columns of one feed.

    Args:
        feed: the source, the delay and the columns.
        source: the ring of the source.
        inputs: the row of inputs of the target.
        target: the name of the target.
        source_points: base points per step of the source.
        target_points: base points per step of the target.
        text: True takes the columns with text only, False those with numbers; None takes all.

    Attributes:
        rule: which row of the source a step needs.
        columns: the columns that are moved.
    """

    def __init__(  # noqa: PLR0913  the two ends of a connection
        self,
        feed: Feed,
        source: Ring,
        inputs: Ring,
        *,
        target: str,
        source_points: int,
        target_points: int,
        text: bool | None = None,
    ) -> None:
        self.feed = feed
        self.source = source
        self.rule = CouplingRule(feed.delay, source_points, target_points)
        self.columns = [
            column for column in feed.columns if text is None or is_text(inputs.layout.column(column[1]).type) == text
        ]
        self._inputs = inputs
        self._copies = _copies(self.columns, source, inputs)
        self._narrowings = [
            (have, Narrowing(f"{feed.source}.{have}", target, want, inputs.layout.column(want).type))
            for have, want, _, _ in self.columns
            if Narrowing.is_between(source.layout.column(have).type, inputs.layout.column(want).type)
        ]

    def step(self, step: int) -> None:
        """Move the values for own step ``step`` of the target.

        Raises:
            StepFailed: see `check_range`.
        """
        if self._narrowings:
            self.check_range(step)
        slot = self.rule.row_for(step) & self.source.mask
        for copy in self._copies:
            copy.part[0, copy.columns] = copy.convert(self.source.parts[copy.source_part][slot][copy.source_columns])

    def check_range(self, step: int) -> None:
        """Check the values for own step ``step``: the burst ends where one does not fit, and does not say which one.

        Raises:
            StepFailed: an input cannot be the number that its output is.
        """
        row = self.rule.row_for(step)
        for source_name, narrowing in self._narrowings:
            narrowing.checked(self.source.value(row, source_name))

    def step_text(self, step: int) -> None:
        """As `step`, for the columns with text."""
        slot = self.rule.row_for(step) & self.source.mask
        for copy in self._copies:
            if copy.part.dtype == np.object_:
                copy.part[0, copy.columns] = self.source.parts[copy.source_part][slot][copy.source_columns]

    @property
    def has_text(self) -> bool:
        """Whether there is a column with text."""
        return any(copy.part.dtype == np.object_ for copy in self._copies)

    def moves(self, base: int) -> list[Move]:
        """The moves of the numbers, from the row ``base`` of the burst."""
        moves = []
        for source_name, target_name, factor, offset in self.columns:
            have, want = self.source.layout.place(source_name), self._inputs.layout.place(target_name)
            from_type = self.source.layout.parts[have.part].type
            to_type = self._inputs.layout.parts[want.part].type
            if is_text(from_type):
                continue
            moves.append(
                Move(
                    from_base=base,
                    from_=self.source.place_in_row(have.part, have.first),
                    to_base=RowBase.FIXED,
                    to=self._inputs.address + self._inputs.place_in_row(want.part, want.first),
                    count=want.size,
                    from_type=NUMBER_TYPES[from_type],
                    to_type=NUMBER_TYPES[to_type],
                    scaled=(factor, offset) != (1.0, 0.0),
                    factor=factor,
                    offset=offset,
                )
            )
        return moves


class _Copy:
    """Columns of one part of the source rows for columns of one part of the row of inputs."""

    def __init__(
        self, source_part: int, source_columns: Index, part: NDArray[Any], columns: Index, scale: tuple[Any, Any] | None
    ) -> None:
        self.source_part = source_part
        self.source_columns = source_columns
        self.part = part
        self.columns = columns
        self.scale = scale

    def convert(self, values: NDArray[Any]) -> NDArray[Any]:
        """``values * factor + offset`` in Float64, with one rounding each; for a Float32 the result is rounded again.

        The assignment that follows converts between types; `check` refuses connections that would lose something.
        """
        if self.scale is None:
            return values
        factor, offset = self.scale
        scaled: NDArray[Any] = values * factor + offset
        if self.part.dtype == np.float32:
            with np.errstate(over="ignore"):
                return scaled.astype(np.float32)
        return scaled


def _copies(columns: Sequence[tuple[str, str, float, float]], source: Ring, inputs: Ring) -> list[_Copy]:
    """Group the columns by part of source and target, and by whether they are scaled.

    An unscaled column is not multiplied by 1.0, so it keeps every bit, also of a NaN.
    """
    groups: dict[tuple[int, int, bool], list[tuple[int, int, float, float]]] = {}
    for source_name, target_name, factor, offset in columns:
        have, want = source.layout.place(source_name), inputs.layout.place(target_name)
        scaled = (factor, offset) != (1.0, 0.0)
        group = groups.setdefault((have.part, want.part, scaled), [])
        group += [(have.first + place, want.first + place, factor, offset) for place in range(want.size)]
    copies = []
    for (source_part, target_part, scaled), items in groups.items():
        scale = (np.array([c[2] for c in items]), np.array([c[3] for c in items])) if scaled else None
        sources, targets = _index([c[0] for c in items]), _index([c[1] for c in items])
        copies.append(_Copy(source_part, sources, inputs.parts[target_part], targets, scale))
    return copies


def _index(columns: Sequence[int]) -> Index:
    """A slice if the columns are consecutive, because numpy copies it faster; otherwise an index array."""
    if list(columns) == list(range(columns[0], columns[0] + len(columns))):
        return slice(columns[0], columns[0] + len(columns))
    return np.array(columns, dtype=np.intp)
