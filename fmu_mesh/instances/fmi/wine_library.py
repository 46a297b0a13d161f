"""The library of an FMU for Windows, which a host under Wine has loaded (`rings/windows_host.c`), for FMPy and tables.

Owns the host: a child that ends with the library or with this process. A function of the FMU looks like one of a
library of this process: a function of C that lets the host call the one of the FMU. What it needs is copied; the types
of its arguments are those that FMPy knows. Steps do not come here: `rings/hosted.c` takes them.
"""

# Who meets here (ADR 99): the one thread that calls the FMU, and the host, which answers one request at a time. The
# deadline of a call is that of any other FMU (`call_guard`): who owns the process ends it, and so the host (the kernel
# kills it with the thread that has started it, and it reads the end of its input). A host that has ended answers every
# call with fatal; what has ended it is a message of the FMU, which so gets into the error.

from __future__ import annotations

import ctypes
import logging
import mmap
import os
import subprocess
import sys
from collections.abc import Callable, Sequence
from enum import IntEnum
from itertools import accumulate
from pathlib import Path
from struct import pack, unpack
from typing import Any, Final

from fmpy.fmi1 import fmi1CallbackFunctions
from fmpy.fmi2 import fmi2CallbackFunctions

from ...rings import native
from ...rings.library import host_program
from ...rings.native import Changed, declared, table
from .fmu_library import Argument, absent, arguments_of, count_of
from .fmu_values import FATAL
from .wine import windows_path, wine_environment, wine_program

__all__ = ["Request", "WineLibrary"]

log = logging.getLogger(__name__)

_SIZE: Final = 1 << 30
"""Of the memory, in bytes; what is not used takes no space."""
_ROOM: Final = 131072
"""Where the room for requests begins; as in windows_host.h."""
_END_S: Final = 5.0
"""How long a host may take to end."""
_WITH_US: Final = "import ctypes, os, sys; ctypes.CDLL(None).prctl(1, 9); os.execv(sys.argv[1], sys.argv[1:])"
"""A program of Python that becomes another one, which the kernel kills with the thread that has started it."""
_TEXT: Final = ctypes.c_char_p
_BYTES: Final = ctypes.POINTER(ctypes.c_uint8)
"""A value of type Binary; an argument before those of a call says how long each is (FMI 3.0, 2.2.6.2)."""
_PLACE: Final = ctypes.c_void_p


class Request(IntEnum):
    """What a node asks of a host, as `burst.h` has it."""

    CALL_FUNCTION, LOAD, FIND, MAP, MAKE_CALLBACKS, COPY_TEXTS, TAKE_STEP, TAKE_BURST = range(8)


@declared("Twin")
class Twin(ctypes.Structure):
    """A function of an FMU: its address in this process, and in the host."""


@declared("Mailbox")
class MailboxTable(Changed):
    """What a node and a host share."""


@declared("Host")
class HostTable(Changed):
    """A host."""


class _Room:
    """Memory for what one request needs, which nothing else uses meanwhile."""

    def __init__(self, memory: mmap.mmap, there: int) -> None:
        self._memory = memory
        self._there = there
        self.next = _ROOM

    def put(self, data: bytes) -> int:
        """Copy bytes; returns where the host has them: with ``there`` 0, the place in the memory."""
        place, end = self.next, self.next + len(data)
        if end > _SIZE:
            raise MemoryError(f"a call of an FMU under Wine needs more than {_SIZE:,} bytes")
        self._memory[place:end] = data
        self.next = -(-end // 16) * 16
        return self._there + place

    def taken(self, there: int, size: int) -> bytes:
        """The bytes that the host has at an address."""
        place = there - self._there
        return self._memory[place : place + size]


class WineLibrary:
    """The library at ``path`` of an FMU that FMPy calls through ``fmpy_class``; `OSError` if it cannot be loaded."""

    def __init__(self, path: Path, fmpy_class: type[Any], instance: str) -> None:
        self.missing: set[str] = set()  # as of `FmuLibrary`
        self.imports: set[bytes] = set()
        self.host = self
        self._types = fmpy_class
        self._texts: list[Any] = []  # what the FMU has returned last
        self._twins: list[Twin] = []
        self._process: subprocess.Popen[bytes] | None = None
        descriptor = os.memfd_create("fmu_mesh_wine", os.MFD_CLOEXEC)
        try:
            os.ftruncate(descriptor, _SIZE)
            self._memory = mmap.mmap(descriptor, _SIZE)
            self._box = MailboxTable.from_buffer(self._memory)
            self._name = ctypes.create_string_buffer(instance.encode())
            name = ctypes.addressof(self._name)
            self._table = HostTable(mailbox=ctypes.addressof(self._box), size=_SIZE, name=name)
            self._start(path.parent, windows_path(Path(f"/proc/{os.getpid()}/fd/{descriptor}")))
            self._load(path)
        except BaseException:
            self.close()
            raise
        finally:
            os.close(descriptor)

    def _start(self, folder: Path, memory: str) -> None:
        program = [sys.executable, "-ISc", _WITH_US, str(wine_program()), str(host_program()), memory]
        pipe = subprocess.PIPE
        # A session of its own: Ctrl-C is for us.
        self._process = process = subprocess.Popen(
            program, stdin=pipe, stdout=pipe, env=wine_environment(), cwd=folder, bufsize=0, start_new_session=True
        )
        assert process.stdin is not None
        assert process.stdout is not None
        os.set_blocking(process.stdin.fileno(), False)
        self._table.note(to=process.stdin.fileno(), from_=process.stdout.fileno(), process=process.pid)

    @property
    def address(self) -> int:
        """Of the table of the host."""
        return ctypes.addressof(self._table)

    def map(self, path: Path | None, address: int, size: int) -> None:
        """See `NativeStep.share`; memory without a path is private."""
        if path is None or address == self._table.shared:
            return
        if there := self._ask(Request.MAP, self._named(windows_path(path))):
            self._table.note(shared=address, shared_there=there, shared_size=size)

    def close(self) -> None:
        """End the host. Never raises; may be called twice."""
        process = self._process
        if process is None:
            return
        self._process = None
        self._table.note(ended=1)
        for pipe in (process.stdin, process.stdout):
            if pipe is not None:
                pipe.close()
        try:
            process.wait(_END_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()

    def __getattr__(self, name: str) -> Any:  # noqa: ANN401 as in ctypes
        if "fmi" not in name:
            raise AttributeError(name)
        if there := self._ask(Request.FIND, self._named(name)):
            function = self._function(name, there)
        else:
            self.missing.add(name)
            function = absent()
        setattr(self, name, function)  # whoever has its address needs it for as long as the library
        return function

    def _load(self, path: Path) -> None:
        room = _Room(self._memory, 0)
        places = [room.put(f"{windows_path(own)}\0".encode()) for own in (path, path.parent)]
        error = self._ask(Request.LOAD, *places)
        if self._table.ended:
            raise OSError(f"the program under Wine that loads '{path.name}' has ended")
        if error and self._box.text:
            raise OSError(f"'{path.name}' needs {self._box.text.decode()}, which neither Wine nor the FMU has")
        if error:
            raise OSError(f"'{path.name}' cannot be loaded under Wine: error {error} of Windows")

    def _named(self, text: str) -> int:
        """The place of a text in the memory."""
        return _Room(self._memory, 0).put(f"{text}\0".encode())

    def _function(self, name: str, there: int) -> Any:  # noqa: ANN401 as in ctypes
        """A function of C that lets the host call the one at ``there``."""
        known = name if name.startswith("fmi") else f"fmi1{name.rpartition('_fmi')[2]}"
        arguments, returned_type = arguments_of(self._types, known)
        result = {bytes: _PLACE, int: ctypes.c_int}.get(returned_type, returned_type)

        def call(*values: Any) -> Any:  # noqa: ANN401 as in ctypes
            try:
                returned = self._call(name, there, arguments, values)
            except MemoryError as error:  # ctypes would return 0, which is OK
                log.error("%s: %s: %s", self._name.value.decode(), name, error)  # noqa: TRY400  a traceback helps no user
                return FATAL if result is ctypes.c_int else None
            if result is ctypes.c_int:
                return FATAL if self._table.ended else ctypes.c_int(returned).value
            if returned_type is bytes and returned:
                room = _Room(self._memory, self._box.there)
                self._texts = self._copied(room, room.put(pack("<q", returned)), 1)
                return ctypes.addressof(self._texts[0])
            return returned if result is not None else None

        function: Any = ctypes.CFUNCTYPE(result, *(argument.passed for argument in arguments))(call)
        self._twins.append(Twin(ctypes.cast(function, _PLACE), there))
        self._functions = table(Twin, self._twins)
        self._table.note(functions=self._functions, n_functions=len(self._twins))
        return function

    def _call(self, name: str, there: int, arguments: Sequence[Argument], values: Sequence[Any]) -> int:
        room, after = _Room(self._memory, self._box.there), list[Callable[[], None]]()
        places: list[int] = []
        for index, (own, value) in enumerate(zip(arguments, values, strict=True)):
            if own.items is fmi2CallbackFunctions:
                environment = fmi2CallbackFunctions.from_address(value).componentEnvironment or 0
                place = self._ask(Request.MAKE_CALLBACKS, environment)
            elif own.name == "logMessage":
                place = self._box.log_fmi3
            elif own.type is fmi1CallbackFunctions:
                place = self._box.callbacks_fmi1
            elif not value:
                place = 0
            elif own.type is _TEXT:
                place = room.put(_located(own.name, value) + b"\0")
            elif own.items is not None:
                # The sizes of Binary values are the argument before them, here and in the host.
                sizes = (values[index - 1], places[-1]) if own.items is _BYTES else (0, 0)
                place = self._put_array(room, name, own, value, count_of(arguments, values, index), sizes, after)
            elif own.type is ctypes.c_double:
                (place,) = unpack("<q", pack("<d", value))
            else:
                place = ord(value) if isinstance(value, bytes) else int(value)
            places.append(place)
        result = self._ask(Request.CALL_FUNCTION, there, *places)
        for copy in after if not self._table.ended else ():
            copy()
        return result

    def _put_array(  # noqa: PLR0913, PLR0917 an argument, and what becomes of it
        self,
        room: _Room,
        name: str,
        own: Argument,
        address: int,
        count: int,
        sizes: tuple[int, int],
        after: list[Callable[[], None]],
    ) -> int:
        """Copy what an argument points to; ``after`` gets what copies it back. Returns where the host has it.

        ``sizes`` are the addresses of the sizes of Binary values, of this process and of the host.
        """
        is_set = "Set" in name
        if own.items in {_TEXT, _BYTES}:
            here = (_PLACE * count).from_address(address)
            given = [0] * count
            if is_set:
                lengths = (ctypes.c_size_t * count).from_address(sizes[0]) if sizes[0] else [-1] * count
                given = [
                    room.put(ctypes.string_at(text, length) + b"\0") if text else 0
                    for text, length in zip(here, lengths, strict=True)
                ]
            place = room.put(pack(f"<{count}q", *given))

            def copy() -> None:
                self._texts = self._copied(room, place, count, sizes[1])
                for number, text in enumerate(self._texts):
                    here[number] = ctypes.addressof(text)

        else:
            size = count * ctypes.sizeof(own.items)
            place = room.put(ctypes.string_at(address, size))

            def copy() -> None:
                ctypes.memmove(address, room.taken(place, size), size)

        if not is_set:
            after.append(copy)
        return place

    def _copied(self, room: _Room, pointers: int, count: int, sizes: int = 0) -> list[Any]:
        """Texts that the FMU has returned, or with ``sizes`` bytes; they live until it returns others."""
        first = room.put(b"")
        used = self._ask(Request.COPY_TEXTS, pointers, count, sizes, first, _SIZE // 2)
        if used > _SIZE // 2:
            raise MemoryError(f"values of an FMU under Wine have more than {_SIZE // 2:,} bytes")
        copied = room.taken(first, used)
        if not sizes:
            return [ctypes.create_string_buffer(text) for text in copied.split(b"\0")[:count]]
        lengths = unpack(f"<{count}Q", room.taken(sizes, count * 8))
        ends = accumulate(length + 1 for length in lengths)
        return [
            ctypes.create_string_buffer(copied[end - length - 1 : end - 1], length + 1)
            for length, end in zip(lengths, ends, strict=True)
        ]

    def _ask(self, what: Request, *arguments: int) -> int:
        """Let the host answer a request; 0 if it has ended."""
        box = self._box
        box.note(what=what)
        box.arguments[: len(arguments)] = arguments
        assert native.library is not None
        return int(box.result) if native.library.host_ask(self.address) else 0


def _located(name: str, text: bytes) -> bytes:
    """A text that an FMU gets, as a path that Windows code understands if it is one."""
    if name == "resourcePath":
        return b"Z:" + text.replace(b"/", b"\\")
    return text.replace(b"file:///", b"file:///Z:/", 1) if name in {"resourceLocation", "fmuLocation"} else text
