"""Model exchange made steppable: the algorithm between two communication points (FMI 2.0, 3.2; FMI 3.0, 3.2).

::

    until the end of the step:
        solve up to the end, the next time event or a zero crossing, one solver step at a time
        tell the FMU that the step is completed
        if a state, step or time event happened:
            event mode; update the discrete states until they converge; continuous-time mode
            the solver begins anew

Owns events and modes. It knows neither variables nor rings, and not which version of FMI it calls.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Final

from ..clocks import NO_CLOCKS, Clocks
from ..step_options import SolverSettings
from .model_calls import ModelCalls
from .solver import Equations, Solver, SolverFailed, make_solver, resolvable

__all__ = ["EventLoop"]

EVENT_ITERATIONS: Final = 1000
"""Event iterations, or events without any advance of time, after which a model is taken not to converge."""


class EventLoop:
    """One model between its communication points.

    Args:
        calls: the functions of the model.
        settings: of the solver.
        tell_completed_steps: whether the FMU wants to know of completed integrator steps.
        stop_time: what the FMU was told, in s; its time is never set to a later one.
        clocks: the clocks of the model, if it has some.

    Attributes:
        terminated: whether the FMU has asked to end the simulation; nothing may be advanced then.

    Call sequence: `start` in event mode, then `advance`, and `event` wherever values are set in between; `close`.

    Raises:
        FMICallException: by every method: the FMU did not return OK.
        SolverFailed: the solver gave up, or the events do not converge.
    """

    def __init__(
        self,
        calls: ModelCalls,
        settings: SolverSettings,
        *,
        tell_completed_steps: bool,
        stop_time: float = math.inf,
        clocks: Clocks | None = None,
    ) -> None:
        self.terminated = False
        self._clocks = clocks if clocks is not None else NO_CLOCKS
        self._calls = calls
        self._tell = tell_completed_steps
        self._stop_time = stop_time
        self._time = 0.0
        self._next_event = math.inf
        self._event_time = -math.inf
        self._events_there = 0
        self.extrapolate: Callable[[float], None] | None = None
        self._solver: Solver = make_solver(
            settings.name, _Extrapolated(self, calls), settings.relative_tolerance, settings.maximum_step_size
        )

    def start(self, time: float) -> None:
        """Handle the first event at ``time`` (s), in event mode after Initialization Mode."""
        self._time = time
        self._update()

    def event(self, set_values: Callable[[], None]) -> None:
        """Set values in event mode, where the model is, and handle what follows from them."""
        self._calls.enter_event_mode()
        set_values()
        self._update()

    def advance(self, end: float) -> bool:
        """Go on to the time ``end`` in s; False if the FMU asked to end the simulation before."""
        while resolvable(self._time, end):
            self._advance_once(end)
            if self.terminated:
                return not resolvable(self._time, end)
        return True

    @property
    def place(self) -> tuple[float, float]:
        """The time where the model is, and that of its next time event, in s."""
        return self._time, self._next_event

    def resume(self, time: float, next_event: float) -> None:
        """Go on where `place` was, in continuous-time mode; the solver begins anew."""
        self.terminated = False
        self._time, self._next_event = time, next_event
        self._solver.restart(time)

    def close(self) -> None:
        """Free the solver."""
        self._solver.close()

    def _advance_once(self, end: float) -> None:
        """One solver step, and the events at its end."""
        target = min(end, self._next_event)
        event = False
        if resolvable(self._time, target):
            self._time, event = self._solver.step(self._time, target)
            if self._calls.n_states == 0:
                self._calls.set_time(self._time)
            if self._tell:
                step_event, self.terminated = self._calls.completed_step()
                event = event or step_event
        if not resolvable(self._time, self._next_event):
            event = True
            if self._next_event > self._time:  # by rounding: the model has to see that its time has come
                self._time = min(self._next_event, self._stop_time)
                self._calls.set_time(self._time)
        if event and not self.terminated:
            self._count_events()
            self._calls.enter_event_mode()
            self._update()

    def _count_events(self) -> None:
        self._events_there = self._events_there + 1 if self._time == self._event_time else 0
        self._event_time = self._time
        if self._events_there > EVENT_ITERATIONS:
            raise SolverFailed(
                f"more than {EVENT_ITERATIONS} events at t = {self._time:.12g} s, and time does not advance"
            )

    def _update(self) -> None:
        """The event iteration, in event mode, and back to continuous-time mode."""
        self._clocks.set_due(self._time)
        self.terminated, next_event = self._iterate()
        if not self.terminated:
            self._clocks.update_intervals(self._time)
            self._next_event = min(next_event, self._clocks.next_tick)
            self._calls.enter_continuous_time_mode()
            self._solver.restart(self._time)

    def _iterate(self) -> tuple[bool, float]:
        """Update the discrete states until they need no update; whether the FMU asks to end, and its next time event.

        Raises:
            SolverFailed: they need updates for ever.
        """
        for _ in range(EVENT_ITERATIONS):
            info = self._calls.update_discrete_states()
            self._clocks.read()
            if info.terminate or not info.again:
                return info.terminate, info.next_event
        raise SolverFailed(f"the discrete states at t = {self._time:.12g} s need more than {EVENT_ITERATIONS} updates")


class _Extrapolated:
    """The equations of a model whose inputs are functions of time within a communication step."""

    def __init__(self, loop: EventLoop, calls: ModelCalls) -> None:
        self.n_states = calls.n_states
        self.n_indicators = calls.n_indicators
        self._loop = loop
        self._calls = calls
        self.get_states = calls.get_states
        self.get_nominals = calls.get_nominals
        self.get_derivatives = calls.get_derivatives
        self.get_indicators = calls.get_indicators

    def set_point(self, time: float, states: int) -> None:
        """See `Equations.set_point`."""
        self._calls.set_point(time, states)
        if self._loop.extrapolate is not None:
            self._loop.extrapolate(time)


_checked: type[Equations] = _Extrapolated
