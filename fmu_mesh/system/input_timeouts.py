"""When an input without values falls back: the rule of `inputs: {u: {timeout: ...}}`, which every engine shares."""

from __future__ import annotations

from bisect import bisect_right, insort
from collections.abc import Iterable, Mapping

import msgspec

from ..errors import TerminationRequested
from ..simtime import ENDLESS
from ..text import shown
from ..variables.model_description import ModelDescription, Value
from ..variables.value_conversion import to_value
from ..variables.value_types import PlainValue
from .schedule import Course

__all__ = ["InputTimeout", "LastValues"]


class InputTimeout(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What an input does without a value.

    Attributes:
        after: the time without a value in s, as written.
        steps: the first own step, of so many base ``points``, that begins so long after step 0, or later; 1 or more.
        value: what it falls back to; None: it holds its value, or ends the run.
    """

    instance: str
    variable: str
    after: float
    steps: int
    points: int
    value: PlainValue | None = None
    stops: bool = False

    def __str__(self) -> str:
        then = "ends the run" if self.stops else "holds" if self.value is None else f"gets {shown(self.value)}"
        return f"{then} after {self.after:.12g} s without a value"


class LastValues:
    """Which inputs of an instance have got no value for too long; ask for own steps in ascending order.

    A value counts from the own step that uses it first; where there is none, step 0 counts. A line of a scenario is a
    value in each step.

    Attributes:
        sent: the own steps that first use the values that somebody sends: the last one that is past, and later ones.
    """

    def __init__(
        self, timeouts: Iterable[InputTimeout], courses: Mapping[str, Course], description: ModelDescription
    ) -> None:
        variables = {variable.name: variable for variable in description.variables}
        self._own = [(own, courses.get(own.variable)) for own in timeouts]
        given = [own for own, _ in self._own if own.value is not None]
        self._values = {own.variable: to_value(own.value, variables[own.variable]) for own in given}
        self.sent: dict[str, list[int]] = {own.variable: [] for own, _ in self._own}

    def came(self, name: str, step: int) -> None:
        """Somebody has sent a value that is used from own step ``step`` on."""
        if name in self.sent:
            insort(self.sent[name], step)

    def count_from(self, step: int) -> None:
        """Its instance begins at this own step: without a value, this one counts."""
        for name in self.sent:
            self.came(name, step)

    def late(self, step: int) -> dict[str, int]:
        """The inputs without a value for too long at the start of an own step, and the steps of their last values."""
        last = [(own, self._last(own, course, step)) for own, course in self._own]
        return {own.variable: at for own, at in last if step - at >= own.steps}

    def fall_back(self, step: int) -> dict[str, Value]:
        """The values of the inputs that fall back in this own step.

        Raises:
            TerminationRequested: an input ends the run; without the point.
        """
        now = [own for own, course in self._own if step - self._last(own, course, step) == own.steps]
        for own in now:
            if own.stops:
                text = f"there was no value since point {(step - own.steps) * own.points}, and it {own}"
                raise TerminationRequested(text, instance=own.instance, variable=own.variable)
        return {own.variable: self._values[own.variable] for own in now if own.variable in self._values}

    def next(self, step: int) -> int:
        """The first own step from ``step`` on in which an input falls back if no value comes; `ENDLESS` without one."""
        due = (self._last(own, course, step) + own.steps for own, course in self._own)
        return min((at for at in due if at >= step), default=ENDLESS)

    def _last(self, own: InputTimeout, course: Course | None, step: int) -> int:
        sent = self.sent[own.variable]
        del sent[: max(0, bisect_right(sent, step) - 1)]
        return max(course.last(step) if course is not None else 0, sent[0] if sent and sent[0] <= step else 0)
