"""Runs with an ONNX model: in processes and in one process the same floats, and those that the model computes."""

from __future__ import annotations

import csv
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime
import pytest
import yaml

from tests.helpers import FMUS, Place
from tests.onnx_models import Nodes, write_model, write_network

INTEGRATOR = f"{FMUS}/Integrator.fmu"
GAIN = f"{FMUS}/Gain.fmu"
PENDULUM = f"{FMUS}/DampedPendulum.fmu"
Rows = list[dict[str, str]]


def written(folder: Path, instances: dict[str, Any], connections: Sequence[Any], **simulation: Any) -> Path:  # noqa: ANN401  of any key
    """A configuration beside the network `policy.onnx`, which has two elements in its input."""
    write_network(folder / "policy.onnx", inputs=2)
    content = {
        "mesh": "m",
        "simulation": {"stop_time": 4.0, "step_size": 0.01, **simulation},
        "instances": instances,
        "connections": list(connections),
        "record": {"file": "m.csv"},
    }
    path = folder / "mesh.yaml"
    path.write_text(yaml.safe_dump(content, sort_keys=False), encoding="utf-8")
    return path


def rows_of_both(place: Place, config: Path) -> Rows:
    """The rows of a distributed run, which have to be those of a run in one process, byte by byte."""
    files = [place.folder / "distributed.csv", place.folder / "local.csv"]
    for file, options in zip(files, ([], ["--local"]), strict=True):
        done = place.run("launch", config, "--no-progress", "--output", file, *options)
        assert done.wait() == 0, done.errors
    assert files[0].read_bytes() == files[1].read_bytes()
    return [*csv.DictReader(files[0].read_text(encoding="utf-8").splitlines())]


def column(rows: Rows, name: str) -> list[float]:
    return [float(row[name]) for row in rows]


def answers(folder: Path, *inputs: Sequence[float]) -> list[float]:
    """What onnxruntime itself computes for each row of inputs."""
    session = onnxruntime.InferenceSession(folder / "policy.onnx", providers=["CPUExecutionProvider"])
    rows = np.array([*zip(*inputs, strict=True)], dtype=np.float32)
    return [float(session.run(None, {"observation": row[None]})[0][0, 0]) for row in rows]


@pytest.mark.parametrize(("algorithm", "window"), [("gauss_seidel", "auto"), ("gauss_seidel", 1), ("jacobi", 16)])
def test_a_chain_has_the_floats_of_the_model(algorithm: str, window: int | str, place: Place) -> None:
    instances = {
        "pendulum": {"fmu": PENDULUM},
        "policy": {"onnx": "policy.onnx", "start_values": {"observation": [0.0, -0.5]}},
        "gain": {"fmu": GAIN, "start_values": {"k": 3.0}},
    }
    connections = ["pendulum.a -> policy.observation[1]", "policy.action -> gain.u"]
    config = written(place.folder, instances, connections, algorithm=algorithm, window=window)

    rows = rows_of_both(place, config)

    angles, actions = column(rows, "pendulum.a"), column(rows, "policy.action")
    late = int(algorithm == "jacobi")  # then a step has the inputs of its start
    expected = answers(place.folder, angles, [-0.5] * len(angles))
    assert actions == [*expected[:late], *expected[: len(expected) - late]]
    assert column(rows, "gain.y")[late:] == [3.0 * action for action in actions[: len(actions) - late]]
    assert len(set(actions)) > 300


@pytest.mark.parametrize("group", [None, "loop"])
def test_a_cycle_has_the_floats_of_the_model(group: str | None, place: Place) -> None:
    instances = {
        "position": {"fmu": INTEGRATOR, "start_values": {"y": 1.0}, "group": group},
        "velocity": {"fmu": INTEGRATOR, "start_values": {"k": 2.0}, "group": group},
        "policy": {"onnx": "policy.onnx", "group": group},
    }
    connections = [
        "velocity.y -> position.u",
        "position.y -> policy.observation[1]",
        "velocity.y -> policy.observation[2]",
        "policy.action -> velocity.u",
    ]

    rows = rows_of_both(place, written(place.folder, instances, connections))

    positions, velocities = column(rows, "position.y"), column(rows, "velocity.y")
    actions = column(rows, "policy.action")
    assert actions == answers(place.folder, positions, velocities)
    assert velocities[1:] == [v + 0.01 * (2.0 * action) for v, action in zip(velocities, actions, strict=True)][:-1]
    assert len(set(actions)) > 300


def test_model_with_step_size_is_computed_at_its_own_points(place: Place) -> None:
    instances = {
        "pendulum": {"fmu": PENDULUM},
        "policy": {"onnx": "policy.onnx", "step_size": 0.05},
        "slow": {"fmu": INTEGRATOR, "step_size": 0.02},
    }
    connections = [
        "pendulum.a -> policy.observation[1]",
        "slow.y -> policy.observation[2]",
        "policy.action -> slow.u",
    ]

    rows = rows_of_both(place, written(place.folder, instances, connections))

    actions = column(rows, "policy.action")
    changes = [point for point in range(1, len(actions)) if actions[point] != actions[point - 1]]
    assert changes == [*range(5, len(actions), 5)]
    own = rows[::5]
    assert actions[::5] == answers(place.folder, column(own, "pendulum.a"), column(own, "slow.y"))


def test_any_name_of_a_tensor_can_be_connected_recorded_and_asked_for(place: Place) -> None:
    names = ("onnx::Gemm 0", "Policy/obs:0", "out.1 -> 2")
    nodes: Nodes = [("Add", [names[0], names[1]], [names[2]])]
    sizes = {name: ("FLOAT", ["N"]) for name in names}
    write_model(place.folder / "named.onnx", nodes, {n: sizes[n] for n in names[:2]}, {names[2]: sizes[names[2]]})
    instances = {
        "pendulum": {"fmu": PENDULUM},
        "net": {"onnx": "named.onnx", "start_values": {names[1]: 0.25}},
        "gain": {"fmu": GAIN},
    }
    connections = [
        {"from": "pendulum.a", "to": f"net.{names[0]}"},
        {"from": f"net.{names[2]}", "to": "gain.u"},
    ]
    config = written(place.folder, instances, connections)

    rows = rows_of_both(place, config)

    expected = [float(np.float32(angle) + np.float32(0.25)) for angle in column(rows, "pendulum.a")]
    assert column(rows, f"net.{names[2]}") == column(rows, "gain.y") == expected


def test_a_running_model_can_be_looked_at_and_set(place: Place) -> None:
    instances = {"gain": {"fmu": GAIN}, "policy": {"onnx": "policy.onnx"}}
    config = written(place.folder, instances, ["policy.action -> gain.u"])
    launched = place.start("launch", config, "--no-progress", "--paused")
    assert place.run("wait", "m", "--state", "paused").wait() == 0

    info = json.loads(place.run("info", "policy", "--json").output)
    done = place.run("set", "policy.observation", "[0.25, -0.75]")
    resumed = place.run("resume", "m")

    assert (info["kind"], info["model_name"]) == ("onnx_model", "graph")
    assert (done.wait(), resumed.wait(), launched.wait()) == (0, 0, 0), done.errors + launched.errors
    rows = [*csv.DictReader((place.folder / "m.csv").read_text(encoding="utf-8").splitlines())]
    assert [column(rows, "policy.action")[point] for point in (0, 1, 400)] == answers(
        place.folder, [0.0, 0.25, 0.25], [0.0, -0.75, -0.75]
    )


@pytest.mark.parametrize("options", [[], ["--local"]], ids=["distributed", "local"])
def test_output_that_is_no_number_ends_run_with_instance_variable_and_point(options: list[str], place: Place) -> None:
    sizes = {"x": ("DOUBLE", ["N"])}
    write_model(place.folder / "log.onnx", [("Log", ["x"], ["y"])], sizes, {"y": ("DOUBLE", ["N"])})
    # The ramp is 0.505 - t: it passes zero between the points 50 and 51.
    ramp = {"fmu": INTEGRATOR, "start_values": {"u": -1.0, "y": 0.505}}
    config = written(place.folder, {"ramp": ramp, "log": {"onnx": "log.onnx"}}, ["ramp.y -> log.x"])

    done = place.run("launch", config, "--no-progress", *options)

    assert done.wait() == 3
    assert "instance log.y, point 50, t = 0.5 s: the output is not a number (NaN)" in done.errors
    assert place.left() == []
