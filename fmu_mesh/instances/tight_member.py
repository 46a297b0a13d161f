"""A member of a solved group: one step with given values of its inputs at both ends, and back to where it began.

What the values are, and which steps are taken, is `fmu_mesh.instances.tight_group`.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any, Final, NamedTuple, Protocol, cast

import msgspec
from msgspec.structs import replace

from ..errors import FmuError
from ..rings.ring import Ring
from ..simtime import TimeGrid
from ..system.coupling_rule import SourceLine
from .contract import Instance, KeepsFiles, LogMessage, Opening
from .instance_wrapper import AroundInstance, of_kind, packed, unpacked

__all__ = ["GroupState", "GroupStep", "TightMember"]

_NO_WAY_BACK: Final = (
    "In a group with `solve: newton`, each member goes back to the start of a step: leave out `solve`, or move this "
    "instance out of the group."
)


class GroupState(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What a group knows between two points.

    Attributes:
        slopes: how the unknowns have changed over the last step, in 1/s; None: that is not known.
        size: the length of that step in s.
        inverse: what the differences are multiplied by to correct the unknowns; None: the Jacobian is not measured.
        level: how many times step control halves the next step.
        is_new: whether ``slopes`` are the first ones after a jump.
    """

    slopes: tuple[float, ...] | None = None
    size: float = 0.0
    inverse: tuple[tuple[float, ...], ...] | None = None
    level: int = 0
    is_new: bool = False


class _OwnState(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The lines of a member from outside of the group; of the first member, the state of the group, too."""

    lines: tuple[SourceLine, ...]
    group: GroupState


class _TightState(NamedTuple):
    """A state of the inner instance, and what else a member has."""

    inner: object
    own: _OwnState


class GroupStep(NamedTuple):
    """One step of all members: its number and size in s, and which part of a point it is (0 to 1)."""

    number: int
    size: float
    first: float = 0.0
    last: float = 1.0


class StepsTogether(Protocol):
    """A group, as its first member knows it."""

    def step(self, step: int) -> None:
        """Take own step ``step`` of all members."""
        ...

    @property
    def cost(self) -> str:
        """What its steps have cost, in words."""
        ...


class TightMember(AroundInstance[Instance]):
    """A member of a solved group. Only the step of the first member does something: it steps all of them.

    Call `solve_together` before `bind`. Before the step of the first member, all members have their rows of inputs.
    """

    def __init__(self, instance: Instance, opening: Opening[Any]) -> None:
        super().__init__(instance)
        group = opening.group
        assert group is not None
        self.name = opening.name
        self.solved = {own.input: number for number, own in enumerate(group.unknowns) if own.target == self.name}
        following = (*opening.linear_inputs, *opening.midpoint_inputs)
        self._outside = [item for item in following if item.name not in self.solved]
        self._lined = {item.name for item in opening.linear_inputs}
        self._feedthrough = group.feedthrough[self.name]
        self._lines: list[SourceLine] = []
        self._ends: list[tuple[float, float]] = []  # of each outside line over the point
        self._group: StepsTogether | None = None  # if it is the first member
        self._at, self._log = 0, opening.log
        self.known = GroupState()
        self.is_stepping = False  # for any thread
        self._goes_on = False

    def lead(self, group: StepsTogether) -> None:
        """The step of this member is that of the group."""
        self._group = group

    def note(self, known: GroupState) -> None:
        """Keep what the group knows; only the first member is asked for it."""
        self.known = known

    def bind(self, inputs: Ring, outputs: Sequence[Ring], grid: TimeGrid, points: int, step: int = 0) -> None:
        """See `Instance`. The instance works on rows of its own; ``outputs`` get what the last try leaves."""
        names = [item.name for item in self._outside]
        if not self._lines:
            self._lines = [SourceLine(cast("float", value)) for value in self._instance.get_values(names) if names]
        self._inputs, self._outputs, self._grid, self._points = inputs, outputs, grid, points
        self._row, self._made = Ring(inputs.layout, 1), [Ring(own.layout, 1) for own in outputs]
        self._floats = self._row.part("Float64")[0]
        self._columns = {name: inputs.layout.place(name).first for name in (*self.solved, *names)}
        self._corrected = [
            (ring.parts[place.part], place.first, self._feedthrough[output])
            for ring in self._made
            for column in ring.layout.columns
            for output in self._feedthrough.keys() & {*column.elements}
            for place in [ring.layout.place(output)]
        ]
        self.refine(0, step)
        self.put(step)

    @property
    def step_size(self) -> float:
        """The length of its steps from point to point, in s."""
        return self._points * self._grid.step_size

    def refine(self, level: int, number: int) -> None:
        """Take step ``number`` next, where a step between points has so many halves."""
        fine = replace(self._grid, step_size=math.ldexp(self._grid.step_size, -level), first_point=0)
        self._instance.bind(self._row, self._made, fine, self._points, number)

    def do_step(self, step: int) -> None:
        """See `Instance`."""
        if self._group is not None:
            self._group.step(step)
            self._at = step + 1

    def begin(self, step: int) -> dict[int, float]:
        """Take the inputs of a point; returns the values of its unknowns there, by their numbers."""
        slot, begin = step & self._inputs.mask, step * self._points
        for own, part in zip(self._row.parts, self._inputs.parts, strict=True):
            own[0] = part[slot]
        self._ends, self._goes_on = [], True
        for number, item in enumerate(self._outside):
            before = self._lines[number]
            value = float(self._floats[self._columns[item.name]])
            line = self._lines[number] = before.through(value, item.latest(step))
            start, end = line.at(begin), line.at(begin + self._points)
            is_line = item.name in self._lined or not line.jumped
            self._ends.append((start, end) if is_line else (value, value))
            self._goes_on &= abs(start - before.at(begin)) <= 0.5 * max(abs(before.change), abs(line.change))
        return {number: float(self._floats[self._columns[name]]) for name, number in self.solved.items()}

    def take(self, span: GroupStep, starts: Sequence[float], ends: Sequence[float], *, goes_on: bool) -> None:
        """One step, with unknowns that have these values at its start and its end."""
        courses = [(name, starts[number], ends[number]) for name, number in self.solved.items()]
        for item, (start, end) in zip(self._outside, self._ends, strict=True):
            courses.append((item.name, start + (end - start) * span.first, start + (end - start) * span.last))
        slopes, beyond = {}, {}
        for name, start, end in courses:
            if name in self._lined:
                self._floats[self._columns[name]], slopes[name] = start, (end - start) / span.size
            else:
                self._floats[self._columns[name]], beyond[name] = 0.5 * (start + end), 0.5 * (end - start)
        if slopes:
            within = goes_on and (self._goes_on or span.first > 0.0)
            cast("Any", self._instance).set_input_derivatives(slopes, continuous=within)  # an FMU, by its description
        self.is_stepping = True
        self._instance.do_step(span.number)
        self.is_stepping = False
        for part, column, inputs_of in self._corrected:
            for name, value in inputs_of.items():
                part[0, column] += value * beyond[name]

    def value(self, output: str) -> float:
        """An output, or an element of one, as the last step has left it."""
        return cast("float", self._made[0].value(0, output))

    def put(self, step: int) -> None:
        """Its outputs are those of own step ``step``."""
        for ring, own in zip(self._outputs, self._made, strict=True):
            for part, made in zip(ring.parts, own.parts, strict=True):
                part[step & ring.mask] = made[0]

    def close(self) -> None:
        """See `Instance`."""
        if self._group is not None:
            self._log(LogMessage(self.name, "OK", "group", self._group.cost, self._at))
            self._group = None
        super().close()

    def remove_files(self) -> None:
        """See `KeepsFiles`."""
        if isinstance(self._instance, KeepsFiles):
            self._instance.remove_files()

    # --- states

    def get_state(self) -> object:
        """See `KeepsState`."""
        return _TightState(super().get_state(), _OwnState(tuple(self._lines), self.known))

    def set_state(self, state: object) -> None:
        """See `KeepsState`."""
        inner, own = of_kind(_TightState, state)
        super().set_state(inner)
        self._lines, self.known = [*own.lines], own.group

    def free_state(self, state: object) -> None:
        """See `KeepsState`."""
        super().free_state(of_kind(_TightState, state).inner)

    def serialize_state(self, state: object) -> bytes:
        """See `KeepsState`."""
        inner, own = of_kind(_TightState, state)
        return packed(own, super().serialize_state(inner))

    def deserialize_state(self, data: bytes) -> object:
        """See `KeepsState`."""
        own, rest = unpacked(data, _OwnState, self.name)
        return _TightState(super().deserialize_state(rest), own)

    @contextmanager
    def kept(self) -> Iterator[object]:
        """The state of the instance here; it is freed at the end."""
        with self._going_back():
            state = super().get_state()
        try:
            yield state
        finally:
            super().free_state(state)

    def go_back(self, state: object) -> None:
        """Be where `kept` was."""
        with self._going_back():
            super().set_state(state)

    @contextmanager
    def _going_back(self) -> Iterator[None]:
        try:
            yield
        except FmuError as error:
            raise error.with_hint(_NO_WAY_BACK) from None
