"""FMI 2.0 model exchange."""

from __future__ import annotations

from fmpy.fmi2 import FMU2Model

from ....variables.value_types import Value
from ..co_simulation.fmi2 import Fmi2Values
from .continuous import ContinuousInstance
from .model_calls import ModelCalls

__all__ = ["Fmi2ModelInstance"]


class Fmi2ModelInstance(ContinuousInstance, Fmi2Values):
    """One instance of an FMI 2.0 FMU for model exchange (FMI 2.0, 3.2)."""

    _library = FMU2Model

    def _enter_initialization(self, start_time: float, stop_time: float | None, start_values: dict[str, Value]) -> None:
        self._time_of_start = start_time
        super()._enter_initialization(start_time, stop_time, start_values)

    def _exit_initialization(self) -> None:
        super()._exit_initialization()
        self._start_events(self._time_of_start)

    def _tolerance(self) -> float | None:
        return self._options.solver.relative_tolerance

    def _model_calls(self) -> ModelCalls:
        return ModelCalls(self._fmu, self._description.continuous_states, self._description.event_indicators, "fmi2")
