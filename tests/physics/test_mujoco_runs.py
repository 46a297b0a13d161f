"""The chapter's runs with a physics engine, against solutions of other solvers and what the publications report.

The configurations run as they are kept, or with one thing changed. A tolerance is the one that the run was asked to
keep, and says what causes the difference.
"""

from __future__ import annotations

import csv
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

import fmu_mesh
from fmu_mesh.run.options import PlanOptions
from tests.helpers import Place, write_config
from tests.plain_run import PlainRun
from tests.planning import prepare

ROOT = Path(__file__).resolve().parents[2]
CONFIGS = ROOT / "configs"

FLAGS = '<flag eulerdamp="disable" contact="disable"/>'
IMPLICIT = (FLAGS, '<flag contact="disable"/>')
RK4 = ('integrator="Euler"', 'integrator="RK4"')
JACOBI = ("gauss_seidel", "jacobi")
MILLISECOND = "step_size: 0.001"

Floats = NDArray[np.float64]
Columns = dict[str, Floats]
Run = Callable[..., Columns]


def columns_of(path: Path) -> Columns:
    with path.open(newline="") as file:
        names, *rows = csv.reader(file)
    return dict(zip(names, np.array(rows, dtype=np.float64).T, strict=True))


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Run:
    """Run a kept configuration in this process, with parts of it and of its world replaced; the columns by name."""
    known: dict[tuple[object, ...], Columns] = {}

    def result(name: str, *replaced: tuple[str, str], start_values: tuple[str, ...] = ()) -> Columns:
        key = (name, replaced, start_values)
        if key not in known:
            folder = tmp_path_factory.mktemp("run")
            config = changed(name, folder, replaced)
            output = folder / "result.csv"
            PlainRun(prepare(config, PlanOptions(start_values=start_values, output=output))).run()
            known[key] = columns_of(output)
        return known[key]

    return result


def changed(name: str, folder: Path, replaced: tuple[tuple[str, str], ...]) -> Path:
    """A copy of a configuration and its world with every pair replaced in one of them."""
    config = (CONFIGS / f"{name}.yaml").read_text(encoding="utf-8").replace("../fmus", str(ROOT / "fmus"))
    world = (CONFIGS / "worlds" / f"{name}.xml").read_text(encoding="utf-8")
    for old, new in replaced:
        assert (old in config) != (old in world), old
        config, world = config.replace(old, new), world.replace(old, new)
    (folder / "worlds").mkdir()
    (folder / "worlds" / f"{name}.xml").write_text(world, encoding="utf-8")
    path = folder / f"{name}.yaml"
    path.write_text(config, encoding="utf-8")
    return path


# --- the damped pendulum (figure 10)


def pendulum_angle(times: Floats) -> Floats:
    """The angle of the pendulum in rad from its equation, by a solver of order 8.

    ``I q'' = -m g l cos(q) - d q'`` with I = m l² + 0.001 kg m², m = 1 kg, l = 1 m, g = 9.8 m/s², d = 0.1 N m s/rad,
    from rest at q = 0, which is horizontal.
    """

    def derivative(_time: float, state: Floats) -> tuple[float, float]:
        return state[1], (-9.8 * np.cos(state[0]) - 0.1 * state[1]) / 1.001

    solution = solve_ivp(derivative, (0.0, 10.0), (0.0, 0.0), "DOP853", t_eval=times, rtol=1e-12, atol=1e-12)
    angle: Floats = solution.y[0]
    return angle


def pair(columns: Columns) -> tuple[Floats, Floats]:
    """Angles of the pendulum that the engine damps, and of the one that the FMU damps."""
    return columns["world.engine.position"], columns["world.fmu.position"]


def test_damping_by_an_fmu_equals_damping_by_the_engine_in_every_float(place: Place, run: Run) -> None:
    output = place.folder / "result.csv"

    launched = place.run(
        *("launch", CONFIGS / "damped_pendulum.yaml", "--no-progress", "--output", output), deadline_s=200.0
    )

    assert "10000 points" in launched.output, launched.errors
    by_engine, by_fmu = pair(columns_of(output))
    assert by_fmu.tolist() == by_engine.tolist()
    assert by_fmu.tolist() == pair(run("damped_pendulum"))[1].tolist()
    assert len(by_fmu) == 10001
    place.assert_nothing_left(5.0)


@pytest.mark.parametrize(
    ("replaced", "tolerance"),
    [
        # The engine's damping is implicit, that of the FMU holds the velocity of the point over the step.
        pytest.param((IMPLICIT,), 2e-3, id="implicit damping"),
        # The engine evaluates its damping at every stage, the torque of the FMU is held.
        pytest.param((IMPLICIT, RK4), 1e-3, id="Runge-Kutta"),
        # The torque is one point older.
        pytest.param((JACOBI,), 3e-3, id="Jacobi"),
    ],
)
def test_other_ways_to_integrate_the_damping_are_close_but_not_equal(
    run: Run, replaced: tuple[tuple[str, str], ...], tolerance: float
) -> None:
    by_engine, by_fmu = pair(run("damped_pendulum", *replaced))

    assert 0.0 < np.abs(by_fmu - by_engine).max() < tolerance


def test_the_pendulum_swings_as_its_equation_says(run: Run) -> None:
    columns = run("damped_pendulum", IMPLICIT, RK4)
    _, by_fmu = pair(columns)

    at = np.array([1.0, 2.0, 5.0, 10.0])
    reference = pendulum_angle(at)
    angles = by_fmu[(at * 1000).astype(int)]

    # The published figures have six decimals.
    assert reference == pytest.approx([-2.894207, -0.682642, -1.152221, -2.478352], abs=1e-6)
    assert angles == pytest.approx(reference, abs=1e-3)


def test_the_error_has_order_one_and_is_larger_with_jacobi(run: Run) -> None:
    steps = (1, 2, 10, 20)
    reference = pendulum_angle(np.linspace(0.0, 10.0, 10001))
    errors: dict[str, list[float]] = {"gauss_seidel": [], "jacobi": []}
    for algorithm, found in errors.items():
        for step in steps:
            size = () if step == 1 else ((MILLISECOND, f"step_size: {step / 1000}"),)
            other = () if algorithm == "gauss_seidel" else (JACOBI,)
            _, by_fmu = pair(run("damped_pendulum", IMPLICIT, RK4, *other, *size))
            found.append(float(np.abs(by_fmu - reference[::step]).max()))

    for found in errors.values():
        # Order one: twice the step, twice the error; up to a tenth, which terms of second order take.
        assert [error / found[0] for error in found] == pytest.approx(steps, rel=0.1)
    ratios = np.array(errors["jacobi"]) / np.array(errors["gauss_seidel"])
    assert (ratios > 2.5).all()


# --- the electrical actuator (figure 20)


def peak_and_settling(columns: Columns, joint: str) -> tuple[float, float]:
    """The highest angle in rad, and the time in s from which it stays within 5 % of the target, 1 rad."""
    angle = columns[f"world.{joint}.position"]
    outside = np.flatnonzero(np.abs(angle - 1.0) > 0.05)
    return float(angle.max()), float(columns["time"][outside[-1] + 1])


def test_the_actuator_overshoots_and_settles_as_it_should(run: Run) -> None:
    columns = run("electrical_actuator")

    found = {joint: peak_and_settling(columns, joint) for joint in ("bare", "weak", "tuned")}

    assert {joint: peak for joint, (peak, _) in found.items()} == {
        "bare": pytest.approx(1.171, rel=0.01),
        "weak": pytest.approx(1.229, rel=0.01),
        "tuned": pytest.approx(1.113, rel=0.01),
    }
    assert {joint: time for joint, (_, time) in found.items()} == {
        "bare": pytest.approx(1.67, rel=0.02),
        "weak": pytest.approx(14.6, rel=0.02),
        "tuned": pytest.approx(3.40, rel=0.02),
    }


def test_with_the_published_motor_constant_it_overshoots_more(run: Run) -> None:
    constants = ("weak_motor.motorConstant=1e-3", "tuned_motor.motorConstant=1e-3")
    columns = run("electrical_actuator", start_values=constants)

    assert columns["world.weak.position"].max() == pytest.approx(1.861, rel=0.01)
    assert columns["world.tuned.position"].max() == pytest.approx(1.262, rel=0.01)


def test_an_actuator_that_is_not_enabled_is_as_if_there_were_none(run: Run) -> None:
    off = ("instance: weak_motor, disable", "instance: weak_motor, enabled: false, disable")
    short = ("stop_time: 20.0", "stop_time: 1.0")

    columns = run("electrical_actuator", off, short)

    assert columns["world.weak.position"].tolist() == columns["world.bare.position"].tolist()


# --- fluid dynamics


def test_a_cube_stops_in_the_fluid_and_goes_on_without_it(run: Run) -> None:
    columns = run("fluid_body")

    assert 0.096 < columns["world.cube.position_x"][-1] < 0.1
    assert columns["world.free_cube.position_x"][-1] == pytest.approx(2.0, abs=1e-3)


def test_a_cube_in_a_wind_ends_up_with_its_velocity(run: Run) -> None:
    columns = run("fluid_body", start_values=("world.wind_x=0.5",))

    # x = w t + (v0 - w) m/D (1 - exp(-D t/m)): 1 m of wind and 0.05 m of its own; what a step of 1 ms adds is below it.
    assert columns["world.cube.position_x"][-1] == pytest.approx(1.05, abs=1e-3)
    assert columns["world.cube.relative_velocity_x"][-1] == pytest.approx(0.0, abs=1e-6)


# --- distributed


SLOW_DAMPER = ("    start_values: {d: 0.1}", "    step_size: 0.005\n    start_values: {d: 0.1}")
SLOW_WORLD = ("    mujoco: worlds/", "    step_size: 0.002\n    mujoco: worlds/")
SHORT = {"electrical_actuator": "20.0", "fluid_body": "2.0", "damped_pendulum": "10.0"}


@pytest.mark.parametrize(
    ("name", "replaced"),
    [
        pytest.param("electrical_actuator", (), id="controllers and actuators"),
        pytest.param("fluid_body", (), id="fluid dynamics"),
        pytest.param("damped_pendulum", (SLOW_DAMPER,), id="a slower actuator"),
        pytest.param("damped_pendulum", (SLOW_WORLD,), id="a slower world"),
    ],
)
def test_every_instance_in_a_process_of_its_own_gives_the_same_floats(
    place: Place, run: Run, name: str, replaced: tuple[tuple[str, str], ...]
) -> None:
    short = (f"stop_time: {SHORT[name]}", "stop_time: 0.2")
    grouped = (("group: auto", "group: null"),) if name != "damped_pendulum" else ()
    alone = changed(name, place.folder, (short, *replaced, *grouped))
    output = place.folder / "result.csv"

    launched = place.run("launch", alone, "--no-progress", "--output", output)

    assert launched.wait() == 0, launched.errors
    expected = run(name, short, *replaced)
    assert {key: column.tolist() for key, column in columns_of(output).items()} == {
        key: column.tolist() for key, column in expected.items()
    }


# --- a body that is placed while the mesh runs


def test_placed_body_moves_alike_in_processes_program_and_rerun(tmp_path: Path) -> None:
    state = [1.0, 2.0, 3.0, 0.5, 0.5, -0.5, 0.5, 0.25, -0.5, 0.75, 1.5, -2.5, 0.125]
    names = [
        "position_x",
        "position_z",
        "orientation_w",
        "linear_velocity_y",
        "angular_velocity_z",
        "body_linear_velocity_x",
    ]
    variables = [f"world.free_cube.{own}" for own in names]
    config = write_config(
        tmp_path,
        name="placed",
        instances={"world": {"mujoco": str(CONFIGS / "worlds/fluid_body.xml"), "keyframe": "moving"}},
        connections=(),
        stop_time=0.2,
        record={"file": "placed.csv", "variables": [*variables, "world.free_cube.pose"]},
    )
    with fmu_mesh.load(config).start(paused=True) as run:
        run.step(50)
        run.set("world.free_cube.state", state)
        run.step(50)
        run.set("world.free_cube.state", state)  # again, although nothing else was set meanwhile
        run.resume()
        result = run.wait()
    again = fmu_mesh.rerun(tmp_path / "placed.csv")
    with fmu_mesh.load(config).open() as system:
        system.step(50)
        system.set("world.free_cube.state", state)
        system.step(50)
        half = system.get("world.free_cube.position_x")
        system.set("world.free_cube.state", state)
        system.step(100)
        alone = [system.get(f"world.free_cube.{own}") for own in names]

    columns = [result[f"world.free_cube.{own}"].tolist() for own in names]
    assert [own[-1] for own in columns] == alone
    assert columns == [again[f"world.free_cube.{own}"].tolist() for own in names]
    moved = columns[0]
    assert (moved[100], moved[50] == moved[51]) == (half, False)
    assert moved[101] == moved[51] != moved[50], "the first step from the state, both times"
    assert moved[51] == pytest.approx(1.0 + 0.25 * 0.001, rel=1e-12)
    pose = [result[f"world.free_cube.pose[{number}]"][51] for number in (1, 3, 4)]
    assert pose == [moved[51], columns[1][51], columns[2][51]]
