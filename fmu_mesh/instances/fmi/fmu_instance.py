"""An FMU instance, the same for all FMI versions: life cycle, values by name and in rows, states, messages, errors.

A version of FMI (`fmi_versions`) adds how an instance is made and initialized, a kind of FMU (`co_simulation`,
`model_exchange`) how it is stepped. A state is that of the FMU and our own `Bookkeeping`; FMI 1.0 has no states.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, Final, Literal, NamedTuple, TypeVar, cast

import msgspec
from fmpy.fmi1 import FMICallException

from ...errors import FmuError, InitializationFailed, LoadFailed, StepFailed, TerminationRequested
from ...rings.native import RowBase, Said, Stage
from ...rings.ring import Ring
from ...simtime import TimeGrid
from ...variables.model_description import ModelDescription, Variable
from ...variables.value_conversion import to_value
from ...variables.value_types import Value, VariableType, flattened, nested
from ..call_guard import call_named, doing
from ..contract import LogMessage
from ..instance_wrapper import of_kind, packed, unpacked
from ..kept_models import KeptModels
from .archive.system_libraries import missing_libraries
from .buffers import Buffer
from .callbacks import recall, register, register_component, tell_counted, unregister
from .calls import Function, RowPointers, cffi_function
from .fmu_values import FATAL, OK, WARNING, PartCall, SolverFailed, Verb, status_name
from .loaded_fmu import FmuFunctions, FmuToLoad, LoadedFmu
from .step_options import StepOptions, Terms

__all__ = ["Bookkeeping", "FmuInstance", "FmuState", "LogSink"]

LogSink = Callable[[LogMessage], None]
T = TypeVar("T")

_DOING: Final[dict[Verb, str]] = {"Set": doing(Stage.SETTING), "Get": doing(Stage.GETTING)}
_MOST_KNOWN: Final = 64
_OWN_ROWS: Final = (RowBase.OUTPUT, RowBase.WATCHED)


class Bookkeeping(msgspec.Struct, frozen=True):
    """What we know about an instance besides its FMU state."""

    step: int  # own steps done; -1 in or before Initialization Mode
    time: float | None = None  # the time of the FMU in s, where it does not follow from the step
    next_event: float | None = None  # time of its next time event in s; None if there is none.
    row: tuple[bytes | list[Any], ...] = ()  # its held inputs
    ticks: tuple[float | None, ...] = ()  # the clocks; see `Clocks.place`
    # time of its last event mode in s, where the steps depend on it; None if there was none.
    last_event: float | None = None
    solver: tuple[float, ...] = ()  # see `Solver.place`


class FmuState(NamedTuple):
    """One state of one instance; it belongs to this instance until `FmuInstance.free_state`."""

    handle: Any
    kept: Bookkeeping


class _Transfer(NamedTuple):
    """Variables of one type that are set or read by name, and memory for their values."""

    type: VariableType
    variables: Sequence[Variable]
    names: Sequence[str]
    buffer: Buffer
    arguments: tuple[Any, ...]  # see `ValueFunctions.arguments`
    is_plain: bool  # whether none of them is an array


class FmuInstance(ABC):
    """One instance of an FMU; see `Instance` and `KeepsState` in `fmu_mesh.instances.contract`.

    Its arguments are those of `Opening`, and the ``terms`` of its archive and the ``options`` of its steps.
    """

    _functions: FmuFunctions  # those of this version of FMI and this kind of FMU

    _component = 0  # the address of the instance, for functions called through ctypes; ``_self`` is the same for cffi

    _solver = ""  # what the error of a solver begins with

    description: ModelDescription
    """The model description; arrays have the shapes that the structural parameters give them."""

    _variables: Mapping[str, Variable]

    def __init__(  # noqa: PLR0913, PLR0917 what an instance is made of; all of it is named where it is called
        self,
        path: Path,
        name: str,
        description: ModelDescription,
        folder: Path,
        log: LogSink = lambda _message: None,
        terms: Terms = Terms(),  # noqa: B008 a frozen Struct
        options: StepOptions = StepOptions(),  # noqa: B008 a frozen Struct
        kept: KeptModels | None = None,
    ) -> None:
        self.name = name
        self._options = options
        self._log = log
        self._last_messages: list[str] = []
        self._said = Said(step=-1, quiet_until=math.inf)  # how far the instance is
        self._state: Literal["instantiated", "initialization", "stepping", "ended", "failed", "closed"] = "instantiated"
        self._live = False
        self._was_reset = False
        self._keep: list[object] = []
        self._known_functions: dict[tuple[Verb, VariableType], tuple[str, Function]] = {}
        self._describe(description)
        prefix = self._functions.values.prefix
        # In FMI 1.0, the names of functions begin with the model identifier (FMI 1.0 CS, 3.1).
        self._symbols = f"{description.model_identifier}_{prefix}" if prefix == "fmi" else prefix
        self._kept = kept
        fmu = FmuToLoad(path, name, description, terms, self._functions, options.deep_binding, options.timeouts)
        left = cast("LoadedFmu | None", kept.take(name, fmu.key)) if kept is not None else None
        self._model = left or LoadedFmu(fmu, folder if kept is None else kept.folder)
        if left is None and kept is not None:
            kept.made(name, self._model)
        try:
            self._model.load()
            self._fmu = self._model.calls
            self._check_functions()
            self._instantiate()
            self._live = True
        except Exception as error:
            self._state = "failed"
            library = description.library if self._model.calls is None else None
            self.close()
            missing = missing_libraries(path, library, terms) if library else ()
            raise self._refused("; ".join(missing) or str(error)) from error

    @property
    def changes_process(self) -> bool:
        """See `ChangesProcess`."""
        return self._model.changes_process

    def enter_initialization(
        self, start_time: float, stop_time: float | None, start_values: Mapping[str, Value]
    ) -> None:
        """Set ``start_values`` and enter Initialization Mode (times in s, None: open end).

        Binary values may be base64 as in a configuration.
        """
        self._check_live()
        if self._functions.values.sized:  # FMI 3.0 alone has arrays
            self._describe(self.description.sized(start_values))
        values = {name: to_value(value, self._variables[name]) for name, value in start_values.items()}
        self._enter_initialization(start_time, stop_time, values)
        self._state = "initialization"

    def exit_initialization(self) -> None:
        """Leave Initialization Mode."""
        self._check_live()
        self._exit_initialization()
        self._state = "stepping"

    def set_values(self, values: Mapping[str, Value]) -> None:
        """Set variables by name."""
        self._check_live()
        for part in self._transfers(values):
            if part.is_plain:
                elements = [values[name] for name in part.names]
            else:
                elements = [e for v in part.variables for e in flattened(values[v.name], len(v.shape))]
            self._load(part.buffer, elements, part.names)
            self._transfer("Set", part)

    def get_values(self, names: Sequence[str]) -> list[Value]:
        """Current values of variables by name."""
        self._check_live()
        values: dict[str, Value] = {}
        for part in self._transfers(names):
            self._transfer("Get", part)
            elements, first = self._elements(part.buffer, part.names), 0
            if part.is_plain:
                values.update(zip(part.names, elements, strict=True))
                continue
            for variable in part.variables:
                values[variable.name] = nested(elements[first : first + variable.size], variable.shape)
                first += variable.size
        return [values[name] for name in names]

    def bind(self, inputs: Ring, outputs: Sequence[Ring], grid: TimeGrid, points: int, step: int = 0) -> None:
        """Let `do_step` work on these rings, ``points`` of ``grid`` each; write the current outputs as row ``step``."""
        self._check_live()
        self._start_time = grid.start_time
        self._base_step_size = grid.step_size
        self._points = points
        self._step_size = points * grid.step_size
        self._said.note(step=step)
        self._input_mask = inputs.mask
        self._keep = [inputs, *outputs]
        self._setters = self._part_calls("Set", inputs, RowBase.FIXED)
        getters = [
            call for base, ring in zip(_OWN_ROWS, outputs, strict=False) for call in self._part_calls("Get", ring, base)
        ]
        self._getters = sorted(getters, key=_is_buffered)
        self._read_outputs(step)

    @abstractmethod
    def do_step(self, step: int) -> None:
        """Set the inputs of row ``step``, advance to own step ``step + 1``, write the outputs to row ``step + 1``."""

    @abstractmethod
    def set_input_derivatives(self, derivatives: Mapping[str, float], *, continuous: bool = False) -> None:
        """Set the slopes of Real inputs within the next step, in 1/s (FMI 2.0, 4.2.1, fmi2SetRealInputDerivatives).

        If ``continuous``, no input jumps at the start of the step, apart from the error of an extrapolation.
        """

    @abstractmethod
    def advance(self, time: float, step_size: float) -> None:
        """One step of ``step_size`` from ``time`` (both in s) without rings, for callers with their own time base."""

    def close(self) -> None:
        """Terminate if allowed, free the instance and remove its files. Never raises; may be called twice."""
        if self._state == "closed":
            return
        if self._live and self._state == "stepping":
            self._end_simulation()
        elif self._live and self._state != "ended":
            self._quietly(self._release)
        self._leave_model()
        unregister(self)
        self._live = False
        self._state = "closed"
        self._keep = []

    def remove_files(self) -> None:
        """From any thread, when the process is about to be ended: remove the extracted files."""
        self._model.remove_files()

    def get_state(self) -> FmuState:
        """See `KeepsState`."""
        self._check_state(self.description.can_get_and_set_state, "get and set its state")
        return FmuState(self._on_state(self._fmu.getFMUState), self._bookkeeping())

    def set_state(self, state: object) -> None:
        """See `KeepsState`."""
        own = of_kind(FmuState, state)
        self._on_state(lambda: self._fmu.setFMUState(own.handle))
        self._restore(own.kept)

    def free_state(self, state: object) -> None:
        """See `KeepsState`."""
        own = of_kind(FmuState, state)
        with suppress(StepFailed):  # it takes memory, and nothing else
            self._on_state(lambda: self._fmu.freeFMUState(own.handle))

    def serialize_state(self, state: object) -> bytes:
        """See `KeepsState`."""
        self._check_state(self.description.can_serialize_state, "serialize its state")
        own = of_kind(FmuState, state)
        return packed(own.kept, self._on_state(lambda: self._fmu.serializeFMUState(own.handle)))

    def deserialize_state(self, data: bytes) -> FmuState:
        """See `KeepsState`."""
        self._check_state(self.description.can_serialize_state, "serialize its state")
        kept, rest = unpacked(data, Bookkeeping, self.name)
        return FmuState(self._on_state(lambda: self._fmu.deserializeFMUState(rest)), kept)

    def logged(self, status: int, category: bytes, message: bytes, counted: int) -> None:
        """See `Logged`; the last messages become part of an error that follows."""
        if status > OK:
            self.recalled(message)
        text, kind = message.decode(errors="replace").strip(), category.decode(errors="replace")
        if counted:
            more = f"{counted:,} more messages" if counted > 1 else "1 more message"
            text = f"{more} like '{text}' ({kind}) {'were' if counted > 1 else 'was'} not shown"
        self._log(LogMessage(self.name, status_name(status), kind, text, self._said.step))

    def recalled(self, message: bytes) -> None:
        """See `Logged`."""
        self._last_messages = [*self._last_messages[-2:], message.decode(errors="replace").strip()]

    # --- what a version of FMI and a kind of FMU add

    def _instantiate(self, **arguments: object) -> None:
        """Make the instance with these arguments for FMPy, unless one was reset; look up what the steps need."""
        self._make(**arguments)

    def _make(self, **arguments: object) -> None:
        """Make the instance; without arguments, with those of the last one."""
        register(self.name, self, id(self._model))
        self._model.instantiate(**arguments)
        self._component, self._self = self._model.component, self._model.pointer
        if not self._functions.values.sized:  # FMI 3.0 passes no component to its logger
            register_component(self._component, self)

    @abstractmethod
    def _enter_initialization(self, start_time: float, stop_time: float | None, start_values: dict[str, Value]) -> None:
        """Set the start values and enter Initialization Mode."""

    def _exit_initialization(self) -> None:
        """Leave Initialization Mode."""
        self._checked(self._fmu.exitInitializationMode)

    def _terminate(self) -> None:
        """End the simulation."""
        self._fmu.terminate()

    def _release(self) -> None:  # noqa: B027 most have allocated nothing
        """Free what this object has allocated in the FMU."""

    # --- its life

    def _end_simulation(self) -> None:
        """End the simulation, and reset the instance if the next run gets this one."""
        kept, only_once = self._kept, self.description.only_once_per_process
        resets = kept is not None and not kept.is_closed and (kept.resets or only_once)
        self._was_reset = self._end_run(resets=resets)
        self._state = "ended"

    def _end_run(self, *, resets: bool) -> bool:
        """End the simulation; with ``resets`` also reset the instance, and return whether that was done."""
        self._quietly(self._terminate)
        self._quietly(self._release)
        return resets and not self._model.is_lost and self._model.reset()

    def _quietly(self, call: Callable[[], object]) -> None:
        """Call a function at the end, where a failure has no consequence, but that of fatal."""
        try:
            if not self._model.is_lost:
                call()
        except FMICallException as error:
            self._note(error.status)
        except OSError:
            return

    @property
    def _is_used_up(self) -> bool:
        """Whether there can be no other instance: a library that allows one instance is unloaded with it."""
        return self._model.is_lost or (self.description.only_once_per_process and not self._was_reset)

    def _leave_model(self) -> None:
        """Leave the FMU to the next instance of this name; after a failure nothing of it is used again."""
        model = self._model
        kept = self._kept
        if kept is None or kept.is_closed or not self._live or self._state == "failed" or self._is_used_up:
            model.close()
            return
        if not self._was_reset:
            model.free()
        kept.keep(self.name, model)

    def _tolerance(self) -> float | None:
        """The tolerance for the FMU (FMI 2.0, 2.1.6; FMI 3.0, 2.3.2)."""
        return self._options.tolerance or self.description.default_experiment.tolerance

    def _bookkeeping(self) -> Bookkeeping:
        return Bookkeeping(self._said.step)

    def _restore(self, kept: Bookkeeping) -> None:
        self._said.note(step=kept.step)
        self._state = "stepping"

    def _describe(self, description: ModelDescription) -> None:
        if description is getattr(self, "description", None):
            return
        self.description = description
        self._known_transfers: dict[tuple[str, ...], list[_Transfer]] = {}
        self._variables = {variable.name: variable for variable in description.variables}

    def _check_functions(self) -> None:
        """Refuse a library without a function that every run needs; others may be missing until they are called."""
        names = {*self._functions.needed}
        names |= {self._function_name("Get", variable.type) for variable in self.description.with_causality("output")}
        names |= {self._function_name("Set", variable.type) for variable in self.description.with_causality("input")}
        missing = self._fmu.dll.missing  # in FMI 1.0 with the model identifier before the name
        if lacking := sorted(name for name in names if any(one.endswith(name) for one in missing)):
            raise RuntimeError(f"its library has no function {', '.join(lacking)}, which every run needs")

    def _check_live(self) -> None:
        if self._model.is_lost:
            raise FmuError("the FMU has returned fatal: no function of it may be called any more", instance=self.name)
        if not self._live:
            msg = f"instance '{self.name}' is closed"
            raise ValueError(msg)

    def _checked(self, call: Callable[[], T]) -> T:
        """Call the FMU; if it or its solver fails, that is an error of this instance."""
        try:
            return call()
        except FMICallException as error:
            raise self._failed(error.function, status=error.status) from error
        except SolverFailed as error:
            raise self._failed(f"{self._solver}{error}") from error

    def _note(self, status: int) -> None:
        """After fatal, no function of the instance is called, not even to free it (FMI 2.0, 2.1.3; 3.0, 2.2.3)."""
        if status == FATAL:
            self._model.lose()

    def _failed(
        self, what: str, variable: str | None = None, hint: str | None = None, status: int | None = None
    ) -> StepFailed | InitializationFailed:
        if status is not None:
            what = f"{what} returned {status_name(status)}"
            self._note(status)
        kind = StepFailed if self._state == "stepping" else InitializationFailed
        self._state = "failed"
        error = kind(f"{what}{self._message()}", instance=self.name, variable=variable, hint=hint)
        tell_counted(self)  # a node closes its instances after it has told its failure
        return error

    def _end_requested(self) -> TerminationRequested:
        return TerminationRequested("the FMU asked to end the simulation", instance=self.name)

    def _refused(self, why: str) -> LoadFailed:
        return LoadFailed(f"'{self._model.path}' cannot be instantiated: {why}{self._message()}", instance=self.name)

    def _message(self) -> str:
        recall()
        messages, self._last_messages = self._last_messages, []
        return f"; the FMU says: {' | '.join(messages)}." if messages else "; the FMU gave no message."

    # --- its states

    def _check_state(self, can: bool, what: str) -> None:  # noqa: FBT001 a capability flag
        if not can:
            raise FmuError(f"the FMU cannot {what}, as its model description says", instance=self.name)

    def _on_state(self, call: Callable[[], T]) -> T:
        """Call the FMU; if it fails, the instance may go on."""
        self._check_live()
        try:
            return call()
        except FMICallException as error:
            self._note(error.status)
            raise StepFailed(f"{error.function} returned {status_name(error.status)}", instance=self.name) from error

    # --- its values

    def _time_of(self, step: int) -> float:
        """The time in s at which own step ``step`` begins: one multiplication, as in `TimeGrid.time`."""
        return self._start_time + step * self._points * self._base_step_size

    def _part_calls(self, verb: Verb, ring: Ring, base: RowBase) -> list[PartCall]:
        """The calls that move a row of a ring; those that need no buffer are first."""
        calls, functions = [], self._functions.values
        for number, part in enumerate(ring.layout.parts):
            variables = [self._variables[column.name] for column in part.columns]
            array, offset = ring.parts[number], ring.offsets[number]
            is_direct = functions.is_direct(part.type, variables)
            buffer = None if is_direct else functions.buffer(part.type, variables)
            calls.append(
                PartCall(
                    type=part.type,
                    variables=variables,
                    array=array,
                    base=base,
                    place=ring.address + offset if base == RowBase.FIXED else offset,
                    sizes=(part.width,) if functions.sized else (),
                    buffer=buffer,
                    function=self._function(verb, part.type),
                    arguments=functions.arguments(variables, buffer),
                    rows=RowPointers(array.ctypes.data, array.strides[0]),
                )
            )
        return sorted(calls, key=_is_buffered)

    def _set_inputs(self, step: int) -> None:
        """Set the inputs of row ``step``, call by call."""
        self._set_row(step & self._input_mask, self._setters)

    def _set_row(self, slot: int, setters: Sequence[PartCall]) -> None:
        for part in setters:
            if part.buffer is None:
                self._call_part("Set", part, slot)
            else:
                self._load(part.buffer, part.array[slot], part.names)
                self._transfer("Set", part)

    def _read_outputs(self, step: int) -> None:
        """Write the outputs to row ``step``, call by call."""
        for part in self._getters:
            slot = step & (len(part.array) - 1)
            if part.buffer is None:
                self._call_part("Get", part, slot)
            else:
                self._transfer("Get", part)
                part.array[slot] = self._elements(part.buffer, part.names)

    def _call_part(self, verb: Verb, part: PartCall, slot: int) -> None:
        """Call a function of the FMU on the memory of a ring."""
        status = call_named(_DOING[verb], part.function, self._self, *part.arguments, part.rows[slot], *part.sizes)
        if status > WARNING:
            raise self._part_failed(verb, part, status)

    def _part_failed(self, verb: Verb, part: PartCall, status: int) -> StepFailed | InitializationFailed:
        """The error for a getter or setter of a row that has returned a status above warning."""
        if part.buffer is None:
            return self._failed(_DOING[verb], status=status)
        return self._transfer_failed(verb, part.type, part.variables, status)

    def _transfer(self, verb: Verb, part: _Transfer | PartCall) -> None:
        """Call the getter or setter of a type for some variables, once, on the memory of their buffer."""
        name, function = self._named(verb, part.type)
        if (status := call_named(name, function, self._self, *part.arguments)) > WARNING:
            raise self._transfer_failed(verb, part.type, part.variables, status)

    def _function_name(self, verb: Verb, type_: VariableType) -> str:
        """The name of a getter or setter, for errors."""
        functions = self._functions.values
        return functions.prefix + functions.name(verb, type_)

    def _function(self, verb: Verb, type_: VariableType) -> Function:
        return self._named(verb, type_)[1]

    def _named(self, verb: Verb, type_: VariableType) -> tuple[str, Function]:
        """A getter or setter, and its name."""
        if (known := self._known_functions.get((verb, type_))) is not None:
            return known
        functions = self._functions.values
        found = getattr(self._fmu.dll, self._symbols + functions.name(verb, type_))
        made = self._function_name(verb, type_), cffi_function(found, functions.declaration(type_))
        self._known_functions[verb, type_] = made
        return made

    def _transfer_failed(
        self, verb: Verb, type_: VariableType, variables: Sequence[Variable], status: int
    ) -> StepFailed | InitializationFailed:
        names = [variable.name for variable in variables]
        odd = next((v for v in variables if verb == "Set" and not v.settable_before_start), None)
        hint = None
        if odd is not None:
            hint = f"FMI does not allow setting '{odd.name}', {odd.role}: leave its start value out."
        what = f"{self._function_name(verb, type_)} of {', '.join(names)}"
        return self._failed(what, status=status, variable=names[0] if len(names) == 1 else None, hint=hint)

    def _load(self, buffer: Buffer, elements: Any, names: Sequence[str]) -> None:  # noqa: ANN401 a list or an array
        try:
            buffer.load(elements)
        except OverflowError as error:
            raise self._failed(f"{', '.join(names)} cannot be set: {error}") from error

    def _elements(self, buffer: Buffer, names: Sequence[str]) -> list[Any]:
        try:
            elements = buffer.values()
        except OverflowError as error:
            raise self._failed(f"{', '.join(names)} cannot be read: {error}") from error
        return elements.tolist() if hasattr(elements, "tolist") else list(elements)

    def _transfers(self, names: Iterable[str]) -> list[_Transfer]:
        """Memory for the values of variables, a part for each type; the last ones are known."""
        key = tuple(names)
        if (known := self._known_transfers.get(key)) is not None:
            return known
        groups: dict[VariableType, list[str]] = {}
        for name in key:
            groups.setdefault(self._variables[name].type, []).append(name)
        found = []
        for type_, members in groups.items():
            variables = [self._variables[name] for name in members]
            functions, is_plain = self._functions.values, not any(variable.shape for variable in variables)
            buffer = functions.buffer(type_, variables)
            arguments = functions.arguments(variables, buffer)
            found.append(_Transfer(type_, variables, members, buffer, arguments, is_plain))
        if len(self._known_transfers) >= _MOST_KNOWN:
            self._known_transfers.clear()
        self._known_transfers[key] = found
        return found


def _is_buffered(part: PartCall) -> bool:
    return part.buffer is not None
