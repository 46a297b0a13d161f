"""Model exchange made steppable: the algorithm between two communication points (FMI 2.0, 3.2; FMI 3.0, 3.2).

::

    until the end of the step:
        solve up to the end, the next time event or a zero crossing, one solver step at a time
        tell the FMU that the step is completed
        if a state, step or time event happened:
            event mode; update the discrete states until they converge; continuous-time mode
            the solver starts anew

Owns events and modes. It knows neither variables nor rings, nor the version of FMI.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from ....rings import native
from ....simtime import resolvable
from ..clocks import EVENT_ITERATIONS, NO_CLOCKS, Clocks
from ..fmu_values import SolverFailed
from ..step_options import SolverSettings
from .dormand_prince import AutoSolver, DormandPrinceSolver
from .model_calls import InputLine, ModelCalls
from .solver import CVodeSolver, EulerSolver, Solver

__all__ = ["EventLoop"]


class EventLoop:
    """One model between its communication points.

    The time of the FMU is never set to a later one than ``stop_time`` (s). It is told of completed integrator steps if
    it needs that.

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
        clocks: Clocks = NO_CLOCKS,
    ) -> None:
        self._clocks = clocks
        self._calls = calls
        self._tell = tell_completed_steps
        self._stop_time = stop_time
        self._event_time = -math.inf
        self._events_there = 0
        self.solver = _solver_for(settings, calls, tells=tell_completed_steps)
        self._at = self.solver.at

    def start(self, time: float) -> None:
        """Handle the first event at ``time`` (s), in event mode after Initialization Mode."""
        self._at.note(time=time)
        self._update()

    def event(self, set_values: Callable[[], None]) -> None:
        """Set values in event mode, where the model is, and handle what follows from them."""
        self._calls.enter_event_mode()
        set_values()
        self._update()

    def set_inputs(self, set_values: Callable[[], None], line: InputLine | None) -> None:
        """Set inputs as an `event` at the start of a step.

        ``line`` sets the inputs that change within the step, at a time in s; None if all are constant.
        """
        self._calls.follow(None)
        self.event(set_values)
        self._calls.follow(line)

    def follow(self, line: InputLine) -> None:
        """Continue with inputs that change continuously: no event, and the solver goes on (FMI 2.0, 3.2.1).

        If the small jump of an extrapolated input takes an event indicator over 0, that is an `event`.
        """
        above = self._above_zero()
        line(self._at.time)
        if self._above_zero() == above:
            self._calls.follow(line)
        else:
            self.set_inputs(lambda: line(self._at.time), line)

    def advance(self, end: float) -> bool:
        """Advance to the time ``end`` in s; False if the FMU asked to end the simulation before."""
        while resolvable(self._at.time, end):
            self._advance_once(end)
            if self.terminated:
                return not resolvable(self._at.time, end)
        return True

    def go_on(self, end: float, *, asks_event: bool, asks_end: bool) -> bool:
        """As `advance`, after the library has taken the model to where it is, and what was asked for there."""
        self._at.note(terminated=asks_end)
        if asks_event and not asks_end:
            self._handle_event()
        return not resolvable(self._at.time, end) if self.terminated else self.advance(end)

    @property
    def terminated(self) -> bool:
        """Whether the FMU has asked to end the simulation; nothing may be advanced then."""
        return bool(self._at.terminated)

    @property
    def place(self) -> tuple[float, float]:
        """The time where the model is, and that of its next time event, in s."""
        return self._at.time, self._at.next_event

    def resume(self, time: float, next_event: float) -> None:
        """Continue where `place` was, in continuous-time mode; the solver starts anew."""
        self._calls.follow(None)
        self._at.note(time=time, next_event=next_event, terminated=False)
        self.restart()

    def restart(self) -> None:
        """Let the solver start anew here."""
        self.solver.restart()

    def close(self) -> None:
        """Free the solver."""
        self.solver.close()

    def _advance_once(self, end: float) -> None:
        """One solver step, and the events at its end."""
        target = min(end, self._at.next_event)
        event = False
        if resolvable(self._at.time, target):
            time, event = self.solver.step(self._at.time, target)
            self._at.note(time=time)
            if self._calls.n_states == 0:
                self._calls.set_time(self._at.time)
            if self._tell:
                step_event, ends = self.solver.complete()
                self._at.note(terminated=ends)
                event = event or step_event
        if not resolvable(self._at.time, self._at.next_event):
            event = True
            if self._at.next_event > self._at.time:  # only by rounding: let the model see the time of its event
                self._at.note(time=min(self._at.next_event, self._stop_time))
                self._calls.set_time(self._at.time)
        if event and not self.terminated:
            self._handle_event()

    def _handle_event(self) -> None:
        self._count_events()
        self._calls.enter_event_mode()
        self._update()

    def _above_zero(self) -> list[bool]:
        """Whether each event indicator is above 0."""
        indicators = np.zeros(self._calls.n_indicators)
        if indicators.size:
            self._calls.get_indicators(indicators.ctypes.data)
        return [*(indicators > 0.0)]

    def _count_events(self) -> None:
        self._events_there = self._events_there + 1 if self._at.time == self._event_time else 0
        self._event_time = self._at.time
        if self._events_there > EVENT_ITERATIONS:
            raise SolverFailed(
                f"more than {EVENT_ITERATIONS} events at t = {self._at.time:.12g} s, and time does not advance"
            )

    def _update(self) -> None:
        """The event iteration, in event mode, and back to continuous-time mode."""
        info = self._clocks.settle(self._at.time, self._calls.update_discrete_states)
        self._at.note(terminated=info.terminate)
        if not self.terminated:
            self._at.note(next_event=min(info.next_event, self._clocks.next_tick))
            self._calls.enter_continuous_time_mode()
            self.solver.restart()


def _solver_for(settings: SolverSettings, equations: ModelCalls, *, tells: bool) -> Solver:
    """The solver for these settings; one that does nothing for a model without states and event indicators."""
    if settings.name == "dopri5":
        return DormandPrinceSolver(equations, settings, tells=tells)
    if settings.name == "auto" and native.library is not None:
        return AutoSolver(equations, settings, tells=tells)
    if equations.n_states == 0 and equations.n_indicators == 0:
        return Solver(equations)
    if settings.name == "euler":
        return EulerSolver(equations, settings.maximum_step_size)
    return CVodeSolver(equations, settings.relative_tolerance, settings.maximum_step_size)
