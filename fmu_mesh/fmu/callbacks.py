"""The callbacks that FMUs of FMI 1.0 and 2.0 get: one set for the process, because there is one proxy for messages.

FMPy's proxy, which formats the variadic messages of an FMU, has one logger only; so messages find their instance by its
name, which is unique in a process.
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

__all__ = ["FMI1_CALLBACKS", "FMI2_CALLBACKS", "register", "unregister"]


class Logged(Protocol):
    """What takes messages."""

    def logged(self, status: int, category: bytes, message: bytes) -> None:
        """Take a message."""
        ...


_instances: dict[bytes, Logged] = {}


def register(name: str, instance: Logged) -> None:
    """From now on messages of the instance called ``name`` go to ``instance``.

    Raises:
        ValueError: the name is taken.
    """
    if name.encode() in _instances:
        msg = f"two instances of one process have the name '{name}'"
        raise ValueError(msg)
    _instances[name.encode()] = instance


def unregister(name: str, instance: Logged) -> None:
    """Messages of ``instance`` go nowhere any more."""
    if _instances.get(name.encode()) is instance:
        del _instances[name.encode()]


def _log(_environment: int | None, name: bytes, status: int, category: bytes, message: bytes) -> None:
    instance = _instances.get(name or b"")
    if instance is not None:
        instance.logged(status, category or b"", message or b"")


def _fmi2_callbacks() -> fmi2CallbackFunctions:
    callbacks = fmi2CallbackFunctions()
    callbacks.logger = fmi2CallbackLoggerTYPE(_log)
    callbacks.allocateMemory = fmi2CallbackAllocateMemoryTYPE(fmpy.calloc)
    callbacks.freeMemory = fmi2CallbackFreeMemoryTYPE(fmpy.free)
    addLoggerProxy(ctypes.byref(callbacks))
    return callbacks


def _fmi1_callbacks() -> fmi1CallbackFunctions:
    """As for FMI 2.0, whose logger has the same arguments; the proxy must not be added a second time."""
    callbacks = fmi1CallbackFunctions()
    callbacks.logger = ctypes.cast(FMI2_CALLBACKS.logger, fmi1CallbackLoggerTYPE)
    callbacks.allocateMemory = fmi1CallbackAllocateMemoryTYPE(fmpy.calloc)
    callbacks.freeMemory = fmi1CallbackFreeMemoryTYPE(fmpy.free)
    callbacks.stepFinished = None
    return callbacks


FMI2_CALLBACKS = _fmi2_callbacks()
FMI1_CALLBACKS = _fmi1_callbacks()
