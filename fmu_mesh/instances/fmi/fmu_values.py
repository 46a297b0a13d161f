"""How an FMU gets and sets values, in each version of FMI; and the call that moves a part of a row.

Where the memory of a ring has the layout that a function of the FMU expects, the function works on the ring itself. For
all other types a `Buffer` is in between.
"""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from typing import Any, Final, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...rings.native import Call, RowBase
from ...variables.model_description import Variable
from ...variables.value_types import DTYPES, VariableType, is_text
from .buffers import BinaryBuffer, Buffer, NumberBuffer, StringBuffer
from .calls import Function, RowPointers, address_of, memory, pointer
from .fmu_library import MISSING

__all__ = ["DISCARD", "FATAL", "OK", "WARNING", "PartCall", "SolverFailed", "ValueFunctions", "Verb", "status_name"]

OK: Final = 0
WARNING: Final = 1
DISCARD: Final = 2
FATAL: Final = 4
_STATUS_NAMES: Final = ("ok", "warning", "discard", "error", "fatal", "pending")

Verb = Literal["Get", "Set"]

_FMI2_NAMES: Final[dict[VariableType, str]] = {"Float64": "Real", "Int32": "Integer", "Enumeration": "Integer"}
"""The types of FMI 1.0 and 2.0 that have another name in FMI 3.0."""


class SolverFailed(Exception):
    """Steps make no progress, or events do not converge; the text says why."""


class ValueFunctions(NamedTuple):
    """The functions of one version of FMI that get and set values, a pair for each type."""

    prefix: str  # what the names of all functions begin with
    boolean: type[Any]  # the C type of a Boolean
    # whether they also take the number of values, and each type has its own (FMI 3.0, 2.2.6 and 2.2.7); otherwise an
    # Enumeration is an `int` (FMI 2.0, 2.1.2)
    sized: bool

    def declaration(self, type_: VariableType) -> str:
        """The C type of those for a type."""
        sizes, count = ", void *" if type_ == "Binary" else "", ", size_t" if self.sized else ""
        return f"int (*)(void *, void *, size_t{sizes}, void *{count})"

    def name(self, verb: Verb, type_: VariableType) -> str:
        """The name of the function for a type, after the prefix."""
        if self.sized:
            return f"{verb}{'Int64' if type_ == 'Enumeration' else type_}"
        return f"{verb}{_FMI2_NAMES.get(type_, type_)}"

    def buffer(self, type_: VariableType, variables: Sequence[Variable]) -> Buffer:
        """Memory for the values of variables of one type, in the C type of this version of FMI."""
        size = sum(variable.size for variable in variables)
        if type_ == "String":
            return StringBuffer(size)
        if type_ == "Binary":
            return BinaryBuffer(size)
        if type_ == "Enumeration" and not self.sized:
            return NumberBuffer(type_, np.intc, size)
        negated = [variable.negated for variable in variables]
        signs = np.where(negated, -1, 1).astype(np.int8) if any(negated) else None
        return NumberBuffer(type_, self.boolean if type_ == "Boolean" else DTYPES[type_], size, signs)

    def arguments(self, variables: Sequence[Variable], buffer: Buffer | None) -> tuple[Any, ...]:
        """Those of a getter or setter after the instance: all if there is a ``buffer``, otherwise up to the values."""
        references = (ctypes.c_uint * len(variables))(*(variable.value_reference for variable in variables))
        first = memory(references), len(variables)
        if buffer is None:
            return first
        places = (buffer.sizes_address, buffer.address) if isinstance(buffer, BinaryBuffer) else (buffer.address,)
        size = (sum(variable.size for variable in variables),) if self.sized else ()
        return *first, *map(pointer, places), *size

    def is_direct(self, type_: VariableType, variables: Sequence[Variable]) -> bool:
        """Whether a ring stores the values of variables of one type in the C type of this version of FMI."""
        differs = is_text(type_) or type_ == "Boolean" or (type_ == "Enumeration" and not self.sized)
        return not differs and not any(variable.negated for variable in variables)


class PartCall(NamedTuple):
    """The call that moves one part of a row between a ring and the FMU."""

    type: VariableType  # the type of the part
    variables: Sequence[Variable]  # its variables
    array: NDArray[Any]  # the memory of the ring, of shape (rows, elements)
    base: RowBase  # what `place` is relative to, in the tables of the library
    place: int  # of the elements in the row, in bytes; for `RowBase.FIXED` the address of those of row 0
    sizes: tuple[int, ...]  # the number of elements, if the function takes it; otherwise empty
    buffer: Buffer | None  # what the function of the FMU works on; None: on the ring itself.
    function: Function  # the getter or setter
    arguments: tuple[Any, ...]  # see `ValueFunctions.arguments`
    rows: RowPointers  # pointers to the elements in the ring

    @property
    def names(self) -> list[str]:
        """The names of the variables."""
        return [variable.name for variable in self.variables]

    @property
    def in_table(self) -> Call:
        """The call for the library."""
        base, values = (self.base, self.place) if self.buffer is None else (RowBase.FIXED, self.buffer.address)
        size = self.sizes[0] if self.sizes else -1
        return Call(address_of(self.function), address_of(self.arguments[0]), len(self.variables), base, values, size)


def status_name(status: int) -> str:
    """The name of a status in the words of FMI (FMI 2.0, 2.1.3); of a number that FMI does not know, the number."""
    if status == MISSING:
        return "nothing: its library does not have this function"
    return _STATUS_NAMES[status] if 0 <= status < len(_STATUS_NAMES) else str(status)
