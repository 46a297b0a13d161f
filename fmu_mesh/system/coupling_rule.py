"""What a step gets from its sources: which row, what of it over the step, and outputs that are consistent.

The ways of `extrapolation`, for the last value ``v`` of a source and its change ``c`` since the value before:

* hold: the input is ``v`` over the whole step, so the coupling is of order 1.
* linear: it follows the line through both values, by the derivative that the FMU takes (`LinearInputs`).
* midpoint: it is constant, with the value of that line in the middle of the step, so the coupling is of order 2
  (`MidpointInputs`). After a jump of the source it is ``v``.

With a delay of 0, the line of a source with a larger step goes through both ends of that step, if the source can go
ahead of the target (`fmu_mesh.system.execution_order`). Else it goes on from the step before.

An output ``y`` that depends directly on an input ``u`` belongs to the input that its last step used, which is a step
old: FMI does not let a co-simulation evaluate it again. With `loops: solved` whoever reads it gets
``y + D (u* - u)`` instead, with the derivative ``D``, the input ``u`` that was used, and the consistent input ``u*``,
which follows from all outputs in the same way (Kuebler and Schiehlen 2000; Arnold and Guenther 2001). As ``D`` is
constant, that is a sum over values of the rows of one point: `Consistent`. So every process calculates it alone.

Row 0 of an instance holds its outputs after Initialization Mode; row n holds them after its own step n - 1. Everything
that moves values over a connection follows this rule: feeds within a node, frames between nodes, and the reference
loop of `--local`.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from ..simtime import ENDLESS

__all__ = ["Consistent", "CouplingRule", "SourceLine", "Term", "jumps_in"]

_JUMP: Final = 4.0
_PART: Final = 0.1
"""A source jumps if its rate of change differs from the one before by more than `_JUMP` times that one, and if it
changes by more than this part of its value. At a turning point, and at the start from rest, a smooth source does the
former."""


class CouplingRule(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The rule for one source and one target.

    Own step j of the target covers the points ``j * target_points`` to ``(j + 1) * target_points``. It reads the source
    at the first of them with a delay of 1, and at the last of them with a delay of 0. A source whose step takes several
    points holds its value between two of them; if it goes ahead, the target reads the end of its step instead (ADR 96).

    Example:
        >>> [CouplingRule(delay=1, source_points=2, target_points=1).row_for(step) for step in range(5)]
        [0, 0, 1, 1, 2]
        >>> [CouplingRule(delay=0, source_points=2, target_points=1, ahead=True).row_for(step) for step in range(5)]
        [1, 1, 2, 2, 3]

    Attributes:
        delay: delay of the connection in points: 0 or 1.
        source_points: base points per step of the source; 1 or more.
        target_points: base points per step of the target; 1 or more.
        ahead: whether the target reads the first row at the end of its step or later; only with a delay of 0.
        last: the last row of the source: its next one would come after the end of the run.
    """

    delay: int
    source_points: int
    target_points: int
    ahead: bool = False
    last: int = ENDLESS

    @property
    def lead(self) -> int:
        """Points from the start of the target's step to that whose value it reads, or after which there is no other."""
        return 0 if self.delay else self.target_points + (self.source_points - 1 if self.ahead else 0)

    def row_for(self, step: int) -> int:
        """The row of the source that feeds own step ``step`` of the target."""
        return min((step * self.target_points + self.lead) // self.source_points, self.last)


class SourceLine(msgspec.Struct, frozen=True):
    """The line through the last two rows of a source, which belong to two points. `burst.c` has it, too."""

    value: float  # the last value
    point: int = 0  # the point of the last value
    change: float = 0.0  # the last value minus the one before; 0 as long as there is only one
    distance: int = 1  # points between the two
    jumped: bool = False  # whether it is no line, because the source has jumped

    def through(self, value: float, point: int) -> SourceLine:
        """The line with the value of this point, which may be the last one again."""
        if point == self.point:
            return SourceLine(value, point, self.change, self.distance, self.jumped)
        change, distance, before = value - self.value, point - self.point, self.change / self.distance
        is_sudden = self.point > 0 and abs(change / distance - before) > _JUMP * abs(before)
        jumped = is_sudden and abs(change) > _PART * max(abs(value), abs(self.value))
        return SourceLine(value, point, change, distance, jumped)

    def at(self, point: float) -> float:
        """The value at a point, or between two."""
        return self.value + self.change * ((point - self.point) / self.distance)

    def middle(self, begin: int, points: int) -> float:
        """The value in the middle of a step of so many points."""
        return self.value if self.jumped else self.at(begin + 0.5 * points)


def jumps_in(
    values: NDArray[np.float64], change: NDArray[np.float64], distance: NDArray[np.float64]
) -> NDArray[np.intp]:
    """The places of the values at which `SourceLine` says that the source has jumped; the first two never have.

    ``change[n]`` is that from value n to the next one, and ``distance[n]`` the number of points between them.
    """
    limits, sizes = np.abs(values), np.abs(change)
    limits *= _PART
    large = np.flatnonzero(sizes > limits[1:])  # few are, and of few the rest is calculated
    large = large[(sizes[large] > limits[large]) & (large > 0)]
    before = change[large - 1] / distance[large - 1]
    is_sudden = np.abs(change[large] / distance[large] - before) > _JUMP * np.abs(before)
    return large[is_sudden] + 1


class Term(NamedTuple):
    """A column of the row of an instance, and what it is multiplied by."""

    instance: str
    column: str
    factor: float


class Consistent(NamedTuple):
    """A consistent output: the constant and all terms, added in this order. All values belong to one point.

    In every way of running, the first product and the constant are added first: ``factor * value + constant``.
    """

    constant: float
    terms: tuple[Term, ...]

    def scaled(self, factor: float, offset: float) -> Consistent:
        """What an input gets by a connection with this factor and this offset."""
        terms = tuple(term._replace(factor=factor * term.factor) for term in self.terms)
        return Consistent(factor * self.constant + offset, terms)
