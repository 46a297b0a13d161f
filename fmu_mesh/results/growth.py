"""Tells where recorded values grow without a limit, before they become infinite: one warning for a run.

Looks at the blocks of rows that are written, so it costs a step nothing. Knows no file.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, Final, NamedTuple

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


class _Crossing(NamedTuple):
    point: int
    value: float


class _Column:
    """A recorded variable: its scale, and where it first was above each of the steps."""

    def __init__(self, name: str, instance: str, read: ReadColumn, given: float) -> None:
        self.name = name
        self.instance = instance
        self.scale = given
        self.read = read
        self._crossings: list[_Crossing] = []

    def learn(self, size: float) -> None:
        """Take the size of a value as a part of its normal size."""
        self.scale = max(self.scale, size)

    def look(self, first: int, values: NDArray[np.float64], most: float) -> tuple[_Crossing, ...] | None:
        """All crossings, once it has crossed all steps; ``most`` is the largest size of these values."""
        crossings = self._crossings
        while most > (limit := self.scale * _STEPS[len(crossings)]):
            place = int((np.abs(values) > limit).argmax())
            crossings.append(_Crossing(first + place, abs(float(values[place]))))
            if len(crossings) == len(_STEPS):
                return tuple(crossings)
        return None


class GrowthWatch:
    """Watches the recorded floats of a run.

    Args:
        plan: the plan of the run.

    Attributes:
        warnings: at most one.

    Call sequence: `begin`, then `look` for consecutive points.
    """

    def __init__(self, plan: Plan) -> None:
        self.warnings: tuple[str, ...] = ()
        self._plan = plan
        self._columns: list[_Column] = []
        last = plan.grid.last_point
        self._normal = _FIRST_POINTS if last >= ENDLESS else max(1, math.ceil(_FIRST_PART * (last + 1)))

    def begin(self, columns: Mapping[tuple[str, str], ReadColumn]) -> None:
        """Choose what is watched.

        Args:
            columns: how the values of each recorded variable are read.
        """
        for (instance, name), read in columns.items():
            variable = self._plan.system.instances[instance].description.variable_of(name)
            if variable is not None and is_float(variable.type):
                bounds = (variable.nominal, variable.minimum, variable.maximum)
                given = [abs(bound) for bound in bounds if bound is not None and math.isfinite(bound)]
                least = 0.0 if variable.nominal else 1.0
                self._columns.append(_Column(f"{instance}.{name}", instance, read, max([least, *given])))

    def look(self, first: int, end: int) -> None:
        """Look at the points first to end - 1."""
        if self.warnings:
            return
        normal = min(max(self._normal, first), end)
        if first < normal:
            for columns, values in self._blocks(first, normal):
                sizes = np.abs(values)
                sizes[~np.isfinite(sizes)] = 0.0
                for column, size in zip(columns, sizes.max(axis=1).tolist(), strict=True):
                    column.learn(size)
        if normal < end:
            found = [
                (crossings[-1].point, column, crossings)
                for columns, values in self._blocks(normal, end)
                for column, own, most in zip(
                    columns, values, np.maximum(values.max(axis=1), -values.min(axis=1)).tolist(), strict=True
                )
                if (crossings := column.look(normal, own, most)) is not None
            ]
            if found:
                _, column, crossings = min(found, key=lambda item: item[0])
                self.warnings = (self._told(column, *crossings),)

    def _blocks(self, first: int, end: int) -> Iterator[tuple[Sequence[_Column], NDArray[np.float64]]]:
        """The columns and their values at the points first to end - 1, of some columns at a time."""
        count = max(1, _BLOCK_NUMBERS // (end - first))
        for start in range(0, len(self._columns), count):
            columns = self._columns[start : start + count]
            yield columns, np.array([column.read(first, end) for column in columns], np.float64)

    def _told(self, column: _Column, begun: _Crossing, fast: _Crossing, far: _Crossing) -> str:
        time, points, ratio = self._plan.grid.time, far.point - fast.point, far.value / fast.value
        if points == 0:  # within one point
            points, ratio = far.point - begun.point + 1, far.value / column.scale
        cycle = next((own for own in self._plan.cycles if column.instance in own), ())
        where = f" It belongs to the cycle {', '.join(cycle)}: a smaller step size may keep it stable." if cycle else ""
        return (
            f"{column.name} grows by a factor of {ratio ** (1 / points):.3g} per point: it left its scale of "
            f"{column.scale:.3g} at point {begun.point} (t = {time(begun.point):.12g} s), and 1e6 times this scale "
            f"at point {far.point} (t = {time(far.point):.12g} s).{where}"
        )
