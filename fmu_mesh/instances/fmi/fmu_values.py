"""Variables of an FMU by name, and as the rows of rings.

Where the memory of a ring has the layout that a function of the FMU expects, the function works on the ring itself. For
all other types a `Buffer` is in between. The versions of FMI differ in their functions, which a subclass adds.
"""

from __future__ import annotations

import ctypes
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final, Literal, NamedTuple

from numpy.typing import NDArray

from ...errors import InitializationFailed, StepFailed
from ...rings.native import Call, RowBase, Said, Stage
from ...rings.ring import Ring
from ...simtime import TimeGrid
from ...system.layout import Part
from ...variables.model_description import ModelDescription, Variable
from ...variables.value_types import Value, VariableType, flattened, nested
from ..call_guard import call_named, doing
from .buffers import Buffer
from .calls import Function, Pointer, RowPointers, address_of, cffi_function, memory
from .fmu_library import MISSING

__all__ = ["DISCARD", "FATAL", "OK", "WARNING", "FmuValues", "PartCall", "Verb", "status_name"]

OK: Final = 0
WARNING: Final = 1
DISCARD: Final = 2
FATAL: Final = 4
_STATUS_NAMES: Final = ("ok", "warning", "discard", "error", "fatal", "pending")

Verb = Literal["Get", "Set"]

_DOING: Final[dict[Verb, str]] = {"Set": doing(Stage.SETTING), "Get": doing(Stage.GETTING)}
_OWN_ROWS: Final = (RowBase.OUTPUT, RowBase.WATCHED)


class PartCall(NamedTuple):
    """The call that moves one part of a row between a ring and the FMU.

    Attributes:
        type: the type of the part.
        variables: its variables.
        array: the memory of the ring, of shape (rows, elements).
        base: what `place` is relative to, in the tables of the library.
        place: of the elements in the row, in bytes; for `RowBase.FIXED` the address of those of row 0.
        size: number of elements.
        buffer: what the function of the FMU works on; None: on the ring itself.
        function: the getter or setter.
        references: its value references.
        rows: pointers to the elements in the ring.
    """

    type: VariableType
    variables: Sequence[Variable]
    array: NDArray[Any]
    base: RowBase
    place: int
    size: int
    buffer: Buffer | None
    function: Function
    references: Pointer
    rows: RowPointers

    @property
    def names(self) -> list[str]:
        """The names of the variables."""
        return [variable.name for variable in self.variables]

    def in_table(self, *, sized: bool) -> Call:
        """The call for the library; ``sized``: the function also takes the number of values (FMI 3.0, 2.2.7)."""
        base, values = (self.base, self.place) if self.buffer is None else (RowBase.FIXED, self.buffer.address)
        size = self.size if sized else -1
        return Call(address_of(self.function), address_of(self.references), len(self.variables), base, values, size)


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
    _said: Said
    """How far the instance is."""

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
            elements, first = self._elements(buffer, members), 0
            for variable in variables:
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
        self, what: str, variable: str | None = None, hint: str | None = None, status: int | None = None
    ) -> StepFailed | InitializationFailed:
        """The error for a failed call, which may have returned ``status``; only `close` is allowed after it."""

    # --- shared by all versions

    def _time_of(self, step: int) -> float:
        """The time in s at which own step ``step`` begins: one multiplication, as in `TimeGrid.time`."""
        return self._start_time + step * self._points * self._base_step_size

    def _part_calls(self, verb: Verb, ring: Ring, base: RowBase) -> list[PartCall]:
        """The calls that move a row of a ring; those that need no buffer are first."""
        calls = []
        for number, part in enumerate(ring.layout.parts):
            variables = [self._variables[column.name] for column in part.columns]
            array, offset = ring.parts[number], ring.offsets[number]
            calls.append(
                PartCall(
                    type=part.type,
                    variables=variables,
                    array=array,
                    base=base,
                    place=ring.address + offset if base == RowBase.FIXED else offset,
                    size=part.width,
                    buffer=None if self._is_direct(part) else self._buffer(part.type, variables),
                    function=cffi_function(self._function(verb, part.type), self._direct_declaration),
                    references=memory(_references(variables)),
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
                self._transfer("Set", part.type, part.variables, part.buffer)

    def _read_outputs(self, step: int) -> None:
        """Write the outputs to row ``step``, call by call."""
        for part in self._getters:
            slot = step & (len(part.array) - 1)
            if part.buffer is None:
                self._call_part("Get", part, slot)
            else:
                self._transfer("Get", part.type, part.variables, part.buffer)
                part.array[slot] = self._elements(part.buffer, part.names)

    def _call_part(self, verb: Verb, part: PartCall, slot: int) -> None:
        """Call a function of the FMU on the memory of a ring."""
        arguments = part.function, part.references, len(part.variables), part.rows[slot], part.size
        status = call_named(_DOING[verb], self._call_direct, *arguments)
        if status > WARNING:
            raise self._part_failed(verb, part, status)

    def _part_failed(self, verb: Verb, part: PartCall, status: int) -> StepFailed | InitializationFailed:
        """The error for a getter or setter of a row that has returned a status above warning."""
        if part.buffer is None:
            return self._failed(_DOING[verb], status=status)
        return self._transfer_failed(verb, part.type, part.variables, status)

    def _transfer(self, verb: Verb, type_: VariableType, variables: Sequence[Variable], buffer: Buffer) -> None:
        """Call the getter or setter of a type for some variables, once."""
        references = [variable.value_reference for variable in variables]
        size = sum(variable.size for variable in variables)
        name = self._function_name(verb, type_)
        status = call_named(name, self._call, self._function(verb, type_), references, buffer, size)
        if status > WARNING:
            raise self._transfer_failed(verb, type_, variables, status)

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

    def _by_type(self, names: Sequence[str] | Mapping[str, Value]) -> dict[VariableType, list[str]]:
        groups: dict[VariableType, list[str]] = {}
        for name in names:
            groups.setdefault(self._variables[name].type, []).append(name)
        return groups


def status_name(status: int) -> str:
    """The name of a status in the words of FMI (FMI 2.0, 2.1.3); of a number that FMI does not know, the number."""
    if status == MISSING:
        return "nothing: its library does not have this function"
    return _STATUS_NAMES[status] if 0 <= status < len(_STATUS_NAMES) else str(status)


def _is_buffered(part: PartCall) -> bool:
    return part.buffer is not None


def _references(variables: Sequence[Variable]) -> ctypes.Array[ctypes.c_uint]:
    return (ctypes.c_uint * len(variables))(*(variable.value_reference for variable in variables))
