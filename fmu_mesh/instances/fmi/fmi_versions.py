"""What co-simulation and model exchange share in each version of FMI: values, initialization and the end."""

from __future__ import annotations

import ctypes
from abc import abstractmethod
from collections.abc import Callable, Sequence
from typing import Any, Final

import numpy as np

from ...system.layout import Part
from ...variables.model_description import Variable
from ...variables.value_types import DTYPES, Value, VariableType, is_text
from .buffers import BinaryBuffer, Buffer, NumberBuffer, StringBuffer
from .callbacks import FMI1_CALLBACKS, FMI3_LOGGER, fmi2_callbacks, register_component
from .calls import Function, Pointer, declared
from .fmu_instance import FmuInstance
from .fmu_values import Verb

__all__ = ["FMI2_NAMES", "FMI2_NEEDED", "FMI3_NEEDED", "Fmi1Values", "Fmi2Values", "Fmi3Values"]

_GET_OR_SET = ctypes.CFUNCTYPE(ctypes.c_int, ctypes.c_void_p, ctypes.c_void_p, ctypes.c_size_t, ctypes.c_void_p)
_GET_OR_SET_3 = ctypes.CFUNCTYPE(
    ctypes.c_int, ctypes.c_void_p, ctypes.c_void_p, ctypes.c_size_t, ctypes.c_void_p, ctypes.c_size_t
)
_GET_OR_SET_BINARY = ctypes.CFUNCTYPE(
    ctypes.c_int,
    ctypes.c_void_p,
    ctypes.c_void_p,
    ctypes.c_size_t,
    ctypes.c_void_p,
    ctypes.c_void_p,
    ctypes.c_size_t,
)
_SUFFIX: Final[dict[VariableType, str]] = {
    "Float64": "Real",
    "Int32": "Integer",
    "Enumeration": "Integer",
    "Boolean": "Boolean",
    "String": "String",
}
FMI2_NAMES: Final = {
    "instantiate": "fmi2Instantiate",
    "getFMUState": "fmi2GetFMUstate",
    "setFMUState": "fmi2SetFMUstate",
    "freeFMUState": "fmi2FreeFMUstate",
    "serializeFMUState": "fmi2SerializeFMUstate",
    "deserializeFMUState": "fmi2DeSerializeFMUstate",
}
"""FMI functions whose name does not follow from the name of FMPy's method, by that name."""
FMI2_NEEDED: Final = (
    "fmi2Instantiate",
    "fmi2SetupExperiment",
    "fmi2EnterInitializationMode",
    "fmi2ExitInitializationMode",
)
FMI3_NEEDED: Final = ("fmi3EnterInitializationMode", "fmi3ExitInitializationMode")
"""The functions that co-simulation and model exchange need, and so above for FMI 2.0."""
_DIRECT: Final = ("Float64", "Int32")
"""The types that a ring stores as in C; an Enumeration is an `int` in FMI 1.0 and 2.0 (2.1.2)."""


class _Fmi1And2Values(FmuInstance):
    """Values in FMI 1.0 and 2.0."""

    _direct_declaration = "int (*)(void *, void *, size_t, void *)"
    _boolean: type[Any]

    def _instantiate(self) -> None:
        super()._instantiate()
        register_component(self._fmu.component, self)

    def _function_name(self, verb: Verb, type_: VariableType) -> str:
        return f"{self._functions.prefix}{verb}{_SUFFIX[type_]}"

    def _function(self, verb: Verb, type_: VariableType) -> Callable[..., int]:
        function: Callable[..., int] = declared(self._fmu.dll, self._symbol(f"{verb}{_SUFFIX[type_]}"), _GET_OR_SET)
        return function

    def _symbol(self, function: str) -> str:
        """The name of a function in the library."""
        return f"{self._functions.prefix}{function}"

    def _buffer(self, type_: VariableType, variables: Sequence[Variable]) -> Buffer:
        if type_ == "String":
            return StringBuffer(len(variables))
        dtypes: dict[VariableType, type[Any]] = {"Float64": np.float64, "Boolean": self._boolean}
        negated = [variable.negated for variable in variables]
        signs = np.where(negated, -1, 1).astype(np.int8) if any(negated) else None
        return NumberBuffer(type_, dtypes.get(type_, np.intc), len(variables), signs)

    def _is_direct(self, part: Part) -> bool:
        return part.type in _DIRECT and not any(self._variables[column.name].negated for column in part.columns)

    def _call(self, function: Callable[..., int], references: Sequence[int], buffer: Buffer, _size: int) -> int:
        array = (ctypes.c_uint * len(references))(*references)
        return function(self._component, ctypes.addressof(array), len(references), buffer.address)

    def _call_direct(self, function: Function, references: Pointer, count: int, row: Pointer, _size: int) -> int:
        return function(self._self, references, count, row)


class Fmi1Values(_Fmi1And2Values):
    """An FMI 1.0 instance.

    FMI 1.0 has no Initialization Mode: values can be set before the function that initializes, and be read after it
    (FMI 1.0 CS, 3.6; ME, 2.8). So the instance is initialized when the first value is read, or else when Initialization
    Mode is left; inputs that are set later hold from the first step on.
    """

    _boolean = np.int8  # a `char` in FMI 1.0 (ME, 2.1.2)
    _initialized = False

    def get_values(self, names: Sequence[str]) -> list[Value]:
        """Current values of variables by name; before the end of Initialization Mode this initializes the instance."""
        if self._state == "initialization":
            self._initialize_once()
        return super().get_values(names)

    def _make_instance(self) -> None:
        self._fmu.instantiate(functions=FMI1_CALLBACKS, loggingOn=False)

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

    @abstractmethod
    def _terminate_initialized(self) -> None:
        """Call the function of FMI that terminates."""

    def _end_run(self, *, resets: bool) -> bool:
        """As in the state machine of FMI 1.0 for co-simulation, fmiResetSlave takes the place of fmiTerminateSlave."""
        return (resets and self._model.reset()) or super()._end_run(resets=False)

    def _terminate(self) -> None:
        if self._initialized:
            self._terminate_initialized()

    def _symbol(self, function: str) -> str:
        return f"{self._description.model_identifier}_{super()._symbol(function)}"


class Fmi2Values(_Fmi1And2Values):
    """An FMI 2.0 instance."""

    _boolean = np.intc

    def _make_instance(self) -> None:
        self._fmu.instantiate(callbacks=fmi2_callbacks(id(self._model)), loggingOn=False)

    def _enter_initialization(self, start_time: float, stop_time: float | None, start_values: dict[str, Value]) -> None:
        """FMI 2.0, 2.1.6 and 4.2.1."""
        tolerance = self._tolerance()
        self._initializing(
            "fmi2SetupExperiment",
            lambda: self._fmu.setupExperiment(tolerance=tolerance, startTime=start_time, stopTime=stop_time),
        )
        self.set_values(start_values)
        self._initializing("fmi2EnterInitializationMode", self._fmu.enterInitializationMode)

    def _exit_initialization(self) -> None:
        self._initializing("fmi2ExitInitializationMode", self._fmu.exitInitializationMode)


class Fmi3Values(FmuInstance):
    """An FMI 3.0 instance."""

    _direct_declaration = "int (*)(void *, void *, size_t, void *, size_t)"

    def _make_instance(self) -> None:
        self._fmu.instantiate(loggingOn=False, logMessage=FMI3_LOGGER, **self._uses())

    def _uses(self) -> dict[str, bool]:
        """Arguments of the instantiation: the features of co-simulation that are used."""
        return {}

    def _enter_initialization(self, start_time: float, stop_time: float | None, start_values: dict[str, Value]) -> None:
        """Structural parameters in Configuration Mode, then all others (FMI 3.0, 2.3.3 and 2.3.2)."""
        structural = {v.name for v in self._description.with_causality("structuralParameter")}
        sizes = {name: value for name, value in start_values.items() if name in structural}
        if sizes:
            self._initializing("fmi3EnterConfigurationMode", self._fmu.enterConfigurationMode)
            self.set_values(sizes)
            self._initializing("fmi3ExitConfigurationMode", self._fmu.exitConfigurationMode)
        self.set_values({name: value for name, value in start_values.items() if name not in structural})
        tolerance = self._tolerance()
        self._initializing(
            "fmi3EnterInitializationMode",
            lambda: self._fmu.enterInitializationMode(tolerance=tolerance, startTime=start_time, stopTime=stop_time),
        )

    def _exit_initialization(self) -> None:
        self._initializing("fmi3ExitInitializationMode", self._fmu.exitInitializationMode)

    def _function_name(self, verb: Verb, type_: VariableType) -> str:
        return f"fmi3{verb}{'Int64' if type_ == 'Enumeration' else type_}"

    def _function(self, verb: Verb, type_: VariableType) -> Callable[..., int]:
        prototype: Any = _GET_OR_SET_BINARY if type_ == "Binary" else _GET_OR_SET_3
        function: Callable[..., int] = declared(self._fmu.dll, self._function_name(verb, type_), prototype)
        return function

    def _buffer(self, type_: VariableType, variables: Sequence[Variable]) -> Buffer:
        size = sum(variable.size for variable in variables)
        match type_:
            case "String":
                return StringBuffer(size)
            case "Binary":
                return BinaryBuffer(size)
            case "Boolean":
                return NumberBuffer(type_, np.uint8, size)
            case _:
                return NumberBuffer(type_, DTYPES[type_], size)

    def _is_direct(self, part: Part) -> bool:
        return not is_text(part.type) and part.type != "Boolean"

    def _call(self, function: Callable[..., int], references: Sequence[int], buffer: Buffer, size: int) -> int:
        array = (ctypes.c_uint * len(references))(*references)
        address = ctypes.addressof(array)
        if isinstance(buffer, BinaryBuffer):
            return function(self._component, address, len(references), buffer.sizes_address, buffer.address, size)
        return function(self._component, address, len(references), buffer.address, size)

    def _call_direct(self, function: Function, references: Pointer, count: int, row: Pointer, size: int) -> int:
        return function(self._self, references, count, row, size)
