"""Inputs that change linearly within a communication step (`extrapolation: linear` of a connection).

Owns the line of an input: the one through the last two rows of its source that the instance has got, at the points to
which they belong. It follows from rows and points only, so it is the same in every process. A connection with delay 1
gives a row of the start of a step or earlier: the input is extrapolated. One with delay 0 gives the row of the end of
a step, if the source has one there: the input is interpolated. `FmuInstance` says how an FMU gets a derivative.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, cast

import msgspec

from ....rings.ring import Ring
from ....simtime import TimeGrid
from ....system.layout import Layout
from ....system.linear_inputs import LinearInput
from ...instance_wrapper import AroundInstance, of_kind, packed, unpacked
from ..fmu_instance import FmuInstance

__all__ = ["LinearInputs"]


class LinearInputs(AroundInstance[FmuInstance]):
    """An instance with inputs that change linearly within a step."""

    def __init__(self, instance: FmuInstance, inputs: Sequence[LinearInput]) -> None:
        super().__init__(instance)
        self._inputs = inputs
        self._lines: list[_Line] = []
        self._outer = Ring(Layout(), 1)
        self._inner = self._outer
        self._columns: list[int] = []
        self._points = 1
        self._base_step_size = 0.0

    def remove_files(self) -> None:
        """See `KeepsFiles`."""
        self._instance.remove_files()

    def bind(self, inputs: Ring, outputs: Sequence[Ring], grid: TimeGrid, points: int, step: int = 0) -> None:
        """See `Instance`."""
        names = [item.name for item in self._inputs]
        if not self._lines:
            # Before the first step, the FMU has the inputs of Initialization Mode.
            values = cast("list[float]", self._instance.get_values(names))  # only Float64 is linear
            self._lines = [_Line(value) for value in values]
        self._outer = inputs
        self._inner = Ring(inputs.layout, 1)
        self._columns = [inputs.layout.place(name).first for name in names]
        self._points, self._base_step_size = points, grid.step_size
        self._instance.bind(self._inner, outputs, grid, points, step)

    def do_step(self, step: int) -> None:
        """See `Instance`."""
        slot = step & self._outer.mask
        for own, part in zip(self._inner.parts, self._outer.parts, strict=True):
            own[0] = part[slot]
        row = self._inner.part("Float64")[0]
        begin = step * self._points
        continuous = True
        slopes = {}
        for number, item in enumerate(self._inputs):
            column, before = self._columns[number], self._lines[number]
            latest = begin if item.delay else begin + self._points
            line = before.through(float(row[column]), latest - latest % item.source_points)  # as in `CouplingRule`
            row[column] = value = line.at(begin)
            # An extrapolation of a smooth source is wrong by less than what it changes in a step of its own.
            allowed = 0.5 * max(abs(before.change), abs(line.change))
            continuous = continuous and abs(value - before.at(begin)) <= allowed
            slopes[item.name] = line.change / (line.distance * self._base_step_size)
            self._lines[number] = line
        self._instance.set_input_derivatives(slopes, continuous=continuous)
        self._instance.do_step(step)

    def get_state(self) -> object:
        """See `KeepsState`."""
        return _LinearState(super().get_state(), tuple(self._lines))

    def set_state(self, state: object) -> None:
        """See `KeepsState`."""
        own = of_kind(_LinearState, state)
        super().set_state(own.inner)
        self._lines = [*own.lines]

    def free_state(self, state: object) -> None:
        """See `KeepsState`."""
        super().free_state(of_kind(_LinearState, state).inner)

    def serialize_state(self, state: object) -> bytes:
        """See `KeepsState`."""
        own = of_kind(_LinearState, state)
        return packed(own.lines, super().serialize_state(own.inner))

    def deserialize_state(self, data: bytes) -> object:
        """See `KeepsState`."""
        lines, rest = unpacked(data, tuple[_Line, ...], None)
        return _LinearState(super().deserialize_state(rest), lines)


class _Line(msgspec.Struct, frozen=True):
    """The line through the last two rows of a source."""

    value: float  # the last value
    point: int = 0  # the point of the last value
    change: float = 0.0  # the last value minus the one before; 0 as long as there is only one
    distance: int = 1  # points between the two

    def through(self, value: float, point: int) -> _Line:
        """The line with the value of this point, which may be the last one again."""
        if point == self.point:
            return _Line(value, point, self.change, self.distance)
        return _Line(value, point, value - self.value, point - self.point)

    def at(self, point: int) -> float:
        """The value at a point."""
        return self.value + self.change * ((point - self.point) / self.distance)


class _LinearState(NamedTuple):
    """A state of the inner instance, and the lines."""

    inner: object
    lines: tuple[_Line, ...]
