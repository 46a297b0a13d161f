"""A model-exchange FMU as an instance that is stepped like one for co-simulation.

Owns inputs and outputs of a model: a changed input is an event at a communication point (FMI 2.0, 3.1), and within a
step inputs are constant, or linear where a connection says so. The way from one communication point to the next is
`fmu_mesh.instances.fmi.model_exchange.model_exchange`; the versions of FMI are in `model_instances`.
"""

from __future__ import annotations

import ctypes
import math
from abc import abstractmethod
from collections.abc import Callable, Mapping, Sequence
from typing import Any, TypeVar

from fmpy.fmi1 import FMICallException

from ....errors import TerminationRequested
from ....rings.ring import Ring
from ....simtime import TimeGrid
from ....variables.value_types import Value
from ..calls import cffi_function, memory
from ..clocks import NO_CLOCKS, Clocks
from ..fmu_instance import FmuInstance
from ..fmu_values import WARNING
from ..state import Bookkeeping
from .model_calls import ModelCalls
from .model_exchange import EventLoop
from .solver import SolverFailed

__all__ = ["ContinuousInstance"]

T = TypeVar("T")
_RowBytes = tuple[bytes | list[Any], ...]


class ContinuousInstance(FmuInstance):
    """The part of model exchange that all versions share; to be named before the base class of the version."""

    _loop: EventLoop | None = None
    _inputs: Ring | None = None
    _clocks: Clocks = NO_CLOCKS
    _row: _RowBytes = ()
    _slopes: Mapping[str, float] = {}
    _is_linear = False
    """Whether inputs changed within the last step."""
    _time_of_start = 0.0
    _stop_time = math.inf

    def enter_initialization(
        self, start_time: float, stop_time: float | None, start_values: Mapping[str, Value]
    ) -> None:
        """See `Instance`."""
        self._time_of_start, self._stop_time = start_time, math.inf if stop_time is None else stop_time
        super().enter_initialization(start_time, stop_time, start_values)

    def do_step(self, step: int) -> None:
        """Set the inputs of row ``step``, advance to own step ``step + 1``, write the outputs to row ``step + 1``."""
        self._checked(lambda: self._take_inputs(step, self._time_of(step)))
        self._advance(self._time_of(step + 1))
        self._said.note(step=step + 1)
        self._read_outputs(step + 1)

    def advance(self, time: float, step_size: float) -> None:
        """One step of ``step_size`` from ``time`` (both in s) without rings, for callers with their own time base."""
        self._check_live()
        self._advance(time + step_size)

    def set_values(self, values: Mapping[str, Value]) -> None:
        """Set variables by name; between two steps that is an event."""
        if self._state != "stepping":
            super().set_values(values)
            return
        loop, set_values = self._event_loop(), super().set_values
        if not loop.terminated:
            self._checked(lambda: loop.event(lambda: set_values(values)))

    def set_input_derivatives(self, derivatives: Mapping[str, float]) -> None:
        """Let inputs change linearly during the next step; derivatives in 1/s."""
        self._slopes = derivatives

    def bind(self, inputs: Ring, outputs: Sequence[Ring], grid: TimeGrid, points: int, step: int = 0) -> None:
        """See `Instance`."""
        super().bind(inputs, outputs, grid, points, step)
        if self._inputs is None and any(part.size for part in inputs.parts):
            self._row = (b"not set yet",)
        self._inputs = inputs

    def close(self) -> None:
        """See `Instance`."""
        super().close()
        if self._loop is not None:
            self._loop.close()
            self._loop = None

    def _tolerance(self) -> float | None:
        return self._options.solver.relative_tolerance

    def _exit_initialization(self) -> None:
        """After Initialization Mode: the first event, then continuous-time mode."""
        super()._exit_initialization()  # type: ignore[safe-super]  # that of the version, which is the next base class
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
            self._row,
            self._clocks.place,
            is_linear=self._is_linear,
        )

    def _restore(self, kept: Bookkeeping) -> None:
        super()._restore(kept)
        self._row, self._is_linear = kept.row, kept.is_linear
        self._clocks.resume(kept.ticks)
        next_event = math.inf if kept.next_event is None else kept.next_event
        self._checked(lambda: (self._loop or self._make_loop()).resume(kept.time or 0.0, next_event))

    @abstractmethod
    def _model_calls(self) -> ModelCalls:
        """The functions of the model, once it is instantiated."""

    def _make_loop(self) -> EventLoop:
        self._loop = EventLoop(
            self._model_calls(),
            self._options.solver,
            tell_completed_steps=self._description.tell_completed_steps,
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
        """Advance the model to ``end`` (s).

        Raises:
            TerminationRequested: the model asks to end the simulation before.
        """
        loop = self._event_loop()
        if loop.terminated or not self._checked(lambda: loop.advance(end)):
            raise TerminationRequested("the FMU asked to end the simulation", instance=self.name)

    def _take_inputs(self, step: int, time: float) -> None:
        """Set the inputs of row ``step`` in event mode, if they have changed or change within a step."""
        slot = step & self._input_mask
        loop = self._event_loop()
        assert self._inputs is not None
        row: _RowBytes = tuple(
            part[slot].tolist() if part.dtype.hasobject else part[slot].tobytes() for part in self._inputs.parts
        )
        if loop.terminated or (row == self._row and not self._is_linear and not any(self._slopes.values())):
            return
        self._row = row
        line = self._line(slot, time)
        self._is_linear = line is not None
        loop.set_inputs(lambda: self._set_inputs(step), line)

    def _line(self, slot: int, start: float) -> Callable[[float], None] | None:
        """Sets the linear inputs at a time within the step that starts at ``start`` (s); None if no input changes."""
        slopes = {name: slope for name, slope in self._slopes.items() if slope != 0.0}
        if not slopes:
            return None
        assert self._inputs is not None
        count = len(slopes)
        variables = [self._variables[name] for name in slopes]
        references = (ctypes.c_uint * count)(*(variable.value_reference for variable in variables))
        values = (ctypes.c_double * count)()
        where, what = memory(references), memory(values)
        function = cffi_function(self._function("Set", "Float64"), self._direct_declaration)
        at_start = [float(self._inputs.value(slot, name)) for name in slopes]  # type: ignore[arg-type]  # Float64 only
        pairs = list(zip(at_start, slopes.values(), strict=True))

        def set_inputs(time: float) -> None:
            values[:] = [value + (time - start) * slope for value, slope in pairs]
            status = self._call_direct(function, where, count, what, count)
            if status > WARNING:
                raise FMICallException(function=self._function_name("Set", "Float64"), status=status)

        return set_inputs

    def _checked(self, call: Callable[[], T]) -> T:
        """Call the model; a failure of the model or of the solver becomes an error of this instance."""
        try:
            return call()
        except FMICallException as error:
            raise self._failed(error.function, status=error.status) from error
        except SolverFailed as error:
            raise self._failed(f"solver {self._options.solver.name}: {error}") from error
