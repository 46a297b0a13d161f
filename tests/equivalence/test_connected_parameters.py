"""Connections to parameters: their values go from one FMU to the next in Initialization Mode, as in a plain loop."""

from __future__ import annotations

import csv
import re
from pathlib import Path

import pytest
import yaml

import fmu_mesh
from tests.equivalence.plain_loop import Wire, run_plainly
from tests.fmus.helpers import FMUS, NO_COMPILER, build_test_fmu
from tests.fmus.packing import repacked
from tests.helpers import Place

pytestmark = pytest.mark.skipif(NO_COMPILER is not None, reason=str(NO_COMPILER))

POINTS, STEP_SIZE = 8, 0.125
CHAIN = ("first.real_out -> second.real_in", "second.real_out -> gain.k")
"""Calculated parameters to parameters; what the last one gets counts in every step."""
RECORDED = ("pendulum.a", "gain.y", "second.real_out")
WAYS: list[tuple[tuple[str, ...], dict[str, str]]] = [
    (("--local",), {}),
    ((), {}),
    (("--window", "1"), {}),
    ((), {"FMU_MESH_LIBRARY": "none"}),
    (("--set-config", "zenoh={shared_memory: false}"), {}),
    (("--set-config", "zenoh={shared_memory: false, row_streams: false}"), {}),
    (("--set-config", "group=auto"), {}),
]
"""Options of `launch`, and its environment."""


def fmus_in(folder: Path) -> dict[str, Path]:
    """`first` and `second` calculate a parameter, `real_out`, from another one, `real_in`."""

    def of_parameters(text: str) -> str:
        text = text.replace(
            'causality="input" variability="continuous"', 'causality="parameter" variability="fixed" initial="exact"'
        ).replace('causality="output" variability="continuous"', 'causality="calculatedParameter" variability="fixed"')
        outputs = re.search(r"(?s)<Outputs>.*</Outputs>", text)
        assert outputs is not None
        return text.replace(outputs[0], re.sub(r'\s*<Unknown index="6"[^>]*/>', "", outputs[0]))

    source = build_test_fmu("AllTypes", folder)
    calculating = repacked(folder / "Calculating.fmu", source=source, description=of_parameters)
    others = {"pendulum": FMUS / "DampedPendulum.fmu", "gain": FMUS / "Gain.fmu"}
    return {"gain": others["gain"], "second": calculating, "first": calculating, "pendulum": others["pendulum"]}


def written(folder: Path, fmus: dict[str, Path], *more: str) -> Path:
    content = {
        "mesh": "parameters",
        "simulation": {"stop_time": POINTS * STEP_SIZE, "step_size": STEP_SIZE},
        "instances": {
            name: {"fmu": str(path), **({"start_values": {"real_in": 0.7}} if name == "first" else {})}
            for name, path in fmus.items()
        },
        "connections": ["pendulum.a -> gain.u", *CHAIN, *more],
        "record": {"file": "rows.csv", "variables": list(RECORDED)},
    }
    path = folder / "mesh.yaml"
    path.write_text(yaml.safe_dump(content, sort_keys=False), encoding="utf-8")
    return path


def test_in_every_run_parameters_get_values_in_order_of_their_dependencies(place: Place) -> None:
    fmus = fmus_in(place.folder)
    config, result = written(place.folder, fmus), place.folder / "rows.csv"
    wires = [Wire("pendulum.a", "gain.u")]
    wires += [Wire(source, target, None) for source, target in (ends.split(" -> ") for ends in CHAIN)]
    expected = run_plainly(
        {
            name: (fmus[name], {"real_in": 0.7} if name == "first" else {})
            for name in ("pendulum", "first", "second", "gain")
        },
        wires,
        [[wire] for wire in (wires[1], wires[2], wires[0])],
        points=POINTS,
        step_size=STEP_SIZE,
        recorded=RECORDED,
    )
    assert expected[-1][2] == 0.7 * expected[-1][1] != 0.0

    usual = place.environment
    for options, environment in WAYS:
        place.environment = {**usual, **environment}
        process = place.run("launch", config, "--no-progress", *options)

        assert process.wait() == 0, place.story()
        _, *rows = csv.reader(result.read_text(encoding="utf-8").splitlines())
        assert [tuple(map(float, row)) for row in rows] == expected, (options, environment)
        result.unlink()


def test_check_says_that_a_connected_parameter_gets_its_value_once(place: Place) -> None:
    check = fmu_mesh.load(written(place.folder, fmus_in(place.folder))).check()

    assert check.plan is not None
    assert [f"{one.source} -> {one.target}" for one in check.plan.connections if one.initial_only] == [*CHAIN]


def test_a_parameter_takes_no_value_that_changes(place: Place) -> None:
    fmus = fmus_in(place.folder)

    findings = fmu_mesh.load(written(place.folder, fmus, "pendulum.a -> first.real_in")).check().findings

    assert [finding.path for finding in findings] == ["connections[3].to"]
    assert "a parameter gets its value once, and 'pendulum.a' changes" in findings[0].expected
