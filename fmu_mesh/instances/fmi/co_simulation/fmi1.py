"""FMI 1.0 co-simulation behind the `Instance` Protocol.

FMPy takes the status of most functions of FMI 1.0 for text, so they are called by prototypes of our own.
"""

from __future__ import annotations

import ctypes
from collections.abc import Mapping

from fmpy.fmi1 import FMU1Slave

from ....rings.native import StepKind
from ...call_guard import call_named
from ..calls import cffi_function, checked_function
from ..fmi_versions import Fmi1
from ..fmu_values import DISCARD, WARNING
from ..loaded_fmu import FmuFunctions
from ..native_instance import NativeInstance
from .discarded_steps import SMALLER_STEPS, SMALLEST, StepStatus, discarded, take_sub_steps

__all__ = ["Fmi1Instance"]

_DO_STEP = "int (*)(void *, double, double, char)"
_INITIALIZE = ctypes.CFUNCTYPE(ctypes.c_int, ctypes.c_void_p, ctypes.c_double, ctypes.c_char, ctypes.c_double)
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


class Fmi1Instance(NativeInstance, Fmi1):
    """One instance of an FMI 1.0 co-simulation FMU."""

    _kind = StepKind.FMI1
    _end = "TerminateSlave"
    _functions = FmuFunctions(FMU1Slave, Fmi1.VALUES, "fmi1FreeSlaveInstance", _NEEDED, _NAMES)

    def advance(self, time: float, step_size: float) -> None:
        """One step of ``step_size`` from ``time`` (both in s) without rings, for callers with their own time base."""
        self._step(time, step_size, None)

    def _instantiate(self, **arguments: object) -> None:
        super()._instantiate(**arguments)
        dll = self._fmu.dll
        self._do_step = cffi_function(getattr(dll, f"{self._symbols}DoStep"), _DO_STEP)
        self._step_status = StepStatus(dll, lambda: self._component, self._symbols, self._failed)
        self._by_calls = bool(self._options.linear_inputs)

    def _complete(self, step: int, status: int | None) -> None:
        self._step(self._time_of(step), self._step_size, status)

    def _step(self, time: float, step_size: float, status: int | None) -> None:
        """Take a step, or complete it after fmiDoStep has returned ``status``."""
        if status is None:
            if self._derivatives:
                self._set_derivatives(self._derivatives)
            status = self._do_step(self._self, time, step_size, _NEW)
        status = self._step_status.settled(status)
        model = self.description
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
            status = self._step_status.settled(self._do_step(self._self, start, size, new_step))
            new_step = _REPEATED if status == DISCARD else _NEW
            return status

        return take_sub_steps(attempt, time, step_size)

    def _set_derivatives(self, derivatives: Mapping[str, float]) -> None:
        variables = [self._variables[name] for name in derivatives]
        count = len(variables)
        references = (ctypes.c_uint * count)(*(variable.value_reference for variable in variables))
        orders = (ctypes.c_int * count)(*[1] * count)
        signed = [-d if v.negated else d for v, d in zip(variables, derivatives.values(), strict=True)]
        function = checked_function(self._fmu.dll, self._symbols, "SetRealInputDerivatives", _SET_DERIVATIVES)
        values = (ctypes.c_double * count)(*signed)
        self._checked(lambda: function(self._component, references, count, orders, values))

    def _initialize(self, start_time: float, stop_time: float | None) -> None:
        """FmiInitializeSlave (FMI 1.0 CS, 3.3)."""
        function = checked_function(self._fmu.dll, self._symbols, "InitializeSlave", _INITIALIZE)
        times = start_time, b"\x00" if stop_time is None else b"\x01", stop_time or 0.0
        self._checked(lambda: call_named("fmiInitializeSlave", function, self._component, *times))
