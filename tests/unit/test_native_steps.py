"""A step as one call of the library: the order of the calls, what a status does, and the same rows as call by call."""

from __future__ import annotations

import ctypes
import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fmu_mesh.config.mesh import TimeoutsConfig
from fmu_mesh.errors import FmuError, StepFailed, TerminationRequested
from fmu_mesh.instances.call_guard import Guarded, Unwatched
from fmu_mesh.instances.contract import LogMessage, StepsNatively
from fmu_mesh.instances.fmi.archive.reading import read_description
from fmu_mesh.instances.fmi.fmu_instance import FmuInstance
from fmu_mesh.instances.fmi.native_instance import NativeInstance
from fmu_mesh.instances.fmi.opening import open_instance
from fmu_mesh.instances.fmi.step_options import StepOptions
from fmu_mesh.rings import native
from fmu_mesh.rings.native import (
    NEVER,
    STAGE_BITS,
    Call,
    MemberTable,
    Move,
    NativeStep,
    OutputTable,
    RowBase,
    Said,
    Stage,
    StepKind,
)
from fmu_mesh.rings.ring import Ring
from fmu_mesh.simtime import TimeGrid
from fmu_mesh.system.layout import Layout
from fmu_mesh.variables.model_description import Variable
from fmu_mesh.variables.value_types import INTEGERS, Value, VariableType, is_text
from tests.fmus.event_fmus import Version, build_event_fmu
from tests.fmus.helpers import NO_COMPILER, find_fmu

pytestmark = pytest.mark.skipif(native.library is None, reason="the library with the burst is not built here")
needs_compiler = pytest.mark.skipif(NO_COMPILER is not None, reason=str(NO_COMPILER))

COMPONENT = 4711
SETTER = ctypes.CFUNCTYPE(ctypes.c_int, ctypes.c_void_p, ctypes.c_void_p, ctypes.c_size_t, ctypes.c_void_p)
SETTER_3 = ctypes.CFUNCTYPE(
    ctypes.c_int, ctypes.c_void_p, ctypes.c_void_p, ctypes.c_size_t, ctypes.c_void_p, ctypes.c_size_t
)
DO_STEP: dict[StepKind, Any] = {
    StepKind.FMI1: ctypes.CFUNCTYPE(ctypes.c_int, ctypes.c_void_p, ctypes.c_double, ctypes.c_double, ctypes.c_char),
    StepKind.FMI2: ctypes.CFUNCTYPE(ctypes.c_int, ctypes.c_void_p, ctypes.c_double, ctypes.c_double, ctypes.c_int),
    StepKind.FMI3: ctypes.CFUNCTYPE(
        ctypes.c_int, ctypes.c_void_p, ctypes.c_double, ctypes.c_double, ctypes.c_bool, *[ctypes.c_void_p] * 4
    ),
}
GRID = TimeGrid(0.0, 0.125, 1000)  # a power of two, because Events3 wants each step to start exactly where it is


class Recorded:
    """An FMU of four functions that notes how they are called, and returns what it is told.

    It has two setters on fixed memory, doStep, and one getter on its ring, which has four rows of eight bytes.
    """

    def __init__(self, kind: StepKind, **statuses: int) -> None:
        self.calls: list[tuple[Any, ...]] = []
        self.said = Said(quiet_until=math.inf)
        self.flag: int | None = None
        self._statuses = statuses
        self._sized = kind == StepKind.FMI3
        self._inputs, self._rows = (ctypes.c_double * 2)(), (ctypes.c_double * 4)()
        self._keep: list[Any] = []
        inputs, rows = ctypes.addressof(self._inputs), ctypes.addressof(self._rows)
        setters = [
            self._call("set_real", RowBase.FIXED, inputs, inputs, 3, 1),
            self._call("set_integer", RowBase.FIXED, inputs + 8, inputs, 5),
        ]
        getters = [self._call("get_real", RowBase.OUTPUT, 0, rows, 7, 8, 9)]
        self._keep.append(DO_STEP[kind](self._stepped))
        self.member = MemberTable(
            setters=native.table(Call, setters),
            getters=native.table(Call, getters),
            n_setters=2,
            n_getters=1,
            kind=kind,
            component=COMPONENT,
            do_step=address_of(self._keep[-1]),
            said=ctypes.addressof(self.said),
            start_time=0.5,
            base_step_size=0.1,
            step_size=0.2,
            points=2,
            outputs=(OutputTable * 2)(OutputTable(rows, 8, 3)),
            bases=(ctypes.c_void_p * RowBase.FIRST_GATE)(),
        )

    def step(self, step: int) -> tuple[int, int]:
        """The stage and the status with which the library comes back."""
        assert native.library is not None
        outcome: int = native.library.member_step(ctypes.addressof(self.member), step)
        return divmod(outcome, 1 << STAGE_BITS)

    def _call(self, name: str, base: RowBase, values: int, memory: int, *references: int) -> Call:
        array = (ctypes.c_uint * len(references))(*references)

        def moved(component: int, given: int, count: int, place: int, *size: int) -> int:
            taken = tuple(ctypes.cast(given, ctypes.POINTER(ctypes.c_uint))[:count])
            self.calls.append((name, component, taken, (place - memory) // 8, *size))
            return self._statuses.get(name, 0)

        function = (SETTER_3 if self._sized else SETTER)(moved)
        self._keep += [array, function]
        return Call(
            address_of(function), ctypes.addressof(array), len(references), base, values, 6 if self._sized else -1
        )

    def _stepped(self, component: int, time: float, step_size: float, last: Any, *results: int) -> int:  # noqa: ANN401 a type of C
        self.calls.append(("step", component, time, step_size, last))
        if self._sized:
            assert results == self.said.addresses
            assert not self.said.anything
            if self.flag is not None:
                ctypes.c_bool.from_address(results[self.flag]).value = True
        return self._statuses.get("step", 0)


def address_of(function: Any) -> int:  # noqa: ANN401 a function of ctypes
    return ctypes.cast(function, ctypes.c_void_p).value or 0


def calls_of(kind: StepKind) -> list[tuple[Any, ...]]:
    """What the FMU notes in own step 5, whose outputs are row 6: in slot 2."""
    size = (6,) if kind == StepKind.FMI3 else ()
    return [
        ("set_real", COMPONENT, (3, 1), 0, *size),
        ("set_integer", COMPONENT, (5,), 1, *size),
        ("step", COMPONENT, 1.5, 0.2, b"\x01" if kind == StepKind.FMI1 else 1),
        ("get_real", COMPONENT, (7, 8, 9), 2, *size),
    ]


@pytest.mark.parametrize("kind", DO_STEP)
def test_all_functions_are_called_in_their_order_on_their_memory(kind: StepKind) -> None:
    recorded = Recorded(kind, set_real=1, step=1)  # a warning changes nothing

    assert recorded.step(5) == (0, 0)
    assert recorded.calls == calls_of(kind)
    assert (recorded.said.step, recorded.said.time) == (6, 0.5 + 12 * 0.1)
    assert recorded.member.stage == Stage.WAITING


@pytest.mark.parametrize("kind", DO_STEP)
@pytest.mark.parametrize(
    ("name", "status", "stage", "calls", "number"),
    [
        ("set_real", 3, Stage.SETTING, 1, 0),
        ("set_integer", 2, Stage.SETTING, 2, 1),
        ("step", 5, Stage.STEPPING, 3, None),
        ("step", 70_000, Stage.STEPPING, 3, None),
        ("get_real", 4, Stage.GETTING, 4, 0),
    ],
)
def test_first_status_above_warning_ends_step_and_is_told_with_its_stage(
    kind: StepKind, name: str, status: int, stage: Stage, calls: int, number: int | None
) -> None:
    recorded = Recorded(kind, **{name: status})

    assert recorded.step(5) == (stage, status)
    assert recorded.calls == calls_of(kind)[:calls]
    assert recorded.member.stage == stage
    assert number is None or recorded.said.call == number


@pytest.mark.parametrize("flag", [0, 1, 2])
def test_step_of_fmi_3_ends_where_fmu_says_more_than_its_status(flag: int) -> None:
    recorded = Recorded(StepKind.FMI3)
    recorded.flag = flag

    for _ in range(2):  # what the first step said is not there in the second
        assert recorded.step(5) == (Stage.STEPPING, 0)
        assert recorded.calls == calls_of(StepKind.FMI3)[:3]
        recorded.calls.clear()


@pytest.mark.parametrize("kind", DO_STEP)
def test_a_step_with_events_is_left_to_python_with_its_inputs(kind: StepKind) -> None:
    recorded = Recorded(kind)
    given, taken = ctypes.c_double(0.7), ctypes.c_double()
    move = Move(RowBase.FIXED, ctypes.addressof(given), RowBase.FIXED, ctypes.addressof(taken), 1, factor=1.0)
    recorded.member.loads, recorded.member.n_loads = native.table(Move, [move]), 1
    recorded.said.note(quiet_until=0.5 + 12 * 0.1)

    assert recorded.step(4) == (0, 0)
    assert recorded.step(5) == (Stage.IN_PYTHON, 0)
    assert len(recorded.calls) == 4
    assert taken.value == 0.7


# ---- FMUs


MODELS: list[tuple[str, dict[str, Value]]] = [
    ("TransportDelay", {}),
    ("DampedPendulum", {}),
    ("Integrator", {}),
    ("Gain", {}),
    ("AllTypes1", {}),
    ("AllTypes", {}),
    ("AllTypes3", {"columns": 3}),
    ("Events3", {"interval": 0.3125, "announced": 1.0}),  # no plain step passes an event that it announces
    ("Events3", {"interval": 0.3125, "announced": 0.0}),  # it returns early from a plain step
]


@needs_compiler
@pytest.mark.parametrize(("model", "start_values"), MODELS)
def test_the_rows_are_those_of_a_step_call_by_call(
    model: str, start_values: dict[str, Value], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    together = rows_of_steps(model, start_values, tmp_path)
    monkeypatch.setattr(native, "library", None)

    assert together == rows_of_steps(model, start_values, tmp_path)
    assert len(set(together)) > 100


def rows_of_steps(model: str, start_values: dict[str, Value], folder: Path) -> list[tuple[bytes, ...]]:
    """All numbers that an FMU puts out in 200 steps with inputs of all values, by turns in two rings."""
    rows = []
    with closing(opened(find_fmu(model, folder), folder, start_values)) as instance:
        inputs, outputs, watched = rings_of(instance)
        instance.bind(inputs, (outputs, watched), GRID, 1)
        assert is_one_call(instance) == (native.library is not None)
        random = np.random.default_rng(17)
        for step in range(200):
            for part, array in zip(inputs.layout.parts, inputs.parts, strict=True):
                array[0] = values_for(part.type, part.width, random)
            instance.do_step(step)
            slot = (step + 1) & outputs.mask
            rows.append(tuple(part[slot].tobytes() for part in outputs.parts))
            assert rows[-1] == tuple(part[slot].tobytes() for part in watched.parts)
    return rows


def values_for(type_: VariableType, width: int, random: np.random.Generator) -> list[Any]:
    """Values of all sizes, with those at the ends of the range; an Enumeration is an int in FMI 1.0 and 2.0."""
    if type_ == "Boolean":
        return [bool(random.integers(2)) for _ in range(width)]
    if type_.startswith("Float"):
        return [random.choice([-0.0, 5e-324, random.normal(), random.normal()]) for _ in range(width)]
    whole = INTEGERS["Int32" if type_ == "Enumeration" else type_]
    low = whole[0] + 1 if whole[0] else 0  # the opposite of the least is no int, and FMI 1.0 has aliases that want it
    return [[low, whole[-1], int(random.integers(100))][random.integers(3)] for _ in range(width)]


def opened(
    path: Path,
    folder: Path,
    start_values: dict[str, Value] | None = None,
    options: StepOptions = StepOptions(),  # noqa: B008 a frozen Struct
    log: Callable[[LogMessage], None] = lambda _message: None,
) -> FmuInstance:
    instance = open_instance(path, "it", read_description(path, kind="co_simulation"), folder, log, options=options)
    instance.enter_initialization(0.0, 125.0, start_values or {})
    instance.exit_initialization()
    return instance


def rings_of(instance: FmuInstance) -> tuple[Ring, Ring, Ring]:
    """A row for all inputs that are numbers, and two rings for all outputs that are."""
    inputs, outputs = (
        [variable for variable in instance.description.with_causality(kind) if not is_text(variable.type)]
        for kind in ("input", "output")
    )
    return Ring(Layout.of(inputs), 1), Ring(Layout.of(outputs), 64), Ring(Layout.of(outputs), 64)


def is_one_call(instance: FmuInstance) -> bool:
    assert isinstance(instance, NativeInstance)
    return vars(instance)["_in_step"][1] is not None


@pytest.fixture(params=["by tables", "call by call"])
def way(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    """How steps are taken."""
    if request.param == "call by call":
        monkeypatch.setattr(native, "library", None)
    return str(request.param)


@needs_compiler
@pytest.mark.parametrize(
    ("model", "given", "read", "value", "says"),
    [
        ("AllTypes", "enumeration_in", "enumeration_out", 2**31, "a value is out of the range of int32"),
        ("AllTypes1", "integer_in_opposite", "real_out", -(2**31), "-2147483648 has no opposite in its type"),
        ("AllTypes1", "integer_in", "integer_opposite", -(2**31), "-2147483648 has no opposite in its type"),
    ],
)
def test_number_that_type_of_fmu_cannot_hold_is_told_with_its_variable(
    model: str, given: str, read: str, value: int, says: str, way: str, tmp_path: Path
) -> None:
    with closing(opened(find_fmu(model, tmp_path), tmp_path)) as instance:
        inputs, outputs = (Ring(Layout.of([variable(instance, name)]), 1) for name in (given, read))
        instance.bind(inputs, (outputs,), GRID, 1)
        assert is_one_call(instance) == (way == "by tables")
        inputs.put(0, given, value)
        what = "integer_opposite cannot be read" if read == "integer_opposite" else f"{given} cannot be set"

        with pytest.raises(StepFailed, match=f"^instance it: {what}: {says}; the FMU gave no message"):
            instance.do_step(0)


@needs_compiler
def test_a_setter_that_fails_is_told_with_its_function_and_its_variables(way: str, tmp_path: Path) -> None:
    with closing(opened(find_fmu("AllTypes1", tmp_path), tmp_path)) as instance:
        # FMI forbids to set this parameter now: no configuration can connect it.
        names = ["integer_in", "boolean_in", "boolean_opposite"]
        inputs = Ring(Layout.of([variable(instance, name) for name in names]), 1)
        instance.bind(inputs, (Ring(Layout(), 4),), GRID, 1)
        assert is_one_call(instance) == (way == "by tables")

        with pytest.raises(StepFailed, match="fmiSetBoolean of boolean_in, boolean_opposite returned error; the FMU"):
            instance.do_step(0)


def test_a_status_that_fmi_does_not_know_is_told_by_its_number(tmp_path: Path) -> None:
    with closing(opened(find_fmu("Gain", tmp_path), tmp_path)) as gain:
        inputs, outputs, _ = rings_of(gain)
        gain.bind(inputs, (outputs,), GRID, 1)
        assert isinstance(gain, StepsNatively)

        with pytest.raises(StepFailed, match="fmi2DoStep returned 70000; the FMU gave no message"):
            gain.finish(0, Stage.STEPPING << STAGE_BITS | 70_000)


def variable(instance: FmuInstance, name: str) -> Variable:
    found = instance.description.variable(name)
    assert found is not None
    return found


# ---- what a node does with the tables


class Burst:
    """Takes the steps of an instance as a node does: by its tables, with a member of its own."""

    def __init__(self, instance: StepsNatively, outputs: Sequence[Ring], grid: TimeGrid) -> None:
        tables = instance.native
        assert tables is not None
        self.finished: list[tuple[int, int]] = []
        self._instance, self._tables = instance, tables
        self._member = member_of(tables, outputs, grid)

    def run(self, steps: range) -> None:
        assert native.library is not None
        for step in steps:
            if outcome := native.library.member_step(ctypes.addressof(self._member), step):
                self.finished.append((step, outcome >> STAGE_BITS))
                self._instance.finish(step, outcome)


def member_of(tables: NativeStep, outputs: Sequence[Ring], grid: TimeGrid) -> MemberTable:
    return MemberTable(
        loads=native.table(Move, tables.loads),
        setters=native.table(Call, tables.setters),
        getters=native.table(Call, tables.getters),
        stores=native.table(Move, tables.stores),
        n_loads=len(tables.loads),
        n_setters=len(tables.setters),
        n_getters=len(tables.getters),
        n_stores=len(tables.stores),
        kind=tables.kind,
        component=tables.component,
        do_step=tables.do_step,
        said=tables.said,
        start_time=grid.start_time,
        base_step_size=grid.step_size,
        step_size=grid.step_size,
        points=1,
        last_step=NEVER,
        python_at=NEVER,
        outputs=(OutputTable * 2)(*(OutputTable(ring.address, ring.stride, ring.mask) for ring in outputs)),
        bases=(ctypes.c_void_p * RowBase.FIRST_GATE)(),
    )


@pytest.fixture
def stairs(tmp_path: Path) -> Iterator[Callable[..., tuple[FmuInstance, Ring]]]:
    """The FMU with a time event at each whole multiple of `period`, without connected inputs."""
    if NO_COMPILER is not None:
        pytest.skip(str(NO_COMPILER))
    instances: list[FmuInstance] = []

    def make(version: Version, **start_values: Value) -> tuple[FmuInstance, Ring]:
        fmu = build_event_fmu("Stairs", version, tmp_path / "fmus")
        instance = opened(fmu, tmp_path, start_values)
        instances.append(instance)
        outputs = Ring(Layout.of(instance.description.with_causality("output")), 64)
        instance.bind(Ring(Layout(), 1), (outputs,), GRID, 1)
        return instance, outputs

    yield make
    for instance in instances:
        instance.close()


def test_node_gives_steps_with_time_events_to_python_and_takes_all_others(
    stairs: Callable[..., tuple[FmuInstance, Ring]],
) -> None:
    instance, outputs = stairs(3, period=0.5)
    other, expected = stairs(3, period=0.5)
    assert isinstance(instance, StepsNatively)
    burst = Burst(instance, (outputs,), GRID)

    burst.run(range(40))
    for step in range(40):
        other.do_step(step)

    assert [step for step, stage in burst.finished if stage == Stage.IN_PYTHON] == list(range(3, 40, 4))
    assert [part.tobytes() for part in outputs.parts] == [part.tobytes() for part in expected.parts]
    assert instance.get_values(["counter"]) == [10]


@pytest.mark.parametrize("version", [2, 3])
def test_after_last_step_that_an_fmu_wants_node_hears_that_it_ends(
    version: Version, stairs: Callable[..., tuple[FmuInstance, Ring]]
) -> None:
    instance, outputs = stairs(version, period=1.0, end=2)
    assert isinstance(instance, StepsNatively)
    burst = Burst(instance, (outputs,), GRID)
    burst.run(range(16))

    with pytest.raises(TerminationRequested):
        burst.run(range(16, 17))

    assert outputs.value(16, "counter") == 2


@needs_compiler
def test_a_message_of_an_fmu_has_the_step_in_which_it_came(tmp_path: Path) -> None:
    messages: list[LogMessage] = []
    fmu = find_fmu("Faulty", tmp_path)
    with closing(opened(fmu, tmp_path, {"fail_at": 1.25}, log=messages.append)) as instance:
        inputs, outputs, _ = rings_of(instance)
        instance.bind(inputs, (outputs,), GRID, 1)
        assert isinstance(instance, StepsNatively)

        with pytest.raises(StepFailed, match="fmi2DoStep returned error; the FMU says: the reactor is empty"):
            Burst(instance, (outputs,), GRID).run(range(20))

    assert [(message.step, message.message) for message in messages] == [(10, "the reactor is empty")]


# ---- who steps without Python


@needs_compiler
@pytest.mark.parametrize(
    ("model", "options", "columns", "who"),
    [
        ("AllTypes", StepOptions(), ["boolean_in", "enumeration_in"], "library"),
        ("AllTypes", StepOptions(), ["boolean_in", "string_in"], "python"),
        ("AllTypes", StepOptions(), [], "library"),
        ("Steps2", StepOptions(), [], "library"),
        ("Steps2", StepOptions(retry_discarded_steps=True), [], "python"),
        ("Events3", StepOptions(), [], "library"),
        ("Events3", StepOptions(), ["u"], "python"),  # it changes in event mode only
    ],
)
def test_an_instance_steps_without_python_if_its_steps_are_numbers_and_calls(
    model: str, options: StepOptions, columns: list[str], who: str, tmp_path: Path
) -> None:
    with closing(opened(find_fmu(model, tmp_path), tmp_path, {}, options)) as instance:
        assert isinstance(instance, StepsNatively)
        inputs = Layout.of([variable(instance, name) for name in columns])
        outputs = [variable for variable in instance.description.with_causality("output") if not is_text(variable.type)]

        instance.bind(Ring(inputs, 1), (Ring(Layout.of(outputs), 4),), GRID, 1)
        assert (instance.native is not None) == (who == "library")

        instance.bind(Ring(inputs, 4), (Ring(Layout.of(outputs), 4),), GRID, 1)
        assert instance.native is None  # a node gives it one row of inputs


def test_an_instance_with_deadlines_passes_the_steps_on(tmp_path: Path) -> None:
    with closing(opened(find_fmu("Gain", tmp_path), tmp_path)) as gain:
        guarded = Guarded("gain", lambda: gain, Unwatched(), TimeoutsConfig())
        inputs, outputs, _ = rings_of(gain)
        guarded.bind(inputs, (outputs,), GRID, 1)
        inputs.put(0, "u", 3.0)

        assert guarded.native is not None
        guarded.finish(0, Stage.IN_PYTHON << STAGE_BITS)

        assert outputs.value(1, "y") == 3.0


def test_an_instance_that_knows_nothing_of_the_library_is_stepped_by_python() -> None:
    class Plain:
        """As another package may write it."""

        def do_step(self, step: int) -> None:
            raise FmuError(f"step {step} is not taken here")

    plain: Any = Plain()

    assert Guarded("it", lambda: plain, Unwatched(), TimeoutsConfig()).native is None
