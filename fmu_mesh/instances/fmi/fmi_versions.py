"""What co-simulation and model exchange share in each version of FMI: their values, initialization and the end."""

from __future__ import annotations

import ctypes
from abc import abstractmethod
from collections.abc import Sequence
from typing import Final

import numpy as np

from ...variables.value_types import Value
from ..call_guard import call_named
from .callbacks import FMI1_CALLBACKS, FMI3_LOGGER, fmi2_callbacks
from .calls import cffi_function, checked_function
from .fmu_instance import FmuInstance
from .fmu_values import WARNING, ValueFunctions

__all__ = ["Fmi1", "Fmi2", "Fmi3"]

_TERMINATE: Final = ctypes.CFUNCTYPE(ctypes.c_int, ctypes.c_void_p)
_MODES: Final = {
    "fmi2SetupExperiment": "int (*)(void *, int, double, double, int, double)",
    "fmi2EnterInitializationMode": "int (*)(void *)",
    "fmi2ExitInitializationMode": "int (*)(void *)",
    "fmi2Terminate": "int (*)(void *)",
}
"""Functions of FMI 2.0 that each run calls, and their C types."""


class Fmi1(FmuInstance):
    """An FMI 1.0 instance.

    FMI 1.0 has no Initialization Mode: values can be set before the function that initializes, and be read after it
    (FMI 1.0 CS, 3.6; ME, 2.8). So the instance is initialized when the first value is read, or else when Initialization
    Mode is left; inputs that are set later hold from the first step on.
    """

    VALUES = ValueFunctions("fmi", np.int8, sized=False)  # a Boolean is a `char` (FMI 1.0 ME, 2.1.2)

    _initialized = False
    _end: str  # the function that ends the simulation, after the prefix

    def get_values(self, names: Sequence[str]) -> list[Value]:
        """Current values of variables by name; before the end of Initialization Mode this initializes the instance."""
        if self._state == "initialization":
            self._initialize_once()
        return super().get_values(names)

    def _instantiate(self, **arguments: object) -> None:
        super()._instantiate(functions=FMI1_CALLBACKS, **arguments)

    def _enter_initialization(self, start_time: float, stop_time: float | None, start_values: dict[str, Value]) -> None:
        self._times = start_time, stop_time
        self.set_values(start_values)

    def _exit_initialization(self) -> None:
        self._initialize_once()

    def _initialize_once(self) -> None:
        if not self._initialized:
            self._initialize(*self._times)
            self._initialized = True

    @abstractmethod
    def _initialize(self, start_time: float, stop_time: float | None) -> None:
        """Call the function of FMI that initializes (times in s)."""

    def _terminate(self) -> None:
        function = checked_function(self._fmu.dll, self._symbols, self._end, _TERMINATE)
        call_named(f"fmi{self._end}", function, self._component)

    def _end_run(self, *, resets: bool) -> bool:
        """As in the state machine of FMI 1.0 for co-simulation, fmiResetSlave takes the place of fmiTerminateSlave."""
        return (resets and self._model.reset()) or super()._end_run(resets=False)


class Fmi2(FmuInstance):
    """An FMI 2.0 instance."""

    VALUES = ValueFunctions("fmi2", np.intc, sized=False)
    NAMES: Final = {
        "instantiate": "fmi2Instantiate",
        "instantiate_again": "fmi2Instantiate",
        "getFMUState": "fmi2GetFMUstate",
        "setFMUState": "fmi2SetFMUstate",
        "freeFMUState": "fmi2FreeFMUstate",
        "serializeFMUState": "fmi2SerializeFMUstate",
        "deserializeFMUState": "fmi2DeSerializeFMUstate",
    }
    """FMI functions whose name does not follow from the name of FMPy's method, by that name."""

    NEEDED: Final = (
        "fmi2Instantiate",
        "fmi2SetupExperiment",
        "fmi2EnterInitializationMode",
        "fmi2ExitInitializationMode",
    )
    """The functions that co-simulation and model exchange need."""

    def _instantiate(self, **arguments: object) -> None:
        super()._instantiate(callbacks=fmi2_callbacks(id(self._model)), **arguments)
        self._modes = {name: cffi_function(getattr(self._fmu.dll, name), own) for name, own in _MODES.items()}

    def _enter_initialization(self, start_time: float, stop_time: float | None, start_values: dict[str, Value]) -> None:
        """FMI 2.0, 2.1.6 and 4.2.1."""
        tolerance = self._tolerance()
        bound = (0, 0.0) if tolerance is None else (1, tolerance)
        end = (0, 0.0) if stop_time is None else (1, stop_time)
        self._change_mode("fmi2SetupExperiment", *bound, start_time, *end)
        self.set_values(start_values)
        self._change_mode("fmi2EnterInitializationMode")

    def _exit_initialization(self) -> None:
        self._change_mode("fmi2ExitInitializationMode")

    def _terminate(self) -> None:
        status = call_named("fmi2Terminate", self._modes["fmi2Terminate"], self._self)
        if status > WARNING:
            self._note(status)

    def _change_mode(self, name: str, *arguments: float) -> None:
        if (status := call_named(name, self._modes[name], self._self, *arguments)) > WARNING:
            raise self._failed(name, status=status)


class Fmi3(FmuInstance):
    """An FMI 3.0 instance."""

    VALUES = ValueFunctions("fmi3", np.uint8, sized=True)
    NEEDED: Final = ("fmi3EnterInitializationMode", "fmi3ExitInitializationMode")

    def _instantiate(self, **arguments: object) -> None:
        super()._instantiate(logMessage=FMI3_LOGGER, **arguments)

    def _enter_initialization(self, start_time: float, stop_time: float | None, start_values: dict[str, Value]) -> None:
        """Structural parameters in Configuration Mode, then all others (FMI 3.0, 2.3.3 and 2.3.2)."""
        structural = {v.name for v in self.description.with_causality("structuralParameter")}
        sizes = {name: value for name, value in start_values.items() if name in structural}
        if sizes:
            self._checked(self._fmu.enterConfigurationMode)
            self.set_values(sizes)
            self._checked(self._fmu.exitConfigurationMode)
        self.set_values({name: value for name, value in start_values.items() if name not in structural})
        times = {"startTime": start_time, "stopTime": stop_time}
        self._checked(lambda: self._fmu.enterInitializationMode(tolerance=self._tolerance(), **times))
