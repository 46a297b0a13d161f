"""FMI 3.0 model exchange."""

from __future__ import annotations

from fmpy.fmi3 import FMU3Model

from ....variables.value_types import Value
from ..clocks import Clocks
from ..co_simulation.fmi3 import Fmi3Values
from .continuous import ContinuousInstance
from .model_calls import Fmi3Calls, ModelCalls

__all__ = ["Fmi3ModelInstance"]


class Fmi3ModelInstance(ContinuousInstance, Fmi3Values):
    """One instance of an FMI 3.0 FMU for model exchange (FMI 3.0, 3.2)."""

    _library = FMU3Model

    def _tolerance(self) -> float | None:
        return self._options.solver.relative_tolerance

    def _enter_initialization(self, start_time: float, stop_time: float | None, start_values: dict[str, Value]) -> None:
        super()._enter_initialization(start_time, stop_time, start_values)
        self._clocks = Clocks(self._fmu, self._description.clocks)
        self._clocks.start(start_time)

    def _exit_initialization(self) -> None:
        super()._exit_initialization()
        self._start_events(self._time_of_start)

    def _model_calls(self) -> ModelCalls:
        return Fmi3Calls(self._fmu)
