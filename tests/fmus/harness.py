"""Runs one FMU directly, call by call and by variable names.

Owns the thin layer between a test and FMPy. Nothing of the mesh is involved: these tests are about the FMUs.
"""

from __future__ import annotations

import math
import random
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import fmpy
import pytest
from fmpy.fmi1 import FMICallException
from fmpy.fmi2 import FMU2Slave, fmi2CallbackFunctions, fmi2CallbackLoggerTYPE

__all__ = ["VARYING_STEPS", "Message", "Unit", "Value", "refusal"]

Value = float | int | bool | str

ERROR = 3
RANDOM = random.Random(2)  # noqa: S311 - no secret
VARYING_STEPS = tuple((RANDOM.uniform(1e-4, 0.3), math.sin(k) + k % 3) for k in range(300))
"""Step sizes (s) with inputs that also jump."""


@dataclass(frozen=True)
class Message:
    """What an FMU told its importer."""

    instance_name: str
    status: int
    category: str
    text: str


class Unit:
    """One instance of an extracted FMU.

    Call sequence: `setup` (or `start`, which goes on to the first communication point), then `set`, `step`
    and `get`. ``fmi`` is FMPy's object for every other call.
    """

    def __init__(self, folder: Path, *, logging_on: bool = False) -> None:
        self.description: Any = fmpy.read_model_description(str(folder))
        self.messages: list[Message] = []
        self.fmi: Any = FMU2Slave(
            guid=self.description.guid,
            modelIdentifier=self.description.coSimulation.modelIdentifier,
            unzipDirectory=str(folder),
            instanceName="unit",
        )
        self._variables = {variable.name: variable for variable in self.description.modelVariables}
        self.callbacks = fmi2CallbackFunctions(logger=fmi2CallbackLoggerTYPE(self._receive))
        self.fmi.instantiate(callbacks=self.callbacks, loggingOn=logging_on)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.fmi.freeInstance()

    def setup(self, start_time: float = 0.0, stop_time: float | None = None) -> Self:
        """Go to initialization mode."""
        self.fmi.setupExperiment(startTime=start_time, stopTime=stop_time)
        self.fmi.enterInitializationMode()
        return self

    def start(self, values: Mapping[str, Value] | None = None, start_time: float = 0.0) -> Self:
        """Go to the first communication point with these start values."""
        self.setup(start_time)
        for name, value in (values or {}).items():
            self.set(name, value)
        self.fmi.exitInitializationMode()
        return self

    def set(self, name: str, value: Value) -> None:
        """Set one variable."""
        match self._variables[name].type:
            case "Real":
                self.fmi.setReal([self.reference(name)], [value])
            case "Integer" | "Enumeration":
                self.fmi.setInteger([self.reference(name)], [value])
            case "Boolean":
                self.fmi.setBoolean([self.reference(name)], [value])
            case "String":
                self.fmi.setString([self.reference(name)], [value])

    def get(self, name: str) -> Value:
        """Return one variable; a String as text."""
        value: Value
        match self._variables[name].type:
            case "Real":
                (value,) = self.fmi.getReal([self.reference(name)])
            case "Integer" | "Enumeration":
                (value,) = self.fmi.getInteger([self.reference(name)])
            case "Boolean":
                value = bool(self.fmi.getBoolean([self.reference(name)])[0])
            case _:
                value = self.fmi.getString([self.reference(name)])[0].decode()
        return value

    def real(self, name: str) -> float:
        """Return one Real variable."""
        return float(self.get(name))

    def step(self, time: float, step_size: float) -> None:
        """Advance from ``time`` to ``time + step_size`` (s)."""
        self.fmi.doStep(time, step_size)

    def run(self, steps: Sequence[tuple[float, float]], start_time: float = 0.0) -> list[dict[str, Value]]:
        """Take ``(step size, value of every Real input)`` steps and return all variables after each."""
        time, rows = start_time, []
        for step_size, value in steps:
            for name, variable in self._variables.items():
                if variable.causality == "input" and variable.type == "Real":
                    self.set(name, value)
            self.step(time, step_size)
            time += step_size
            rows.append({name: self.get(name) for name in self._variables})
        return rows

    def reference(self, name: str) -> int:
        """Return the value reference of a variable."""
        return int(self._variables[name].valueReference)

    def _receive(self, _environment: int, name: bytes, status: int, category: bytes, text: bytes) -> None:
        self.messages.append(Message(name.decode(), status, category.decode(), text.decode()))


def refusal(unit: Unit, call: Callable[[], object]) -> Message:
    """Return the message that goes with the error that ``call`` has to end in."""
    with pytest.raises(FMICallException) as caught:
        call()
    assert caught.value.status == ERROR
    return unit.messages[-1]
