"""Functions that are compiled while we run: llvmlite makes them of LLVM's own language, without a compiler here."""

from __future__ import annotations

import struct
from functools import cache
from typing import Any, Final, NamedTuple

__all__ = ["Compiled", "compile_function"]

_POINTER_BYTES: Final = 8


class Compiled(NamedTuple):
    """Where a compiled function begins, and what owns its code: keep it as long as the function is called."""

    address: int
    engine: Any


def compile_function(name: str, text: str) -> Compiled | None:
    """Compile ``text``, in LLVM's language, for a machine with 64-bit addresses; None where that is not possible.

    Args:
        name: that of the function in the text whose address is wanted.
        text: one module.
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
    """llvmlite, loaded when the first function is compiled: most commands do without it."""
    try:
        import llvmlite.binding as llvm  # noqa: PLC0415 as above
    except ImportError:  # there is none for this platform
        return None
    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    return llvm
