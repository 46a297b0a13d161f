"""A plain loop over FMPy for scalars of all types, FMI 2.0 and 3.0, and nothing of the mesh.

Everything that the mesh derives is given here: the order, the delays, what a connection makes of a value, and in which
stages values are handed on in Initialization Mode.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import fmpy
from fmpy.fmi2 import FMU2Slave
from fmpy.fmi3 import FMU3Slave

__all__ = ["Wire", "run_plainly"]

_SUFFIXES = {"Enumeration": "Integer"}, {"Enumeration": "Int64"}
"""By version: the functions of a type that do not have its own name."""


def _same(value: Any) -> Any:  # noqa: ANN401  of any type
    return value


class Wire(NamedTuple):
    """One connection, with ends such as `a.y`; without a delay, it is for Initialization Mode only."""

    source: str
    target: str
    delay: int | None = 0
    change: Callable[[Any], Any] = _same


def run_plainly(
    fmus: Mapping[str, tuple[Path, Mapping[str, Any]]],
    wires: Sequence[Wire],
    stages: Sequence[Sequence[Wire]],
    *,
    points: int,
    step_size: float,
    recorded: Sequence[str],
) -> list[tuple[Any, ...]]:
    """The rows of the result: the time, and the values of the recorded variables.

    Args:
        fmus: file and start values by name, in the order in which they step.
        wires: all connections that have values in the steps.
        stages: for Initialization Mode; of each stage, all sources are read before anything is set.
        points: number of steps.
        step_size: in s.
        recorded: the variables, as `a.y`.
    """
    with ExitStack() as opened:
        made = _Fmus({name: _Fmu(name, path, opened) for name, (path, _) in fmus.items()})
        for name, (_, start_values) in fmus.items():
            made[name].start(start_values)
        for stage in stages:
            brought = [(wire.target, wire.change(made.get_end(wire.source))) for wire in stage]
            for target, value in brought:
                made.give_end(target, value)
        for fmu in made.values():
            fmu.fmi.exitInitializationMode()
        values = {source: [made.get_end(source)] for source in [*(wire.source for wire in wires), *recorded]}
        for point in range(points):
            for name in made:
                _step(made, name, point, step_size, [wire for wire in wires if wire.delay is not None], values)
        return [(k * step_size, *(values[name][k] for name in recorded)) for k in range(points + 1)]


def _step(
    made: _Fmus, name: str, point: int, step_size: float, wires: Sequence[Wire], values: Mapping[str, list[Any]]
) -> None:
    for wire in wires:
        if wire.target.partition(".")[0] == name:
            made.give_end(wire.target, wire.change(values[wire.source][point if wire.delay else point + 1]))
    made[name].fmi.doStep(point * step_size, step_size)
    for source, own in values.items():
        if source.partition(".")[0] == name:
            own.append(made.get_end(source))


class _Fmu:
    """One instance of FMPy, by variable names."""

    def __init__(self, name: str, path: Path, opened: ExitStack) -> None:
        folder = fmpy.extract(str(path))
        opened.callback(shutil.rmtree, folder, ignore_errors=True)
        description: Any = fmpy.read_model_description(folder)
        self._is_new = description.fmiVersion.startswith("3.")
        self._variables = {v.name: v for v in description.modelVariables}
        make = FMU3Slave if self._is_new else FMU2Slave
        self.fmi: Any = make(
            guid=description.guid,
            modelIdentifier=description.coSimulation.modelIdentifier,
            unzipDirectory=folder,
            instanceName=name,
        )
        self.fmi.instantiate()
        opened.callback(self.fmi.freeInstance)

    def start(self, start_values: Mapping[str, Any]) -> None:
        """To Initialization Mode."""
        if not self._is_new:
            self.fmi.setupExperiment(startTime=0.0)
        for name, value in start_values.items():
            self.give(name, value)
        self.fmi.enterInitializationMode()

    def get(self, name: str) -> Any:  # noqa: ANN401  of any type
        """The value of a scalar."""
        value = self._function("get", name)()[0]
        return bool(value) if self._variables[name].type == "Boolean" else value

    def give(self, name: str, value: Any) -> None:  # noqa: ANN401  of any type
        """Set a scalar."""
        self._function("set", name)([value])

    def _function(self, verb: str, name: str) -> Callable[..., Any]:
        variable = self._variables[name]
        suffix = _SUFFIXES[self._is_new].get(variable.type, variable.type)
        return partial(getattr(self.fmi, f"{verb}{suffix}"), [variable.valueReference])


class _Fmus(dict[str, _Fmu]):
    """Instances by name, and their variables as `a.y`."""

    def get_end(self, end: str) -> Any:  # noqa: ANN401  of any type
        name, _, variable = end.partition(".")
        return self[name].get(variable)

    def give_end(self, end: str, value: Any) -> None:  # noqa: ANN401  of any type
        name, _, variable = end.partition(".")
        self[name].give(variable, value)
