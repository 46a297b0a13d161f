"""All calls of one step as one compiled function, made when an instance is bound to its rings.

A call from Python into C takes longer than a step of a small FMU, and a step has a call for every setter, for the step
itself and for every getter. llvmlite makes one function of them within milliseconds, and needs no compiler on the
user's machine; the addresses are constants of the function. Without llvmlite, `compile_step` returns None.
"""

from __future__ import annotations

import ctypes
import struct
from collections.abc import Sequence
from typing import Final, NamedTuple

from ....compiled import Compiled, compile_function
from ..calls import DirectCall, Function, Pointer, address_of, cffi_function
from ..fmu_values import WARNING

__all__ = [
    "DOING",
    "GETTING",
    "SETTING",
    "STATUS_BITS",
    "STEPPING",
    "CompiledStep",
    "StepCall",
    "compile_step",
    "fmi2_step",
    "fmi3_step",
]

SETTING: Final = 1
STEPPING: Final = 2
GETTING: Final = 3
STATUS_BITS: Final = 24
DOING: Final = {SETTING: "setting the inputs", GETTING: "reading the outputs"}
"""The words of an error for the other stages."""

_DECLARATION: Final = "int (*)(size_t, double, size_t)"


class StepCall(NamedTuple):
    """The call that takes the step.

    Attributes:
        function: what is called.
        arguments: those after the component, in LLVM's language; ``%time`` is the start of the step in s.
        flags: address of 32 bits: 0 before the call, and 0 afterwards if the step needs nothing more.
    """

    function: Function
    arguments: str
    flags: int | None = None


def fmi2_step(function: Function, step_size: float) -> StepCall:
    """fmi2DoStep by ``step_size`` (s) (FMI 2.0, 4.2.1)."""
    return StepCall(function, f"double %time, double {_double(step_size)}, i32 1")


def fmi3_step(function: Function, step_size: float, results: Sequence[Pointer], flags: int) -> StepCall:
    """fmi3DoStep by ``step_size`` (s); ``results`` are its other results (FMI 3.0, 4.2.1)."""
    said = ", ".join(f"ptr {_pointer(result)}" for result in results)
    return StepCall(function, f"double %time, double {_double(step_size)}, i1 zeroext true, {said}", flags)


class CompiledStep(NamedTuple):
    """A compiled function, and what keeps its code alive."""

    call: Function
    code: Compiled


def compile_step(
    component: Pointer,
    setters: Sequence[DirectCall],
    step: StepCall,
    getters: Sequence[DirectCall],
    *,
    sized: bool = False,
) -> CompiledStep | None:
    """Compile ``(input row, time in s, output row)``: set the inputs, take the step, get the outputs.

    The function returns 0. After the first status above warning, and after a step with a flag, it makes no other call
    and returns ``stage << STATUS_BITS | status``. The caller keeps the references, the rings and the flags alive.

    Args:
        component: first argument of all calls.
        setters: how the inputs are set.
        step: how the step is taken.
        getters: how the outputs are read.
        sized: whether setters and getters also take the number of values (FMI 3.0, 2.2.7).
    """
    calls: list[str] = []

    def call(stage: int, function: Function, arguments: str, flags: int | None = None) -> None:
        number = len(calls)
        ends = f"%above{number}"
        if flags is not None:
            calls.append(f"\n  store volatile i32 0, ptr {_place(flags)}")
        calls.append(
            f"""
  %status{number} = call i32 {_pointer(function)}(ptr {_pointer(component)}, {arguments})
  %above{number} = icmp sgt i32 %status{number}, {WARNING}"""
        )
        if flags is not None:
            ends = f"%ends{number}"
            calls.append(
                f"""
  %flags{number} = load volatile i32, ptr {_place(flags)}
  %flagged{number} = icmp ne i32 %flags{number}, 0
  {ends} = or i1 %above{number}, %flagged{number}"""
            )
        calls.append(
            f"""
  br i1 {ends}, label %end{number}, label %next{number}
end{number}:
  %low{number} = and i32 %status{number}, {(1 << STATUS_BITS) - 1}
  %result{number} = or i32 %low{number}, {stage << STATUS_BITS}
  ret i32 %result{number}
next{number}:"""
        )

    def move(stage: int, moved: DirectCall, row: str) -> None:
        function, references, count, rows, size = moved
        number = len(calls)
        calls.append(
            f"""
  %offset{number} = mul i64 {row}, {rows.row_size}
  %place{number} = add i64 %offset{number}, {rows.address}
  %row{number} = inttoptr i64 %place{number} to ptr"""
        )
        values = f"ptr %row{number}, i64 {size}" if sized else f"ptr %row{number}"
        call(stage, function, f"ptr {_pointer(references)}, i64 {count}, {values}")

    for setter in setters:
        move(SETTING, setter, "%in")
    call(STEPPING, step.function, step.arguments, step.flags)
    for getter in getters:
        move(GETTING, getter, "%out")
    text = f"define i32 @step(i64 %in, double %time, i64 %out) {{{''.join(calls)}\n  ret i32 0\n}}"
    if (code := compile_function("step", text)) is None:
        return None
    return CompiledStep(cffi_function(ctypes.CFUNCTYPE(ctypes.c_int)(code.address), _DECLARATION), code)


def _pointer(made: Function | Pointer) -> str:
    return _place(address_of(made))


def _place(address: int) -> str:
    return f"inttoptr (i64 {address} to ptr)"


def _double(value: float) -> str:
    """A double in LLVM's own notation, bit by bit."""
    return f"0x{struct.unpack('<Q', struct.pack('<d', value))[0]:016X}"
