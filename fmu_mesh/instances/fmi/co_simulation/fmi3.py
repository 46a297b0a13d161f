"""FMI 3.0 co-simulation behind the `Instance` Protocol, with all that can happen in one communication step (4.2.1).

::

    until the end of the step:
        fmi3DoStep to the end, the next time event or the next tick of a clock
        discarded: again with half of it
        an event, or its time has come: event mode; update the discrete states; step mode

The communication points of the mesh stay the same; only the FMU sees more of them. With event mode in use, discrete
inputs and tunable parameters change in event mode only (fmi3EnterEventMode); continuous inputs are set in step mode.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final, Literal

from fmpy.fmi1 import FMICallException
from fmpy.fmi3 import FMU3Slave

from ....rings.native import RowBase, Said, StepKind
from ....rings.ring import Ring
from ....simtime import TimeGrid, resolvable, step_within
from ....variables.model_description import ModelDescription
from ....variables.value_types import Value
from ..calls import Function, Pointer, cffi_function, pointer
from ..clocks import Clocks, updated
from ..fmi_versions import Fmi3
from ..fmu_instance import Bookkeeping
from ..fmu_values import DISCARD, WARNING, PartCall, SolverFailed, Verb
from ..loaded_fmu import FmuFunctions
from ..native_instance import NativeInstance
from .discarded_steps import SMALLEST

__all__ = ["Fmi3Instance", "Fmi3Steps"]

_NEEDED = "fmi3InstantiateCoSimulation", *Fmi3.NEEDED, "fmi3DoStep"
_DO_STEP = "int (*)(void *, double, double, _Bool, void *, void *, void *, void *)"
MOST_RETURNS: Final = 1000
"""After this many returns of fmi3DoStep at the same time, an FMU makes no progress."""


class Fmi3Instance(NativeInstance, Fmi3):
    """One instance of an FMI 3.0 co-simulation FMU."""

    _kind = StepKind.FMI3
    _functions = FmuFunctions(FMU3Slave, Fmi3.VALUES, "fmi3FreeInstance", _NEEDED, {"instantiate": _NEEDED[0]})
    _steps: Fmi3Steps
    _discrete_row: tuple[bytes | list[Any], ...] = ()

    def set_values(self, values: Mapping[str, Value]) -> None:
        """Set variables by name; between two steps in event mode, if the FMU has it."""
        if self._state != "stepping":
            super().set_values(values)
            return
        set_values = super().set_values
        if not self._steps.terminated:
            self._checked(lambda: self._steps.event(self._said.time, lambda: set_values(values)))

    def setter(self, name: str) -> Callable[[Value], None] | None:
        """See `Prepares`."""
        if (put := super().setter(name)) is None:
            return None

        def put_before_end(value: Value) -> None:
            if not self._steps.terminated:
                put(value)

        return put_before_end

    def bind(self, inputs: Ring, outputs: Sequence[Ring], grid: TimeGrid, points: int, step: int = 0) -> None:
        """See `Instance`."""
        super().bind(inputs, outputs, grid, points, step)
        if self._discrete:
            self._native = None  # a node does not know whether these inputs have changed
            take, member = self._in_step

            def take_after_events(member: Pointer, step: int) -> int:
                self._set_discrete(step & self._input_mask)
                return take(member, step)

            self._in_step = take_after_events, member

    def advance(self, time: float, step_size: float) -> None:
        """One step of ``step_size`` from ``time`` (both in s) without rings, for callers with their own time base."""
        self._check_live()
        end = time + step_size
        self._advance(end, lambda: self._steps.step(time, step_size, end))

    def _instantiate(self, **arguments: object) -> None:
        has_event_mode = self.description.has_event_mode
        super()._instantiate(eventModeUsed=has_event_mode, earlyReturnAllowed=True, **arguments)
        self._do_step = cffi_function(self._fmu.dll.fmi3DoStep, _DO_STEP)

    def _enter_initialization(self, start_time: float, stop_time: float | None, start_values: dict[str, Value]) -> None:
        super()._enter_initialization(start_time, stop_time, start_values)
        self._said.note(time=start_time)
        self._steps = Fmi3Steps(self._fmu, self._do_step, self.description, self._said)
        self._checked(lambda: self._steps.start(start_time))
        self._by_calls = bool(self._steps.clocks)

    def _exit_initialization(self) -> None:
        """An FMU with event mode is in it now."""
        super()._exit_initialization()
        self._checked(lambda: self._steps.exit_initialization(self._said.time))

    def _part_calls(self, verb: Verb, ring: Ring, base: RowBase) -> list[PartCall]:
        calls = super()._part_calls(verb, ring, base)
        if verb == "Set":
            self._discrete = [part for part in calls if self._is_discrete(part)]
            return [part for part in calls if not self._is_discrete(part)]
        return calls

    def _is_discrete(self, part: PartCall) -> bool:
        """Whether the variables of a part change in event mode only."""
        continuous = all(variable.variability == "continuous" for variable in part.variables)
        return self.description.has_event_mode and not continuous

    def _is_plain(self, verb: Verb | Literal["State"]) -> bool:
        return super()._is_plain(verb) and (verb == "Get" or not self.description.has_event_mode)

    def _complete(self, step: int, status: int | None) -> None:
        steps, start, size, end = self._steps, self._time_of(step), self._step_size, self._time_of(step + 1)
        if status is None:
            self._advance(end, lambda: steps.step(start, size, end))
        else:
            self._advance(end, lambda: steps.finish(status, start, size, end))

    def _advance(self, end: float, step: Callable[[], float]) -> None:
        """Take a step to ``end`` (s); ``step`` returns the time that it has reached."""
        time = self._checked(step)
        self._said.note(time=time)
        if resolvable(time, end):
            raise self._end_requested()

    def _set_discrete(self, slot: int) -> None:
        """In event mode: set the inputs that change in event mode only, if they did change."""
        arrays = [part.array for part in self._discrete]
        row = tuple(a[slot].tolist() if a.dtype.hasobject else a[slot].tobytes() for a in arrays)
        if row == self._discrete_row or self._steps.terminated:
            return
        self._discrete_row = row
        set_row = self._set_row
        self._checked(lambda: self._steps.event(self._said.time, lambda: set_row(slot, self._discrete)))

    def _bookkeeping(self) -> Bookkeeping:
        next_event, event_time = self._steps.place
        ticks = self._steps.clocks.place
        return Bookkeeping(self._said.step, self._said.time, next_event, self._discrete_row, ticks, event_time)

    def _restore(self, kept: Bookkeeping) -> None:
        super()._restore(kept)
        self._said.note(time=kept.time or 0.0)
        self._discrete_row = kept.row
        self._steps.resume(kept.next_event, kept.last_event)
        self._steps.clocks.resume(kept.ticks)


class Fmi3Steps:
    """Steps of one instance: early return, event mode and clocks; it knows neither variables nor rings.

    ``fmu`` is FMPy's object, instantiated with event mode if the description has it; ``said`` what a step says besides
    its status. Up to its `quiet_until`, a step is a single call of fmi3DoStep, unless it says otherwise.

    Call sequence: `start` in Initialization Mode, `exit_initialization` after it, then `step`, and `event` wherever
    values are set in event mode. A caller that calls fmi3DoStep itself continues with `finish` if needed.

    Raises:
        FMICallException: by every method: the FMU did not return OK.
        SolverFailed: its events do not converge, or it makes no progress.
    """

    def __init__(self, fmu: Any, do_step: Function, description: ModelDescription, said: Said) -> None:  # noqa: ANN401 FMPy is untyped
        self.terminated = False  # whether the FMU has asked to end the simulation; no step may be taken then
        self.clocks = Clocks(fmu, description.clocks)
        self._fmu = fmu
        self._self = pointer(fmu.component)
        self._has_event_mode = description.has_event_mode
        self._varies = description.can_handle_variable_step_size
        self._do_step = do_step
        self._said = said
        self._results = [pointer(address) for address in said.addresses]
        self._next_event = math.inf
        self._event_time = -math.inf
        self._look_ahead()

    def start(self, time: float) -> None:
        """In Initialization Mode at ``time`` (s)."""
        if self.clocks:
            self.clocks.start(time)

    def exit_initialization(self, time: float) -> None:
        """After Initialization Mode at ``time`` (s): the first events, then step mode."""
        if self._has_event_mode:
            self._update(time)
            self._look_ahead()

    @property
    def place(self) -> tuple[float | None, float | None]:
        """The times of the next time event and of the last event mode in s; None where there is none."""
        next_event, event_time = (t if math.isfinite(t) else None for t in (self._next_event, self._event_time))
        return next_event, event_time

    def resume(self, next_event: float | None, event_time: float | None) -> None:
        """Continue where `place` was."""
        self.terminated = False
        self._next_event = math.inf if next_event is None else next_event
        self._event_time = -math.inf if event_time is None else event_time
        self._look_ahead()

    def event(self, time: float, set_values: Callable[[], None]) -> None:
        """Set values in event mode at ``time`` (s), or between two steps if the FMU has no event mode."""
        if not self._has_event_mode:
            set_values()
            return
        self._fmu.enterEventMode()
        set_values()
        self._update(time)
        self._look_ahead()

    def step(self, start: float, step_size: float, end: float) -> float:
        """Take the step from ``start`` by ``step_size`` to ``end`` (s); the time reached, if the FMU ends earlier."""
        status = None
        if self._said.quiet_until > end:
            status = self._attempt(start, step_size)
            if status <= WARNING and not self._said.anything:
                return end
        return self.finish(status, start, step_size, end)

    def finish(self, status: int | None, start: float, step_size: float, end: float) -> float:
        """As `step`, after fmi3DoStep from ``start`` by ``step_size`` (s) has returned ``status``; None: not called."""
        said = self._said
        time, largest, stuck = start, step_size, 0
        while not self.terminated and resolvable(time, end):
            if self._is_due(time):
                self._handle_event(time)
                continue
            target = self._target(time, min(end, time + largest))
            if status is None:
                whole = (time, target) == (start, end)
                status = self._attempt(time, step_size if whole else step_within(time, target - time, target))
            if status == DISCARD and self._varies and largest > step_size / SMALLEST:
                largest, status = largest / 2.0, None
                continue
            if status == DISCARD and largest < step_size:
                raise SolverFailed(f"fmi3DoStep returned discard down to 1/{SMALLEST} of the step")
            if status > WARNING:
                raise FMICallException(function="fmi3DoStep", status=status)
            status = None
            before, time = time, said.last_time if said.early else target
            stuck = 0 if time > before else stuck + 1
            if stuck > MOST_RETURNS:
                raise SolverFailed(f"fmi3DoStep returned early {MOST_RETURNS} times at t = {time:.12g} s")
            self.terminated = said.terminate
            if not self.terminated and (said.event_needed or self._is_due(time)):
                self._handle_event(time)
        self._look_ahead()
        return time

    def _look_ahead(self) -> None:
        self._said.note(quiet_until=-math.inf if self.terminated or self.clocks else self._next_event)

    def _attempt(self, time: float, size: float) -> int:
        self._said.clear()
        return self._do_step(self._self, time, size, True, *self._results)  # noqa: FBT003 a C function

    def _is_due(self, time: float) -> bool:
        """Whether event mode is needed at ``time`` (s).

        The time of the FMU may differ by rounding, so that it does not see its time event yet: we ask only once.
        """
        if not self._has_event_mode:
            return False
        return (self._next_event <= time and time > self._event_time) or not resolvable(time, self.clocks.next_tick)

    def _target(self, time: float, end: float) -> float:
        """The end of the next fmi3DoStep: an FMU with a fixed step size is never asked for another one."""
        if not (self._has_event_mode and self._varies):
            return end
        return min(t for t in (end, self._next_event, self.clocks.next_tick) if t > time)

    def _handle_event(self, time: float) -> None:
        self._fmu.enterEventMode()
        self._update(time)

    def _update(self, time: float) -> None:
        """In event mode at ``time`` (s): update the discrete states, then step mode."""
        self._event_time = time
        info = self.clocks.settle(time, lambda: updated(self._fmu))
        self.terminated = info.terminate
        if not self.terminated:
            self._next_event = info.next_event
            self._fmu.enterStepMode()
