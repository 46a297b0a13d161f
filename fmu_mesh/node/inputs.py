"""Unconnected inputs and tunable parameters over time: values that a program sends with a time from which on they hold.

Owns how a step gets its value from them, as `fmi_adapter` does for a ROS node. `fmu_mesh.system.settable` says which
variables may be set.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Literal

from ..errors import FmuError
from ..instances.contract import Instance, KeepsState
from ..instances.input_trajectory import Trajectory
from ..instances.instance_wrapper import AroundInstance
from ..rings.ring import Ring
from ..simtime import ENDLESS, TimeGrid
from ..variables.model_description import Value
from ..variables.value_types import is_float
from ..wire.values import ValueRefused
from .stepping import Runner

__all__ = ["TimedInputs", "set_input"]

_WAITING = 1 << 16


class TimedInputs(AroundInstance[Instance]):
    """An `Instance` whose inputs and parameters may follow trajectories; all other calls go to the inner instance.

    The step from t sets each of these variables to its value at t. A value without a time holds from the next step on.
    So does a value with a past time, unless a value with a later time is already used. The instance may be of any kind.

    Args:
        instance: the inner instance.
        interpolation: linear between two times for inputs of type Real, or constant from each time on.
    """

    def __init__(self, instance: Instance, interpolation: Literal["hold", "linear"]) -> None:
        super().__init__(instance)
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
        early, self._early = self._early, []
        for name, value, time in early:
            self.add(name, value, time)

    def do_step(self, step: int) -> None:
        """Set all inputs with a trajectory to their values at the start of the step, then step the inner instance."""
        if self._trajectories:
            time = self._time(step)
            now = {name: own.value(time, self._resolution(time)) for name, own in self._trajectories.items()}
            changed = {name: value for name, value in now.items() if self._used.get(name) != value}
            if changed:
                self._instance.set_values(changed)
                self._used.update(changed)
        self._instance.do_step(step)
        self._step = step + 1

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
        steps = (when - self._resolution(when) - self._grid.start_time) / (self._points * self._grid.step_size)
        if steps > ENDLESS:
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
        return math.ceil(max(steps, self._step))

    def follows(self, name: str) -> bool:
        """Whether a variable gets its values over time: every input does, and a parameter that got one with a time."""
        variable = self.description.variable(name)
        return name in self._trajectories or (variable is not None and variable.causality == "input")

    def _keeper(self) -> KeepsState:
        text = "the state of an instance with inputs over time cannot be kept: the values are not part of it"
        raise FmuError(text, instance=getattr(self._instance, "name", None))

    def _time(self, step: int) -> float:
        assert self._grid is not None
        return self._grid.time(step * self._points)

    def _resolution(self, time: float) -> float:
        """Largest difference of two equal times: the rounding of one multiplication and one addition."""
        assert self._grid is not None
        return 8 * math.ulp(max(abs(self._grid.start_time), abs(time)))


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
        return runner.instance.add(name, value, time)
    runner.instance.set_values({name: value})
    return runner.step
