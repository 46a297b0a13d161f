"""FMI 3.0 co-simulation behind the `Instance` Protocol.

FMPy loads the library; values go between the memory of a `Ring` and the FMU directly, whole arrays at once. A step
that returns early is finished here, with Event Mode in between where the FMU has one, so the communication points of
the mesh stay (FMI 3.0, 4.2.1).
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from fmpy.fmi1 import FMICallException
from fmpy.fmi3 import FMU3Slave

from ..model.description import Variable
from ..model.ring import Part
from ..model.types import DTYPES, Value, VariableType, is_text
from .buffers import BinaryBuffer, Buffer, NumberBuffer, StringBuffer
from .instance import STATUS_NAMES, WARNING, FmuInstance, Verb

__all__ = ["Fmi3Instance"]

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
_DO_STEP = ctypes.CFUNCTYPE(
    ctypes.c_int,
    ctypes.c_void_p,
    ctypes.c_double,
    ctypes.c_double,
    ctypes.c_bool,
    ctypes.c_void_p,
    ctypes.c_void_p,
    ctypes.c_void_p,
    ctypes.c_void_p,
)
_EVENTS_AT_ONE_TIME: Final = 1000
"""Early returns without progress in time, and updates of discrete states, after which an FMU is taken to be stuck."""


class Fmi3Instance(FmuInstance):
    """One instance of an FMI 3.0 co-simulation FMU."""

    def do_step(self, step: int) -> None:
        """Set the inputs of row ``step``, advance to own step ``step + 1``, write the outputs to row ``step + 1``."""
        slot = step & self._input_mask
        if self._sets_in_event_mode:
            self._fmu_called(self._fmu.enterEventMode)
        component = self._component
        for function, references, count, rows, size in self._direct_setters:
            status = function(component, references, count, rows[slot], size)
            if status > WARNING:
                raise self._failed(f"setting the inputs returned {STATUS_NAMES[status]}")
        for set_row in self._setters:
            set_row(slot)
        if self._sets_in_event_mode:
            self._leave_event_mode()
        time = self._start_time + step * self._points * self._base_step_size  # `grid.time`, without a call
        self._advance(time, self._step_size, self._start_time + (step + 1) * self._points * self._base_step_size)
        self._step = step + 1
        slot = (step + 1) & self._output_mask
        for function, references, count, rows, size in self._direct_getters:
            status = function(component, references, count, rows[slot], size)
            if status > WARNING:
                raise self._failed(f"reading the outputs returned {STATUS_NAMES[status]}")
        for get_row in self._getters:
            get_row(slot)

    def advance(self, time: float, step_size: float) -> None:
        """One step of ``step_size`` from ``time`` (both in s) without rings, for callers with their own time base."""
        self._check_live()
        self._advance(time, step_size, time + step_size)

    def set_values(self, values: Mapping[str, Value]) -> None:
        """Set variables by name; between steps in Event Mode if one of them may not change otherwise."""
        discrete = any(self._needs_event_mode(self._variables[name]) for name in values)
        if self._state == "stepping" and discrete:
            self._fmu_called(self._fmu.enterEventMode)
            super().set_values(values)
            self._leave_event_mode()
        else:
            super().set_values(values)

    # --- what the base class asks for

    def _instantiate(self, folder: Path) -> None:
        description = self._description
        fmu = FMU3Slave(
            guid=description.guid,
            modelIdentifier=description.model_identifier,
            unzipDirectory=str(folder),
            instanceName=self.name,
        )
        fmu.instantiate(
            loggingOn=False,
            eventModeUsed=description.has_event_mode,
            earlyReturnAllowed=True,
            logMessage=self._message_came,
        )
        self._fmu = fmu
        self._component = fmu.component
        self._do_step = _DO_STEP(("fmi3DoStep", fmu.dll))
        self._next_event: float | None = None
        # eventHandlingNeeded, terminateSimulation and earlyReturn, one byte each.
        self._flags = ctypes.create_string_buffer(3)
        self._last_time = ctypes.c_double()
        first = ctypes.addressof(self._flags)
        self._answers = (first, first + 1, first + 2, ctypes.addressof(self._last_time))
        self._sets_in_event_mode = False

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
        tolerance = self._description.default_experiment.tolerance
        self._initializing(
            "fmi3EnterInitializationMode",
            lambda: self._fmu.enterInitializationMode(tolerance=tolerance, startTime=start_time, stopTime=stop_time),
        )

    def _exit_initialization(self) -> None:
        """An FMU with Event Mode is in it now."""
        self._initializing("fmi3ExitInitializationMode", self._fmu.exitInitializationMode)
        if self._description.has_event_mode:
            self._leave_event_mode()

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

    def _prepare(self, verb: Verb, part: Part, array: Any) -> None:  # noqa: ANN401 as in the base class
        super()._prepare(verb, part, array)
        if verb == "Set" and any(self._needs_event_mode(self._variables[column.name]) for column in part.columns):
            self._sets_in_event_mode = True

    def _call(self, function: Callable[..., int], references: Sequence[int], buffer: Buffer, size: int) -> int:
        array = (ctypes.c_uint * len(references))(*references)
        address = ctypes.addressof(array)
        if isinstance(buffer, BinaryBuffer):
            return function(self._component, address, len(references), buffer.sizes_address, buffer.address, size)
        return function(self._component, address, len(references), buffer.address, size)

    def _call_direct(self, function: Callable[..., int], references: int, count: int, row: int, size: int) -> int:
        return function(self._component, references, count, row, size)

    # --- steps and events

    def _advance(self, time: float, step_size: float, end: float) -> None:
        """Call `fmi3DoStep` until ``end`` (s) is reached, with Event Mode where the FMU wants it (FMI 3.0, 4.2.1)."""
        has_events, stuck = self._description.has_event_mode, 0
        while True:
            target = end
            if self._next_event is not None and time < self._next_event < end:
                target, step_size = self._next_event, self._next_event - time
            status = self._do_step(self._component, time, step_size, True, *self._answers)  # noqa: FBT003  as in C
            if status > WARNING:
                raise self._failed(f"fmi3DoStep returned {STATUS_NAMES[status]}")
            event, terminate, early = self._flags.raw
            if terminate:
                raise self._failed("fmi3DoStep asks to end the simulation")
            reached = self._last_time.value if early else target
            if has_events and (event or (self._next_event is not None and reached >= self._next_event)):
                self._fmu_called(self._fmu.enterEventMode)
                self._leave_event_mode()
            if reached >= end:
                return
            stuck = stuck + 1 if reached <= time else 0
            if reached < time or stuck > _EVENTS_AT_ONE_TIME:
                raise self._failed(f"fmi3DoStep returns early at t = {reached!r} s again and again")
            time, step_size = reached, end - reached

    def _leave_event_mode(self) -> None:
        """Update the discrete states until they stay, and enter Step Mode (FMI 3.0, 2.3.5)."""
        for _ in range(_EVENTS_AT_ONE_TIME):
            update, terminate, _, _, defined, time = self._fmu_called(self._fmu.updateDiscreteStates)
            if terminate:
                raise self._failed("fmi3UpdateDiscreteStates asks to end the simulation")
            if not update:
                self._next_event = float(time) if defined else None
                self._fmu_called(self._fmu.enterStepMode)
                return
        raise self._failed("fmi3UpdateDiscreteStates never comes to an end")

    def _needs_event_mode(self, variable: Variable) -> bool:
        return self._description.has_event_mode and variable.variability != "continuous"

    def _fmu_called(self, call: Callable[[], Any]) -> Any:  # noqa: ANN401 whatever the function of FMPy returns
        try:
            return call()
        except FMICallException as error:
            raise self._failed(f"{error.function} returned {STATUS_NAMES[error.status]}") from error
