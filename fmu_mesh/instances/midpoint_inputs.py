"""Inputs that get the value in the middle of the line of their source (`extrapolation: midpoint`), for any kind.

What that value is says `fmu_mesh.system.coupling_rule`. The lines are in tables, which the burst follows as well.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, cast

from ..rings.native import Changed, CopyCall, NativeStep, declared
from ..rings.ring import Ring
from ..simtime import TimeGrid
from ..system.coupling_rule import SourceLine
from ..system.layout import Layout
from ..system.linear_inputs import LinearInput
from .contract import Instance, KeepsFiles
from .instance_wrapper import AroundNativeSteps, of_kind, packed, unpacked

__all__ = ["MidpointInputs"]


@declared("Line")
class LineTable(Changed):
    """A `SourceLine`, and where its input is in the row."""


class _MidpointState(NamedTuple):
    """A state of the inner instance, and the lines."""

    inner: object
    lines: tuple[SourceLine, ...]


class MidpointInputs(AroundNativeSteps):
    """An instance whose row of inputs is changed before each step."""

    def __init__(self, instance: Instance, inputs: Sequence[LinearInput]) -> None:
        super().__init__(instance)
        self._inputs = inputs
        self._lines = (LineTable * len(inputs))()
        self._row = Ring(Layout(), 1)
        self._columns: list[int] = []
        self._points = 0

    @property
    def native(self) -> NativeStep | None:
        """See `StepsNatively`."""
        own = super().native
        return own._replace(lines=self._lines) if own is not None else None

    def bind(self, inputs: Ring, outputs: Sequence[Ring], grid: TimeGrid, points: int, step: int = 0) -> None:
        """See `Instance`."""
        names = [item.name for item in self._inputs]
        self._row = inputs
        self._columns = [inputs.layout.place(name).first for name in names]
        row = inputs.part("Float64")
        if not self._points:  # before the first step, the instance has the inputs of Initialization Mode
            self._put([SourceLine(cast("float", value)) for value in self._instance.get_values(names)])
        for line, item, column in zip(self._lines, self._inputs, self._columns, strict=True):
            rule, to = item.rule, row.ctypes.data + 8 * column
            line.note(to=to, lead=rule.lead, source_points=rule.source_points, last=rule.last)
        self._points = points
        super().bind(inputs, outputs, grid, points, step)

    def do_step(self, step: int) -> None:
        """See `Instance`."""
        row, lines, begin = self._row.part("Float64")[step & self._row.mask], self._known, step * self._points
        for number, (item, column) in enumerate(zip(self._inputs, self._columns, strict=True)):
            lines[number] = line = lines[number].through(float(row[column]), item.latest(step))
            row[column] = line.middle(begin, self._points)
        self._put(lines)
        self._instance.do_step(step)

    @property
    def _known(self) -> list[SourceLine]:
        return [SourceLine(own.value, own.point, own.change, own.distance, bool(own.jumped)) for own in self._lines]

    def _put(self, lines: Sequence[SourceLine]) -> None:
        for own, line in zip(self._lines, lines, strict=True):
            own.note(value=line.value, point=line.point, change=line.change, distance=line.distance, jumped=line.jumped)

    def remove_files(self) -> None:
        """See `KeepsFiles`."""
        if isinstance(self._instance, KeepsFiles):
            self._instance.remove_files()

    def get_state(self) -> object:
        """See `KeepsState`."""
        return _MidpointState(super().get_state(), tuple(self._known))

    def set_state(self, state: object) -> None:
        """See `KeepsState`."""
        own = of_kind(_MidpointState, state)
        super().set_state(own.inner)
        self._put(own.lines)

    def free_state(self, state: object) -> None:
        """See `KeepsState`."""
        super().free_state(of_kind(_MidpointState, state).inner)

    def serialize_state(self, state: object) -> bytes:
        """See `KeepsState`."""
        own = of_kind(_MidpointState, state)
        return packed(own.lines, super().serialize_state(own.inner))

    def deserialize_state(self, data: bytes) -> object:
        """See `KeepsState`."""
        lines, rest = unpacked(data, tuple[SourceLine, ...], None)
        return _MidpointState(super().deserialize_state(rest), lines)

    def state_access(self, state: object) -> CopyCall | None:
        """None, because there is more to do."""
        return None
