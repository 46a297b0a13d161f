"""A profiled run is a run like any other: the same numbers, and figures that can be true."""

from __future__ import annotations

import json
from collections.abc import Iterator
from typing import Any

import pytest

from tests.helpers import Place, write_config

GAIN = {"fmu": "Gain"}
INTEGRATOR = {"fmu": "Integrator"}
INSTANCES: dict[str, dict[str, Any]] = {
    "pendulum": {"fmu": "DampedPendulum", "start_values": {"a": 1.0}},
    "position": {**INTEGRATOR, "group": "oscillator"},
    "velocity": {**INTEGRATOR, "group": "oscillator", "start_values": {"k": -1.0}},
    "gain": {**GAIN, "group": "oscillator"},
    "slow": {"fmu": "Integrator", "step_size": 0.004},
}
CONNECTIONS = [
    "pendulum.a -> gain.u",
    "gain.y -> slow.u",
    "slow.y -> position.u",
    "position.y -> velocity.u",
]


@pytest.fixture
def place() -> Iterator[Place]:
    with Place() as place:
        yield place


def test_a_profiled_run_has_equal_numbers_and_a_trace_of_every_node(place: Place) -> None:
    config = write_config(place.folder, instances=INSTANCES, connections=CONNECTIONS, name="five")

    run = place.run("launch", config, "--profile", "trace.json")
    local = place.run("launch", config, "--local", "--output", "local.csv")

    assert (run.wait(), local.wait()) == (0, 0), run.errors + local.errors
    assert (place.folder / "five.csv").read_bytes() == (place.folder / "local.csv").read_bytes()
    lines = run.output.splitlines()
    assert lines[0] == "Profile"
    assert lines[-1].startswith("1000 points in ")
    summary = json.loads((place.folder / "trace.json").read_bytes())["otherData"]["fmu_mesh"]
    steps = {name: unit["steps"] for node in summary["nodes"] for unit in node["units"] for name in unit["instances"]}
    assert steps == {"pendulum": 1000, "position": 1000, "velocity": 1000, "gain": 1000, "slow": 250}
    for node in summary["nodes"]:
        parts = [node["compute_s"], node["transport_s"], *node["wait_s"].values()]
        assert all(part >= 0.0 for part in parts)
        assert sum(parts) <= node["seconds"] * 1.02 + 0.01
        assert set(node["wait_s"]) <= {*INSTANCES, "grant"}


def test_a_master_by_hand_asks_nodes_by_hand_for_their_profile(place: Place) -> None:
    config = write_config(place.folder)

    nodes = [place.start("node", config, name) for name in ("pendulum", "delay")]
    master = place.run("master", config, "--profile")

    assert [master.wait(), *(node.wait() for node in nodes)] == [0, 0, 0], master.errors
    assert master.output.startswith("Profile\n  node      instance  steps")


def test_a_profile_of_a_run_by_the_wall_clock_names_wall_clock(place: Place) -> None:
    config = write_config(place.folder, stop_time=0.5, simulation={"real_time_factor": 1})

    run = place.run("launch", config, "--profile")

    assert run.wait() == 0, run.errors
    assert " for the grant, which the wall clock holds back" in run.output
