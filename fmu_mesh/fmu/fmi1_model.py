"""FMI 1.0 model exchange.

FMI 1.0 has no Initialization Mode: values are set, then `fmiInitialize` computes the rest (FMI 1.0, 2.8). Outputs that
a connection needs before are read after it, and inputs that become known later are set as at any other event.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Final

import numpy as np
from fmpy.fmi1 import (
    FMU1Model,
    fmi1CallbackAllocateMemoryTYPE,
    fmi1CallbackFreeMemoryTYPE,
    fmi1CallbackFunctions,
    fmi1CallbackLoggerTYPE,
)

from ..model.description import Variable
from ..model.ring import Part
from ..model.types import Value, VariableType
from .buffers import Buffer, NumberBuffer, StringBuffer
from .continuous import ContinuousInstance
from .fmi2 import CALLBACKS, listen, silence
from .instance import Verb
from .model_calls import Fmi1Calls, ModelCalls

__all__ = ["Fmi1ModelInstance"]

_GET_OR_SET = ctypes.CFUNCTYPE(ctypes.c_int, ctypes.c_void_p, ctypes.c_void_p, ctypes.c_size_t, ctypes.c_void_p)
_SUFFIX: Final[dict[VariableType, str]] = {
    "Float64": "Real",
    "Int32": "Integer",
    "Enumeration": "Integer",
    "Boolean": "Boolean",
    "String": "String",
}
_C_TYPES: Final = {"Float64": np.float64, "Boolean": np.int8}


def _callbacks() -> fmi1CallbackFunctions:
    """Those of FMI 2.0, whose logger is called with the same arguments."""
    callbacks = fmi1CallbackFunctions()
    callbacks.logger = ctypes.cast(CALLBACKS.logger, fmi1CallbackLoggerTYPE)
    callbacks.allocateMemory = ctypes.cast(CALLBACKS.allocateMemory, fmi1CallbackAllocateMemoryTYPE)
    callbacks.freeMemory = ctypes.cast(CALLBACKS.freeMemory, fmi1CallbackFreeMemoryTYPE)
    return callbacks


class Fmi1ModelInstance(ContinuousInstance):
    """One instance of an FMI 1.0 FMU for model exchange."""

    _is_initialized = False

    def get_values(self, names: Sequence[str]) -> list[Value]:
        """See `Instance`; before fmiInitialize, there is nothing to get."""
        if self._state == "initialization":
            self._initialize()
        return super().get_values(names)

    def close(self) -> None:
        """See `Instance`."""
        super().close()
        silence(self)

    def _instantiate(self, folder: Path) -> None:
        listen(self)
        self._fmu = FMU1Model(
            guid=self._description.guid,
            modelIdentifier=self._description.model_identifier,
            unzipDirectory=str(folder),
            instanceName=self.name,
        )
        self._fmu.instantiate(functions=_callbacks(), loggingOn=False)
        self._component = self._fmu.component
        description = self._description
        self._calls = Fmi1Calls(self._fmu, description.continuous_states, description.event_indicators)

    def _enter_initialization(
        self, start_time: float, _stop_time: float | None, start_values: dict[str, Value]
    ) -> None:
        self._time_of_start = start_time
        self.set_values(start_values)

    def _exit_initialization(self) -> None:
        self._initialize()
        self._start_events(self._time_of_start)

    def _initialize(self) -> None:
        if self._is_initialized:
            return
        tolerance = self._options.solver.relative_tolerance
        self._initializing("fmiInitialize", lambda: self._calls.initialize(self._time_of_start, tolerance))
        self._is_initialized = True

    def _model_calls(self) -> ModelCalls:
        return self._calls

    def _terminate(self) -> None:
        self._fmu.fmi1Terminate(self._component)

    def _free(self) -> None:
        self._fmu.freeInstance()

    def _function_name(self, verb: Verb, type_: VariableType) -> str:
        return f"fmi{verb}{_SUFFIX[type_]}"

    def _function(self, verb: Verb, type_: VariableType) -> Callable[..., int]:
        name = f"{self._description.model_identifier}_{self._function_name(verb, type_)}"
        return _GET_OR_SET((name, self._fmu.dll))

    def _buffer(self, type_: VariableType, variables: Sequence[Variable]) -> Buffer:
        if type_ == "String":
            return StringBuffer(len(variables))
        signs = np.array([-1 if variable.negated else 1 for variable in variables], dtype=np.int8)
        dtype = _C_TYPES.get(type_, np.intc)
        return NumberBuffer(type_, dtype, len(variables), signs if (signs < 0).any() else None)

    def _is_direct(self, part: Part) -> bool:
        negated = any(self._variables[column.name].negated for column in part.columns)
        return part.type in ("Float64", "Int32") and not negated

    def _call(self, function: Callable[..., int], references: Sequence[int], buffer: Buffer, _size: int) -> int:
        array = (ctypes.c_uint * len(references))(*references)
        return function(self._component, ctypes.addressof(array), len(references), buffer.address)

    def _call_direct(self, function: Callable[..., int], references: int, count: int, row: int, _size: int) -> int:
        return function(self._component, references, count, row)
