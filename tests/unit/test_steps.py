"""Steps of single instances: discarded ones, FMU state, solvers, and what is refused."""

from __future__ import annotations

import ctypes
import math
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import pytest

from fmu_mesh.errors import StepFailed, TerminationRequested
from fmu_mesh.instances.fmi.archive.reading import read_description
from fmu_mesh.instances.fmi.calls import cffi_function
from fmu_mesh.instances.fmi.co_simulation.discarded_steps import SMALLEST, take_sub_steps
from fmu_mesh.instances.fmi.co_simulation.extrapolation import LinearInputs
from fmu_mesh.instances.fmi.co_simulation.fmi3 import Fmi3Steps
from fmu_mesh.instances.fmi.fmu_instance import FmuInstance
from fmu_mesh.instances.fmi.fmu_values import DISCARD
from fmu_mesh.instances.fmi.opening import open_instance, stepped
from fmu_mesh.instances.fmi.step_options import SolverSettings, StepOptions
from fmu_mesh.rings.native import Said
from fmu_mesh.rings.ring import Ring
from fmu_mesh.simtime import TimeGrid
from fmu_mesh.system.coupling_rule import CouplingRule
from fmu_mesh.system.layout import Layout
from fmu_mesh.system.linear_inputs import LinearInput
from fmu_mesh.variables.model_description import Kind, ModelDescription
from fmu_mesh.variables.value_types import Value
from tests.fmus.event_fmus import Version
from tests.fmus.helpers import NO_COMPILER, build_test_fmu

EventFmu = Callable[..., Path]
CO_SIMULATION: list[tuple[Version, Kind]] = [(2, "co_simulation"), (3, "co_simulation")]
WITH_STATE: list[tuple[Version, Kind]] = [*CO_SIMULATION, (2, "model_exchange"), (3, "model_exchange")]
EXACT = [StepOptions(), StepOptions(SolverSettings("cvode")), StepOptions(SolverSettings("dopri5"))]
ALL: list[tuple[Version, Kind]] = [*WITH_STATE, (1, "model_exchange")]


@contextmanager
def running(
    fmu: Path,
    folder: Path,
    kind: Kind,
    step_size: float = 0.25,
    options: StepOptions = StepOptions(),  # noqa: B008 a frozen Struct
    **start_values: Value,
) -> Iterator[FmuInstance]:
    """An instance at point 0, with all its inputs in one row, and all its outputs in a ring of 64 rows."""
    description = read_description(fmu, kind=kind)
    with closing(open_instance(fmu, "m", description, folder, options=options)) as instance:
        instance.enter_initialization(0.0, 100.0, start_values)
        instance.exit_initialization()
        inputs = Ring(Layout.of(description.with_causality("input")), 1)
        outputs = Ring(Layout.of(description.with_causality("output")), 64)
        for variable in description.with_causality("input"):
            inputs.put(0, variable.name, cast("Value", variable.start))
        instance.bind(inputs, (outputs,), TimeGrid(0.0, step_size, 400), 1)
        yield instance


def outputs(instance: FmuInstance) -> list[Value]:
    names = [variable.name for variable in instance.description.with_causality("output")]
    return instance.get_values(names)


def outputs_after(instance: FmuInstance, steps: range) -> list[Value]:
    for step in steps:
        instance.do_step(step)
    return outputs(instance)


# ---- sub-steps


def test_step_is_halved_until_it_is_taken_and_its_parts_fill_it() -> None:
    taken: list[tuple[float, float]] = []

    def attempt(time: float, size: float) -> int:
        if size > 0.2:
            return DISCARD
        taken.append((time, size))
        return 0

    assert take_sub_steps(attempt, 3.0, 1.0) == 0
    assert taken == [(3.0 + part / 8, 0.125) for part in range(8)]


def test_a_step_that_is_discarded_down_to_the_smallest_part_is_discarded() -> None:
    sizes: list[float] = []

    def attempt(_time: float, size: float) -> int:
        sizes.append(size)
        return DISCARD

    assert take_sub_steps(attempt, 0.0, 1.0) == DISCARD
    assert sizes[-1] == 1.0 / SMALLEST
    assert len(sizes) == int(math.log2(SMALLEST))


@pytest.mark.parametrize(("version", "kind"), CO_SIMULATION)
def test_a_discarded_step_is_taken_in_parts_if_fmu_can_and_may(
    version: Version, kind: Kind, event_fmu: EventFmu, tmp_path: Path
) -> None:
    options = StepOptions(retry_discarded_steps=True)

    with running(event_fmu("Stairs", version), tmp_path, kind, 0.25, options, longest_step=0.1) as stairs:
        for step in range(20):
            stairs.do_step(step)

        assert stairs.get_values(["counter", "last_stair"]) == [5, 5.0]


@pytest.mark.parametrize(("version", "kind"), CO_SIMULATION)
def test_a_step_that_is_always_discarded_fails_and_says_so(
    version: Version, kind: Kind, event_fmu: EventFmu, tmp_path: Path
) -> None:
    options = StepOptions(retry_discarded_steps=True)

    with (
        running(event_fmu("Stairs", version), tmp_path, kind, 0.25, options, longest_step=1e-9) as stairs,
        pytest.raises(
            StepFailed, match=r"DoStep returned discard down to 1/1024 of the step; the FMU says: the step is"
        ),
    ):
        stairs.do_step(0)


def test_without_the_wish_a_discarded_step_of_fmi_2_is_a_failure(event_fmu: EventFmu, tmp_path: Path) -> None:
    with (
        running(event_fmu("Stairs", 2), tmp_path, "co_simulation", longest_step=0.1) as stairs,
        pytest.raises(StepFailed, match=r"fmi2DoStep returned discard; .*; the FMU says: the step is too long"),
    ):
        stairs.do_step(0)


def test_an_fmu_of_fmi_3_with_a_fixed_step_size_keeps_it(event_fmu: EventFmu, tmp_path: Path) -> None:
    fmu = event_fmu("Stairs", 3, canHandleVariableCommunicationStepSize="false", hasEventMode="false")

    with (
        running(fmu, tmp_path, "co_simulation", longest_step=0.1) as stairs,
        pytest.raises(StepFailed, match=r"fmi3DoStep returned discard; the FMU says: the step is too long"),
    ):
        stairs.do_step(0)


def test_the_rest_of_a_step_after_early_return_ends_where_step_does() -> None:
    """0.11 - 0.04 is rounded up, so that 0.04 and it are more than 0.11."""
    calls: list[tuple[float, float]] = []

    def stepped(_component: int, time: float, size: float, _no_set_state: bool, *results: int) -> int:  # noqa: FBT001 as in C
        calls.append((time, size))
        ctypes.c_bool.from_address(results[2]).value = time == 0.0
        ctypes.c_double.from_address(results[3]).value = 0.04
        return 0

    function = ctypes.CFUNCTYPE(
        ctypes.c_int, ctypes.c_void_p, ctypes.c_double, ctypes.c_double, ctypes.c_bool, *[ctypes.c_void_p] * 4
    )(stepped)
    do_step = cffi_function(function, "int (*)(void *, double, double, _Bool, void *, void *, void *, void *)")
    fmu = SimpleNamespace(component=1)
    description = ModelDescription("m", "m", "3.0", "co_simulation", "", (), can_handle_variable_step_size=True)
    assert 0.04 + (0.11 - 0.04) > 0.11

    assert Fmi3Steps(fmu, do_step, description, Said()).step(0.0, 0.11, 0.11)

    assert calls[0] == (0.0, 0.11)
    assert calls[1][0] == 0.04
    assert sum(calls[1]) <= 0.11


# ---- the end that an FMU asks for


@pytest.mark.parametrize(("version", "kind"), ALL)
@pytest.mark.parametrize(("period", "last_step"), [(1.0, 8), (0.3, 2)], ids=["at a point", "between points"])
def test_an_fmu_that_asks_to_end_ends_before_its_unfinished_step(
    version: Version, kind: Kind, period: float, last_step: int, event_fmu: EventFmu, tmp_path: Path
) -> None:
    with running(event_fmu("Stairs", version), tmp_path, kind, period=period, end=2) as stairs:
        for step in range(last_step):
            stairs.do_step(step)

        with pytest.raises(TerminationRequested):
            stairs.do_step(last_step)


# ---- events


@pytest.mark.parametrize(("version", "kind"), [case for case in ALL if case != (2, "co_simulation")])
def test_discrete_states_that_never_converge_are_an_error_and_no_hang(
    version: Version, kind: Kind, event_fmu: EventFmu, tmp_path: Path
) -> None:
    fmu = event_fmu("Stairs", version)
    with pytest.raises(Exception, match="need more than 1000 updates"), running(fmu, tmp_path, kind, forever=1):
        pass


@pytest.mark.parametrize("version", [1, 2, 3])
@pytest.mark.parametrize("options", EXACT, ids=["auto", "cvode", "dopri5"])
def test_where_a_model_cannot_be_evaluated_the_solver_ends_with_its_words(
    options: StepOptions, version: Version, event_fmu: EventFmu, tmp_path: Path
) -> None:
    fmu = event_fmu("Oscillator", version)

    def run() -> None:
        with running(fmu, tmp_path, "model_exchange", options=options, limit=0.5) as oscillator:
            for step in range(20):
                oscillator.do_step(step)

    with pytest.raises(StepFailed) as caught:
        run()

    assert "returned discard" in str(caught.value)
    assert version == 1 or "the FMU says: y is out of its range" in str(caught.value)


@pytest.mark.parametrize("version", [1, 2, 3])
@pytest.mark.parametrize("options", EXACT, ids=["auto", "cvode", "dopri5"])
def test_completed_steps_are_told_and_step_events_are_handled(
    options: StepOptions, version: Version, event_fmu: EventFmu, tmp_path: Path
) -> None:
    """The oscillator asks for an event with every hundredth step of the solver."""
    with running(event_fmu("Oscillator", version), tmp_path, "model_exchange", 2.0, options) as oscillator:
        for step in range(25):
            oscillator.do_step(step)

        completed, events = oscillator.get_values(["completed_steps", "events"])

    assert isinstance(completed, int)
    assert completed > 200
    assert events == completed // 100 + 2  # and one at the start, one for the input that is set first


def test_euler_takes_steps_of_the_largest_size_that_is_allowed(event_fmu: EventFmu, tmp_path: Path) -> None:
    options = StepOptions(solver=SolverSettings("euler", maximum_step_size=0.01))

    with running(event_fmu("Oscillator", 2), tmp_path, "model_exchange", 0.1, options) as oscillator:
        oscillator.do_step(0)
        x, y, completed = oscillator.get_values(["x", "y", "completed_steps"])

    expected_x, expected_y = 2.0, 0.0
    for _ in range(10):
        slope = (1.0 - expected_x**2) * expected_y - expected_x
        expected_x, expected_y = expected_x + 0.01 * expected_y, expected_y + 0.01 * slope
    assert completed == 10
    assert [x, y] == pytest.approx([expected_x, expected_y], rel=1e-12)  # the ten steps are not all 0.01 to the bit


@pytest.mark.parametrize("parts", [1, 3])
def test_euler_takes_as_many_steps_at_late_times_as_at_early_ones(
    parts: int, event_fmu: EventFmu, tmp_path: Path
) -> None:
    options = StepOptions(solver=SolverSettings("euler", maximum_step_size=0.01 / parts))

    with running(event_fmu("Oscillator", 2), tmp_path, "model_exchange", 0.01, options) as oscillator:
        for step in range(390):
            oscillator.do_step(step)

        assert oscillator.get_values(["completed_steps"]) == [390 * parts]


# ---- the FMU state


@pytest.mark.parametrize(("version", "kind"), WITH_STATE)
@pytest.mark.parametrize("model", ["Ball", "Stairs"])
@pytest.mark.parametrize("options", EXACT, ids=["auto", "cvode", "dopri5"])
def test_instance_goes_on_bit_by_bit_from_state_that_it_was_in(
    options: StepOptions, version: Version, kind: Kind, model: str, event_fmu: EventFmu, tmp_path: Path
) -> None:
    with running(event_fmu(model, version), tmp_path, kind, 0.1, options) as instance:
        for step in range(6):
            instance.do_step(step)
        state = instance.get_state()
        there = outputs_after(instance, range(6, 20))

        instance.set_state(state)

        assert outputs_after(instance, range(6, 20)) == there
        instance.free_state(state)


@pytest.mark.parametrize(("version", "kind"), WITH_STATE)
@pytest.mark.parametrize("options", EXACT, ids=["auto", "cvode", "dopri5"])
def test_another_instance_goes_on_bit_by_bit_from_a_serialized_state(
    options: StepOptions, version: Version, kind: Kind, event_fmu: EventFmu, tmp_path: Path
) -> None:
    fmu = event_fmu("Ball", version)
    with running(fmu, tmp_path, kind, 0.1, options) as instance:
        for step in range(6):
            instance.do_step(step)
        state = instance.get_state()
        data = instance.serialize_state(state)
        instance.free_state(state)
        there = outputs_after(instance, range(6, 20))

    with running(fmu, tmp_path, kind, 0.1, options) as other:
        state = other.deserialize_state(data)
        other.set_state(state)

        assert outputs_after(other, range(6, 20)) == there
        other.free_state(state)


# ---- clocks


@pytest.mark.parametrize("kind", ["co_simulation", "model_exchange"])
@pytest.mark.parametrize(
    ("clock", "ticks"),
    [
        ('intervalVariability="constant" intervalDecimal="0.4" shiftDecimal="0.2"', [0.2, 0.6, 1.0, 1.4, 1.8]),
        (
            'intervalVariability="tunable" supportsFraction="true" resolution="8" intervalCounter="4" shiftCounter="1"',
            [0.125, 0.625, 1.125, 1.625],
        ),
        ('intervalVariability="fixed"', [0.1 + number * 0.3 for number in range(7)]),
        ('intervalVariability="countdown"', [0.3, 0.6, 0.9, 1.2, 1.5, 1.8]),
    ],
    ids=["constant", "fraction", "by the FMU", "countdown"],
)
def test_time_based_input_clock_ticks_when_it_is_time_also_between_points(
    clock: str, ticks: list[float], kind: Kind, event_fmu: EventFmu, tmp_path: Path
) -> None:
    fmu = event_fmu("Stairs", 3, clocks=clock)
    seen: set[float] = set()

    with running(fmu, tmp_path, kind, 0.05) as stairs:
        for step in range(39):
            stairs.do_step(step)
            seen.add(cast("float", stairs.get_values(["last_tick"])[0]))
        assert stairs.get_values(["counter"]) == [100 * len(ticks) + 1]

    # The times of an aperiodic clock are sums: each interval counts from the tick before.
    assert sorted(seen - {0.0}) == pytest.approx(ticks, rel=1e-12)


def test_an_fmu_with_a_fixed_step_size_takes_its_ticks_at_points(event_fmu: EventFmu, tmp_path: Path) -> None:
    clock = 'intervalVariability="constant" intervalDecimal="0.4" shiftDecimal="0.2"'
    fmu = event_fmu("Stairs", 3, clocks=clock, canHandleVariableCommunicationStepSize="false")

    with running(fmu, tmp_path, "co_simulation", 0.25) as stairs:
        ticks = []
        for step in range(4):
            stairs.do_step(step)
            ticks += stairs.get_values(["last_tick"])

    assert ticks == [0.25, 0.25, 0.75, 1.0]


@pytest.mark.parametrize("kind", ["co_simulation", "model_exchange"])
def test_clocks_and_linear_inputs_go_on_from_a_state_too(kind: Kind, event_fmu: EventFmu, tmp_path: Path) -> None:
    clock = 'intervalVariability="constant" intervalDecimal="0.07" shiftDecimal="0.02"'
    with running(event_fmu("Stairs", 3, clocks=clock), tmp_path, kind, 0.05, period=0.11) as stairs:
        for step in range(6):
            stairs.do_step(step)
        state = stairs.get_state()
        there = outputs_after(stairs, range(6, 20))

        stairs.set_state(state)

        assert outputs_after(stairs, range(6, 20)) == there
        stairs.free_state(state)


@pytest.mark.skipif(NO_COMPILER is not None, reason=str(NO_COMPILER))
@pytest.mark.parametrize("causality", ["input", "parameter"])
def test_an_event_after_a_restored_state_has_its_own_time(causality: str, event_fmu: EventFmu, tmp_path: Path) -> None:
    with running(event_fmu("Stairs", 3), tmp_path, "co_simulation", increment=1) as stairs:
        inputs: Ring = vars(stairs)["_keep"][0]
        stairs.do_step(0)
        state = stairs.get_state()
        outputs_after(stairs, range(1, 20))
        stairs.set_state(state)
        if causality == "input":
            inputs.put(1, "increment", 2)
        else:
            stairs.set_values({"end": 1000})

        stairs.do_step(1)

        after = stairs.get_state()
        assert (state.kept.last_event, after.kept.last_event) == (0.0, 0.25)
        stairs.free_state(state)
        stairs.free_state(after)


@pytest.mark.parametrize(("version", "kind"), [(2, "co_simulation"), (2, "model_exchange"), (3, "model_exchange")])
def test_linear_inputs_are_part_of_the_state(version: Version, kind: Kind, event_fmu: EventFmu, tmp_path: Path) -> None:
    options = StepOptions(linear_inputs=(LinearInput("u", CouplingRule(1, 1, 1)),))
    description = read_description(event_fmu("Integral", version), kind=kind)
    rings = [Ring(Layout.of(description.with_causality(causality)), 32) for causality in ("input", "output")]
    for row in range(32):
        rings[0].put(row, "u", math.sin(row))
    with closing(open_instance(event_fmu("Integral", version), "m", description, tmp_path, options=options)) as inner:
        instance = cast("LinearInputs", stepped(inner, options))
        instance.enter_initialization(0.0, 10.0, {})
        instance.exit_initialization()
        instance.bind(rings[0], (rings[1],), TimeGrid(0.0, 0.1, 100), 1)
        for step in range(5):
            instance.do_step(step)
        state = instance.get_state()
        data = instance.serialize_state(state)
        for step in range(5, 20):
            instance.do_step(step)
        there = outputs(inner)

        again = instance.deserialize_state(data)
        instance.set_state(again)
        for step in range(5, 20):
            instance.do_step(step)

        assert outputs(inner) == there
        instance.free_state(again)
        instance.free_state(state)


@pytest.mark.skipif(NO_COMPILER is not None, reason=str(NO_COMPILER))
def test_an_fmu_of_fmi_3_that_asked_to_end_is_not_stepped(tmp_path: Path) -> None:
    with running(build_test_fmu("Events3", tmp_path), tmp_path, "co_simulation", last=0.5) as instance:
        instance.do_step(0)
        instance.do_step(1)  # it asks at the end of this one, which is complete

        for _ in range(2):
            with pytest.raises(TerminationRequested):
                instance.do_step(2)
