"""Model exchange behind the `Instance` Protocol, for FMI 1.0, 2.0 and 3.0."""

from __future__ import annotations

from fmpy.fmi1 import FMU1Model
from fmpy.fmi2 import FMU2Model
from fmpy.fmi3 import FMU3Model

from ....variables.value_types import Value
from ..clocks import Clocks
from ..fmi_versions import FMI2_NAMES, FMI2_NEEDED, FMI3_NEEDED, Fmi1Values, Fmi2Values, Fmi3Values
from ..loaded_fmu import FmuFunctions
from .continuous import ContinuousInstance
from .model_calls import Fmi1Calls, Fmi3Calls, ModelCalls

__all__ = ["Fmi1ModelInstance", "Fmi2ModelInstance", "Fmi3ModelInstance"]


_NAMES = {"instantiate": "fmiInstantiateModel", "fmi1FreeModelInstance": "fmiFreeModelInstance"}
_NEEDED_1 = "fmiInstantiateModel", "fmiSetTime", "fmiInitialize", "fmiEventUpdate"
_NEEDED_2 = *FMI2_NEEDED, "fmi2SetTime", "fmi2NewDiscreteStates", "fmi2EnterContinuousTimeMode"
_NEEDED_3 = (
    "fmi3InstantiateModelExchange",
    *FMI3_NEEDED,
    "fmi3SetTime",
    "fmi3UpdateDiscreteStates",
    "fmi3EnterContinuousTimeMode",
)


class Fmi1ModelInstance(ContinuousInstance, Fmi1Values):
    """One instance of an FMI 1.0 FMU for model exchange (FMI 1.0, 2.8)."""

    _functions = FmuFunctions(FMU1Model, "fmi", "fmi1FreeModelInstance", _NEEDED_1, _NAMES)

    def _instantiated(self) -> None:
        self._calls = Fmi1Calls(self._fmu, self._description.continuous_states, self._description.event_indicators)

    def _initialize(self, start_time: float, stop_time: float | None) -> None:  # noqa: ARG002 only for co-simulation
        """FmiInitialize (FMI 1.0, 2.5)."""
        tolerance = self._options.solver.relative_tolerance
        self._initializing("fmiInitialize", lambda: self._calls.initialize(start_time, tolerance))

    def _terminate_initialized(self) -> None:
        self._calls.terminate()

    def _model_calls(self) -> ModelCalls:
        return self._calls


class Fmi2ModelInstance(ContinuousInstance, Fmi2Values):
    """One instance of an FMI 2.0 FMU for model exchange (FMI 2.0, 3.2)."""

    _functions = FmuFunctions(FMU2Model, "fmi2", "fmi2FreeInstance", _NEEDED_2, FMI2_NAMES)

    def _model_calls(self) -> ModelCalls:
        return ModelCalls(self._fmu, self._description.continuous_states, self._description.event_indicators, "fmi2")


class Fmi3ModelInstance(ContinuousInstance, Fmi3Values):
    """One instance of an FMI 3.0 FMU for model exchange (FMI 3.0, 3.2)."""

    _functions = FmuFunctions(FMU3Model, "fmi3", "fmi3FreeInstance", _NEEDED_3, {"instantiate": _NEEDED_3[0]})

    def _enter_initialization(self, start_time: float, stop_time: float | None, start_values: dict[str, Value]) -> None:
        super()._enter_initialization(start_time, stop_time, start_values)
        self._clocks = Clocks(self._fmu, self._description.clocks)
        self._clocks.start(start_time)

    def _model_calls(self) -> ModelCalls:
        return Fmi3Calls(self._fmu)
