"""FMI 1.0 co-simulation behind the `Instance` Protocol.

FMPy takes the status of most functions of FMI 1.0 for text, so they are called by prototypes of our own.
"""

from __future__ import annotations

import ctypes
from collections.abc import Mapping

from fmpy.fmi1 import FMICallException, FMU1Slave

from ....rings.native import StepKind
from ...call_guard import call_named
from ..calls import cffi_function, declared
from ..fmi_versions import Fmi1Values
from ..fmu_values import DISCARD, WARNING
from ..loaded_fmu import FmuFunctions
from .discarded_steps import PENDING, SMALLER_STEPS, SMALLEST, StepStatus, discarded, take_sub_steps
from .native_instance import NativeInstance

__all__ = ["Fmi1Instance"]

_DO_STEP = "int (*)(void *, double, double, char)"
_INITIALIZE = ctypes.CFUNCTYPE(ctypes.c_int, ctypes.c_void_p, ctypes.c_double, ctypes.c_char, ctypes.c_double)
_TERMINATE = ctypes.CFUNCTYPE(ctypes.c_int, ctypes.c_void_p)
_SET_DERIVATIVES = ctypes.CFUNCTYPE(
    ctypes.c_int, ctypes.c_void_p, ctypes.c_void_p, ctypes.c_size_t, ctypes.c_void_p, ctypes.c_void_p
)
_NAMES = {
    "instantiate": "fmiInstantiateSlave",
    "fmi1FreeSlaveInstance": "fmiFreeSlaveInstance",
    "reset": "fmiResetSlave",
}
_NEEDED = "fmiInstantiateSlave", "fmiInitializeSlave", "fmiDoStep"
_NEW, _REPEATED = b"\x01", b"\x00"
"""`newStep` of fmiDoStep."""


class Fmi1Instance(NativeInstance, Fmi1Values):
    """One instance of an FMI 1.0 co-simulation FMU."""

    _kind = StepKind.FMI1
    _functions = FmuFunctions(FMU1Slave, "fmi", "fmi1FreeSlaveInstance", _NEEDED, _NAMES)
    _derivatives: Mapping[str, float] = {}

    def advance(self, time: float, step_size: float) -> None:
        """One step of ``step_size`` from ``time`` (both in s) without rings, for callers with their own time base."""
        if self._derivatives:
            self._set_derivatives(self._derivatives)
        status = self._do_step(self._self, time, step_size, _NEW)
        if status > WARNING:
            self._finish(time, step_size, status)

    def set_input_derivatives(
        self,
        derivatives: Mapping[str, float],
        *,
        continuous: bool = False,  # noqa: ARG002 for model exchange
    ) -> None:
        """First time derivatives (1/s) of Real inputs for the next step (FMI 1.0 CS, 3.3)."""
        self._derivatives = derivatives  # the FMU gets them after the values of these inputs

    def _instantiated(self) -> None:
        dll = self._fmu.dll
        self._do_step = cffi_function(getattr(dll, self._symbol("DoStep")), _DO_STEP)
        self._step_status = StepStatus(dll, self._component, self._symbol(""))

    def _needs_python(self) -> bool:
        return bool(self._options.linear_inputs)

    def _take_step(self, step: int) -> None:
        self.advance(self._time_of(step), self._step_size)

    def _complete(self, step: int, status: int) -> None:
        self._finish(self._time_of(step), self._step_size, status)

    def _finish(self, time: float, step_size: float, status: int) -> None:
        """Complete a step whose ``status`` is above warning.

        Raises:
            StepFailed: the step cannot be completed.
        """
        if status == PENDING:
            status = self._waited()
        model = self._description
        repeats = status == DISCARD and model.can_handle_variable_step_size and model.can_reject_steps
        repeats = repeats and not self._options.linear_inputs  # sub-steps would need derivatives of their own
        if repeats:
            status = self._repeat(time, step_size)
        if status <= WARNING:
            return
        if status != DISCARD:
            raise self._failed("fmiDoStep", status=status)
        messages = self._last_messages
        last_time = self._step_status.last_successful_time()
        self._last_messages = messages  # a message about this question is not the reason of the failure
        raise self._failed(discarded("fmiDoStep", last_time, SMALLEST if repeats else None), hint=SMALLER_STEPS)

    def _repeat(self, time: float, step_size: float) -> int:
        """Take a discarded step in smaller ones; `newStep` is false for a step that repeats one (FMI 1.0, 3.4)."""
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

    def _set_derivatives(self, derivatives: Mapping[str, float]) -> None:
        variables = [self._variables[name] for name in derivatives]
        count = len(variables)
        references = (ctypes.c_uint * count)(*(variable.value_reference for variable in variables))
        orders = (ctypes.c_int * count)(*[1] * count)
        signed = [-d if v.negated else d for v, d in zip(variables, derivatives.values(), strict=True)]
        function = declared(self._fmu.dll, self._symbol("SetRealInputDerivatives"), _SET_DERIVATIVES)
        status = function(self._component, references, count, orders, (ctypes.c_double * count)(*signed))
        if status > WARNING:
            raise self._failed("fmiSetRealInputDerivatives", status=status)

    def _initialize(self, start_time: float, stop_time: float | None) -> None:
        """FmiInitializeSlave (FMI 1.0 CS, 3.3)."""
        name = "fmiInitializeSlave"
        function = declared(self._fmu.dll, self._symbol("InitializeSlave"), _INITIALIZE)
        stop_time_defined = b"\x00" if stop_time is None else b"\x01"
        status = call_named(name, function, self._component, start_time, stop_time_defined, stop_time or 0.0)
        if status > WARNING:
            raise self._failed(name, status=status)

    def _terminate_initialized(self) -> None:
        function = declared(self._fmu.dll, self._symbol("TerminateSlave"), _TERMINATE)
        status = call_named("fmiTerminateSlave", function, self._component)
        if status > WARNING:
            raise FMICallException(function="fmiTerminateSlave", status=status)
