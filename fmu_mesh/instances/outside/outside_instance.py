"""One instance whose steps come from a program that we did not start; see `fmu_mesh/rings/outside.c` for the memory.

The program gives the first outputs in Initialization Mode, and then each step is one round trip: it gets the inputs,
and gives the outputs.
"""

from __future__ import annotations

import ctypes
import mmap
import os
import select
import socket
import struct
import sys
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from typing import Any, Final, NoReturn

import numpy as np

from ...errors import FmuError, InitializationFailed, LoadFailed, StepFailed, StepPending, TerminationRequested
from ...rings import native
from ...rings.library import why_no_library
from ...rings.native import Call, NativeStep, RowBase, Said, Span, Stage, StepKind
from ...rings.ring import Ring
from ...simtime import TimeGrid
from ...variables.model_description import Variable
from ...variables.value_conversion import to_value
from ...variables.value_types import DTYPES, Value, flattened, nested
from ..contract import Opening
from .outside_section import OutsideConfig

__all__ = ["OutsideInstance"]

# Who meets here: the thread of the node that steps its instances, and the program, through the memory and the socket; a
# server thread reads `awaited`. outside.c says whose turn it is when. What may go wrong: the program never comes, or
# sleeps in a debugger between `outside_attach` and its first step (until then `timeouts.initialize` holds, because all
# others wait in Initialization Mode, too); it is killed (the socket ends); a second one comes (the socket is gone).
# Steps have no deadline: the library returns after a slice, and the burst leaves with `StepPending`, so that the node
# sees the end of the run and calls again. Where Python takes the step (a String, values over time), it waits here, and
# only the end of the process ends the wait. ADR 103.

_VERSION: Final = 1
_HEAD: Final = struct.Struct("@4q2d16s4I48s512s")
_VARIABLE: Final = struct.Struct("@256s5q")
_TYPES: Final = (
    "Float64 Float32 Int8 UInt8 Int16 UInt16 Int32 UInt32 Int64 UInt64 Boolean String".split()  # noqa: SIM905  shorter
)
_TEXT_BYTES: Final = 4096
_NODE, _PROGRAM = 1, 2
_PENDING, _DIED, _LEFT = 200, 201, 202
_SLICE_NS: Final = 20_000_000
_LOOK_S: Final = 0.05
_TURN_AT: Final = 64
_SHARE_OF_DEADLINE: Final = 0.9
"""Of `timeouts.initialize`: so this error, which knows more, comes before that of the master."""


class _NodeEnd(ctypes.Structure):
    """`OutsideNode` in outside.c."""

    _fields_ = (
        ("memory", ctypes.c_void_p),
        ("socket", ctypes.c_int64),
        ("slice_ns", ctypes.c_int64),
        ("pending_ns", ctypes.c_int64),
    )


class OutsideInstance:
    """An instance that a program steps."""

    waits_for_program = True

    def __init__(self, opening: Opening[OutsideConfig]) -> None:
        self.name = opening.name
        self.description = opening.description
        if native.library is None or sys.platform != "linux":
            hint = f"The library of C is {why_no_library()}"
            raise LoadFailed("an instance `outside` needs the library of C", instance=self.name, hint=hint)
        self._library = native.library
        self._deadline_s = _SHARE_OF_DEADLINE * opening.timeouts.initialize
        self._initialize_s = opening.timeouts.initialize
        self._socket_file = opening.folder / f"{self.name}.outside"
        self._said, self._pid = Said(), 0
        self._started: float | None = None  # the wait for Initialization Mode
        self._has_begun = self._has_rows = False
        self._native: NativeStep | None = None
        self._connection: socket.socket | None = None
        self._file: int
        self._make_memory(opening.description.variables)
        self._listen()

    @property
    def native(self) -> NativeStep | None:
        """See `StepsNatively`."""
        return self._native

    @property
    def stage(self) -> int:
        """See `StepsNatively`."""
        return Stage.IN_PYTHON

    @property
    def awaited(self) -> str:
        """For which program its step waits, and since when, in words; empty: it does not wait. From any thread."""
        since = self._end.pending_ns
        return f"its program (process {self._pid}) since {(time.monotonic_ns() - since) / 1e9:.1f} s" if since else ""

    def enter_initialization(
        self, start_time: float, stop_time: float | None, start_values: Mapping[str, Value]
    ) -> None:
        """Set ``start_values``; the program has not attached yet."""
        self._started = time.monotonic()
        variables = {variable.name: variable for variable in self.description.variables}
        self.set_values({name: to_value(value, variables[name]) for name, value in start_values.items()})

    def exit_initialization(self) -> None:
        """Leave Initialization Mode: the program has attached, and given its first outputs."""
        self._begin()

    def set_values(self, values: Mapping[str, Value]) -> None:
        """Set inputs, which the program sees at the next step."""
        for name, value in values.items():
            self._write(name, value)

    def get_values(self, names: Sequence[str]) -> list[Value]:
        """Current values; in Initialization Mode, the outputs that the program has given with `outside_begin`."""
        if not self._has_begun and not self._inputs.issuperset(names):
            self._begin()
        return [self._read(name) for name in names]

    def bind(self, inputs: Ring, outputs: Sequence[Ring], grid: TimeGrid, points: int, step: int = 0) -> None:
        """Choose the rings of `do_step`; at the first time, wait for the outputs with which the program begins."""
        self._rings = inputs, outputs
        if not self._has_rows:
            struct.pack_into("@q2d", self._memory, 24, points, grid.start_time, grid.step_size)
            self._library.outside_pass(self._end.memory, _PROGRAM)
            self._await_first("`outside_step`")
            self._has_rows = True
        for ring in outputs:
            for name in ring.layout.names:
                ring.put(step, name, self._read(name))
        names = {name for ring in (inputs, *outputs) for name in ring.layout.names}
        self._native = None
        if inputs.rows == 1 and names.isdisjoint(self._texts):
            self._native = self._tables(inputs, outputs)

    def do_step(self, step: int) -> None:
        """Take a step in Python: it waits until the program has taken it."""
        inputs, outputs = self._rings
        if not self._end.pending_ns:
            for name in inputs.layout.names:
                self._write(name, inputs.value(step, name))
        while status := self._library.outside_do_step(self._address, 0.0, 0.0, 1):
            if status != _PENDING:
                self._fail(status)
        for ring in outputs:
            for name in ring.layout.names:
                ring.put(step + 1, name, self._read(name))
        self._said.note(step=step + 1)

    def check_rows(self, spans: Sequence[Span]) -> bool:
        """See `StepsNatively`: who calls `do_step` looks itself."""
        return False

    def finish(self, step: int, outcome: int) -> None:
        """See `StepsNatively`; raises `StepPending` while the program takes its time."""
        status = outcome & ((1 << native.STAGE_BITS) - 1)
        if status == _PENDING:
            raise StepPending
        self._fail(status)

    def close(self) -> None:
        """Tell the program that the run has ended, and remove the socket. Never raises; may be called twice."""
        self.remove_files()
        self._listener.close()
        if self._end.memory:
            self._library.outside_close(self._end.memory, b"the run has ended")
            self._end.memory = None
        if self._connection is not None:
            self._connection.close()
        with suppress(OSError):
            os.close(self._file)
        self._file = -1

    def remove_files(self) -> None:
        """See `KeepsFiles`."""
        self._socket_file.unlink(missing_ok=True)

    # --- the memory

    def _make_memory(self, variables: Sequence[Variable]) -> None:
        """Make the memory, and write its head, the variables, and the start values."""
        self._inputs = {own.name for own in variables if own.causality == "input"}
        self._texts = {own.name for own in variables if own.type == "String"}
        heads, at = [], _HEAD.size + len(variables) * _VARIABLE.size
        self._places: dict[str, tuple[int, int]] = {}
        for own in variables:
            size = _TEXT_BYTES if own.type == "String" else own.size * np.dtype(DTYPES[own.type]).itemsize
            at = (at + 63) // 64 * 64
            is_output = own.causality == "output"
            fields = own.name.encode(), _TYPES.index(own.type), is_output, own.size, at, size
            heads.append(_VARIABLE.pack(*fields))
            self._places[own.name] = at, size
            at += size
        self._file = os.memfd_create(f"fmu_mesh {self.name}", os.MFD_CLOEXEC)
        os.ftruncate(self._file, at)
        self._memory: mmap.mmap = mmap.mmap(self._file, at)
        self._flat = np.frombuffer(self._memory, np.uint8)
        head = _VERSION, at, len(variables), 1, 0.0, 0.0, b"", _PROGRAM, 0, 0, 0, b"", b""
        self._memory[: _HEAD.size + len(heads) * _VARIABLE.size] = b"".join([_HEAD.pack(*head), *heads])
        self._arrays: dict[str, Any] = {}
        self._shapes = {own.name: own.shape for own in variables}
        for own in variables:
            place, size = self._places[own.name]
            kind = np.dtype("S4096" if own.type == "String" else DTYPES[own.type])
            self._arrays[own.name] = self._flat[place : place + size].view(kind)
            self._write(own.name, own.start)
        self._end: Any = _NodeEnd(int(self._flat.ctypes.data), -1, _SLICE_NS, 0)
        self._address = ctypes.addressof(self._end)

    def _write(self, name: str, value: Any) -> None:  # noqa: ANN401 a value of any type
        if name in self._texts:
            text = str(value).encode()
            if len(text) >= _TEXT_BYTES or b"\0" in text:
                what = f"a String for a program has at most {_TEXT_BYTES - 1} bytes, and none is zero"
                raise FmuError(what, instance=self.name, variable=name)
            self._arrays[name][0] = text
        else:
            self._arrays[name][:] = flattened(value, len(self._shapes[name]))

    def _read(self, name: str) -> Value:
        elements, shape = self._arrays[name].tolist(), self._shapes[name]
        if name in self._texts:
            return str(elements[0].partition(b"\0")[0].decode(errors="replace"))
        return nested(elements, shape) if shape else elements[0]

    def _tables(self, inputs: Ring, outputs: Sequence[Ring]) -> NativeStep:
        """The step as functions of FMI 2.0 would be called."""
        places = {name: (ctypes.c_int64 * 2)(*place) for name, place in self._places.items()}

        def calls(function: object, base: int, ring: Ring, first: int) -> list[Call]:
            address = ctypes.cast(function, ctypes.c_void_p).value  # type: ignore[arg-type]  # it is one of ctypes
            made = []
            for name in ring.layout.names:
                place = ring.layout.place(name)
                at = first + ring.place_in_row(place.part, place.first)
                made.append(Call(address, ctypes.addressof(places[name]), 1, base, at, -1))
            return made

        library, getters = self._library, list[Call]()
        for base, ring in zip((RowBase.OUTPUT, RowBase.WATCHED), outputs, strict=False):
            getters += calls(library.outside_take, base, ring, 0)
        self._said.note(quiet_until=float("inf"))
        return NativeStep(
            kind=StepKind.FMI2,
            component=self._address,
            do_step=ctypes.cast(library.outside_do_step, ctypes.c_void_p).value or 0,
            said=ctypes.addressof(self._said),
            loads=(),
            setters=calls(library.outside_put, RowBase.FIXED, inputs, inputs.address),
            getters=getters,
            stores=(),
            kept=(self._said, self._end, places, self._memory),
        )

    # --- the program

    def _listen(self) -> None:
        """Open the socket at which the program attaches."""
        self._socket_file.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        self._socket_file.unlink(missing_ok=True)
        self._listener = socket.socket(socket.AF_UNIX)
        folder = os.open(self._socket_file.parent, os.O_PATH | os.O_DIRECTORY)
        try:  # the path of a socket must be short
            self._listener.bind(f"/proc/self/fd/{folder}/{self._socket_file.name}")
            self._listener.listen(1)
        except OSError as error:
            self._listener.close()
            raise LoadFailed(f"its socket cannot be made: {error.strerror}", instance=self.name) from error
        finally:
            os.close(folder)

    def _attach(self) -> None:
        """Wait a moment for the program, and give it the memory."""
        if not select.select([self._listener], [], [], _LOOK_S)[0]:
            return
        connection, _ = self._listener.accept()
        pid, uid, _ = struct.unpack("3i", connection.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, 12))
        if uid != os.getuid():
            connection.sendall(b"it belongs to another user")
            connection.close()
            return
        self.remove_files()  # nobody else attaches
        self._listener.close()
        self._connection, self._pid = connection, pid
        self._end.socket = connection.fileno()
        socket.send_fds(connection, [b"\0"], [self._file])

    def _begin(self) -> None:
        """Wait until the program has attached, and given its first outputs."""
        if not self._has_begun:
            self._await_first("`outside_begin`")
            self._has_begun = True

    def _await_first(self, call: str) -> None:
        end = (self._started or time.monotonic()) + self._deadline_s
        while True:
            if self._connection is None:
                self._attach()
            elif (status := self._library.outside_await(self._address)) == 0:
                return
            elif status == _DIED:
                self._fail(status)
            if time.monotonic() > end:
                hint = "Start the program soon after the mesh, or raise `timeouts.initialize`."
                what = "no program has attached" if self._connection is None else f"its program has not called {call}"
                text = f"{what} within {self._deadline_s:g} s (`timeouts.initialize`: {self._initialize_s:g} s)"
                raise InitializationFailed(text, instance=self.name, hint=hint)

    def _fail(self, status: int) -> NoReturn:
        if status == _LEFT:
            raise TerminationRequested("its program has detached", instance=self.name)
        kind = StepFailed if self._has_rows else InitializationFailed
        hint = "Its own messages say more. The rows before are kept."
        text = f"its program (process {self._pid}) has ended without `outside_detach`"
        raise kind(text, instance=self.name, hint=hint)
