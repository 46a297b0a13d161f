"""How the C functions of an FMU are called.

The functions of every step go through cffi, which takes about half the time of ctypes; addresses become pointers once,
not in every call. All other functions go through FMPy. Both release the interpreter's lock during a call.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, TypeAlias

from cffi import FFI
from fmpy.fmi1 import FMICallException

from ..call_guard import call_named
from .fmu_library import FmuLibrary

__all__ = [
    "FmpyCalls",
    "Function",
    "Pointer",
    "RowPointers",
    "address_of",
    "cffi_function",
    "checked_function",
    "declared",
    "memory",
    "pointer",
]

Pointer: TypeAlias = Any
"""A C pointer to anything."""

Function: TypeAlias = Callable[..., int]
"""A function of an FMU that returns its status."""

_WARNING = 1
_ffi = FFI()


class FmpyCalls:
    """FMPy's object of an FMU; a deadline watch can ask which FMI function one of its methods is in.

    ``names`` has the FMI functions whose name is not the prefix and the name of the method, by the name of the method.

    Example:
        >>> import threading
        >>> from types import SimpleNamespace
        >>> from fmu_mesh.instances.call_guard import current_function
        >>> fmu = SimpleNamespace(enterEventMode=lambda: current_function(threading.get_ident()))
        >>> FmpyCalls(fmu, "fmi2", {}).enterEventMode()
        'fmi2EnterEventMode'
    """

    def __init__(self, fmu: Any, prefix: str, names: Mapping[str, str]) -> None:  # noqa: ANN401 FMPy is untyped
        self._fmu = fmu
        self._prefix = prefix
        self._names = names

    def __getattr__(self, name: str) -> Any:  # noqa: ANN401 as above
        found = getattr(self._fmu, name)
        if not callable(found):
            return found
        function = name if name.startswith("fmi") else f"{self._prefix}{name[0].upper()}{name[1:]}"
        call = self.__dict__[name] = partial(call_named, self._names.get(name, function), found)
        return call


def declared(library: FmuLibrary, name: str, prototype: Any) -> Any:  # noqa: ANN401 ctypes has no types
    """The function ``name`` of a library with a prototype of ours."""
    return ctypes.cast(getattr(library, name), prototype)


def checked_function(library: FmuLibrary, symbols: str, name: str, prototype: Any) -> Any:  # noqa: ANN401 as above
    """As `declared`, but a status above warning is an `FMICallException`, as it is where FMPy calls.

    Its symbol is ``symbols`` and ``name``; ``symbols`` begins with the model identifier in FMI 1.0.
    """

    def check(status: int, _function: object, _arguments: object) -> int:
        if status > _WARNING:
            raise FMICallException(function=symbols.rpartition("_")[2] + name, status=status)
        return status

    function = declared(library, symbols + name, prototype)
    function.errcheck = check
    return function


def cffi_function(function: Function, declaration: str) -> Function:
    """A function of a loaded library, called through cffi.

    ``declaration`` is the C type of a pointer to it, such as ``int (*)(void *, double)``.
    """
    address = ctypes.cast(function, ctypes.c_void_p).value  # type: ignore[arg-type]  # it is one of ctypes' own
    called: Function = _ffi.cast(declaration, address or 0)
    return called


def pointer(address: int | None) -> Pointer:
    """An address as an argument of a `cffi_function`."""
    return _ffi.cast("void *", address or 0)


class RowPointers(dict[int, Pointer]):
    """Pointers to the rows of an array by row number; a pointer is made when it is first used.

    ``address`` is that of row 0, ``row_size`` the distance of two rows in bytes.
    """

    def __init__(self, address: int, row_size: int) -> None:
        super().__init__()
        self.address = address
        self.row_size = row_size

    def __missing__(self, row: int) -> Pointer:
        """Make the pointer to a row."""
        made = self[row] = pointer(self.address + row * self.row_size)
        return made


def address_of(made: Function | Pointer) -> int:
    """The address of what `cffi_function`, `pointer` or `memory` returned."""
    return int(_ffi.cast("uintptr_t", made))  # type: ignore[arg-type]  # it is one of cffi's own


def memory(array: Any) -> Pointer:  # noqa: ANN401 an array of ctypes or numpy
    """The memory of an array as an argument of a `cffi_function`; the pointer keeps the array alive."""
    return _ffi.from_buffer(array)
