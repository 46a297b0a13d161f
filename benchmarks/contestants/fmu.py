"""An FMU through FMPy, ready to step; what all contestants but our own use."""

from __future__ import annotations

import shutil
from contextlib import contextmanager
from ctypes import byref
from typing import TYPE_CHECKING, Any

import fmpy
from fmpy import extract, read_model_description
from fmpy.fmi2 import (
    FMU2Slave,
    fmi2CallbackAllocateMemoryTYPE,
    fmi2CallbackFreeMemoryTYPE,
    fmi2CallbackFunctions,
    fmi2CallbackLoggerTYPE,
)
from fmpy.logging import addLoggerProxy

from benchmarks.contestants.entry import FMUS

if TYPE_CHECKING:
    from collections.abc import Iterator

    from benchmarks.task import Member, System, Task

__all__ = ["Fmu", "opened", "opened_all"]


class Fmu:
    """One instance.

    Attributes:
        fmu: FMPy's object.
        references: value references by name.
        inputs: value references of the connected input, as FMPy's functions take them.
        outputs: likewise of the output.
        messages: what it has logged.
    """

    def __init__(self, member: Member, stop_time: float | None) -> None:
        path = str(FMUS / f"{member.fmu}.fmu")
        description = read_model_description(path, validate=False)
        self.references = references = {one.name: one.valueReference for one in description.modelVariables}
        self.inputs = [references[member.input]]
        self.outputs = [references[member.output]]
        self.messages: list[tuple[Any, ...]] = []
        self._folder = extract(path)
        self.fmu: Any = FMU2Slave(
            guid=description.guid,
            modelIdentifier=description.coSimulation.modelIdentifier,
            unzipDirectory=self._folder,
            instanceName=member.name,
        )
        self.fmu.instantiate(callbacks=_callbacks(self.messages), loggingOn=False)
        self.fmu.setupExperiment(startTime=0.0, stopTime=stop_time)
        names = list(member.start_values)
        self.fmu.setReal([references[name] for name in names], [member.start_values[name] for name in names])
        self.fmu.enterInitializationMode()

    def set(self, value: float) -> None:
        """Set the input."""
        self.fmu.setReal(self.inputs, [value])

    def get(self) -> float:
        """Read the output."""
        value: float = self.fmu.getReal(self.outputs)[0]
        return value

    def close(self) -> None:
        """Free the instance and its files."""
        self.fmu.terminate()
        self.fmu.freeInstance()
        shutil.rmtree(self._folder, ignore_errors=True)


def _callbacks(messages: list[tuple[Any, ...]]) -> fmi2CallbackFunctions:
    """Those of FMPy, but messages are not printed."""
    logger = fmi2CallbackLoggerTYPE(lambda *message: messages.append(message))
    allocate, free = fmi2CallbackAllocateMemoryTYPE(fmpy.calloc), fmi2CallbackFreeMemoryTYPE(fmpy.free)
    callbacks = fmi2CallbackFunctions(logger=logger, allocateMemory=allocate, freeMemory=free)
    addLoggerProxy(byref(callbacks))
    return callbacks


@contextmanager
def opened(task: Task, index: int) -> Iterator[Fmu]:
    """Instance ``index`` of the task's system, initialized and at point 0."""
    fmu = Fmu(task.system.members[index], task.stop_time)
    try:
        value = task.initial_inputs[index]
        if value is not None:
            fmu.set(value)
        fmu.fmu.exitInitializationMode()
        yield fmu
    finally:
        fmu.close()


@contextmanager
def opened_all(system: System, stop_time: float) -> Iterator[tuple[list[Fmu], list[float | None]]]:
    """All instances of a system in this process at point 0, and their initial inputs."""
    fmus = [Fmu(member, stop_time) for member in system.members]
    try:
        inputs: list[float | None] = [None] * len(fmus)
        for _ in fmus:  # a value needs as many rounds as there are instances on its way
            for index, fmu in enumerate(fmus):
                source = system.source_of(index)
                if source is not None:
                    inputs[index] = value = fmus[source].get()
                    fmu.set(value)
        for fmu in fmus:
            fmu.fmu.exitInitializationMode()
        yield fmus, inputs
    finally:
        for fmu in fmus:
            fmu.close()
