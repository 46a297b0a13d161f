"""Steps of an FMI 2.0 co-simulation FMU that are tried again in smaller ones after `fmi2Discard`.

Owns the FMU state that is kept for it; when a step is retried is decided by the configuration.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from typing import Any, Final

from fmpy.fmi1 import FMICallException

from ..calls import Function, Pointer
from ..fmu_instance import STATUS_NAMES
from .step_status import PENDING
from .substeps import DISCARD, take_sub_steps

__all__ = ["RetriedSteps"]

_ENDS: Final = 6
"""Stands for the status of a step that was a wish to end the simulation."""


class RetriedSteps:
    """fmi2DoStep that goes back to where a discarded step began, and takes smaller ones.

    After fmi2Discard, only fmi2SetFMUstate leads on (FMI 2.0, 4.2.4), so the state is kept before every step.

    Attributes:
        ends: whether the last discarded step was a wish to end the simulation.
    """

    def __init__(
        self,
        fmu: Any,  # noqa: ANN401 FMPy is untyped
        do_step: Function,
        waited: Callable[[], int],
        asks_to_end: Callable[[], bool],
        failed: Callable[[str], Exception],
    ) -> None:
        self.ends = False
        self._fmu = fmu
        self._do_step = do_step
        self._waited = waited
        self._asks_to_end = asks_to_end
        self._failed = failed
        self._state = ctypes.c_void_p()

    def __call__(self, component: Pointer, time: float, step_size: float, _no_set_state: int) -> int:
        """As fmi2DoStep; a step that is discarded is taken in smaller ones."""

        def attempt(start: float, size: float) -> int:
            self._fmu.fmi2GetFMUstate(self._fmu.component, ctypes.byref(self._state))
            status = self._do_step(component, start, size, 0)
            if status == PENDING:
                status = self._waited()
            if status == DISCARD:
                self.ends = self._asks_to_end()
                if self.ends:
                    return _ENDS
                self._fmu.fmi2SetFMUstate(self._fmu.component, self._state)
            return status

        try:
            status = attempt(time, step_size)
            if status == DISCARD:
                status = take_sub_steps(attempt, time, step_size)
        except FMICallException as error:
            raise self._failed(f"{error.function} returned {STATUS_NAMES[error.status]}") from error
        return DISCARD if self.ends else status

    def free(self) -> None:
        """Free the state that was kept."""
        if self._state.value is not None:
            self._fmu.fmi2FreeFMUstate(self._fmu.component, ctypes.byref(self._state))
