"""Inputs that change linearly within a communication step (`extrapolation: linear` of a connection).

Owns the line of an input: the one through the last two rows of its source that the instance has got, at the points to
which they belong. It follows from rows and points only, so it is the same in every process. A connection with delay 1
gives a row of the start of a step or earlier: the input is extrapolated. One with delay 0 gives the row of the end of
a step, if the source has one there, or a later one if the source goes ahead: the input is interpolated. `FmuInstance`
says how an FMU gets a derivative.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, cast

from ....rings.ring import Ring
from ....simtime import TimeGrid
from ....system.coupling_rule import SourceLine
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
        self._lines: list[SourceLine] = []
        self._outer = Ring(Layout(), 1)
        self._inner = self._outer
        self._columns: list[int] = []
        self._told: list[tuple[int, str]] = []  # whose value at the end of the step goes into the row of outputs
        self._rows: Sequence[Ring] = ()
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
            self._lines = [SourceLine(value) for value in values]
        self._outer = inputs
        self._inner = Ring(inputs.layout, 1)
        self._columns = [inputs.layout.place(name).first for name in names]
        self._points, self._base_step_size = points, grid.step_size
        self._rows, known = outputs[:1], outputs[0].layout
        self._told = [(n, item.name) for n, item in enumerate(self._inputs) if item.ends and item.name in known]
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
            line = before.through(float(row[column]), item.latest(step))
            row[column] = value = line.at(begin)
            # An extrapolation of a smooth source is wrong by less than what it changes in a step of its own.
            allowed = 0.5 * max(abs(before.change), abs(line.change))
            continuous = continuous and abs(value - before.at(begin)) <= allowed
            slopes[item.name] = line.change / (line.distance * self._base_step_size)
            self._lines[number] = line
        self._instance.set_input_derivatives(slopes, continuous=continuous)
        self._instance.do_step(step)
        for number, name in self._told:
            self._rows[0].put(step + 1, name, self._lines[number].at(begin + self._points))

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
        lines, rest = unpacked(data, tuple[SourceLine, ...], None)
        return _LinearState(super().deserialize_state(rest), lines)


class _LinearState(NamedTuple):
    """A state of the inner instance, and the lines."""

    inner: object
    lines: tuple[SourceLine, ...]
