"""The defects of a run are the same floats in every way of running it, and follow from the values that it records."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import fmu_mesh
from fmu_mesh.errors import ConfigurationError, StepFailed
from tests.helpers import FMUS, Place, wait_until

POINTS = 9000
FAILING = """
import fmu_mesh

class Failing(fmu_mesh.Component):
    u = fmu_mesh.Input()
    y = fmu_mesh.Output()

    def step(self, time, step_size):
        if time > 0.5:
            raise ValueError("no further")
        self.y = self.u
"""
SOLVED: Mapping[str, Any] = {"loops": "solved", "extrapolation": "midpoint"}


def oscillator(**simulation: Any) -> fmu_mesh.Mesh:  # noqa: ANN401  as the file has them
    """Two integrators in a cycle through a gain, which depends on its input directly; a slow and a fast reader."""
    mesh = fmu_mesh.Mesh("oscillator", step_size=0.01, stop_time=0.01 * POINTS)
    mesh.add("x", fmu=str(FMUS / "Integrator.fmu"), start_values={"y": 1.0})
    mesh.add("v", fmu=str(FMUS / "Integrator.fmu"))
    mesh.add("gain", fmu=str(FMUS / "Gain.fmu"), start_values={"k": -1.0})
    mesh.add("old", fmu=str(FMUS / "TransportDelay.fmu"), start_values={"d": 0.1}, step_size=0.03)
    mesh.add("sum", fmu=str(FMUS / "Integrator.fmu"))
    mesh.connect("v.y", "x.u")
    mesh.connect("x.y", "gain.u")
    mesh.connect("gain.y", "v.u", factor=2.0, offset=0.25)
    mesh.connect("x.y", "old.x")
    mesh.connect("old.y", "sum.u")
    mesh.configure(simulation=simulation)
    return mesh


def differences(values: NDArray[np.float64]) -> tuple[float, int, float]:
    """The largest one, at which point, and the root mean square, where the last value is held."""
    found = np.abs(np.diff(values))
    return float(found.max()), int(found.argmax()) + 1, float(np.sqrt(np.mean(found**2)))


@pytest.mark.parametrize("simulation", [{}, SOLVED, {"algorithm": "jacobi"}], ids=["hold", "solved", "jacobi"])
def test_every_way_of_running_gives_the_same_floats(simulation: dict[str, Any], tmp_path: Path) -> None:
    mesh, groups = oscillator(**simulation), oscillator(**simulation)
    groups.configure(group="auto")

    one = mesh.run(defects=True, output=tmp_path / "one.csv", processes=False)
    others = [
        mesh.run(defects=True, output=tmp_path / "all.csv"),
        mesh.run(defects=True, output=tmp_path / "narrow.csv", window=16),
        mesh.run(defects=True, record="memory", processes=False),
        mesh.run(defects=True, record=["x.y"]),
        groups.run(defects=True, record="memory"),
        fmu_mesh.Result.read(tmp_path / "one.csv"),
        fmu_mesh.Result.read(tmp_path / "narrow.csv"),
    ]

    assert [*one.defects] == ["v.y -> x.u", "x.y -> gain.u", "gain.y -> v.u", "x.y -> old.x", "old.y -> sum.u"]
    assert all(other.defects == one.defects for other in others)
    assert one.metadata["defects"]["v.y -> x.u"]["steps"] == POINTS


def test_with_hold_it_is_the_difference_of_rows(tmp_path: Path) -> None:
    result = oscillator().run(defects=True, output=tmp_path / "held.csv")

    for name, values in (("v.y -> x.u", result["v.y"]), ("gain.y -> v.u", 2.0 * result["gain.y"] + 0.25)):
        maximum, point, rms = differences(values)
        found = result.defects[name]
        assert (found.maximum, found.point, found.steps) == (maximum, point, POINTS)
        assert found.time == pytest.approx(0.01 * point)
        assert found.rms == pytest.approx(rms, rel=1e-12)
        assert found.relative == maximum / np.ptp(values)
    slow, _, _ = differences(result["x.y"][::3])
    assert (result.defects["x.y -> old.x"].maximum, result.defects["old.y -> sum.u"].steps) == (slow, POINTS // 3)


def test_consistent_outputs_are_compared_as_sums(tmp_path: Path) -> None:
    mesh = oscillator(loops="solved")

    result = mesh.run(defects=True, output=tmp_path / "solved.csv", record=["gain.y"])

    consistent = 2.0 * result["gain.y"] + 0.25
    assert result.defects["gain.y -> v.u"].maximum == pytest.approx(differences(consistent)[0], rel=1e-12)


def test_lines_have_smaller_defects_than_holding() -> None:
    held, lines = (
        oscillator(loops="solved", extrapolation=way).run(defects=True, record="memory", processes=False).defects
        for way in ("hold", "midpoint")
    )

    assert lines["v.y -> x.u"].rms < 0.02 * held["v.y -> x.u"].rms


@pytest.mark.parametrize("processes", [True, False])
def test_a_run_that_fails_has_the_defects_of_its_rows(tmp_path: Path, processes: bool) -> None:  # noqa: FBT001  a parameter of the test
    (tmp_path / "failing.py").write_text(FAILING)
    mesh = fmu_mesh.Mesh("failing", step_size=0.001, stop_time=1.0)
    mesh.add("x", fmu=str(FMUS / "Integrator.fmu"), start_values={"u": 1.0})
    mesh.add("end", python=f"{tmp_path}/failing.py:Failing")
    mesh.connect("x.y", "end.u")

    with pytest.raises(StepFailed) as failed:
        mesh.run(defects=True, output=tmp_path / "failing.csv", processes=processes)

    result = failed.value.result
    assert isinstance(result, fmu_mesh.Result)
    assert result.defects["x.y -> end.u"].steps == len(result.times) - 1 == 501


def test_a_run_from_a_state_compares_from_there_on(tmp_path: Path) -> None:
    mesh = oscillator(algorithm="jacobi")
    with mesh.open() as system:
        system.step(300)
        system.save(tmp_path / "here.state")

    result = mesh.run(defects=True, state=tmp_path / "here.state", record="memory", stop_time=6.0, processes=False)

    assert result.defects["v.y -> x.u"].steps == 300
    assert result.defects["v.y -> x.u"].maximum == differences(result["v.y"])[0]


def test_the_status_and_graph_of_a_run_have_the_defects_so_far() -> None:
    so_far = oscillator().run(defects=True, record="memory", stop_time=5.0, processes=False).defects

    with oscillator().start(defects=True, record="memory", paused=True) as run:
        run.wait_for("paused")
        run.step(500)
        shown = wait_until(
            lambda: found if (found := run.status.defects) and found["v.y -> x.u"].steps == 500 else None,
            "the defects of these points",
        )
        picture = run.graph().svg()
        run.stop()

    assert shown == so_far
    assert [*shown] == sorted(shown, key=lambda name: -shown[name].relative)
    assert f"\nassumed and came differ by at most {so_far['v.y -> x.u'].maximum:.3g} (at t = " in picture


def test_without_the_option_nothing_is_compared(tmp_path: Path) -> None:
    result = oscillator().run(output=tmp_path / "none.csv", stop_time=1.0)

    assert result.defects == {}
    assert "defects" not in result.metadata


def test_defects_without_a_result_are_refused() -> None:
    mesh = oscillator()
    mesh.configure(record={"file": None})

    with pytest.raises(ConfigurationError, match="defects are calculated where rows are written, and nothing is rec"):
        mesh.plan(defects=True)


def test_the_summary_shows_the_five_largest(place: Place) -> None:
    config = place.folder / "oscillator.yaml"
    oscillator().save(config)

    run = place.run("launch", config, "--defects", "--local")

    assert run.wait() == 0, run.story()
    _, rest = run.output.split("defects: a pointer to the connection, no error estimate\n")
    heading, first, *_ = rest.splitlines()
    assert heading.split() == ["connection", "largest", "of", "its", "range", "RMS", "at", "t", "in", "s"]
    assert first.startswith("  x.y -> old.x ")
