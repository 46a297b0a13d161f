"""FMI 3.0 co-simulation behind the `Instance` Protocol.

FMPy loads the library; values go between the memory of a `Ring` and the FMU directly, whole arrays at once. A step
that returns early is finished here, with Event Mode in between where the FMU has one, so the communication points of
the mesh stay (FMI 3.0, 4.2.1).
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from fmpy.fmi3 import FMU3Slave

from ....system.layout import Part
from ....variables.model_description import Variable
from ....variables.value_types import DTYPES, Value, VariableType, is_text
from ..buffers import BinaryBuffer, Buffer, NumberBuffer, StringBuffer
from ..calls import Function, Pointer
from ..fmu_instance import FmuInstance, Verb
from .fmi3_events import SteppedInEvents
from .fmi3_steps import Fmi3Steps

__all__ = ["Fmi3Instance", "Fmi3Values"]

_GET_OR_SET = ctypes.CFUNCTYPE(
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


class Fmi3Values(FmuInstance):
    """What all kinds of FMI 3.0 instances share: values, initialization and the end."""

    _library: type[Any]
    _direct_declaration = "int (*)(void *, void *, size_t, void *, size_t)"

    def _instantiate(self, folder: Path) -> None:
        fmu = self._library(
            guid=self._description.guid,
            modelIdentifier=self._description.model_identifier,
            unzipDirectory=str(folder),
            instanceName=self.name,
        )
        fmu.instantiate(loggingOn=False, logMessage=self._message_came, **self._uses())
        self._fmu = fmu
        self._component = fmu.component

    def _uses(self) -> dict[str, bool]:
        """What the instance is told of us when it is made."""
        return {}

    def _tolerance(self) -> float | None:
        """The tolerance that the FMU is told (FMI 3.0, 2.3.2)."""
        return self._options.tolerance or self._description.default_experiment.tolerance

    def _message_came(self, _environment: int | None, status: int, category: bytes, message: bytes) -> None:
        self.logged(status, category or b"", message or b"")

    def _enter_initialization(self, start_time: float, stop_time: float | None, start_values: dict[str, Value]) -> None:
        """Structural parameters in Configuration Mode, then all others (FMI 3.0, 2.3.3 and 2.3.2)."""
        structural = {v.name for v in self._description.with_causality("structuralParameter")}
        sizes = {name: value for name, value in start_values.items() if name in structural}
        if sizes:
            self._initializing("fmi3EnterConfigurationMode", self._fmu.enterConfigurationMode)
            self.set_values(sizes)
            self._initializing("fmi3ExitConfigurationMode", self._fmu.exitConfigurationMode)
        self.set_values({name: value for name, value in start_values.items() if name not in structural})
        self._time_of_start, tolerance = start_time, self._tolerance()
        self._initializing(
            "fmi3EnterInitializationMode",
            lambda: self._fmu.enterInitializationMode(tolerance=tolerance, startTime=start_time, stopTime=stop_time),
        )

    def _exit_initialization(self) -> None:
        self._initializing("fmi3ExitInitializationMode", self._fmu.exitInitializationMode)

    def _terminate(self) -> None:
        self._fmu.terminate()

    def _free(self) -> None:
        self._fmu.freeInstance()

    def _function_name(self, verb: Verb, type_: VariableType) -> str:
        return f"fmi3{verb}{'Int64' if type_ == 'Enumeration' else type_}"

    def _function(self, verb: Verb, type_: VariableType) -> Callable[..., int]:
        prototype: Any = _GET_OR_SET_BINARY if type_ == "Binary" else _GET_OR_SET
        function: Callable[..., int] = prototype((self._function_name(verb, type_), self._fmu.dll))
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


class Fmi3Instance(SteppedInEvents, Fmi3Values):
    """One instance of an FMI 3.0 co-simulation FMU."""

    _library = FMU3Slave

    def _uses(self) -> dict[str, bool]:
        return {"eventModeUsed": self._description.has_event_mode, "earlyReturnAllowed": True}

    def _enter_initialization(self, start_time: float, stop_time: float | None, start_values: dict[str, Value]) -> None:
        super()._enter_initialization(start_time, stop_time, start_values)
        self._steps = Fmi3Steps(self._fmu, self._description)
        self._stepped(lambda: self._steps.start(start_time))

    def _exit_initialization(self) -> None:
        """An FMU with Event Mode is in it now."""
        super()._exit_initialization()
        self._stepped(self._steps.exit_initialization)
