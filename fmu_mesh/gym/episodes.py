"""The episodes of all copies of a mesh: what an action does, what is observed, and what ends an episode.

Owns the batch and the columns of observations and actions; `environments` gives it the form that Gymnasium asks for.
"""

from __future__ import annotations

import math
import operator
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np
from msgspec.structs import replace
from numpy.typing import ArrayLike, NDArray

from ..api.mesh_builder import Mesh, load
from ..errors import CallRefused
from ..run.run_plan import RunPlan
from ..text import counted, listed, option_text
from ..variables.model_description import Variable
from .task import Names, Step, Task

__all__ = ["Episodes", "SpaceColumn", "Stepped"]

Floats = NDArray[np.float64]
Truths = NDArray[np.bool_]

_NO_NUMBERS = {"String", "Binary"}


class SpaceColumn(NamedTuple):
    """An observed variable, or one that an action sets.

    Attributes:
        name: `instance.variable`.
        variable: what the model description says about it.
        size: how many elements of an observation or action it has.
        low: its lower bound; -inf without one.
        high: its upper bound; inf without one.
    """

    name: str
    variable: Variable
    size: int
    low: float
    high: float

    @property
    def is_whole(self) -> bool:
        """Whether it has whole numbers or truths, and no numbers with a fraction."""
        return not self.variable.type.startswith("Float")


class Stepped(NamedTuple):
    """What a step gave, each as an array of shape (copies,).

    Attributes:
        rewards: 0 where an episode has begun.
        terminated: which episodes came to their end.
        truncated: which episodes were cut off by time.
        reasons: by copy, why its FMU ended it.
    """

    rewards: Floats
    terminated: Truths
    truncated: Truths
    reasons: Mapping[int, str]


class Episodes:
    """The episodes of all copies. Call sequence: `begin`, then `step`, with `observations` after each; `close`.

    Args:
        task: the task.
        copies: how many.
        options: of `Mesh.batch`, such as the step size.

    Attributes:
        observed: the columns of an observation.
        acted: the columns of an action.

    Raises:
        CallRefused: the task cannot be done with this mesh.
        ConfigurationError: the mesh or an option is wrong.
        FmuError: an FMU cannot be opened or initialized.
    """

    def __init__(self, task: Task, copies: int, options: Mapping[str, Any]) -> None:
        mesh = task.mesh if isinstance(task.mesh, Mesh) else load(task.mesh)
        if not hasattr(task.points, "__index__") or (points := operator.index(task.points)) < 1:
            raise CallRefused(f"{option_text('points', task.points)}: expected a whole number, 1 or more")
        self._task, self._points = task, points
        run = mesh.plan(**options)
        self._last_point = _last_point(run, task)
        self.observed = _columns("observations", run, task.observations)
        self.acted = _columns("actions", run, task.actions)
        self._batch = mesh.batch(copies, **options)
        try:
            self._check_actions()
        except BaseException:
            self.close()
            raise
        self._scalars = [column.name for column in self.observed]
        if any(column.variable.shape or column.variable.type != "Float64" for column in self.observed):
            self._scalars = []
        self._values = np.zeros((copies, sum(column.size for column in self.observed)))

    @property
    def observations(self) -> NDArray[Any]:
        """What is observed now: a new array of shape (copies, elements)."""
        return self._values.astype(self._task.dtype)

    def begin(self, random: np.random.Generator, given: Mapping[str, ArrayLike], which: Truths | None = None) -> None:
        """Begin new episodes.

        Args:
            random: where start values are drawn from.
            given: start values that replace those of the task, one for all of these copies or one for each.
            which: the copies, of shape (copies,); None: all of them.
        """
        mask = np.ones(self._batch.copies, dtype=bool) if which is None else which
        count = int(np.count_nonzero(mask))
        drawn = self._task.start_values(random, count) if self._task.start_values is not None else {}
        values = {name: _spread(name, value, mask, count) for name, value in {**drawn, **given}.items()}
        if values:
            self._batch.reset(mask, start_values=values)
        else:
            self._batch.reset(mask)
        self._read()

    def step(self, actions: ArrayLike, over: Truths, random: np.random.Generator) -> Stepped:
        """Take one step of all copies whose episode goes on, and begin a new episode in the others.

        Args:
            actions: of shape (copies, elements), or (copies,) for one element.
            over: the copies whose episode is over, of shape (copies,); what their action is does not matter.
            random: where start values are drawn from.
        """
        batch, copies = self._batch, self._batch.copies
        done = self._set(np.asarray(actions).reshape(copies, -1), over)
        before = self._values
        if not over.all():
            batch.step(self._points)
        self._read()
        step = Step({**done, **self._named(self._values)}, self._named(before), batch.time, batch.get)
        rewards = self._computed("reward", self._task.reward, step, float)
        terminated = self._computed("terminated", self._task.terminated or _never, step, bool)
        point = batch.point
        gone = batch.done & (point < self._last_point)
        truncated = ~gone & (point + self._points > self._last_point)
        terminated |= gone
        reasons = {copy: batch.reasons.get(copy, "") for copy in np.flatnonzero(gone & ~over).tolist()}
        if over.any():
            rewards[over], terminated[over], truncated[over] = 0.0, False, False
            self.begin(random, {}, over)
        return Stepped(rewards, terminated, truncated, reasons)

    def close(self) -> None:
        """Free all copies."""
        self._batch.close()

    def _check_actions(self) -> None:
        for column in self.acted:
            self._batch.set(column.name, self._batch.get(column.name))  # this knows what may be set
            if (self._task.scaled or column.is_whole) and not math.isfinite(column.high - column.low):
                hint = f'For example, actions={{"{column.name}": (-1.0, 1.0)}}.'
                raise CallRefused(f"'{column.name}' has no minimum and maximum, and an action needs both.", hint=hint)
        whole = [column.name for column in self.acted if column.is_whole]
        if whole and len(whole) < len(self.acted):
            text = (
                f"{listed(whole)} of the actions {'has' if len(whole) == 1 else 'have'} whole numbers, and others not."
            )
            raise CallRefused(text, hint="Choose actions of one kind.")

    def _set(self, actions: NDArray[Any], over: Truths) -> dict[str, NDArray[Any]]:
        """Set the inputs of an action, and return what they were set to, by name."""
        elements = sum(column.size for column in self.acted)
        if actions.shape[1] != elements:
            raise CallRefused(f"an action has {counted(actions.shape[1], 'element')}; expected {elements}.")
        done, begin = {}, 0
        for column in self.acted:
            part = actions[:, begin : begin + column.size]
            begin += column.size
            if column.is_whole:
                part = np.where(over[:, None], int(column.low), part)
                if (wrong := ~((part >= column.low) & (part <= column.high)).all(axis=1)).any():
                    told = f"{part[wrong][0].tolist()} for '{column.name}'"
                    raise CallRefused(f"an action has {told}; expected {column.low:g} to {column.high:g}.")
                part = part.astype(bool if column.variable.type == "Boolean" else np.int64)
            else:
                part = np.where(over[:, None], 0.0, part.astype(np.float64))
                if self._task.scaled:
                    part = column.low + (part + 1.0) * (0.5 * (column.high - column.low))
                part = np.clip(part, column.low, column.high)
            done[column.name] = part.reshape(len(part), *column.variable.shape)
        self._batch.set(done)
        return done

    def _read(self) -> None:
        """Read what is observed into a new array: a function of the task may have kept a part of the last one."""
        values, begin = np.empty_like(self._values), 0
        if self._scalars:
            self._batch.get(self._scalars, out=values)
        else:
            for column in self.observed:
                part = values[:, begin : begin + column.size]
                part[:] = self._batch.get(column.name).reshape(part.shape)
                begin += column.size
        self._values = values

    def _named(self, values: Floats) -> dict[str, NDArray[Any]]:
        named, begin = {}, 0
        for column in self.observed:
            end, shape = begin + column.size, column.variable.shape
            named[column.name] = values[:, begin:end].reshape(-1, *shape) if shape else values[:, begin]
            begin = end
        return named

    def _computed(self, name: str, function: Callable[[Step], ArrayLike], step: Step, dtype: type) -> NDArray[Any]:
        found, copies = np.asarray(function(step)), self._batch.copies
        if found.shape not in {(), (copies,)}:
            raise CallRefused(f"`{name}` of the task returned the shape {found.shape}; expected ({copies},).")
        return np.array(np.broadcast_to(found, (copies,)), dtype)


def _never(_: Step) -> ArrayLike:
    return False


def _last_point(run: RunPlan, task: Task) -> int:
    """The last point of an episode."""
    grid = run.plan.grid
    if task.episode_time is None:
        return grid.last_point
    if not task.episode_time > 0.0:
        raise CallRefused(f"{option_text('episode_time', task.episode_time)}: expected more than 0 s")
    return min(grid.last_point, replace(grid, start_time=0.0).step_at(task.episode_time))


def _columns(option: str, run: RunPlan, names: Names) -> tuple[SpaceColumn, ...]:
    """The columns of observations or actions."""
    bounds = names if isinstance(names, Mapping) else dict.fromkeys(names)
    if not bounds:
        raise CallRefused(f"{option} of the task: expected one variable or more")
    columns = []
    for name, given in bounds.items():
        _, variable = run.variable(name)
        if variable.type in _NO_NUMBERS:
            raise CallRefused(f"'{name}' is a {variable.type}, and observations and actions are numbers.")
        low, high = given if given is not None else _bounds_of(variable)
        if not low < high:
            raise CallRefused(f"the bounds of '{name}' are {low:g} and {high:g}; expected a lower and an upper one.")
        columns.append(SpaceColumn(name, variable, variable.size, float(low), float(high)))
    return tuple(columns)


def _bounds_of(variable: Variable) -> tuple[float, float]:
    """The bounds that the model description gives."""
    low, high = variable.minimum, variable.maximum
    if variable.type == "Boolean":
        return 0.0, 1.0
    if variable.items:
        numbers = [number for _, number in variable.items]
        return float(min(numbers)), float(max(numbers))
    return -math.inf if low is None else low, math.inf if high is None else high


def _spread(name: str, value: ArrayLike, mask: Truths, count: int) -> NDArray[Any]:
    """The value of each copy, of shape (copies, ...), from those of the copies that begin anew."""
    values = np.asarray(value)
    if values.ndim and len(values) != count:
        text = (
            f"the start value of '{name}' has {counted(len(values), 'element')}; expected {count}, one for each copy."
        )
        raise CallRefused(text)
    spread = np.zeros((len(mask), *values.shape[1:]), values.dtype)
    spread[mask] = values
    return spread
