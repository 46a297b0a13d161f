"""FMI 2.0 co-simulation behind the `Instance` Protocol.

FMPy loads the library and declares its functions; the hot loop calls them through prototypes of its own, on arrays
that are allocated once: an input row is set from, and an output row read into, the memory of a `Ring` directly.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from fmpy.fmi1 import FMICallException
from fmpy.fmi2 import FMU2Slave, fmi2Terminated

from ....errors import TerminationRequested
from ....rings.ring import Ring
from ....simtime import TimeGrid
from ....system.layout import Part
from ....variables.model_description import Variable
from ....variables.value_types import Value, VariableType
from ..buffers import Buffer, NumberBuffer, StringBuffer
from ..callbacks import fmi2_callbacks, register, register_component, unregister
from ..calls import Function, Pointer, hot
from ..fmu_instance import STATUS_NAMES, WARNING, FmuInstance, Verb
from ..model_exchange.solver import resolvable
from ..state import Standing
from .fmi2_steps import RetriedSteps
from .fused import DOING, GETTING, STATUS_BITS, STEPPING, Fused, fmi2_step, fuse
from .step_status import PENDING, RETRY, SMALLER_STEPS, StepStatus, discarded
from .substeps import DISCARD, SMALLEST

__all__ = ["Fmi2Instance", "Fmi2Values"]

_GET_OR_SET = ctypes.CFUNCTYPE(ctypes.c_int, ctypes.c_void_p, ctypes.c_void_p, ctypes.c_size_t, ctypes.c_void_p)
_DO_STEP = "int (*)(void *, double, double, int)"
_SUFFIX: Final[dict[VariableType, str]] = {
    "Float64": "Real",
    "Int32": "Integer",
    "Enumeration": "Integer",
    "Boolean": "Boolean",
    "String": "String",
}
_DIRECT: Final = ("Float64", "Int32")
"""The types that lie in a ring as in C; a Boolean and an Enumeration are an `int` in FMI 2.0 (2.1.2)."""


class Fmi2Values(FmuInstance):
    """What both kinds of FMI 2.0 instances share: values, initialization and the end."""

    _library: type[Any]
    _direct_declaration = "int (*)(void *, void *, size_t, void *)"

    def close(self) -> None:
        """Terminate if allowed, free the instance and remove its files. Never raises; may be called twice."""
        super().close()
        unregister(self)

    def _instantiate(self, folder: Path) -> None:
        register(self.name, self)
        fmu = self._library(
            guid=self._description.guid,
            modelIdentifier=self._description.model_identifier,
            unzipDirectory=str(folder),
            instanceName=self.name,
        )
        fmu.instantiate(callbacks=fmi2_callbacks(self), loggingOn=False)
        self._fmu = fmu
        self._component = fmu.component
        register_component(self._component, self)

    def _enter_initialization(self, start_time: float, stop_time: float | None, start_values: dict[str, Value]) -> None:
        """FMI 2.0, 2.1.6 and 4.2.1."""
        tolerance = self._tolerance()
        self._initializing(
            "fmi2SetupExperiment",
            lambda: self._fmu.setupExperiment(tolerance=tolerance, startTime=start_time, stopTime=stop_time),
        )
        self.set_values(start_values)
        self._initializing("fmi2EnterInitializationMode", self._fmu.enterInitializationMode)

    def _tolerance(self) -> float | None:
        """The tolerance that the FMU is told (FMI 2.0, 2.1.6)."""
        return self._options.tolerance or self._description.default_experiment.tolerance

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

    def _call_direct(self, function: Function, references: Pointer, count: int, row: Pointer, _size: int) -> int:
        return function(self._self, references, count, row)


class Fmi2Instance(Fmi2Values):
    """One instance of an FMI 2.0 co-simulation FMU."""

    _library = FMU2Slave
    _retrying: RetriedSteps | None = None
    _terminated = False
    """Whether the FMU has asked to end the simulation with the step that is complete now."""

    def bind(self, inputs: Ring, outputs: Sequence[Ring], grid: TimeGrid, points: int, step: int = 0) -> None:
        """Let `do_step` work on these rings, ``points`` of ``grid`` each; write the current outputs as row ``step``."""
        super().bind(inputs, outputs, grid, points, step)
        is_plain = self._do_step is self._plain_do_step and not (self._setters or self._getters or self._terminated)
        self._fused = self._fuse() if is_plain else None
        self._hot = (self._fused.call if self._fused is not None else None, self._input_mask, self._output_mask)

    def do_step(self, step: int) -> None:
        """Set the inputs of row ``step``, advance to own step ``step + 1``, write the outputs to row ``step + 1``."""
        fused, input_mask, output_mask = self._hot
        if fused is None:
            self._step_by_calls(step)
            return
        time = self._start_time + step * self._points * self._base_step_size  # `grid.time`, without a call
        if outcome := fused(step & input_mask, time, (step + 1) & output_mask):
            self._finish_fused(outcome, step, time)
        self._step = step + 1

    def _step_by_calls(self, step: int) -> None:
        """`do_step` where something is between the rows and the FMU: a conversion, or a step that is retried."""
        self._check_not_terminated()
        self._set_inputs(step & self._input_mask)
        time = self._start_time + step * self._points * self._base_step_size
        status = self._do_step(self._self, time, self._step_size, 1)
        if status > WARNING:
            self._finish(status, time + self._step_size)
        self._step = step + 1
        self._read_outputs((step + 1) & self._output_mask)

    def _fuse(self) -> Fused | None:
        step = fmi2_step(self._plain_do_step, self._step_size)
        return fuse(self._self, self._direct_setters, step, self._direct_getters)

    def _finish_fused(self, outcome: int, step: int, time: float) -> None:
        """What follows from a status above warning, as in `_step_by_calls`."""
        stage, status = divmod(outcome, 1 << STATUS_BITS)
        if stage == STEPPING:
            self._finish(status, time + self._step_size)
            self._step = step + 1
            self._read_outputs((step + 1) & self._output_mask)
            return
        if stage == GETTING:
            self._step = step + 1
        raise self._failed(f"{DOING[stage]} returned {STATUS_NAMES[status]}")

    def advance(self, time: float, step_size: float) -> None:
        """One step of ``step_size`` from ``time`` (both in s) without rings, for callers with their own time base."""
        self._check_live()
        self._check_not_terminated()
        try:
            self._fmu.doStep(currentCommunicationPoint=time, communicationStepSize=step_size)
        except FMICallException as error:
            self._finish(error.status, time + step_size)

    def set_values(self, values: Mapping[str, Value]) -> None:
        """Set variables by name; an FMU that has asked to end takes no more (FMI 2.0, 4.2.4)."""
        if not self._terminated:
            super().set_values(values)

    def set_input_derivatives(self, derivatives: Mapping[str, float]) -> None:
        """First time derivatives (1/s) of Real inputs for the next step (FMI 2.0, 4.2.1)."""
        self._derivatives: dict[int, float] = {
            self._variables[name].value_reference: slope for name, slope in derivatives.items()
        }

    def _step_with_derivatives(self, component: Pointer, time: float, step_size: float, no_set_state: int) -> int:
        """fmi2DoStep, after the derivatives of the inputs, which are set after their values."""
        references, slopes = list(self._derivatives), list(self._derivatives.values())
        try:
            self._fmu.setRealInputDerivatives(references, [1] * len(references), slopes)
        except FMICallException as error:
            raise self._failed(f"{error.function} returned {STATUS_NAMES[error.status]}") from error
        return self._step_of_fmu(component, time, step_size, no_set_state)

    def _instantiate(self, folder: Path) -> None:
        super()._instantiate(folder)
        self._plain_do_step: Function = hot(self._fmu.dll.fmi2DoStep, _DO_STEP)
        self._do_step = self._plain_do_step
        self._step_status = StepStatus(self._fmu.dll, self._component, "fmi2")
        if self._options.retry_discarded_steps:
            self._retrying = RetriedSteps(self._fmu, self._do_step, self._waited, self._asks_to_end, self._failed)
            self._do_step = self._retrying
        if self._options.linear_inputs:
            self._step_of_fmu, self._do_step = self._do_step, self._step_with_derivatives
            self._derivatives = {}

    def _stand(self, standing: Standing) -> None:
        super()._stand(standing)
        self._terminated = False

    def _finish(self, status: int, end: float) -> None:
        """Bring a step to its ``end`` (s) that was not simply taken (FMI 2.0, 4.2.1).

        Raises:
            StepFailed: it cannot be.
            TerminationRequested: the FMU asks to end the simulation before the end of the step.
        """
        if status == PENDING:
            status = self._waited()
        if status <= WARNING:
            return
        if status != DISCARD:
            raise self._failed(f"fmi2DoStep returned {STATUS_NAMES[status]}")
        messages = self._last_messages
        if self._asks_to_end() if self._retrying is None else self._retrying.ends:
            # The outputs are valid up to the last successful time, and are a row if that is the end of the step.
            last_time = self._step_status.last_successful_time()
            self._terminated = last_time is not None and not resolvable(last_time, end)
            if not self._terminated:
                raise self._end_requested()
            self._hot = (None, 0, 0)  # the next step is refused, which costs the compiled call nothing
            return
        if self._retrying is not None:
            raise self._failed(discarded("fmi2DoStep", None, SMALLEST), hint=SMALLER_STEPS)
        last_time = self._step_status.last_successful_time()
        self._last_messages = messages  # what it says to the questions is not why the step failed
        model = self._description
        can_retry = (
            model.can_handle_variable_step_size and model.can_get_and_set_state and not self._options.linear_inputs
        )
        hint = RETRY if can_retry else SMALLER_STEPS
        raise self._failed(discarded("fmi2DoStep", last_time, None), hint=hint)

    def _check_not_terminated(self) -> None:
        if self._terminated:
            raise self._end_requested()

    def _end_requested(self) -> TerminationRequested:
        return TerminationRequested("the FMU asked to end the simulation", instance=self.name)

    def _waited(self) -> int:
        status = self._step_status.wait()
        if status is None:
            raise self._failed("fmi2DoStep returned pending, and fmi2GetStatus does not tell when the step is done")
        return status

    def _asks_to_end(self) -> bool:
        """Whether a discarded step is a wish to end the simulation; most FMUs do not know of this question."""
        value = ctypes.c_int(0)
        try:
            self._fmu.fmi2GetBooleanStatus(self._component, fmi2Terminated, ctypes.byref(value))
        except FMICallException:
            return False
        return bool(value.value)

    def _free(self) -> None:
        if self._retrying is not None:
            self._retrying.free()
        super()._free()
