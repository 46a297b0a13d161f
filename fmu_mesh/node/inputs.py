"""Unconnected inputs and tunable parameters over time: what a scenario prescribes, and what programs send with a time.

Owns how a step gets its value from them, as `fmi_adapter` does for a ROS node. Which variables may be set is
`fmu_mesh.system.start_values`; when an input without values falls back is `fmu_mesh.system.input_timeouts`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from types import MappingProxyType
from typing import Any, Literal

import msgspec
import numpy as np
from numpy.typing import NDArray

from ..errors import FmuError
from ..instances.call_guard import Guarded
from ..instances.contract import Instance, KeepsState, LogMessage
from ..instances.input_trajectory import SavedTrajectory, Trajectory
from ..instances.instance_wrapper import AroundNativeSteps, of_kind, packed, unpacked
from ..results.keys_file import recorded_values
from ..rings.native import CopyCall
from ..rings.packed_member import PackedMember
from ..rings.ring import Ring
from ..simtime import ENDLESS, TimeGrid
from ..system.input_timeouts import InputTimeout, LastValues
from ..system.live_keys import KeyValue
from ..system.plan import InstancePlan
from ..system.schedule import Course
from ..system.series_files import courses_of
from ..text import listed
from ..variables.model_description import Value
from ..variables.value_conversion import checked_value
from ..variables.value_types import is_float
from ..wire.values import ValueRefused
from .stepping import Runner

__all__ = ["TimedInputs", "TooManyWait", "set_input", "with_times"]

_WAITING = 1 << 16
_SOON = 64
"""An input that changes within this many steps is calculated ahead."""

_LEAST = 8
"""For so many steps it takes less time to calculate inputs ahead than to set them in each step."""

_AHEAD = 4096
"""Number of steps that inputs are calculated ahead."""


class TooManyWait(ValueRefused):
    """A value is refused only because too many others of its variable wait for their times."""


class _OverTime(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Inputs over time between two own steps; what a scenario prescribes follows from the step.

    Attributes:
        step: the own step after the last one that `do_step` has taken.
        sent: see `LastValues`; ``late``: see `TimedInputs`.
        used: the values of ``trajectories`` that are set.
        unwarned: the inputs of which no fallback was told yet.
    """

    step: int
    trajectories: dict[str, SavedTrajectory]
    used: dict[str, Any]
    sent: dict[str, list[int]]
    late: dict[str, int]
    unwarned: tuple[str, ...]


class _TimedState(msgspec.Struct, frozen=True):
    """A state of the inner instance, and its inputs over time."""

    inner: object
    over_time: _OverTime


class TimedInputs(AroundNativeSteps):
    """An `Instance` whose inputs and parameters may follow trajectories; all other calls go to the inner instance.

    The step from t sets each of these variables to its value at t. A value without a time holds from the next step on.
    So does a value with a past time, unless a value with a later time is already used. What a scenario prescribes is
    set in the steps in which it changes, and then replaces any other value. The instance may be of any kind.

    A state has all values that were sent; but values of keys of Zenoh have no past, and there is no state then. After a
    state is restored, the next step is one that `do_step` takes.

    Args:
        interpolation: linear between two times for inputs of type Real, or constant from each time on.
        keys: the inputs that get the values of keys, and whether they are linear in any case.
        recorded: what has come by keys in an earlier run, in the order of its points.
        warn: called with the first fallback of each input.

    Attributes:
        last: when inputs with a timeout got their last values.
        late: the inputs without a value for too long, and the own steps of their last values; for any thread.
        python_at: the next own step that `do_step` has to take, because a value may change in it.
        tracks: inputs that change in each step before it: where each lies in the row of inputs, and its values.
        tracks_from: the own step of the first of these values.
    """

    def __init__(  # noqa: PLR0913  all that may give values
        self,
        instance: Instance,
        interpolation: Literal["hold", "linear"],
        courses: Mapping[str, Course] = MappingProxyType({}),
        timeouts: Sequence[InputTimeout] = (),
        warn: Callable[[LogMessage], None] = lambda _message: None,
        *,
        keys: Mapping[str, bool] = MappingProxyType({}),
        recorded: Iterable[tuple[str, int, float | None, Value]] = (),
    ) -> None:
        super().__init__(instance)
        self._asked: list[Callable[[], None]] = []
        self._recorded = iter(recorded)
        self._next = next(self._recorded, None)
        self.last = LastValues(timeouts, courses, instance.description)
        self._warn, self._timeouts = warn, {own.variable: own for own in timeouts}
        self._unwarned = {*self._timeouts}
        self.late: dict[str, int] = {}
        self.python_at = 0
        self.tracks: list[tuple[int, NDArray[np.float64]]] = []
        self.tracks_from = 0
        self._in_row: dict[str, tuple[Callable[[int, Value], None], int]] = {}
        self._tracked: list[str] = []
        self._set_in_step = instance.set_in_step if isinstance(instance, Guarded) else instance.set_values
        self._courses = courses
        self._linear = interpolation == "linear"
        self._keys = keys
        self._trajectories: dict[str, Trajectory] = {}
        self._used: dict[str, Value] = {}
        self._grid: TimeGrid  # from `start` on
        self._points, self._step = 1, 0

    def bind(self, inputs: Ring, outputs: Sequence[Ring], grid: TimeGrid, points: int, step: int = 0) -> None:
        """Bind the inner instance. From now on there is a time."""
        self._in_row.clear()
        for name in (self._courses.keys() | self._keys.keys()) & {*inputs.layout.names}:
            place = inputs.layout.place(name)
            self._in_row[name] = inputs.writer(name), inputs.address + inputs.place_in_row(place.part, place.first)
            inputs.put(0, name, self._instance.get_values([name])[0])
        self._instance.bind(inputs, outputs, grid, points, step)
        self.start(grid, points, step)

    def start(self, grid: TimeGrid, points: int, step: int) -> None:
        """Start the time at own step ``step``; each own step has ``points`` points of ``grid``."""
        self._grid, self._points, self._step = grid, points, step
        self.python_at = step
        self.tracks, self._tracked = [], []

    def do_step(self, step: int) -> None:
        """Set all values that change at the start of the step, then step the inner instance."""
        if step >= self.python_at:
            self._set_changes(step)
            self._look_ahead(step + 1)
        else:
            for name, (_, values) in zip(self._tracked, self.tracks, strict=True):
                self._in_row[name][0](0, float(values[step - self.tracks_from]))
        self._instance.do_step(step)
        self._step = step + 1

    def reached(self, step: int) -> None:
        """Note that ``step`` own steps are done: `do_step` has not taken those without a change."""
        self._step = step

    def ask(self, source: Callable[[], None]) -> None:
        """Call ``source``, which may `add` values, before each step that Python takes; `expect` says which it takes."""
        self._asked.append(source)

    def expect(self, step: int) -> None:
        """Own step ``step`` may change a value, so Python takes it."""
        self.python_at = min(self.python_at, step)

    def add(self, name: str, value: Value, time: float | None, most: int = _WAITING) -> int:
        """Give a variable a value from ``time`` (s; None: now) on; return the first own step that uses it.

        Raises:
            TooManyWait: so many values wait for their time already.
        """
        now = self._time(self._step)
        when = now if time is None else time
        step = self._grid.step_at(when, self._points)
        if name not in self._trajectories:
            variable = self.description.variable(name)
            is_input = variable is not None and variable.causality == "input"
            real = variable is not None and is_input and is_float(variable.type)
            linear = real and (self._linear or self._keys.get(name, False))
            trajectory = Trajectory(linear=linear)
            if when > now:
                # There is no line to the first value of a key.
                trajectory.add(now, self._instance.get_values([name])[0], holds=self._keys.get(name, False))
            self._trajectories[name] = trajectory
        if len(self._trajectories[name]) >= most:
            raise TooManyWait(f"{most} values of '{name}' wait for their time already")
        step = max(step, self._step)
        # A line changes in each step from now on. A value that holds changes nothing before its own step. What was sent
        # is calculated ahead up to the last value at most.
        own = self._trajectories[name]
        is_needed_now = name in self._courses or when <= own.last if name in self._tracked else own.linear
        # The value that it has fallen back to is as if it had been sent, and would be newer than one with a past time.
        own.add(max(when, now) if name in self.late else when, value)
        self.last.came(name, step)
        self.python_at = min(self.python_at, self._step if is_needed_now else step)
        return step

    def follows(self, name: str) -> bool:
        """Whether a variable gets its values over time: every input does, and a parameter that got one with a time."""
        variable = self.description.variable(name)
        return name in self._trajectories or (variable is not None and variable.causality == "input")

    def skip_before(self, point: int) -> None:
        """A state of this point has what came before it, in an earlier run or before a restart."""
        while self._next is not None and self._next[1] < point:
            self._next = next(self._recorded, None)

    def _set_changes(self, step: int) -> None:
        """Set what changes in own step ``step``."""
        time = self._time(step)
        self.take_given(step)
        for ask in self._asked:
            ask()
        changes = {name: value for name, own in self._courses.items() if (value := own.change(step)) is not None}
        if self.last.sent:
            changes |= self._fall_back(step, time)
        for name, value in changes.items():
            if name in self._trajectories:
                self._trajectories[name].add(time, value)
                if self._trajectories[name].after(time + self._grid.rounding(time)) is None:
                    del self._trajectories[name]
                    self._used.pop(name, None)
        for name, own in self._trajectories.items():
            value = own.value(time, self._grid.rounding(time))
            if self._used.get(name) != value:
                changes[name] = value
        for name in changes.keys() & self._in_row.keys():
            self._in_row[name][0](0, changes[name])
        if others := {name: value for name, value in changes.items() if name not in self._in_row}:
            self._set_in_step(others)
        self._used.update((name, value) for name, value in changes.items() if name in self._trajectories)

    def take_given(self, step: int) -> None:
        """Take what came from outside up to own step ``step``, in an earlier run or before a restart."""
        while self._next is not None and self._next[1] <= step * self._points:
            name, _, when, value = self._next
            self._step = step
            self.add(name, value, when, ENDLESS)  # when the first run took it, there was room
            self._next = next(self._recorded, None)

    def _fall_back(self, step: int, time: float) -> dict[str, Value]:
        """What inputs fall back to in own step ``step``, which begins at ``time`` (s)."""
        for name, own in self._trajectories.items():
            if own.linear and own.after(time + self._grid.rounding(time)) is not None:
                self.last.came(name, step)  # a line to a later value
        values, self.late = self.last.fall_back(step), self.last.late(step)
        for name in [name for name in self._timeouts if name in self._unwarned and name in self.late]:
            self._unwarned.remove(name)
            timeout, point = self._timeouts[name], self.late[name] * self._points
            text = f"input '{name}' has had no value since point {point}: it {timeout}"
            self._warn(LogMessage(timeout.instance, "warning", "timeout", text, step))
        return values

    def _look_ahead(self, step: int) -> None:
        """Find the step that Python takes next, and the values of inputs that change in each step before it."""
        changes = {name: own.next_change(step) for name, own in self._courses.items()}
        soon = [
            name
            for name, change in changes.items()
            if change < step + _SOON
            and name in self._in_row
            and name not in self._trajectories
            and name not in self.late
            and self._courses[name].first_step <= step
        ]
        sent = self._next_sent(step)
        came = {
            name: self._grid.step_at(self._trajectories[name].last, self._points)
            for name, change in sent.items()
            if change < step + _SOON and name in self._in_row and name not in self._courses and name not in self.late
        }
        others = [change for name, change in (*changes.items(), *sent.items()) if name not in {*soon, *came}]
        recorded = self._next[1] // self._points if self._next is not None else ENDLESS
        others += self.last.next(step), recorded
        end = min([*others, *came.values(), step + _AHEAD])
        self.tracks, self._tracked, self.tracks_from = [], [], step
        if not (soon or came) or end - step < _LEAST:
            self.python_at = min([*changes.values(), *sent.values(), *others])
            return
        self._tracked = [*soon, *came]
        self.tracks = [(self._in_row[name][1], self._courses[name].values(step, end - step)) for name in soon]
        times = self._grid.times(step * self._points, end * self._points, self._points)
        roundings = 8 * np.spacing(np.maximum(abs(self._grid.start_time), np.abs(times)))
        for name in came:
            self.tracks.append((self._in_row[name][1], self._trajectories[name].values(times, roundings)))
            self._used.pop(name, None)
        self.python_at = end

    def _next_sent(self, step: int) -> dict[str, int]:
        """The first own step from ``step`` on in which each value that was sent may change; without those that hold."""
        steps = {}
        time = self._time(step - 1)
        for name, own in self._trajectories.items():
            later = own.after(time + self._grid.rounding(time))
            if later is not None:
                steps[name] = step if own.linear else max(step, self._grid.step_at(later, self._points))
        return steps

    # --- states

    def get_state(self) -> object:
        """See `KeepsState`.

        Raises:
            FmuError: the inputs get values of keys, or the inner instance has no states.
        """
        trajectories = {name: own.save() for name, own in self._trajectories.items()}
        sent = {name: [*steps] for name, steps in self.last.sent.items()}
        unwarned = tuple(sorted(self._unwarned))
        own = _OverTime(self._step, trajectories, dict(self._used), sent, dict(self.late), unwarned)
        return _TimedState(super().get_state(), own)

    def set_state(self, state: object) -> None:
        """See `KeepsState`."""
        saved = of_kind(_TimedState, state)
        super().set_state(saved.inner)
        own = saved.over_time
        self._trajectories = {
            name: Trajectory(linear=kept.linear, saved=kept) for name, kept in own.trajectories.items()
        }
        self._used, self.late, self._unwarned = dict(own.used), dict(own.late), {*own.unwarned}
        self.last.sent.update((name, [*steps]) for name, steps in own.sent.items())
        self._step = self.python_at = own.step
        self.tracks, self._tracked = [], []

    def free_state(self, state: object) -> None:
        """See `KeepsState`."""
        super().free_state(of_kind(_TimedState, state).inner)

    def serialize_state(self, state: object) -> bytes:
        """See `KeepsState`."""
        saved = of_kind(_TimedState, state)
        return packed(saved.over_time, super().serialize_state(saved.inner))

    def deserialize_state(self, data: bytes) -> object:
        """See `KeepsState`."""
        own, rest = unpacked(data, _OverTime, getattr(self._instance, "name", None))
        return _TimedState(super().deserialize_state(rest), own)

    def apart(self, data: bytes) -> tuple[PackedMember, bytes]:
        """What `serialize_state` returned as what each engine knows of inputs over time, and that of the model."""
        own, inner = unpacked(data, _OverTime, getattr(self._instance, "name", None))
        time = self._time(own.step)
        rounding = self._grid.rounding(time)
        waits = tuple(
            name
            for name, one in self._trajectories.items()
            if one.after(time + rounding) is not None or one.value(time, rounding) != own.used.get(name)
        )
        known = PackedMember(b"", own.step, -1, {}, {}, own.sent, msgspec.msgpack.encode(own), waits)
        return known, inner

    def together(self, packed_member: PackedMember) -> bytes:
        """The other way round: what `deserialize_state` takes. Another engine may have known less."""
        known = packed_member
        if known.over_time:
            return msgspec.msgpack.encode((msgspec.Raw(known.over_time), known.state))
        self.last.sent.update((name, [*steps]) for name, steps in known.sent.items())
        late = self.last.late(known.step - 1)
        unwarned = tuple(sorted(self._timeouts.keys() - late.keys()))
        return packed(_OverTime(known.step, {}, {}, known.sent, late, unwarned), known.state)

    def state_access(self, state: object) -> CopyCall | None:  # noqa: ARG002  as in `AccessedNatively`
        """See `AccessedNatively`; None, because there is more to do."""
        return None

    def _keeper(self) -> KeepsState:
        if self._keys:
            inputs = listed([*self._keys])
            text = f"its state cannot be kept, because keys of Zenoh give values to {inputs}, and these have no past"
            raise FmuError(text, instance=getattr(self._instance, "name", None))
        return super()._keeper()

    def _time(self, step: int) -> float:
        return self._grid.time(step * self._points)


def with_times(
    instance: Instance,
    plan: InstancePlan,
    grid: TimeGrid,
    warn: Callable[[LogMessage], None],
    given: Sequence[KeyValue] = (),
) -> Instance:
    """The instance as its plan wants it: with what a scenario prescribes, and with inputs that follow times.

    After a restart, it gets again what was ``given`` to it before.

    Raises:
        ConfigurationError: a table of the scenario, or the values of keys of an earlier run, cannot be read, or have
            changed since the run was planned.
    """
    interpolation = plan.section.interpolation
    if interpolation is None and not plan.scenario and not plan.timeouts and not plan.keys_in and not given:
        return instance
    courses = courses_of(plan.scenario, instance.description, grid, plan.step_points)
    keys = {own.variable: own.linear for own in plan.keys_in}
    known = {one.name: one for one in instance.description.variables if one.name in keys}
    recorded = (
        recorded_values(plan.recorded_keys, plan.name, known)
        if plan.recorded_keys is not None
        else _again(instance, given)
    )
    return TimedInputs(instance, interpolation or "hold", courses, plan.timeouts, warn, keys=keys, recorded=recorded)


def _again(instance: Instance, given: Sequence[KeyValue]) -> Iterator[tuple[str, int, float | None, Value]]:
    for path, point, time, plain in given:
        name = path.partition(".")[2]
        variable = instance.description.variable(name)
        assert variable is not None  # it was set before
        yield name, point, time, checked_value(plain, variable, name)


def set_input(runner: Runner, name: str, value: Value, time: float | None, *, more: bool = False) -> int:
    """On the main thread, between steps: set a variable; return the first own step that uses it.

    Only the first value with a time wraps the instance in `TimedInputs`. So steps of other instances do not get slower.
    If there are ``more``, the caller has to call `Runner.follow_inputs` after the last one, before the next step.

    Raises:
        FmuError: the FMU refused it.
        ValueRefused: too many values wait for their time, or no step of this run begins at this one or later.
    """
    if time is not None and time > (latest := runner.grid.latest(runner.point, streamed=False)):
        what = "the end of the simulation" if runner.grid.stop_time is not None else "1e6 s ahead: is it a Unix time?"
        raise ValueRefused(f"the time {time:.12g} s is later than {latest:.12g} s, {what}")
    if time is not None and not isinstance(runner.instance, TimedInputs):
        timed = TimedInputs(runner.instance, "hold")
        timed.start(runner.grid, runner.plan.step_points, runner.step)
        runner.wrap(timed)
    if isinstance(runner.instance, TimedInputs) and (time is not None or runner.instance.follows(name)):
        runner.instance.reached(runner.step)
        step = runner.instance.add(name, value, time)
        if not more:
            runner.follow_inputs()
        return step
    runner.instance.set_values({name: value})
    return runner.step
