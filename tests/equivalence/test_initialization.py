"""Algebraic loops at the start, in real processes: consistent values, the same in every float, or a clear error."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from fmu_mesh.errors import LoopNotConverged
from tests.helpers import Place, rows_of, write_config
from tests.plain_run import PlainRun
from tests.planning import prepare

CONNECTIONS = ("pendulum.a -> sum.u1", "sum.y -> a.u", "a.y -> b.u", "b.y -> sum.u2", "b.y -> end.u")


def ring(folder: Path, gain: float, **initialization: float) -> Path:
    """A loop of three instances, each a process of its own, with one before it and one after it."""
    instances: dict[str, dict[str, Any]] = {
        "pendulum": {"fmu": "DampedPendulum"},
        "sum": {"fmu": "Adder"},
        "a": {"fmu": "Gain", "start_values": {"k": gain}},
        "b": {"fmu": "Gain", "start_values": {"k": -1.0}},
        "end": {"fmu": "Gain"},
    }
    return write_config(
        folder, instances=instances, connections=CONNECTIONS, name="ring", stop_time=0.05, initialization=initialization
    )


def test_a_loop_over_processes_starts_with_consistent_values_and_equals_one_process(place: Place) -> None:
    config = ring(place.folder, 3.0, relaxation=0.25)
    result = place.folder / "ring.csv"

    assert place.run("launch", config, "--no-progress").wait() == 0
    distributed = result.read_bytes()
    PlainRun(prepare(config)).run()

    assert distributed == result.read_bytes()
    _, angle, *_, total, first, second, after = rows_of(result)[0]
    assert abs(total - (angle + second)) <= 1e-9  # the torn connection, within the tolerance
    assert (first, second, after) == (3.0 * total, -first, second)
    # The loop is u = -3 (angle + u) at the start; its error is the residual over 1 + 3.
    assert abs(second + 0.75 * angle) <= 1e-9


def test_loop_that_does_not_converge_ends_run_with_its_names_and_residuals(place: Place) -> None:
    config = ring(place.folder, -1.0)  # u = angle + u has no solution

    process = place.run("launch", config, "--no-progress")

    assert process.wait() == 3
    assert "the algebraic loop sum.y -> a.y -> b.y did not converge at the start: after 1000 " in process.message
    assert "residuals: b.y -> sum.u2 1.5 (from 1498.5 to 1500); as the tolerance counts them, 0.001" in process.message
    assert "It may have no solution" in process.message
    place.assert_nothing_left()
    with pytest.raises(LoopNotConverged) as caught:
        PlainRun(prepare(config)).run()
    assert caught.value.message in process.message
