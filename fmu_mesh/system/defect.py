"""The defect of a connection: how far what a target assumed over its steps was from what came (docs/defects.md)."""

from __future__ import annotations

import re
from collections.abc import Mapping
from heapq import nlargest

import msgspec

__all__ = ["Defect", "DefectWords", "largest_defects"]

_INDEX = re.compile(r"\[[0-9,]+\](?= ->|$)")


class Defect(msgspec.Struct, frozen=True):
    """How far what a target assumed was from what came: a pointer to the connection, and no estimate of an error.

    Attributes:
        maximum: the largest difference, in the unit of the input.
        point: the point at which the value came that differs most.
        time: the simulation time of that point in s.
        rms: root mean square of all differences, in the unit of the input.
        relative: the largest difference divided by the range of the input in the run; 0 if it was constant.
        steps: number of differences: the steps of the target in which a value came.
    """

    maximum: float
    point: int
    time: float
    rms: float
    relative: float
    steps: int


def largest_defects(defects: Mapping[str, Defect], most: int) -> dict[str, Defect]:
    """Those that are largest relative to the range of their inputs, the largest first."""
    return dict(nlargest(most, defects.items(), key=lambda item: item[1].relative))


class DefectWords:
    """Says of connections how large their defects are; of one of arrays, the largest one of its elements.

    Attributes:
        most: the largest ``relative`` of all; 0 without any.
    """

    def __init__(self, defects: Mapping[str, Defect]) -> None:
        self._found: dict[str, tuple[str, Defect]] = {}
        for name, own in largest_defects(defects, len(defects)).items():
            for connection in (name, _INDEX.sub("", name)):
                self._found.setdefault(connection, (name, own))
        self.most = max((own.relative for own in defects.values()), default=0.0)

    def largest_among(self, units: Mapping[str, str]) -> tuple[str, float]:
        """A line on the largest one of these connections, and its ``relative``; `""` and 0 if none of them has one.

        ``units`` has the units of their inputs.
        """
        found = [(*self._found[name], f" {unit}".rstrip()) for name, unit in units.items() if name in self._found]
        if not found:
            return "", 0.0
        name, own, unit = max(found, key=lambda item: item[1].relative)
        which = "" if [*units] == [name] else f"{name}: "
        most, rms = f"{own.maximum:.3g}{unit} (at t = {own.time:.12g} s)", f"{own.rms:.3g}{unit}"
        return f"\n{which}assumed and came differ by at most {most}, RMS {rms}", own.relative
