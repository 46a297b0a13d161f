"""The reference of invariant 1: a plain loop over FMPy, as its users write it, and nothing of the mesh.

What a step uses is written here from its definition: the step of a target from point k to point k + m uses the value of
the source at point k (delay 1) or k + m (delay 0), and an output holds its value until the next own point of its
instance.
"""

from __future__ import annotations

import csv
import shutil
import struct
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import fmpy
import msgspec
import yaml
from fmpy.fmi2 import FMU2Slave

__all__ = ["Pipe", "Reference", "Unit", "as_bits", "read_csv", "reference_of", "run_fmpy"]

Table = list[tuple[float, ...]]


class Unit(msgspec.Struct, frozen=True):
    """One FMU.

    Attributes:
        points: base points per own step.
    """

    name: str
    fmu: str
    start_values: Mapping[str, float]
    points: int = 1


class Pipe(msgspec.Struct, frozen=True):
    """One connection between Real variables."""

    source: str
    output: str
    target: str
    input: str
    delay: int
    factor: float = 1.0
    offset: float = 0.0


class Reference(msgspec.Struct, frozen=True):
    """What to run.

    Attributes:
        units: in the order in which they are stepped at a point.
        recorded: (unit, output) of each column but the time.
        loops: the pipes at which each algebraic loop at the start is torn; what comes first stands first.
        relaxation: how much of the difference an iteration of a loop takes away.
        changes: values by (unit, variable) and the point at which a step begins; each is set before this step.
    """

    units: Sequence[Unit]
    pipes: Sequence[Pipe]
    step_size: float
    last_point: int
    recorded: Sequence[tuple[str, str]]
    start_time: float = 0.0
    loops: Sequence[Sequence[Pipe]] = ()
    relaxation: float = 1.0
    changes: Mapping[tuple[str, str], Mapping[int, float]] = {}


def run_fmpy(reference: Reference) -> Table:
    """The rows of the result: the time, and the recorded outputs."""
    with _opened(reference) as fmus:
        return _loop(reference, fmus)


def _loop(reference: Reference, fmus: Mapping[str, _Fmu]) -> Table:
    start, h = reference.start_time, reference.step_size
    values: dict[tuple[str, str], list[float]] = {}
    points = {unit.name: unit.points for unit in reference.units}
    wanted = list(dict.fromkeys([*((p.source, p.output) for p in reference.pipes), *reference.recorded]))
    for name, output in wanted:
        values[name, output] = [fmus[name].get(output)]

    def value_at(name: str, output: str, point: int) -> float:
        return values[name, output][point // points[name]]

    rows = [(start, *(value_at(*column, 0) for column in reference.recorded))]
    for end in range(1, reference.last_point + 1):
        for unit in reference.units:
            if end % unit.points:
                continue
            begin = end - unit.points
            _change(reference, unit.name, begin, fmus[unit.name])
            for pipe in reference.pipes:
                if pipe.target == unit.name:
                    value = value_at(pipe.source, pipe.output, begin if pipe.delay else end)
                    fmus[unit.name].set(pipe.input, _scaled(pipe, value))
            fmus[unit.name].fmi.doStep(start + begin * h, unit.points * h)
            for name, output in wanted:
                if name == unit.name:
                    values[name, output].append(fmus[name].get(output))
        rows.append((start + end * h, *(value_at(*column, end) for column in reference.recorded)))
    return rows


def _change(reference: Reference, name: str, begin: int, fmu: _Fmu) -> None:
    """Set what changes in the step of a unit that begins at a point."""
    for (owner, variable), values_at in reference.changes.items():
        if owner == name and begin in values_at:
            fmu.set(variable, values_at[begin])


def _scaled(pipe: Pipe, value: float) -> float:
    return value if (pipe.factor, pipe.offset) == (1.0, 0.0) else value * pipe.factor + pipe.offset


class _Fmu:
    """One instance of FMPy, by variable names."""

    def __init__(self, unit: Unit, folder: str) -> None:
        description: Any = fmpy.read_model_description(folder)
        self._references = {v.name: [v.valueReference] for v in description.modelVariables}
        self.fmi: Any = FMU2Slave(
            guid=description.guid,
            modelIdentifier=description.coSimulation.modelIdentifier,
            unzipDirectory=folder,
            instanceName=unit.name,
        )
        self.fmi.instantiate()

    def get(self, name: str) -> float:
        return float(self.fmi.getReal(self._references[name])[0])

    def set(self, name: str, value: float) -> None:
        self.fmi.setReal(self._references[name], [value])


@contextmanager
def _opened(reference: Reference) -> Iterator[dict[str, _Fmu]]:
    """All FMUs at the first communication point."""
    folders: dict[str, str] = {}
    fmus: dict[str, _Fmu] = {}
    try:
        for unit in reference.units:
            if unit.fmu not in folders:
                folders[unit.fmu] = fmpy.extract(unit.fmu)
            fmus[unit.name] = fmu = _Fmu(unit, folders[unit.fmu])
            fmu.fmi.setupExperiment(startTime=reference.start_time)
            for name, value in unit.start_values.items():
                fmu.set(name, value)
            fmu.fmi.enterInitializationMode()
        _settle(reference, fmus)
        for fmu in fmus.values():
            fmu.fmi.exitInitializationMode()
        yield fmus
    finally:
        for fmu in fmus.values():
            fmu.fmi.freeInstance()
        for folder in folders.values():
            shutil.rmtree(folder, ignore_errors=True)


def _settle(reference: Reference, fmus: Mapping[str, _Fmu]) -> None:
    """Iterate each loop at the start until it is consistent, and hand all other values on."""
    settled: list[Pipe] = []
    for loop in reference.loops:
        settled += loop
        assumed = [fmus[pipe.target].get(pipe.input) for pipe in loop]
        while True:
            for pipe, value in zip(loop, assumed, strict=True):
                fmus[pipe.target].set(pipe.input, value)
            _propagate(reference, fmus, settled)
            brought = [_scaled(pipe, fmus[pipe.source].get(pipe.output)) for pipe in loop]
            residuals = [abs(new - old) / max(1.0, abs(new)) for old, new in zip(assumed, brought, strict=True)]
            if max(residuals) <= 1e-9:
                break
            relaxed = [old + reference.relaxation * (new - old) for old, new in zip(assumed, brought, strict=True)]
            assumed = relaxed if reference.relaxation < 1.0 else brought
    _propagate(reference, fmus, settled)


def _propagate(reference: Reference, fmus: Mapping[str, _Fmu], torn: Sequence[Pipe]) -> None:
    """Hand values on through all pipes but the torn ones."""
    for _ in reference.units:  # so many times at most does a value have to be handed on
        for pipe in reference.pipes:
            if pipe not in torn:
                fmus[pipe.target].set(pipe.input, _scaled(pipe, fmus[pipe.source].get(pipe.output)))


def reference_of(
    config: Path, delays: Mapping[str, int], *, default_delay: int = 0, order: Sequence[str] | None = None
) -> Reference:
    """What a configuration file means, read without the mesh.

    Args:
        config: the file; connections in the short form or the long one, and `record.variables` given.
        delays: delay by `source.output -> target.input`.
        default_delay: the delay of all other connections.
        order: the order in which instances are stepped at a point; by default that of the file.
    """
    content = yaml.safe_load(config.read_text(encoding="utf-8"))
    simulation = content["simulation"]
    start, h = float(simulation.get("start_time", 0.0)), float(simulation["step_size"])
    instances = content["instances"]
    units = [
        Unit(
            name=name,
            fmu=str(config.parent / instances[name]["fmu"]),
            start_values=instances[name].get("start_values", {}),
            points=round(float(instances[name].get("step_size", h)) / h),
        )
        for name in order or instances
    ]
    pipes = []
    for connection in content["connections"]:
        form = connection
        if isinstance(form, str):
            source, target = form.split(" -> ")
            form = {"from": source, "to": target}
        source, _, output = form["from"].partition(".")
        target, _, input_ = form["to"].partition(".")
        delay = form.get("delay", delays.get(f"{form['from']} -> {form['to']}", default_delay))
        scale = (float(form.get("factor", 1.0)), float(form.get("offset", 0.0)))
        pipes.append(Pipe(source, output, target, input_, delay, *scale))
    return Reference(
        units=units,
        pipes=pipes,
        step_size=h,
        last_point=round((float(simulation["stop_time"]) - start) / h),
        recorded=[(name.partition(".")[0], name.partition(".")[2]) for name in content["record"]["variables"]],
        start_time=start,
    )


def read_csv(content: bytes) -> tuple[list[str], Table]:
    """Header and rows of a result, every number read by `float`."""
    header, *rows = csv.reader(content.decode().splitlines())
    return header, [tuple(map(float, row)) for row in rows]


def as_bits(table: Table) -> list[bytes]:
    """Rows as bytes: 0.0 is not -0.0 there, and a NaN equals itself."""
    return [struct.pack(f"<{len(row)}d", *row) for row in table]
