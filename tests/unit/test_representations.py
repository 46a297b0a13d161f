"""How objects look in an interpreter and in a notebook: one line, a short table, and nothing that costs or fails."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import fmu_mesh
from fmu_mesh.api.result import Result
from fmu_mesh.pictures.graph_drawing import GraphNode, GraphVariable
from fmu_mesh.pictures.system_graph import graph_of
from fmu_mesh.pictures.tables import html_table
from fmu_mesh.results.recording import Columns
from tests.helpers import FMUS

PAIR = """
mesh: pair
simulation: {stop_time: 1.0, step_size: 0.01}
instances:
  pendulum: {fmu: DampedPendulum.fmu, start_values: {a: 1.3}}
  delay: {fmu: TransportDelay.fmu, start_values: {d: 0.1}}
connections: [pendulum.a -> delay.x]
"""


def pair(text: str = PAIR, folder: Path = FMUS) -> fmu_mesh.Mesh:
    return fmu_mesh.Mesh.from_yaml(text, folder=folder)


def html(shown: object) -> str:
    return str(shown._repr_html_())  # type: ignore[attr-defined]  # what a notebook calls


def objects(folder: Path) -> Iterator[tuple[object, str]]:
    """One object of each class, and how it is represented."""
    mesh = pair()
    mesh.to_ssp(folder / "pair.ssp")
    result = mesh.run(record="memory", processes=False)
    other = mesh.run(record="memory", processes=False, start_values={"delay.d": 0.2})
    yield mesh, "<Mesh pair: 2 instances, 1 connection>"
    yield mesh.plan(), "<RunPlan of pair: 2 instances, 1 connection, 100 points>"
    yield mesh.check().plan, "<PlanView of pair: 2 instances, 1 connection>"
    yield mesh.graph(), "<SystemGraph of pair: 2 instances in 2 processes, 1 connection>"
    yield mesh.repeated(), "<RepeatedMesh of <Mesh pair: 2 instances, 1 connection>>"
    yield result.compare(other), "<Comparison: this result and the other one differ: 1 of 4 variables>"
    gain = fmu_mesh.inspect(FMUS / "Gain.fmu")
    yield gain, f"<Inspection of {FMUS / 'Gain.fmu'}: FMI 2.0 co-simulation, 3 variables, runs here>"
    yield gain.description, "<ModelDescription of Gain: FMI 2.0, 3 variables>"
    package = fmu_mesh.inspect_package(folder / "pair.ssp")
    yield (
        package,
        f"<PackageInspection of {folder / 'pair.ssp'}: SSP 1.0, 2 components, 1 connection between them>",
    )
    with mesh.open() as system:
        system.step(5)
        yield system, "<System pair: ready, point 5, 0.05 s>"
        yield system.save(), "<SystemState: point 5>"


def test_each_object_is_represented_by_one_line(tmp_path: Path) -> None:
    for shown, expected in objects(tmp_path):
        assert repr(shown) == expected


def test_a_check_says_whether_the_mesh_can_run_and_what_is_wrong() -> None:
    wrong = pair(PAIR.replace("delay.x", "delay.y")).check()

    assert repr(pair().check()).endswith(": can run, 0 warnings>")
    assert html(pair().check()).count("<tr>") == 3
    assert repr(wrong).endswith(": 1 finding, 0 warnings>")
    assert "<td" in html(wrong)
    assert "connections[0]" in html(wrong)


def test_a_mesh_of_1000_instances_is_shown_in_few_lines() -> None:
    mesh = fmu_mesh.Mesh("large", step_size=0.01, stop_time=1.0)
    for number in range(1000):
        mesh.add(f"gain{number}", fmu=FMUS / "Gain.fmu")
    for number in range(999):
        mesh.connect(f"gain{number}.y", f"gain{number + 1}.u")

    for shown in (mesh, mesh.check(), mesh.graph()):
        assert len(repr(shown)) < 100
        assert len(html(shown)) < 8_000
        assert "and 980 more rows" in html(shown)


def test_a_graph_of_very_many_connections_is_a_table() -> None:
    nodes = [GraphNode(f"i{number}", "m.fmu", "p") for number in range(20)]
    pairs = [(a.instance, b.instance, 1) for a in nodes for b in nodes]

    graph = graph_of("dense", nodes, [(pair, GraphVariable("y", "u")) for pair in pairs])

    assert html(graph).count("<tr>") == 21
    assert "<svg" in html(graph_of("chain", nodes, [(("i0", "i1", 0), GraphVariable("y", "u"))]))


@pytest.mark.parametrize(
    "text",
    [
        "[1, 2]",
        "7",
        "mesh: {a: 1}",
        "instances: [a, b]\nconnections: 3",
        "instances: {a: 3, b: null, c: [x]}",
        "instances: {a: {start_values: [1]}}",
    ],
)
def test_a_mesh_of_any_text_is_shown(text: str) -> None:
    mesh = pair(text)

    assert repr(mesh).startswith("<Mesh ")
    assert html(mesh).startswith("<div>")


def test_names_of_others_are_no_markup() -> None:
    mesh = pair("mesh: <script>a</script>\ninstances: {<b>x</b>: {fmu: '<i>&\u202e'}}")
    rows = html_table("<u>", ["<s>"], [["<script>\n"]], 1)

    assert "<script>" not in html(mesh) + rows
    assert "&lt;script&gt;\\n" in rows
    assert not any(tag in html(mesh) + rows for tag in ("<b>", "<i>", "<u>", "<s>", "\u202e"))


def test_to_show_a_thing_reads_no_file(tmp_path: Path) -> None:
    folder = tmp_path / "gone"
    shutil.copytree(FMUS, folder, ignore=shutil.ignore_patterns("src"))
    mesh = pair(folder=folder)
    plan = mesh.plan(record="memory")
    with fmu_mesh.sweep(mesh, {"pendulum.d": [0.1, 0.2]}, folder=folder / "sweep", workers=1) as running:
        sweep = running.wait()
    curves, check, graph = sweep.curves(0), mesh.check(), mesh.graph()
    later = Result("later", file=folder / "later.csv", system=plan.plan.system)
    shutil.rmtree(folder)

    assert repr(running) == "<Sweep of pair: 2 of 2 runs, 0 failed>"
    assert html(running) == "<progress value='2' max='2'></progress> pair: 2 of 2 runs, 0 failed"
    assert repr(sweep) == "<SweepResult of 'pair': 2 of 2 runs, 0 failed>"
    assert html(sweep).count("<tr>") == 3
    assert repr(later).startswith("<Result of 'later': pendulum.a, pendulum.der(a), ")
    for shown in (mesh, check, graph, curves, later):
        assert repr(shown)
        assert html(shown)


def test_a_table_is_cut_and_says_so() -> None:
    asked = []

    def rows() -> Iterator[list[object]]:
        for number in range(10**9):
            asked.append(number)
            yield [number] * 40

    text = html_table("numbers", ["column"] * 40, rows(), 10**9)

    assert len(asked) <= 21
    assert text.count("<td") == 200
    assert "and 999999980 more rows" in text
    assert "and 30 more columns" in text


@pytest.mark.parametrize(
    ("values", "cells"),
    [([1.0, -2.5], ("-2.5", "1")), (["b", "a"], ("", "")), ([], ("", "")), ([True], ("True", "True"))],
)
def test_a_result_shows_the_least_and_the_largest_value(values: list[Any], cells: tuple[str, str]) -> None:
    result = Result("r", columns=Columns(np.arange(float(len(values))), {"a.y": np.array(values)}))

    assert all(f">{cell}</td>" in html(result) for cell in cells)
