"""The library of an FMU that is a component of WebAssembly, after the draft FMI-LS-WASM (ADR 101).

Owns the component and its instances. A function of FMI 3.0 looks like one of a library of this process: a function of C
that calls the method of the same name. What this gets and returns follows from what FMPy knows of the arguments.
"""

# Who meets here: threads that call instances, each of them its own. An instance has a store of wasmtime for itself, and
# so its memory; Python's lock is free while its code runs. The deadline of a call is that of any other FMU
# (`call_guard`): who owns the process ends it. After a trap, wasmtime enters the instance no longer: each later call
# returns error, while the process and other instances go on. One linker for all instances was tried: then a message
# does not say whose it is, because an FMU may give any name.

from __future__ import annotations

import ctypes
import itertools
import re
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any, Final

from ...installing import version_of_library
from .fmu_library import Argument, absent, arguments_of, count_of
from .fmu_values import OK

__all__ = ["ComponentLibrary"]

_INTERFACE: Final = "fmi:fmi3/{}@3.0.0"
_STATUSES: Final = ("ok", "warning", "discard", "error", "fatal")
_QUALIFIERS: Final = ("interval-not-yet-known", "interval-unchanged", "interval-changed")
_FIELDS: Final = {"discrete-states-need-update": "new-discrete-states-needed"}
"""The field of a record, where it is not named as the argument of C."""
_LOG: Final = ctypes.CFUNCTYPE(None, ctypes.c_void_p, ctypes.c_int, ctypes.c_char_p, ctypes.c_char_p)
_BYTES: Final = ctypes.POINTER(ctypes.c_uint8)


class _Refused(Exception):
    """A method has returned a status in the place of a value."""


class ComponentLibrary:
    """The component at ``path`` of an FMU that FMPy calls through ``fmpy_class``; `OSError` if it cannot be loaded.

    Each of its instances gets at most ``memory`` bytes, or without them as much as WebAssembly has.
    """

    host = None  # as of `FmuLibrary`

    def __init__(self, path: Path, fmpy_class: type[Any], kind: str, memory: int | None) -> None:
        version_of_library("wasmtime")
        import wasmtime.component  # noqa: PLC0415  an optional library

        self.missing: set[str] = set()  # as of `FmuLibrary`
        self.imports: set[bytes] = set()
        self._types = fmpy_class
        self._memory = memory
        self._guests: dict[int, _Guest] = {}
        self._states: dict[int, bytes] = {}
        self._numbers = itertools.count(1)  # of instances and states, which are pointers for others
        own = kind.replace("_", "-")
        self._interface, self._prefix = _INTERFACE.format(own), f"{own}-instance."
        config = wasmtime.Config()
        config.parallel_compilation = False  # its threads would be missing where a process that has them forks
        self._engine = wasmtime.Engine(config)
        try:
            self._component = wasmtime.component.Component(self._engine, path.read_bytes())
        except wasmtime.WasmtimeError as error:
            raise OSError(f"wasmtime cannot compile '{path.name}': {error}") from error
        exports = self._component.type.exports(self._engine)
        interface = exports[self._interface].ty if self._interface in exports else None
        if not isinstance(interface, wasmtime.component.ComponentInstanceType):
            raise OSError(f"'{path.name}' does not export {self._interface}, but {', '.join(exports) or 'nothing'}")
        self._methods = {str(name).rpartition(".")[2] for name in interface.exports(self._engine)}

    def close(self) -> None:
        """Free all instances and the component. Never raises; may be called twice."""
        for guest in self._guests.values():
            guest.close()
        self._guests.clear()
        self._component.close()

    def __getattr__(self, name: str) -> Any:  # noqa: ANN401 as in ctypes
        if not name.startswith("fmi3"):
            raise AttributeError(name)
        if (call := self._call_of(name)) is None:
            self.missing.add(name)
            function = absent()
        else:
            arguments, result = arguments_of(self._types, name)
            passed = [argument.passed for argument in arguments]
            function = ctypes.CFUNCTYPE(ctypes.c_int if result is int else result, *passed)(call)
        setattr(self, name, function)  # whoever has its address needs it for as long as the library
        return function

    def _call_of(self, name: str) -> Callable[..., Any] | None:
        """What a function of C does; None if the component has no such method."""
        method = _kebab(name.removeprefix("fmi3"))
        if name == "fmi3FreeInstance":
            return lambda handle: self._guests.pop(handle).close()
        if name.startswith("fmi3Instantiate"):
            return partial(self._instantiate, name, method) if method in self._methods else None
        if "FMUState" in name:
            act = getattr(self, f"_{method.replace('-', '_')}")
        elif method in self._methods:
            act = partial(_call, method, arguments_of(self._types, name)[0][1:])
        else:
            return None

        def call(handle: int, *values: Any) -> int:  # noqa: ANN401 as in ctypes
            guest = self._guests[handle]
            return guest.checked(name, lambda: act(guest, *values))

        return call

    def _instantiate(self, function: str, method: str, *values: Any) -> int | None:  # noqa: ANN401 as in ctypes
        texts, flags, rest = [(text or b"").decode() for text in values[:3]], values[3:5], values[5:]
        if "co-simulation" in method:
            flags, rest = (*values[3:7], []), values[9:]
        guest = _Guest(self._prefix, *rest[:2])

        def make() -> int:
            guest.load(self._engine, self._component, self._interface, self._memory)
            guest.make(method, *texts, *flags)
            return OK

        if guest.checked(function, make) != OK:
            guest.close()
            return None
        number = next(self._numbers)
        self._guests[number] = guest
        return number

    def _get_fmu_state(self, guest: _Guest, place: int) -> int:
        return self._keep(place, guest.value("get-fmu-state"))

    def _set_fmu_state(self, guest: _Guest, state: int) -> int:
        return guest.status("set-fmu-state", self._states[state])

    def _free_fmu_state(self, _guest: _Guest, place: int) -> int:
        own = (ctypes.c_size_t * 1).from_address(place)
        self._states.pop(own[0], None)
        own[0] = 0
        return OK

    def _serialized_fmu_state_size(self, _guest: _Guest, state: int, place: int) -> int:
        (ctypes.c_size_t * 1).from_address(place)[0] = len(self._states[state])
        return OK

    def _serialize_fmu_state(self, _guest: _Guest, state: int, place: int, size: int) -> int:
        ctypes.memmove(place, self._states[state], min(size, len(self._states[state])))
        return OK

    def _deserialize_fmu_state(self, _guest: _Guest, place: int, size: int, state: int) -> int:
        return self._keep(state, ctypes.string_at(place, size))

    def _keep(self, place: int, state: bytes) -> int:
        """Keep a state; at ``place`` is the number of the one that it replaces, or 0."""
        own = (ctypes.c_size_t * 1).from_address(place)
        own[0] = own[0] or next(self._numbers)
        self._states[own[0]] = state
        return OK


class _Guest:
    """One instance of a component; ``log`` is the function of C for its messages, for an ``environment``."""

    def __init__(self, prefix: str, environment: int | None, log: int | None) -> None:
        self._blocks: list[Any] = []  # what it has returned last
        self._prefix = prefix
        self._environment = environment
        self._log = _LOG(log) if log else None
        self._functions: dict[str, Any] = {}
        self._resource: Any = None  # what FMI calls the instance
        self._linker: Any = None
        self._is_lost = False

    def load(self, engine: Any, component: Any, interface: str, memory: int | None) -> None:  # noqa: ANN401 of wasmtime
        """Give it a memory of its own and what it imports: functions for messages, and a system with nothing in it."""
        import wasmtime.component  # noqa: PLC0415  an optional library

        self._store = wasmtime.Store(engine)
        self._store.set_wasi(wasmtime.WasiConfig())
        if memory is not None:
            self._store.set_limits(memory_size=memory)
        self._linker = wasmtime.component.Linker(engine)
        self._linker.add_wasip2()
        with self._linker.root() as root:
            with root.add_instance(_INTERFACE.format("callbacks")) as own:
                own.add_func("log-message", lambda _store, _name, *message: self._tell(*message))
                for name in ("clock-update", "lock-preemption", "unlock-preemption"):
                    own.add_func(name, lambda _store: None)
            with root.add_instance(_INTERFACE.format("intermediate-update-callbacks")) as own:
                own.add_func("intermediate-update", lambda _store, *_values: (False, 0.0))
        self._instance = self._linker.instantiate(self._store, component)
        self._index = self._instance.get_export_index(self._store, interface)

    def make(self, method: str, *values: Any) -> None:  # noqa: ANN401 any value of WIT
        """Make what FMI calls the instance; `ValueError` if it makes none."""
        self._resource = self._called(f"[static]{self._prefix}{method}", *values)
        if self._resource is None:
            raise ValueError("it made no instance")

    def checked(self, function: str, act: Callable[[], int]) -> int:
        """The status of ``act``, which may raise whatever a faulty component provokes; then it is lost."""
        if self._is_lost:
            return _STATUSES.index("error")
        try:
            return act()
        except _Refused as refused:
            return _STATUSES.index(refused.args[0])
        except Exception as error:  # noqa: BLE001  C cannot pass it on
            self._is_lost = True
            why = str(error).strip().rpartition("\n")[2].strip() or type(error).__name__
            self._tell("error", "sandbox", f"{function} was stopped in its sandbox: {why}")
            return _STATUSES.index("error")

    def status(self, method: str, *values: Any) -> int:  # noqa: ANN401 any value of WIT
        """Call a method that returns a status."""
        return _STATUSES.index(self._called(f"[method]{self._prefix}{method}", self._resource, *values))

    def value(self, method: str, *values: Any) -> Any:  # noqa: ANN401 any value of WIT
        """Call a method that returns a value, or else a status."""
        answer = self._called(f"[method]{self._prefix}{method}", self._resource, *values)
        if isinstance(answer, str):
            raise _Refused(answer)
        return answer

    def kept(self, blocks: Sequence[bytes]) -> list[Any]:
        """Keep copies until the next ones; returns their addresses (int)."""
        self._blocks = [ctypes.create_string_buffer(one) for one in blocks]
        return [*map(ctypes.addressof, self._blocks)]

    def close(self) -> None:
        """Free it. Never raises."""
        import wasmtime  # noqa: PLC0415  an optional library

        if self._resource is not None and not self._is_lost:
            with suppress(wasmtime.WasmtimeError, wasmtime.Trap):
                self._resource.drop(self._store)
        if self._linker is not None:
            self._linker.close()
            self._store.close()

    def _called(self, name: str, *values: Any) -> Any:  # noqa: ANN401 any value of WIT
        if (function := self._functions.get(name)) is None:
            index = self._instance.get_export_index(self._store, name, self._index)
            function = self._functions[name] = self._instance.get_func(self._store, index)
        result = function(self._store, *values)
        function.post_return(self._store)
        return result

    def _tell(self, status: str, category: str, text: str) -> None:
        if self._log is not None:
            self._log(self._environment, _STATUSES.index(status), category.encode(), text.encode())


def _kebab(name: str) -> str:
    """What WIT calls a function or an argument of C.

    Example:
        >>> _kebab("GetUInt8"), _kebab("SetFMUState"), _kebab("earlyReturn")
        ('get-uint8', 'set-fmu-state', 'early-return')
    """
    return re.sub(r"\B(?=[A-Z])", "-", name.replace("UInt", "Uint").replace("FMU", "Fmu")).lower()


def _call(method: str, arguments: Sequence[Argument], guest: _Guest, *values: Any) -> int:  # noqa: ANN401 as in ctypes
    """Call a method with the arguments of its function of C, and write what it returns to where they point."""
    is_set, sizes = method.startswith("set-"), 0
    given, wanted = list[Any](), list[tuple[Argument, int, int]]()
    for index, (own, value) in enumerate(zip(arguments, values, strict=True)):
        if own.name == "valueSizes":
            sizes = value
        elif own.items is not None:
            count = count_of(arguments, values, index)
            if is_set or own.name == "valueReferences":
                given.append(_taken(own.items, value, count, sizes))
            else:
                wanted.append((own, value, count))
        elif own.type is not ctypes.c_size_t:
            given.append(value)
    if method == "enter-initialization-mode":
        has_tolerance, tolerance, start, has_end, end = given
        given = [tolerance if has_tolerance else None, start, end if has_end else None]
    if not wanted:
        return guest.status(method, *given)
    _give(guest, guest.value(method, *given), wanted, sizes)
    return OK


def _taken(items: Any, place: int, count: int, sizes: int) -> list[Any] | bytes:  # noqa: ANN401 a type of ctypes
    """The values at an address, for a list of WIT."""
    if not count:
        return b"" if items is ctypes.c_uint8 else []
    own = list((items * count).from_address(place))
    if items is ctypes.c_char_p:
        return [(text or b"").decode() for text in own]
    if items is _BYTES:
        there = (ctypes.c_size_t * count).from_address(sizes)
        return [ctypes.string_at(data, size) for data, size in zip(own, there, strict=True)]
    return bytes(own) if items is ctypes.c_uint8 else own


def _give(guest: _Guest, answer: Any, wanted: Sequence[tuple[Argument, int, int]], sizes: int) -> None:  # noqa: ANN401 as above
    """Write what a method has returned to the arguments that ``wanted`` it, each with an address and a number."""
    if isinstance(answer, list | bytes):
        columns = [*zip(*answer, strict=True)] if len(wanted) > 1 else [answer]
        for (own, place, count), column in zip(wanted, columns, strict=False):
            if len(column) != count:
                raise ValueError(f"it returned {len(column)} values instead of {count}")
            if count:
                _give_list(guest, own.items, place, column, sizes)
        return
    for own, place, _ in wanted:
        field = _kebab(own.name)
        value = answer if isinstance(answer, int) else getattr(answer, _FIELDS.get(field, field))
        (own.items * 1).from_address(place)[0] = value


def _give_list(guest: _Guest, items: Any, place: int, column: Sequence[Any], sizes: int) -> None:  # noqa: ANN401 as above
    """Write a list of WIT to an address; texts and blocks of bytes stay where they are until the next ones."""
    if items is ctypes.c_char_p or items is _BYTES:
        blocks = [one.encode() if isinstance(one, str) else one for one in column]
        (ctypes.c_void_p * len(column)).from_address(place)[:] = guest.kept(blocks)
        if sizes:
            (ctypes.c_size_t * len(column)).from_address(sizes)[:] = [*map(len, blocks)]
        return
    numbers = [_QUALIFIERS.index(one) if isinstance(one, str) else one for one in column]
    (items * len(column)).from_address(place)[:] = numbers
