"""Compiling functions at run time: llvmlite compiles LLVM assembly, so this host needs no compiler."""

from __future__ import annotations

import struct
from functools import cache
from typing import Any, Final, NamedTuple

__all__ = ["Compiled", "compile_function"]

_POINTER_BYTES: Final = 8


class Compiled(NamedTuple):
    """A compiled function: its address, and the owner of its code, which must live as long as calls are made."""

    address: int
    engine: Any


def compile_function(name: str, text: str) -> Compiled | None:
    """Compile a module for a processor with 64-bit addresses; None if this platform cannot.

    Args:
        name: the function of the module whose address is returned.
        text: the module in LLVM assembly.
    """
    llvm = _llvm()
    if llvm is None or struct.calcsize("P") != _POINTER_BYTES:
        return None
    machine = llvm.Target.from_default_triple().create_target_machine(opt=1)
    engine = llvm.create_mcjit_compiler(llvm.parse_assembly(text), machine)
    engine.finalize_object()
    return Compiled(engine.get_function_address(name), engine)


@cache
def _llvm() -> Any:  # noqa: ANN401 llvmlite is untyped
    """llvmlite, or None if it is not installed. Most commands do not need it, so it is imported late."""
    try:
        import llvmlite.binding as llvm  # noqa: PLC0415 as above
    except ImportError:  # it has no wheel for this platform
        return None
    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    return llvm
