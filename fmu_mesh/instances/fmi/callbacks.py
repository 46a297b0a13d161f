"""Callbacks for FMUs of FMI 1.0 and 2.0, and the assignment of log messages to instances.

FMPy's proxy, which formats the variadic messages of an FMU, has one logger for the whole process. So a message goes to
the instance whose address comes with it: the environment that the instance was made with (FMI 2.0, 2.1.5), or the
component (FMI 1.0, 2.3). Some FMUs pass neither; then the instance name decides, which instances of several meshes in
one process may share. If this name is unknown as well, every instance gets the message, because it may be the reason
why a call fails.
"""

from __future__ import annotations

import ctypes
from typing import Protocol

import fmpy
from fmpy.fmi1 import (
    fmi1CallbackAllocateMemoryTYPE,
    fmi1CallbackFreeMemoryTYPE,
    fmi1CallbackFunctions,
    fmi1CallbackLoggerTYPE,
)
from fmpy.fmi2 import (
    fmi2CallbackAllocateMemoryTYPE,
    fmi2CallbackFreeMemoryTYPE,
    fmi2CallbackFunctions,
    fmi2CallbackLoggerTYPE,
)
from fmpy.logging import addLoggerProxy

__all__ = ["FMI1_CALLBACKS", "fmi2_callbacks", "register", "register_component", "unregister"]


class Logged(Protocol):
    """Receives log messages."""

    def logged(self, status: int, category: bytes, message: bytes) -> None:
        """Take a message."""
        ...


_by_address: dict[int, Logged] = {}
_registered: dict[int, tuple[bytes, Logged]] = {}
"""Names and instances, by the identity of the instance."""


def register(name: str, instance: Logged, environment: int) -> None:
    """Messages with the address ``environment``, or of the instance called ``name``, go to ``instance`` from now on."""
    _registered[id(instance)] = name.encode(), instance
    _by_address[environment] = instance


def register_component(component: int, instance: Logged) -> None:
    """Messages with the address ``component`` also go to ``instance``."""
    _by_address[component] = instance


def unregister(instance: Logged) -> None:
    """Discard messages of ``instance`` from now on."""
    _registered.pop(id(instance), None)
    for address in [address for address, one in tuple(_by_address.items()) if one is instance]:
        del _by_address[address]


def fmi2_callbacks(environment: int) -> fmi2CallbackFunctions:
    """The callbacks for an instance of FMI 2.0 with a registered environment; they must live as long as it does."""
    callbacks = fmi2CallbackFunctions.from_buffer_copy(_FMI2_CALLBACKS)
    callbacks.componentEnvironment = environment
    return callbacks


def _log(address: int | None, name: bytes | None, status: int, category: bytes | None, message: bytes | None) -> None:
    addressed, everyone = _by_address.get(address or 0), tuple(_registered.values())
    named = [instance for own, instance in everyone if own == name]
    for instance in [addressed] if addressed is not None else named or [one for _, one in everyone]:
        instance.logged(status, category or b"", message or b"")


def _fmi2_callbacks() -> fmi2CallbackFunctions:
    callbacks = fmi2CallbackFunctions()
    callbacks.logger = fmi2CallbackLoggerTYPE(_log)
    callbacks.allocateMemory = fmi2CallbackAllocateMemoryTYPE(fmpy.calloc)
    callbacks.freeMemory = fmi2CallbackFreeMemoryTYPE(fmpy.free)
    addLoggerProxy(ctypes.byref(callbacks))
    return callbacks


def _fmi1_callbacks() -> fmi1CallbackFunctions:
    """The logger is that of FMI 2.0, which has the same arguments; the proxy must not be added twice."""
    callbacks = fmi1CallbackFunctions()
    callbacks.logger = ctypes.cast(_FMI2_CALLBACKS.logger, fmi1CallbackLoggerTYPE)
    callbacks.allocateMemory = fmi1CallbackAllocateMemoryTYPE(fmpy.calloc)
    callbacks.freeMemory = fmi1CallbackFreeMemoryTYPE(fmpy.free)
    callbacks.stepFinished = None
    return callbacks


_FMI2_CALLBACKS = _fmi2_callbacks()
FMI1_CALLBACKS = _fmi1_callbacks()
