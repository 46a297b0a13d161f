"""Tells where recorded values grow without a limit, before they become infinite: one warning for a run.

Looks at the blocks of rows that are written, so it costs a step nothing. Knows no file.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from ..simtime import ENDLESS
from ..system.plan import Plan
from ..variables.value_types import is_float

__all__ = ["GrowthWatch", "ReadColumn"]

ReadColumn = Callable[[int, int], NDArray[Any]]
"""Returns the values of a variable at the points first to end - 1."""

_STEPS: Final = (1.0, 1e3, 1e6)
"""In scales: where a value begins to grow, from where on its rate is told, and where this is worth a warning."""

_FIRST_PART: Final = 0.05
_FIRST_POINTS: Final = 1000
"""The points that show the scale of a value: a part of the run, or this many where it has no end."""

_BLOCK_NUMBERS: Final = 1 << 18


class GrowthWatch:
    """Watches the recorded floats of a run.

    Args:
        plan: the plan of the run.

    Attributes:
        warnings: at most one.

    Call sequence: `begin`, then `look` for consecutive points; `begin_again` before those of another run of the plan.
    """

    def __init__(self, plan: Plan) -> None:
        self.warnings: tuple[str, ...] = ()
        self._plan = plan
        self._columns: list[tuple[str, str, ReadColumn]] = []
        self._given, self._harmless = np.zeros(0), 0.0
        self._crossings: dict[int, list[tuple[int, float]]] = {}  # points and values above each of the steps so far
        last = plan.grid.last_point
        self._normal = _FIRST_POINTS if last >= ENDLESS else max(1, math.ceil(_FIRST_PART * (last + 1)))

    def begin(self, columns: Mapping[tuple[str, str], ReadColumn]) -> None:
        """Choose what is watched; ``columns`` says how the values of each recorded variable are read."""
        scales = []
        for (instance, name), read in columns.items():
            variable = self._plan.system.instances[instance].description.variable_of(name)
            if variable is not None and is_float(variable.type):
                bounds = (variable.nominal, variable.minimum, variable.maximum)
                given = [abs(bound) for bound in bounds if bound is not None and math.isfinite(bound)]
                scales.append(max([0.0 if variable.nominal else 1.0, *given]))
                self._columns.append((instance, name, read))
        self._given = np.array(scales)
        self._harmless = _STEPS[-1] * min(scales, default=0.0)
        self.begin_again()

    def begin_again(self) -> None:
        """Another run begins, whose values are read in the same way."""
        self.warnings = ()
        self._crossings.clear()
        self._scales, self._limits = self._given.copy(), self._given.copy()

    def look(self, first: int, end: int) -> None:
        """Look at the points first to end - 1."""
        if self.warnings:
            return
        normal, is_whole_run = min(max(self._normal, first), end), first == 0 and end > self._plan.grid.last_point
        for part, sizes in self._blocks(first, end):
            if is_whole_run and np.maximum.reduce(sizes, axis=None) <= self._harmless:
                continue  # no scale is less than the one that is given, and nobody looks at the scales again
            scales, limits = self._scales[part], self._limits[part]
            if normal > first:
                usual = sizes[:, : normal - first]
                most = np.maximum.reduce(usual, axis=1)
                if not np.isfinite(most).all():
                    most = np.where(np.isfinite(usual), usual, 0.0).max(axis=1)
                limits[:] = np.maximum(scales, most, out=scales)
            if normal < end:
                later = sizes[:, normal - first :]
                above = np.maximum.reduce(later, axis=1) > limits
                for row in np.flatnonzero(above).tolist() if above.any() else ():
                    self._take(part.start + row, normal, later[row])
        if not self._crossings:
            return
        reached = {column: own for column, own in self._crossings.items() if len(own) == len(_STEPS)}
        if reached:
            column = min(reached, key=lambda own: (reached[own][-1][0], own))
            self.warnings = (self._told(column, *reached[column]),)

    def _blocks(self, first: int, end: int) -> Iterator[tuple[slice, NDArray[np.float64]]]:
        """The sizes of the values of some columns at a time at the points first to end - 1, and which columns."""
        count = max(1, _BLOCK_NUMBERS // max(1, end - first))
        for start in range(0, len(self._columns) if first < end else 0, count):
            part = slice(start, start + count)
            values = np.array([read(first, end) for _, _, read in self._columns[part]], np.float64)
            yield part, np.abs(values, out=values)

    def _take(self, column: int, first: int, sizes: NDArray[np.float64]) -> None:
        """Find where the values of a column that begin at a point are above the next steps."""
        crossings, scale = self._crossings.setdefault(column, []), float(self._scales[column])
        for step in _STEPS[len(crossings) :]:
            self._limits[column] = limit = scale * step
            if not (sizes > limit).any():
                return
            place = int((sizes > limit).argmax())
            crossings.append((first + place, float(sizes[place])))

    def _told(self, column: int, begun: tuple[int, float], fast: tuple[int, float], far: tuple[int, float]) -> str:
        (instance, name, _), scale, time = self._columns[column], float(self._scales[column]), self._plan.grid.time
        points, ratio = far[0] - fast[0], far[1] / fast[1]
        if points == 0:  # within one point
            points, ratio = far[0] - begun[0] + 1, far[1] / scale
        cycle = next((own for own in self._plan.cycles if instance in own), ())
        where = f" It belongs to the cycle {', '.join(cycle)}: a smaller step size may keep it stable." if cycle else ""
        return (
            f"{instance}.{name} grows by a factor of {ratio ** (1 / points):.3g} per point: it left its scale of "
            f"{scale:.3g} at point {begun[0]} (t = {time(begun[0]):.12g} s), and 1e6 times this scale "
            f"at point {far[0]} (t = {time(far[0]):.12g} s).{where}"
        )
