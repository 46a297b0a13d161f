"""Callbacks for FMUs, and the assignment of log messages to instances.

The loggers are those of `messages.c`, which format messages and pass on a limited number; without the library of C,
FMPy's proxy formats them where it has one, and all are passed on. A message goes to the instance whose address comes
with it: the environment that the instance was made with (FMI 2.0, 2.1.5; FMI 3.0, 2.3.1), or the component (FMI 1.0,
2.3). Some FMUs pass neither; then the instance name decides, which instances of several meshes in one process may
share. If this name is unknown as well, every instance gets the message, because it may be the reason why a call fails.
"""

from __future__ import annotations

import ctypes
from typing import Any, Final, Protocol

import fmpy
from fmpy import fmi1, fmi2
from fmpy.logging import addLoggerProxy

from ...rings.library import load_library

__all__ = [
    "FMI1_CALLBACKS",
    "FMI3_LOGGER",
    "fmi2_callbacks",
    "recall",
    "register",
    "register_component",
    "tell_counted",
    "unregister",
]


class Logged(Protocol):
    """Receives log messages."""

    def logged(self, status: int, category: bytes, message: bytes, counted: int) -> None:
        """Take a message, or the last one of ``counted`` messages of its kind that are not passed on."""
        ...

    def recalled(self, message: bytes) -> None:
        """Take a message that was only counted, because it may say why a call fails."""
        ...


class _Message(ctypes.Structure):
    """As in `messages.c`."""

    _fields_ = [
        ("kind", ctypes.c_uint64),
        ("address", ctypes.c_void_p),
        ("counted", ctypes.c_int64),
        ("status", ctypes.c_int32),
        ("name", ctypes.c_char * 256),
        ("category", ctypes.c_char * 256),
        ("text", ctypes.c_char * 4096),
    ]


_by_address: dict[int, Logged] = {}
_registered: dict[int, tuple[bytes, Logged, list[int]]] = {}
"""Names, instances and their addresses, by the identity of the instance."""


def register(name: str, instance: Logged, environment: int) -> None:
    """Messages with the address ``environment``, or of the instance called ``name``, go to ``instance`` from now on."""
    _registered[id(instance)] = name.encode(), instance, [environment]
    _by_address[environment] = instance


def register_component(component: int, instance: Logged) -> None:
    """Messages with the address ``component`` also go to a registered ``instance``."""
    _registered[id(instance)][2].append(component)
    _by_address[component] = instance


def unregister(instance: Logged) -> None:
    """Discard messages of ``instance`` from now on; tell how many were only counted."""
    message = _Message()
    recall(message)  # or another instance would get them later
    tell_counted(instance, message)
    for address in _registered.pop(id(instance), (b"", instance, []))[2]:
        if _by_address.get(address) is instance:
            del _by_address[address]


def fmi2_callbacks(environment: int) -> fmi2.fmi2CallbackFunctions:
    """The callbacks for an instance of FMI 2.0 with a registered environment; they must live as long as it does."""
    callbacks = fmi2.fmi2CallbackFunctions.from_buffer_copy(_FMI2_CALLBACKS)
    callbacks.componentEnvironment = environment
    return callbacks


def recall(message: _Message | None = None) -> None:
    """Give the instances the last messages that were only counted; ``message`` is memory for them."""
    message = message or _Message()
    while _library is not None and _library.recall_message(ctypes.byref(message)):
        for instance in _receivers(message.address, message.name):
            instance.recalled(message.text)


def tell_counted(instance: Logged, message: _Message | None = None) -> None:
    """Tell how many messages of ``instance`` were only counted, and not told yet; ``message`` is memory for them."""
    message, number = message or _Message(), 0
    while _library is not None and _library.message_of_kind(ctypes.c_int64(number), ctypes.byref(message)):
        receivers = _receivers(message.address, message.name)
        if instance not in receivers:
            number += 1
            continue
        _library.forget_kind(ctypes.byref(message))
        for receiver in receivers if message.counted else ():
            receiver.logged(message.status, message.category, message.text, message.counted)


def _receivers(address: int | None, name: bytes | None) -> list[Logged]:
    addressed, everyone = _by_address.get(address or 0), tuple(_registered.values())
    named = [instance for own, instance, _ in everyone if own == name]
    return [addressed] if addressed is not None else named or [one for _, one, _ in everyone]


def _pass_on(passed: Any) -> None:  # noqa: ANN401 ctypes has no type for a pointer
    message = passed.contents
    recall()
    for instance in _receivers(message.address, message.name):
        instance.logged(message.status, message.category, message.text, message.counted)


def _log(address: int | None, name: bytes | None, status: int, category: bytes | None, text: bytes | None) -> None:
    """The logger without the library."""
    texts = (name or b"")[:255], (category or b"")[:255], (text or b"")[:4095]
    _pass_on(ctypes.pointer(_Message(0, address, 0, status, *texts)))


def _fmi2_callbacks() -> fmi2.fmi2CallbackFunctions:
    callbacks = fmi2.fmi2CallbackFunctions()
    callbacks.allocateMemory = fmi2.fmi2CallbackAllocateMemoryTYPE(fmpy.calloc)
    callbacks.freeMemory = fmi2.fmi2CallbackFreeMemoryTYPE(fmpy.free)
    if _library is not None:
        callbacks.logger = ctypes.cast(_library.log_fmi1_2, fmi2.fmi2CallbackLoggerTYPE)
    else:
        callbacks.logger = fmi2.fmi2CallbackLoggerTYPE(_log)
        addLoggerProxy(ctypes.byref(callbacks))
    return callbacks


def _fmi1_callbacks() -> fmi1.fmi1CallbackFunctions:
    """The logger is that of FMI 2.0, which has the same arguments; the proxy must not be added twice."""
    callbacks = fmi1.fmi1CallbackFunctions()
    callbacks.logger = ctypes.cast(_FMI2_CALLBACKS.logger, fmi1.fmi1CallbackLoggerTYPE)
    callbacks.allocateMemory = fmi1.fmi1CallbackAllocateMemoryTYPE(fmpy.calloc)
    callbacks.freeMemory = fmi1.fmi1CallbackFreeMemoryTYPE(fmpy.free)
    callbacks.stepFinished = None
    return callbacks


_PASS_ON: Final = ctypes.CFUNCTYPE(None, ctypes.POINTER(_Message))(_pass_on)
_library: Final = ctypes.PyDLL(path) if (path := load_library(to_step=False)) is not None else None
if _library is not None:
    _library.pass_messages_to(_PASS_ON)
_FMI2_CALLBACKS = _fmi2_callbacks()
FMI1_CALLBACKS = _fmi1_callbacks()
FMI3_LOGGER: Final = (
    ctypes.cast(_library.log_fmi3, ctypes.c_void_p).value
    if _library is not None
    else lambda address, status, category, text: _log(address, None, status, category, text)
)
