"""One communication step of an FMI 3.0 co-simulation FMU, with all that can happen in it (FMI 3.0, 4.2.1).

::

    until the end of the step:
        fmi3DoStep to the end, the next time event or the next tick of a clock
        discarded: again with half of it
        an event, or its time has come: event mode; update the discrete states; step mode

So the communication points of the mesh stay where they are; only the FMU sees more of them. Owns event mode and early
return of co-simulation; it knows neither variables nor rings.
"""

from __future__ import annotations

import ctypes
import math
from collections.abc import Callable
from typing import Any, Final

from fmpy.fmi1 import FMICallException

from ....simtime import step_within
from ....variables.model_description import ModelDescription
from ..calls import hot, pointer
from ..clocks import Clocks
from ..model_exchange.solver import SolverFailed, resolvable
from .fused import Step, fmi3_step
from .substeps import DISCARD, SMALLEST

__all__ = ["Fmi3Steps"]

WARNING: Final = 1
MOST_RETURNS: Final = 1000
"""Returns of fmi3DoStep or events, without any advance of time, after which an FMU is taken to be stuck."""

_DO_STEP = "int (*)(void *, double, double, _Bool, void *, void *, void *, void *)"


class Fmi3Steps:
    """Steps of one instance.

    Args:
        fmu: FMPy's object, instantiated with event mode if the description has it.
        description: its model description.

    Attributes:
        terminated: whether the FMU has asked to end the simulation; no step may be taken then.
        clocks: its clocks.
        time: where the FMU is in s.
        quiet_until: up to this time in s, a step is one call of fmi3DoStep, unless that says otherwise.

    Call sequence: `start` in Initialization Mode, `exit_initialization` after it, then `step`, and `event` wherever
    values are set in event mode. Instead of `step`, who calls fmi3DoStep (`fuse`) goes on with `finish` where needed.

    Raises:
        FMICallException: by every method: the FMU did not return OK.
        SolverFailed: its events do not converge, or it makes no progress.
    """

    def __init__(self, fmu: Any, description: ModelDescription) -> None:  # noqa: ANN401 FMPy is untyped
        self.terminated = False
        self.clocks = Clocks(fmu, description.clocks)
        self._fmu = fmu
        self._self = pointer(fmu.component)
        self._has_event_mode = description.has_event_mode
        self._varies = description.can_handle_variable_step_size
        self._do_step = hot(fmu.dll.fmi3DoStep, _DO_STEP)
        self._results = _Results()
        self._pointers = [pointer(address) for address in self._results.addresses]
        self.time = 0.0
        self._next_event = math.inf
        self._event_time = -math.inf
        self._look_ahead()

    def start(self, time: float) -> None:
        """In Initialization Mode at ``time`` (s)."""
        self.time = time
        if self.clocks:
            self.clocks.start(time)

    def exit_initialization(self) -> None:
        """After Initialization Mode: the first events, then step mode."""
        if self._has_event_mode:
            self._update()
            self._look_ahead()

    @property
    def place(self) -> tuple[float | None, float | None]:
        """The times of the next time event and of the last event mode in s; None where there is none."""
        next_event, event_time = (t if math.isfinite(t) else None for t in (self._next_event, self._event_time))
        return next_event, event_time

    def resume(self, time: float, next_event: float | None, event_time: float | None) -> None:
        """Go on at ``time`` (s), where `place` was."""
        self.terminated = False
        self.time = time
        self._next_event = math.inf if next_event is None else next_event
        self._event_time = -math.inf if event_time is None else event_time
        self._look_ahead()

    def event(self, set_values: Callable[[], None]) -> None:
        """Set values in event mode, or between two steps if there is none."""
        if not self._has_event_mode:
            set_values()
            return
        self._fmu.enterEventMode()
        set_values()
        self._update()
        self._look_ahead()

    def fused(self, step_size: float) -> Step:
        """fmi3DoStep by ``step_size`` (s) as a part of one compiled call."""
        return fmi3_step(self._do_step, step_size, self._pointers, self._results.addresses[0])

    def step(self, start: float, step_size: float, end: float) -> bool:
        """Go on from ``start`` by ``step_size`` to ``end`` (s); False if the FMU asked to end the simulation before."""
        status = None
        if self.quiet_until > end:
            status = self._attempt(start, step_size)
            if status <= WARNING and not self._results.any[0]:  # the step was nothing but a step
                self.time = end
                return True
        return self.finish(status, start, step_size, end)

    def finish(self, status: int | None, start: float, step_size: float, end: float) -> bool:
        """As `step`, where fmi3DoStep from ``start`` by ``step_size`` (s) has returned ``status`` already, if any."""
        results = self._results
        time, largest, stuck = start, step_size, 0
        self.time = start
        while not self.terminated and resolvable(time, end):
            if self._is_due(time):
                self._handle_event()
                continue
            target = self._target(time, min(end, time + largest))
            if status is None:
                whole = (time, target) == (start, end)
                status = self._attempt(time, step_size if whole else step_within(time, target - time, target))
            if status == DISCARD and self._varies and largest > step_size / SMALLEST:
                largest, status = largest / 2.0, None
                continue
            self._check(status, retried=largest < step_size)
            status = None
            before, time = time, results.last_time.value if results.early else target
            stuck = 0 if time > before else stuck + 1
            if stuck > MOST_RETURNS:
                raise SolverFailed(f"fmi3DoStep returned early {MOST_RETURNS} times at t = {time:.12g} s")
            self.time = time
            self.terminated = results.terminate
            if not self.terminated and (results.event_needed or self._is_due(time)):
                self._handle_event()
        self._look_ahead()
        return not resolvable(time, end)

    def _look_ahead(self) -> None:
        self.quiet_until = -math.inf if self.terminated or self.clocks else self._next_event

    def _attempt(self, time: float, size: float) -> int:
        self._results.any[0] = 0
        return self._do_step(self._self, time, size, True, *self._pointers)  # noqa: FBT003 a C function

    def _check(self, status: int, *, retried: bool) -> None:
        if status == DISCARD and retried:
            raise SolverFailed(f"fmi3DoStep returned discard down to 1/{SMALLEST} of the step")
        if status > WARNING:
            raise FMICallException(function="fmi3DoStep", status=status)

    def _is_due(self, time: float) -> bool:
        """Whether event mode is needed at ``time`` (s).

        An FMU whose own time differs by rounding may not see its time event yet: then it is not asked a second time.
        """
        if not self._has_event_mode:
            return False
        return (self._next_event <= time and time > self._event_time) or not resolvable(time, self.clocks.next_tick)

    def _target(self, time: float, end: float) -> float:
        """Where the next fmi3DoStep ends: an FMU with a fixed step size is not asked for another one."""
        if not (self._has_event_mode and self._varies):
            return end
        return min(t for t in (end, self._next_event, self.clocks.next_tick) if t > time)

    def _handle_event(self) -> None:
        self._fmu.enterEventMode()
        self._update()

    def _update(self) -> None:
        """Event mode at the current time, and back to step mode."""
        self._event_time = self.time
        self.clocks.set_due(self.time)
        for _ in range(MOST_RETURNS):
            again, self.terminated, _nominals, _states, defined, next_event = self._fmu.updateDiscreteStates()
            self.clocks.read()
            if self.terminated:
                return
            if not again:
                break
        else:
            raise SolverFailed(f"the discrete states at t = {self.time:.12g} s need more than {MOST_RETURNS} updates")
        self._next_event = next_event if defined else math.inf
        self.clocks.update_intervals(self.time)
        self._fmu.enterStepMode()


class _Results:
    """What fmi3DoStep says besides its status (FMI 3.0, 4.2.1).

    Attributes:
        any: the flags as one number, which is 0 if none is set; one look instead of three.
        last_time: how far an early return has come, in s.
        addresses: of eventHandlingNeeded, terminateSimulation, earlyReturn and lastSuccessfulTime.
    """

    def __init__(self) -> None:
        self._flags = (ctypes.c_bool * 4)()
        self.any = memoryview(self._flags).cast("B").cast("I")
        self.last_time = ctypes.c_double()
        first = ctypes.addressof(self._flags)
        self.addresses = (first, first + 1, first + 2, ctypes.addressof(self.last_time))

    @property
    def event_needed(self) -> bool:
        """The FMU has an event to be handled."""
        return self._flags[0]

    @property
    def terminate(self) -> bool:
        """The FMU asks to end the simulation."""
        return self._flags[1]

    @property
    def early(self) -> bool:
        """The FMU has returned before the end of the step."""
        return self._flags[2]
