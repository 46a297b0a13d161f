"""A name that a model description declares twice: FMI forbids it, some FMUs do it, and it is one variable."""

from __future__ import annotations

import csv
import json
import queue
from pathlib import Path

import pytest
import zenoh

from tests.equivalence.test_events import both_ways
from tests.fmus.helpers import find_fmu
from tests.fmus.packing import repacked
from tests.helpers import DEADLINE_S, Place, write_config

REACHED = '<ScalarVariable name="reached" valueReference="{}" causality="output" variability="continuous"><Real/>'
SAME, OTHER = REACHED.format(3), REACHED.format(1)
"""What `reached` is declared as besides its own declaration: the same, or the value of `y`."""


def doubled(place: Place, declaration: str) -> Path:
    """An FMU of FMI 1.0 with another declaration of `reached` before its own."""
    variables = "<ModelVariables>"
    return repacked(
        place.folder / "doubled.fmu",
        source=find_fmu("Steps1", place.folder / "fmus"),
        description=lambda text: text.replace(variables, f"{variables}{declaration}</ScalarVariable>"),
    )


def point_of(sample: zenoh.Sample) -> int:
    assert sample.attachment is not None
    point: int = json.loads(sample.attachment.to_bytes())["point"]
    return point


@pytest.mark.parametrize("declaration", [SAME, OTHER], ids=["the same", "another"])
def test_name_declared_twice_is_one_variable_in_one_process_and_in_many(declaration: str, place: Place) -> None:
    content = {
        "simulation": {"stop_time": 1.0, "step_size": 0.01},
        "instances": {
            "doubled": {"fmu": str(doubled(place, declaration))},
            "plain": {"fmu": str(find_fmu("Steps1", place.folder / "fmus"))},
        },
        "connections": ["doubled.reached -> plain.u"],
    }

    launched, local = both_ways(place, content)

    assert launched == local
    rows = list(csv.DictReader(launched.decode().splitlines()))
    assert sorted(rows[0]) == sorted(
        ["time", *(f"{name}.{output}" for name in ("doubled", "plain") for output in ("y", "reached", "attempts"))]
    )
    assert [row["doubled.reached"] for row in rows] == [row["plain.reached"] for row in rows]
    assert [row["plain.y"] for row in rows[1:]] == [row["doubled.reached"] for row in rows[1:]]


def test_a_name_that_is_declared_twice_is_looked_at_as_any_other(place: Place) -> None:
    config = write_config(
        place.folder,
        instances={"doubled": {"fmu": str(doubled(place, OTHER))}},
        connections=[],
        stop_time=600.0,
        simulation={"step_size": 0.01, "real_time_factor": 1.0},
    )
    launched = place.start("launch", config, "--no-progress")
    samples: queue.SimpleQueue[zenoh.Sample] = queue.SimpleQueue()
    with place.session() as session:
        subscriber = session.declare_subscriber("fmu_mesh/pair/doubled/out/reached", samples.put)
        points = [point_of(samples.get(timeout=DEADLINE_S)) for _ in range(20)]
        subscriber.undeclare()

    got = place.run("get", "doubled.reached", "--json")
    info = place.run("info", "doubled")
    stopped = place.run("stop", "pair")

    assert points == list(range(points[0], points[0] + 20))
    [reading] = [json.loads(line) for line in got.output.splitlines()]
    assert reading["value"] == (reading["point"] - 1) * 0.01 + 0.01  # as the FMU adds it up
    assert 'The variable name "reached" (line ' in info.output
    assert stopped.wait() == 0
    assert launched.wait() == 130
    assert "stopped by a command" in launched.errors
