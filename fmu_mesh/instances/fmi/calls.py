"""The C functions of an FMU as the hot loop calls them: through cffi, which takes about half the time of ctypes.

FMPy loads the library and declares what is called now and then; here is what is called in every step. Both release
the interpreter's lock during a call. Addresses are turned into pointers once, and not in every call.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from typing import Any, TypeAlias

from cffi import FFI

__all__ = ["DirectCall", "Function", "Pointer", "Rows", "address_of", "hot", "memory", "pointer"]

Pointer: TypeAlias = Any
"""A C pointer to anything."""

Function: TypeAlias = Callable[..., int]
"""A function of an FMU that returns its status."""

_ffi = FFI()


def hot(function: Function, declaration: str) -> Function:
    """A function of a loaded library, to be called with `pointer` where ``declaration`` has one.

    Args:
        function: as ctypes has it.
        declaration: the type of a pointer to it in C, such as ``int (*)(void *, double)``.
    """
    address = ctypes.cast(function, ctypes.c_void_p).value  # type: ignore[arg-type]  # it is one of ctypes' own
    called: Function = _ffi.cast(declaration, address or 0)
    return called


def pointer(address: int | None) -> Pointer:
    """An address as an argument of what `hot` returns."""
    return _ffi.cast("void *", address or 0)


class Rows(dict[int, Pointer]):
    """The rows of an array as arguments of what `hot` returns, by number; a pointer is made when it is first needed.

    Args:
        address: of row 0.
        row_size: from one row to the next, in bytes.
    """

    def __init__(self, address: int, row_size: int) -> None:
        super().__init__()
        self.address = address
        self.row_size = row_size

    def __missing__(self, row: int) -> Pointer:
        """The pointer to a row, made now."""
        made = self[row] = pointer(self.address + row * self.row_size)
        return made


DirectCall: TypeAlias = tuple[Function, Pointer, int, Rows, int]
"""A function on ring memory: it, the value references and their number, each row, number of values."""


def address_of(made: Function | Pointer) -> int:
    """The address of what `hot`, `pointer` or `memory` made."""
    return int(_ffi.cast("uintptr_t", made))  # type: ignore[arg-type]  # it is one of cffi's own


def memory(array: ctypes.Array[Any]) -> Pointer:
    """The memory of an array as an argument of what `hot` returns; it lives as long as this."""
    return _ffi.from_buffer(array)
