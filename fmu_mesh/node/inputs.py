"""Unconnected inputs and tunable parameters over time: what a scenario prescribes, and what programs send with a time.

Owns how a step gets its value from them, as `fmi_adapter` does for a ROS node. `fmu_mesh.system.settable` says which
variables may be set.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Literal, cast

from ..errors import FmuError
from ..instances.call_guard import Guarded
from ..instances.contract import Instance, KeepsState, StepsNatively
from ..instances.input_trajectory import Trajectory
from ..instances.instance_wrapper import AroundInstance
from ..rings.native import NativeStep, Stage
from ..rings.ring import Ring
from ..simtime import ENDLESS, TimeGrid
from ..system.plan import InstancePlan
from ..system.schedule import Course
from ..system.series_files import courses_of
from ..variables.model_description import Value
from ..variables.value_types import is_float
from ..wire.values import ValueRefused
from .stepping import Runner

__all__ = ["TimedInputs", "set_input", "with_times"]

_WAITING = 1 << 16


class TimedInputs(AroundInstance[Instance]):
    """An `Instance` whose inputs and parameters may follow trajectories; all other calls go to the inner instance.

    The step from t sets each of these variables to its value at t. A value without a time holds from the next step on.
    So does a value with a past time, unless a value with a later time is already used. What a scenario prescribes is
    set in the steps in which it changes, and then replaces any other value. The instance may be of any kind.

    Args:
        instance: the inner instance.
        interpolation: linear between two times for inputs of type Real, or constant from each time on.
        courses: what a scenario prescribes, by variable.

    Attributes:
        python_at: the next own step that `do_step` has to take, because a value may change in it.
    """

    def __init__(
        self,
        instance: Instance,
        interpolation: Literal["hold", "linear"],
        courses: Mapping[str, Course] = MappingProxyType({}),
    ) -> None:
        super().__init__(instance)
        self.python_at = 0
        self._set_in_step = instance.set_in_step if isinstance(instance, Guarded) else instance.set_values
        self._courses = courses
        self._linear = interpolation == "linear"
        self._trajectories: dict[str, Trajectory] = {}
        self._used: dict[str, Value] = {}
        self._early: list[tuple[str, Value, float | None]] = []
        self._grid: TimeGrid | None = None
        self._points = 1
        self._step = 0

    def bind(self, inputs: Ring, outputs: Sequence[Ring], grid: TimeGrid, points: int, step: int = 0) -> None:
        """Bind the inner instance. From now on there is a time; values that came before get the present one."""
        self._instance.bind(inputs, outputs, grid, points, step)
        self.start(grid, points, step)

    def start(self, grid: TimeGrid, points: int, step: int) -> None:
        """Start the time at own step ``step``; each own step has ``points`` points of ``grid``."""
        self._grid, self._points, self._step = grid, points, step
        self.python_at = step
        early, self._early = self._early, []
        for name, value, time in early:
            self.add(name, value, time)

    def do_step(self, step: int) -> None:
        """Set all values that change at the start of the step, then step the inner instance."""
        if step >= self.python_at:
            self._set_changes(step)
            self.python_at = self._next_change(step + 1)
        self._instance.do_step(step)
        self._step = step + 1

    @property
    def native(self) -> NativeStep | None:
        """See `StepsNatively`: the steps before `python_at`."""
        return self._instance.native if isinstance(self._instance, StepsNatively) else None

    @property
    def stage(self) -> int:
        """See `StepsNatively`."""
        return self._instance.stage if isinstance(self._instance, StepsNatively) else Stage.IN_PYTHON

    def finish(self, step: int, outcome: int) -> None:
        """See `StepsNatively`; only called if there is `native`."""
        cast("StepsNatively", self._instance).finish(step, outcome)

    def reached(self, step: int) -> None:
        """Note that ``step`` own steps are done: `do_step` has not taken those without a change."""
        self._step = step

    def add(self, name: str, value: Value, time: float | None) -> int:
        """Give a variable a value from ``time`` (s; None: now) on; return the first own step that uses it.

        Raises:
            ValueRefused: too many values wait for their time, or this one is too late.
        """
        if self._grid is None:
            self._early.append((name, value, time))
            return 0
        now = self._time(self._step)
        when = now if time is None else time
        step = self._grid.step_at(when, self._points)
        if step >= ENDLESS:
            raise ValueRefused(f"the time {when:g} s is later than any run ends")
        if name not in self._trajectories:
            variable = self.description.variable(name)
            is_input = variable is not None and variable.causality == "input"
            linear = self._linear and variable is not None and is_input and is_float(variable.type)
            trajectory = Trajectory(linear=linear)
            if when > now:
                trajectory.add(now, self._instance.get_values([name])[0])
            self._trajectories[name] = trajectory
        if len(self._trajectories[name]) >= _WAITING:
            raise ValueRefused(f"{_WAITING} values of '{name}' wait for their time already")
        self._trajectories[name].add(when, value)
        self.python_at = self._step
        return max(step, self._step)

    def follows(self, name: str) -> bool:
        """Whether a variable gets its values over time: every input does, and a parameter that got one with a time."""
        variable = self.description.variable(name)
        return name in self._trajectories or (variable is not None and variable.causality == "input")

    def _set_changes(self, step: int) -> None:
        """Set what changes in own step ``step``."""
        time = self._time(step)
        changes = {name: value for name, own in self._courses.items() if (value := own.change(step)) is not None}
        for name, value in changes.items():
            if name in self._trajectories:
                self._trajectories[name].add(time, value)
        for name, own in self._trajectories.items():
            value = own.value(time, self._grid_here.rounding(time))
            if self._used.get(name) != value:
                changes[name] = value
        if changes:
            self._set_in_step(changes)
            self._used.update((name, value) for name, value in changes.items() if name in self._trajectories)

    def _next_change(self, step: int) -> int:
        """The first own step from ``step`` on in which a value may change; the step before it is taken."""
        steps = [own.next_change(step) for own in self._courses.values()]
        time = self._time(step - 1)
        for own in self._trajectories.values():
            later = own.after(time + self._grid_here.rounding(time))
            if later is not None:
                steps.append(step if own.linear else max(step, self._grid_here.step_at(later, self._points)))
        return min(steps, default=ENDLESS)

    def _keeper(self) -> KeepsState:
        text = "the state of an instance with inputs over time cannot be kept: the values are not part of it"
        raise FmuError(text, instance=getattr(self._instance, "name", None))

    def _time(self, step: int) -> float:
        return self._grid_here.time(step * self._points)

    @property
    def _grid_here(self) -> TimeGrid:
        """The communication points, once the time has started."""
        assert self._grid is not None
        return self._grid


def with_times(instance: Instance, plan: InstancePlan, grid: TimeGrid) -> Instance:
    """The instance as its plan wants it: with what a scenario prescribes, and with inputs that follow times.

    Raises:
        ConfigurationError: a table of the scenario cannot be read, or has changed since the run was planned.
    """
    interpolation = plan.section.interpolation
    if interpolation is None and not plan.scenario:
        return instance
    courses = courses_of(plan.scenario, instance.description, grid, plan.step_points)
    return TimedInputs(instance, interpolation or "hold", courses)


def set_input(runner: Runner, name: str, value: Value, time: float | None) -> int:
    """On the main thread, between steps: set a variable; return the first own step that uses it.

    Only the first value with a time wraps the instance in `TimedInputs`. So steps of other instances do not get slower.

    Raises:
        FmuError: the FMU refused it.
        ValueRefused: too many values wait for their time, or this one is too late.
    """
    if time is not None and not isinstance(runner.instance, TimedInputs):
        timed = TimedInputs(runner.instance, "hold")
        timed.start(runner.grid, runner.plan.step_points, runner.step)
        runner.wrap(timed)
    if isinstance(runner.instance, TimedInputs) and (time is not None or runner.instance.follows(name)):
        runner.instance.reached(runner.step)
        step = runner.instance.add(name, value, time)
        runner.refit()
        return step
    runner.instance.set_values({name: value})
    return runner.step
