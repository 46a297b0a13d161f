"""Which row of a source feeds which step of a target (design, section 3).

Row 0 of an instance holds its outputs after Initialization Mode; row n holds them after its own step n - 1. Everything
that moves values over a connection follows this rule: feeds within a node, frames between nodes, and the reference
loop of `--local`.
"""

from __future__ import annotations

from typing import TypeVar

import msgspec
import numpy as np
from numpy.typing import NDArray

__all__ = ["CouplingRule"]

Steps = TypeVar("Steps", int, NDArray[np.intp])


class CouplingRule(msgspec.Struct, frozen=True):
    """The rule for one source and one target.

    Own step j of the target covers the points ``j * target_points`` to ``(j + 1) * target_points``. It reads the source
    at the first of them with a delay of 1, and at the last of them with a delay of 0. A source whose step takes several
    points holds its value between two of them.

    Example:
        >>> rule = CouplingRule(delay=1, source_points=2, target_points=1)
        >>> [rule.row_for(step) for step in range(5)]
        [0, 0, 1, 1, 2]

    Attributes:
        delay: delay of the connection in points: 0 or 1.
        source_points: base points per step of the source; 1 or more.
        target_points: base points per step of the target; 1 or more.
    """

    delay: int
    source_points: int
    target_points: int

    @property
    def lead(self) -> int:
        """Number of points from the start of the target's step to the point whose value it reads."""
        return 0 if self.delay else self.target_points

    def row_for(self, step: Steps) -> Steps:
        """The row of the source that feeds own step ``step`` of the target; also for an array of steps."""
        return (step * self.target_points + self.lead) // self.source_points
