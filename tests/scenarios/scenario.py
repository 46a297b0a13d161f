"""The execution graph of a small system as text: which instance takes which step with values of which points.

A scenario is a few connections between test doubles whose only output is the point they are at. So an input tells which
point it came from, and a line says `c: 2 -> 3 uses a@3, b@2`.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import msgspec

from fmu_mesh.config.instance_sections import KIND, Extrapolation
from fmu_mesh.config.mesh import Config
from fmu_mesh.instances.registry import decode_section
from fmu_mesh.rings.ring import Ring
from fmu_mesh.simtime import TimeGrid
from fmu_mesh.system.connections import Connection
from fmu_mesh.system.plan import Plan, make_plan
from fmu_mesh.system.records import RecordPlan
from fmu_mesh.system.system import ResolvedSystem, SystemInstance
from fmu_mesh.variables.model_description import ModelDescription, Value, Variable
from tests.plain_run import PlainRun
from tests.scenarios.simulated import SimulatedMesh

__all__ = ["Counter", "Scenario", "text", "variable"]

_STEP = re.compile(r"(\w+): (\d+) -> (\d+)(?: uses (.*))?")
_CONNECTION = re.compile(r"(\w+) -> (\w+)(?: \(delay ([01])\))?")


def variable(name: str, causality: str, **more: object) -> Variable:
    """A continuous Real variable."""
    return Variable(name, 0, "Float64", causality, "continuous", **more)  # type: ignore[arg-type] # chosen by the tests


def text(lines: Sequence[str]) -> str:
    """Lines as they stand in a test."""
    return "".join(f"{line}\n" for line in lines)


@dataclass(frozen=True)
class Scenario:
    """A system of counters.

    Attributes:
        connections: `a -> b`, or `a -> b (delay 1)`.
        points: the last point.
        algorithm: `gauss_seidel` or `jacobi`.
        steps: base points per own step, where it is not 1.
        feedthrough: instances whose initial output depends on their inputs.
        extrapolation: of all connections.
    """

    connections: Sequence[str]
    points: int = 2
    algorithm: str = "gauss_seidel"
    steps: Mapping[str, int] = field(default_factory=dict)
    feedthrough: str = ""
    extrapolation: Extrapolation = "hold"

    def plan(self, *, groups: Mapping[str, str] | None = None, window: int = 16, record: bool = False) -> Plan:
        """The plan, with instances placed in groups."""
        ends = [match.groups() for c in self.connections if (match := _CONNECTION.fullmatch(c))]
        assert len(ends) == len(self.connections), self.connections
        names = sorted({name for source, target, _ in ends for name in (source, target)})
        config = msgspec.convert(
            {
                "mesh": "scenario",
                "simulation": {"stop_time": self.points, "step_size": 1.0, "algorithm": self.algorithm},
                "instances": {name: {KIND: "fmu", "fmu": "none.fmu"} for name in names},
            },
            Config,
            dec_hook=decode_section,
        )
        descriptions = {name: self._description(name, [s for s, t, _ in ends if t == name]) for name in names}
        system = ResolvedSystem(
            config=config,
            grid=TimeGrid(0.0, 1.0, self.points),
            instances={
                name: SystemInstance(
                    name=name,
                    fmu="none.fmu",
                    description=descriptions[name],
                    start_values={},
                    step_points=self.steps.get(name, 1),
                    node=(groups or {}).get(name, name),
                )
                for name in names
            },
            connections=tuple(
                Connection(
                    source,
                    descriptions[source].variables[-1],
                    target,
                    variable(source, "input"),
                    1.0,
                    0.0,
                    int(delay) if delay else None,
                    f"connections[{index}]",
                    self.extrapolation,
                )
                for index, (source, target, delay) in enumerate(ends)
            ),
            records=(RecordPlan("none.csv", tuple((name, "point") for name in names)),) if record else (),
        )
        return make_plan(system, window=window)

    def in_one_loop(self) -> str:
        """The steps of the reference, in its order."""
        plan, lines = self.plan(), list[str]()
        PlainRun(plan, open_instance=lambda name: Counter(plan, name, steps=lines)).run()
        return text(lines)

    def initialization(self) -> str:
        """The calls of Initialization Mode, in the order of the reference."""
        plan, lines = self.plan(), list[str]()
        PlainRun(plan, open_instance=lambda name: Counter(plan, name, initialization=lines)).run()
        return text(lines)

    def initialization_on_nodes(self, *, seed: int = 0) -> dict[str, list[str]]:
        """The calls of Initialization Mode by instance, each a node of its own."""
        plan, lines = self.plan(), list[str]()
        SimulatedMesh(plan, lambda name: Counter(plan, name, initialization=lines), seed).run()
        calls: dict[str, list[str]] = {}
        for name, _, call in (line.partition(": ") for line in lines):
            calls.setdefault(name, []).append(call)
        return calls

    def on_nodes(
        self, *, groups: Mapping[str, str] | None = None, window: int = 16, seed: int = 0, record: bool = False
    ) -> list[str]:
        """The steps of simulated nodes, in the order of this seed."""
        plan, lines = self.plan(groups=groups, window=window, record=record), list[str]()
        SimulatedMesh(plan, lambda name: Counter(plan, name, steps=lines), seed).run()
        return lines

    def grouped(self, groups: Mapping[str, str] | None = None) -> str:
        """The steps of one node with window 1: by default, all instances are in it."""
        plan = self.plan()
        one = dict.fromkeys(plan.order, "group")
        return text(self.on_nodes(groups=one if groups is None else groups, window=1))

    def assert_the_same_on_any_nodes(self) -> None:
        """Each instance takes the steps of the reference, whatever the placement, the window and the delays."""
        names = self.plan().order
        expected = _by_instance(self.in_one_loop().splitlines())
        placements: list[dict[str, str]] = [
            {},
            dict.fromkeys(names, "all"),
            {name: f"pair{number // 2}" for number, name in enumerate(names)},
            {name: f"pair{number % 2}" for number, name in enumerate(names)},
        ]
        for number, groups in enumerate(placements):
            for window in (1, 2, 64):
                for seed in range(3):
                    lines = self.on_nodes(groups=groups, window=window, seed=seed, record=bool(number % 2))
                    assert _by_instance(lines) == expected, (groups, window, seed)
                    _assert_causal(lines)

    def _description(self, name: str, sources: Sequence[str]) -> ModelDescription:
        dependencies = None if name in self.feedthrough else ()
        return ModelDescription(
            model_name="Counter",
            model_identifier="Counter",
            fmi_version="2.0",
            kind="co_simulation",
            guid="{1}",
            variables=(
                *(variable(source, "input") for source in sources),
                variable("point", "output", dependencies=dependencies),
            ),
        )


class Counter:
    """An instance whose output is the point it is at; writes down what is asked of it.

    Args:
        steps: takes a line per step.
        initialization: takes a line per call in Initialization Mode.
    """

    def __init__(
        self, plan: Plan, name: str, *, steps: list[str] | None = None, initialization: list[str] | None = None
    ) -> None:
        instance = plan.system.instances[name]
        self.description = instance.description
        self._name = name
        self._points = instance.step_points
        self._steps = steps if steps is not None else []
        self._initialization = initialization if initialization is not None else []
        self._inputs = self._outputs = Ring(plan.nodes[instance.node].instances[0].outputs, 1)

    def enter_initialization(
        self, _start_time: float, _stop_time: float | None, _start_values: Mapping[str, Value]
    ) -> None:
        self._initialization.append(f"{self._name}: enter")

    def exit_initialization(self) -> None:
        self._initialization.append(f"{self._name}: exit")

    def set_values(self, values: Mapping[str, Value]) -> None:
        self._initialization.append(f"{self._name}: set {', '.join(values)}")

    def get_values(self, names: Sequence[str]) -> list[Value]:
        self._initialization.append(f"{self._name}: get {', '.join(names)}")
        return [0.0 for _ in names]

    def bind(self, inputs: Ring, outputs: Sequence[Ring], _grid: TimeGrid, _points: int, step: int = 0) -> None:
        self._inputs, self._outputs = inputs, outputs[0]
        self._write(step)

    def do_step(self, step: int) -> None:
        row = self._inputs.part("Float64")[step & self._inputs.mask]
        used = ", ".join(f"{n}@{value:g}" for n, value in zip(self._inputs.layout.names, row, strict=True))
        first = step * self._points
        self._steps.append(f"{self._name}: {first} -> {first + self._points}" + (f" uses {used}" if used else ""))
        self._write(step + 1)

    def close(self) -> None:
        return

    def _write(self, step: int) -> None:
        self._outputs.part("Float64")[step & self._outputs.mask] = step * self._points


def _by_instance(lines: Sequence[str]) -> dict[str, list[str]]:
    """The lines of each instance in their order; what runs side by side has no order."""
    steps: dict[str, list[str]] = {}
    for line in lines:
        steps.setdefault(line.partition(":")[0], []).append(line)
    return steps


def _assert_causal(lines: Sequence[str]) -> None:
    """A step that uses a value stands after the step that made it."""
    reached: dict[str, int] = {}
    for line in lines:
        match = _STEP.fullmatch(line)
        assert match is not None, line
        name, first, last, used = match.groups()
        assert reached.get(name, 0) == int(first), line
        for use in used.split(", ") if used else ():
            source, _, point = use.partition("@")
            assert int(point) <= reached.get(source, 0), line
        reached[name] = int(last)
