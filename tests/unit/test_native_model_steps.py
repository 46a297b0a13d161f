"""Model exchange as one call of the library for a step: the same rows as call by call, and what is left to Python."""

from __future__ import annotations

import ctypes
import random
from collections.abc import Callable, Iterator, Mapping
from contextlib import closing, contextmanager
from pathlib import Path
from typing import NamedTuple

import pytest

from fmu_mesh.errors import StepFailed
from fmu_mesh.instances.fmi.archive.reading import read_description
from fmu_mesh.instances.fmi.model_exchange.continuous import ContinuousInstance
from fmu_mesh.instances.fmi.opening import open_instance
from fmu_mesh.rings import native
from fmu_mesh.rings.native import Stage
from fmu_mesh.rings.ring import Ring
from fmu_mesh.simtime import TimeGrid
from fmu_mesh.system.layout import Layout
from fmu_mesh.variables.value_types import Value
from tests.fmus.event_fmus import Version
from tests.unit.test_native_steps import Burst

pytestmark = pytest.mark.skipif(native.library is None, reason="the library with the solver is not built here")

EventFmu = Callable[..., Path]
STEPS = 120
GRID = TimeGrid(0.25, 0.02, STEPS)
MODELS: dict[str, dict[str, Value]] = {
    "Ball": {},
    "Oscillator": {"mu": 3.0},
    "Integral": {"level": 0.1},
    "Stairs": {"period": 0.07},
    "Winding": {},
    "Heater": {"late": 1.33},
}


class Stepped(NamedTuple):
    """An instance with its rings; of inputs there is one row, or one for each step."""

    instance: ContinuousInstance
    inputs: Ring
    outputs: Ring

    def rows(self) -> list[bytes]:
        return [part.tobytes() for part in self.outputs.parts]


@contextmanager
def stepping(fmu: Path, folder: Path, rows: int, start_values: Mapping[str, Value] = {}) -> Iterator[Stepped]:
    description = read_description(fmu, kind="model_exchange")
    with closing(open_instance(fmu, "m", description, folder)) as instance:
        assert isinstance(instance, ContinuousInstance)
        instance.enter_initialization(GRID.start_time, None, start_values)
        instance.exit_initialization()
        inputs = Ring(Layout.of(description.with_causality("input")), rows)
        outputs = Ring(Layout.of(description.with_causality("output")), 128)
        instance.bind(inputs, (outputs,), GRID, 1)
        assert (instance.native is not None) == (rows == 1)
        yield Stepped(instance, inputs, outputs)


def give(stepped: Stepped, row: int, values: Mapping[str, Value]) -> None:
    for name, value in values.items():
        stepped.inputs.put(row, name, value)


def courses(fmu: Path, number: int) -> list[dict[str, Value]]:
    """Inputs for each step, of which some stay for a while."""
    random_ = random.Random(number)  # noqa: S311  for tests
    found: list[dict[str, Value]] = []
    for step in range(STEPS):
        if not step or random_.random() < 0.4:
            found.append(
                {
                    variable.name: random_.uniform(-1.0, 1.0) if variable.type == "Float64" else random_.randrange(3)
                    for variable in read_description(fmu, kind="model_exchange").with_causality("input")
                }
            )
        else:
            found.append(found[-1])
    return found


@pytest.mark.parametrize("version", [1, 2, 3])
@pytest.mark.parametrize("model", MODELS)
def test_a_step_of_the_library_gives_the_floats_of_single_calls(
    model: str, version: Version, event_fmu: EventFmu, tmp_path: Path
) -> None:
    fmu = event_fmu(model, version)
    values = courses(fmu, version)
    start_values = MODELS[model]
    with (
        stepping(fmu, tmp_path / "a", 1, start_values) as once,
        stepping(fmu, tmp_path / "b", 128, start_values) as by_calls,
    ):
        for step, given in enumerate(values):
            give(once, 0, given)
            give(by_calls, step, given)
            once.instance.do_step(step)
            by_calls.instance.do_step(step)

        assert once.rows() == by_calls.rows()


@pytest.mark.parametrize("version", [2, 3])
@pytest.mark.parametrize("model", [model for model in MODELS if model != "Heater"])  # CVode begins anew at a state
def test_states_and_settings_between_native_steps_change_no_float(
    model: str, version: Version, event_fmu: EventFmu, tmp_path: Path
) -> None:
    fmu = event_fmu(model, version)
    values = courses(fmu, version)
    random_ = random.Random(version)  # noqa: S311  for tests
    with (
        stepping(fmu, tmp_path / "a", 1, MODELS[model]) as first,
        stepping(fmu, tmp_path / "b", 1, MODELS[model]) as other,
    ):
        for step, given in enumerate(values):
            give(first, 0, given)
            give(other, 0, given)
            if random_.random() < 0.2:
                state = other.instance.get_state()
                give(other, 0, random_.choice(values))
                for ahead in range(step, step + random_.randrange(1, 6)):
                    other.instance.do_step(ahead)
                other.instance.set_state(state)
                other.instance.free_state(state)
                give(other, 0, given)
            first.instance.do_step(step)
            other.instance.do_step(step)
            names = [variable.name for variable in first.instance.description.with_causality("output")]
            assert first.instance.get_values(names) == other.instance.get_values(names), step


@pytest.mark.parametrize("version", [2, 3])
def test_a_state_from_before_the_first_step_is_begun_anew(
    version: Version, event_fmu: EventFmu, tmp_path: Path
) -> None:
    with stepping(event_fmu("Integral", version), tmp_path, 1) as own:
        state, found = own.instance.get_state(), []
        for _ in range(2):
            for step in range(20):
                give(own, 0, {"u": 0.5})
                own.instance.do_step(step)
            found.append(own.rows())
            own.instance.set_state(state)
        own.instance.free_state(state)

    assert found[0] == found[1]


@pytest.mark.parametrize("version", [1, 2, 3])
def test_steps_with_state_events_are_not_left_to_python(version: Version, event_fmu: EventFmu, tmp_path: Path) -> None:
    with stepping(event_fmu("Ball", version), tmp_path, 1) as ball:
        burst = Burst(ball.instance, (ball.outputs,), GRID)
        for step in range(STEPS):
            give(ball, 0, {"u": 0.1 * (step // 10)})
            burst.run(range(step, step + 1))
        bounces = ball.instance.get_values(["bounces"])

    assert burst.finished == []
    assert bounces == [7]


@pytest.mark.parametrize("version", [1, 2, 3])
def test_only_steps_with_time_events_are_left_to_python(version: Version, event_fmu: EventFmu, tmp_path: Path) -> None:
    with stepping(event_fmu("Stairs", version), tmp_path, 1, {"period": 0.07}) as stairs:
        burst = Burst(stairs.instance, (stairs.outputs,), GRID)
        for step in range(STEPS):
            give(stairs, 0, {"increment": 1})
            burst.run(range(step, step + 1))
        counter = stairs.instance.get_values(["counter"])

    assert {stage for _, stage in burst.finished} == {Stage.STEPPING}
    assert counter == [len(burst.finished)]


def test_an_input_that_the_fmu_refuses_ends_the_step(
    event_fmu: EventFmu, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    refuse = ctypes.CFUNCTYPE(ctypes.c_int, *[ctypes.c_void_p] * 2, ctypes.c_size_t, ctypes.c_void_p)(lambda *_: 3)
    with stepping(event_fmu("Integral", 2), tmp_path, 1) as own:
        solver = own.instance._solver_in_c  # no FMU of the tests refuses a value
        assert solver is not None
        monkeypatch.setattr(solver.table.setters[0], "function", ctypes.cast(refuse, ctypes.c_void_p).value)

        with pytest.raises(StepFailed, match="setting the inputs returned error"):
            own.instance.do_step(0)
