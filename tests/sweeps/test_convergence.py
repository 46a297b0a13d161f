"""`Mesh.convergence` and its command: orders and errors of systems with exact solutions, and where there is none."""

from __future__ import annotations

import csv
import json
import shutil
import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib import image

import fmu_mesh
from fmu_mesh.pictures.sweep_drawing import convergence_figure
from fmu_mesh.sweeps.convergence import VariableConvergence
from tests.helpers import FMUS, Place, wait_until
from tests.sweeps import coupled_parts
from tests.sweeps.coupled_parts import exact

OUTSIDE = "not in the range where it converges"
SAME = "no difference beyond rounding between the two finest runs"


def mesh_of(folder: Path, *connections: str, stop_time: float = 10.0, **parts: dict[str, Any]) -> fmu_mesh.Mesh:
    """A mesh of parts, which all step at the same time and get what the others had before: hold."""
    shutil.copy(Path(coupled_parts.__file__), folder)
    mesh = fmu_mesh.Mesh.from_yaml("mesh: coupled", folder=folder)
    mesh.configure(simulation={"step_size": 0.02, "stop_time": stop_time, "algorithm": "jacobi"})
    for name, keys in parts.items():
        mesh.add(name, **{"python": f"coupled_parts.py:{name}", **keys})
    for connection in connections:
        mesh.connect(*connection.split(" -> "))
    return mesh


def masses(folder: Path, **options: Any) -> fmu_mesh.Mesh:  # noqa: ANN401 as `mesh_of`
    wires = "FirstMass.x -> SecondMass.x1", "FirstMass.v -> SecondMass.v1", "SecondMass.force -> FirstMass.force"
    return mesh_of(folder, *wires, FirstMass={}, SecondMass={}, **options)


def controlled(folder: Path) -> fmu_mesh.Mesh:
    return mesh_of(folder, "Lag.x -> Controller.y", "Controller.u -> Lag.u", Lag={}, Controller={})


def one_way(folder: Path, **oscillator: Any) -> fmu_mesh.Mesh:  # noqa: ANN401 keys of a section
    return mesh_of(folder, "Oscillator.x -> Lag.u", Lag={}, Oscillator=oscillator)


def found_in(convergence: fmu_mesh.Convergence) -> dict[str, VariableConvergence]:
    return {own.name: own for own in convergence.variables}


SYSTEMS = {
    masses: (
        [[0, 1, 0, 0], [-20, -2, 10, 1], [0, 0, 0, 1], [10, 1, -110, -3]],
        [1.0, 0.0, 1.0, 0.0],
        {"FirstMass.x": 0, "SecondMass.x": 2},
    ),
    # The last state is 1: the set point.
    controlled: ([[0, -1, 1], [2, -6, 4], [0, 0, 0]], [0.0, 0.0, 1.0], {"Lag.x": 1}),
    one_way: ([[0, 1, 0], [-1, 0, 0], [2, 0, -2]], [1.0, 0.0, 0.0], {"Lag.x": 2}),
}
"""By mesh, its A, its first states, and which state a variable is."""


@pytest.mark.parametrize("system", SYSTEMS)
def test_hold_has_order_one_and_the_estimate_is_the_error(system: Any, tmp_path: Path) -> None:  # noqa: ANN401 a function
    a, x, states = SYSTEMS[system]
    mesh = system(tmp_path)

    convergence = mesh.convergence(halvings=3, workers=2, folder=tmp_path / "kept")

    assert convergence.step_sizes == (0.02, 0.01, 0.005, 0.0025)
    assert (convergence.steps, convergence.points) == ((1000, 2000, 4000, 8000), 501)
    solution = exact(np.array(a, float), x, 0.0025, 4000)
    runs = [mesh.run(step_size=step, record="memory", processes=False) for step in (0.005, 0.0025)]
    for name, state in states.items():
        own = found_in(convergence)[name]
        assert own.verdict == "converges"
        assert own.order == pytest.approx(1.0, abs=0.1)
        assert own.rms_order == pytest.approx(1.0, abs=0.1)
        error = np.abs(runs[1][name] - solution[:, state])[::8].max()
        # What is neglected is smaller by the step size over the shortest time of these systems, which is about 0.1 s.
        assert own.error == pytest.approx(error, rel=0.05)
        assert own.differences[-1] == np.abs(runs[0][name][::4] - runs[1][name][::8]).max()  # the same floats
    assert len(fmu_mesh.SweepResult.read(tmp_path / "kept")) == 4


def test_a_stiff_coupling_gets_no_number_but_an_answer(place: Place) -> None:
    file = place.folder / "stiff.yaml"
    masses(place.folder).save(file)

    done = place.run("convergence", file, "--set", "SecondMass.kc=1000", "--set", "SecondMass.dc=10")

    assert done.wait() == 0
    lines = [line.split("  ", 1) for line in done.output.splitlines() if line.startswith(("First", "Second"))]
    assert {name: text.strip().partition("; ")[0] for name, text in lines} == dict.fromkeys(
        ["FirstMass.x", "FirstMass.v", "SecondMass.force", "SecondMass.x"], OUTSIDE
    )
    assert all(" the two finest runs differ by " in text for _, text in lines)
    assert "estimated error" not in done.output
    place.assert_nothing_left()


@pytest.mark.parametrize("halvings", [2, 3])
def test_a_very_stiff_coupling_is_not_in_the_range(halvings: int, tmp_path: Path) -> None:
    mesh = masses(tmp_path, stop_time=1.0)

    convergence = mesh.convergence(
        halvings=halvings, start_values={"SecondMass.kc": 1e5, "SecondMass.dc": 1e3}, workers=1
    )

    assert {own.verdict for own in convergence.variables} <= {OUTSIDE, f"{OUTSIDE}: NaN or infinite"}
    assert {(own.order, own.rms_order, own.error) for own in convergence.variables} == {(None, None, None)}
    assert convergence.plot() is not None


def test_an_instance_with_a_step_of_its_own_stays_slower(tmp_path: Path) -> None:
    mesh = one_way(tmp_path, step_size=0.08)

    convergence = mesh.convergence(workers=1, stop_time=8.0)

    own = found_in(convergence)
    assert own["Oscillator.own_step"].largest == 0.08 / 4
    assert own["Oscillator.own_step"].differences == (0.04, 0.02)
    assert own["Lag.x"].order == pytest.approx(1.0, abs=0.1)
    assert convergence.steps == (500, 1000, 2000)


def test_a_discrete_variable_of_an_fmu_is_not_compared(event_fmu: Callable[..., Path]) -> None:
    mesh = fmu_mesh.Mesh.from_fmu(event_fmu("Ball", 3), simulation={"step_size": 0.01, "stop_time": 0.4})
    mesh.record("Ball.*")

    convergence = mesh.convergence(workers=1)

    assert convergence.not_compared["Ball.last_bounce"] == "discrete"
    assert [own.name for own in convergence.variables] == ["Ball.h", "Ball.v"]


def test_integers_are_listed_and_a_variable_may_not_change(tmp_path: Path) -> None:
    convergence = masses(tmp_path).convergence(workers=1, stop_time=1.0)

    assert convergence.not_compared == {"SecondMass.steps": "Int64"}
    assert "not compared: SecondMass.steps (Int64)" in str(convergence)
    alone = fmu_mesh.Mesh.from_fmu(FMUS / "Integrator.fmu", simulation={"stop_time": 1.0}, start_values={"u": 0.1})
    alone.record("Integrator.y")
    assert [own.verdict for own in alone.convergence(workers=1).variables] == [SAME]


def test_one_halving_says_that_one_more_is_needed(tmp_path: Path) -> None:
    convergence = one_way(tmp_path).convergence(halvings=1, workers=1)

    assert "Lag.x" in str(convergence)
    assert found_in(convergence)["Lag.x"].verdict == "one more halving is needed to know"
    assert "`halvings=3`" not in str(convergence)


def test_a_run_that_explodes_is_an_answer(tmp_path: Path) -> None:
    convergence = mesh_of(tmp_path, Growing={}).convergence(workers=1, stop_time=1.0)

    assert [own.verdict for own in convergence.variables] == [f"{OUTSIDE}: NaN or infinite"]
    assert len(convergence.plot().axes[0].lines) == 2  # the slopes


def test_an_instance_that_refuses_smaller_steps_is_named(tmp_path: Path) -> None:
    mesh = mesh_of(tmp_path, Coarse={}, stop_time=1.0)

    with pytest.raises(fmu_mesh.FmuError) as raised:
        mesh.convergence(workers=1)

    text = str(raised.value)
    assert text.startswith("the run with steps of 0.005 s failed: instance Coarse, point 0, t = 0 s: ")
    assert "a step of 0.005 s is too small for me" in text
    assert text.endswith("Choose another `step_size`, or fewer `halvings`.")


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ({"halvings": 7}, "`halvings=7`: expected a whole number from 1 to 6"),
        ({"halvings": 0}, "`halvings=0`"),
        ({"keys_from": "run.csv"}, "`keys_from` for runs with other step sizes"),
        ({"config_values": {"simulation.stop_time": None}}, "has no end. Give it one, with `stop_time=...`."),
        ({"stop_time": 2.0**53 * 0.015, "halvings": 1}, "has steps of 0.01 s: choose fewer `halvings`, or a larger"),
        ({"config_values": {"record.variables": []}}, "records nothing to compare. Name `record.variables`."),
        ({"config_values": {"record.from": 0.03, "record.every": 3}}, "no common point"),
    ],
)
def test_what_cannot_be_studied_is_refused_with_a_way_out(options: dict[str, Any], text: str, tmp_path: Path) -> None:
    with pytest.raises(fmu_mesh.FmuMeshError) as raised:
        one_way(tmp_path).convergence(**{"workers": 1, **options})

    assert text in str(raised.value)


def test_the_command_writes_a_table_a_picture_and_one_object(place: Place) -> None:
    file = place.folder / "masses.yaml"
    masses(place.folder).save(file)

    done = place.run("convergence", file, "--output", "table.csv", "--plot", "error.png", "--stop-time", "1")
    as_json = place.run("convergence", file, "--json", "--stop-time", "1", "--workers", "2")

    assert (done.wait(), as_json.wait()) == (0, 0)
    head, _, names, *rows = done.output.splitlines()
    assert head == "coupled: steps of 0.02, 0.01, 0.005 s, compared at 51 common points"
    assert names.split("  ")[0] == "variable"
    assert all(row[names.index("order") - 1] == " " for row in rows[:4])
    assert "A single order may be chance: see `--halvings 3`." in done.output
    assert rows[-2:] == ["table: table.csv", "plot: error.png"]
    found = json.loads(as_json.output)
    with (place.folder / "table.csv").open(newline="") as table:
        lines = [*csv.DictReader(table)]
    assert [line["name"] for line in lines] == [own["name"] for own in found["variables"]]
    assert float(lines[0]["error"]) == found["variables"][0]["error"]
    assert float(lines[0]["0.01 s - 0.005 s"]) == found["variables"][0]["differences"][1]
    assert image.imread(place.folder / "error.png").shape[2] == 4
    assert not list(place.folder.glob("*_sweep"))
    place.assert_nothing_left()


def test_a_folder_keeps_the_runs_for_another_halving(place: Place) -> None:
    file = place.folder / "one_way.yaml"
    one_way(place.folder).save(file)
    place.run("convergence", file, "--folder", "kept")

    refused = place.run("convergence", file, "--folder", "kept")
    more = place.run("convergence", file, "--folder", "kept", "--resume", "--halvings", "3")

    assert refused.wait() == 2
    assert "`--resume`" in refused.message
    assert more.wait() == 0
    assert len((place.folder / "kept" / "rows.jsonl").read_text().splitlines()) == 4
    place.assert_nothing_left()


def test_ctrl_c_ends_a_study_and_says_what_is_kept(place: Place) -> None:
    file = place.folder / "long.yaml"
    one_way(place.folder).save(file)
    study = place.start("convergence", file, "--stop-time", "1e6")
    wait_until(lambda: list((place.folder / "tmp").glob("fmu_mesh-*/runs/*.csv*")), "the first rows")

    study.signal(signal.SIGINT)

    assert study.wait() == 130
    assert "`--folder` keeps its runs." in study.message
    place.assert_nothing_left(5.0)


def test_a_picture_has_both_slopes_and_leaves_out_what_has_no_place() -> None:
    figure = convergence_figure("m", [0.2, 0.1, 0.05], [5, 10, 20], {"a.y": [4.0, 2.0, 1.0], "b.y": [0.0, 1.0]})

    for axes in figure.axes:
        assert [text.get_text() for text in axes.texts] == ["order 1", "order 2"]
        assert (axes.get_xscale(), axes.get_yscale()) == ("log", "log")
    legend = figure.axes[1].get_legend()
    assert legend is not None
    assert [text.get_text() for text in legend.get_texts()] == ["a.y", "b.y (difference)"]
    assert figure.get_facecolor() == (1.0, 1.0, 1.0, 1.0)  # readable on a dark page, too
