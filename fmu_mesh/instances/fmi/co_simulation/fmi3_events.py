"""FMI 3.0 co-simulation with event mode: what is set when, and the steps between two communication points.

With event mode in use, discrete inputs and tunable parameters change in event mode only (FMI 3.0, 4.2.1,
fmi3EnterEventMode); continuous inputs are set in step mode. Owns that split;
`fmu_mesh.instances.fmi.co_simulation.fmi3_steps` owns the steps.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, TypeVar

from fmpy.fmi1 import FMICallException

from ....errors import FmuError, TerminationRequested
from ....rings.ring import Ring
from ....simtime import TimeGrid
from ....system.layout import Part
from ....variables.value_types import Value
from ..calls import DirectCall
from ..fmu_instance import STATUS_NAMES, WARNING, FmuInstance, Verb
from ..model_exchange.solver import SolverFailed
from ..state import Standing
from .fmi3_steps import Fmi3Steps
from .fused import DOING, GETTING, STATUS_BITS, STEPPING, Fused, fuse

__all__ = ["SteppedInEvents"]

T = TypeVar("T")


class SteppedInEvents(FmuInstance):
    """What event mode, early return and clocks make of an FMI 3.0 instance for co-simulation."""

    _steps: Fmi3Steps
    _discrete_row: tuple[bytes | list[Any], ...] = ()

    def bind(self, inputs: Ring, outputs: Sequence[Ring], grid: TimeGrid, points: int, step: int = 0) -> None:
        """See `Instance`."""
        self._discrete: list[Any] = []
        self._discrete_direct: list[DirectCall] = []
        self._discrete_setters: list[Callable[[int], None]] = []
        super().bind(inputs, outputs, grid, points, step)
        self._fused = self._fuse() if not (self._setters or self._getters) else None
        fused = self._fused.call if self._fused is not None else None
        self._hot = (fused, self._steps, self._input_mask, self._output_mask)

    def do_step(self, step: int) -> None:
        """Set the inputs of row ``step``, advance to own step ``step + 1``, write the outputs to row ``step + 1``."""
        fused, steps, input_mask, output_mask = self._hot
        start = self._start_time + step * self._points * self._base_step_size
        if self._discrete:
            self._set_discrete(step & input_mask)
        end = self._start_time + (step + 1) * self._points * self._base_step_size
        if fused is not None and steps.quiet_until > end:
            if outcome := fused(step & input_mask, start, (step + 1) & output_mask):
                self._finish_fused(outcome, step, start, end)
            else:
                steps.time = end
            self._step = step + 1
            return
        self._set_inputs(step & input_mask)
        self._go_on(lambda: steps.step(start, self._step_size, end))
        self._step = step + 1
        self._read_outputs((step + 1) & output_mask)

    def _fuse(self) -> Fused | None:
        step = self._steps.fused(self._step_size)
        return fuse(self._self, self._direct_setters, step, self._direct_getters, sized=True)

    def _finish_fused(self, outcome: int, step: int, start: float, end: float) -> None:
        """What follows where the step was more than a step, or a status is above warning."""
        stage, status = divmod(outcome, 1 << STATUS_BITS)
        if stage == STEPPING:
            self._go_on(lambda: self._steps.finish(status, start, self._step_size, end))
            self._step = step + 1
            self._read_outputs((step + 1) & self._output_mask)
            return
        if stage == GETTING:
            self._steps.time, self._step = end, step + 1
        raise self._failed(f"{DOING[stage]} returned {STATUS_NAMES[status]}")

    def advance(self, time: float, step_size: float) -> None:
        """One step of ``step_size`` from ``time`` (both in s) without rings, for callers with their own time base."""
        self._check_live()
        self._go_on(lambda: self._steps.step(time, step_size, time + step_size))

    def _go_on(self, step: Callable[[], bool]) -> None:
        if not self._stepped(step):
            raise TerminationRequested("the FMU asked to end the simulation", instance=self.name)

    def set_values(self, values: Mapping[str, Value]) -> None:
        """Set variables by name; between two steps in event mode, if the FMU has that."""
        if self._state != "stepping":
            super().set_values(values)
            return
        set_values = super().set_values
        if not self._steps.terminated:
            self._stepped(lambda: self._steps.event(lambda: set_values(values)))

    def _standing(self) -> Standing:
        steps = self._steps
        next_event, event_time = steps.place
        return Standing(self._step, steps.time, next_event, self._discrete_row, steps.clocks.place, event_time)

    def _stand(self, standing: Standing) -> None:
        super()._stand(standing)
        self._discrete_row = standing.row
        self._steps.resume(standing.time or 0.0, standing.next_event, standing.last_event)
        self._steps.clocks.resume(standing.ticks)

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
        """Set what changes in event mode only, if it did."""
        row = tuple(a[slot].tolist() if a.dtype.hasobject else a[slot].tobytes() for a in self._discrete)
        if row == self._discrete_row or self._steps.terminated:
            return
        self._discrete_row = row
        self._stepped(
            lambda: self._steps.event(lambda: self._set_row(slot, self._discrete_direct, self._discrete_setters))
        )

    def _set_row(self, slot: int, direct: Sequence[DirectCall], setters: Sequence[Callable[[int], None]]) -> None:
        for function, references, count, rows, size in direct:
            status = self._call_direct(function, references, count, rows[slot], size)
            if status > WARNING:
                raise self._failed(f"setting the inputs returned {STATUS_NAMES[status]}")
        for set_row in setters:
            set_row(slot)

    def _stepped(self, call: Callable[[], T]) -> T:
        try:
            return call()
        except (FMICallException, SolverFailed) as error:
            raise self._failure(error) from error

    def _failure(self, error: FMICallException | SolverFailed) -> FmuError:
        if isinstance(error, SolverFailed):
            return self._failed(str(error))
        return self._failed(f"{error.function} returned {STATUS_NAMES[error.status]}")
