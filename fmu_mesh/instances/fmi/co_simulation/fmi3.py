"""FMI 3.0 co-simulation behind the `Instance` Protocol.

With event mode in use, discrete inputs and tunable parameters change in event mode only (FMI 3.0, 4.2.1,
fmi3EnterEventMode); continuous inputs are set in step mode. Owns this distinction; the steps, early return and events
are `fmu_mesh.instances.fmi.co_simulation.fmi3_steps`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, TypeVar

from fmpy.fmi1 import FMICallException
from fmpy.fmi3 import FMU3Slave

from ....errors import FmuError, TerminationRequested
from ....rings.ring import Ring
from ....simtime import TimeGrid
from ....system.layout import Part
from ....variables.value_types import Value
from ..calls import DirectCall
from ..fmi_versions import Fmi3Values
from ..fmu_values import STATUS_NAMES, Verb
from ..model_exchange.solver import SolverFailed, resolvable
from ..state import Bookkeeping
from .compiled_step import DOING, GETTING, STATUS_BITS, STEPPING, CompiledStep, compile_step
from .fmi3_steps import Fmi3Steps

__all__ = ["Fmi3Instance"]

T = TypeVar("T")


class Fmi3Instance(Fmi3Values):
    """One instance of an FMI 3.0 co-simulation FMU."""

    _library = FMU3Slave
    _function_names: Mapping[str, str] = {"instantiate": "fmi3InstantiateCoSimulation"}
    _steps: Fmi3Steps
    _discrete_row: tuple[bytes | list[Any], ...] = ()
    _time = 0.0
    """The time of the FMU in s, between two steps."""

    def set_values(self, values: Mapping[str, Value]) -> None:
        """Set variables by name; between two steps in event mode, if the FMU has it."""
        if self._state != "stepping":
            super().set_values(values)
            return
        set_values = super().set_values
        if not self._steps.terminated:
            self._checked(lambda: self._steps.event(self._time, lambda: set_values(values)))

    def bind(self, inputs: Ring, outputs: Sequence[Ring], grid: TimeGrid, points: int, step: int = 0) -> None:
        """See `Instance`."""
        self._discrete: list[Any] = []
        self._discrete_direct: list[DirectCall] = []
        self._discrete_setters: list[Callable[[int], None]] = []
        super().bind(inputs, outputs, grid, points, step)
        self._compiled = None if self._setters or self._getters else self._compile()
        call = None if self._compiled is None else self._compiled.call
        self._in_step = (call, self._steps, self._input_mask, self._output_mask)

    def do_step(self, step: int) -> None:
        """Set the inputs of row ``step``, advance to own step ``step + 1``, write the outputs to row ``step + 1``."""
        compiled, steps, input_mask, output_mask = self._in_step
        start = self._start_time + step * self._points * self._base_step_size
        if self._discrete:
            self._set_discrete(step & input_mask)
        end = self._start_time + (step + 1) * self._points * self._base_step_size
        if compiled is not None and steps.quiet_until > end:
            if outcome := compiled(step & input_mask, start, (step + 1) & output_mask):
                self._finish_compiled(outcome, step, start, end)
            else:
                self._time = end
            self._step = step + 1
            return
        self._set_inputs(step & input_mask)
        self._advance(end, lambda: steps.step(start, self._step_size, end))
        self._step = step + 1
        self._read_outputs((step + 1) & output_mask)

    def advance(self, time: float, step_size: float) -> None:
        """One step of ``step_size`` from ``time`` (both in s) without rings, for callers with their own time base."""
        self._check_live()
        end = time + step_size
        self._advance(end, lambda: self._steps.step(time, step_size, end))

    def _uses(self) -> dict[str, bool]:
        return {"eventModeUsed": self._description.has_event_mode, "earlyReturnAllowed": True}

    def _enter_initialization(self, start_time: float, stop_time: float | None, start_values: dict[str, Value]) -> None:
        super()._enter_initialization(start_time, stop_time, start_values)
        self._time = start_time
        self._steps = Fmi3Steps(self._fmu, self._description)
        self._checked(lambda: self._steps.start(start_time))

    def _exit_initialization(self) -> None:
        """An FMU with event mode is in it now."""
        super()._exit_initialization()
        self._checked(lambda: self._steps.exit_initialization(self._time))

    def _compile(self) -> CompiledStep | None:
        step = self._steps.compiled(self._step_size)
        return compile_step(self._self, self._direct_setters, step, self._direct_getters, sized=True)

    def _finish_compiled(self, outcome: int, step: int, start: float, end: float) -> None:
        """Continue after a status above warning, or after a step with an event or an early return."""
        stage, status = divmod(outcome, 1 << STATUS_BITS)
        if stage == STEPPING:
            self._advance(end, lambda: self._steps.finish(status, start, self._step_size, end))
            self._step = step + 1
            self._read_outputs((step + 1) & self._output_mask)
            return
        if stage == GETTING:
            self._time, self._step = end, step + 1
        raise self._failed(f"{DOING[stage]} returned {STATUS_NAMES[status]}")

    def _advance(self, end: float, step: Callable[[], float]) -> None:
        """Take a step to ``end`` (s); ``step`` returns the time that it has reached."""
        self._time = self._checked(step)
        if resolvable(self._time, end):
            raise TerminationRequested("the FMU asked to end the simulation", instance=self.name)

    def _prepare(self, verb: Verb, part: Part, array: Any) -> None:  # noqa: ANN401 an array of any dtype
        direct, others = len(self._direct_setters), len(self._setters)
        super()._prepare(verb, part, array)
        continuous = all(self._variables[column.name].variability == "continuous" for column in part.columns)
        if verb == "Set" and self._description.has_event_mode and not continuous:
            self._discrete.append(array)
            self._discrete_direct += self._direct_setters[direct:]
            self._discrete_setters += self._setters[others:]
            del self._direct_setters[direct:], self._setters[others:]

    def _set_discrete(self, slot: int) -> None:
        """In event mode: set the inputs that change in event mode only, if they did change."""
        row = tuple(a[slot].tolist() if a.dtype.hasobject else a[slot].tobytes() for a in self._discrete)
        if row == self._discrete_row or self._steps.terminated:
            return
        self._discrete_row = row
        set_row = self._set_row
        self._checked(
            lambda: self._steps.event(self._time, lambda: set_row(slot, self._discrete_direct, self._discrete_setters))
        )

    def _checked(self, call: Callable[[], T]) -> T:
        try:
            return call()
        except (FMICallException, SolverFailed) as error:
            raise self._failure(error) from error

    def _failure(self, error: FMICallException | SolverFailed) -> FmuError:
        if isinstance(error, SolverFailed):
            return self._failed(str(error))
        return self._failed(f"{error.function} returned {STATUS_NAMES[error.status]}")

    def _bookkeeping(self) -> Bookkeeping:
        next_event, event_time = self._steps.place
        ticks = self._steps.clocks.place
        return Bookkeeping(self._step, self._time, next_event, self._discrete_row, ticks, event_time)

    def _restore(self, kept: Bookkeeping) -> None:
        super()._restore(kept)
        self._time = kept.time or 0.0
        self._discrete_row = kept.row
        self._steps.resume(kept.next_event, kept.last_event)
        self._steps.clocks.resume(kept.ticks)
