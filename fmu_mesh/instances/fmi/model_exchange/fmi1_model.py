"""FMI 1.0 model exchange.

FMI 1.0 has no Initialization Mode: values are set, then `fmiInitialize` computes the rest (FMI 1.0, 2.8). Outputs that
a connection needs before are read after it, and inputs that become known later are set as at any other event.
"""

from __future__ import annotations

from pathlib import Path

from fmpy.fmi1 import FMU1Model

from ....variables.value_types import Value
from ..callbacks import FMI1_CALLBACKS, register, register_component
from ..co_simulation.fmi1 import Fmi1Instance
from .continuous import ContinuousInstance
from .model_calls import Fmi1Calls, ModelCalls

__all__ = ["Fmi1ModelInstance"]


class Fmi1ModelInstance(ContinuousInstance, Fmi1Instance):
    """One instance of an FMI 1.0 FMU for model exchange."""

    def _instantiate(self, folder: Path) -> None:
        register(self.name, self)
        self._initialized = False
        description = self._description
        self._fmu = FMU1Model(
            guid=description.guid,
            modelIdentifier=description.model_identifier,
            unzipDirectory=str(folder),
            instanceName=self.name,
        )
        self._fmu.instantiate(functions=FMI1_CALLBACKS, loggingOn=False)
        self._component = self._fmu.component
        register_component(self._component, self)
        self._calls = Fmi1Calls(self._fmu, description.continuous_states, description.event_indicators)

    def _enter_initialization(self, start_time: float, stop_time: float | None, start_values: dict[str, Value]) -> None:
        self._time_of_start = start_time
        super()._enter_initialization(start_time, stop_time, start_values)

    def _exit_initialization(self) -> None:
        super()._exit_initialization()
        self._start_events(self._time_of_start)

    def _initialize(self) -> None:
        """Call `fmiInitialize`, once (FMI 1.0, 2.5)."""
        if not self._initialized:
            tolerance = self._options.solver.relative_tolerance
            self._initializing("fmiInitialize", lambda: self._calls.initialize(self._time_of_start, tolerance))
            self._initialized = True

    def _terminate(self) -> None:
        if self._initialized:
            self._calls.terminate()

    def _model_calls(self) -> ModelCalls:
        return self._calls
