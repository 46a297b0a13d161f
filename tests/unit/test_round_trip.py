"""What a round trip costs, in sentences: lower limits that follow from windows and from the delays of cycles."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

import fmu_mesh
from fmu_mesh.cli.main import main
from fmu_mesh.config.yaml_text import Plain
from fmu_mesh.run.options import PlanOptions
from fmu_mesh.system.round_trip import round_trip_cost
from tests.helpers import FMUS
from tests.planning import prepare

CONFIGS = Path(__file__).parents[2] / "configs"
RATES = """\
mesh: rates
simulation: {stop_time: 4.0, step_size: 0.01, window: 64, algorithm: ALGORITHM}
instances:
  a: {fmu: FMUS/Integrator.fmu}
  b: {fmu: FMUS/Gain.fmu, step_size: 0.02, group: GROUP}
  c: {fmu: FMUS/Gain.fmu, group: GROUP}
connections: [a.y -> b.u, b.y -> c.u, c.y -> a.u]
"""


@pytest.mark.parametrize(
    ("window", "round_trip_s", "sentence"),
    [
        (1, 0.05, "window 1: between hosts at least 0.05 s per point, 1000 s for 20000 points"),
        (1, 0.0001, "window 1: between hosts at least 0.0001 s per point, 2 s for 20000 points"),
        (100, 0.05, "window 100: between hosts at most 2000 points/s"),
    ],
)
def test_a_window_limits_the_speed(window: int, round_trip_s: float, sentence: str) -> None:
    plan = prepare(CONFIGS / "pendulum_delay.yaml", PlanOptions(window=window))

    assert round_trip_cost(plan, round_trip_s) == [sentence]


def test_an_open_end_has_no_sum() -> None:
    plan = prepare(CONFIGS / "pendulum_delay.yaml", PlanOptions(window=1, config_values={"simulation.stop_time": None}))

    assert round_trip_cost(plan, 0.05) == ["window 1: between hosts at least 0.05 s per point"]


@pytest.mark.parametrize(
    ("algorithm", "group", "cost"),
    [
        ("jacobi", "null", "at least 0.01 s per point, 4 s for 400 points"),  # delays of 1, 2 and 2 points
        ("gauss_seidel", "null", "at least 0.05 s per point, 20 s for 400 points"),
        ("gauss_seidel", "near", "at least 0.05 s per point, 20 s for 400 points"),
    ],
)
def test_a_cycle_waits_for_all_that_its_delays_do_not_cover(
    algorithm: str, group: str, cost: str, tmp_path: Path
) -> None:
    file = tmp_path / "rates.yaml"
    text = RATES.replace("ALGORITHM", algorithm).replace("GROUP", group).replace("FMUS", str(FMUS))
    file.write_text(text, encoding="utf-8")

    window, cycle = round_trip_cost(prepare(file), 0.05)

    assert window == "window 64: between hosts at most 1280 points/s"
    assert cycle.endswith(f": if it is on several hosts, {cost}")


def test_one_process_has_no_network() -> None:
    groups: dict[str, Plain] = {"instances.position.group": "one", "instances.velocity.group": "one"}

    plan = prepare(CONFIGS / "cycle2.yaml", PlanOptions(config_values=groups))

    assert round_trip_cost(plan, 0.05) == ["one process: nothing goes between hosts"]


def test_check_says_it_as_text_and_as_json(capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["check", str(CONFIGS / "pendulum_delay.yaml"), "--window", "1", "--round-trip", "0.05"]
    said = fmu_mesh.load(CONFIGS / "pendulum_delay.yaml").check(window=1).at_round_trip(0.05)

    assert main(arguments) == 0
    assert capsys.readouterr().out.endswith(f"\nBetween hosts, with a round trip of 0.05 s\n{said[0]}\n")
    assert main([*arguments, "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["round_trip"] == said


@pytest.mark.parametrize("given", ["0", "-1", "nan", "fast"])
def test_a_round_trip_is_a_time(given: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["check", str(CONFIGS / "pendulum_delay.yaml"), f"--round-trip={given}"]) == 2
    assert "--round-trip" in capsys.readouterr().err
