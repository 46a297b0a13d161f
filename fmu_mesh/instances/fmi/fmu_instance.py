"""What the instances of all FMI versions have in common: files, messages, values by name, and rows.

A version adds the calls: how an instance is made, initialized, stepped and freed. The hot loop calls the functions of
the FMU on the memory of a `Ring` directly where a type lies there as C has it; a `Buffer` is in between for the others.
"""

from __future__ import annotations

import ctypes
import shutil
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final, Literal

from fmpy.fmi1 import FMICallException

from ...errors import InitializationFailed, LoadFailed, StepFailed
from ...rings.ring import Ring
from ...simtime import TimeGrid
from ...system.layout import Part
from ...variables.model_description import ModelDescription, Variable
from ...variables.value_conversion import to_value
from ...variables.value_types import Value, VariableType, flattened, nested
from ..contract import LogMessage
from .archive.archive import Terms
from .archive.sources import extract
from .buffers import Buffer
from .calls import DirectCall, Function, Pointer, Rows, hot, memory, pointer
from .state import KeepsFmuState, Standing
from .step_options import StepOptions

__all__ = ["OK", "STATUS_NAMES", "WARNING", "FmuInstance", "LogSink", "Verb"]

OK: Final = 0
WARNING: Final = 1
STATUS_NAMES: Final = ("ok", "warning", "discard", "error", "fatal", "pending")

Verb = Literal["Get", "Set"]
LogSink = Callable[[LogMessage], None]


class FmuInstance(KeepsFmuState, ABC):
    """One instance of an FMU; see `fmu_mesh.instances.contract.Instance` for the call sequence.

    Args:
        path: the .fmu file.
        name: instance name.
        description: what `read_description` returned for it.
        folder: an existing private folder to extract into.
        log: called with every log message, on the thread that calls the FMU.
        terms: what the FMU has to keep to.
        options: how it is stepped.

    Raises:
        LoadFailed: the FMU cannot be extracted, loaded or instantiated.
    """

    _direct_declaration: str
    """The type in C of the functions that get and set numbers."""

    _component: int
    """The address of the instance, for what is called through ctypes; for `hot` functions it is ``_self``."""

    def __init__(  # noqa: PLR0913, PLR0917 what an instance is made of; all of it is named where it is called
        self,
        path: Path,
        name: str,
        description: ModelDescription,
        folder: Path,
        log: LogSink = lambda _message: None,
        terms: Terms = Terms(),  # noqa: B008 a frozen Struct
        options: StepOptions = StepOptions(),  # noqa: B008 a frozen Struct
    ) -> None:
        self.name = name
        self._options = options
        self._log = log
        self._last_messages: list[str] = []
        self._step = -1
        self._state: Literal["instantiated", "initialization", "stepping", "failed", "closed"] = "instantiated"
        self._live = False
        self._keep: list[object] = []
        self._describe(description)
        self._extracted = extract(path, folder, terms, model=description)
        try:
            self._instantiate(self._extracted)
            self._self = pointer(self._component)
            self._live = True
        except Exception as error:
            self._state = "failed"
            self.close()
            raise LoadFailed(f"'{path}' cannot be instantiated: {error}{self._said()}", instance=name) from error

    @property
    def description(self) -> ModelDescription:
        """The model description; arrays have the shapes that the structural parameters give them."""
        return self._description

    def enter_initialization(
        self, start_time: float, stop_time: float | None, start_values: Mapping[str, Value]
    ) -> None:
        """Set ``start_values`` and enter Initialization Mode (times in s, None: open end).

        Binary values may be base64 as in a configuration.
        """
        self._check_live()
        self._describe(self._description.sized(start_values))
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
        for type_, names in self._by_type(values).items():
            variables = [self._variables[name] for name in names]
            buffer = self._buffer(type_, variables)
            try:
                buffer.load([e for v in variables for e in flattened(values[v.name], len(v.shape))])
            except OverflowError as error:
                raise self._failed(f"{', '.join(names)} cannot be set: {error}") from error
            self._transfer("Set", type_, variables, buffer)

    def get_values(self, names: Sequence[str]) -> list[Value]:
        """Current values of variables by name."""
        self._check_live()
        values: dict[str, Value] = {}
        for type_, members in self._by_type(names).items():
            variables = [self._variables[name] for name in members]
            buffer = self._buffer(type_, variables)
            self._transfer("Get", type_, variables, buffer)
            elements = self._elements(buffer, members)
            for variable in variables:
                values[variable.name] = nested(elements[: variable.size], variable.shape)
                elements = elements[variable.size :]
        return [values[name] for name in names]

    def bind(self, inputs: Ring, outputs: Sequence[Ring], grid: TimeGrid, points: int, step: int = 0) -> None:
        """Let `do_step` work on these rings, ``points`` of ``grid`` each; write the current outputs as row ``step``."""
        self._check_live()
        self._start_time = grid.start_time
        self._base_step_size = grid.step_size
        self._points = points
        self._step_size = points * grid.step_size
        self._step = step
        self._input_mask = inputs.mask
        self._output_mask = outputs[0].mask
        self._keep = [inputs, *outputs]
        self._direct_setters: list[DirectCall] = []
        self._direct_getters: list[DirectCall] = []
        self._setters: list[Callable[[int], None]] = []
        self._getters: list[Callable[[int], None]] = []
        for number, part in enumerate(inputs.layout.parts):
            self._prepare("Set", part, inputs.parts[number])
        for ring in outputs:
            for number, part in enumerate(ring.layout.parts):
                self._prepare("Get", part, ring.parts[number])
        self._read_outputs(step & self._output_mask)

    @abstractmethod
    def do_step(self, step: int) -> None:
        """Set the inputs of row ``step``, advance to own step ``step + 1``, write the outputs to row ``step + 1``."""

    @abstractmethod
    def advance(self, time: float, step_size: float) -> None:
        """One step of ``step_size`` from ``time`` (both in s) without rings, for callers with their own time base."""

    def close(self) -> None:
        """Terminate if allowed, free the instance and remove its files. Never raises; may be called twice."""
        if self._state == "closed":
            return
        if self._live:
            if self._state == "stepping":
                _quietly(self._terminate)
            _quietly(self._free)
        self._live = False
        self._state = "closed"
        self._keep = []
        self.remove_files()

    def remove_files(self) -> None:
        """From any thread, when the process is about to be ended: remove the extracted files."""
        shutil.rmtree(self._extracted, ignore_errors=True)

    def logged(self, status: int, category: bytes, message: bytes) -> None:
        """Take a message from the FMU's logger; keeps the last ones for the error that may follow."""
        text = message.decode(errors="replace").strip()
        name = STATUS_NAMES[status] if 0 <= status < len(STATUS_NAMES) else str(status)
        if status > OK:
            self._last_messages = [*self._last_messages[-2:], text]
        self._log(LogMessage(self.name, name, category.decode(errors="replace"), text, self._step))

    # --- what a version of FMI adds

    @abstractmethod
    def _instantiate(self, folder: Path) -> None:
        """Load the library from the extracted FMU and make the instance; any exception says why it cannot be."""

    @abstractmethod
    def _enter_initialization(self, start_time: float, stop_time: float | None, start_values: dict[str, Value]) -> None:
        """Set the start values and enter Initialization Mode."""

    @abstractmethod
    def _exit_initialization(self) -> None:
        """Leave Initialization Mode."""

    @abstractmethod
    def _terminate(self) -> None:
        """End the simulation."""

    @abstractmethod
    def _free(self) -> None:
        """Free the instance."""

    @abstractmethod
    def _function(self, verb: Verb, type_: VariableType) -> Callable[..., int]:
        """The function that gets or sets values of a type."""

    @abstractmethod
    def _buffer(self, type_: VariableType, variables: Sequence[Variable]) -> Buffer:
        """Memory for the values of variables of one type, as this version of FMI has it in C."""

    @abstractmethod
    def _is_direct(self, part: Part) -> bool:
        """Whether the values of a part lie in a ring as the functions of this version have them in C."""

    @abstractmethod
    def _call(self, function: Callable[..., int], references: Sequence[int], buffer: Buffer, size: int) -> int:
        """Call a getter or setter on a buffer with ``size`` values; returns the status."""

    # --- the state

    def _standing(self) -> Standing:
        return Standing(self._step)

    def _stand(self, standing: Standing) -> None:
        self._step = standing.step
        self._state = "stepping"

    # --- shared by the versions

    def _describe(self, description: ModelDescription) -> None:
        self._description = description
        self._variables = {variable.name: variable for variable in description.variables}

    def _prepare(self, verb: Verb, part: Part, array: Any) -> None:  # noqa: ANN401 an array of any dtype
        """Prepare what moves one part of a row: a function on the memory of the ring, or one with a buffer."""
        variables = [self._variables[column.name] for column in part.columns]
        function = self._function(verb, part.type)
        if self._is_direct(part):
            rows = Rows(array.ctypes.data, array.strides[0])
            calls = self._direct_setters if verb == "Set" else self._direct_getters
            called = hot(function, self._direct_declaration)
            calls.append((called, memory(_references(variables)), len(variables), rows, part.width))
            return
        buffer = self._buffer(part.type, variables)
        names = [variable.name for variable in variables]

        def set_row(slot: int) -> None:
            try:
                buffer.load(array[slot])
            except OverflowError as error:
                raise self._failed(f"{', '.join(names)} cannot be set: {error}") from error
            self._transfer("Set", part.type, variables, buffer)

        def get_row(slot: int) -> None:
            self._transfer("Get", part.type, variables, buffer)
            array[slot] = self._elements(buffer, names)

        if verb == "Set":
            self._setters.append(set_row)
        else:
            self._getters.append(get_row)

    def _set_inputs(self, slot: int) -> None:
        for function, references, count, rows, size in self._direct_setters:
            status = self._call_direct(function, references, count, rows[slot], size)
            if status > WARNING:
                raise self._failed(f"setting the inputs returned {STATUS_NAMES[status]}")
        for set_row in self._setters:
            set_row(slot)

    def _read_outputs(self, slot: int) -> None:
        for function, references, count, rows, size in self._direct_getters:
            status = self._call_direct(function, references, count, rows[slot], size)
            if status > WARNING:
                raise self._failed(f"reading the outputs returned {STATUS_NAMES[status]}")
        for get_row in self._getters:
            get_row(slot)

    @abstractmethod
    def _call_direct(self, function: Function, references: Pointer, count: int, row: Pointer, size: int) -> int:
        """Call a getter or setter on the memory of a ring; returns the status."""

    def _transfer(self, verb: Verb, type_: VariableType, variables: Sequence[Variable], buffer: Buffer) -> None:
        """Call the getter or setter of a type for some variables, once.

        Raises:
            FmuError: the FMU refused.
        """
        references = [variable.value_reference for variable in variables]
        size = sum(variable.size for variable in variables)
        status = self._call(self._function(verb, type_), references, buffer, size)
        if status > WARNING:
            names = [variable.name for variable in variables]
            what = f"{self._function_name(verb, type_)} of {', '.join(names)} returned {STATUS_NAMES[status]}"
            odd = next((v for v in variables if verb == "Set" and not v.settable_before_start), None)
            hint = None
            if odd is not None:
                hint = f"FMI does not allow setting '{odd.name}', {odd.role}: leave its start value out."
            raise self._failed(what, variable=names[0] if len(names) == 1 else None, hint=hint)

    @abstractmethod
    def _function_name(self, verb: Verb, type_: VariableType) -> str:
        """The name of the function that gets or sets values of a type, for errors."""

    def _elements(self, buffer: Buffer, names: Sequence[str]) -> list[Any]:
        try:
            elements = buffer.values()
        except OverflowError as error:
            raise self._failed(f"{', '.join(names)} cannot be read: {error}") from error
        return elements.tolist() if hasattr(elements, "tolist") else list(elements)

    def _by_type(self, names: Sequence[str] | Mapping[str, Value]) -> dict[VariableType, list[str]]:
        groups: dict[VariableType, list[str]] = {}
        for name in names:
            groups.setdefault(self._variables[name].type, []).append(name)
        return groups

    def _check_live(self) -> None:
        if not self._live:
            msg = f"instance '{self.name}' is closed"
            raise ValueError(msg)

    def _initializing(self, function: str, call: Callable[[], object]) -> None:
        try:
            call()
        except FMICallException as error:
            self._state = "failed"
            text = f"{function} returned {STATUS_NAMES[error.status]}{self._said()}"
            raise InitializationFailed(text, instance=self.name) from error

    def _failed(
        self, what: str, variable: str | None = None, hint: str | None = None
    ) -> StepFailed | InitializationFailed:
        kind = StepFailed if self._state == "stepping" else InitializationFailed
        self._state = "failed"
        return kind(f"{what}{self._said()}", instance=self.name, variable=variable, hint=hint)

    def _said(self) -> str:
        messages, self._last_messages = self._last_messages, []
        return f"; the FMU says: {' | '.join(messages)}." if messages else "; the FMU gave no message."


def _references(variables: Sequence[Variable]) -> ctypes.Array[ctypes.c_uint]:
    return (ctypes.c_uint * len(variables))(*(variable.value_reference for variable in variables))


def _quietly(call: Callable[[], object]) -> None:
    """Call a function of the FMU on the way out, where its failure changes nothing any more."""
    try:
        call()
    except (FMICallException, OSError):
        return
