"""Model exchange with inputs that change at every point: the error of the solver, and what counts as an event."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
import pytest

from fmu_mesh.instances.fmi.archive.reading import read_description
from fmu_mesh.instances.fmi.opening import open_instance, stepped
from fmu_mesh.instances.fmi.step_options import SolverSettings, StepOptions
from fmu_mesh.rings import native
from fmu_mesh.rings.ring import Ring
from fmu_mesh.simtime import TimeGrid
from fmu_mesh.system.coupling_rule import CouplingRule
from fmu_mesh.system.layout import Layout
from fmu_mesh.system.linear_inputs import LinearInput
from fmu_mesh.variables.model_description import Kind
from fmu_mesh.variables.value_types import Value
from tests.fmus.event_fmus import Version

EventFmu = Callable[..., Path]
Solver = Literal["cvode", "dopri5", "euler"]
EXACT: tuple[Solver, ...] = ("cvode", "dopri5")
Extrapolation = Literal["hold", 0, 1]
"""Held inputs, or linear ones over a connection with this delay."""

DELAYS: tuple[Extrapolation, ...] = (0, 1)
TOLERANCES = [1e-4, 1e-6, 1e-8]
FLOOR = 200
"""The error of a run in tolerances: each of some hundred steps of the solver may add one (measured: at most 110)."""


class Driven(NamedTuple):
    """A model with an input that is a sine of 2.3 rad/s."""

    name: str
    input: str
    outputs: tuple[str, ...]
    start_values: dict[str, Value]
    stop_time: float


SYSTEMS = {
    "oscillator": Driven("Oscillator", "u", ("x", "y"), {"mu": 0.0}, 4.0),
    "stiff system": Driven("Winding", "U", ("I",), {}, 1.0),  # a time constant of 1 ms
    "bouncing ball": Driven("Ball", "u", ("h", "v"), {}, 1.5),
    "Van der Pol": Driven("Oscillator", "u", ("x", "y"), {"mu": 5.0}, 4.0),
}


def driven(
    fmu: Path,
    folder: Path,
    system: Driven,
    values: list[float],
    step_size: float,
    extrapolation: Extrapolation,
    kind: Kind = "model_exchange",
    solver: SolverSettings = SolverSettings(),  # noqa: B008 a frozen Struct
) -> list[list[Value]]:
    """The outputs after each step, with ``values`` of the input: at the start and at the end of all steps."""
    is_linear = extrapolation != "hold"
    options = StepOptions(
        linear_inputs=(LinearInput(system.input, CouplingRule(int(extrapolation), 1, 1)),) if is_linear else (),
        solver=solver,
    )
    inputs = Ring(Layout.of([(system.input, "Float64")]), 1)
    outputs = Ring(Layout.of(v for v in read_description(fmu).variables if v.name in system.outputs), 1)
    rows = []
    with closing(open_instance(fmu, "m", read_description(fmu, kind=kind), folder, options=options)) as inner:
        instance = stepped(inner, options)
        instance.enter_initialization(0.0, None, {**system.start_values, system.input: values[0]})
        instance.exit_initialization()
        instance.bind(inputs, (outputs,), TimeGrid(0.0, step_size, len(values)), 1)
        for step in range(len(values) - 1):
            inputs.put(0, system.input, values[step + 1 if extrapolation == 0 else step])
            instance.do_step(step)
            rows.append([outputs.value(0, name) for name in system.outputs])
    return rows


def sine(stop_time: float, step_size: float) -> list[float]:
    """The input at all points."""
    return [math.sin(2.3 * point * step_size) for point in range(round(stop_time / step_size) + 1)]


@pytest.mark.parametrize("name", SYSTEMS)
@pytest.mark.parametrize("method", EXACT)
def test_linear_inputs_are_more_exact_with_smaller_steps(
    method: Solver, name: str, event_fmu: EventFmu, tmp_path: Path
) -> None:
    system = SYSTEMS[name]
    fmu = event_fmu(system.name, 2)
    # The co-simulation is good to 1e-11, and the line over 2.5 ms is as good as the sine to 4e-6.
    exact = driven(fmu, tmp_path, system, sine(system.stop_time, 2.5e-3), 2.5e-3, 0, "co_simulation")[-1]

    for tolerance, delay in itertools.product(TOLERANCES, DELAYS):
        errors = []
        for step_size in (0.1, 0.025, 0.01):
            values = sine(system.stop_time, step_size)
            solver = SolverSettings(method, tolerance)
            end = driven(fmu, tmp_path, system, values, step_size, delay, solver=solver)[-1]
            errors.append(float(np.max(np.abs(np.subtract(end, exact, dtype=np.float64)))))

        floor = 1e-5 + FLOOR * tolerance
        assert all(later <= max(0.5 * before, floor) for before, later in itertools.pairwise(errors)), errors


def test_a_line_that_turns_too_sharply_begins_anew(event_fmu: EventFmu, tmp_path: Path) -> None:
    """CVode gives up after seven failures of its error test in one step, as the history does not fit the new line."""
    system = SYSTEMS["stiff system"]
    fmu = event_fmu(system.name, 2)
    values = sine(1.0, 0.1)

    rows = driven(fmu, tmp_path, system, values, 0.1, 1, solver=SolverSettings("cvode", 1e-8))

    exact = driven(fmu, tmp_path, system, values, 0.1, 1, "co_simulation")
    assert np.max(np.abs(np.subtract(rows, exact, dtype=np.float64))) <= 1e-8


@pytest.mark.parametrize("solver", ["cvode", "dopri5", "euler"])
@pytest.mark.parametrize("version", [1, 2, 3])
def test_a_line_that_goes_on_is_no_event(version: Version, solver: Solver, event_fmu: EventFmu, tmp_path: Path) -> None:
    system = Driven("Integral", "u", ("s", "events"), {"level": 100.0}, 1.0)
    fmu = event_fmu("Integral", version)
    ramp = [0.1 * point for point in range(11)]

    rows = driven(fmu, tmp_path, system, ramp, 0.1, 0, solver=SolverSettings(solver))

    # One at the end of Initialization Mode, and one at the first step.
    assert {row[1] for row in rows} == {2}
    if solver in EXACT:
        assert rows[-1][0] == pytest.approx(0.5, rel=1e-5)  # ten steps of a tolerance of 1e-6 each


@pytest.mark.skipif(native.library is None, reason="the library is not built here")
@pytest.mark.parametrize("version", [1, 2, 3])
@pytest.mark.parametrize("model", ["Oscillator", "Integral", "Ball", "Heater"])
@pytest.mark.parametrize("extrapolation", ["hold", 0, 1])
def test_what_cvode_calls_in_c_gives_the_floats_of_python(
    extrapolation: Extrapolation,
    model: str,
    version: Version,
    event_fmu: EventFmu,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    fmu = event_fmu(model, version)
    system = Driven(model, "u", tuple(v.name for v in read_description(fmu).with_causality("output")), {}, 1.0)
    rows = []
    for library in (native.library, None):
        monkeypatch.setattr(native, "library", library)
        solver = SolverSettings("cvode", 1e-6)
        rows.append(driven(fmu, tmp_path, system, sine(1.0, 0.05), 0.05, extrapolation, solver=solver))

    assert repr(rows[0]) == repr(rows[1])


@pytest.mark.parametrize("extrapolation", ["hold", 0, 1])
@pytest.mark.parametrize("solver", EXACT)
@pytest.mark.parametrize("version", [1, 2, 3])
def test_an_input_that_jumps_over_a_level_is_an_event(
    version: Version, solver: Solver, extrapolation: Extrapolation, event_fmu: EventFmu, tmp_path: Path
) -> None:
    system = Driven("Integral", "u", ("above", "last_change"), {"level": 0.5}, 1.0)
    jump = [0.0, 0.0, 0.0, 1.0, 1.0, 1.0]

    settings = SolverSettings(solver)
    rows = driven(event_fmu("Integral", version), tmp_path, system, jump, 0.5, extrapolation, solver=settings)

    # A value of the end of a step is the end of a ramp, which crosses the level in its middle.
    before, time = (2, 1.25) if extrapolation == 0 else (3, 1.5)
    assert [row[0] for row in rows] == [0] * before + [1] * (5 - before)
    assert rows[-1][1] == pytest.approx(time, abs=1e-9)  # the solver locates an event to a few units of rounding


@pytest.mark.parametrize("solver", EXACT)
@pytest.mark.parametrize("version", [1, 2, 3])
def test_a_corrected_extrapolation_that_passes_a_level_is_an_event(
    version: Version, solver: Solver, event_fmu: EventFmu, tmp_path: Path
) -> None:
    """The line ends at 0.46, and the next one begins at 0.52: too little for a jump, and the level is between."""
    system = Driven("Integral", "u", ("above", "last_change", "events"), {"level": 0.5}, 1.0)

    ramp = [0.1, 0.28, 0.52, 0.76, 1.0]
    settings = SolverSettings(solver)
    rows = driven(event_fmu("Integral", version), tmp_path, system, ramp, 0.5, 1, solver=settings)

    assert [row[0] for row in rows] == [0, 0, 1, 1]
    assert rows[-1][1] == pytest.approx(1.0, abs=1e-9)
    # At the start, at the first step, where the line begins and at the level, which takes two updates.
    assert [row[2] for row in rows] == [2, 3, 5, 5]


@pytest.mark.parametrize("version", [1, 2, 3])
def test_a_value_that_is_set_again_is_no_event(version: Version, event_fmu: EventFmu, tmp_path: Path) -> None:
    fmu = event_fmu("Stairs", version)
    with closing(open_instance(fmu, "m", read_description(fmu, kind="model_exchange"), tmp_path)) as instance:
        instance.enter_initialization(0.0, None, {"period": 100.0})
        instance.exit_initialization()

        events = []
        for value in (1, 1, 2, 2):
            instance.set_values({"increment": value})
            events += instance.get_values(["events"])

    assert events == [1, 1, 2, 2]
