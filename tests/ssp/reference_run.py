"""A plain loop over the FMUs of a flat system with FMPy, as its users write it; it imports nothing of the package.

The step of an FMU from point k to k + 1 uses the values of its sources at point k (delay 1) or k + 1 (delay 0). With
jacobi every delay is 1. With gauss_seidel a delay is 0, except in as few connections as necessary for an order of the
FMUs, and of two choices in the connections that come later. Before the first point, outputs are read in the order in
which they depend on one another (docs/adr/0013).

    python -m tests.ssp.reference_run system.ssp rows.csv --step-size 0.01 --stop-time 1.0 [--algorithm gauss_seidel]
"""

from __future__ import annotations

import argparse
import csv
import math
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from ctypes import byref, c_double, c_int, c_void_p
from dataclasses import replace
from itertools import combinations
from pathlib import Path
from typing import Any, TypeVar

import fmpy
from fmpy.fmi1 import FMU1Slave
from fmpy.fmi2 import FMU2Model, FMU2Slave
from fmpy.fmi3 import FMU3Slave

from tests.ssp.reference_system import End, FlatSystem, Flow, Fmu, Path_, Value, name_of, read_system

__all__ = ["Row", "run_system"]

Row = tuple[Value, ...]
V = TypeVar("V")

_TOLERANCE = 1e-9
_SWEEPS = 1000


def run_system(
    system: FlatSystem, *, step_size: float, stop_time: float, algorithm: str = "jacobi"
) -> tuple[list[End], list[Row]]:
    """The outputs of all FMUs at every communication point.

    Args:
        system: what to run.
        step_size: in s.
        stop_time: in s.
        algorithm: jacobi or gauss_seidel.

    Returns:
        The outputs, and the rows: the time in s, and the values of the outputs.
    """
    outputs = [(path, name) for path, fmu in system.fmus.items() for name in _outputs_of(fmu)]
    times = _Times(system.start_time, step_size, round((stop_time - system.start_time) / step_size), stop_time)
    points = {path: round((fmu.step_size or step_size) / step_size) for path, fmu in system.fmus.items()}
    system = _in_mesh_order(system)
    delays = _delays(system, algorithm)
    order = _order(system, delays)
    with _opened(system, times, points) as running:
        _initialize(system, running, delays)
        values = {end: [running[end[0]].get(end[1])] for end in outputs}

        def value_at(end: End, point: int) -> Value:
            return values[end][point // points[end[0]]]

        rows: list[Row] = [(times.of(0), *(value_at(end, 0) for end in outputs))]
        for end_point in range(1, times.last + 1):
            for path in order:
                if end_point % points[path]:
                    continue
                begin = end_point - points[path]
                for flow in system.flows:
                    if flow.target[0] == path and flow not in running[path].only_at_the_start:
                        value = flow.change.of(value_at(flow.source, begin if delays[flow.target] else end_point))
                        running[path].take(flow.target[1], value)
                running[path].step(times.of(begin), times.of(end_point), points[path] * step_size)
                for end in outputs:
                    if end[0] == path:
                        values[end].append(running[path].get(end[1]))
            rows.append((times.of(end_point), *(value_at(end, end_point) for end in outputs)))
    return outputs, rows


class _Times:
    """The communication points of a run."""

    def __init__(self, start: float, step_size: float, last: int, stop: float) -> None:
        self.start, self.step_size, self.last, self.stop = start, step_size, last, stop

    def of(self, point: int) -> float:
        return self.start + point * self.step_size

    def stop_for(self, points: int) -> float:
        """The stop time that an FMU is told: not before the end of its last step (docs/adr/0014)."""
        last_begin = self.of((self.last // points - 1) * points)
        return max(self.stop, last_begin + points * self.step_size)


# --- the order


def _delays(system: FlatSystem, algorithm: str) -> dict[End, int]:
    if algorithm == "jacobi":
        return dict.fromkeys((flow.target for flow in system.flows), 1)
    flows = system.flows
    for count in range(len(flows) + 1):
        for delayed in sorted(combinations(range(len(flows)), count), reverse=True):
            edges = [(f.source[0], f.target[0]) for number, f in enumerate(flows) if number not in delayed]
            if not any(source in _reached(target, edges) for source, target in edges):
                return {flow.target: int(number in delayed) for number, flow in enumerate(flows)}
    raise AssertionError


def _in_mesh_order(system: FlatSystem) -> FlatSystem:
    """The connections that gauss_seidel delays are last, if more of them closed a cycle of those in front."""
    fewest = _delays(system, "gauss_seidel")
    kept: list[tuple[Path_, Path_]] = []
    for flow in system.flows:
        if flow.source[0] not in _reached(flow.target[0], kept):
            kept.append((flow.source[0], flow.target[0]))
    if len(kept) + sum(fewest.values()) == len(system.flows):
        return system
    return replace(system, flows=sorted(system.flows, key=lambda flow: fewest[flow.target]))


def _order(system: FlatSystem, delays: Mapping[End, int]) -> list[Path_]:
    edges = [(flow.source[0], flow.target[0]) for flow in system.flows if delays[flow.target] == 0]
    order: list[Path_] = []
    while len(order) < len(system.fmus):
        order.append(
            next(
                path
                for path in system.fmus
                if path not in order and all(source in order for source, target in edges if target == path)
            )
        )
    return order


def _reached(start: V, edges: Sequence[tuple[V, V]]) -> set[V]:
    """What is reached from ``start``, and ``start``."""
    found, new = {start}, [start]
    while new:
        at = new.pop()
        for source, target in edges:
            if source == at and target not in found:
                found.add(target)
                new.append(target)
    return found


# --- Initialization Mode


def _initialize(system: FlatSystem, running: Mapping[Path_, _Running], delays: Mapping[End, int]) -> None:
    """Read all connected outputs, one level after the other, and give them to the inputs; then leave the mode."""
    connected = list(dict.fromkeys(flow.source for flow in system.flows))
    dependent = {
        flow.target: [end for end in connected if end[0] == flow.target[0] and _depends(system, end, flow.target[1])]
        for flow in system.flows
    }
    edges = [(flow.source, target) for flow in system.flows for target in dependent[flow.target]]
    known: dict[End, Value] = {}
    settled: set[End] = set()

    def read(ends: Sequence[End], assumed: Mapping[End, Value], into: dict[End, Value]) -> None:
        """Read outputs of one level, after everything known was set in their FMUs."""
        found = {}
        for path in dict.fromkeys(end[0] for end in ends):
            _give(
                system, running, path, into, {end: value for end, value in assumed.items() if end[0] == path}, settled
            )
            found.update({end: running[path].get(end[1]) for end in ends if end[0] == path})
        into.update(found)

    for singles, loops in _by_depth(connected, edges):
        read(singles, {}, known)
        for loop in loops:
            own = [flow for flow in system.flows if flow.source in loop]
            torn = _torn(own, dependent, loop, delays)
            kept = [
                (flow.source, end) for flow in own if flow not in torn for end in dependent[flow.target] if end in loop
            ]
            levels = [level for level, _ in _by_depth(loop, kept)]
            assumed = {flow.target: _start(system, flow.target) for flow in torn}
            for _ in range(_SWEEPS):
                swept = dict(known)
                for level in levels:
                    read(level, assumed, swept)
                brought = {flow.target: flow.change.of(swept[flow.source]) for flow in torn}
                if all(_agree(assumed[end], new) for end, new in brought.items()):
                    break
                assumed = brought
            else:
                raise ValueError(f"the loop {loop} does not converge")
            known.update({end: swept[end] for end in loop})
            settled |= assumed.keys()
    for path in running:
        _give(system, running, path, known, {}, settled)
    for fmu in running.values():
        fmu.leave_initialization()


def _give(
    system: FlatSystem,
    running: Mapping[Path_, _Running],
    path: Path_,
    known: Mapping[End, Value],
    assumed: Mapping[End, Value],
    settled: set[End],
) -> None:
    for flow in system.flows:
        if flow.target[0] != path:
            continue
        if flow.target in assumed:
            running[path].set(flow.target[1], assumed[flow.target])
        elif flow.source in known and flow.target not in settled:
            running[path].set(flow.target[1], flow.change.of(known[flow.source]))


def _torn(
    own: Sequence[Flow], dependent: Mapping[End, Sequence[End]], loop: Sequence[End], delays: Mapping[End, int]
) -> list[Flow]:
    """The connections that close the cycles of a loop, if those without a delay are looked at first."""
    torn: list[Flow] = []
    kept: list[tuple[End, End]] = []
    for flow in sorted(own, key=lambda flow: delays[flow.target]):
        targets = [end for end in dependent[flow.target] if end in loop]
        if any(flow.source in _reached(end, kept) for end in targets):
            torn.append(flow)
        else:
            kept += [(flow.source, end) for end in targets]
    return [flow for flow in own if flow in torn]


def _by_depth(ends: Sequence[End], edges: Sequence[tuple[End, End]]) -> Iterator[tuple[list[End], list[list[End]]]]:
    """Outputs whose sources have all been before: those without a cycle, and the loops."""
    reached = {end: _reached(end, [(source, target) for source, target in edges]) for end in ends}
    loops = {end: [other for other in ends if other in reached[end] and end in reached[other]] for end in ends}
    done: set[End] = set()
    while len(done) < len(ends):
        ready = [
            end
            for end in ends
            if end not in done
            and all(source in done or source in loops[end] for source, target in edges if target in loops[end])
        ]
        cyclic = [end for end in ready if len(loops[end]) > 1 or (end, end) in edges]
        yield [end for end in ready if end not in cyclic], [loops[end] for end in cyclic if end == loops[end][0]]
        done |= {*ready}


def _depends(system: FlatSystem, output: End, known: str) -> bool:
    """Whether an output depends on a variable of its FMU before the first point (FMI 2.0, 2.2.8; FMI 1.0, 3.3)."""
    fmu = system.fmus[output[0]]
    if fmu.description.fmiVersion == "1.0":
        dependencies = fmu.direct_dependencies.get(output[1])
        return dependencies is None or known in dependencies
    for unknown in fmu.description.initialUnknowns:
        if unknown.variable is not None and unknown.variable.name == output[1]:
            return unknown.dependencies is None or known in [variable.name for variable in unknown.dependencies]
    return False


def _start(system: FlatSystem, end: End) -> Value:
    fmu = system.fmus[end[0]]
    variable = fmu.variables[end[1]]
    if end[1] in fmu.start_values:
        return fmu.start_values[end[1]]
    match variable.type:
        case "Real" | "Float64" | "Float32":
            return float(variable.start or 0.0)
        case "Boolean":
            return variable.start in ("true", "1")
        case "String":
            return str(variable.start or "")
        case _:
            return int(variable.start or 0)


def _agree(old: Value, new: Value) -> bool:
    if isinstance(new, float):
        return math.isfinite(new) and abs(new - float(old)) <= _TOLERANCE * max(1.0, abs(new))
    return old == new


# --- the FMUs


@contextmanager
def _opened(system: FlatSystem, times: _Times, points: Mapping[Path_, int]) -> Iterator[dict[Path_, _Running]]:
    """All FMUs in Initialization Mode."""
    running: dict[Path_, _Running] = {}
    with tempfile.TemporaryDirectory() as folder:
        try:
            for number, (path, fmu) in enumerate(system.fmus.items()):
                unpacked = Path(folder) / str(number)
                fmpy.extract(str(fmu.file), str(unpacked))
                running[path] = _class_of(fmu)(fmu, str(unpacked))
                running[path].enter_initialization(times.start, times.stop_for(points[path]))
                running[path].only_at_the_start = [
                    flow
                    for flow in system.flows
                    if flow.target[0] == path and fmu.variables[flow.target[1]].causality not in (None, "input")
                ]
            yield running
        finally:
            for one in running.values():
                one.close()


def _class_of(fmu: Fmu) -> type[_Running]:
    version = fmu.description.fmiVersion
    if fmu.kind == "model_exchange":
        return {"2.0": _Fmi2Model}[version]
    return {"1.0": _Fmi1, "2.0": _Fmi2, "3.0": _Fmi3}[version]


def _outputs_of(fmu: Fmu) -> list[str]:
    return [name for name, variable in fmu.variables.items() if variable.causality == "output"]


class _Running:
    """One FMU, by the names of its variables."""

    fmu: Any
    only_at_the_start: list[Flow]

    def __init__(self, fmu: Fmu, folder: str) -> None:
        self.of = fmu
        self.variables = fmu.variables
        tolerance = fmu.description.defaultExperiment.tolerance if fmu.description.defaultExperiment else None
        self.tolerance = None if tolerance is None else float(tolerance)
        kind = fmu.description.modelExchange if fmu.kind == "model_exchange" else fmu.description.coSimulation
        self.fmu = self.make()(
            guid=fmu.description.guid,
            modelIdentifier=kind.modelIdentifier,
            unzipDirectory=folder,
            instanceName=name_of(fmu.path),
        )
        self.instantiate()

    def make(self) -> type[Any]:
        """The class of FMPy."""
        raise NotImplementedError

    def instantiate(self) -> None:
        self.fmu.instantiate()

    def enter_initialization(self, start: float, stop: float) -> None:
        self.fmu.setupExperiment(tolerance=self.tolerance, startTime=start, stopTime=stop)
        for name, value in self.of.start_values.items():
            self.set(name, value)
        self.fmu.enterInitializationMode()

    def leave_initialization(self) -> None:
        self.fmu.exitInitializationMode()

    def get(self, name: str) -> Value:
        type_, reference = self.variables[name].type, [self.variables[name].valueReference]
        match type_:
            case "Real":
                return float(self.fmu.getReal(reference)[0])
            case "Boolean":
                return bool(self.fmu.getBoolean(reference)[0])
            case "String":
                return str(self.fmu.getString(reference)[0].decode())
            case _:
                return int(self.fmu.getInteger(reference)[0])

    def set(self, name: str, value: Value) -> None:
        type_, reference = self.variables[name].type, [self.variables[name].valueReference]
        match type_:
            case "Real":
                self.fmu.setReal(reference, [float(value)])
            case "Boolean":
                self.fmu.setBoolean(reference, [bool(value)])
            case "String":
                self.fmu.setString(reference, [str(value)])
            case _:
                self.fmu.setInteger(reference, [int(value)])

    def take(self, name: str, value: Value) -> None:
        """A value for the next step."""
        self.set(name, value)

    def step(self, begin: float, end: float, size: float) -> None:  # noqa: ARG002  model exchange needs the end
        self.fmu.doStep(currentCommunicationPoint=begin, communicationStepSize=size)

    def close(self) -> None:
        self.fmu.terminate()
        self.fmu.freeInstance()


class _Fmi1(_Running):
    """FMI 1.0 has no Initialization Mode: the FMU is initialized when the first value is read."""

    initialized = False

    def make(self) -> type[Any]:
        return FMU1Slave  # type: ignore[no-any-return]  # FMPy is untyped

    def enter_initialization(self, start: float, stop: float) -> None:
        self.times = start, stop
        for name, value in self.of.start_values.items():
            self.set(name, value)

    def leave_initialization(self) -> None:
        if not self.initialized:
            self.initialized = True
            self.fmu.initialize(tStart=self.times[0], stopTime=self.times[1])

    def get(self, name: str) -> Value:
        self.leave_initialization()
        return self._signed(name, super().get(name))

    def set(self, name: str, value: Value) -> None:
        super().set(name, self._signed(name, value))

    def _signed(self, name: str, value: Value) -> Value:
        if name not in self.of.negated or isinstance(value, str):
            return value
        return not value if isinstance(value, bool) else -value


class _Fmi2(_Running):
    def make(self) -> type[Any]:
        return FMU2Slave  # type: ignore[no-any-return]  # FMPy is untyped


class _Fmi3(_Running):
    def make(self) -> type[Any]:
        return FMU3Slave  # type: ignore[no-any-return]  # FMPy is untyped

    def enter_initialization(self, start: float, stop: float) -> None:
        for name, value in self.of.start_values.items():
            self.set(name, value)
        self.fmu.enterInitializationMode(tolerance=self.tolerance, startTime=start, stopTime=stop)

    def get(self, name: str) -> Value:
        type_ = self.variables[name].type.replace("Enumeration", "Int64")
        value = getattr(self.fmu, f"get{type_}")([self.variables[name].valueReference])[0]
        return value.decode() if isinstance(value, bytes) else value

    def set(self, name: str, value: Value) -> None:
        type_ = self.variables[name].type.replace("Enumeration", "Int64")
        getattr(self.fmu, f"set{type_}")([self.variables[name].valueReference], [value])


class _Fmi2Model(_Running):
    """A model with the CVode of FMPy; a changed input is an event (docs/model-exchange-and-events.md)."""

    _solver: Any = None

    def make(self) -> type[Any]:
        if self.tolerance is None:
            self.tolerance = 1e-6
        self.states = int(self.of.description.numberOfContinuousStates)
        self.indicators = int(self.of.description.numberOfEventIndicators)
        self.tells = not self.of.description.modelExchange.completedIntegratorStepNotNeeded
        self.taken: dict[str, Value] = {}
        self.used: dict[str, Value] | None = None
        return FMU2Model  # type: ignore[no-any-return]  # FMPy is untyped

    def enter_initialization(self, start: float, stop: float) -> None:
        self.time = start
        super().enter_initialization(start, stop)

    def leave_initialization(self) -> None:
        super().leave_initialization()
        self._update()

    def take(self, name: str, value: Value) -> None:
        self.taken[name] = value

    def step(self, begin: float, end: float, size: float) -> None:  # noqa: ARG002  those of co-simulation
        if self.taken and repr(self.taken) != repr(self.used):
            self.used = dict(self.taken)
            self.fmu.enterEventMode()
            for name, value in self.taken.items():
                self.set(name, value)
            self._update()
        while _later(end, self.time):
            self._advance(end)

    def _advance(self, end: float) -> None:
        target = min(end, self.next_event)
        event = False
        if _later(target, self.time):
            if self._solver is None:
                self.time = target
                self.fmu.setTime(self.time)
            else:
                self.time, event = self._solver.one_step(target)
            if self.tells:
                event = bool(self.fmu.completedIntegratorStep()[0]) or event
        if not _later(self.next_event, self.time):
            event = True
        if event:
            self.fmu.enterEventMode()
            self._update()

    def _update(self) -> None:
        again = True
        while again:
            again, _, _, _, has_next, next_time = self.fmu.newDiscreteStates()
            self.next_event = float(next_time) if has_next else math.inf
        self.fmu.enterContinuousTimeMode()
        if self._solver is None and (self.states or self.indicators):
            self._solver = _solver_of(self)
        elif self._solver is not None:
            self._solver.reset(self.time)


def _later(time: float, than: float) -> bool:
    """Whether a time is after another one by more than rounding."""
    return math.isinf(time) or time - than > 8 * math.ulp(max(abs(time), abs(than)))


def _solver_of(model: _Fmi2Model) -> Any:  # noqa: ANN401  FMPy is untyped
    from fmpy import sundials  # noqa: PLC0415  the import loads libraries

    cvode = sundials.libraries.sundials_cvode
    set_stop_time = cvode.CVodeSetStopTime
    set_stop_time.argtypes, set_stop_time.restype = [c_void_p, c_double], c_int

    class NoInput:
        def apply(self, time: float) -> None:
            """Inputs are constant between two points."""

    class Solver(sundials.CVodeSolver):  # type: ignore[misc]  # FMPy is untyped
        def one_step(self, stop: float) -> tuple[float, bool]:
            """One step of the solver, to ``stop`` at most; the time, and whether there is an event."""
            set_stop_time(self.cvode_mem, stop)
            reached = c_double(0.0)
            flag = sundials.CVode(self.cvode_mem, stop, self.x, byref(reached), 2)
            assert flag >= 0, self.error_info
            self.set_time(reached.value)
            if not self.discrete:
                self.set_x(self.px, self.nx)
            return reached.value, flag == sundials.CV_ROOT_RETURN

    fmu = model.fmu
    return Solver(
        nx=model.states,
        nz=model.indicators,
        get_x=fmu.getContinuousStates,
        set_x=fmu.setContinuousStates,
        get_dx=fmu.getDerivatives,
        get_z=fmu.getEventIndicators,
        get_nominals=fmu.getNominalsOfContinuousStates,
        set_time=fmu.setTime,
        input=NoInput(),
        startTime=model.time,
        relativeTolerance=model.tolerance,
    )


def main(arguments: Sequence[str] | None = None) -> None:
    """Write the rows of a system as CSV, every number so that it is read again as the same one."""
    parser = argparse.ArgumentParser()
    parser.add_argument("package", type=Path)
    parser.add_argument("rows", type=Path)
    parser.add_argument("--ssd", default="SystemStructure.ssd")
    parser.add_argument("--step-size", type=float)
    parser.add_argument("--stop-time", type=float)
    parser.add_argument("--algorithm", default="jacobi")
    given = parser.parse_args(arguments)
    with tempfile.TemporaryDirectory() as folder:
        system = read_system(given.package, Path(folder), given.ssd)
        step_size: float | None = given.step_size or system.step_size
        stop_time: float | None = given.stop_time or system.stop_time
        if step_size is None or stop_time is None:
            parser.error("the system has no step size or no stop time: --step-size, --stop-time")
        outputs, rows = run_system(system, step_size=step_size, stop_time=stop_time, algorithm=given.algorithm)
    with given.rows.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(["time", *(f"{name_of(path)}.{name}" for path, name in outputs)])
        writer.writerows([_written(value) for value in row] for row in rows)


def _written(value: Value) -> str:
    """A value as in the result files of the package."""
    return str(value).lower() if isinstance(value, bool) else repr(value) if isinstance(value, float) else str(value)


if __name__ == "__main__":
    main()
