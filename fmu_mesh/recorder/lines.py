"""Makes lines of a CSV file from a JSON array of numbers: after a line's last number, the comma becomes a line end.

orjson writes the numbers. With NumPy, finding the commas would take a third of the time of both steps. So a compiled
function does it if llvmlite is available.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from functools import cache
from typing import Final, NamedTuple

import numpy as np

from ..compiled import Compiled, compile_function

__all__ = ["in_lines", "prepare"]

_COMMA, _NEWLINE = b",\n"
_BLOCK: Final = 64

# 64 characters at a time: compare all with a comma, and go from one bit of the result to the next. The last block ends
# where the text ends; what it has in common with the one before is masked out.
_ENDS = f"""
declare i64 @llvm.cttz.i64(i64, i1)

define void @end_lines(ptr %text, i64 %size, i64 %width) {{
start:
  %last = sub i64 %size, {_BLOCK}
  br label %block
block:
  %i = phi i64 [0, %start], [%following, %next]
  %left = phi i64 [%width, %start], [%left_then, %next]
  %is_last = icmp ugt i64 %i, %last
  %first = select i1 %is_last, i64 %last, i64 %i
  %known = sub i64 %i, %first
  %place = getelementptr i8, ptr %text, i64 %first
  %characters = load <{_BLOCK} x i8>, ptr %place, align 1
  %equal = icmp eq <{_BLOCK} x i8> %characters, <{", ".join([f"i8 {_COMMA}"] * _BLOCK)}>
  %commas = bitcast <{_BLOCK} x i1> %equal to i64
  %without = lshr i64 %commas, %known
  %new = shl i64 %without, %known
  br label %look
look:
  %found = phi i64 [%new, %block], [%rest, %counted]
  %left_then = phi i64 [%left, %block], [%left_now, %counted]
  %is_over = icmp eq i64 %found, 0
  br i1 %is_over, label %next, label %count
count:
  %fewer = sub i64 %left_then, 1
  %ends = icmp eq i64 %fewer, 0
  br i1 %ends, label %end, label %counted
end:
  %number = call i64 @llvm.cttz.i64(i64 %found, i1 true)
  %comma = getelementptr i8, ptr %place, i64 %number
  store i8 {_NEWLINE}, ptr %comma
  br label %counted
counted:
  %left_now = phi i64 [%fewer, %count], [%width, %end]
  %less = sub i64 %found, 1
  %rest = and i64 %found, %less
  br label %look
next:
  %following = add i64 %i, {_BLOCK}
  %more = icmp ult i64 %following, %size
  br i1 %more, label %block, label %done
done:
  ret void
}}
"""


def prepare() -> None:
    """Compile the function that `in_lines` calls before the first row arrives; this takes some milliseconds."""
    _compiled()


def in_lines(numbers: bytes, width: int) -> memoryview:
    """Lines with ``width`` numbers each, from a JSON array of at least one number."""
    text = bytearray(numbers)
    characters = np.frombuffer(text, dtype=np.uint8)
    if len(text) >= _BLOCK and (compiled := _compiled()) is not None:
        compiled.call(characters.ctypes.data, len(text), width)
    else:
        characters[np.flatnonzero(characters == _COMMA)[width - 1 :: width]] = _NEWLINE
    characters[-1] = _NEWLINE
    return memoryview(text)[1:]


class _EndLines(NamedTuple):
    """``call(address of the text, its size, at least 64, numbers of a line)``, and where it is."""

    call: Callable[[int, int, int], None]
    code: Compiled


@cache
def _compiled() -> _EndLines | None:
    code = compile_function("end_lines", _ENDS)
    if code is None:
        return None
    # It keeps the interpreter's lock: releasing and acquiring it takes longer than the call.
    function = ctypes.PYFUNCTYPE(None, ctypes.c_void_p, ctypes.c_int64, ctypes.c_int64)
    return _EndLines(function(code.address), code)
