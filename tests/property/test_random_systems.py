"""Any system gives the reference result for any window, placement and delay of messages, in every float.

The reference is a recursion written down here from the definition of a delay, of a held value and of a fixed point; it
shares nothing with the code of the mesh but the delays and the tears, which `tests/property/test_plan.py` looks at.
"""

from __future__ import annotations

import math
import tempfile
from collections.abc import Callable, Mapping, Sequence
from functools import cache, partial
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from hypothesis import HealthCheck, event, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from fmu_mesh import files
from fmu_mesh.config.instance_sections import KIND
from fmu_mesh.config.loading import LoadedConfig
from fmu_mesh.config.mesh import Config, InitializationConfig
from fmu_mesh.errors import LoopNotConverged, StepFailed, TerminationRequested
from fmu_mesh.instances.registry import decode_section
from fmu_mesh.results.record_files import open_results
from fmu_mesh.rings import native
from fmu_mesh.rings.ring import Ring
from fmu_mesh.run.outcome import Outcome
from fmu_mesh.run.repeated import RepeatedRuns
from fmu_mesh.run.run_plan import RunPlan
from fmu_mesh.simtime import TimeGrid
from fmu_mesh.system.algebraic_loop import FixedPoint
from fmu_mesh.system.connections import Connection
from fmu_mesh.system.initialization_plan import Loop, Tear
from fmu_mesh.system.plan import Plan, make_plan
from fmu_mesh.system.records import RecordPlan
from fmu_mesh.system.system import ResolvedSystem, SystemInstance
from fmu_mesh.variables.model_description import Causality, ModelDescription, Value, Variable, VariableType
from tests.helpers import examples
from tests.plain_run import PlainRun
from tests.scenarios.simulated import SimulatedMesh

STEP_SIZE = 0.1
LARGE = 100_003
ITERATIONS = 40

Row = tuple[float, int]


class Pipe(msgspec.Struct, frozen=True):
    """A connection: from an output (`y` Real, `n` Integer) of one instance to an input of its own at another."""

    source: int
    output: str
    target: int
    real: bool
    factor: float
    offset: float
    delay: int | None


class Drawn(msgspec.Struct, frozen=True):
    """A random system; instances are numbers.

    Attributes:
        steps: base points per own step.
        groups: number of the node of each instance.
        feedthrough: whether the initial Real output depends on the inputs.
        recorded: whether `y` of every instance is recorded.
        inputs: whether all inputs are recorded, too.
        first: point of the first recorded row.
        every: points from row to row.
    """

    algorithm: str
    last_point: int
    window: int
    steps: tuple[int, ...]
    groups: tuple[int, ...]
    feedthrough: tuple[bool, ...]
    pipes: tuple[Pipe, ...]
    recorded: bool
    seed: int
    inputs: bool = False
    first: int = 0
    every: int = 1


@st.composite
def systems(draw: st.DrawFn) -> Drawn:
    count = draw(st.integers(1, 12))
    instance = st.integers(0, count - 1)
    cyclic = draw(st.booleans())
    pipes = []
    for first, second in draw(st.lists(st.tuples(instance, instance), max_size=2 * count)):
        source, target = (first, second) if cyclic else (min(first, second), max(first, second))
        if source == target and not cyclic:
            continue
        output = draw(st.sampled_from("yyn"))
        real = output == "y" or draw(st.booleans())
        scaled = real and draw(st.booleans())
        forward = source < target
        pipes.append(
            Pipe(
                source=source,
                output=output,
                target=target,
                real=real,
                factor=draw(st.floats(-2.0, 2.0)) if scaled else 1.0,
                offset=draw(st.floats(-1.0, 1.0)) if scaled else 0.0,
                delay=draw(st.sampled_from([None, None, None, 1, 0] if forward else [None, None, 1])),
            )
        )
    per_instance = {"min_size": count, "max_size": count}
    return Drawn(
        algorithm=draw(st.sampled_from(["jacobi", "gauss_seidel"])),
        last_point=draw(st.integers(0, 24)),
        window=draw(st.sampled_from([1, 1, 2, 3]) | st.integers(1, 64)),
        steps=tuple(draw(st.lists(st.sampled_from([1, 1, 2, 3, 4]), **per_instance))),  # type: ignore[arg-type] # sizes
        groups=tuple(draw(st.lists(st.integers(0, draw(instance)), **per_instance))),  # type: ignore[arg-type] # sizes
        feedthrough=tuple(draw(st.lists(st.booleans(), **per_instance))),  # type: ignore[arg-type] # sizes
        pipes=tuple(pipes),
        recorded=draw(st.booleans()),
        seed=draw(st.integers(0, 2**32)),
        inputs=draw(st.booleans()),
        first=draw(st.sampled_from([0, 0, 1, 5])),
        every=draw(st.sampled_from([1, 1, 2, 7])),
    )


@st.composite
def looped(draw: st.DrawFn) -> Drawn:
    """A system through all of whose instances a ring leads, and every first output depends on every input."""
    drawn = draw(systems())
    count = len(drawn.steps)
    factors = draw(st.lists(st.floats(-2.0, 2.0), min_size=count, max_size=count))
    ring = [
        Pipe(i, "y", (i + 1) % count, real=True, factor=factor, offset=0.0, delay=None)
        for i, factor in enumerate(factors)
    ]
    return msgspec.structs.replace(
        drawn,
        pipes=(*ring, *drawn.pipes),
        feedthrough=(True,) * count,
        last_point=min(drawn.last_point, 3),
    )


# ---- the model: a step that no other order of values gives the same result for


def start_of(number: int) -> float:
    return math.sin(number + 1.0)


def stepped(row: Row, step: int, reals: Sequence[float], integers: Sequence[int]) -> Row:
    y, n = 1.7 * row[0] + 0.3 * step, 5 * row[1] + step
    for place, value in enumerate(reals):
        y += (0.2 + 0.1 * place) * value
    for place, number in enumerate(integers):
        n += (3 + place) * number
    return math.sin(y), n % LARGE


def initial(number: int, reals: Sequence[float], *, feedthrough: bool) -> float:
    y = start_of(number)
    return y + sum(0.05 * value for value in reals) if feedthrough else y


# ---- the reference: from the definition, without the mesh


def scaled(pipe: Pipe, row: Row) -> float | int:
    value = row[0] if pipe.output == "y" else row[1]
    return value if (pipe.factor, pipe.offset) == (1.0, 0.0) else value * pipe.factor + pipe.offset


def started(drawn: Drawn, loops: Sequence[tuple[Sequence[int], Sequence[int]]]) -> list[float]:
    """The first `y` of every instance, after the iteration of each loop, whose arithmetic is tested elsewhere.

    Args:
        drawn: the system.
        loops: the pipes at which each loop is torn, and its instances; what comes first stands first.

    Raises:
        LoopNotConverged: a loop takes more than `ITERATIONS`.
    """
    known: dict[int, float] = {}
    settled: dict[int, float | int] = {}

    def brought(p: int, assumed: Mapping[int, float | int]) -> float | int:
        pipe = drawn.pipes[p]
        return scaled(pipe, (y_of(pipe.source, assumed) if pipe.output == "y" else math.nan, pipe.source))

    def y_of(i: int, assumed: Mapping[int, float | int]) -> float:
        if i in known:
            return known[i]
        own = [p for p, pipe in enumerate(drawn.pipes) if pipe.target == i and pipe.real and drawn.feedthrough[i]]
        inputs = [float(assumed[p] if p in assumed else brought(p, assumed)) for p in own]
        return initial(i, inputs, feedthrough=drawn.feedthrough[i])

    for torn, members in loops:
        tears = tuple(
            Tear(
                "",
                "",
                str(p),
                "",
                1.0,
                0.0,
                "Float64" if drawn.pipes[p].real else "Int32",
                0.0 if drawn.pipes[p].real else 0,
            )
            for p in torn
        )
        point = FixedPoint(Loop(0, 0, tears, (), ()), InitializationConfig(iterations=ITERATIONS))
        while True:
            values = (own for own in point.assumed.values() if isinstance(own, float | int))
            assumed = dict(zip(torn, values, strict=True))
            if point.update([brought(p, settled | assumed) for p in torn]):
                break
        settled |= assumed
        known |= {i: y_of(i, settled) for i in members}
    return [y_of(i, settled) for i in range(len(drawn.steps))]


def reference(drawn: Drawn, delays: Sequence[int], first: Sequence[float]) -> list[list[Row]]:
    """The outputs of every instance at its own points.

    Args:
        drawn: the system.
        delays: the delay of each pipe.
        first: the first `y` of every instance.
    """
    into = [[p for p, pipe in enumerate(drawn.pipes) if pipe.target == i] for i in range(len(drawn.steps))]

    @cache
    def row(i: int, step: int) -> Row:
        if step == 0:
            return first[i], i
        m = drawn.steps[i]
        values = []
        for p in into[i]:
            pipe = drawn.pipes[p]
            point = (step - 1) * m if delays[p] else step * m
            values.append((pipe.real, scaled(pipe, row(pipe.source, point // drawn.steps[pipe.source]))))
        reals = [float(value) for real, value in values if real]
        integers = [int(value) for real, value in values if not real]
        return stepped(row(i, step - 1), step - 1, reals, integers)

    rows: list[list[Row]] = [[] for _ in drawn.steps]
    for point in range(drawn.last_point + 1):  # in this order the recursion is never deep
        for i, m in enumerate(drawn.steps):
            if point % m == 0:
                rows[i].append(row(i, point // m))
    return rows


# ---- the same system for the mesh


def name_of(number: int) -> str:
    return f"i{number}"


def planned(drawn: Drawn) -> Plan:
    count = len(drawn.steps)

    def variable(name: str, kind: VariableType, causality: Causality, dependencies: tuple[str, ...] | None) -> Variable:
        return Variable(name, 0, kind, causality, "discrete", dependencies=dependencies)

    def kind(pipe: Pipe) -> VariableType:
        return "Float64" if pipe.real else "Int32"

    outputs = [
        {
            "y": variable("y", "Float64", "output", None if drawn.feedthrough[i] else ()),
            "n": variable("n", "Int32", "output", ()),
        }
        for i in range(count)
    ]
    inputs = {p: variable(f"u{p}", kind(pipe), "input", ()) for p, pipe in enumerate(drawn.pipes)}
    names = [name_of(i) for i in range(count)]
    recorded = tuple((name, "y") for name in names)
    if drawn.inputs:
        recorded += tuple((name_of(pipe.target), f"u{p}") for p, pipe in enumerate(drawn.pipes))
    config = msgspec.convert(
        {
            "mesh": "random",
            "simulation": {"stop_time": 1.0, "step_size": STEP_SIZE, "algorithm": drawn.algorithm},
            "instances": {name: {KIND: "fmu", "fmu": "none.fmu"} for name in names},
            "initialization": {"iterations": ITERATIONS},
        },
        Config,
        dec_hook=decode_section,
    )
    system = ResolvedSystem(
        config=config,
        grid=TimeGrid(0.0, STEP_SIZE, drawn.last_point),
        instances={
            name: SystemInstance(
                name=name,
                fmu="none.fmu",
                description=ModelDescription(
                    model_name="Mixer",
                    model_identifier="Mixer",
                    fmi_version="2.0",
                    kind="co_simulation",
                    guid="{1}",
                    variables=(
                        *outputs[i].values(),
                        *(inputs[p] for p, pipe in enumerate(drawn.pipes) if pipe.target == i),
                    ),
                ),
                start_values={},
                step_points=drawn.steps[i],
                node=f"node{drawn.groups[i]}",
            )
            for i, name in enumerate(names)
        },
        connections=tuple(
            Connection(
                source_instance=name_of(pipe.source),
                source=outputs[pipe.source][pipe.output],
                target_instance=name_of(pipe.target),
                target=inputs[p],
                factor=pipe.factor,
                offset=pipe.offset,
                delay=pipe.delay,
                path=f"connections[{p}]",
            )
            for p, pipe in enumerate(drawn.pipes)
        ),
        records=(RecordPlan("none.csv", recorded, drawn.first, drawn.every),) if drawn.recorded else (),
    )
    return make_plan(system, window=drawn.window)


def with_file(plan: Plan, file: Path) -> Plan:
    """The plan with its rows in this file."""
    records = tuple(msgspec.structs.replace(record, file=str(file)) for record in plan.system.records)
    return msgspec.structs.replace(plan, system=msgspec.structs.replace(plan.system, records=records))


class Mixer:
    """A test double that computes the model above on rings, and keeps its outputs."""

    def __init__(self, drawn: Drawn, plan: Plan, number: int) -> None:
        self.rows: list[Row] = []
        self.description = plan.system.instances[name_of(number)].description
        self._drawn = drawn
        self._number = number
        self._initial: dict[str, Any] = {
            v.name: 0.0 for v in self.description.variables if v.causality == "input" and v.type == "Float64"
        }
        self._inputs: dict[str, Any] = {v.name: 0 for v in self.description.variables if v.causality == "input"}
        self._rings: tuple[Ring, Ring] | None = None

    def enter_initialization(
        self, _start_time: float, _stop_time: float | None, _start_values: Mapping[str, Value]
    ) -> None:
        return

    def exit_initialization(self) -> None:
        return

    def set_values(self, values: Mapping[str, Value]) -> None:
        self._initial.update({name: value for name, value in values.items() if name in self._initial})
        self._inputs.update(values)

    def get_values(self, names: Sequence[str]) -> list[Value]:
        row = self._initial_row()
        return [self._inputs[name] if name in self._inputs else row[name != "y"] for name in names]

    def bind(self, inputs: Ring, outputs: Sequence[Ring], _grid: TimeGrid, _points: int, step: int = 0) -> None:
        self._rings = inputs, outputs[0]
        self.rows.append(self._initial_row())
        self._write(step)

    def do_step(self, step: int) -> None:
        assert self._rings is not None
        inputs, _ = self._rings
        slot = step & inputs.mask
        reals, integers = inputs.part("Float64")[slot].tolist(), inputs.part("Int32")[slot].tolist()
        self.rows.append(stepped(self.rows[-1], step, reals, integers))
        self._inputs.update({name: inputs.value(step, name) for name in inputs.layout.names})
        self._write(step + 1)

    def close(self) -> None:
        return

    def _initial_row(self) -> Row:
        values = [float(value) for value in self._initial.values()]
        return initial(self._number, values, feedthrough=self._drawn.feedthrough[self._number]), self._number

    def _write(self, step: int) -> None:
        assert self._rings is not None
        outputs = self._rings[1]
        for name in outputs.layout.names:
            outputs.put(step, name, self._inputs[name] if name in self._inputs else self.rows[-1][name != "y"])


def expected_of(drawn: Drawn, plan: Plan) -> list[list[Row]]:
    loops = [
        ([int(tear.input[1:]) for tear in loop.tears], [int(instance[1:]) for instance, _ in loop.outputs])
        for loop in plan.initialization.loops
    ]
    return reference(drawn, [connection.delay or 0 for connection in plan.connections], started(drawn, loops))


def run(drawn: Drawn, plan: Plan, mesh: Callable[[Callable[[str], Mixer]], object]) -> list[list[Row]]:
    mixers = [Mixer(drawn, plan, number) for number in range(len(drawn.steps))]
    by_name = {name_of(number): mixer for number, mixer in enumerate(mixers)}
    mesh(by_name.__getitem__)
    return [mixer.rows for mixer in mixers]


def bits(rows: list[list[Row]]) -> list[list[tuple[str, int]]]:
    """Rows whose equality is that of every bit."""
    return [[(y.hex(), n) for y, n in own] for own in rows]


@given(systems())
@settings(max_examples=examples(150), deadline=None, suppress_health_check=[HealthCheck.too_slow])
def test_any_system_gives_the_reference_result_on_nodes(drawn: Drawn) -> None:
    assert_reference_on_nodes(drawn)


@given(looped())
@settings(max_examples=examples(60), deadline=None, suppress_health_check=[HealthCheck.too_slow])
def test_any_system_with_a_loop_at_start_gives_reference_result_on_nodes(drawn: Drawn) -> None:
    assert_reference_on_nodes(drawn)


def assert_reference_on_nodes(drawn: Drawn) -> None:
    plan = planned(drawn)
    meshes: list[SimulatedMesh] = []

    def simulate(open_instance: Callable[[str], Mixer]) -> None:
        meshes.append(SimulatedMesh(plan, open_instance, drawn.seed))
        meshes[0].run()

    try:
        expected = expected_of(drawn, plan)
    except LoopNotConverged:
        event("not converged")
        with pytest.raises(LoopNotConverged, match=f"did not converge at the start: after {ITERATIONS} iterations"):
            run(drawn, plan, simulate)
        return

    result = run(drawn, plan, simulate)

    assert bits(result) == bits(expected)
    for name, rows in meshes[0].recorded.items():
        assert np.array_equal(column(rows), np.array([y for y, _ in expected[int(name[1:])]])), name
    event("cycles" if plan.cycles else "no cycle")
    event(f"{len(plan.initialization.loops)} loops at the start")


@given(systems())
@settings(max_examples=examples(100), deadline=None)
def test_any_system_gives_the_reference_result_in_one_process(drawn: Drawn) -> None:
    drawn = msgspec.structs.replace(drawn, recorded=False)
    plan = planned(drawn)
    try:
        expected = expected_of(drawn, plan)
    except LoopNotConverged:
        with pytest.raises(LoopNotConverged):
            run(drawn, plan, lambda open_instance: PlainRun(plan, open_instance=open_instance).run())
        return

    result = run(drawn, plan, lambda open_instance: PlainRun(plan, open_instance=open_instance).run())

    assert bits(result) == bits(expected)


class Kept:
    """A result file that keeps what it gets."""

    path = Path("kept.csv")
    kept = files.Kept()

    def __init__(self) -> None:
        self.columns: list[list[NDArray[Any]]] = []
        self.rows = 0

    def write(self, times: NDArray[np.float64], columns: Sequence[NDArray[Any]]) -> None:
        self.columns.append([np.array(column) for column in (times, *columns)])
        self.rows += len(times)

    def note(self, entry: Mapping[str, Any]) -> None:  # noqa: ARG002  it keeps rows only
        return

    def flush(self) -> None:
        return

    def close(self) -> None:
        return


LIBRARIES = pytest.mark.parametrize(
    "library",
    [pytest.param(True, marks=pytest.mark.skipif(native.library is None, reason="no library")), False],
    ids=["C", "Python"],
)


@LIBRARIES
@given(st.one_of(systems(), looped()))
@settings(max_examples=examples(100), deadline=None, suppress_health_check=[HealthCheck.too_slow])
def test_any_system_gives_the_reference_result_in_each_of_many_runs(library: bool, drawn: Drawn) -> None:  # noqa: FBT001 a parameter of tests
    plan = planned(drawn)
    run_plan = RunPlan(LoadedConfig(plan.system.config, Path()), plan, {})
    opened: dict[str, Mixer] = {}

    def open_instance(name: str) -> Mixer:
        opened[name] = Mixer(drawn, plan, int(name[1:]))
        return opened[name]

    with pytest.MonkeyPatch.context() as patch, tempfile.TemporaryDirectory() as folder:
        if not library:
            patch.setattr(native, "library", None)
        runs = RepeatedRuns(Path(folder), open_instance=open_instance)
        try:
            expected = expected_of(drawn, plan)
        except LoopNotConverged:
            expected = []
        for _ in range(2):
            kept = Kept()
            files = partial(list[Kept], [kept] if drawn.recorded else [])
            if not expected:
                with pytest.raises(LoopNotConverged):
                    runs.run(run_plan, files)
                continue
            outcome = runs.run(run_plan, files)

            rows = len(range(drawn.first, drawn.last_point + 1, drawn.every)) if drawn.recorded else 0
            assert (outcome.point, outcome.rows) == (drawn.last_point, rows)
            assert bits([opened[name_of(number)].rows for number in range(len(drawn.steps))]) == bits(expected)
            if drawn.recorded:
                columns = [np.concatenate(parts) for parts in zip(*kept.columns, strict=True)]
                delays = [connection.delay or 0 for connection in plan.connections]
                assert_recorded(drawn, delays, expected, columns)
        runs.close()


class Ending(Mixer):
    """A mixer that fails in one of its steps, or asks to end the simulation there."""

    def __init__(self, drawn: Drawn, plan: Plan, number: int, end: tuple[int, bool] | None) -> None:
        super().__init__(drawn, plan, number)
        self._end = end

    def do_step(self, step: int) -> None:
        if self._end is not None and step == self._end[0]:
            name = name_of(self._number)
            raise (
                StepFailed("it fails here", instance=name) if self._end[1] else TerminationRequested("", instance=name)
            )
        super().do_step(step)


@st.composite
def ending_systems(draw: st.DrawFn) -> tuple[Drawn, list[tuple[int, bool] | None]]:
    """A system, and of each instance the step in which it ends, if it does, and whether it fails there."""
    drawn = msgspec.structs.replace(draw(systems()), recorded=True)
    end = st.none() | st.tuples(st.integers(0, 12), st.booleans())
    return drawn, [draw(end) for _ in drawn.steps]


@pytest.mark.parametrize("slow", [False, True])
@LIBRARIES
@given(ending_systems())
@settings(max_examples=examples(100), deadline=None, suppress_health_check=[HealthCheck.too_slow])
def test_many_runs_end_where_a_run_point_by_point_ends(
    library: bool,  # noqa: FBT001 a parameter of tests
    slow: bool,  # noqa: FBT001 as above
    ending: tuple[Drawn, list[tuple[int, bool] | None]],
) -> None:
    """``slow``: each step takes longer than a slice, so instances are at several points when one ends."""
    drawn, ends = ending
    plan = planned(drawn)

    def instance(name: str) -> Ending:
        return Ending(drawn, plan, int(name[1:]), ends[int(name[1:])])

    def ended(run: Callable[[], Outcome]) -> tuple[object, ...]:
        try:
            outcome = run()
        except StepFailed as error:
            return error.instance, error.point, error.time
        return outcome.state, outcome.point, outcome.time, outcome.ended_by

    def written() -> bytes | None:
        """What is in the file, if a row was written."""
        return file.read_bytes() if file.is_file() else None

    with pytest.MonkeyPatch.context() as patch, tempfile.TemporaryDirectory() as folder:
        if not library:
            patch.setattr(native, "library", None)
        if slow:
            patch.setattr("fmu_mesh.run.repeated._SLICE_S", 1e-7)
        file = Path(folder, "rows.csv")
        plan = with_file(plan, file)
        loaded = LoadedConfig(plan.system.config, Path())
        expected = ended(PlainRun(plan, open_instance=instance, loaded=loaded).run), written()
        runs = RepeatedRuns(Path(folder), open_instance=instance)
        run_plan = RunPlan(loaded, plan, {})
        for _ in range(2):
            found = ended(lambda: runs.run(run_plan, lambda: open_results(loaded, plan.system)))
            assert (found, written()) == expected
        runs.close()
    event("ended early" if len(expected[0]) == 3 or expected[0][3] is not None else "to the end")


def assert_recorded(
    drawn: Drawn, delays: Sequence[int], expected: list[list[Row]], columns: list[NDArray[Any]]
) -> None:
    """The times, then `y` of every instance, which holds between its own points, then the inputs.

    An input has the value that the last own step used; what it has at the start, others look at.
    """
    points = range(drawn.first, drawn.last_point + 1, drawn.every)
    if not points:
        assert columns == []
        return
    assert columns[0].tolist() == [point * STEP_SIZE for point in points]
    outputs, inputs = columns[1 : 1 + len(drawn.steps)], columns[1 + len(drawn.steps) :]
    for found, rows, own in zip(outputs, expected, drawn.steps, strict=True):
        assert [y.hex() for y in found.tolist()] == [rows[point // own][0].hex() for point in points]
    for p, found in enumerate(inputs):
        pipe = drawn.pipes[p]
        own, source = drawn.steps[pipe.target], drawn.steps[pipe.source]
        for value, point in zip(found.tolist(), points, strict=True):
            if step := point // own:
                used = (step - 1) * own if delays[p] else step * own
                assert value == scaled(pipe, expected[pipe.source][used // source])
    assert len(inputs) == (len(drawn.pipes) if drawn.inputs else 0)


@pytest.mark.parametrize("window", [1, 7, 256])
def test_a_chain_of_eight_with_a_slow_last_node_runs_through(window: int) -> None:
    pipes = tuple(Pipe(i, "y", i + 1, real=True, factor=1.0, offset=0.0, delay=None) for i in range(7))
    drawn = Drawn(
        algorithm="gauss_seidel",
        last_point=300,
        window=window,
        steps=(1,) * 8,
        groups=tuple(range(8)),
        feedthrough=(False,) * 8,
        pipes=pipes,
        recorded=True,
        seed=window,
    )
    plan = planned(drawn)

    def simulate(open_instance: Callable[[str], Mixer]) -> None:
        mesh = SimulatedMesh(plan, open_instance, drawn.seed)
        mesh.slow_down("node7", 1000.0)
        mesh.run()

    assert bits(run(drawn, plan, simulate)) == bits(expected_of(drawn, plan))


def column(rows: list[NDArray[np.float64]]) -> NDArray[np.float64]:
    return np.array([row[0] for row in rows])
