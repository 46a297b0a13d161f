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
from typing import Any, Final, cast

from msgspec.structs import replace

from ..errors import StepFailed
from ..rings.array_elements import scaled
from ..system.consistent_outputs import solve
from ..system.solved_groups import SolvedGroup
from ..text import counted, listed
from .contract import Instance
from .instance_wrapper import AroundInstance
from .tight_member import GroupState, GroupStep, TightMember

__all__ = ["solve_together"]

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
_WAYS_OUT: Final = "A smaller step size may help, or a larger `tolerance` of the group."


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
        self._points = self._steps = self._tries = 0
        self._members[0].lead(self)

    @property
    def _known(self) -> GroupState:
        return self._members[0].known

    def _note(self, **changes: Any) -> None:  # noqa: ANN401  fields of the state
        self._members[0].note(replace(self._known, **changes))

    @property
    def cost(self) -> str:
        """How many steps and tries there were, in words."""
        points, group = counted(self._points, "point"), self._plan.name
        return f"the group '{group}' took {counted(self._steps, 'step')} and {self._tries} tries for {points}"

    def step(self, step: int) -> None:
        """Own step ``step`` of all members."""
        values = dict[int, float]()
        for member in self._members:
            values |= member.begin(step)
        starts, size = [values[number] for number in range(len(values))], self._members[0].step_size
        place, bound, whole = 0, 0, 1 << self._most  # in the smallest steps
        while place < whole:
            level = self._known.level
            while place % (whole >> level):
                level += 1
            part = whole >> level
            number = (step << level) + place // part
            if level != bound:
                self._refine(level, number)
                bound = level
            span = GroupStep(number, math.ldexp(size, -level), place / whole, (place + part) / whole)
            if self._try(span, starts, level):
                place += part
                starts = self._given()
                self._steps += 1
        self._points += 1
        for member in self._members:
            member.put(step + 1)
        if bound:
            self._refine(0, step + 1)

    def _refine(self, level: int, number: int) -> None:
        for member in self._members:
            member.refine(level, number)

    def _try(self, span: GroupStep, starts: Sequence[float], level: int) -> bool:
        """Take one step, and choose the size of the next one; whether it was good. If not, all are where they were."""
        with self._kept() as states:
            ends = self._solved(span, starts, states)
            if ends is None and level == self._most:
                raise self._without_solution()
            if ends is None or not self._is_good(span, starts, ends, level):
                self._go_back(states)
                self._note(level=max(self._known.level, level + 1))
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

    def _solved(self, span: GroupStep, starts: Sequence[float], states: Sequence[object]) -> list[float] | None:
        """The unknowns at the end of a step; None if the tries do not find them."""
        slopes, before, was_measured = self._known.slopes, math.inf, False
        ends = [start + slope * span.size for start, slope in zip(starts, slopes or [0.0] * len(starts), strict=True)]
        for number in range(_MOST_TRIES):
            if number:
                self._go_back(states)
            self._tries += 1
            for member in self._members:
                member.take(span, starts, ends, goes_on=slopes is not None)
            given = self._given()
            self._left = [(own - end, end) for own, end in zip(given, ends, strict=True)]
            worst = max(_relative(left, end) for left, end in self._left)
            if worst <= self._plan.tolerance:
                return ends
            if not math.isfinite(worst):
                return None
            if not was_measured and (self._known.inverse is None or worst > _CONTRACTS * before):
                self._measure(span, starts, ends, given, states)
                was_measured = True
            before, inverse = worst, self._known.inverse or ()
            ends = [
                end + sum(factor * left for factor, (left, _) in zip(row, self._left, strict=True))
                for end, row in zip(ends, inverse, strict=True)
            ]
        return None

    def _measure(
        self,
        span: GroupStep,
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
                member.take(span, starts, others, goes_on=self._known.slopes is not None)
            for row, own in zip(rows, [self._given()[row] for row in rows], strict=True):
                matrix[row][column] -= (own - given[row]) / (others[column] - end)
        right = [{row: 1.0} for row in count]
        loop = solve(matrix, right) if all(math.isfinite(one) for row in matrix for one in row) else [*count]
        if loop is not None:
            names = listed([str(self._plan.unknowns[number]) for number in loop])
            text = f"the values of {names} do not follow from each other: the group '{self._plan.name}' has no Jacobian"
            raise StepFailed(text, instance=self._targets[loop[0]].name, hint=_WAYS_OUT)
        self._note(inverse=tuple(tuple(own.get(n, 0.0) for n in count) for own in right))

    def _is_good(self, span: GroupStep, starts: Sequence[float], ends: Sequence[float], level: int) -> bool:
        """Whether the lines are near enough to the courses of the unknowns, as far as their ends tell.

        The end of a step and the slope before it give the second derivative, and that the distance in the middle. What
        jumps does so within one smallest step. The next one finds the new slope, and then the error has to be small.
        """
        tolerance, known = self._plan.step_tolerance or math.inf, self._known
        slopes, size = known.slopes or (0.0,) * len(ends), known.size if known.slopes is not None else 0.0
        both = zip(starts, slopes, ends, strict=True)
        bends = [_relative(end - (start + slope * span.size), end) for start, slope, end in both]
        error = max(bends) * span.size / (4.0 * (span.size + size))
        if (is_large := error > tolerance) and level < self._most:
            more = math.ceil(0.5 * math.log2(error / tolerance / _SAFETY))
            self._note(level=min(level + max(more, 1), self._most))
            return False
        if is_large and known.is_new:
            raise self._too_coarse(bends, error)
        if error < _EASY * tolerance:
            level = max(level - 1, 0)
        jumps, is_new = is_large and known.slopes is not None, is_large and known.slopes is None
        rates = tuple((end - start) / span.size for start, end in zip(starts, ends, strict=True))
        self._note(slopes=None if jumps else rates, size=span.size, level=level, is_new=is_new)
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
