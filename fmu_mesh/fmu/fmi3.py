"""FMI 3.0 co-simulation behind the `Instance` Protocol (stand-in)."""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from fmpy.fmi3 import FMU3Slave

from ..model.description import Variable
from ..model.ring import Part
from ..model.types import DTYPES, Value, VariableType
from .buffers import Buffer, NumberBuffer, StringBuffer
from .fmi3_events import SteppedInEvents
from .fmi3_steps import Fmi3Steps
from .instance import Verb

_GET_OR_SET = ctypes.CFUNCTYPE(
    ctypes.c_int, ctypes.c_void_p, ctypes.c_void_p, ctypes.c_size_t, ctypes.c_void_p, ctypes.c_size_t
)


class Fmi3Instance(SteppedInEvents):
    """One instance of an FMI 3.0 co-simulation FMU."""

    _library: type[Any] = FMU3Slave

    def _instantiate(self, folder: Path) -> None:
        fmu = self._library(
            guid=self._description.guid,
            modelIdentifier=self._description.model_identifier,
            unzipDirectory=str(folder),
            instanceName=self.name,
        )
        fmu.instantiate(logMessage=self._on_message, **self._how())
        self._fmu = fmu
        self._component = fmu.component

    def _how(self) -> dict[str, Any]:
        used = self._description.has_event_mode
        return {"eventModeUsed": used, "earlyReturnAllowed": used}

    def _on_message(self, _environment: Any, status: int, category: bytes, message: bytes) -> None:
        self.logged(status, category or b"", message or b"")

    def _enter_initialization(self, start_time: float, stop_time: float | None, start_values: dict[str, Value]) -> None:
        self._time_of_start = start_time
        self.set_values(start_values)
        self._initializing(
            "fmi3EnterInitializationMode",
            lambda: self._fmu.enterInitializationMode(
                tolerance=self._tolerance(), startTime=start_time, stopTime=stop_time
            ),
        )
        self._initialized()

    def _initialized(self) -> None:
        self._steps = Fmi3Steps(self._fmu, self._description)
        self._steps.start(self._time_of_start)

    def _tolerance(self) -> float | None:
        return self._description.default_experiment.tolerance

    def _exit_initialization(self) -> None:
        self._initializing("fmi3ExitInitializationMode", self._fmu.exitInitializationMode)
        self._first_events()

    def _first_events(self) -> None:
        self._stepped(self._steps.exit_initialization)

    def _terminate(self) -> None:
        self._fmu.terminate()

    def _free(self) -> None:
        self._fmu.freeInstance()

    def _function_name(self, verb: Verb, type_: VariableType) -> str:
        return f"fmi3{verb}{'Int64' if type_ == 'Enumeration' else type_}"

    def _function(self, verb: Verb, type_: VariableType) -> Callable[..., int]:
        return _GET_OR_SET((self._function_name(verb, type_), self._fmu.dll))

    def _buffer(self, type_: VariableType, variables: Sequence[Variable]) -> Buffer:
        size = sum(variable.size for variable in variables)
        return StringBuffer(size) if type_ == "String" else NumberBuffer(type_, DTYPES[type_], size)

    def _is_direct(self, part: Part) -> bool:
        return part.type not in ("String", "Binary")

    def _call(self, function: Callable[..., int], references: Sequence[int], buffer: Buffer, size: int) -> int:
        array = (ctypes.c_uint * len(references))(*references)
        return function(self._component, ctypes.addressof(array), len(references), buffer.address, size)

    def _call_direct(self, function: Callable[..., int], references: int, count: int, row: int, size: int) -> int:
        return function(self._component, references, count, row, size)
