"""FMI 1.0 co-simulation behind the `Instance` Protocol.

FMI 1.0 has no Initialization Mode: values can be set before `fmiInitializeSlave`, and be read after it (FMI 1.0 CS,
3.6). So the slave is initialized when the first value is asked for, with what is set by then, or else when
Initialization Mode is left; inputs that are set later hold from the first step on.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from fmpy.fmi1 import FMU1Slave

from ....errors import InitializationFailed
from ....system.layout import Part
from ....variables.model_description import Variable
from ....variables.value_types import Value, VariableType
from ..buffers import Buffer, NumberBuffer, StringBuffer
from ..callbacks import FMI1_CALLBACKS, register, register_component, unregister
from ..calls import Function, Pointer, hot
from ..fmu_instance import STATUS_NAMES, WARNING, FmuInstance, Verb
from .step_status import PENDING, SMALLER_STEPS, StepStatus, discarded
from .substeps import DISCARD, SMALLEST, take_sub_steps

__all__ = ["Fmi1Instance"]

_GET_OR_SET = ctypes.CFUNCTYPE(ctypes.c_int, ctypes.c_void_p, ctypes.c_void_p, ctypes.c_size_t, ctypes.c_void_p)
_DO_STEP = "int (*)(void *, double, double, char)"
_INITIALIZE = ctypes.CFUNCTYPE(ctypes.c_int, ctypes.c_void_p, ctypes.c_double, ctypes.c_char, ctypes.c_double)
_SET_DERIVATIVES = ctypes.CFUNCTYPE(
    ctypes.c_int, ctypes.c_void_p, ctypes.c_void_p, ctypes.c_size_t, ctypes.c_void_p, ctypes.c_void_p
)
_NEW, _REPEATED = b"\x01", b"\x00"
"""`newStep` of fmiDoStep."""
_TERMINATE = ctypes.CFUNCTYPE(ctypes.c_int, ctypes.c_void_p)
_SUFFIX: Final[dict[VariableType, str]] = {
    "Float64": "Real",
    "Int32": "Integer",
    "Enumeration": "Integer",
    "Boolean": "Boolean",
    "String": "String",
}
_C_TYPES: Final[dict[VariableType, type[Any]]] = {
    "Float64": np.float64,
    "Int32": np.intc,
    "Enumeration": np.intc,
    "Boolean": np.int8,
}
"""A Boolean is a `char` in FMI 1.0 (ME 2.1.2)."""


class Fmi1Instance(FmuInstance):
    """One instance of an FMI 1.0 co-simulation FMU.

    FMPy takes the status of most functions of FMI 1.0 for text, so they are called by prototypes of our own.
    """

    _direct_declaration = "int (*)(void *, void *, size_t, void *)"

    def do_step(self, step: int) -> None:
        """Set the inputs of row ``step``, advance to own step ``step + 1``, write the outputs to row ``step + 1``."""
        component = self._self
        slot = step & self._input_mask
        for function, references, count, rows, _ in self._direct_setters:
            status = function(component, references, count, rows[slot])
            if status > WARNING:
                raise self._failed(f"setting the inputs returned {STATUS_NAMES[status]}")
        for set_row in self._setters:
            set_row(slot)
        time = self._start_time + step * self._points * self._base_step_size  # `grid.time`, without a call
        self.advance(time, self._step_size)
        self._step = step + 1
        self._read_outputs((step + 1) & self._output_mask)

    def advance(self, time: float, step_size: float) -> None:
        """One step of ``step_size`` from ``time`` (both in s) without rings, for callers with their own time base."""
        status = self._do_step(self._self, time, step_size, _NEW)
        if status > WARNING:
            self._finish(time, step_size, status)

    def _finish(self, time: float, step_size: float, status: int) -> None:
        """Bring a step to its end that was not simply taken.

        Raises:
            StepFailed: it cannot be.
        """
        if status == PENDING:
            status = self._waited()
        model = self._description
        repeats = status == DISCARD and model.can_handle_variable_step_size and model.can_reject_steps
        repeats = repeats and not self._options.linear_inputs  # the parts of a step have no derivatives of their own
        if repeats:
            status = self._repeat(time, step_size)
        if status <= WARNING:
            return
        if status != DISCARD:
            raise self._failed(f"fmiDoStep returned {STATUS_NAMES[status]}")
        messages = self._last_messages
        last_time = self._step_status.last_successful_time()
        self._last_messages = messages  # what it says to the question is not why the step failed
        raise self._failed(discarded("fmiDoStep", last_time, SMALLEST if repeats else None), hint=SMALLER_STEPS)

    def _repeat(self, time: float, step_size: float) -> int:
        """Take a step that was discarded in smaller ones; a step that repeats another one is told so (FMI 1.0, 3.4)."""
        new_step = _REPEATED

        def attempt(start: float, size: float) -> int:
            nonlocal new_step
            status = self._do_step(self._self, start, size, new_step)
            if status == PENDING:
                status = self._waited()
            new_step = _REPEATED if status == DISCARD else _NEW
            return status

        return take_sub_steps(attempt, time, step_size)

    def _waited(self) -> int:
        status = self._step_status.wait()
        if status is None:
            raise self._failed("fmiDoStep returned pending, and fmiGetStatus does not tell when the step is done")
        return status

    def set_input_derivatives(self, derivatives: Mapping[str, float]) -> None:
        """First time derivatives (1/s) of Real inputs for the next step (FMI 1.0 CS, 3.3)."""
        variables = [self._variables[name] for name in derivatives]
        self._derivatives: list[float] = [
            -slope if variable.negated else slope
            for variable, slope in zip(variables, derivatives.values(), strict=True)
        ]
        self._derivative_references = [variable.value_reference for variable in variables]

    def _step_with_derivatives(self, component: Pointer, time: float, step_size: float, new_step: bytes) -> int:
        """fmiDoStep, after the derivatives of the inputs, which are set after their values."""
        count = len(self._derivatives)
        references = (ctypes.c_uint * count)(*self._derivative_references)
        orders = (ctypes.c_int * count)(*[1] * count)
        slopes = (ctypes.c_double * count)(*self._derivatives)
        status = self._set_derivatives(self._component, references, count, orders, slopes)
        if status > WARNING:
            raise self._failed(f"fmiSetRealInputDerivatives returned {STATUS_NAMES[status]}")
        return self._step_of_fmu(component, time, step_size, new_step)

    def get_values(self, names: Sequence[str]) -> list[Value]:
        """Current values of variables by name; before the end of Initialization Mode this initializes the slave."""
        if self._state == "initialization":
            self._initialize()
        return super().get_values(names)

    def close(self) -> None:
        """Terminate if allowed, free the instance and remove its files. Never raises; may be called twice."""
        super().close()
        unregister(self)

    def _instantiate(self, folder: Path) -> None:
        register(self.name, self)
        self._initialized = False
        fmu = FMU1Slave(
            guid=self._description.guid,
            modelIdentifier=self._description.model_identifier,
            unzipDirectory=str(folder),
            instanceName=self.name,
        )
        fmu.instantiate(functions=FMI1_CALLBACKS, loggingOn=False)
        if not fmu.component:
            raise RuntimeError("fmiInstantiateSlave returned no instance")
        self._fmu = fmu
        self._component = fmu.component
        register_component(self._component, self)
        self._do_step = hot(getattr(fmu.dll, self._prefixed("DoStep")), _DO_STEP)
        self._step_status = StepStatus(fmu.dll, fmu.component, self._prefixed(""))
        if self._options.linear_inputs:
            self._step_of_fmu: Function = self._do_step
            self._do_step = self._step_with_derivatives
            self._set_derivatives = _SET_DERIVATIVES((self._prefixed("SetRealInputDerivatives"), fmu.dll))
            self.set_input_derivatives({})

    def _enter_initialization(self, start_time: float, stop_time: float | None, start_values: dict[str, Value]) -> None:
        self._times = start_time, stop_time
        self.set_values(start_values)

    def _exit_initialization(self) -> None:
        self._initialize()

    def _initialize(self) -> None:
        """Call `fmiInitializeSlave`, once (FMI 1.0 CS, 3.3)."""
        if self._initialized:
            return
        start_time, stop_time = self._times
        function = _INITIALIZE((self._prefixed("InitializeSlave"), self._fmu.dll))
        stop_time_defined = b"\x00" if stop_time is None else b"\x01"
        status = function(self._component, start_time, stop_time_defined, stop_time or 0.0)
        if status > WARNING:
            self._state = "failed"
            text = f"fmiInitializeSlave returned {STATUS_NAMES[status]}{self._said()}"
            raise InitializationFailed(text, instance=self.name)
        self._initialized = True

    def _terminate(self) -> None:
        if self._initialized:
            _TERMINATE((self._prefixed("TerminateSlave"), self._fmu.dll))(self._component)

    def _free(self) -> None:
        self._fmu.freeInstance()

    def _prefixed(self, function: str) -> str:
        return f"{self._description.model_identifier}_fmi{function}"

    def _function_name(self, verb: Verb, type_: VariableType) -> str:
        return f"fmi{verb}{_SUFFIX[type_]}"

    def _function(self, verb: Verb, type_: VariableType) -> Callable[..., int]:
        return _GET_OR_SET((self._prefixed(f"{verb}{_SUFFIX[type_]}"), self._fmu.dll))

    def _buffer(self, type_: VariableType, variables: Sequence[Variable]) -> Buffer:
        if type_ == "String":
            return StringBuffer(len(variables))
        negated = [variable.negated for variable in variables]
        signs = np.where(negated, -1, 1).astype(np.int8) if any(negated) else None
        return NumberBuffer(type_, _C_TYPES[type_], len(variables), signs)

    def _is_direct(self, part: Part) -> bool:
        negated = any(self._variables[column.name].negated for column in part.columns)
        return part.type in ("Float64", "Int32") and not negated

    def _call(self, function: Callable[..., int], references: Sequence[int], buffer: Buffer, _size: int) -> int:
        array = (ctypes.c_uint * len(references))(*references)
        return function(self._component, ctypes.addressof(array), len(references), buffer.address)

    def _call_direct(self, function: Function, references: Pointer, count: int, row: Pointer, _size: int) -> int:
        return function(self._self, references, count, row)
