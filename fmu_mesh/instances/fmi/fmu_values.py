"""Variables of an FMU by name, and as the rows of rings.

Where the memory of a ring has the layout that a function of the FMU expects, the function works on the ring itself. For
all other types a `Buffer` is in between. The versions of FMI differ in their functions, which a subclass adds.
"""

from __future__ import annotations

import ctypes
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final, Literal

from ...errors import InitializationFailed, StepFailed
from ...rings.ring import Ring
from ...simtime import TimeGrid
from ...system.layout import Part
from ...variables.model_description import ModelDescription, Variable
from ...variables.value_types import Value, VariableType, flattened, nested
from ..call_guard import call_named
from .buffers import Buffer
from .calls import DirectCall, Function, Pointer, RowPointers, cffi_function, memory

__all__ = ["OK", "STATUS_NAMES", "WARNING", "FmuValues", "Verb"]

OK: Final = 0
WARNING: Final = 1
STATUS_NAMES: Final = ("ok", "warning", "discard", "error", "fatal", "pending")

Verb = Literal["Get", "Set"]


class FmuValues(ABC):
    """The values of one instance of an FMU.

    Raises:
        FmuError: by every method: the FMU returned a status above warning.
    """

    _direct_declaration: str
    """C type of the functions that get and set numbers."""

    _description: ModelDescription
    _variables: Mapping[str, Variable]
    _keep: list[object]
    _step: int

    def set_values(self, values: Mapping[str, Value]) -> None:
        """Set variables by name."""
        self._check_live()
        for type_, names in self._by_type(values).items():
            variables = [self._variables[name] for name in names]
            buffer = self._buffer(type_, variables)
            self._load(buffer, [e for v in variables for e in flattened(values[v.name], len(v.shape))], names)
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

    # --- what a version of FMI adds

    @abstractmethod
    def _function(self, verb: Verb, type_: VariableType) -> Callable[..., int]:
        """The function that gets or sets values of a type."""

    @abstractmethod
    def _function_name(self, verb: Verb, type_: VariableType) -> str:
        """The name of this function, for errors."""

    @abstractmethod
    def _buffer(self, type_: VariableType, variables: Sequence[Variable]) -> Buffer:
        """Memory for the values of variables of one type, in the C type of this version of FMI."""

    @abstractmethod
    def _is_direct(self, part: Part) -> bool:
        """Whether a ring stores this part of a row in the C type of this version of FMI."""

    @abstractmethod
    def _call(self, function: Callable[..., int], references: Sequence[int], buffer: Buffer, size: int) -> int:
        """Call a getter or setter on a buffer with ``size`` values; returns the status."""

    @abstractmethod
    def _call_direct(self, function: Function, references: Pointer, count: int, row: Pointer, size: int) -> int:
        """Call a getter or setter on the memory of a ring; returns the status."""

    # --- what an instance adds

    @abstractmethod
    def _check_live(self) -> None:
        """Raise a ValueError if the instance is closed."""

    @abstractmethod
    def _failed(
        self, what: str, variable: str | None = None, hint: str | None = None
    ) -> StepFailed | InitializationFailed:
        """The error for a failed call; only `close` is allowed after it."""

    # --- shared by all versions

    def _prepare(self, verb: Verb, part: Part, array: Any) -> None:  # noqa: ANN401 an array of any dtype
        """Prepare the call that copies one part of a row between ``array``, the memory of a ring, and the FMU."""
        variables = [self._variables[column.name] for column in part.columns]
        if self._is_direct(part):
            rows = RowPointers(array.ctypes.data, array.strides[0])
            function = cffi_function(self._function(verb, part.type), self._direct_declaration)
            calls = self._direct_setters if verb == "Set" else self._direct_getters
            calls.append((function, memory(_references(variables)), len(variables), rows, part.width))
            return
        buffer = self._buffer(part.type, variables)
        names = [variable.name for variable in variables]

        def set_row(slot: int) -> None:
            self._load(buffer, array[slot], names)
            self._transfer("Set", part.type, variables, buffer)

        def get_row(slot: int) -> None:
            self._transfer("Get", part.type, variables, buffer)
            array[slot] = self._elements(buffer, names)

        if verb == "Set":
            self._setters.append(set_row)
        else:
            self._getters.append(get_row)

    def _set_inputs(self, slot: int) -> None:
        self._set_row(slot, self._direct_setters, self._setters)

    def _set_row(self, slot: int, direct: Sequence[DirectCall], setters: Sequence[Callable[[int], None]]) -> None:
        for function, references, count, rows, size in direct:
            status = self._call_direct(function, references, count, rows[slot], size)
            if status > WARNING:
                raise self._failed(f"setting the inputs returned {STATUS_NAMES[status]}")
        for set_row in setters:
            set_row(slot)

    def _read_outputs(self, slot: int) -> None:
        for function, references, count, rows, size in self._direct_getters:
            status = self._call_direct(function, references, count, rows[slot], size)
            if status > WARNING:
                raise self._failed(f"reading the outputs returned {STATUS_NAMES[status]}")
        for get_row in self._getters:
            get_row(slot)

    def _transfer(self, verb: Verb, type_: VariableType, variables: Sequence[Variable], buffer: Buffer) -> None:
        """Call the getter or setter of a type for some variables, once."""
        references = [variable.value_reference for variable in variables]
        size = sum(variable.size for variable in variables)
        name = self._function_name(verb, type_)
        status = call_named(name, self._call, self._function(verb, type_), references, buffer, size)
        if status > WARNING:
            names = [variable.name for variable in variables]
            odd = next((v for v in variables if verb == "Set" and not v.settable_before_start), None)
            hint = None
            if odd is not None:
                hint = f"FMI does not allow setting '{odd.name}', {odd.role}: leave its start value out."
            what = f"{name} of {', '.join(names)} returned {STATUS_NAMES[status]}"
            raise self._failed(what, variable=names[0] if len(names) == 1 else None, hint=hint)

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

    def _by_type(self, names: Sequence[str] | Mapping[str, Value]) -> dict[VariableType, list[str]]:
        groups: dict[VariableType, list[str]] = {}
        for name in names:
            groups.setdefault(self._variables[name].type, []).append(name)
        return groups


def _references(variables: Sequence[Variable]) -> ctypes.Array[ctypes.c_uint]:
    return (ctypes.c_uint * len(variables))(*(variable.value_reference for variable in variables))
