"""The functions of model exchange, the same for FMI 1.0, 2.0 and 3.0.

Owns the differences between the versions: names, modes and event information. The order of the calls is
`fmu_mesh.instances.fmi.model_exchange.model_exchange`.
"""

from __future__ import annotations

import ctypes
import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from fmpy.fmi1 import FMICallException, fmi1EventInfo
from fmpy.fmi2 import fmi2EventInfo

from ....rings.native import Call, EquationsTable, StepKind
from ....variables.model_description import ModelDescription
from ..calls import Function, Pointer, address_of, checked_function, memory
from ..clocks import EventInfo, updated
from ..fmu_library import MISSING
from ..fmu_values import WARNING

__all__ = ["Fmi1Calls", "Fmi3Calls", "InputLine", "InputSetter", "LibraryCalls", "ModelCalls"]

_ARRAY = ctypes.CFUNCTYPE(ctypes.c_int, ctypes.c_void_p, ctypes.c_void_p, ctypes.c_size_t)
_TIME = ctypes.CFUNCTYPE(ctypes.c_int, ctypes.c_void_p, ctypes.c_double)
_EVENT_UPDATE = ctypes.CFUNCTYPE(ctypes.c_int, ctypes.c_void_p, ctypes.c_char, ctypes.c_void_p)
_COMPLETED = ctypes.CFUNCTYPE(ctypes.c_int, ctypes.c_void_p, ctypes.c_void_p)
_INITIALIZE = ctypes.CFUNCTYPE(ctypes.c_int, ctypes.c_void_p, ctypes.c_char, ctypes.c_double, ctypes.c_void_p)


_FUNCTIONS = [field for field, *_ in EquationsTable._fields_][2:12]
"""The fields that are functions; the library names them by their place."""

_MODES = {
    "enter_event_mode": "EnterEventMode",
    "update_discrete_states": "NewDiscreteStates",
    "enter_continuous_time_mode": "EnterContinuousTimeMode",
}


class InputSetter(NamedTuple):
    """A function of an FMU that sets Float64 inputs."""

    function: Function
    name: str
    component: Pointer
    is_sized: bool  # whether it takes the number of values


class InputLine:
    """Linear inputs within the step that begins at ``start`` (s); calling it sets them at a time.

    ``begins`` are their values at ``start``, ``slopes`` in 1/s. ``setter`` is the function of the FMU.
    """

    def __init__(
        self,
        setter: InputSetter,
        references: Sequence[int],
        start: float,
        begins: Sequence[float],
        slopes: Sequence[float],
    ) -> None:
        self.name = setter.name  # of the function
        self._setter = setter
        self._count = len(references)
        self._references = (ctypes.c_uint * self._count)(*references)
        self._values, self._begins, self._slopes = (
            (ctypes.c_double * self._count)(*numbers) for numbers in (begins, begins, slopes)
        )
        self._start = start
        self._sizes = (self._count,) if setter.is_sized else ()
        self._arguments = setter.component, memory(self._references), self._count, memory(self._values), *self._sizes

    def __call__(self, time: float) -> None:
        """Set the inputs at a time in s."""
        self._values[:] = [
            begin + (time - self._start) * slope for begin, slope in zip(self._begins, self._slopes, strict=True)
        ]
        if (status := self._setter.function(*self._arguments)) > WARNING:
            raise FMICallException(function=self._setter.name, status=status)

    def table(self) -> dict[str, Any]:
        """The fields of `EquationsTable`; the line keeps what they point to."""
        references, values = ctypes.addressof(self._references), ctypes.addressof(self._values)
        self._call = Call(
            address_of(self._setter.function), references, self._count, 0, values, *(self._sizes or (-1,))
        )
        return {
            "line": ctypes.addressof(self._call),
            "line_values": ctypes.addressof(self._begins),
            "line_slopes": ctypes.addressof(self._slopes),
            "line_start": self._start,
        }


class ModelCalls:
    """The model exchange functions of one instance. Arrays are given as addresses of float64 memory.

    Raises:
        FMICallException: by every method: the FMU returned a status above warning.
    """

    _kind = StepKind.FMI2
    _modes: Mapping[str, str] = _MODES
    _nominals = "GetNominalsOfContinuousStates"
    _derivatives = "GetDerivatives"

    def __init__(self, fmu: Any, description: ModelDescription, symbols: str) -> None:  # noqa: ANN401 FMPy is untyped
        self.n_states = description.continuous_states
        self.n_indicators = description.event_indicators
        self._fmu = fmu
        self._component = fmu.component
        self._symbols = symbols
        self.line: InputLine | None = None  # see `follow`
        self._set_time = self._function("SetTime", _TIME)
        self._set_states = self._function("SetContinuousStates", _ARRAY)
        self._get_states = self._function("GetContinuousStates", _ARRAY)
        self._get_indicators = self._function("GetEventIndicators", _ARRAY)
        self._get_nominals = self._function(self._nominals, _ARRAY)
        self._get_derivatives = self._function(self._derivatives, _ARRAY)

    def _function(self, name: str, prototype: Any) -> Any:  # noqa: ANN401 ctypes has no types
        return checked_function(self._fmu.dll, self._symbols, name, prototype)

    def follow(self, line: InputLine | None) -> None:
        """From now on, ``line`` sets inputs at the time of every `set_point`; None: they stay as they are."""
        self.line = line

    def table(self) -> tuple[dict[str, Any], dict[str, str]]:
        """The fields of `EquationsTable` that are functions, and the names of these in FMI."""
        names = {
            "set_time": "SetTime",
            "set_states": "SetContinuousStates",
            "get_states": "GetContinuousStates",
            "get_nominals": self._nominals,
            "get_derivatives": self._derivatives,
            "get_indicators": "GetEventIndicators",
            "completed_step": "CompletedIntegratorStep",
            **self._modes,
        }
        address = ctypes.c_void_p
        made = {
            field: ctypes.cast(getattr(self._fmu.dll, self._symbols + name), address).value
            for field, name in names.items()
        }
        prefix = self._symbols.rpartition("_")[2]
        told = {field: prefix + name for field, name in names.items()}
        return {"kind": self._kind, "component": self._component, **made}, told

    def set_time(self, time: float) -> None:
        """Set the time in s."""
        self._set_time(self._component, time)

    def set_point(self, time: float, states: int) -> None:
        """Put the model at a time in s, at these continuous states and at the inputs of this time."""
        self._set_time(self._component, time)
        if self.n_states:
            self._set_states(self._component, states, self.n_states)
        if self.line is not None:
            self.line(time)

    def get_states(self, states: int) -> None:
        """The continuous states that the model is at."""
        self._get_states(self._component, states, self.n_states)

    def get_nominals(self, nominals: int) -> None:
        """The nominal values of the continuous states; 1 if the library does not have this function."""
        try:
            self._get_nominals(self._component, nominals, self.n_states)
        except FMICallException as error:
            if error.status != MISSING:
                raise
            (ctypes.c_double * self.n_states).from_address(nominals)[:] = [1.0] * self.n_states

    def get_derivatives(self, derivatives: int) -> None:
        """The derivatives of the continuous states where the model is."""
        self._get_derivatives(self._component, derivatives, self.n_states)

    def get_indicators(self, indicators: int) -> None:
        """The event indicators where the model is."""
        self._get_indicators(self._component, indicators, self.n_indicators)

    def enter_event_mode(self) -> None:
        """From continuous-time mode into event mode."""
        self._fmu.enterEventMode()

    def enter_continuous_time_mode(self) -> None:
        """From event mode into continuous-time mode."""
        self._fmu.enterContinuousTimeMode()

    def update_discrete_states(self) -> EventInfo:
        """One event iteration, in event mode."""
        info = fmi2EventInfo()
        self._fmu.fmi2NewDiscreteStates(self._component, ctypes.byref(info))
        next_event = info.nextEventTime if info.nextEventTimeDefined else math.inf
        return EventInfo(bool(info.newDiscreteStatesNeeded), bool(info.terminateSimulation), next_event)

    def completed_step(self) -> tuple[bool, bool]:
        """Tell that a step of the solver is done; whether event mode is needed, and whether the FMU asks to end."""
        event, terminate = self._fmu.completedIntegratorStep()
        return bool(event), bool(terminate)


class Fmi1Calls(ModelCalls):
    """FMI 1.0: there are no modes; events are handled by fmiEventUpdate (FMI 1.0, 2.8).

    FMPy takes the status of these functions for text and does not check it, so they are called by our own prototypes.
    """

    _kind = StepKind.FMI1
    _modes: Mapping[str, str] = {"update_discrete_states": "EventUpdate"}
    _nominals = "GetNominalContinuousStates"

    def __init__(self, fmu: Any, description: ModelDescription, symbols: str) -> None:  # noqa: ANN401 FMPy is untyped
        super().__init__(fmu, description, symbols)
        self._event_update = self._function("EventUpdate", _EVENT_UPDATE)
        self._completed_step = self._function("CompletedIntegratorStep", _COMPLETED)
        self._initialize = self._function("Initialize", _INITIALIZE)

    def initialize(self, time: float, tolerance: float) -> None:
        """Compute what follows from the values that were set, at ``time`` in s (FMI 1.0, 2.5)."""
        self.set_time(time)
        self._initialize(self._component, b"\1", tolerance, ctypes.byref(fmi1EventInfo()))

    def enter_event_mode(self) -> None:
        """There is no such mode."""

    def enter_continuous_time_mode(self) -> None:
        """There is no such mode."""

    def update_discrete_states(self) -> EventInfo:
        """One event iteration."""
        info = fmi1EventInfo()
        self._event_update(self._component, b"\0", ctypes.byref(info))
        next_event = info.nextEventTime if info.upcomingTimeEvent != b"\0" else math.inf
        return EventInfo(info.iterationConverged == b"\0", info.terminateSimulation != b"\0", next_event)

    def completed_step(self) -> tuple[bool, bool]:
        """Tell that a step of the solver is done; an FMU cannot ask to end here."""
        event = ctypes.c_char()
        self._completed_step(self._component, ctypes.byref(event))
        return event.value != b"\0", False


class Fmi3Calls(ModelCalls):
    """FMI 3.0, where the FMU says itself how many states and indicators it has: it depends on structural parameters."""

    _kind = StepKind.FMI3
    _modes: Mapping[str, str] = _MODES | {"update_discrete_states": "UpdateDiscreteStates"}
    _derivatives = "GetContinuousStateDerivatives"

    def __init__(self, fmu: Any, description: ModelDescription, symbols: str) -> None:  # noqa: ANN401 FMPy is untyped
        super().__init__(fmu, description, symbols)
        self.n_states = fmu.getNumberOfContinuousStates()
        self.n_indicators = fmu.getNumberOfEventIndicators()

    def update_discrete_states(self) -> EventInfo:
        """One event iteration, in event mode."""
        return updated(self._fmu)


class LibraryCalls:
    """The same functions as the library calls them; ``fields`` are those of `EquationsTable` that a solver adds."""

    def __init__(self, equations: ModelCalls, **fields: Any) -> None:  # noqa: ANN401 fields of C
        functions, self._names = equations.table()
        counts = {"n_states": equations.n_states, "n_indicators": equations.n_indicators}
        self.table = EquationsTable(next_event=math.inf, **counts, **functions, **fields)
        self._equations = equations
        self._line: InputLine | None = None

    def follow(self) -> None:
        """Let the library set the linear inputs of this step, if they are other ones than before."""
        line = self._equations.line
        if line is not self._line:
            self._line = line
            self.table.note(is_new=True, **(line.table() if line is not None else {"line": None}))

    def failure(self) -> FMICallException:
        """The call that has failed."""
        names = [self._names.get(field, "") for field in _FUNCTIONS]
        if self._line is not None:
            names.append(self._line.name)
        return FMICallException(function=names[self.table.function], status=self.table.status)
