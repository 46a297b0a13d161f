"""Components of the job `arrays`: one puts out a field of numbers, the other one adds them up."""

from __future__ import annotations

from typing import Any

import numpy as np

import fmu_mesh

__all__ = ["SIZES", "numpy_alone"]

SIZES = (1_000, 100_000, 1_000_000)
"""Numbers of a field."""


def _pair(size: int) -> tuple[type[fmu_mesh.Component], type[fmu_mesh.Component]]:
    class Source(fmu_mesh.Component):
        """Puts out a field that changes in each step."""

        field = fmu_mesh.Output(shape=size)

        def initialize(self) -> None:
            self._base = np.arange(size, dtype=np.float64)
            self.field = self._base

        def step(self, time: float, step_size: float) -> None:  # noqa: ARG002  as the mesh calls it
            self.field = self._base + time

    class Sum(fmu_mesh.Component):
        """Adds up a field."""

        field = fmu_mesh.Input(shape=size)
        total = fmu_mesh.Output()

        def step(self, time: float, step_size: float) -> None:  # noqa: ARG002  as the mesh calls it
            self.total = float(self.field.sum())

    return Source, Sum


Source1000, Sum1000 = _pair(1_000)
Source100000, Sum100000 = _pair(100_000)
Source1000000, Sum1000000 = _pair(1_000_000)


def numpy_alone(size: int, points: int, step_size: float) -> list[float]:
    """The same with numpy alone: the work of both, and one copy between them; the sums at all points but the first."""
    base: Any = np.arange(size, dtype=np.float64)
    sums = []
    field = base.copy()
    for point in range(points):
        sums.append(float(field.sum()))
        field = (base + point * step_size).copy()
    return sums
