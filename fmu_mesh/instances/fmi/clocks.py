"""Clocks of an FMI 3.0 instance: when its time-based input clocks tick, and which of its output clocks have ticked.

Owns the arithmetic of intervals (FMI 3.0, 2.2.8): tick n of a periodic clock is at `start + shift + n * interval`, one
multiplication. The caller enters and leaves event mode.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, Final, NamedTuple

from fmpy.fmi3 import fmi3Float64, fmi3IntervalQualifier, fmi3ValueReference

from ...simtime import resolvable
from ...variables.model_description import Clock
from .fmu_values import SolverFailed

__all__ = ["EVENT_ITERATIONS", "NO_CLOCKS", "Clocks", "EventInfo", "unsettled", "updated"]

EVENT_ITERATIONS: Final = 1000
"""After this many event iterations, or events at the same time, a model does not converge."""

_INTERVAL_CHANGED: Final = 2
_PERIODIC: Final = ("constant", "fixed", "tunable")
_APERIODIC: Final = ("changing", "countdown")


class EventInfo(NamedTuple):
    """What one event iteration returns (FMI 2.0, 3.2.2: fmi2EventInfo)."""

    again: bool  # the iteration has not converged yet
    terminate: bool  # the FMU asks to end the simulation
    next_event: float  # time of the next time event in s; infinite if there is none


def updated(fmu: Any) -> EventInfo:  # noqa: ANN401 FMPy is untyped
    """One event iteration of FMI 3.0 (fmi3UpdateDiscreteStates)."""
    again, terminate, _nominals, _states, defined, time = fmu.updateDiscreteStates()
    return EventInfo(bool(again), bool(terminate), float(time) if defined else math.inf)


def unsettled(time: float) -> str:
    """Why event mode at ``time`` (s) has no end, in words."""
    return f"the discrete states at t = {time:.12g} s need more than {EVENT_ITERATIONS} updates"


class Clocks:
    """The clocks of one instance.

    Call sequence: `start` in Initialization Mode; then `settle` in every event mode. Each raises `FMICallException` if
    the FMU does not return OK.
    """

    def __init__(self, fmu: Any, clocks: Sequence[Clock]) -> None:  # noqa: ANN401 FMPy is untyped
        inputs = [clock for clock in clocks if clock.causality == "input"]
        self.next_tick = math.inf  # of an input clock in s; infinite if there is none
        self.ticked: set[str] = set()  # the output clocks that have ticked since this was last emptied
        self._fmu = fmu
        self._periodic = [clock for clock in inputs if clock.interval_variability in _PERIODIC]
        self._ticks = [0] * len(self._periodic)  # of each, so far
        self._first_and_interval = [(0.0, math.inf)] * len(self._periodic)  # of each: the time of tick 0, both in s
        self._aperiodic = {
            clock.value_reference: math.inf for clock in inputs if clock.interval_variability in _APERIODIC
        }
        self._outputs = [clock for clock in clocks if clock.causality == "output"]

    def __bool__(self) -> bool:
        """Whether there is any clock."""
        return bool(self._periodic or self._aperiodic or self._outputs)

    def start(self, time: float) -> None:
        """In Initialization Mode at ``time`` (s): ask for the intervals that depend on parameters."""
        for number, clock in enumerate(self._periodic):
            interval, shift = clock.interval or math.inf, clock.shift
            if clock.interval is None:
                shifts = (fmi3Float64 * 1)()
                interval, _ = self._interval(clock.value_reference)
                self._fmu.getShiftDecimal(_references(clock.value_reference), shifts)
                shift = float(shifts[0])
            self._first_and_interval[number] = time + shift, interval
        self._find_next()

    @property
    def place(self) -> tuple[float | None, ...]:
        """The ticks of each periodic clock, then the next tick of each aperiodic one in s; None if it has none."""
        aperiodic = (tick if math.isfinite(tick) else None for tick in self._aperiodic.values())
        return (*map(float, self._ticks), *aperiodic)

    def resume(self, place: Sequence[float | None]) -> None:
        """Continue where `place` was."""
        self._ticks = [int(ticks or 0) for ticks in place[: len(self._periodic)]]
        for reference, tick in zip(self._aperiodic, place[len(self._periodic) :], strict=True):
            self._aperiodic[reference] = math.inf if tick is None else tick
        self._find_next()

    def settle(self, time: float, update: Callable[[], EventInfo]) -> EventInfo:
        """In event mode at ``time`` (s): let clocks tick, and ``update`` the discrete states until they are settled."""
        self._set_due(time)
        for _ in range(EVENT_ITERATIONS):
            info = update()
            self._read()
            if info.terminate:
                return info
            if not info.again:
                self._update_intervals(time)
                return info
        raise SolverFailed(unsettled(time))

    def _set_due(self, time: float) -> None:
        """Activate every input clock whose tick is at ``time`` (s)."""
        due = []
        for number, tick in enumerate(self._next_ticks()):
            if not resolvable(time, tick):
                due.append(self._periodic[number].value_reference)
                self._ticks[number] += 1
        for reference, tick in self._aperiodic.items():
            if not resolvable(time, tick):
                due.append(reference)
                self._aperiodic[reference] = math.inf
        if due:
            self._fmu.setClock(due, [True] * len(due))
        self._find_next()

    def _read(self) -> None:
        """Note which output clocks tick (FMI 3.0, 2.2.8.3)."""
        if self._outputs:
            active = self._fmu.getClock([clock.value_reference for clock in self._outputs])
            self.ticked.update(clock.name for clock, ticks in zip(self._outputs, active, strict=True) if ticks)

    def _update_intervals(self, time: float) -> None:
        """At the end of event mode: ask when aperiodic clocks tick next (FMI 3.0, 2.2.8.4)."""
        for reference in self._aperiodic:
            interval, qualifier = self._interval(reference)
            if qualifier == _INTERVAL_CHANGED:
                self._aperiodic[reference] = time + interval
        self._find_next()

    def _interval(self, reference: int) -> tuple[float, int]:
        intervals, qualifiers = (fmi3Float64 * 1)(), (fmi3IntervalQualifier * 1)()
        self._fmu.getIntervalDecimal(_references(reference), intervals, qualifiers)
        return float(intervals[0]), int(qualifiers[0])

    def _next_ticks(self) -> list[float]:
        """The times of the next ticks of the periodic clocks in s."""
        pairs = zip(self._ticks, self._first_and_interval, strict=True)
        return [first + ticks * interval for ticks, (first, interval) in pairs]

    def _find_next(self) -> None:
        self.next_tick = min((*self._next_ticks(), *self._aperiodic.values()), default=math.inf)


NO_CLOCKS: Final = Clocks(None, ())
"""For an FMU without clocks; it never calls the FMU."""


def _references(reference: int) -> Any:  # noqa: ANN401 an array of ctypes
    return (fmi3ValueReference * 1)(reference)
