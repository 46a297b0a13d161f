"""The calls of one step as one call: a function that is compiled when an instance is bound to its rings.

The way from Python into C and back takes longer than a step of a small FMU, and is taken for every setter, for the step
itself and for every getter. llvmlite makes one function of them, in some milliseconds and without a compiler on the
user's machine; the addresses are constants in it. Where there is no llvmlite, `fuse` gives None.
"""

from __future__ import annotations

import ctypes
import struct
from collections.abc import Sequence
from typing import Final, NamedTuple

from ..compiled import Compiled, compile_function
from .calls import DirectCall, Function, Pointer, address_of, hot
from .instance import WARNING

__all__ = ["GETTING", "SETTING", "STATUS_BITS", "STEPPING", "Fused", "fuse"]

SETTING: Final = 1
STEPPING: Final = 2
GETTING: Final = 3
STATUS_BITS: Final = 24

_DECLARATION: Final = "int (*)(size_t, double, size_t)"


class Fused(NamedTuple):
    """A compiled function as it is called, and where it is."""

    call: Function
    code: Compiled


def fuse(
    component: Pointer,
    setters: Sequence[DirectCall],
    do_step: Function,
    step_size: float,
    getters: Sequence[DirectCall],
) -> Fused | None:
    """Compile ``(input row, time in s, output row)``: set the inputs, step by ``step_size`` (s), get the outputs.

    The function returns 0. At the first status above warning it calls nothing more, and returns
    ``stage << STATUS_BITS | status``. The references and the rings have to be kept alive for it. FMI 2.0, 4.2.1.
    """
    calls: list[str] = []

    def call(stage: int, function: Function, arguments: str) -> None:
        number = len(calls)
        calls.append(
            f"""
  %status{number} = call i32 {_pointer(function)}(ptr {_pointer(component)}, {arguments})
  %above{number} = icmp sgt i32 %status{number}, {WARNING}
  br i1 %above{number}, label %end{number}, label %next{number}
end{number}:
  %low{number} = and i32 %status{number}, {(1 << STATUS_BITS) - 1}
  %result{number} = or i32 %low{number}, {stage << STATUS_BITS}
  ret i32 %result{number}
next{number}:"""
        )

    def move(stage: int, moved: DirectCall, row: str) -> None:
        function, references, count, rows, _ = moved
        number = len(calls)
        calls.append(
            f"""
  %offset{number} = mul i64 {row}, {rows.row_size}
  %place{number} = add i64 %offset{number}, {rows.address}
  %row{number} = inttoptr i64 %place{number} to ptr"""
        )
        call(stage, function, f"ptr {_pointer(references)}, i64 {count}, ptr %row{number}")

    for setter in setters:
        move(SETTING, setter, "%in")
    call(STEPPING, do_step, f"double %time, double {_double(step_size)}, i32 1")
    for getter in getters:
        move(GETTING, getter, "%out")
    text = f"define i32 @step(i64 %in, double %time, i64 %out) {{{''.join(calls)}\n  ret i32 0\n}}"
    if (step := compile_function("step", text)) is None:
        return None
    return Fused(hot(ctypes.CFUNCTYPE(ctypes.c_int)(step.address), _DECLARATION), step)


def _pointer(made: Function | Pointer) -> str:
    return f"inttoptr (i64 {address_of(made)} to ptr)"


def _double(value: float) -> str:
    """A double in LLVM's own notation, bit by bit."""
    return f"0x{struct.unpack('<Q', struct.pack('<d', value))[0]:016X}"
