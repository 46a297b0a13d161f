"""Coupled linear parts with exact solutions: the errors and the order of a group that is solved by Newton.

The FMUs have the equations of systems that were solved exactly, by matrix exponentials, for parts that are exact for
inputs which are linear over a step. So the errors here are those of the coupling, and known: `EXPECTED` has those of
0.02 s and 0.01 s.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest

import fmu_mesh
from tests.fmus.event_fmus import Version
from tests.helpers import write_config
from tests.physics.linear_parts import diagonal, exponential
from tests.solved_systems import LINKS, MASSES, PARTS, masses

EventFmu = Callable[..., Path]
Starts = Mapping[str, float]


class Coupled(NamedTuple):
    """Two parts, their links, the time of the end in s, and the errors that are expected."""

    one: Starts
    two: Starts
    links: tuple[str, ...]
    stop: float
    expected: tuple[float, float]


SOFT = {**MASSES[1], "e": 10.0, "c": 1.0}
STIFF = {**MASSES[1], "e": 1e5, "c": 1e3}
SIGNALS = ("two.y -> one.w", "one.y -> two.u")
SYSTEMS = {
    "soft masses": Coupled(MASSES[0], SOFT, LINKS, 10.0, (9.5726e-4, 2.3987e-4)),
    "medium masses": Coupled(MASSES[0], MASSES[1], LINKS, 10.0, (2.8778e-2, 7.1746e-3)),
    "stiff masses": Coupled(MASSES[0], STIFF, LINKS, 10.0, (5.6729e-1, 3.2685e-1)),
    "ladder with a loop gain of -2": Coupled(
        {"a": -1.0, "b": 1.0, "e": -1.0, "c": 1.0, "f": -2.0, "u": 1.0},
        {"a": -2.0, "b": 2.0, "c": -1.0, "d": 1.0},
        SIGNALS,
        5.0,
        (5.3896e-6, 1.3475e-6),
    ),
    "PI controller and plant": Coupled(
        {"b": 1.0, "e": -1.0, "c": 1.0, "d": 2.0, "f": -2.0, "u": 1.0},
        {"a": -2.0, "b": 2.0, "c": 1.0},
        SIGNALS,
        10.0,
        (1.7815e-4, 4.4504e-5),
    ),
    "thermal pair": Coupled(
        {"b": 1.0, "e": -1.0, "c": 1.0, "x": 1.0, "u": 1.0},
        {"a": -0.75, "b": 0.5, "c": -1.0, "d": 1.0},
        SIGNALS,
        5.0,
        (7.7434e-6, 1.9358e-6),
    ),
}


def part(starts: Starts) -> tuple[Any, ...]:
    """The matrices A, B, C and D of a `LinearPart`; the outputs are x, v and y, the inputs u and w."""
    a, b, e, c, d, f = (starts.get(name, 0.0) for name in "abecdf")
    match starts.get("masses", 0):
        case 1:
            return [[0, 1], [-a, -b]], [[0, 0], [1, 0]], [[1, 0], [0, 1], [0, 0]], [[0, 0]] * 3
        case 2:
            force = [[1, 0], [0, 1], [e, c]]
            return [[0, 1], [-a - e, -b - c]], [[0, 0], [e, c]], force, [[0, 0], [0, 0], [-e, -c]]
    return [[a, 0], [0, 0]], [[b, e], [0, 0]], [[1, 0], [0, 1], [c, 0]], [[0, 0], [0, 0], [d, f]]


def exact(system: Coupled, step_size: float, count: int) -> np.ndarray[Any, Any]:
    """`one.x` and `two.x` at the points: the whole is one linear system."""
    parts = [part(system.one), part(system.two)]
    a, b, c, d = (diagonal([np.array(own[number], float) for own in parts]) for number in range(4))
    links, constant = np.zeros((4, 6)), np.array([system.one.get("u", 0.0), 0.0, 0.0, 0.0])
    outputs = [f"{name}.{variable}" for name in ("one", "two") for variable in "xvy"]
    inputs = [f"{name}.{variable}" for name in ("one", "two") for variable in "uw"]
    for link in system.links:
        source, target = link.split(" -> ")
        links[inputs.index(target), outputs.index(source)] = 1.0
    inverse = np.linalg.inv(np.eye(4) - links @ d)
    whole = np.zeros((5, 5))
    whole[:4, :4] = a + b @ inverse @ links @ c
    whole[:4, 4] = b @ inverse @ constant
    move = exponential(whole * step_size)
    rows = [np.array([system.one.get("x", 0), 0, system.two.get("x", 0), 0, 1.0])]
    for _ in range(count):
        rows += [move @ rows[-1]]
    return np.array(rows)[:, [0, 2]]


def error_of(
    fmu: Path,
    folder: Path,
    system: Coupled,
    step_size: float,
    *,
    kind: str = "model_exchange",
    simulation: Mapping[str, str] | None = None,
    **group: object,
) -> float:
    """The largest error of the positions over a run; with keys of ``simulation`` there is no group."""
    instances = masses(fmu, **group)
    for name, starts in (("one", system.one), ("two", system.two)):
        instances[name] = {**instances[name], "start_values": starts, "kind": kind}
        if simulation is not None:
            del instances[name]["group"]
        if kind == "co_simulation":
            del instances[name]["solver"]
    config = write_config(
        folder,
        instances=instances,
        connections=system.links,
        stop_time=system.stop,
        simulation={"step_size": step_size, **(simulation or {})},
        record={"file": "pair.csv", "variables": ["one.x", "two.x"]},
    )
    result = fmu_mesh.load(config).run(processes=False, record="memory")
    found = np.stack([result["one.x"], result["two.x"]], 1)
    return float(np.abs(found - exact(system, step_size, len(result.times) - 1)).max())


@pytest.mark.parametrize("name", SYSTEMS)
def test_fmus_that_take_lines_have_the_known_errors_of_order_2(event_fmu: EventFmu, tmp_path: Path, name: str) -> None:
    system, fmu = SYSTEMS[name], event_fmu("LinearPart", 2)

    errors = [error_of(fmu, tmp_path, system, step_size) for step_size in (0.02, 0.01)]

    assert errors == pytest.approx(system.expected, rel=1e-3)
    if "stiff" not in name:
        assert math.log2(errors[0] / errors[1]) == pytest.approx(2.0, abs=0.02)


LINES = {
    "soft masses": (2.2510e-3, 5.6361e-4),
    "medium masses": (1.4897e-1, 3.7620e-2),
    "ladder with a loop gain of -2": (1.3157e-4, 3.3112e-5),
    "PI controller and plant": (2.6604e-3, 6.8228e-4),
    "thermal pair": (9.8843e-5, 2.4855e-5),
}
"""The errors of the same parts where inputs follow the line through their last two values, with consistent outputs."""


@pytest.mark.parametrize("name", LINES)
def test_lines_with_solved_loops_have_the_known_errors(event_fmu: EventFmu, tmp_path: Path, name: str) -> None:
    system, fmu = SYSTEMS[name], event_fmu("LinearPart", 2)
    coupling = {"loops": "solved", "extrapolation": "auto", "algorithm": "jacobi"}

    errors = [error_of(fmu, tmp_path, system, step_size, simulation=coupling) for step_size in (0.02, 0.01)]

    assert errors == pytest.approx(LINES[name], rel=0.01)  # the solver has a tolerance, too
    if name != "medium masses":
        assert math.log2(errors[0] / errors[1]) == pytest.approx(2.0, abs=0.1)  # there are terms of higher orders


@pytest.mark.parametrize(("version", "kind"), [(3, "model_exchange"), (2, "co_simulation"), (3, "co_simulation")])
def test_each_kind_of_fmu_is_of_order_2(event_fmu: EventFmu, tmp_path: Path, version: Version, kind: str) -> None:
    system, fmu = SYSTEMS["PI controller and plant"], event_fmu("LinearPart", version)

    errors = [error_of(fmu, tmp_path, system, step_size, kind=kind) for step_size in (0.02, 0.01)]

    if (version, kind) != (3, "co_simulation"):  # that takes no line: its inputs are the means
        assert errors == pytest.approx(system.expected, rel=1e-3)
    assert errors[0] < 1.5 * system.expected[0]
    assert math.log2(errors[0] / errors[1]) == pytest.approx(2.0, abs=0.02)


def test_components_whose_inputs_are_means_are_of_order_2(event_fmu: EventFmu, tmp_path: Path) -> None:
    (tmp_path / "parts.py").write_text(PARTS, encoding="utf-8")
    system, errors = SYSTEMS["medium masses"], []
    for step_size in (0.01, 0.005, 0.0025):
        instances = masses(event_fmu("LinearPart", 2))
        instances["two"] = {"python": "parts.py:Mass", "group": "g"}
        config = write_config(
            tmp_path,
            instances=instances,
            connections=LINKS,
            stop_time=5.0,
            simulation={"step_size": step_size},
            record={"file": "pair.csv", "variables": ["one.x", "two.x"]},
        )
        result = fmu_mesh.load(config).run(processes=False, record="memory")
        found = np.stack([result["one.x"], result["two.x"]], 1)
        errors.append(float(np.abs(found - exact(system, step_size, len(found) - 1)).max()))

    assert errors[0] < 0.03
    assert math.log2(errors[1] / errors[2]) == pytest.approx(2.0, abs=0.1)


def test_the_log_says_what_a_group_has_cost(event_fmu: EventFmu, tmp_path: Path) -> None:
    config, said = write_config(tmp_path, instances=masses(event_fmu("LinearPart", 2)), connections=LINKS), list[str]()

    fmu_mesh.load(config).run(processes=False, on_event=lambda event: said.append(str(event)))

    # Two tries for a point: the parts are linear, and the Jacobian is measured once.
    assert any("the group 'g' took 1000 steps and 2000 tries for 1000 points" in text for text in said), said


def test_step_control_makes_errors_smaller_with_points_that_are_far_apart(event_fmu: EventFmu, tmp_path: Path) -> None:
    fmu, system = event_fmu("LinearPart", 2), SYSTEMS["medium masses"]
    errors = [
        error_of(fmu, tmp_path, system, 0.02, step_control={"tolerance": tolerance}) for tolerance in (1e-2, 1e-4)
    ]

    assert errors[0] < system.expected[0]
    assert errors[1] < 0.1 * errors[0]
    assert errors[1] < 5e-4
