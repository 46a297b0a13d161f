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

from ..model.description import ModelDescription
from .clocks import Clocks
from .solver import SolverFailed, resolvable
from .substeps import DISCARD, SMALLEST

__all__ = ["Fmi3Steps"]

WARNING: Final = 1
MOST_RETURNS: Final = 1000
"""Returns of fmi3DoStep or events, without any advance of time, after which an FMU is taken to be stuck."""

_DO_STEP = ctypes.CFUNCTYPE(
    ctypes.c_int,
    ctypes.c_void_p,
    ctypes.c_double,
    ctypes.c_double,
    ctypes.c_bool,
    ctypes.c_void_p,
    ctypes.c_void_p,
    ctypes.c_void_p,
    ctypes.c_void_p,
)


class Fmi3Steps:
    """Steps of one instance.

    Args:
        fmu: FMPy's object, instantiated with event mode if the description has it.
        description: its model description.

    Attributes:
        terminated: whether the FMU has asked to end the simulation; no step may be taken then.
        clocks: its clocks.

    Call sequence: `start` in Initialization Mode, `exit_initialization` after it, then `step`, and `event` wherever
    values are set in event mode.

    Raises:
        FMICallException: by every method: the FMU did not return OK.
        SolverFailed: its events do not converge, or it makes no progress.
    """

    def __init__(self, fmu: Any, description: ModelDescription) -> None:  # noqa: ANN401 FMPy is untyped
        self.terminated = False
        self.clocks = Clocks(fmu, description.clocks)
        self._fmu = fmu
        self._component = fmu.component
        self._has_event_mode = description.has_event_mode
        self._varies = description.can_handle_variable_step_size
        self._do_step = _DO_STEP(("fmi3DoStep", fmu.dll))
        self._event_needed, self._terminate, self._early = (ctypes.c_bool() for _ in range(3))
        self._last_time = ctypes.c_double()
        results = (self._event_needed, self._terminate, self._early, self._last_time)
        self._results = [ctypes.addressof(result) for result in results]
        self._time = 0.0
        self._next_event = math.inf
        self._event_time = -math.inf

    def start(self, time: float) -> None:
        """In Initialization Mode at ``time`` (s)."""
        self._time = time
        if self.clocks:
            self.clocks.start(time)

    def exit_initialization(self) -> None:
        """After Initialization Mode: the first events, then step mode."""
        if self._has_event_mode:
            self._update()

    @property
    def place(self) -> tuple[float | None, float | None]:
        """The times of the next time event and of the last event mode in s; None where there is none."""
        next_event, event_time = (t if math.isfinite(t) else None for t in (self._next_event, self._event_time))
        return next_event, event_time

    def resume(self, next_event: float | None, event_time: float | None) -> None:
        """Go on where `place` was."""
        self.terminated = False
        self._next_event = math.inf if next_event is None else next_event
        self._event_time = -math.inf if event_time is None else event_time

    def event(self, set_values: Callable[[], None]) -> None:
        """Set values in event mode, or between two steps if there is none."""
        if not self._has_event_mode:
            set_values()
            return
        self._fmu.enterEventMode()
        set_values()
        self._update()

    def step(self, start: float, step_size: float, end: float) -> bool:
        """Go on from ``start`` by ``step_size`` to ``end`` (s); False if the FMU asked to end the simulation before."""
        time, largest, stuck = start, step_size, 0
        self._time = start
        while not self.terminated and resolvable(time, end):
            if self._is_due(time):
                self._handle_event()
                continue
            target = self._target(time, min(end, time + largest))
            status = self._attempt(time, step_size if (time, target) == (start, end) else target - time)
            if status == DISCARD and self._varies and largest > step_size / SMALLEST:
                largest /= 2.0
                continue
            self._check(status, retried=largest < step_size)
            before, time = time, self._last_time.value if self._early.value else target
            stuck = 0 if time > before else stuck + 1
            if stuck > MOST_RETURNS:
                raise SolverFailed(f"fmi3DoStep returned early {MOST_RETURNS} times at t = {time:.12g} s")
            self._time = time
            self.terminated = self._terminate.value
            if not self.terminated and (self._event_needed.value or self._is_due(time)):
                self._handle_event()
        return not resolvable(time, end)

    def _attempt(self, time: float, size: float) -> int:
        self._event_needed.value = self._terminate.value = self._early.value = False
        status: int = self._do_step(self._component, time, size, True, *self._results)  # noqa: FBT003 a C function
        return status

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
        self._event_time = self._time
        self.clocks.set_due(self._time)
        for _ in range(MOST_RETURNS):
            again, self.terminated, _nominals, _states, defined, next_event = self._fmu.updateDiscreteStates()
            self.clocks.read()
            if self.terminated:
                return
            if not again:
                break
        else:
            raise SolverFailed(f"the discrete states at t = {self._time:.12g} s need more than {MOST_RETURNS} updates")
        self._next_event = next_event if defined else math.inf
        self.clocks.update_intervals(self._time)
        self._fmu.enterStepMode()
