"""Events and solutions of model-exchange and co-simulation FMUs against the ones on paper."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from pathlib import Path

import pytest
import yaml

from tests.fmus.event_fmus import Version
from tests.helpers import rows_of, write_config
from tests.plain_run import PlainRun
from tests.planning import prepare

EventFmu = Callable[..., Path]
Row = tuple[float, ...]

G, E, HEIGHT = 9.81, 0.7, 1.0
BOUNCES = 5


def bounce_times() -> list[float]:
    """When a ball that falls from `HEIGHT` at rest meets the ground, and keeps `E` of its velocity each time."""
    speed = math.sqrt(2.0 * G * HEIGHT)
    times = [speed / G]
    while len(times) < BOUNCES:
        speed *= E
        times.append(times[-1] + 2.0 * speed / G)
    return times


def simulated(
    folder: Path, fmu: Path, variables: list[str], *, stop_time: float, step_size: float, **instance: object
) -> list[Row]:
    """The recorded rows (time, then ``variables``) of one instance on its own."""
    config = write_config(
        folder,
        instances={"m": {"fmu": str(fmu), **instance}},
        connections=[],
        stop_time=stop_time,
        simulation={"step_size": step_size},
        record={"file": "m.csv", "variables": [f"m.{name}" for name in variables]},
    )
    PlainRun(prepare(config)).run()
    return rows_of(folder / "m.csv")


@pytest.mark.parametrize(
    ("version", "kind"),
    [*itertools.product((1, 2, 3), ("cvode", "dopri5")), (2, "co_simulation"), (3, "co_simulation")],
)
def test_a_ball_bounces_at_the_times_of_the_formula(
    version: Version, kind: str, event_fmu: EventFmu, tmp_path: Path
) -> None:
    settings: dict[str, object] = {"kind": kind}
    if kind != "co_simulation":
        settings = {"kind": "model_exchange", "solver": {"name": kind, "relative_tolerance": 1e-8}}

    rows = simulated(
        tmp_path,
        event_fmu("Ball", version),
        ["last_bounce", "bounces"],
        stop_time=2.2,
        step_size=0.01,
        **settings,
    )

    times = sorted({row[1] for row in rows if row[2]})
    assert len(times) == BOUNCES
    # 1e-6 s is what the project promises; the solver's own tolerance is a hundred times smaller.
    assert times == pytest.approx(bounce_times(), abs=1e-6, rel=0.0)


@pytest.mark.parametrize("version", [1, 2, 3])
@pytest.mark.parametrize("solver", ["cvode", "dopri5"])
def test_a_time_event_happens_exactly_where_the_fmu_says(
    solver: str, version: Version, event_fmu: EventFmu, tmp_path: Path
) -> None:
    rows = simulated(
        tmp_path,
        event_fmu("Stairs", version),
        ["last_stair", "counter"],
        stop_time=3.0,
        step_size=0.1,
        kind="model_exchange",
        solver={"name": solver},
        start_values={"period": 0.25},
    )

    assert [row[2] for row in rows] == [math.floor(row[0] / 0.25 + 1e-9) for row in rows]
    assert {row[1] for row in rows} == {number * 0.25 for number in range(13)}


@pytest.mark.parametrize("version", [1, 2, 3])
@pytest.mark.parametrize("solver", ["cvode", "dopri5", "euler"])
def test_an_input_that_jumps_over_a_level_is_integrated_as_an_event(
    version: Version, solver: str, event_fmu: EventFmu, tmp_path: Path
) -> None:
    """The steps of a stair are held inputs: the integral is a sum, which even Euler gets right."""
    config = write_config(
        tmp_path,
        instances={
            "stairs": {"fmu": str(event_fmu("Stairs", 2)), "start_values": {"period": 0.5}},
            "integral": {
                "fmu": str(event_fmu("Integral", version)),
                "kind": "model_exchange",
                "solver": {"name": solver},
                "start_values": {"level": 1.5},
            },
        },
        connections=["stairs.counter -> integral.u"],
        stop_time=3.0,
        simulation={"step_size": 0.5, "algorithm": "jacobi"},
        record={"file": "m.csv", "variables": ["integral.s", "integral.above", "integral.last_change"]},
    )

    PlainRun(prepare(config)).run()

    rows = rows_of(tmp_path / "m.csv")
    assert [row[1] for row in rows] == pytest.approx([0.0, 0.0, 0.5, 1.5, 3.0, 5.0, 7.5], rel=1e-6)
    # With a delay of one point the input is 2 from t = 1 s on.
    assert [row[2] for row in rows] == [0, 0, 0, 1, 1, 1, 1]
    assert {row[3] for row in rows[3:]} == {1.0}


@pytest.mark.parametrize("version", [1, 2, 3])
@pytest.mark.parametrize("solver", ["cvode", "dopri5"])
def test_model_exchange_agrees_with_co_simulation_of_the_same_model(
    version: Version, solver: str, event_fmu: EventFmu, tmp_path: Path
) -> None:
    def run(fmu: Path, **instance: object) -> list[Row]:
        return simulated(tmp_path, fmu, ["x", "y"], stop_time=20.0, step_size=0.1, **instance)

    ours = run(
        event_fmu("Oscillator", version), kind="model_exchange", solver={"name": solver, "relative_tolerance": 1e-9}
    )
    theirs = run(event_fmu("Oscillator", 2), kind="co_simulation")

    # The co-simulation is good to 1e-11. A local tolerance of 1e-9 per step becomes a phase error of the cycle.
    for row, other in zip(ours, theirs, strict=True):
        assert row == pytest.approx(other, abs=1e-6, rel=0.0)


@pytest.mark.parametrize(
    ("version", "kind"), [(2, "co_simulation"), (1, "model_exchange"), (2, "model_exchange"), (3, "model_exchange")]
)
@pytest.mark.parametrize("delay", [0, 1])
def test_the_integral_of_a_ramp_is_right_if_the_input_changes_linearly(
    version: Version, kind: str, delay: int, event_fmu: EventFmu, tmp_path: Path
) -> None:
    """Held inputs would be wrong by half a step of the ramp each time: at t = 1 s by 0.05."""
    ramp = {"fmu": str(event_fmu("Integral", 2)), "start_values": {"u": 1.0}}
    square: dict[str, object] = {"fmu": str(event_fmu("Integral", version)), "kind": kind}
    if kind == "model_exchange":
        square["solver"] = {"relative_tolerance": 1e-9}
    config = write_config(
        tmp_path,
        instances={"ramp": ramp, "square": square},
        connections=[],
        stop_time=1.0,
        simulation={"step_size": 0.1},
        record={"file": "m.csv", "variables": ["square.s"]},
    )
    content = yaml.safe_load(config.read_text(encoding="utf-8"))
    content["connections"] = [{"from": "ramp.s", "to": "square.u", "extrapolation": "linear", "delay": delay}]
    config.write_text(yaml.safe_dump(content), encoding="utf-8")

    PlainRun(prepare(config)).run()

    # With a delay of one point, the slope of the first step is not known yet: there the input is 0.
    missing = 0.005 if delay else 0.0
    for row in rows_of(tmp_path / "m.csv")[1:]:
        assert row[1] == pytest.approx(row[0] ** 2 / 2 - missing, abs=1e-6, rel=0.0)
