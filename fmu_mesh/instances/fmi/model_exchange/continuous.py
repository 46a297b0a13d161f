"""A model-exchange FMU as an instance that is stepped like one for co-simulation.

Owns inputs and outputs of a model: an input that jumps is an event at a communication point (FMI 2.0, 3.1). Within a
step inputs are constant, or linear where a connection says so; where the next line goes on from there, there is no
event. The way from one communication point to the next is
`fmu_mesh.instances.fmi.model_exchange.model_exchange`.
"""

from __future__ import annotations

import ctypes
import math
from collections.abc import Mapping, Sequence
from typing import Any, Literal

import numpy as np
from fmpy.fmi1 import FMU1Model
from fmpy.fmi2 import FMU2Model
from fmpy.fmi3 import FMU3Model
from numpy.typing import NDArray

from ....errors import FmuError
from ....rings.native import NativeStep, StepKind
from ....rings.ring import Ring
from ....simtime import TimeGrid
from ....variables.value_types import Value
from ...contract import LogMessage
from ...instance_wrapper import of_kind
from ..clocks import NO_CLOCKS, Clocks
from ..fmi_versions import Fmi1, Fmi2, Fmi3
from ..fmu_instance import Bookkeeping, FmuState
from ..fmu_values import Verb
from ..loaded_fmu import FmuFunctions
from ..native_instance import NativeInstance
from ..step_options import NO_STATE_OF_CVODE
from .dormand_prince import NOT_SET, AutoSolver, DormandPrinceSolver, HeldRow, RowBytes, Solved
from .model_calls import Fmi1Calls, Fmi3Calls, InputLine, InputSetter, ModelCalls
from .model_exchange import EventLoop

__all__ = ["ContinuousInstance", "Fmi1ModelInstance", "Fmi2ModelInstance", "Fmi3ModelInstance"]

_NAMES = {"instantiate": "fmiInstantiateModel", "fmi1FreeModelInstance": "fmiFreeModelInstance"}
_NEEDED_1 = "fmiInstantiateModel", "fmiSetTime", "fmiInitialize", "fmiEventUpdate"
_NEEDED_2 = *Fmi2.NEEDED, "fmi2SetTime", "fmi2NewDiscreteStates", "fmi2EnterContinuousTimeMode"
_NEEDED_3 = (
    "fmi3InstantiateModelExchange",
    *Fmi3.NEEDED,
    "fmi3SetTime",
    "fmi3UpdateDiscreteStates",
    "fmi3EnterContinuousTimeMode",
)


class ContinuousInstance(NativeInstance):
    """The part of model exchange that all versions share; to be named before the base class of the version."""

    _calls: type[ModelCalls] = ModelCalls  # those of this version

    _kind = StepKind.EQUATIONS
    _solver_in_c: DormandPrinceSolver | None = None  # the solver, if the library takes complete steps

    _loop: EventLoop | None = None
    _inputs: Ring | None = None
    _clocks: Clocks = NO_CLOCKS
    _linear_columns: NDArray[np.intp] = np.zeros(0, dtype=np.intp)
    """The columns of the other ones among those of type Float64."""
    _slopes: Mapping[str, float] = {}
    _goes_on = False  # whether the linear inputs begin where the last step has left them
    _time_of_start = 0.0
    _stop_time = math.inf

    def enter_initialization(
        self, start_time: float, stop_time: float | None, start_values: Mapping[str, Value]
    ) -> None:
        """See `Instance`."""
        self._solver = f"solver {self._options.solver.name}: "
        self._time_of_start, self._stop_time = start_time, math.inf if stop_time is None else stop_time
        super().enter_initialization(start_time, stop_time, start_values)

    def advance(self, time: float, step_size: float) -> None:
        """One step of ``step_size`` from ``time`` (both in s) without rings, for callers with their own time base."""
        self._check_live()
        self._advance(time + step_size)

    def set_values(self, values: Mapping[str, Value]) -> None:
        """Set variables by name; between two steps that is an event, if a value changes."""
        if self._state != "stepping":
            super().set_values(values)
            return
        loop, set_values = self._event_loop(), super().set_values
        if not loop.terminated and repr(self.get_values(list(values))) != repr([*values.values()]):
            self._checked(lambda: loop.event(lambda: set_values(values)))

    def set_input_derivatives(self, derivatives: Mapping[str, float], *, continuous: bool = False) -> None:
        """See `FmuInstance`."""
        self._slopes, self._goes_on = derivatives, continuous

    def bind(self, inputs: Ring, outputs: Sequence[Ring], grid: TimeGrid, points: int, step: int = 0) -> None:
        """See `Instance`."""
        solver = self._loop.solver if self._loop is not None else None
        self._by_calls = bool(self._options.linear_inputs or self._clocks)
        self._solver_in_c = solver if isinstance(solver, DormandPrinceSolver) and not self._by_calls else None
        self._by_calls = self._solver_in_c is None
        is_first, row = self._inputs is None, self._row.get()
        super().bind(inputs, outputs, grid, points, step)
        self._row: HeldRow = HeldRow()
        if self._solver_in_c is not None and self._native is not None:
            self._row = self._solver_in_c.share([part.in_table for part in self._setters], inputs)
        self._row.put(NOT_SET if is_first and any(part.size for part in inputs.parts) else row)
        self._inputs = inputs
        linear = [inputs.layout.place(item.name).first for item in self._options.linear_inputs]
        self._linear_columns = np.array(linear, dtype=np.intp)

    def serialize_state(self, state: object) -> bytes:
        """See `KeepsState`; refused where the solver `auto` has turned to CVode."""
        solver, place = self._event_loop().solver, of_kind(FmuState, state).kept.solver
        if isinstance(solver, AutoSolver) and solver.goes_on_with_cvode(place):
            raise FmuError(f"its state cannot be written: {NO_STATE_OF_CVODE}", instance=self.name)
        return super().serialize_state(state)

    def close(self) -> None:
        """See `Instance`."""
        super().close()
        if self._loop is not None:
            self._loop.close()
            self._loop = None

    def _is_plain(self, verb: Verb | Literal["State"]) -> bool:
        return verb == "Get"

    def _complete(self, step: int, status: int | None) -> None:
        loop, solver, end = self._event_loop(), self._solver_in_c, self._time_of(step + 1)
        assert solver is not None
        if loop.terminated:
            raise self._end_requested()
        own = solver.table
        if own.result == Solved.LEFT:
            self._take_step(step)
            return
        if own.result == Solved.FAILED and own.call < own.n_setters:
            raise self._part_failed("Set", self._setters[own.call], own.status)
        at_event = own.result == Solved.AT_EVENT
        asks_end = own.result == Solved.ENDS or bool(at_event and own.asks_end)
        self._checked(lambda: solver.check(own.result))
        if not self._checked(lambda: loop.go_on(end, asks_event=at_event, asks_end=asks_end)):
            raise self._end_requested()
        self._tell_doubt()

    def _step_by_calls(self, step: int) -> None:
        self._take_step(step)
        self._said.note(step=step + 1)
        self._read_outputs(step + 1)

    def _take_step(self, step: int) -> None:
        """One step without the outputs."""
        self._checked(lambda: self._take_inputs(step, self._time_of(step)))
        self._advance(self._time_of(step + 1))
        self._tell_doubt()

    def _tables(self) -> NativeStep:
        return super()._tables()._replace(setters=())  # the equations have them

    def _step_address(self) -> int:
        assert self._solver_in_c is not None
        return ctypes.addressof(self._solver_in_c.table)

    def _instantiate(self, **arguments: object) -> None:
        super()._instantiate(**arguments)
        self._row = HeldRow()

    def _tolerance(self) -> float | None:
        return self._options.solver.relative_tolerance

    def _exit_initialization(self) -> None:
        """After Initialization Mode: the first event, then continuous-time mode."""
        super()._exit_initialization()
        self._checked(lambda: self._make_loop().start(self._time_of_start))

    def _bookkeeping(self) -> Bookkeeping:
        """The solver starts anew where a state is taken, so that going back to the state later changes nothing."""
        loop = self._event_loop()
        time, next_event = loop.place
        self._checked(loop.restart)
        return Bookkeeping(
            self._said.step,
            time,
            next_event if math.isfinite(next_event) else None,
            self._row.get(),
            self._clocks.place,
            solver=loop.solver.place,
        )

    def _restore(self, kept: Bookkeeping) -> None:
        super()._restore(kept)
        self._row.put(kept.row)
        self._clocks.resume(kept.ticks)
        next_event = math.inf if kept.next_event is None else kept.next_event
        loop = self._loop or self._make_loop()
        loop.solver.resume(kept.solver)
        self._checked(lambda: loop.resume(kept.time or 0.0, next_event))

    def _make_loop(self) -> EventLoop:
        self._loop = EventLoop(
            self._calls(self._fmu, self.description, self._symbols),
            self._options.solver,
            tell_completed_steps=self.description.tell_completed_steps,
            stop_time=self._stop_time,
            clocks=self._clocks,
        )
        return self._loop

    def _event_loop(self) -> EventLoop:
        if self._loop is None:
            msg = f"instance '{self.name}' is not initialized, or closed"
            raise ValueError(msg)
        return self._loop

    def _advance(self, end: float) -> None:
        """Advance the model to ``end`` (s); `TerminationRequested` if it asks to end the simulation before."""
        loop = self._event_loop()
        if loop.terminated or not self._checked(lambda: loop.advance(end)):
            raise self._end_requested()

    def _tell_doubt(self) -> None:
        """Tell once that another solver would be better."""
        if (doubt := self._event_loop().solver.doubt()) is not None:
            self._log(LogMessage(self.name, "warning", "solver", doubt, self._said.step, noted="stiff"))

    def _take_inputs(self, step: int, time: float) -> None:
        """Set the inputs of row ``step``: in event mode if a held one has changed, or a linear one jumps.

        Linear inputs that go on are no event: they may be set in continuous-time mode (FMI 2.0, 3.2.1).
        """
        loop = self._event_loop()
        if loop.terminated:
            return
        slot = step & self._input_mask
        row, line = self._held(slot), self._line(slot, time)
        if row != self._row.get() or (line is not None and not self._goes_on):
            self._row.put(row)
            loop.set_inputs(lambda: self._set_inputs(step), line)
        elif line is not None:
            loop.follow(line)

    def _held(self, slot: int) -> RowBytes:
        """A row of inputs, with 0 in the place of the linear ones."""
        assert self._inputs is not None
        held: list[bytes | list[Any]] = []
        for part, row in zip(self._inputs.layout.parts, self._inputs.parts, strict=True):
            values = row[slot]
            if part.type == "Float64" and self._linear_columns.size:
                values = values.copy()
                values[self._linear_columns] = 0.0
            held.append(values.tolist() if row.dtype.hasobject else values.tobytes())
        return tuple(held)

    def _line(self, slot: int, start: float) -> InputLine | None:
        """The linear inputs within the step that starts at ``start`` (s); None if there are none."""
        slopes = self._slopes
        if not slopes:
            return None
        assert self._inputs is not None
        functions = self._functions.values
        function = self._function("Set", "Float64")
        setter = InputSetter(function, self._function_name("Set", "Float64"), self._self, functions.sized)
        begins = [float(self._inputs.value(slot, name)) for name in slopes]  # type: ignore[arg-type]  # Float64 only
        references = [self._variables[name].value_reference for name in slopes]
        return InputLine(setter, references, start, begins, [*slopes.values()])


class Fmi1ModelInstance(ContinuousInstance, Fmi1):
    """One instance of an FMI 1.0 FMU for model exchange (FMI 1.0, 2.8)."""

    _functions = FmuFunctions(FMU1Model, Fmi1.VALUES, "fmi1FreeModelInstance", _NEEDED_1, _NAMES)
    _calls = Fmi1Calls
    _end = "Terminate"

    def _initialize(self, start_time: float, stop_time: float | None) -> None:
        """FmiInitialize (FMI 1.0, 2.5)."""
        tolerance = self._options.solver.relative_tolerance
        calls = Fmi1Calls(self._fmu, self.description, self._symbols)
        self._checked(lambda: calls.initialize(start_time, tolerance))


class Fmi2ModelInstance(ContinuousInstance, Fmi2):
    """One instance of an FMI 2.0 FMU for model exchange (FMI 2.0, 3.2)."""

    _functions = FmuFunctions(FMU2Model, Fmi2.VALUES, "fmi2FreeInstance", _NEEDED_2, Fmi2.NAMES)


class Fmi3ModelInstance(ContinuousInstance, Fmi3):
    """One instance of an FMI 3.0 FMU for model exchange (FMI 3.0, 3.2)."""

    _functions = FmuFunctions(FMU3Model, Fmi3.VALUES, "fmi3FreeInstance", _NEEDED_3, {"instantiate": _NEEDED_3[0]})
    _calls = Fmi3Calls

    def _enter_initialization(self, start_time: float, stop_time: float | None, start_values: dict[str, Value]) -> None:
        super()._enter_initialization(start_time, stop_time, start_values)
        self._clocks = Clocks(self._fmu, self.description.clocks)
        self._clocks.start(start_time)
