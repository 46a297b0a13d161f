"""FMI 2.0 co-simulation behind the `Instance` Protocol.

FMPy loads the library and declares its functions; the hot loop calls them through prototypes of its own, on arrays
that are allocated once: an input row is set from, and an output row read into, the memory of a `Ring` directly.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Final

import numpy as np
from fmpy.fmi1 import FMICallException
from fmpy.fmi2 import FMU2Slave

from ..model.description import Variable
from ..model.ring import Part, Ring
from ..model.types import Value, VariableType
from ..simtime import TimeGrid
from .buffers import Buffer, NumberBuffer, StringBuffer
from .callbacks import FMI2_CALLBACKS, register, unregister
from .instance import STATUS_NAMES, WARNING, FmuInstance, Verb

__all__ = ["Fmi2Instance"]

_GET_OR_SET = ctypes.CFUNCTYPE(ctypes.c_int, ctypes.c_void_p, ctypes.c_void_p, ctypes.c_size_t, ctypes.c_void_p)
_DO_STEP = ctypes.CFUNCTYPE(ctypes.c_int, ctypes.c_void_p, ctypes.c_double, ctypes.c_double, ctypes.c_int)
_SUFFIX: Final[dict[VariableType, str]] = {
    "Float64": "Real",
    "Int32": "Integer",
    "Enumeration": "Integer",
    "Boolean": "Boolean",
    "String": "String",
}
_DIRECT: Final = ("Float64", "Int32")
"""The types that lie in a ring as in C; a Boolean and an Enumeration are an `int` in FMI 2.0 (2.1.2)."""


class Fmi2Instance(FmuInstance):
    """One instance of an FMI 2.0 co-simulation FMU."""

    def bind(self, inputs: Ring, outputs: Sequence[Ring], grid: TimeGrid, points: int, step: int = 0) -> None:
        """Let `do_step` work on these rings, ``points`` of ``grid`` each; write the current outputs as row ``step``."""
        super().bind(inputs, outputs, grid, points, step)
        # One look-up for all that a step needs: it is a part of the time of a small FMU.
        self._hot = (
            self._component,
            self._do_step,
            self._input_mask,
            self._output_mask,
            [call[:4] for call in self._direct_setters],
            [call[:4] for call in self._direct_getters],
            bool(self._setters or self._getters),
        )

    def do_step(self, step: int) -> None:
        """Set the inputs of row ``step``, advance to own step ``step + 1``, write the outputs to row ``step + 1``."""
        component, do_step, input_mask, output_mask, setters, getters, has_buffers = self._hot
        slot = step & input_mask
        for function, references, count, rows in setters:
            status = function(component, references, count, rows[slot])
            if status > WARNING:
                raise self._failed(f"setting the inputs returned {STATUS_NAMES[status]}")
        if has_buffers:
            for set_row in self._setters:
                set_row(slot)
        time = self._start_time + step * self._points * self._base_step_size  # `grid.time`, without a call
        status = do_step(component, time, self._step_size, 1)
        if status > WARNING:
            raise self._failed(f"fmi2DoStep returned {STATUS_NAMES[status]}")
        self._step = step + 1
        slot = (step + 1) & output_mask
        for function, references, count, rows in getters:
            status = function(component, references, count, rows[slot])
            if status > WARNING:
                raise self._failed(f"reading the outputs returned {STATUS_NAMES[status]}")
        if has_buffers:
            for get_row in self._getters:
                get_row(slot)

    def advance(self, time: float, step_size: float) -> None:
        """One step of ``step_size`` from ``time`` (both in s) without rings, for callers with their own time base."""
        self._check_live()
        try:
            self._fmu.doStep(currentCommunicationPoint=time, communicationStepSize=step_size)
        except FMICallException as error:
            raise self._failed(f"{error.function} returned {STATUS_NAMES[error.status]}") from error

    def close(self) -> None:
        """Terminate if allowed, free the instance and remove its files. Never raises; may be called twice."""
        super().close()
        unregister(self.name, self)

    def _instantiate(self, folder: Path) -> None:
        register(self.name, self)
        fmu = FMU2Slave(
            guid=self._description.guid,
            modelIdentifier=self._description.model_identifier,
            unzipDirectory=str(folder),
            instanceName=self.name,
        )
        fmu.instantiate(callbacks=FMI2_CALLBACKS, loggingOn=False)
        self._fmu = fmu
        self._component = fmu.component
        self._do_step = _DO_STEP(("fmi2DoStep", fmu.dll))

    def _enter_initialization(self, start_time: float, stop_time: float | None, start_values: dict[str, Value]) -> None:
        """FMI 2.0, 2.1.6 and 4.2.1."""
        tolerance = self._description.default_experiment.tolerance
        self._initializing(
            "fmi2SetupExperiment",
            lambda: self._fmu.setupExperiment(tolerance=tolerance, startTime=start_time, stopTime=stop_time),
        )
        self.set_values(start_values)
        self._initializing("fmi2EnterInitializationMode", self._fmu.enterInitializationMode)

    def _exit_initialization(self) -> None:
        self._initializing("fmi2ExitInitializationMode", self._fmu.exitInitializationMode)

    def _terminate(self) -> None:
        self._fmu.terminate()

    def _free(self) -> None:
        self._fmu.freeInstance()

    def _function_name(self, verb: Verb, type_: VariableType) -> str:
        return f"fmi2{verb}{_SUFFIX[type_]}"

    def _function(self, verb: Verb, type_: VariableType) -> Callable[..., int]:
        return _GET_OR_SET((self._function_name(verb, type_), self._fmu.dll))

    def _buffer(self, type_: VariableType, variables: Sequence[Variable]) -> Buffer:
        if type_ == "String":
            return StringBuffer(len(variables))
        return NumberBuffer(type_, np.float64 if type_ == "Float64" else np.intc, len(variables))

    def _is_direct(self, part: Part) -> bool:
        return part.type in _DIRECT

    def _call(self, function: Callable[..., int], references: Sequence[int], buffer: Buffer, _size: int) -> int:
        array = (ctypes.c_uint * len(references))(*references)
        return function(self._component, ctypes.addressof(array), len(references), buffer.address)

    def _call_direct(self, function: Callable[..., int], references: int, count: int, row: int, _size: int) -> int:
        return function(self._component, references, count, row)
