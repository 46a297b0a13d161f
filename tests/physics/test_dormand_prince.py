"""The solver `dopri5` against solutions on paper, and what it says of a model that it does not suit."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

from fmu_mesh.errors import ConfigurationError
from fmu_mesh.instances.contract import LogMessage
from fmu_mesh.instances.fmi.archive.reading import read_description
from fmu_mesh.instances.fmi.opening import open_instance
from fmu_mesh.instances.fmi.step_options import SolverSettings, StepOptions
from fmu_mesh.rings import native
from fmu_mesh.rings.library import LIBRARY_VARIABLE
from fmu_mesh.rings.ring import Ring
from fmu_mesh.simtime import TimeGrid
from fmu_mesh.system.layout import Layout
from tests.fmus.event_fmus import Version
from tests.helpers import write_config
from tests.physics.test_changing_inputs import EXACT, FLOOR, Driven, driven, sine
from tests.planning import prepare

pytestmark = pytest.mark.skipif(native.library is None, reason="the library with the solver is not built here")

EventFmu = Callable[..., Path]
HARMONIC = Driven("Oscillator", "u", ("x", "y"), {"mu": 0.0}, 10.0)


def error_of(rows: list[list[float]], exact: list[tuple[float, float]]) -> float:
    return float(np.max(np.abs(np.subtract(rows, exact))))


def free(step_size: float, points: int) -> list[tuple[float, float]]:
    """The harmonic oscillator from x = 2 at rest, without a force, after each step."""
    times = [step_size * point for point in range(1, points + 1)]
    return [(2.0 * math.cos(time), -2.0 * math.sin(time)) for time in times]


def held(values: list[float], step_size: float) -> list[tuple[float, float]]:
    """The same with a force that is held within each step: a turn around the point (u, 0)."""
    x, y, found = 2.0, 0.0, []
    cosine, sine_of_step = math.cos(step_size), math.sin(step_size)
    for u in values[:-1]:
        x, y = u + (x - u) * cosine + y * sine_of_step, y * cosine - (x - u) * sine_of_step
        found.append((x, y))
    return found


@pytest.mark.parametrize("version", [1, 2, 3])
@pytest.mark.parametrize("tolerance", [1e-4, 1e-6, 1e-8, 1e-10])
def test_an_oscillator_is_as_exact_as_its_tolerance(
    tolerance: float, version: Version, event_fmu: EventFmu, tmp_path: Path
) -> None:
    settings = SolverSettings("dopri5", tolerance)

    rows = driven(event_fmu("Oscillator", version), tmp_path, HARMONIC, [0.0] * 11, 1.0, "hold", solver=settings)

    assert error_of(rows, free(1.0, 10)) <= FLOOR * tolerance  # type: ignore[arg-type]  # two floats a row


def test_steep_slopes_at_a_late_time_do_not_stop_the_solver(event_fmu: EventFmu, tmp_path: Path) -> None:
    """The first step size would be 1e-15 s, which changes no time of 1000 s."""
    fmu = event_fmu("Winding", 2)
    options = StepOptions(SolverSettings("dopri5"))
    with closing(open_instance(fmu, "m", read_description(fmu, kind="model_exchange"), tmp_path, options=options)) as m:
        m.enter_initialization(1e3, None, {"L": 1e-9, "U": 1.0, "I": 1e-6})
        m.exit_initialization()
        m.advance(1e3, 1e-7)
        current = m.get_values(["I"])

    assert current == [pytest.approx(1.0, abs=1e-5)]


def test_half_the_step_has_a_32nd_of_the_error(event_fmu: EventFmu, tmp_path: Path) -> None:
    """With a tolerance that allows everything, the steps are those between the points."""
    fmu, errors = event_fmu("Oscillator", 2), []
    for points in (32, 64, 128):
        settings = SolverSettings("dopri5", 1e3)
        rows = driven(fmu, tmp_path, HARMONIC, [0.0] * (points + 1), 8.0 / points, "hold", solver=settings)
        errors.append(error_of(rows[-1:], free(8.0 / points, points)[-1:]))  # type: ignore[arg-type]  # as above

    orders = [math.log2(before / after) for before, after in itertools.pairwise(errors)]
    assert all(4.8 <= order <= 5.5 for order in orders), orders


@pytest.mark.parametrize("step_size", [0.1, 0.01, 0.001])
def test_held_inputs_that_jump_at_each_point_cost_no_accuracy(
    step_size: float, event_fmu: EventFmu, tmp_path: Path
) -> None:
    fmu, values = event_fmu("Oscillator", 2), sine(4.0, step_size)
    errors = {}
    for name in EXACT:
        rows = driven(fmu, tmp_path, HARMONIC, values, step_size, "hold", solver=SolverSettings(name, 1e-6))
        errors[name] = error_of(rows, held(values, step_size))  # type: ignore[arg-type]  # two floats a row

    assert errors["dopri5"] <= 1e-6
    assert errors["dopri5"] <= 0.1 * errors["cvode"]


@pytest.mark.parametrize("version", [1, 2, 3])
def test_each_held_step_is_one_step_of_the_solver(version: Version, event_fmu: EventFmu, tmp_path: Path) -> None:
    """So it costs seven evaluations: six, and one of the new input. The oscillator counts the completed steps."""
    system = Driven("Oscillator", "u", ("x",), {"mu": 0.0}, 1.0)
    options = StepOptions(SolverSettings("dopri5"))
    fmu = event_fmu("Oscillator", version)
    with closing(open_instance(fmu, "m", read_description(fmu, kind="model_exchange"), tmp_path, options=options)) as m:
        m.enter_initialization(0.0, None, system.start_values)
        m.exit_initialization()
        inputs, outputs = (Ring(Layout.of([(name, "Float64")]), 1) for name in ("u", "x"))
        m.bind(inputs, (outputs,), TimeGrid(0.0, 0.01, 100), 1)
        counts = []
        for step in range(100):
            inputs.put(0, "u", math.sin(0.01 * step))
            m.do_step(step)
            counts += m.get_values(["completed_steps"])

    # The first step size is that of an algorithm; from then on a step between two points is one of the solver.
    assert {later - before for before, later in itertools.pairwise(counts[2:])} == {1}  # type: ignore[operator]  # integers


@pytest.mark.parametrize("version", [1, 2, 3])
def test_a_discarded_evaluation_makes_the_step_smaller(version: Version, event_fmu: EventFmu, tmp_path: Path) -> None:
    """Stages of long steps leave the circle of radius 2 by more than the limit; those of short ones do not."""
    system = HARMONIC._replace(start_values={"mu": 0.0, "limit": 2.00001})
    settings = SolverSettings("dopri5", 1e-4)

    rows = driven(event_fmu("Oscillator", version), tmp_path, system, [0.0] * 6, 1.0, "hold", solver=settings)

    assert error_of(rows, free(1.0, 5)) <= FLOOR * 1e-4  # type: ignore[arg-type]  # two floats a row


@pytest.mark.parametrize(("longest", "steps"), [(0.05, 20), (0.03, 34), (None, 1)])
def test_no_step_is_longer_than_the_user_allows(
    longest: float | None, steps: int, event_fmu: EventFmu, tmp_path: Path
) -> None:
    """A loose tolerance allows a step from point to point, once the first step size has grown."""
    fmu = event_fmu("Oscillator", 2)
    options = StepOptions(SolverSettings("dopri5", 1e3, longest))
    with closing(open_instance(fmu, "m", read_description(fmu, kind="model_exchange"), tmp_path, options=options)) as m:
        m.enter_initialization(0.0, None, {"mu": 0.0})
        m.exit_initialization()
        counts = [0]
        for point in range(5):
            m.advance(1.0 * point, 1.0)
            counts += m.get_values(["completed_steps"])  # type: ignore[arg-type]  # integers

    assert counts[-1] - counts[-2] == steps


def test_without_the_library_the_solver_is_refused(
    event_fmu: EventFmu, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(LIBRARY_VARIABLE, "none")
    fmu, solver = str(event_fmu("Oscillator", 2)), {"name": "dopri5"}
    instances = {"m": {"fmu": fmu, "kind": "model_exchange", "solver": solver}}

    with pytest.raises(ConfigurationError) as refused:
        prepare(write_config(tmp_path, instances=instances, connections=[]))

    text = str(refused.value)
    assert "instances.m.solver.name" in text
    assert "dopri5, whose steps the library of C takes; it is not used" in text
    assert "`cvode`" in text


def test_a_stiff_model_is_told_once_and_solved(event_fmu: EventFmu, tmp_path: Path) -> None:
    messages: list[LogMessage] = []
    options = StepOptions(SolverSettings("dopri5"))
    fmu = event_fmu("Winding", 2)
    description = read_description(fmu, kind="model_exchange")
    with closing(open_instance(fmu, "m", description, tmp_path, messages.append, options=options)) as winding:
        winding.enter_initialization(0.0, None, {"U": 1.0, "w": 2.0, "L": 1e-4})
        winding.exit_initialization()
        rings = Ring(Layout.of([("U", "Float64")]), 1), (Ring(Layout.of([("I", "Float64")]), 1),)
        rings[0].put(0, "U", 1.0)
        winding.bind(*rings, TimeGrid(0.0, 0.1, 10), 1)
        for step in range(10):
            winding.do_step(step)
        current = winding.get_values(["I"])

    assert current == [pytest.approx(1.0 - 0.1 * 2.0, abs=1e-5)]
    [told] = [message for message in messages if message.category == "solver"]
    assert "the model is stiff" in told.message
    assert "`solver: {name: cvode}`" in told.message
