"""FMI 3.0 model exchange."""

from __future__ import annotations

from typing import Any

from fmpy.fmi3 import FMU3Model

from .continuous import ContinuousInstance
from .fmi3 import Fmi3Instance
from .model_calls import Fmi3Calls, ModelCalls

__all__ = ["Fmi3ModelInstance"]


class Fmi3ModelInstance(ContinuousInstance, Fmi3Instance):
    """One instance of an FMI 3.0 FMU for model exchange (FMI 3.0, 3.2)."""

    _library: type[Any] = FMU3Model

    def _how(self) -> dict[str, Any]:
        return {}

    def _tolerance(self) -> float | None:
        return self._options.solver.relative_tolerance

    def _initialized(self) -> None:
        """Its events are those of the event loop."""

    def _first_events(self) -> None:
        self._start_events(self._time_of_start)

    def _model_calls(self) -> ModelCalls:
        return Fmi3Calls(self._fmu)
