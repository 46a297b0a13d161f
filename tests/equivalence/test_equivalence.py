"""The result of processes equals that of a plain FMPy loop in every float of every row (invariant 1)."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import pytest
import yaml

from fmu_mesh.run.options import PlanOptions
from tests.equivalence.reference import Reference, as_bits, read_csv, reference_of, run_fmpy
from tests.helpers import FMUS, Place
from tests.plain_run import PlainRun
from tests.planning import prepare

CONFIGS = Path(__file__).resolve().parents[2] / "configs"
PENDULUM, CHAPTER, CHAIN, CYCLE = "pendulum_delay", "chapter_library_example", "chain8", "cycle2"

WINDOWS = [1, 16, 256, "auto"]
GAUSS_SEIDEL, JACOBI = "gauss_seidel", "jacobi"

Edit = Callable[[dict[str, Any]], None]


def rewritten(name: str, folder: Path, edit: Edit) -> Path:
    """A copy of a kept configuration with changes; by default, every output that is connected is recorded."""
    content = yaml.safe_load((CONFIGS / f"{name}.yaml").read_text(encoding="utf-8"))
    for instance in content["instances"].values():
        instance["fmu"] = str(FMUS / Path(instance["fmu"]).name)
    content["record"].setdefault("variables", [c.split(" -> ")[0] for c in content["connections"]])
    edit(content)
    return written(content, folder)


def written(content: Mapping[str, Any], folder: Path) -> Path:
    path = folder / "mesh.yaml"
    path.write_text(yaml.safe_dump({**content, "mesh": "m"}, sort_keys=False), encoding="utf-8")
    return path


def shortened(points: int, algorithm: str, window: int | str = "auto") -> Edit:
    """Fewer points, and transport delays so short that what goes into them comes out of them."""

    def edit(content: dict[str, Any]) -> None:
        simulation = content["simulation"]
        step_size = simulation["step_size"]
        simulation |= {"stop_time": points * step_size, "algorithm": algorithm, "window": window}
        for instance in content["instances"].values():
            if instance["fmu"].endswith("TransportDelay.fmu"):
                instance["start_values"]["d"] = 10.5 * step_size

    return edit


def grouped(points: int, algorithm: str, groups: Mapping[str, str]) -> Edit:
    def edit(content: dict[str, Any]) -> None:
        shortened(points, algorithm)(content)
        for name, group in groups.items():
            content["instances"][name]["group"] = group

    return edit


def launched(place: Place, config: Path, *arguments: str) -> bytes:
    """The result of a run, as bytes."""
    output = place.folder / "result.csv"
    process = place.start("launch", config, "--no-progress", "--output", output, *arguments)
    assert process.wait(50.0) == 0, process.errors
    return output.read_bytes()


def in_this_process(place: Place, config: Path) -> bytes:
    """The result of the same plan in one process."""
    output = place.folder / "local.csv"
    PlainRun(prepare(config, PlanOptions(output=output))).run()
    return output.read_bytes()


def assert_result(content: bytes, reference: Reference) -> None:
    header, rows = read_csv(content)
    assert header == ["time", *(f"{name}.{output}" for name, output in reference.recorded)]
    expected = run_fmpy(reference)
    assert len(rows) == len(expected) == reference.last_point + 1
    pairs = zip(as_bits(rows), as_bits(expected), strict=True)
    different = [point for point, (row, other) in enumerate(pairs) if row != other]
    assert not different, f"{len(different)} rows: {rows[different[0]]} where {expected[different[0]]} is expected"


def cycle_of_two(config: Path, algorithm: str) -> Reference:
    """Gauss-Seidel puts the delay on the connection that closes the cycle: the one that the file names last."""
    delays = {"velocity.y -> position.u": int(algorithm == JACOBI), "position.y -> velocity.u": 1}
    return reference_of(config, delays, order=["velocity", "position"])


def assert_equivalent(place: Place, config: Path, reference: Reference) -> None:
    content = launched(place, config)
    assert_result(content, reference)
    assert content == in_this_process(place, config)


# ---- the kept configurations as they are


@pytest.mark.parametrize("name", [PENDULUM, CHAPTER])
def test_a_kept_configuration_gives_equal_floats_in_processes_locally_and_in_fmpy(name: str, place: Place) -> None:
    content = launched(place, CONFIGS / f"{name}.yaml")

    assert_result(content, reference_of(CONFIGS / f"{name}.yaml", {"pendulum.a -> delay.x": 0}))
    assert content == launched(place, CONFIGS / f"{name}.yaml", "--local")


# ---- windows and algorithms


@pytest.mark.parametrize(
    ("name", "window", "algorithm"),
    [
        *((PENDULUM, window, algorithm) for window in WINDOWS for algorithm in (GAUSS_SEIDEL, JACOBI)),
        *((CHAPTER, window, GAUSS_SEIDEL) for window in WINDOWS),
        (CHAPTER, "auto", JACOBI),
    ],
)
def test_any_window_and_algorithm_gives_the_same_floats(
    name: str, window: int | str, algorithm: str, place: Place
) -> None:
    points = 200 if window == 1 else 1500
    config = rewritten(name, place.folder, shortened(points, algorithm, window))

    assert_equivalent(place, config, reference_of(config, {"pendulum.a -> delay.x": int(algorithm == JACOBI)}))


@pytest.mark.parametrize(("algorithm", "window"), [(GAUSS_SEIDEL, "auto"), (GAUSS_SEIDEL, 16), (JACOBI, "auto")])
def test_eight_instances_in_a_row_give_the_same_floats(algorithm: str, window: int | str, place: Place) -> None:
    config = rewritten(CHAIN, place.folder, shortened(600, algorithm, window))

    assert_equivalent(place, config, reference_of(config, {}, default_delay=int(algorithm == JACOBI)))


@pytest.mark.parametrize(
    ("algorithm", "window"), [(JACOBI, 1), (JACOBI, 16), (JACOBI, 256), (JACOBI, "auto"), (GAUSS_SEIDEL, "auto")]
)
def test_a_cycle_of_two_gives_the_same_floats(algorithm: str, window: int | str, place: Place) -> None:
    config = rewritten(CYCLE, place.folder, shortened(200 if window == 1 else 600, algorithm, window))

    assert_equivalent(place, config, cycle_of_two(config, algorithm))


# ---- groups


CHAIN_NAMES = ("pendulum", "gain_1", "delay_1", "integrator", "delay_2", "gain_2", "delay_3", "gain_3")


@pytest.mark.parametrize(
    "groups",
    [
        pytest.param(dict.fromkeys(CHAIN_NAMES, "all"), id="all in one"),
        pytest.param({name: f"pair_{place // 2}" for place, name in enumerate(CHAIN_NAMES)}, id="pairs"),
        pytest.param({name: f"side_{place % 2}" for place, name in enumerate(CHAIN_NAMES)}, id="alternating"),
    ],
)
def test_a_chain_gives_the_same_floats_in_any_groups(groups: Mapping[str, str], place: Place) -> None:
    config = rewritten(CHAIN, place.folder, grouped(600, GAUSS_SEIDEL, groups))

    assert_equivalent(place, config, reference_of(config, {}))


@pytest.mark.parametrize("algorithm", [GAUSS_SEIDEL, JACOBI])
def test_a_cycle_in_one_group_gives_the_same_floats(algorithm: str, place: Place) -> None:
    config = rewritten(CYCLE, place.folder, grouped(6000, algorithm, {"position": "loop", "velocity": "loop"}))

    assert_equivalent(place, config, cycle_of_two(config, algorithm))


# ---- instances with step sizes of their own


H = 0.0078125
"""A step size whose multiples are exact, so that the end of a step is the start of the next one for every FMU."""


def multi_rate(algorithm: str, groups: Sequence[str], step_size: float, window: int | str = "auto") -> dict[str, Any]:
    """Fast to slow (2, 5 and 3 points), slow to fast, and slow to slow; 3 does not divide the number of points."""
    members: dict[str, tuple[str, dict[str, float], int]] = {
        "pendulum": ("DampedPendulum", {"a": 1.3}, 1),
        "slow_2": ("TransportDelay", {"d": 0.1}, 2),
        "slow_5": ("Integrator", {"k": 1.5, "y": 0.2}, 5),
        "slow_3": ("TransportDelay", {"d": 0.05}, 3),
        "fast": ("Integrator", {"k": -0.7}, 1),
        "sum": ("Adder", {}, 2),
    }
    return {
        "simulation": {"stop_time": 400 * step_size, "step_size": step_size, "algorithm": algorithm, "window": window},
        "instances": {
            name: {"fmu": str(FMUS / f"{fmu}.fmu"), "start_values": start_values, "step_size": points * step_size}
            | ({"group": group} if group else {})
            for (name, (fmu, start_values, points)), group in zip(members.items(), groups, strict=True)
        },
        "connections": [
            "pendulum.a -> slow_2.x",
            "pendulum.a -> slow_5.u",
            "slow_2.y -> slow_3.x",
            "slow_5.y -> fast.u",
            "fast.y -> sum.u1",
            "slow_3.y -> sum.u2",
        ],
        "record": {"variables": ["pendulum.a", "slow_2.y", "slow_5.y", "slow_3.y", "fast.y", "sum.y"]},
    }


APART = ("",) * 6
MIXED = ("left", "right", "left", "right", "left", "right")
TOGETHER = ("all",) * 6


@pytest.mark.parametrize(
    ("algorithm", "groups", "window"),
    [
        (GAUSS_SEIDEL, APART, "auto"),
        (JACOBI, APART, "auto"),
        (GAUSS_SEIDEL, MIXED, 1),
        (JACOBI, MIXED, 3),
        (GAUSS_SEIDEL, TOGETHER, "auto"),
        (JACOBI, TOGETHER, 16),
    ],
)
def test_instances_with_step_sizes_of_their_own_give_the_same_floats(
    algorithm: str, groups: Sequence[str], window: int | str, place: Place
) -> None:
    config = written(multi_rate(algorithm, groups, H, window), place.folder)

    assert_equivalent(place, config, reference_of(config, {}, default_delay=int(algorithm == JACOBI)))


def test_a_slow_instance_is_told_the_times_of_the_communication_points(place: Place) -> None:
    """Times are one product of a point and the base step size, whatever the instance's own step size is."""
    config = written(multi_rate(GAUSS_SEIDEL, TOGETHER, 0.01), place.folder)

    assert_result(in_this_process(place, config), reference_of(config, {}))


@pytest.mark.parametrize("algorithm", [GAUSS_SEIDEL, JACOBI])
@pytest.mark.parametrize("group", [None, "loop"])
def test_a_cycle_of_two_rates_gives_the_same_floats(algorithm: str, group: str | None, place: Place) -> None:
    def edit(content: dict[str, Any]) -> None:
        content["simulation"] |= {"stop_time": 500 * H, "step_size": H, "algorithm": algorithm}
        for name, points in (("position", 2), ("velocity", 3)):
            content["instances"][name] |= {"step_size": points * H, "group": group}

    config = rewritten(CYCLE, place.folder, edit)

    assert_equivalent(place, config, cycle_of_two(config, algorithm))
