"""FMI 2.0 co-simulation behind the `Instance` Protocol."""

from __future__ import annotations

import ctypes
import math
from collections.abc import Callable, Mapping, Sequence

from fmpy.fmi1 import FMICallException
from fmpy.fmi2 import FMU2Slave, fmi2Terminated

from ....rings.native import StepKind
from ....rings.ring import Ring
from ....simtime import TimeGrid, resolvable
from ....variables.value_types import Value
from ..callbacks import unregister
from ..calls import cffi_function
from ..fmi_versions import Fmi2
from ..fmu_instance import Bookkeeping
from ..fmu_values import DISCARD, WARNING
from ..loaded_fmu import FmuFunctions
from ..native_instance import NativeInstance
from .discarded_steps import RETRY, SMALLER_STEPS, SMALLEST, StepStatus, discarded, take_sub_steps

__all__ = ["Fmi2Instance"]

_DO_STEP = "int (*)(void *, double, double, int)"
_ENDS = 998
"""Our own status for a discarded step with which the FMU asks to end the simulation."""


class Fmi2Instance(NativeInstance, Fmi2):
    """One instance of an FMI 2.0 co-simulation FMU."""

    _kind = StepKind.FMI2
    _functions = FmuFunctions(FMU2Slave, Fmi2.VALUES, "fmi2FreeInstance", (*Fmi2.NEEDED, "fmi2DoStep"), Fmi2.NAMES)
    _bound: tuple[object, ...] = ()  # what it is bound to
    _terminated = False  # whether the FMU has asked to end the simulation with the step that is complete now

    def advance(self, time: float, step_size: float) -> None:
        """One step of ``step_size`` from ``time`` (both in s) without rings, for callers with their own time base."""
        self._check_live()
        self._check_not_terminated()
        try:
            self._fmu.doStep(currentCommunicationPoint=time, communicationStepSize=step_size)
        except FMICallException as error:
            self._finish(error.status, time + step_size)

    def set_values(self, values: Mapping[str, Value]) -> None:
        """Set variables by name; an FMU that has asked to end takes no more values (FMI 2.0, 4.2.4)."""
        if not self._terminated:
            super().set_values(values)

    def setter(self, name: str) -> Callable[[Value], None] | None:
        """See `Prepares`."""
        if (put := super().setter(name)) is None:
            return None

        def put_before_end(value: Value) -> None:
            if not self._terminated:
                put(value)

        return put_before_end

    def bind(self, inputs: Ring, outputs: Sequence[Ring], grid: TimeGrid, points: int, step: int = 0) -> None:
        """See `Instance`; with what it was bound to before, only the outputs are written."""
        bound = inputs, tuple(outputs), grid, points
        if bound == self._bound:
            self._follow_component()
            self._said.note(step=step)
            self._read_outputs(step)
            return
        super().bind(inputs, outputs, grid, points, step)
        self._bound = bound

    def end_run(self) -> bool:
        """See `BeginsAgain` (fmi2Reset; FMI 2.0, 2.1.6)."""
        if self._kept is None or not self._live or self._state != "stepping":
            return False
        self._end_simulation()
        if self._is_used_up:
            return False
        if not self._was_reset:
            self._model.free()
        unregister(self)
        return True

    def begin_again(self) -> None:
        """See `BeginsAgain`."""
        self._terminated = self._was_reset = False
        self._derivatives, self._last_messages, self._kept_state = {}, [], ctypes.c_void_p()
        self._said.note(step=-1, quiet_until=math.inf)
        self._state = "instantiated"
        try:
            self._make()
        except Exception as error:
            self._state = "failed"
            raise self._refused(str(error)) from error

    def _instantiate(self, **arguments: object) -> None:
        super()._instantiate(**arguments)
        dll, options = self._fmu.dll, self._options
        self._do_step = cffi_function(dll.fmi2DoStep, _DO_STEP)
        self._step_status = StepStatus(dll, lambda: self._component, self._symbols, self._failed)
        self._by_calls = bool(options.retry_discarded_steps or options.linear_inputs)
        self._kept_state = ctypes.c_void_p()  # that before the step, where steps are retried

    def _step_by_calls(self, step: int) -> None:
        self._check_not_terminated()
        super()._step_by_calls(step)

    def _complete(self, step: int, status: int | None) -> None:
        time = self._time_of(step)
        if status is None:
            if self._derivatives:
                self._set_derivatives(self._derivatives)
            if self._options.retry_discarded_steps:
                status = self._checked(lambda: self._retried(time, self._step_size))
            else:
                status = self._do_step(self._self, time, self._step_size, 1)
        if status > WARNING:
            self._finish(status, time + self._step_size)

    def _retried(self, time: float, step_size: float) -> int:
        """Take a step, a discarded one in smaller steps; `DISCARD`: the smallest was discarded, `_ENDS`: it is the end.

        After fmi2Discard, only fmi2SetFMUstate is allowed (FMI 2.0, 4.2.4), so the state is kept before every step.
        """
        fmu, state = self._fmu, ctypes.byref(self._kept_state)

        def attempt(start: float, size: float) -> int:
            fmu.fmi2GetFMUstate(self._component, state)
            status = self._step_status.settled(self._do_step(self._self, start, size, 0))
            if status == DISCARD:
                if self._asks_to_end():
                    return _ENDS
                fmu.fmi2SetFMUstate(self._component, self._kept_state)
            return status

        status = attempt(time, step_size)
        return take_sub_steps(attempt, time, step_size) if status == DISCARD else status

    def _set_derivatives(self, derivatives: Mapping[str, float]) -> None:
        references = [self._variables[name].value_reference for name in derivatives]
        orders, values = [1] * len(references), list(derivatives.values())
        self._checked(lambda: self._fmu.setRealInputDerivatives(references, orders, values))

    def _finish(self, status: int, end: float) -> None:
        """Complete a step to ``end`` (s) whose ``status`` is above warning (FMI 2.0, 4.2.1).

        `TerminationRequested`: the FMU asks to end the simulation before the end of the step.
        """
        status = self._step_status.settled(status)
        if status <= WARNING:
            return
        retries = self._options.retry_discarded_steps
        if status not in (DISCARD, _ENDS):
            raise self._failed("fmi2DoStep", status=status)
        messages = self._last_messages
        if status == _ENDS or (not retries and self._asks_to_end()):
            # The outputs are those of the last successful time: a row, if this is the end of the step.
            last_time = self._step_status.last_successful_time()
            self._terminated = last_time is not None and not resolvable(last_time, end)
            if not self._terminated:
                raise self._end_requested()
            self._said.note(quiet_until=-math.inf)  # `_step_by_calls` refuses the next step
            return
        if retries:
            raise self._failed(discarded("fmi2DoStep", None, SMALLEST), hint=SMALLER_STEPS)
        last_time = self._step_status.last_successful_time()
        self._last_messages = messages  # a message about these questions is not the reason of the failure
        model = self.description
        can_retry = (
            model.can_handle_variable_step_size and model.can_get_and_set_state and not self._options.linear_inputs
        )
        hint = RETRY if can_retry else SMALLER_STEPS
        raise self._failed(discarded("fmi2DoStep", last_time, None), hint=hint)

    def _check_not_terminated(self) -> None:
        if self._terminated:
            raise self._end_requested()

    def _asks_to_end(self) -> bool:
        """Whether a discarded step means that the FMU asks to end; most FMUs do not know this question."""
        value = ctypes.c_int(0)
        try:
            self._fmu.fmi2GetBooleanStatus(self._component, fmi2Terminated, ctypes.byref(value))
        except FMICallException:
            return False
        return bool(value.value)

    def _restore(self, kept: Bookkeeping) -> None:
        super()._restore(kept)
        self._terminated = False
        self._said.note(quiet_until=math.inf)

    def _release(self) -> None:
        if self._kept_state.value is not None:
            self._fmu.fmi2FreeFMUstate(self._component, ctypes.byref(self._kept_state))
