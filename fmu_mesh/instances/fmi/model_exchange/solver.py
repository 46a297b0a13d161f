"""Solvers of ordinary differential equations that stop at state events: what steps a model-exchange FMU.

Owns the Protocols of equations and solvers, and a forward Euler for checks; CVode is in
`fmu_mesh.instances.fmi.model_exchange.cvode`. A solver knows nothing of FMI modes; the event iteration is
`fmu_mesh.instances.fmi.model_exchange.model_exchange`.
"""

from __future__ import annotations

import math
from typing import Any, Protocol

import numpy as np

from ....simtime import steps_between

__all__ = ["Equations", "EulerSolver", "NothingToSolve", "Solver", "SolverFailed", "resolvable"]


class Equations(Protocol):
    """The continuous part of a model. Arrays are given as addresses of float64 memory.

    Raises:
        FMICallException: by every method: the FMU did not return OK.
    """

    n_states: int
    n_indicators: int

    def set_point(self, time: float, states: int) -> None:
        """Put the model at a time in s and at these continuous states."""
        ...

    def get_states(self, states: int) -> None:
        """The continuous states that the model is at."""
        ...

    def get_nominals(self, nominals: int) -> None:
        """The nominal values of the continuous states."""
        ...

    def get_derivatives(self, derivatives: int) -> None:
        """The derivatives of the continuous states where the model is."""
        ...

    def get_indicators(self, indicators: int) -> None:
        """The event indicators where the model is."""
        ...


class Solver(Protocol):
    """Call sequence: `restart`, then `step` from where the last one ended; `restart` after every event; `close`."""

    def restart(self, time: float) -> None:
        """Begin anew at a time in s, at the states and nominal values of the model."""
        ...

    def step(self, time: float, stop: float) -> tuple[float, bool]:
        """One step from ``time`` to ``stop`` (s) at most: the time reached, and whether an event indicator crossed 0.

        The model is at that time and at its states afterwards.

        Raises:
            SolverFailed: the solver gave up; the text says why.
            FMICallException: the model could not be evaluated.
        """
        ...

    def close(self) -> None:
        """Free its memory."""
        ...


class SolverFailed(Exception):
    """The solver gave up; the text says why."""


def resolvable(time: float, stop: float) -> bool:
    """Whether ``stop`` is after ``time`` (both in s) by more than rounding.

    Time events and communication points are computed in different ways. So the same instant may have two values that
    differ in the last digits; there is nothing to integrate between them.
    """
    return math.isinf(stop) or stop - time > 8 * math.ulp(max(abs(time), abs(stop)))


class NothingToSolve:
    """For a model with neither continuous states nor event indicators."""

    def restart(self, time: float) -> None:
        """Nothing to do."""

    def step(self, time: float, stop: float) -> tuple[float, bool]:  # noqa: ARG002 the Protocol
        """Go to ``stop``; the model is put there by its event loop."""
        return stop, False

    def close(self) -> None:
        """Nothing to do."""


class EulerSolver:
    """Forward Euler; events are seen at the end of the step in which they happen.

    Args:
        equations: the model.
        maximum_step_size: in s; None: one step per communication step.
    """

    def __init__(self, equations: Equations, maximum_step_size: float | None) -> None:
        self._equations = equations
        self._maximum = maximum_step_size
        self._states = np.zeros(equations.n_states)
        self._derivatives = np.zeros(equations.n_states)
        self._indicators = np.zeros(equations.n_indicators)
        self._before = np.zeros(equations.n_indicators, dtype=bool)
        self._steps: list[float] = []

    def restart(self, time: float) -> None:  # noqa: ARG002 the Protocol
        """Take the states of the model."""
        if self._equations.n_states:
            self._equations.get_states(self._states.ctypes.data)
        self._before = self._above_zero()
        self._steps = []

    def step(self, time: float, stop: float) -> tuple[float, bool]:
        """See `Solver.step`."""
        if not self._steps or self._steps[0] != stop:
            self._steps = self._divided(time, stop)
        end = self._steps.pop()
        if self._equations.n_states:
            self._equations.get_derivatives(self._derivatives.ctypes.data)
            self._states += (end - time) * self._derivatives
        self._equations.set_point(end, self._states.ctypes.data)
        above = self._above_zero()
        crossed = bool((above != self._before).any())
        self._before = above
        return end, crossed

    def close(self) -> None:
        """Nothing to free."""

    def _divided(self, time: float, stop: float) -> list[float]:
        """The ends of equal steps, no longer than allowed, from ``time`` to ``stop``; the first is the last item."""
        if self._maximum is None:
            return [stop]
        whole = steps_between(time, stop, self._maximum)
        count = max(1, math.ceil((stop - time) / self._maximum) if whole is None else whole)
        return [stop, *(time + (stop - time) * (number / count) for number in range(count - 1, 0, -1))]

    def _above_zero(self) -> np.ndarray[Any, np.dtype[np.bool_]]:
        if self._equations.n_indicators:
            self._equations.get_indicators(self._indicators.ctypes.data)
        return self._indicators > 0.0
