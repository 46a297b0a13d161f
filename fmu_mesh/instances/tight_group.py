"""Groups that are solved by Newton (`group: {name: g, solve: newton}`): the steps of all members at once.

The unknowns are the values of the Float64 inputs that members get from members, at the end of a step. Over the step,
such an input follows the line from its value at the start to the unknown one, where the instance takes that; elsewhere
it is constant, the mean of both, and an output that depends directly on it is corrected by that derivative from the
mean to the end. What the connections then give of the outputs has to be the unknowns (Kuebler and Schiehlen 2000;
Schweizer and Lu 2015: index 1, order 2)::

    the first guess goes on as the last step has ended
    until what the outputs give is the guess:
        step all members from the saved state of the point
        correct the guess by the Jacobian: it is measured by differences, and again when it stops to converge

Between points there is one state of the group more, beside those of its members: the Jacobian, and how the last step
has ended. It belongs to the first member, so that a run that goes on from a state makes the same floats.
"""

# In plain floats, as all that several processes have to calculate alike (`fmu_mesh.system.consistent_outputs`).

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from typing import Any, Final, NamedTuple, Protocol, cast

import msgspec
from msgspec.structs import replace

from ..errors import FmuError, StepFailed
from ..rings.array_elements import scaled
from ..rings.ring import Ring
from ..simtime import TimeGrid
from ..system.consistent_outputs import solve
from ..system.coupling_rule import Line
from ..system.layout import Layout
from ..system.solved_groups import SolvedGroup
from ..text import listed
from .contract import Instance, KeepsFiles, Opening
from .instance_wrapper import AroundInstance, of_kind, packed, unpacked

__all__ = ["TightMember", "solve_together"]

_MOST_TRIES: Final = 20
_CONTRACTS: Final = 0.25
"""If a try leaves more than this part of the difference before it, the Jacobian is measured anew."""

_DIFFERENCE: Final = 2.0**-10
"""By how much an unknown is changed to measure the Jacobian, relative to the larger of 1 and its size. What solvers
within FMUs round away from step to step is far below it."""

_FINEST: Final = 10
"""Step control halves the step of a point up to so many times."""

_EASY: Final = 0.125
"""If the estimated error is below this part of the tolerance, the next step is twice as long: its error is about four
times as large."""

_SAFETY: Final = 0.9
_SHOWN: Final = 3


class _FollowsLines(Protocol):
    """An instance whose inputs may change linearly over a step, as an FMU does; see `FmuInstance`."""

    def set_input_derivatives(self, derivatives: Mapping[str, float], *, continuous: bool = False) -> None: ...


class _GroupState(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
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
    """Our part of a `_TightState` as bytes."""

    lines: tuple[Line, ...]
    group: _GroupState | None


class _TightState(msgspec.Struct, frozen=True):
    """A state of a member: that of its instance, its lines from outside of the group; of the first, the group, too."""

    inner: object
    lines: tuple[Line, ...]
    group: _GroupState | None


class _Span(NamedTuple):
    """One step of all members: its number and size in s, and which part of a point it is (0 to 1)."""

    number: int
    size: float
    first: float = 0.0
    last: float = 1.0


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
        self._lines: list[Line] = []
        self._ends: list[tuple[float, float]] = []  # of each outside line over the point
        self._group: _TightGroup | None = None  # of the first member
        self._goes_on = False

    def lead(self, group: _TightGroup) -> None:
        """The step of this member is that of the group."""
        self._group = group

    def bind(self, inputs: Ring, outputs: Sequence[Ring], grid: TimeGrid, points: int, step: int = 0) -> None:
        """See `Instance`. The instance works on rows of its own; ``outputs`` get what the last try leaves."""
        names = [item.name for item in self._outside]
        if not self._lines:
            self._lines = [Line(cast("float", value)) for value in self._instance.get_values(names) if names]
        self._inputs, self._outputs, self._grid, self._points = inputs, outputs, grid, points
        self._row, self._made = Ring(inputs.layout, 1), [Ring(own.layout, 1) for own in outputs]
        self._floats = self._row.part("Float64")[0]
        self._columns = {name: inputs.layout.place(name).first for name in (*self.solved, *names)}
        self._corrected = [
            (ring.parts[place.part], place.first, inputs_of)
            for ring in self._made
            for output, inputs_of in self._feedthrough.items()
            if _has(ring.layout, output)
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

    def begin(self, step: int) -> dict[int, float]:
        """Take the inputs of a point; returns the values of its unknowns there, by their numbers."""
        slot, begin = step & self._inputs.mask, step * self._points
        for own, part in zip(self._row.parts, self._inputs.parts, strict=True):
            own[0] = part[slot]
        self._ends, self._goes_on = [], True
        for number, item in enumerate(self._outside):
            before, latest = self._lines[number], begin if item.delay else begin + self._points
            value = float(self._floats[self._columns[item.name]])
            line = self._lines[number] = before.through(value, latest - latest % item.source_points)
            start, end = line.at(begin), line.at(begin + self._points)
            is_line = item.name in self._lined or not line.jumped
            self._ends.append((start, end) if is_line else (value, value))
            self._goes_on &= abs(start - before.at(begin)) <= 0.5 * max(abs(before.change), abs(line.change))
        return {number: float(self._floats[self._columns[name]]) for name, number in self.solved.items()}

    def take(self, span: _Span, starts: Sequence[float], ends: Sequence[float], *, goes_on: bool) -> None:
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
            cast("_FollowsLines", self._instance).set_input_derivatives(slopes, continuous=within)
        self._instance.do_step(span.number)
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

    def remove_files(self) -> None:
        """See `KeepsFiles`."""
        if isinstance(self._instance, KeepsFiles):
            self._instance.remove_files()

    # --- states

    def get_state(self) -> object:
        """See `KeepsState`."""
        group = self._group.known if self._group is not None else None
        return _TightState(super().get_state(), tuple(self._lines), group)

    def set_state(self, state: object) -> None:
        """See `KeepsState`."""
        own = of_kind(_TightState, state)
        super().set_state(own.inner)
        self._lines = [*own.lines]
        if self._group is not None and own.group is not None:
            self._group.known = own.group

    def free_state(self, state: object) -> None:
        """See `KeepsState`."""
        super().free_state(of_kind(_TightState, state).inner)

    def serialize_state(self, state: object) -> bytes:
        """See `KeepsState`."""
        own = of_kind(_TightState, state)
        return packed(_OwnState(own.lines, own.group), super().serialize_state(own.inner))

    def deserialize_state(self, data: bytes) -> object:
        """See `KeepsState`."""
        both, rest = unpacked(data, _OwnState, self.name)
        return _TightState(super().deserialize_state(rest), both.lines, both.group)

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


_WAYS_OUT: Final = "A smaller step size may help, or a larger `tolerance` of the group."
_NO_WAY_BACK: Final = (
    "In a group with `solve: newton`, each member goes back to the start of a step: leave out `solve`, or move this "
    "instance out of the group."
)


def solve_together(groups: Iterable[SolvedGroup], instances: Mapping[str, Instance]) -> None:
    """Let the first member of each group step all of its members. Call it when all instances are open."""
    for group in groups:
        members = [cast("AroundInstance[Instance]", instances[name]) for name in group.members]
        _TightGroup(group, [member.within(TightMember) for member in members])
        if any(member.changes_process for member in members):
            members[0].take_care()


class _TightGroup:
    """The members of a group and what it knows between two points."""

    def __init__(self, plan: SolvedGroup, members: Sequence[TightMember]) -> None:
        self._plan, self._members = plan, members
        by_name = {member.name: member for member in members}
        self._sources = [(by_name[own.source], own.output, own.factor, own.offset) for own in plan.unknowns]
        self._targets = [by_name[own.target] for own in plan.unknowns]
        self._most = _FINEST if plan.step_tolerance is not None else 0
        self._left: list[tuple[float, float]] = []  # what the last try has left of each unknown, and its value
        self.known = _GroupState()
        self._members[0].lead(self)

    def step(self, step: int) -> None:
        """Own step ``step`` of all members."""
        values = dict[int, float]()
        for member in self._members:
            values |= member.begin(step)
        starts, size = [values[number] for number in range(len(values))], self._members[0].step_size
        place, bound, whole = 0, 0, 1 << self._most  # in the smallest steps
        while place < whole:
            level = self.known.level
            while place % (whole >> level):
                level += 1
            if level != bound:
                self._refine(level, (step << level) + (place >> (self._most - level)))
                bound = level
            part = whole >> level
            number = (step << level) + (place >> (self._most - level))
            span = _Span(number, math.ldexp(size, -level), place / whole, (place + part) / whole)
            if self._try(span, starts, level):
                place += part
                starts = self._given()
        for member in self._members:
            member.put(step + 1)
        if bound:
            self._refine(0, step + 1)

    def _refine(self, level: int, number: int) -> None:
        for member in self._members:
            member.refine(level, number)

    def _try(self, span: _Span, starts: Sequence[float], level: int) -> bool:
        """Take one step, and choose the size of the next one; whether it was good. If not, all are where they were."""
        with self._kept() as states:
            ends = self._solved(span, starts, states)
            if ends is None and level == self._most:
                raise self._without_solution()
            if ends is None or not self._is_good(span, starts, ends, level):
                self._go_back(states)
                self.known = replace(self.known, level=max(self.known.level, level + 1))
                return False
        return True

    @contextmanager
    def _kept(self) -> Iterator[list[object]]:
        with ExitStack() as stack:
            yield [stack.enter_context(member.kept()) for member in self._members]

    def _go_back(self, states: Sequence[object]) -> None:
        for member, state in zip(self._members, states, strict=True):
            member.go_back(state)

    def _given(self) -> list[float]:
        """What the connections give of the outputs, for each unknown."""
        return [cast("float", scaled(one.value(output), *change)) for one, output, *change in self._sources]

    def _solved(self, span: _Span, starts: Sequence[float], states: Sequence[object]) -> list[float] | None:
        """The unknowns at the end of a step; None if the tries do not find them."""
        slopes, before, was_measured = self.known.slopes, math.inf, False
        ends = [start + slope * span.size for start, slope in zip(starts, slopes or [0.0] * len(starts), strict=True)]
        for number in range(_MOST_TRIES):
            if number:
                self._go_back(states)
            for member in self._members:
                member.take(span, starts, ends, goes_on=slopes is not None)
            given = self._given()
            self._left = [(own - end, end) for own, end in zip(given, ends, strict=True)]
            worst = max(_relative(left, end) for left, end in self._left)
            if worst <= self._plan.tolerance:
                return ends
            if not math.isfinite(worst):
                return None
            if not was_measured and (self.known.inverse is None or worst > _CONTRACTS * before):
                self._measure(span, starts, ends, given, states)
                was_measured = True
            before, inverse = worst, self.known.inverse or ()
            ends = [
                end + sum(factor * left for factor, (left, _) in zip(row, self._left, strict=True))
                for end, row in zip(ends, inverse, strict=True)
            ]
        return None

    def _measure(
        self,
        span: _Span,
        starts: Sequence[float],
        ends: Sequence[float],
        given: Sequence[float],
        states: Sequence[object],
    ) -> None:
        """Measure the Jacobian: by one step of its member for each unknown that something of the group depends on."""
        count = range(len(ends))
        matrix = [[float(row == column) for column in count] for row in count]
        for column, (member, end) in enumerate(zip(self._targets, ends, strict=True)):
            rows = [row for row in count if self._sources[row][0] is member]
            others = [*ends]
            others[column] += _DIFFERENCE * max(1.0, abs(end))
            if rows:
                member.go_back(states[self._members.index(member)])
                member.take(span, starts, others, goes_on=self.known.slopes is not None)
            for row, own in zip(rows, [self._given()[row] for row in rows], strict=True):
                matrix[row][column] -= (own - given[row]) / (others[column] - end)
        right = [{row: 1.0} for row in count]
        loop = solve(matrix, right) if all(math.isfinite(one) for row in matrix for one in row) else [*count]
        if loop is not None:
            names = listed([str(self._plan.unknowns[number]) for number in loop])
            text = f"the values of {names} do not follow from each other: the group '{self._plan.name}' has no Jacobian"
            raise StepFailed(text, instance=self._targets[loop[0]].name, hint=_WAYS_OUT)
        self.known = replace(self.known, inverse=tuple(tuple(own.get(n, 0.0) for n in count) for own in right))

    def _is_good(self, span: _Span, starts: Sequence[float], ends: Sequence[float], level: int) -> bool:
        """Whether the lines are near enough to the courses of the unknowns, as far as their ends tell.

        The end of a step and the slope before it give the second derivative, and that the distance in the middle. What
        jumps does so within one smallest step. The next one finds the new slope, and then the error has to be small.
        """
        tolerance, known = self._plan.step_tolerance, self.known
        slopes, size = known.slopes or (0.0,) * len(ends), known.size if known.slopes is not None else 0.0
        bends = [
            _relative(end - (a + slope * span.size), end) for a, slope, end in zip(starts, slopes, ends, strict=True)
        ]
        error = max(bends) * span.size / (4.0 * (span.size + size))
        is_large = tolerance is not None and error > tolerance
        if is_large and level < self._most:
            more = math.ceil(0.5 * math.log2(error / tolerance / _SAFETY))
            self.known = replace(known, level=min(level + max(more, 1), self._most))
            return False
        if is_large and known.is_new:
            raise self._too_coarse(bends, error)
        if tolerance is not None and error < _EASY * tolerance:
            level = max(level - 1, 0)
        jumps, is_new = is_large and known.slopes is not None, is_large and known.slopes is None
        rates = tuple((end - start) / span.size for start, end in zip(starts, ends, strict=True))
        self.known = replace(known, slopes=None if jumps else rates, size=span.size, level=level, is_new=is_new)
        return True

    def _without_solution(self) -> StepFailed:
        worst = sorted(range(len(self._left)), key=lambda number: -_relative(*self._left[number]))[:_SHOWN]
        shown = [
            f"{self._plan.unknowns[n]} is {end:.12g}, and its source gives {left:.3g} more"
            for n in worst
            for left, end in [self._left[n]]
        ]
        text = f"the group '{self._plan.name}' has no solution that {_MOST_TRIES} tries find: {listed(shown)}"
        return StepFailed(text, instance=self._targets[worst[0]].name, hint=_WAYS_OUT)

    def _too_coarse(self, bends: Sequence[float], error: float) -> StepFailed:
        worst = max(range(len(bends)), key=bends.__getitem__)
        text = (
            f"the tolerance {self._plan.step_tolerance:g} of `step_control` cannot be met in '{self._plan.name}': "
            f"with 1/{1 << self._most} of the step of the group, {self._plan.unknowns[worst]} is wrong by {error:.3g}"
        )
        return StepFailed(text, instance=self._targets[worst].name, hint=_WAYS_OUT)


def _relative(value: float, size: float) -> float:
    """A difference relative to the larger of 1 and the size of what differs; infinite if it is no number."""
    return abs(value) / max(1.0, abs(size)) if math.isfinite(value) and math.isfinite(size) else math.inf


def _has(layout: Layout, output: str) -> bool:
    try:
        layout.place(output)
    except KeyError:
        return False
    return True
