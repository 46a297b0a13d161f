"""FMI 3.0 co-simulation behind the `Instance` Protocol.

With event mode in use, discrete inputs and tunable parameters change in event mode only (FMI 3.0, 4.2.1,
fmi3EnterEventMode); continuous inputs are set in step mode. Owns this distinction; the steps, early return and events
are `fmu_mesh.instances.fmi.co_simulation.fmi3_steps`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, TypeVar

from fmpy.fmi3 import FMU3Slave

from ....rings.native import RowBase, StepKind
from ....rings.ring import Ring
from ....simtime import TimeGrid, resolvable
from ....variables.value_types import Value
from ..calls import Pointer, cffi_function
from ..fmi_versions import FMI3_NEEDED, FMI3_VALUES, Fmi3
from ..fmu_instance import Bookkeeping
from ..fmu_values import PartCall, Verb
from ..loaded_fmu import FmuFunctions
from ..model_exchange.solver import SolverFailed
from .fmi3_steps import Fmi3Steps
from .native_instance import NativeInstance

__all__ = ["Fmi3Instance"]

T = TypeVar("T")

_NEEDED = "fmi3InstantiateCoSimulation", *FMI3_NEEDED, "fmi3DoStep"
_DO_STEP = "int (*)(void *, double, double, _Bool, void *, void *, void *, void *)"


class Fmi3Instance(NativeInstance, Fmi3):
    """One instance of an FMI 3.0 co-simulation FMU."""

    _kind = StepKind.FMI3
    _functions = FmuFunctions(FMU3Slave, FMI3_VALUES, "fmi3FreeInstance", _NEEDED, {"instantiate": _NEEDED[0]})
    _steps: Fmi3Steps
    _discrete_row: tuple[bytes | list[Any], ...] = ()

    def set_values(self, values: Mapping[str, Value]) -> None:
        """Set variables by name; between two steps in event mode, if the FMU has it."""
        if self._state != "stepping":
            super().set_values(values)
            return
        set_values = super().set_values
        if not self._steps.terminated:
            self._checked(lambda: self._steps.event(self._said.time, lambda: set_values(values)))

    def bind(self, inputs: Ring, outputs: Sequence[Ring], grid: TimeGrid, points: int, step: int = 0) -> None:
        """See `Instance`."""
        super().bind(inputs, outputs, grid, points, step)
        if self._discrete:
            self._native = None  # a node does not know whether these inputs have changed
            take, member = self._in_step

            def take_after_events(member: Pointer, step: int) -> int:
                self._set_discrete(step & self._input_mask)
                return take(member, step)

            self._in_step = take_after_events, member

    def advance(self, time: float, step_size: float) -> None:
        """One step of ``step_size`` from ``time`` (both in s) without rings, for callers with their own time base."""
        self._check_live()
        end = time + step_size
        self._advance(end, lambda: self._steps.step(time, step_size, end))

    def _instantiate(self, **arguments: object) -> None:
        has_event_mode = self._description.has_event_mode
        super()._instantiate(eventModeUsed=has_event_mode, earlyReturnAllowed=True, **arguments)
        self._do_step = cffi_function(self._fmu.dll.fmi3DoStep, _DO_STEP)

    def _enter_initialization(self, start_time: float, stop_time: float | None, start_values: dict[str, Value]) -> None:
        super()._enter_initialization(start_time, stop_time, start_values)
        self._said.note(time=start_time)
        self._steps = Fmi3Steps(self._fmu, self._do_step, self._description, self._said)
        self._checked(lambda: self._steps.start(start_time))
        self._by_calls = bool(self._steps.clocks)

    def _exit_initialization(self) -> None:
        """An FMU with event mode is in it now."""
        super()._exit_initialization()
        self._checked(lambda: self._steps.exit_initialization(self._said.time))

    def _part_calls(self, verb: Verb, ring: Ring, base: RowBase) -> list[PartCall]:
        calls = super()._part_calls(verb, ring, base)
        if verb == "Set":
            self._discrete = [part for part in calls if self._is_discrete(part)]
            return [part for part in calls if not self._is_discrete(part)]
        return calls

    def _is_discrete(self, part: PartCall) -> bool:
        """Whether the variables of a part change in event mode only."""
        continuous = all(variable.variability == "continuous" for variable in part.variables)
        return self._description.has_event_mode and not continuous

    def _complete(self, step: int, status: int | None) -> None:
        steps, start, size, end = self._steps, self._time_of(step), self._step_size, self._time_of(step + 1)
        if status is None:
            self._advance(end, lambda: steps.step(start, size, end))
        else:
            self._advance(end, lambda: steps.finish(status, start, size, end))

    def _advance(self, end: float, step: Callable[[], float]) -> None:
        """Take a step to ``end`` (s); ``step`` returns the time that it has reached."""
        time = self._checked(step)
        self._said.note(time=time)
        if resolvable(time, end):
            raise self._end_requested()

    def _set_discrete(self, slot: int) -> None:
        """In event mode: set the inputs that change in event mode only, if they did change."""
        arrays = [part.array for part in self._discrete]
        row = tuple(a[slot].tolist() if a.dtype.hasobject else a[slot].tobytes() for a in arrays)
        if row == self._discrete_row or self._steps.terminated:
            return
        self._discrete_row = row
        set_row = self._set_row
        self._checked(lambda: self._steps.event(self._said.time, lambda: set_row(slot, self._discrete)))

    def _checked(self, call: Callable[[], T]) -> T:
        try:
            return super()._checked(call)
        except SolverFailed as error:
            raise self._failed(str(error)) from error

    def _bookkeeping(self) -> Bookkeeping:
        next_event, event_time = self._steps.place
        ticks = self._steps.clocks.place
        return Bookkeeping(self._said.step, self._said.time, next_event, self._discrete_row, ticks, event_time)

    def _restore(self, kept: Bookkeeping) -> None:
        super()._restore(kept)
        self._said.note(time=kept.time or 0.0)
        self._discrete_row = kept.row
        self._steps.resume(kept.next_event, kept.last_event)
        self._steps.clocks.resume(kept.ticks)
